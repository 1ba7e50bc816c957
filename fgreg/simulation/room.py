"""A simulated operating room over time: the true poses at any moment, and the data of camera and probe.

A surgeon holds the fibre still at one place after another: first at corners of a calibration board, then at tissue.
Between places the marker moves smoothly; while it is held the hand trembles slightly. From time to time a bump moves
the camera. Ground truth only; times are seconds since the room was made and never decrease.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.geometry.transforms import FloatArray, exp_so3, inverse, log_so3, make_transform, transform_points
from fgreg.model.probe_model import ChannelModel
from fgreg.model.session_model import NoiseModel
from fgreg.model.static_tags import StaticTag
from fgreg.simulation import sweeps
from fgreg.simulation.config import SimulationConfig, default_probe, default_rig
from fgreg.simulation.pictures import LookPicture, ShotPicture
from fgreg.simulation.render import Optics, UInt8Image
from fgreg.simulation.scene import AimShots, Scene, UnseenError, draw_aim_shots, draw_pm_shots, draw_scene

TRAVEL_MM_S, TRAVEL_RAD_S, LEAST_TRAVEL_S = 40.0, math.radians(30.0), 0.8
"""Mean speed of the fibre from place to place."""
TREMOR_HZ = (0.7, 2.3, 5.1, 8.7)
TREMOR_MM, TREMOR_RAD = 0.03, 0.0006
"""Amplitude of each tremor component and axis."""
HOLDER_MM, HOLDER_RAD = 0.03, 0.0003
"""Noise of the camera pose that the holder reports, per axis."""
BUMP_EVERY_S = 240.0
"""Default mean time between bumps: long enough for several registrations."""
BUMP_S = 0.5
"""Duration of a camera move by a bump."""
SCENES = 6
"""Largest number of scenes drawn until one is found in which the camera sees the marker."""
BMODE_PIXEL_MM, BMODE_DEPTH_MM = 0.3, 60.0
STATIC_TAGS = ((1, -24.0, -52.0), (2, 24.0, -52.0), (3, 0.0, 56.0))
"""Id and TRUS x and y (mm) of the tags that may lie beside the tissue."""
STATIC_TAG_MM, STATIC_TAG_LEAN_RAD = 20.0, 0.2
REACH_MM = 140.0
"""Beams that meet no tissue within this distance end there."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RoomConfig:
    """Configuration of the room.

    Attributes:
        seed: of everything random.
        aims: calibration shots before the surgeon turns to the tissue.
        bump_every_s: mean time between camera moves once the surgeon is at the tissue; infinite for none.
        bump_rad, bump_mm: size (sigma per axis) of a move, about the middle of the tissue.
        tremor_hz: the four frequencies of the hand's tremor.
        scene: cameras, probe, stage and noise; with ``frames`` and amplitudes.
    """

    seed: int = 1
    aims: int = 10
    bump_every_s: float = BUMP_EVERY_S
    bump_rad: float = math.radians(2.0)
    bump_mm: float = 2.5
    tremor_hz: tuple[float, float, float, float] = TREMOR_HZ
    scene: SimulationConfig

    def __post_init__(self) -> None:
        if self.aims < 0:
            raise ValueError(f"aims is {self.aims}, expected 0 or more")
        if not self.bump_every_s > 0:
            raise ValueError(f"bump_every_s is {self.bump_every_s}, expected a number > 0, or infinity")
        if self.scene.probe.channels is None:
            raise ValueError("the room's probe has to record channel data")


def room_config(
    seed: int = 1,
    width_px: int = 640,
    *,
    aims: int = 10,
    bump_every_s: float = BUMP_EVERY_S,
    static_tags: int = 0,
) -> RoomConfig:
    """A room with a stereo camera of this width, a probe that records channel data, and up to three static tags."""
    scene = SimulationConfig(
        name="room",
        frames=True,
        amplitudes=True,
        probe=default_probe(ChannelModel(sampling_mhz=40.0, t0_us=13.0, pulse_delay_us=0.4)),
        camera=default_rig(width_px),
        noise=NoiseModel(aim_mm=(0.3, 0.3, 0.1)),
        samples=1160,
        snr_db=18.0,
        optics=Optics(samples=16),
        static_tags=tuple(StaticTag(number, STATIC_TAG_MM) for number, _, _ in STATIC_TAGS[:static_tags]),
    )
    return RoomConfig(seed=seed, aims=aims, bump_every_s=bump_every_s, scene=scene)


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Pose at which the fibre is held: ``trus_T_marker`` (4, 4); for aims also corner [column, row] and board pose."""

    trus_T_marker: FloatArray
    corner: tuple[int, int] | None = None
    trus_T_board: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Travel:
    """Motion from one pose to another between two times, at rest at both ends."""

    start_s: float
    end_s: float
    start: FloatArray
    end: FloatArray

    def at(self, t_s: float) -> FloatArray:
        share = min(max((t_s - self.start_s) / max(self.end_s - self.start_s, 1e-9), 0.0), 1.0)
        smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)  # least jerk
        turn = log_so3(self.start[:3, :3].T @ self.end[:3, :3])
        return make_transform(
            self.start[:3, :3] @ exp_so3(smooth * turn),
            (1.0 - smooth) * self.start[:3, 3] + smooth * self.end[:3, 3],
        )


def travel_s(start: FloatArray, end: FloatArray) -> float:
    """Time (s) that the fibre takes from one pose (4, 4) to another."""
    way = float(np.linalg.norm(end[:3, 3] - start[:3, 3]))
    turn = float(np.linalg.norm(log_so3(start[:3, :3].T @ end[:3, :3])))
    return max(LEAST_TRAVEL_S, way / TRAVEL_MM_S, turn / TRAVEL_RAD_S)


def _at(travels: list[Travel], t_s: float) -> FloatArray:
    """Pose of a body that moves along successive ways."""
    return next(travel for travel in reversed(travels) if travel.start_s <= max(t_s, 0.0)).at(t_s)


class Room:
    """The room. What has happened up to a time does not depend on what is asked afterwards.

    Attributes:
        config: what goes on.
        moved_s: when the camera began to move, each time.
    """

    def __init__(self, config: RoomConfig) -> None:
        self.config = config
        streams = [np.random.default_rng(s) for s in np.random.SeedSequence(config.seed).spawn(6)]
        self._scene_rng, self._aim_rng, self._shot_rng, self._bump_rng, tremor, self._miss_rng = streams
        self._aims = self._begin()
        trus_T_camera = self.scene.trus_T_camera[0]
        holder = np.random.default_rng((self.config.seed, 3))
        self._base_T_trus = make_transform(exp_so3(holder.normal(0.0, 1.0, 3)), holder.normal(0.0, 300.0, 3))
        self._phase = tremor.uniform(0.0, 2.0 * math.pi, (6, len(TREMOR_HZ)))
        self._cameras: list[Travel] = [Travel(0.0, 0.0, trus_T_camera, trus_T_camera)]
        self.moved_s: list[float] = []
        self._bump_due_s = math.inf
        self._places = 0
        self._place = self._next_place()
        start = self._place.trus_T_marker
        self._travels: list[Travel] = [Travel(0.0, 0.0, start, start)]

    def _begin(self) -> list[Place]:
        """A scene in which aims and spots can be seen, and the aims."""
        config = replace(self.config.scene, aims=self.config.aims)
        for attempt in range(SCENES):
            self.scene: Scene = draw_scene(config, self._scene_rng)
            miss = self._miss_rng.standard_normal((config.aims, 3))
            try:
                aims = draw_aim_shots(config, self.scene, self._aim_rng, miss)
                self._spot(self.scene.trus_T_camera[0])
            except UnseenError:
                if attempt == SCENES - 1:
                    raise
            else:
                break
        return self._places_of(aims)

    def _places_of(self, aims: AimShots) -> list[Place]:
        trus_T_camera = self.scene.trus_T_camera[0]
        return [
            Place(trus_T_camera @ pose, (int(corner[0]), int(corner[1])), trus_T_camera @ board)
            for pose, corner, board in zip(aims.shots.camera_T_marker, aims.corner, aims.camera_T_board, strict=True)
        ]

    # --- events -----------------------------------------------------------------------------------------------------

    @property
    def place(self) -> Place:
        """The place where the fibre is held, or to which it moves."""
        return self._place

    @property
    def marker_T_laser(self) -> FloatArray:
        """(4, 4) the true calibration."""
        return self.scene.marker_T_laser

    def arrives_s(self) -> float:
        """Time at which the fibre comes (came) to rest at its place."""
        return self._travels[-1].end_s

    def proceed(self, t_s: float) -> Place:
        """The surgeon goes on to the next place, from wherever the fibre is at ``t_s``."""
        self._go(self._next_place(), t_s)
        if self._place.corner is None and not math.isfinite(self._bump_due_s):
            self._bump_due_s = self._next_bump(t_s)
        return self._place

    def go_elsewhere(self, t_s: float) -> Place:
        """The surgeon aims in another way, since marker or board are not found in the pictures of this place."""
        rng = np.random.default_rng((self.config.seed, 4, len(self._travels)))
        config = replace(self.config.scene, aims=1)
        with suppress(UnseenError):
            (place,) = self._places_of(draw_aim_shots(config, self.scene, rng, rng.standard_normal((1, 3))))
            self._go(place, t_s)
        return self._place

    def _go(self, place: Place, t_s: float) -> None:
        start, end = self._travels[-1].at(t_s), place.trus_T_marker
        self._place = place
        self._travels.append(Travel(t_s, t_s + travel_s(start, end), start, end))

    def pass_to(self, t_s: float) -> None:
        """Advance the time and start the bumps that are due."""
        if t_s >= self._bump_due_s:
            self.bump(self._bump_due_s)
            self._bump_due_s = self._next_bump(t_s)

    def bump(self, t_s: float) -> None:
        """Start a move of the camera at ``t_s``."""
        before = self.trus_T_camera(t_s)
        self._cameras.append(Travel(t_s, t_s + BUMP_S, before, self._bumped(before)))
        self.moved_s.append(t_s)

    def _bumped(self, trus_T_camera: FloatArray) -> FloatArray:
        """The camera's pose after a bump."""
        rng, config = self._bump_rng, self.config
        middle = self.scene.tissue.point(np.zeros(()), np.zeros(()))
        turn = exp_so3(rng.normal(0.0, config.bump_rad, 3))
        move = make_transform(turn, middle - turn @ middle + rng.normal(0.0, config.bump_mm, 3))
        return np.asarray(move @ trus_T_camera)

    def _next_bump(self, t_s: float) -> float:
        mean = self.config.bump_every_s
        return math.inf if math.isinf(mean) else t_s + mean * float(self._bump_rng.uniform(0.5, 1.5))

    def _next_place(self) -> Place:
        number, self._places = self._places, self._places + 1
        return self._aims[number] if number < len(self._aims) else self._spot(self._cameras[-1].end)

    def _spot(self, trus_T_camera: FloatArray) -> Place:
        """A shot at tissue that is visible from a camera at this pose."""
        scene = replace(self.scene, trus_T_camera=(trus_T_camera,))
        shots = draw_pm_shots(self.config.scene, scene, np.zeros(1, dtype=np.int64), self._shot_rng)
        return Place(trus_T_camera @ shots.camera_T_marker[0])

    # --- poses ------------------------------------------------------------------------------------------------------

    def trus_T_camera(self, t_s: float) -> FloatArray:
        """(4, 4) the true registration."""
        return _at(self._cameras, t_s)

    def trus_T_tags(self, t_s: float) -> dict[int, FloatArray]:  # noqa: ARG002
        """(4, 4) the static tags by id: beside the tissue, leaning towards its middle."""
        depth_mm = self.config.scene.probe.radius_mm + 0.5 * sum(self.config.scene.pm_depth_mm)
        poses = {}
        for number, x, y in STATIC_TAGS:
            lean = STATIC_TAG_LEAN_RAD / math.hypot(x, y) * np.array([y, -x, 0.0])
            turned = exp_so3(lean) @ exp_so3(np.array([0.0, 0.0, float(number)]))
            poses[number] = make_transform(turned, np.array([x, y, depth_mm]))
        return {tag.id: poses[tag.id] for tag in self.config.scene.static_tags}

    def trus_T_marker(self, t_s: float) -> FloatArray:
        """(4, 4) the marker, with the hand's tremor."""
        wave = np.sin(2.0 * math.pi * np.array(self.config.tremor_hz) * t_s + self._phase).sum(axis=1)
        still = _at(self._travels, t_s)
        return make_transform(still[:3, :3] @ exp_so3(TREMOR_RAD * wave[:3]), still[:3, 3] + TREMOR_MM * wave[3:])

    def camera_T_marker(self, t_s: float) -> FloatArray:
        """(4, 4) the marker in the camera frame."""
        return np.asarray(inverse(self.trus_T_camera(t_s)) @ self.trus_T_marker(t_s))

    def base_T_camera(self, t_s: float, index: int) -> FloatArray:
        """(4, 4) the camera pose that its holder reports, in its base frame; ``index`` seeds the noise."""
        rng = np.random.default_rng((self.config.seed, index, 3))
        true = self._base_T_trus @ self.trus_T_camera(t_s)
        noise = make_transform(exp_so3(HOLDER_RAD * rng.standard_normal(3)), HOLDER_MM * rng.standard_normal(3))
        return np.asarray(true @ noise)

    def spot_mm(self, t_s: float) -> FloatArray:
        """(3,) TRUS point where the beam ends: on the tissue, or in the air if it misses the tissue."""
        trus_T_laser = self.trus_T_marker(t_s) @ self.marker_T_laser
        low, high = 0.0, REACH_MM
        for _ in range(4):
            lam = np.linspace(low, high, 65)
            above = self._above_tissue(trus_T_laser[:3, 3] + lam[:, None] * trus_T_laser[:3, 2])
            inside = np.flatnonzero(above[1:] <= 0.0)
            if above[0] <= 0.0 or not inside.size:
                break
            low, high = float(lam[inside[0]]), float(lam[inside[0] + 1])
        return np.asarray(trus_T_laser[:3, 3] + 0.5 * (low + high) * trus_T_laser[:3, 2])

    def _above_tissue(self, trus_p_mm: FloatArray) -> FloatArray:
        """Distance (n,) of points (n, 3) outside the tissue's surface, away from the probe."""
        angle = np.arctan2(trus_p_mm[:, 1], trus_p_mm[:, 2])
        surface = self.scene.tissue.point(trus_p_mm[:, 0], angle)
        return np.asarray(np.hypot(trus_p_mm[:, 1], trus_p_mm[:, 2]) - np.hypot(surface[:, 1], surface[:, 2]))

    def plane_rad(self, t_s: float) -> float:
        """Plane angle at which the beam's end lies in the plane."""
        return float(self.config.scene.array.plane_angle_rad(self.spot_mm(t_s)))

    def truth_at(self, camera_s: Sequence[float], spots_s: Sequence[float]) -> dict[str, Any]:
        """Ground truth (plain numbers), to evaluate an estimate, never to make one.

        Args:
            camera_s, spots_s: times of the returned ``trus_T_camera`` (4x4 each) and ``spots_mm`` (3 each). The result
                also has ``marker_T_laser`` (4x4), ``moved_s`` (when the camera began to move), ``stood`` (4x4 each: its
                poses at the start and after each move) and ``seed``.
        """
        return {
            "trus_T_camera": [self.trus_T_camera(t).tolist() for t in camera_s],
            "spots_mm": [self.spot_mm(t).tolist() for t in spots_s],
            "marker_T_laser": self.marker_T_laser.tolist(),
            "moved_s": [*self.moved_s],
            "stood": [travel.end.tolist() for travel in self._cameras],
            "seed": self.config.seed,
        }

    # --- measurements -----------------------------------------------------------------------------------------------

    def pictures(self, t_s: float, index: int) -> tuple[UInt8Image, UInt8Image]:
        """Left and right image (h, w) at a time; ``index`` seeds the sensor's noise."""
        camera_T_trus = inverse(self.trus_T_camera(t_s))
        camera_T_marker = self.camera_T_marker(t_s)
        board = self._place.trus_T_board
        spot = transform_points(camera_T_trus, self.spot_mm(t_s)[None])[0]
        seed = self.config.seed
        picture = ShotPicture(
            camera_T_marker,
            camera_T_marker @ self.marker_T_laser,
            spot,
            seed,
            (seed, index),
            None if board is None else camera_T_trus @ board,
            camera_T_trus if board is None else None,
            {number: np.asarray(camera_T_trus @ pose) for number, pose in self.trus_T_tags(t_s).items()},
        )
        return picture.render(self.config.scene, right=False), picture.render(self.config.scene, right=True)

    def channel_data(self, t_s: float, scan_rad: float, index: int) -> npt.NDArray[np.int16]:
        """(elements, samples) the probe's data of a pulse at ``t_s`` with its plane at ``scan_rad``."""
        config, source = self.config.scene, self.spot_mm(t_s)
        depth = config.array.distance_mm(source, np.asarray(scan_rad))
        width = float(sweeps.half_width_rad(config.probe.sensitivity, depth)) + self.scene.window_edge_rad
        return LookPicture(source, scan_rad, width, (self.config.seed, index, 2)).channel_data(config)

    def bmode(self, scan_rad: float, index: int) -> tuple[UInt8Image, tuple[float, float], tuple[float, float]]:
        """What the scanner shows with its plane at ``scan_rad``: speckle up to the tissue's surface, nothing beyond.

        Returns:
            The picture (depth, lateral), its pixels' size along depth and laterally, and depth and TRUS x of the centre
            of its first pixel, mm. ``index`` seeds what flickers.
        """
        probe = self.config.scene.probe
        x = np.arange(probe.element_x_mm.min(), probe.element_x_mm.max(), BMODE_PIXEL_MM)
        depth = np.arange(0.0, BMODE_DEPTH_MM, BMODE_PIXEL_MM)
        surface = self.scene.tissue.point(x, np.full_like(x, scan_rad))
        below = np.hypot(surface[:, 1], surface[:, 2]) - probe.radius_mm - depth[:, None]
        still = np.random.default_rng((self.config.seed, round(math.degrees(scan_rad)) % 360))
        speckle = np.hypot(*still.standard_normal((2, *below.shape))) + 0.1 * np.random.default_rng(
            (self.config.seed, index, 3)
        ).standard_normal(below.shape)
        grey = 40.0 * np.abs(speckle) * (below > 0.0) + 160.0 * np.exp(-np.square(below / 0.6))
        return np.clip(grey, 0.0, 255.0).astype(np.uint8), (BMODE_PIXEL_MM,) * 2, (0.0, float(x[0]))
