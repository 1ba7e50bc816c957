"""Frames of a simulated session: what the cameras and the probe record of each shot, made when asked for."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from fgreg.geometry.transforms import FloatArray, make_transform, transform_points
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
from fgreg.simulation.lens import project_points
from fgreg.simulation.misreading import true_board, true_marker, true_rig, view_shift_mm
from fgreg.simulation.render import UInt8Image, render_frame
from fgreg.simulation.surfaces import Background, BoardSurface, PatchSurface, Surface, TagSurface

ProbeFrame = npt.NDArray[np.int16] | npt.NDArray[np.uint8] | npt.NDArray[np.float32]

DRAPE_MM = 45.0
"""Distance of the drape behind the calibration board."""


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
    """

    camera_T_marker: FloatArray
    camera_T_laser: FloatArray
    camera_p_spot_mm: FloatArray
    scene_seed: int
    noise_seed: tuple[int, ...]
    camera_T_board: FloatArray | None = None
    camera_T_trus: FloatArray | None = None

    def render(self, config: SimulationConfig, right: bool) -> UInt8Image:
        """The image of the left or the right camera, (h, w) 8-bit.

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
        camera_T_marker = self.camera_T_marker.copy()
        camera_T_marker[:3, 3] += view_shift_mm(config, camera_T_marker)
        surfaces: list[Surface] = [
            TagSurface(config.marker.dictionary, tag.id, tag.size_mm, camera_T_marker @ tag.marker_T_tag)
            for tag in true_marker(config).tags
        ]
        # The bare fibre about the laser frame's origin. It is behind the marker's printed face: never over it.
        fibre = transform_points(self.camera_T_laser, np.array([[0.0, 0.0, -4.0], [0.0, 0.0, 8.0]]))
        surfaces.append(_strip(fibre[0], fibre[1], 0.9, 0.7, depth_bias_mm=25.0))
        if self.camera_T_board is not None:
            surfaces.append(BoardSurface(true_board(config), self.camera_T_board))
            away = make_transform(np.eye(3), np.array([0.0, 0.0, DRAPE_MM]))
            background = Background(self.camera_T_board @ away, 0.1, 0.3, self.scene_seed)
        else:
            assert self.camera_T_trus is not None
            background, clutter = _tissue(config, self.camera_T_trus, self.scene_seed)
            surfaces += clutter
            half = np.array([0.5, 0.0, 0.0])
            surfaces.append(_strip(self.camera_p_spot_mm - half, self.camera_p_spot_mm + half, 1.0, 1.1))
        return render_frame(
            camera,
            [surface.seen_from(camera_T_left) for surface in surfaces],
            np.random.default_rng((*self.noise_seed, stream)),
            config.optics,
            background.seen_from(camera_T_left),
            self._spoilt(config, camera, camera_T_left, stream),
        )

    def _spoilt(
        self, config: SimulationConfig, camera: CameraModel, camera_T_left: FloatArray, stream: int
    ) -> SpoiltView | None:
        if config.disturbances == Disturbances():
            return None
        tag, optics = config.marker.tags[0], config.optics
        camera_p = transform_points(camera_T_left @ self.camera_T_marker, tag.marker_p_corners_mm)
        corners = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]], dtype=np.float32)
        image_from_tag = cv2.getPerspectiveTransform(corners, project_points(camera, camera_p).astype(np.float32))
        nearness = optics.reference_mm / float(np.linalg.norm(camera_p.mean(axis=0)))
        white = optics.white_level * nearness**optics.distance_exponent
        return SpoiltView(config.disturbances, np.asarray(image_from_tag), stream == 1, self.noise_seed, white)


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
    return Background(camera_T_plane, 0.2, 0.4, seed), clutter


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
