"""Configuration of a simulated session, in one frozen record."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, as_float_array
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.probe_model import ChannelModel, ProbeModel, SensitivityModel
from fgreg.model.session_model import BoardModel, CharucoModel, MarkerModel, NoiseModel, StageModel, TagModel
from fgreg.model.static_tags import StaticTag
from fgreg.model.systematic import Systematic
from fgreg.simulation.acoustics import Artefact, Elevation, Pulse
from fgreg.simulation.array import TrueArray
from fgreg.simulation.disturbances import Disturbances
from fgreg.simulation.render import Optics


class Sweep(StrEnum):
    """How the stage finds a PM.

    ``window``: uniform over the angles at which the PM is detected, direction unknown (``sweep`` 0). ``alternating``:
    steps from one limit up to the first detection, every other PM from the other limit. ``one_way``: always from the
    lower limit.
    ``two_sided``: each PM from both limits, ``looks_per_pm`` looks from either.
    """

    WINDOW = "window"
    ALTERNATING = "alternating"
    ONE_WAY = "one-way"
    TWO_SIDED = "two-sided"


def default_probe(channels: ChannelModel | None = None) -> ProbeModel:
    """128 elements at 0.43 mm on a radius of 10 mm, window +-6 deg at every depth, known to 0.3 deg."""
    sensitivity = SensitivityModel(
        as_float_array([20.0, 30.0, 45.0]), as_float_array(np.radians([6.0, 6.0, 6.0])), math.radians(0.3)
    )
    return ProbeModel(128, 0.43, False, 10.0, 1540.0, sensitivity, channels)


def default_stage() -> StageModel:
    """Steps of 2 deg between -60 and 60 deg."""
    return StageModel(math.radians(2.0), (math.radians(-60.0), math.radians(60.0)))


def default_rig(width_px: int = 1280) -> StereoRig:
    """A 16:9 stereo endoscope of 74 deg across with 5.2 mm between the lenses, which converge by 2.5 deg."""
    s = width_px / 1280.0
    height_px = round(width_px * 9 / 16)

    def camera(f: float, cx: float, cy: float, distortion: list[float]) -> CameraModel:
        matrix = [[f * s, 0.0, cx * s], [0.0, (f + 1.2) * s, cy * s], [0.0, 0.0, 1.0]]
        return CameraModel((width_px, height_px), as_float_array(matrix), as_float_array(distortion))

    turn = math.radians(2.5)
    c, n = math.cos(turn), math.sin(turn)
    right_T_left = [[c, 0.0, n, -5.19], [0.0, 1.0, 0.0, 0.06], [-n, 0.0, c, 0.11], [0.0, 0.0, 0.0, 1.0]]
    return StereoRig(
        camera(850.0, 645.3, 356.8, [-0.112, 0.064, 0.0006, -0.0004, 0.0]),
        camera(853.5, 631.9, 361.4, [-0.118, 0.071, -0.0003, 0.0005, 0.0]),
        as_float_array(right_T_left),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimulationConfig:
    """All parameters of a simulated session; angles rad, lengths mm. ``dataclasses.replace`` makes variants.

    Recorded:
        name: of the session.
        frames: raw frames of the cameras, and channel data of the probe (of a probe without channels: images)
            instead of poses and (x, range).
        aims, pairs: calibration shots and PMs of the registration, over all epochs.
        looks_per_pm: looks at each PM, at different stage angles with a detection; one ``pair`` event each.
        amplitudes: record the amplitude of each look, and the curve in the session.
        tracks_heard, tracks_silent: number of track events with a look at their PM, and without (``scan_deg`` only).
        track_looks: looks of a track event with a detection.
        sweep: how the stage finds PMs.
        epochs: camera epochs; the camera moves between them.
        camera_move_known: the move is recorded, with errors of the two sigmas (rotation, translation) and covariance.
        camera_moves_reported: each move is an event; where not, nothing recorded tells of it.
        initial_laser: record a rough ``initial.marker_T_laser`` (3 deg, 2 mm off per axis).
        camera_declared: poses, but of a session that has the camera, marker and board: what deviates in these acts on
            poses as it would on frames.
        spots: pairs have the pixels of the PM's visible spot in both views. spot_px: their error (sigma, each axis).
        points: points known to both devices as data, at the end of the session.
        checks: points known to both devices (``SimulatedSession.checks``). check_sigma_mm: per axis, of the camera's
            and of the TRUS side, of points as well.

    Errors that the session does not declare:
        outlier_pairs: number of outlier PMs: their looks are at another source, anywhere in the image.
        reversed_stage, reversed_elements: wired with the other sign than the session states.
        deviations: true less declared value of the rig's constants. Absent: none; but the window's edge and the
            marker's bias are drawn from their standard deviations.
        edge_jitter_rad: a soft edge: the half width varies by this (sigma) from PM to PM.
        beam_offset_mm: each PM lies beside the beam by this (sigma, each axis across it).
        water_mm, water_index: depth of water, with a level surface, above each PM (along TRUS z), and its index of
            refraction: the beam bends where it enters. (Images are drawn without water.)
        stage_slip_rad, stage_slip_at: the plane stays behind the reading by this angle, for good, after this share of
            the PMs.
        camera_move_mm: the camera moves by this in a random direction, without a turn; else turns and shifts are drawn.
        artefacts: what every record of the probe holds besides the source.
        declared_noise: the session's ``noise`` block; the true one (``noise``) where None.
        declared_camera: the session's camera; the true one (``camera``, but for ``deviations``) where None.
        declared: values that the session has instead of the true ones, by key: ``{"probe.radius_mm": 0.01}``.
        systematic: what the session says of its constants' standard deviations.
        disturbances: what spoils the images.
        static_tags: of the session; where they are is the room's (fgreg.simulation.room).

    Geometry:
        pm_x_mm, pm_angle_rad, pm_depth_mm: half extent along the axis and in stage angle, span of depths from the
            element face of the tissue surface.
        collinear: all PMs on one line, 0: along the probe's axis.
        lambda_mm, aim_lambda_mm: span of distances from the fibre's tip to the spot.
        beam_tilt_rad: beams spread by this to either side, about two axes (0: parallel beams).
        beam_roll_rad, aim_roll_rad: the marker is rolled about the beam by this to either side.
        laser_offset_mm, laser_tilt_rad: spans of the beam's distance from the marker's origin and of its angle to the
            marker's -z (the printed face looks back at the camera).
        marker_T_laser: fixes the calibration, else drawn.
        camera_distance_mm: span, to the middle of the tissue. camera_roll_rad: largest angle of the image's
            long side from the direction across the probe's axis. board_distance_mm: span of the boards' distances.
        marker_distance_mm, tag_tilt_rad: shots outside this span, or with the tag's face tilted more than this, or
            with the tag not completely in both images, are not taken.
    """

    name: str = "simulated"
    frames: bool = False
    aims: int = 12
    pairs: int = 10
    looks_per_pm: int = 1
    amplitudes: bool = False
    amplitude_noise: float = 0.05
    tracks_heard: int = 0
    tracks_silent: int = 0
    track_looks: int = 1
    sweep: Sweep = Sweep.ALTERNATING
    epochs: int = 1
    camera_move_known: bool = False
    camera_move_sigma: tuple[float, float] = (math.radians(0.3), 0.5)
    camera_moves_reported: bool = True
    initial_laser: bool = False
    camera_declared: bool = False
    spots: bool = False
    spot_px: float = 0.5
    points: int = 0
    checks: int = 0
    check_sigma_mm: tuple[float, float] = (0.35, 0.35)

    outlier_pairs: int = 0
    reversed_stage: bool = False
    reversed_elements: bool = False
    deviations: Mapping[Constant, float] = field(default_factory=dict)
    edge_jitter_rad: float = 0.0
    beam_offset_mm: float = 0.0
    water_mm: float = 0.0
    water_index: float = 1.33
    stage_slip_rad: float = 0.0
    stage_slip_at: float = 0.5
    camera_move_mm: float | None = None
    noise: NoiseModel = field(default_factory=NoiseModel)
    declared_noise: NoiseModel | None = None
    declared_camera: StereoRig | None = None
    declared: Mapping[str, Any] = field(default_factory=dict)
    systematic: Systematic = field(default_factory=Systematic)

    pm_x_mm: float = 20.0
    pm_angle_rad: float = math.radians(35.0)
    pm_depth_mm: tuple[float, float] = (22.0, 42.0)
    collinear: bool = False
    lambda_mm: tuple[float, float] = (20.0, 60.0)
    aim_lambda_mm: tuple[float, float] = (20.0, 60.0)
    beam_tilt_rad: float = math.radians(30.0)
    beam_roll_rad: float = math.radians(40.0)
    aim_roll_rad: float = math.radians(60.0)
    laser_offset_mm: tuple[float, float] = (5.0, 15.0)
    laser_tilt_rad: tuple[float, float] = (math.radians(10.0), math.radians(25.0))
    marker_T_laser: FloatArray | None = None
    camera_distance_mm: tuple[float, float] = (140.0, 170.0)
    camera_roll_rad: float = math.radians(25.0)
    board_distance_mm: tuple[float, float] = (110.0, 160.0)
    marker_distance_mm: tuple[float, float] = (75.0, 160.0)
    tag_tilt_rad: float = math.radians(50.0)

    probe: ProbeModel = field(default_factory=default_probe)
    stage: StageModel = field(default_factory=default_stage)
    camera: StereoRig = field(default_factory=default_rig)
    marker: MarkerModel = field(default_factory=lambda: MarkerModel("DICT_4X4_50", (TagModel(0, 25.0),)))
    board: BoardModel = field(default_factory=lambda: BoardModel(9, 6, 9.0, CharucoModel("DICT_5X5_100", 6.5)))
    static_tags: tuple[StaticTag, ...] = ()
    optics: Optics = field(default_factory=Optics)
    disturbances: Disturbances = field(default_factory=Disturbances)
    pulse: Pulse = field(default_factory=Pulse)
    elevation: Elevation = field(default_factory=Elevation)
    snr_db: float = 15.0
    samples: int = 1200
    artefacts: tuple[Artefact, ...] = ()
    targets_mm: FloatArray | None = None

    def __post_init__(self) -> None:
        if self.epochs < 1 or self.looks_per_pm < 1 or self.track_looks < 1:
            raise ValueError("epochs, looks_per_pm and track_looks have to be at least 1")
        if self.camera_move_mm is not None and self.epochs < 2:
            raise ValueError("camera_move_mm needs a session in which the camera moves: 2 epochs or more")
        if min(self.aims, self.pairs, self.tracks_heard, self.tracks_silent, self.points, self.checks) < 0:
            raise ValueError("aims, pairs, tracks, points and checks have to be 0 or more")
        if not (self.water_mm >= 0.0 and self.water_index >= 1.0):
            raise ValueError("water_mm has to be 0 or more, water_index at least 1")
        if not 0 <= self.outlier_pairs <= self.pairs:
            raise ValueError(f"outlier_pairs is {self.outlier_pairs}, expected 0 to {self.pairs}")
        if self.spots and not (self.has_camera and self.camera.right):
            raise ValueError("spots are pixels of two declared cameras: frames or camera_declared")
        if self.frames and self.probe.channels is None:
            if self.probe.image is None:
                raise ValueError("raw frames need probe.channels or probe.image")
            if self.deviations or self.artefacts or self.reversed_elements:
                raise ValueError("images have no deviations, artefacts or reversed elements, channel data have")

    @property
    def array(self) -> TrueArray:
        """The probe's array as it is."""
        return TrueArray.of(self.probe, self.deviations)

    @property
    def has_camera(self) -> bool:
        """Whether the session has the camera, the marker and the board."""
        return self.frames or self.camera_declared
