"""Results of detection in a frame: the pose of marker or board, a photoacoustic point, or a reason.

Separate from the detectors, so that code that reads results does not load OpenCV.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from fgreg.detection.corner_noise import CornerNoise, fit_covariance
from fgreg.geometry.transforms import FloatArray, hat
from fgreg.model.camera_dependence import corner_dependence
from fgreg.model.measurements import CameraDependence, Wavefront
from fgreg.model.session_model import BoardModel

LEAST_RANGE_MM = 3.0
"""Sound from nearer than this is made at the probe's face, by light that falls on it."""


@dataclass(frozen=True, slots=True)
class NotFound:
    """No usable detection; the reason as part of a sentence."""

    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class RigidFit:
    """A rigid body found in one or two views.

    Attributes:
        camera_T_body: (4, 4).
        information: (6, 6) over the right tangent (rotation rad, translation mm), at corner noise scale 1.
        common_covariance: (6, 6) of the errors that residuals cannot show (method bias, errors common to both views).
        cost: whitened sum of squared residuals, chi-square of ``dof`` at scale 1.
        dof: residuals less 6.
        corners: number of corners over all views.
        views: names of the views used.
        rms_px: root mean square distance of predicted from observed corners, undistorted pixels.
        second_ratio: RMS of the second planar hypothesis over that of this one; infinite where there is no second.
        clearance: by how much the second hypothesis fits worse, over what makes it ambiguous; infinite where there is
            no second, None where it was not looked for, because an earlier frame had it out of the question.
        left_out: tags or corners that were seen but not used, with the reason.
        tell_dependence: computes :attr:`dependence`, which only poses of events need.
    """

    camera_T_body: FloatArray
    information: FloatArray
    common_covariance: FloatArray
    cost: float
    dof: int
    corners: int
    views: tuple[str, ...]
    rms_px: float
    second_ratio: float
    clearance: float | None
    left_out: tuple[str, ...]
    tell_dependence: Callable[[], CameraDependence]

    @property
    def dependence(self) -> CameraDependence:
        """Of the pose on the rig's constants."""
        return self.tell_dependence()


@dataclass(frozen=True, slots=True, eq=False)
class MarkerFit:
    """A detected marker: the fit of its pose, and the ids of the tags used."""

    pose: RigidFit
    tags: tuple[int, ...]

    @property
    def camera_T_marker(self) -> FloatArray:
        """(4, 4)."""
        return self.pose.camera_T_body


def marker_covariance(fit: MarkerFit, noise: CornerNoise) -> FloatArray:
    """(6, 6) covariance over the right tangent (rotation rad, translation mm) at the session's corner noise."""
    return fit_covariance(fit.pose, noise)


@dataclass(frozen=True, slots=True, eq=False)
class BoardFit:
    """A detected board: the fit of its pose, and the board's model."""

    pose: RigidFit
    board: BoardModel

    @property
    def camera_T_board(self) -> FloatArray:
        """(4, 4)."""
        return self.pose.camera_T_body


def board_covariance(fit: BoardFit, noise: CornerNoise) -> FloatArray:
    """(6, 6) covariance of ``camera_T_board`` over the right tangent (rotation rad, translation mm)."""
    return fit_covariance(fit.pose, noise)


def board_corner(fit: BoardFit, column: int, row: int, noise: CornerNoise) -> tuple[FloatArray, FloatArray]:
    """Position of a board corner: (camera_p_mm (3,), covariance (3, 3) mm^2, camera frame).

    It is computed from the pose of the whole board, so it need not be in view; it assumes a flat board.

    Raises:
        ValueError: the board has no such corner.
    """
    board = fit.board
    if not (0 <= column < board.columns and 0 <= row < board.rows):
        raise ValueError(f"corner [{column}, {row}], expected [0..{board.columns - 1}, 0..{board.rows - 1}]")
    board_p = np.array([column, row, 0.0]) * board.square_mm
    rotation = fit.camera_T_board[:3, :3]
    jacobian = rotation @ np.hstack([-hat(board_p), np.eye(3)])
    covariance = jacobian @ board_covariance(fit, noise) @ jacobian.T
    return rotation @ board_p + fit.camera_T_board[:3, 3], covariance


def board_corner_dependence(fit: BoardFit, column: int, row: int) -> CameraDependence:
    """How the position of a board corner (:func:`board_corner`) depends on the rig's constants."""
    board_p = np.array([column, row, 0.0]) * fit.board.square_mm
    return corner_dependence(fit.camera_T_board, board_p, fit.pose.dependence)


@dataclass(frozen=True, slots=True, eq=False)
class OtherWave:
    """A later wave in the frame of a find: x and range, covariance (2, 2) mm^2 and statistic as of :class:`PaFind`."""

    x_mm: float
    range_mm: float
    covariance: FloatArray
    statistic: float


@dataclass(frozen=True, slots=True, eq=False)
class PaFind:
    """One photoacoustic source found in one frame.

    Attributes:
        x_mm: TRUS x of the source.
        range_mm: distance from the element row along the image plane at the *assumed* sound speed: assumed speed
            times the arrival time at the apex of the wavefront. The true range is this times the true ratio of sound
            speeds (``sound_speed_ratio`` where it is known well enough).
        covariance: (2, 2) over (x_mm, range_mm), mm^2.
        amplitude: peak of the wave's envelope at the strongest elements (channel data) or in the image, in the
            frame's units; comparable only for the same source.
        snr_db: amplitude / sqrt(2) over the standard deviation of the noise, per sample.
        sound_speed_ratio: true over assumed sound speed from the wavefront's shape alone; None for images, which do
            not hold the wavefront.
        sound_speed_ratio_sigma: its standard deviation.
        elements_used: number of elements that received the source and entered the fit; None for images.
        statistic, threshold: the detection statistic (log likelihood ratio) and its threshold.
        others: later waves in the same frame, the strongest first: reflections, or the source after all where the
            first wave has another cause.
    """

    x_mm: float
    range_mm: float
    covariance: FloatArray
    amplitude: float
    snr_db: float
    sound_speed_ratio: float | None
    sound_speed_ratio_sigma: float | None
    elements_used: int | None
    statistic: float
    threshold: float
    others: tuple[OtherWave, ...] = ()

    @property
    def wavefront(self) -> Wavefront | None:
        """What the wavefront's curvature says about the sound speed; None for images."""
        if self.sound_speed_ratio is None or self.sound_speed_ratio_sigma is None:
            return None
        return Wavefront(self.sound_speed_ratio, self.sound_speed_ratio_sigma)


@dataclass(frozen=True, slots=True)
class NoSignal:
    """No source in the frame; ``reason`` gives the statistic and the threshold."""

    reason: str


@dataclass(slots=True, eq=False)
class FrameResults:
    """Detections in a session's frames.

    Attributes:
        markers, boards: by event index, for every event whose marker or board is detected in frames.
        finds: by (event index, number of the look).
    """

    markers: dict[int, MarkerFit | NotFound] = field(default_factory=dict)
    boards: dict[int, BoardFit | NotFound] = field(default_factory=dict)
    finds: dict[tuple[int, int], PaFind | NoSignal] = field(default_factory=dict)
