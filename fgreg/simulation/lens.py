"""The camera's lens: projection with OpenCV's distortion polynomial, and its inverse."""

from __future__ import annotations

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.model.session_model import CameraModel


def project_points(camera: CameraModel, camera_p_mm: FloatArray) -> FloatArray:
    """Pixels (..., 2) of points (..., 3) in the camera's frame: pinhole and OpenCV's five distortion coefficients."""
    normalised = camera_p_mm[..., :2] / camera_p_mm[..., 2:]
    x, y = distort(normalised[..., 0], normalised[..., 1], camera.distortion)
    k = camera.matrix
    return np.stack([k[0, 0] * x + k[0, 1] * y + k[0, 2], k[1, 1] * y + k[1, 2]], axis=-1)


def undistorted_rays(camera: CameraModel, column_px: FloatArray, row_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rays (x, y) at z = 1 through pixels, by Newton's method on the distortion.

    Raises:
        ValueError: the distortion cannot be inverted over these pixels.
    """
    k = camera.matrix
    yd = (row_px - k[1, 2]) / k[1, 1]
    xd = (column_px - k[0, 2] - k[0, 1] * yd) / k[0, 0]
    x, y = xd.copy(), yd.copy()
    with np.errstate(all="ignore"):  # a distortion that folds diverges, which is reported below
        for _ in range(25):
            fx, fy = distort(x, y, camera.distortion)
            ex, ey = fx - xd, fy - yd
            jxx, jxy, jyy = distortion_jacobian(x, y, camera.distortion)
            determinant = jxx * jyy - jxy * jxy
            if max(np.abs(ex).max(), np.abs(ey).max()) < 1e-12:
                break
            x -= (jyy * ex - jxy * ey) / determinant
            y -= (jxx * ey - jxy * ex) / determinant
    # A solution beyond the fold of the polynomial is on the other side of the axis, or turns the image over.
    unfolded = (determinant > 0.0) & (x * xd + y * yd >= 0.0)
    if not (np.abs(ex) < 1e-9).all() or not (np.abs(ey) < 1e-9).all() or not unfolded.all():
        raise ValueError(f"the lens distortion {camera.distortion.tolist()} cannot be inverted over the image")
    return x, y


def distort(x: FloatArray, y: FloatArray, distortion: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distorted normalised coordinates; ``distortion`` is k1, k2, p1, p2, k3."""
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


def distortion_jacobian(
    x: FloatArray, y: FloatArray, distortion: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """d(x')/dx, d(x')/dy = d(y')/dx, d(y')/dy of :func:`distort`."""
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))  # d radial / d(r2), times 2
    return (
        radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y,
        radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
    )
