"""Cameras with OpenCV's lens models: pixels to rays and back, with Jacobians.

Pixel coordinates follow OpenCV: the centre of the top left pixel is (0, 0). *Normalised* coordinates are (X/Z, Y/Z).
*Ideal* pixels are normalised coordinates times the focal lengths: pixels of the same camera without distortion,
counted from the principal point. Straight lines in space are straight there, and a pixel keeps its size.

Source of the models: OpenCV documentation, "Camera Calibration and 3D Reconstruction" (radial, rational, tangential
and thin prism distortion) and "Fisheye camera model" (Kannala and Brandt).
"""

from __future__ import annotations

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.model.camera_model import CameraModel

UNDISTORT_ITERATIONS = 20
UNDISTORT_TOLERANCE = 1e-9
MAX_START_RAD = 1.3
"""Largest angle from the axis at which the inverse of a fisheye lens starts."""


def focal_px(camera: CameraModel) -> FloatArray:
    """(2,) focal lengths along x and y."""
    return np.array([camera.matrix[0, 0], camera.matrix[1, 1]])


def _principal_px(camera: CameraModel) -> FloatArray:
    return np.array([camera.matrix[0, 2], camera.matrix[1, 2]])


def distort(camera: CameraModel, normalized: FloatArray) -> FloatArray:
    """Distorted normalised coordinates (..., 2) of ideal normalised points (..., 2)."""
    x, y = normalized[..., 0], normalized[..., 1]
    r2 = x * x + y * y
    radial, _ = _radial(camera, r2)
    if camera.fisheye:
        return np.asarray(normalized * radial[..., None])
    _, _, p1, p2, _, _, _, _, s1, s2, s3, s4 = _coefficients(camera)
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (s1 + s2 * r2),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + r2 * (s3 + s4 * r2),
        ],
        axis=-1,
    )


def distort_jacobian(camera: CameraModel, normalized: FloatArray) -> FloatArray:
    """Derivative of :func:`distort` by its argument: (..., 2, 2)."""
    x, y = normalized[..., 0], normalized[..., 1]
    r2 = x * x + y * y
    radial, slope = _radial(camera, r2)  # d radial / dx = slope * x
    _, _, p1, p2, _, _, _, _, s1, s2, s3, s4 = [0.0] * 12 if camera.fisheye else _coefficients(camera)
    prism_x, prism_y = 2.0 * (s1 + 2.0 * s2 * r2), 2.0 * (s3 + 2.0 * s4 * r2)
    mixed = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
    out = np.empty((*np.shape(x), 2, 2))
    out[..., 0, 0] = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x + prism_x * x
    out[..., 0, 1] = mixed + prism_x * y
    out[..., 1, 0] = mixed + prism_y * x
    out[..., 1, 1] = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x + prism_y * y
    return out


def _coefficients(camera: CameraModel) -> list[float]:
    """All 12; those that a camera does not have are zero."""
    given = [float(value) for value in camera.distortion]
    return given + [0.0] * (12 - len(given))


def _radial(camera: CameraModel, r2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Radial factor at squared radii r2 (...,), and twice its derivative by r2."""
    if camera.fisheye:
        k1, k2, k3, k4 = (float(value) for value in camera.distortion)
        r = np.sqrt(np.maximum(r2, 1e-12))  # the limit at the centre is reached well before
        angle = np.arctan(r)
        a2 = angle * angle
        turned = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
        by_angle = 1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4)))
        return turned / r, (by_angle * r / (1.0 + r * r) - turned) / r**3
    k1, k2, _, _, k3, k4, k5, k6, *_ = _coefficients(camera)
    above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    by_above = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)
    by_below = k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6)
    return above / below, 2.0 * (by_above - above / below * by_below) / below


def pixels_from_normalized(camera: CameraModel, normalized: FloatArray) -> FloatArray:
    """Pixels (..., 2) at which ideal normalised points (..., 2) are seen."""
    return distort(camera, normalized) * focal_px(camera) + _principal_px(camera)


def project(camera: CameraModel, camera_p_mm: FloatArray) -> FloatArray:
    """Pixels (..., 2) of points (..., 3) in this camera's frame (z > 0)."""
    return pixels_from_normalized(camera, camera_p_mm[..., :2] / camera_p_mm[..., 2:3])


def normalized_from_pixels(camera: CameraModel, pixels: FloatArray) -> FloatArray:
    """Ideal normalised points (..., 2) of pixels (..., 2), by Newton's method.

    NaN where the distortion model cannot be inverted: no root nearby, or one beyond the fold of the radial polynomial.
    """
    observed = (np.asarray(pixels, dtype=np.float64) - _principal_px(camera)) / focal_px(camera)
    if not camera.distortion.any() and not camera.fisheye:
        return observed
    point = observed.copy()
    if camera.fisheye:
        angle = np.minimum(np.linalg.norm(observed, axis=-1, keepdims=True), MAX_START_RAD)
        point *= np.tan(angle) / np.maximum(angle, 1e-12)
    for _ in range(UNDISTORT_ITERATIONS):
        error = distort(camera, point) - observed
        if np.abs(error).max(initial=0.0) < UNDISTORT_TOLERANCE:
            break
        j = distort_jacobian(camera, point)
        det = j[..., 0, 0] * j[..., 1, 1] - j[..., 0, 1] * j[..., 1, 0]
        det = np.where(np.abs(det) < 1e-3, 1e-3, det)
        point[..., 0] -= (j[..., 1, 1] * error[..., 0] - j[..., 0, 1] * error[..., 1]) / det
        point[..., 1] -= (j[..., 0, 0] * error[..., 1] - j[..., 1, 0] * error[..., 0]) / det
        np.clip(point, -10.0, 10.0, out=point)
    error = np.abs(distort(camera, point) - observed).max(axis=-1)
    good = (error < 1e-7) & (np.linalg.det(distort_jacobian(camera, point)) > 0.0)
    return np.where(good[..., None], point, np.nan)


def ideal_from_pixels(camera: CameraModel, pixels: FloatArray) -> FloatArray:
    """Ideal pixels (..., 2) of pixels (..., 2); NaN where the distortion cannot be inverted."""
    return normalized_from_pixels(camera, pixels) * focal_px(camera)


def ideal_by_lens(camera: CameraModel, ideal: FloatArray) -> FloatArray:
    """(..., 2, 3) derivative of :func:`ideal_from_pixels` by relative focal length and principal point, times -1.

    It is how much farther along x and y an ideal pixel (..., 2) would be predicted with these larger.
    """
    by_pixel = np.linalg.inv(pixel_by_ideal_jacobian(camera, ideal))
    from_centre = pixels_from_ideal(camera, ideal) - _principal_px(camera)
    return np.concatenate([by_pixel @ from_centre[..., None], by_pixel], axis=-1)


def pixels_from_ideal(camera: CameraModel, ideal: FloatArray) -> FloatArray:
    """Pixels (..., 2) of ideal pixels (..., 2)."""
    return pixels_from_normalized(camera, ideal / focal_px(camera))


def pixel_by_ideal_jacobian(camera: CameraModel, ideal: FloatArray) -> FloatArray:
    """Derivative of :func:`pixels_from_ideal`: (..., 2, 2)."""
    f = focal_px(camera)
    return f[:, None] * distort_jacobian(camera, ideal / f) / f
