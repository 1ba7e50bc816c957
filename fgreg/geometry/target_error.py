"""Errors against a truth, and what a registration's error or covariance comes to at the targets, where it matters."""

from __future__ import annotations

import numpy as np

from fgreg.geometry.transforms import FloatArray, exp_so3, hat, inverse, transform_points


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
