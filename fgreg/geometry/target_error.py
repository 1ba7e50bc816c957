"""Errors against a truth, and what a registration's error or covariance comes to at the targets, where it matters."""

from __future__ import annotations

import numpy as np
from scipy.special import chndtrix, gammaincinv

from fgreg.geometry.transforms import FloatArray, exp_so3, hat, inverse, transform_points

QUANTILE = 0.95
_FREEDOM = np.linspace(1.0, 3.0, 4001)
_CHI2 = 2.0 * gammaincinv(0.5 * _FREEDOM, QUANTILE)
"""Quantiles of chi squares of one to three degrees of freedom; linear interpolation is accurate to 1e-7."""


def tre_mm(trus_T_camera: FloatArray, true_trus_T_camera: FloatArray, targets_mm: FloatArray) -> FloatArray:
    """Target registration errors (n,) mm: where the estimate puts the camera points that are truly at the targets.

    Args:
        trus_T_camera, true_trus_T_camera: (4, 4).
        targets_mm: (n, 3) TRUS.
    """
    camera_p = transform_points(inverse(true_trus_T_camera), targets_mm)
    return np.asarray(np.linalg.norm(transform_points(trus_T_camera, camera_p) - targets_mm, axis=-1))


def beam_error(marker_T_laser: FloatArray, true_marker_T_laser: FloatArray) -> tuple[float, float]:
    """Angle between two beams (rad), and distance (mm) of the true beam's origin from the estimated beam."""
    cross = np.cross(marker_T_laser[:3, 2], true_marker_T_laser[:3, 2])
    angle = float(np.arctan2(np.linalg.norm(cross), marker_T_laser[:3, 2] @ true_marker_T_laser[:3, 2]))
    gap = true_marker_T_laser[:3, 3] - marker_T_laser[:3, 3]
    return angle, float(np.linalg.norm(np.cross(gap, marker_T_laser[:3, 2])))


def target_jacobians(trus_T_camera: FloatArray, targets_mm: FloatArray) -> FloatArray:
    """(n, 3, 6): how targets (n, 3) move, along the camera's axes, with the right tangent of ``trus_T_camera``."""
    camera_p = transform_points(inverse(trus_T_camera), targets_mm)
    return np.concatenate([-hat(camera_p), np.broadcast_to(np.eye(3), (len(camera_p), 3, 3))], axis=-1)


def expected_tre_mm(covariance: FloatArray, trus_T_camera: FloatArray, targets_mm: FloatArray) -> FloatArray:
    """(..., n) root of the expected squared error at each target for covariances (..., 6, 6), right tangent."""
    jacobian = target_jacobians(trus_T_camera, targets_mm)
    square = np.einsum("nij,...jk,nik->...n", jacobian, covariance, jacobian)
    return np.asarray(np.sqrt(np.maximum(square, 0.0)))


def moved_mm(step: FloatArray, trus_T_camera: FloatArray, targets_mm: FloatArray) -> FloatArray:
    """(..., n) distances by which moving the registration by right tangents (..., 6) moves the targets (n, 3)."""
    camera_p = transform_points(inverse(trus_T_camera), targets_mm)
    step = np.asarray(step, dtype=np.float64)
    moved = np.einsum("...ij,nj->...ni", exp_so3(step[..., :3]), camera_p) + step[..., None, 3:] - camera_p
    return np.asarray(np.linalg.norm(moved, axis=-1))


def gaussian_quantile_mm(covariance: FloatArray) -> FloatArray:
    """(n,) 95 % quantiles of |e| for zero-mean Gaussian errors e of covariances (n, 3, 3).

    |e|^2 is a weighted sum of chi squares. One chi square matches its first four cumulants (Liu, Tang and Zhang, 2009).
    Exact for one, two or three equal axes; within 1 % of |e| for all others.
    """
    flat, square = covariance.reshape(-1, 9), (covariance @ covariance).reshape(-1, 9)
    c1 = flat[:, ::4].sum(axis=1)
    c2 = square[:, ::4].sum(axis=1)
    c3 = (square * flat).sum(axis=1)  # both are symmetric
    freedom = np.maximum(c2**3 / np.maximum(c3**2, 1e-300), 1.0)
    chi2 = np.interp(freedom, _FREEDOM, _CHI2)  # three axes are never worth more than three
    return np.asarray(np.sqrt(np.maximum(c1 + (chi2 - freedom) * np.sqrt(c2 / freedom), 0.0)))


def target_bounds_mm(
    covariance: FloatArray, trus_T_camera: FloatArray, targets_mm: FloatArray, worst_mm: float
) -> FloatArray:
    """(n,) 95 % bounds of the error at targets (n, 3), of which the largest is ``worst_mm``.

    Those of the covariance (6, 6), right tangent, and what a verdict adds at every target for causes that it names.
    """
    jacobian = target_jacobians(trus_T_camera, targets_mm)
    bounds = gaussian_quantile_mm(jacobian @ covariance @ jacobian.swapaxes(1, 2))
    return np.asarray(np.maximum(bounds + worst_mm - bounds.max(), 0.0))


def offset_quantile_mm(mean_mm: FloatArray, covariance: FloatArray) -> float:
    """95 % quantile of |e| for a Gaussian error e of mean (3,) and covariance (3, 3).

    As :func:`gaussian_quantile_mm`, with the cumulants of noncentral chi squares; within 2 % of |e|.
    """
    cumulants = []
    power = np.eye(3)
    for k in range(1, 5):
        shifted = k * float(mean_mm @ power @ mean_mm)
        power = power @ covariance
        cumulants.append(float(np.trace(power)) + shifted)
    c1, c2, c3, c4 = cumulants
    skew, tail = c3 / c2**1.5, c4 / c2**2
    if skew**2 > tail:
        scale = 1.0 / (skew - np.sqrt(skew**2 - tail))
        noncentral = skew * scale**3 - scale**2
        freedom = scale**2 - 2.0 * noncentral
        quantile = float(chndtrix(QUANTILE, freedom, noncentral))
    else:
        scale, noncentral = 1.0 / skew, 0.0
        freedom = 1.0 / skew**2
        quantile = 2.0 * float(gammaincinv(0.5 * freedom, QUANTILE))
    standard = (quantile - freedom - noncentral) / (np.sqrt(2.0) * scale)
    return float(np.sqrt(max(c1 + standard * np.sqrt(2.0 * c2), 0.0)))
