"""Does a calibration still hold? A few new views of the board against it.

With the poses of the board fitted to the new views and the cameras as calibrated, g is what the corners' chi square
would gain along each parameter (the gradient, poses following). Where nothing has changed its covariance is
I + I S I: I the information of the new corners, S the covariance of the calibration. So g tests all parameters at once
(a score test; Rao 1948), in the directions that the new views show. By how much it is off says a fit to the new views
with the calibration as prior, widened by what heat, a shock or a turn of the focus does.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.special import gammaincc

from fgreg.calibration import parameters
from fgreg.calibration.bundle import Bundle, Prior, fit, fit_poses, reduced_gradient, summed_up
from fgreg.calibration.comparison import Apart, compare
from fgreg.calibration.views import CornerTable
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import BoolArray, FloatArray
from fgreg.model.camera_model import StereoRig

UNLIKELY = 1e-3
"""False alarms."""
DRIFT_FOCAL, DRIFT_CENTRE_PX, DRIFT_ROTATION_RAD, DRIFT_SHIFT_MM = 0.02, 20.0, float(np.radians(0.5)), 0.5
"""Sigmas of what may have happened since."""
_DRAWS = 40
_SHOWN = 1e-3
"""Information along a direction, relative to the calibration's, from which the new views show it."""


class Validity(StrEnum):
    """The verdict."""

    HOLDS = "holds"
    CHANGED = "changed"
    CANNOT_TELL = "cannot tell"


@dataclass(frozen=True, slots=True)
class Change:
    """Of one of the rig's constants: by how much it is off now, and with which sigma (both in the memory's units)."""

    constant: Constant
    change: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class CameraCheck:
    """Result of a check.

    Attributes:
        validity: the verdict. p: of the score test.
        rms_px: residual length with the calibration as it is; best_px: with the cameras fitted to the new views.
        apart: of the calibration from what the new views say. noise_mm: as much of it may be noise (RMS).
        changes: of the rig's constants.
    """

    validity: Validity
    p: float
    rms_px: float
    best_px: float
    apart: Apart
    noise_mm: float
    changes: tuple[Change, ...]


def check(
    table: CornerTable,
    rig: StereoRig,
    covariance: FloatArray,
    sigma_px: float,
    left_T_board: FloatArray,
    depths_mm: tuple[float, ...],
    limit_mm: float,
) -> CameraCheck:
    """Compare new views with a calibration.

    Args:
        rig, covariance: the calibration, and its covariance (P, P).
        sigma_px: of its corners; 0 where it is not known.
        left_T_board: (V, 4, 4) about where the board is in the new views.
        depths_mm: at which the difference is told.
        limit_mm: RMS difference of located points that matters.
    """
    information = _information(rig, covariance)
    now = fit(table, rig, left_T_board, Prior(rig, information))
    sigma = max(now.sigma_px, sigma_px)
    placed = fit_poses(table.subset(now.used), rig, left_T_board)
    before = summed_up(table, rig, placed, Prior(rig, information), now.used)
    p = _score_p(table, before, covariance, sigma)
    apart = compare(rig, now.rig, depths_mm)
    spread = now.covariance * (sigma / now.sigma_px) ** 2
    noise = _noise(now.rig, spread, depths_mm)
    which, by = parameters.constants(rig)
    off, sigmas = by @ parameters.difference(now.rig, rig), np.sqrt(np.diag(by @ (spread + covariance) @ by.T))
    size = apart.points_rms_mm
    if np.isnan(size):  # one camera: pixels at the middle depth
        focal = float(np.mean(rig.left.matrix[[0, 1], [0, 1]]))
        size, noise = apart.rays_rms_px[0] * depths_mm[len(depths_mm) // 2] / focal, noise / focal * depths_mm[1]
    if p < UNLIKELY and size > limit_mm:
        validity = Validity.CHANGED
    else:
        validity = Validity.CANNOT_TELL if noise > limit_mm else Validity.HOLDS
    return CameraCheck(
        validity,
        p,
        _rms_px(before, now.used),
        _rms_px(now, now.used),
        apart,
        noise,
        tuple(Change(c, float(d), float(s)) for c, d, s in zip(which, off, sigmas, strict=True)),
    )


def _rms_px(bundle: Bundle, used: BoolArray) -> float:
    return float(np.sqrt(np.mean(np.sum(bundle.residual_px[used] ** 2, axis=1))))


def _information(rig: StereoRig, covariance: FloatArray) -> FloatArray:
    """(P, P) of the parameters now: the calibration's covariance, widened by what may have happened since."""
    sigma = np.zeros(len(covariance))
    for camera, columns in zip(parameters.cameras(rig), parameters.lens_columns(rig), strict=True):
        first = columns.start
        sigma[first : first + 2] = DRIFT_FOCAL * camera.matrix[0, 0]
        sigma[first + 2 : first + 4] = DRIFT_CENTRE_PX
    if rig.right is not None:
        sigma[-6:-3], sigma[-3:] = DRIFT_ROTATION_RAD, DRIFT_SHIFT_MM
    return np.asarray(np.linalg.inv(covariance + np.diag(sigma**2)))


def _score_p(table: CornerTable, before: Bundle, covariance: FloatArray, sigma_px: float) -> float:
    """Probability of such a gradient where nothing has changed."""
    scale = (before.sigma_px / sigma_px) ** 2
    information, gradient = scale * before.information, scale * reduced_gradient(table, before)
    # In units in which the calibration's covariance is 1, directions are shown or not by their information alone.
    root = np.linalg.cholesky(covariance)
    values, vectors = np.linalg.eigh(root.T @ information @ root)
    along = vectors.T @ (root.T @ gradient)
    shown = values > _SHOWN
    chi_square = float(np.sum(along[shown] ** 2 / (values[shown] + values[shown] ** 2)))
    return float(gammaincc(0.5 * max(int(shown.sum()), 1), 0.5 * chi_square))


def _noise(rig: StereoRig, covariance: FloatArray, depths_mm: tuple[float, ...]) -> float:
    """RMS difference (mm; px with one camera) by the covariance alone."""
    rng = np.random.default_rng(0)
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    sizes = []
    for _ in range(_DRAWS):
        apart = compare(rig, parameters.moved(rig, root @ rng.standard_normal(len(covariance))), depths_mm)
        sizes.append(apart.rays_rms_px[0] if np.isnan(apart.points_rms_mm) else apart.points_rms_mm)
    return float(np.sqrt(np.mean(np.square(sizes))))
