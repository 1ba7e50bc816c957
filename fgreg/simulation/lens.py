"""The camera's lens: projection with OpenCV's distortion models, and its inverse.

The estimator's formulas (fgreg.model.lens) are not used here, so that an error in them shows in simulated sessions.
Both are tested against OpenCV's own functions, which are too slow for all pixels of an image.
"""

from __future__ import annotations

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.model.camera_model import CameraModel

STEP = 1e-6
"""For derivatives by differences."""


def project_points(camera: CameraModel, camera_p_mm: FloatArray) -> FloatArray:
    """Pixels (..., 2) of points (..., 3) in the camera's frame."""
    normalised = camera_p_mm[..., :2] / camera_p_mm[..., 2:]
    x, y = distort(camera, normalised[..., 0], normalised[..., 1])
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
    if camera.fisheye:
        angle = np.hypot(xd, yd)
        wide = np.tan(np.minimum(angle, 1.3)) / np.maximum(angle, 1e-12)
        x, y = x * wide, y * wide
    with np.errstate(all="ignore"):  # a distortion that folds diverges, which is reported below
        for _ in range(25):
            fx, fy = distort(camera, x, y)
            ex, ey = fx - xd, fy - yd
            by_x, by_y = (
                [(high - low) / (2.0 * STEP) for high, low in zip(*ends, strict=True)]
                for ends in (
                    (distort(camera, x + STEP, y), distort(camera, x - STEP, y)),
                    (distort(camera, x, y + STEP), distort(camera, x, y - STEP)),
                )
            )
            determinant = by_x[0] * by_y[1] - by_x[1] * by_y[0]
            if max(np.abs(ex).max(), np.abs(ey).max()) < 1e-12:
                break
            x -= (by_y[1] * ex - by_y[0] * ey) / determinant
            y -= (by_x[0] * ey - by_x[1] * ex) / determinant
    # A solution beyond the fold of the polynomial is on the other side of the axis, or turns the image over.
    unfolded = (determinant > 0.0) & (x * xd + y * yd >= 0.0)
    if not (np.abs(ex) < 1e-9).all() or not (np.abs(ey) < 1e-9).all() or not unfolded.all():
        raise ValueError(f"the lens distortion {camera.distortion.tolist()} cannot be inverted over the image")
    return x, y


def distort(camera: CameraModel, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distorted normalised coordinates."""
    if camera.fisheye:
        angle = np.arctan(np.hypot(x, y))
        factor = 1.0 + sum(k * angle ** (2 * n + 2) for n, k in enumerate(camera.distortion))
        scale = factor * angle / np.maximum(np.hypot(x, y), 1e-15)
        return scale * x, scale * y
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = np.pad(camera.distortion, (0, 12 - len(camera.distortion)))
    r2 = x * x + y * y
    radial = (1.0 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1.0 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + s1 * r2 + s2 * r2**2,
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + s3 * r2 + s4 * r2**2,
    )
