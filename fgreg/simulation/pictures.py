"""Frames of a simulated session: what the cameras and the probe record of each shot, made when asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from fgreg.geometry.transforms import FloatArray, exp_so3, inverse, make_transform, transform_points
from fgreg.model.camera_model import CameraModel
from fgreg.simulation.acoustics import (
    Hearing,
    log_compressed,
    quantised,
    simulate_channels,
    simulate_envelope_image,
)
from fgreg.simulation.config import SimulationConfig
from fgreg.simulation.disturbances import Disturbances, SpoiltView
from fgreg.simulation.highlights import Wetness
from fgreg.simulation.lens import project_points
from fgreg.simulation.misreading import true_board, true_marker, true_rig, view_shift_mm
from fgreg.simulation.render import Exposure, UInt8Image, render_frame
from fgreg.simulation.surfaces import Background, BoardSurface, PatchSurface, Surface, TagSurface

ProbeFrame = npt.NDArray[np.int16] | npt.NDArray[np.uint8] | npt.NDArray[np.float32]

DRAPE_MM = 45.0
"""Distance of the drape behind the calibration board."""
MOMENTS = 5
"""Number of places of a moving hand in one exposure."""
LEVER_MM = 100.0
"""The hand turns about points at this distance."""


@dataclass(frozen=True, slots=True, eq=False)
class ShotPicture:
    """What there is to see in one shot, in the left camera's frame.

    Attributes:
        camera_T_marker: the marker. camera_T_laser: the fibre that it holds.
        camera_T_board: the calibration board, in calibration shots.
        camera_T_trus: in shots at tissue.
        camera_p_spot_mm: where the beam ends; it glows on tissue.
        scene_seed: of what is the same in all shots of a session.
        noise_seed: of this shot's sensor noise.
        camera_T_tags: the static tags by id, where they are in the scene.
    """

    camera_T_marker: FloatArray
    camera_T_laser: FloatArray
    camera_p_spot_mm: FloatArray
    scene_seed: int
    noise_seed: tuple[int, ...]
    camera_T_board: FloatArray | None = None
    camera_T_trus: FloatArray | None = None
    camera_T_tags: Mapping[int, FloatArray] = field(default_factory=dict)

    def render(self, config: SimulationConfig, right: bool) -> UInt8Image:
        """The image of the left or the right camera, (h, w) or (h, w, 3) 8-bit; deinterlaced, of half the height.

        Raises:
            ValueError: there is no right camera.
        """
        rig = true_rig(config)
        camera, camera_T_left = rig.left, np.eye(4)
        if right:
            if rig.right is None or rig.right_T_left is None:
                raise ValueError("the rig has no right camera")
            camera, camera_T_left = rig.right, rig.right_T_left
        return self._render(config, camera, camera_T_left, int(right))

    def _render(
        self, config: SimulationConfig, camera: CameraModel, camera_T_left: FloatArray, stream: int
    ) -> UInt8Image:
        what = config.disturbances.of_shot(self.noise_seed)
        camera_T_marker = self.camera_T_marker.copy()
        camera_T_marker[:3, 3] += view_shift_mm(config, camera_T_marker)
        held: list[Surface] = [
            TagSurface(config.marker.dictionary, tag.id, tag.size_mm, camera_T_marker @ tag.marker_T_tag)
            for tag in true_marker(config).tags
        ]
        # The bare fibre about the laser frame's origin. It is behind the marker's printed face: never over it.
        fibre = transform_points(self.camera_T_laser, np.array([[0.0, 0.0, -4.0], [0.0, 0.0, 8.0]]))
        held.append(_strip(fibre[0], fibre[1], 0.9, 0.7, depth_bias_mm=25.0))
        surfaces: list[Surface] = []
        if self.camera_T_board is not None:
            surfaces.append(BoardSurface(true_board(config), self.camera_T_board))
            away = make_transform(np.eye(3), np.array([0.0, 0.0, DRAPE_MM]))
            background = Background(self.camera_T_board @ away, 0.1, 0.3, self.scene_seed)
        else:
            assert self.camera_T_trus is not None
            background, surfaces = _tissue(config, self.camera_T_trus, self.scene_seed)
            half = np.array([0.5, 0.0, 0.0])
            surfaces.append(_strip(self.camera_p_spot_mm - half, self.camera_p_spot_mm + half, 1.0, 1.1))
        surfaces += [
            TagSurface(config.marker.dictionary, tag.id, tag.size_mm, self.camera_T_tags[tag.id])
            for tag in config.static_tags
            if tag.id in self.camera_T_tags
        ]
        wet = None
        if what.specular > 0.0:
            wet = Wetness(what.specular, transform_points(camera_T_left, _light_at_tip(config)), self.scene_seed)
        return render_frame(
            camera,
            [surface.seen_from(camera_T_left) for surface in surfaces],
            np.random.default_rng((*self.noise_seed, stream)),
            config.optics,
            background.seen_from(camera_T_left),
            held=[surface.seen_from(camera_T_left) for surface in held],
            exposures=[
                self._exposure(config, what, camera, camera_T_left, stream, after_s, lines)
                for after_s, lines in _fields(what)
            ],
            disturbances=what,
            wet=wet,
        )

    def _exposure(
        self,
        config: SimulationConfig,
        what: Disturbances,
        camera: CameraModel,
        camera_T_left: FloatArray,
        stream: int,
        after_s: float,
        lines: slice,
    ) -> Exposure:
        """The exposure of ``lines`` whose middle is ``after_s`` after the time at which the marker is where it is."""
        if what == Disturbances():
            return Exposure()
        moves: tuple[FloatArray, ...] = ()
        if what.hand_mm_s > 0.0:
            half_s = 0.5e-3 * what.shutter_ms
            times = after_s + half_s * (2.0 * (np.arange(MOMENTS) + 0.5) / MOMENTS - 1.0)
            moves = tuple(self._moved(what.hand_mm_s, time) for time in times)
        tag, optics = config.marker.tags[0], config.optics
        middle = self._moved(what.hand_mm_s, after_s) @ self.camera_T_marker
        camera_p = transform_points(camera_T_left @ middle, tag.marker_p_corners_mm)
        corners = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]], dtype=np.float32)
        image_from_tag = cv2.getPerspectiveTransform(corners, project_points(camera, camera_p).astype(np.float32))
        distance = float(np.linalg.norm(camera_p.mean(axis=0)))
        white = optics.white_level * (optics.reference_mm / distance) ** optics.distance_exponent
        spoilt = SpoiltView(what, np.asarray(image_from_tag), stream == 1, self.noise_seed, white, distance)
        return Exposure(tuple(camera_T_left @ move @ inverse(camera_T_left) for move in moves), spoilt, lines)

    def _moved(self, speed_mm_s: float, after_s: float) -> FloatArray:
        """(4, 4) motion of what the hand holds, left camera frame, up to ``after_s``."""
        rng = np.random.default_rng((*self.noise_seed, 74))
        along, about = (axis / np.linalg.norm(axis) for axis in rng.standard_normal((2, 3)))
        rotation = exp_so3(after_s * speed_mm_s / LEVER_MM * about)
        centre = self.camera_T_marker[:3, 3]
        return make_transform(rotation, centre + after_s * speed_mm_s * along - rotation @ centre)


def _fields(what: Disturbances) -> list[tuple[float, slice]]:
    """Of each field its time, from that of the marker's pose, and its lines."""
    if not what.field_hz:
        return [(0.0, slice(None))]
    if what.deinterlace:
        return [(0.0, slice(0, None, 2))]
    half_s = 0.5 / what.field_hz
    return [(-half_s, slice(0, None, 2)), (half_s, slice(1, None, 2))]


def _light_at_tip(config: SimulationConfig) -> FloatArray:
    """(3,) the scope's light, left camera frame: midway between the lenses."""
    right_T_left = config.camera.right_T_left
    return np.zeros(3) if right_T_left is None else np.asarray(0.5 * inverse(right_T_left)[:3, 3])


def _tissue(config: SimulationConfig, camera_T_trus: FloatArray, seed: int) -> tuple[Background, list[Surface]]:
    """The tissue as a plane at its middle depth, with an instrument and dark patches lying on it."""
    height = config.probe.radius_mm + 0.5 * sum(config.pm_depth_mm)
    # Beneath the spots, so that nothing on it is nearer than they are.
    trus_T_plane = make_transform(np.eye(3), np.array([0.0, 0.0, height - 0.5 * np.ptp(config.pm_depth_mm)]))
    camera_T_plane = camera_T_trus @ trus_T_plane
    rng = np.random.default_rng((seed, 7))
    clutter: list[Surface] = []
    for albedo, width, length in ((0.5, 6.0, 90.0), (0.05, 5.0, 60.0), (0.04, 9.0, 9.0), (0.6, 4.0, 7.0)):
        turn = rng.uniform(-np.pi, np.pi)
        c, s = np.cos(turn), np.sin(turn)
        at = np.array([*rng.uniform(20.0, 55.0, 2) * rng.choice([-1.0, 1.0], 2), 0.5])
        plane_T_patch = make_transform(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), at)
        clutter.append(PatchSurface(camera_T_plane @ plane_T_patch, width, length, albedo))
    return Background(camera_T_plane, 0.2, 0.4, seed, blood_mm=0.03, slope=0.3), clutter


def _strip(
    camera_p0_mm: FloatArray, camera_p1_mm: FloatArray, width_mm: float, albedo: float, depth_bias_mm: float = 0.0
) -> PatchSurface:
    """A strip from one point to another that shows its full width to the camera."""
    along = camera_p1_mm - camera_p0_mm
    length = float(np.linalg.norm(along))
    y = along / length
    middle = 0.5 * (camera_p0_mm + camera_p1_mm)
    x = np.cross(y, middle)
    x /= np.linalg.norm(x)
    return PatchSurface(
        make_transform(np.stack([x, y, np.cross(x, y)], axis=-1), middle), width_mm, length, albedo, depth_bias_mm
    )


@dataclass(frozen=True, slots=True, eq=False)
class LookPicture:
    """What the probe records of one look."""

    trus_p_source_mm: FloatArray
    scan_rad: float
    half_width_rad: float
    noise_seed: tuple[int, ...]

    def record(self, config: SimulationConfig) -> ProbeFrame:
        """Channel data; of a probe without channels, an image."""
        return self.image(config) if config.probe.channels is None else self.channel_data(config)

    def channel_data(self, config: SimulationConfig) -> npt.NDArray[np.int16]:
        """(elements, samples)."""
        channels = simulate_channels(
            config.probe,
            self.trus_p_source_mm,
            self.scan_rad,
            np.random.default_rng(self.noise_seed),
            pulse=config.pulse,
            snr_db=config.snr_db,
            samples=config.samples,
            sound_speed_true_m_s=config.array.sound_speed_ratio * config.probe.sound_speed_m_s,
            hearing=Hearing(elevation=config.elevation),
            half_width_rad=self.half_width_rad,
            array=config.array,
            artefacts=config.artefacts,
        )
        return quantised(channels[::-1] if config.reversed_elements else channels)

    def image(self, config: SimulationConfig) -> npt.NDArray[np.uint8] | npt.NDArray[np.float32]:
        """(depth, lateral) pixels of the envelope, log-compressed where the probe's images are."""
        image = simulate_envelope_image(
            config.probe,
            self.trus_p_source_mm,
            self.scan_rad,
            np.random.default_rng(self.noise_seed),
            pulse=config.pulse,
            snr_db=config.snr_db,
            hearing=Hearing(elevation=config.elevation),
            half_width_rad=self.half_width_rad,
        )
        log_db = None if config.probe.image is None else config.probe.image.log_db
        return image if log_db is None else log_compressed(image, log_db)
