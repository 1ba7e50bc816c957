"""Lens models: pixels to rays and back, with Jacobians. The one place that computes with them.

Pixel coordinates follow OpenCV: the centre of the top left pixel is (0, 0). *Normalised* coordinates are (X/Z, Y/Z).
*Ideal* pixels are normalised coordinates times the focal lengths: pixels of the same camera without distortion,
counted from the principal point. Straight lines in space are straight there, and a pixel keeps its size.

With r the distance from the axis in normalised coordinates, D maps these to distorted ones:

    polynomial  D = (x, y) A / B + tangential + prism,
                A = 1 + k1 r^2 + k2 r^4 + k3 r^6,   B = 1 + k4 r^2 + k5 r^4 + k6 r^6
    fisheye     D = (x, y) t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) / r,   t = atan r

A model holds out to its *reach*, the smallest r at which the radial part stops to grow (a fold) or has a pole. Beyond,
the formula gives pixels at which nothing is seen.

Source of the models: OpenCV documentation, "Camera Calibration and 3D Reconstruction" (radial, rational, tangential
and thin prism distortion) and "Fisheye camera model" (Kannala and Brandt).
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.polynomial import polynomial

from fgreg.geometry.transforms import BoolArray, FloatArray
from fgreg.model.camera_model import CameraModel

UNDISTORT_ITERATIONS = 20
UNDISTORT_TOLERANCE = 1e-11
"""Of a root, in normalised coordinates: far below 1e-6 px."""
WIDEST_RAD = math.radians(89.0)
"""No model is used farther from the axis than this: normalised coordinates end at 90 degrees."""
LONGEST_STEP = 0.2
"""Of Newton's method, in normalised coordinates on the axis."""
_NEAREST_MM = 1.0
"""Points nearer than this to the camera's plane are not seen."""
_NODES = 256
"""Of the table of radii in which the inverse starts."""


def focal_px(camera: CameraModel) -> FloatArray:
    """(2,) focal lengths along x and y."""
    return np.array([camera.matrix[0, 0], camera.matrix[1, 1]])


def _principal_px(camera: CameraModel) -> FloatArray:
    return np.array([camera.matrix[0, 2], camera.matrix[1, 2]])


def distort(camera: CameraModel, normalized: FloatArray) -> FloatArray:
    """Distorted normalised coordinates (..., 2) of ideal normalised points (..., 2)."""
    x, y = normalized[..., 0], normalized[..., 1]
    x2, y2 = x * x, y * y
    r2 = x2 + y2
    out = normalized * _radial(camera, r2)[..., None]
    if camera.fisheye:
        return np.asarray(out)
    _, _, p1, p2, _, _, _, _, s1, s2, s3, s4 = _coefficients(camera)
    mixed = 2.0 * x * y
    out[..., 0] += p1 * mixed + p2 * (r2 + 2.0 * x2)
    out[..., 1] += p1 * (r2 + 2.0 * y2) + p2 * mixed
    if s1 or s2 or s3 or s4:
        out[..., 0] += r2 * (s1 + s2 * r2)
        out[..., 1] += r2 * (s3 + s4 * r2)
    return np.asarray(out)


def distort_jacobian(camera: CameraModel, normalized: FloatArray) -> FloatArray:
    """Derivative of :func:`distort` by its argument: (..., 2, 2)."""
    x, y = normalized[..., 0], normalized[..., 1]
    r2 = x * x + y * y
    radial, slope = _radial(camera, r2), _radial_slope(camera, r2)  # d radial / dx = slope * x
    _, _, p1, p2, _, _, _, _, s1, s2, s3, s4 = [0.0] * 12 if camera.fisheye else _coefficients(camera)
    by_x = slope * x
    out = np.empty((*np.shape(x), 2, 2))
    out[..., 0, 0] = radial + by_x * x + (2.0 * p1) * y + (6.0 * p2) * x
    out[..., 0, 1] = out[..., 1, 0] = by_x * y + (2.0 * p1) * x + (2.0 * p2) * y
    out[..., 1, 1] = radial + slope * y * y + (6.0 * p1) * y + (2.0 * p2) * x
    if s1 or s2 or s3 or s4:
        prism = np.stack([2.0 * (s1 + 2.0 * s2 * r2), 2.0 * (s3 + 2.0 * s4 * r2)], axis=-1)
        out += prism[..., :, None] * normalized[..., None, :]
    return out


def _coefficients(camera: CameraModel) -> list[float]:
    """All 12; those that a camera does not have are zero."""
    given = [float(value) for value in camera.distortion]
    return given + [0.0] * (12 - len(given))


def _fisheye_angle(r2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """r and the angle from the axis at squared radii."""
    r = np.sqrt(np.maximum(r2, 1e-12))  # the limit at the centre is reached well before
    return r, np.arctan(r)


def _radial(camera: CameraModel, r2: FloatArray) -> FloatArray:
    """Radial factor at squared radii r2 (...,)."""
    if camera.fisheye:
        k1, k2, k3, k4 = (float(value) for value in camera.distortion)
        r, angle = _fisheye_angle(r2)
        a2 = angle * angle
        return np.asarray(angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))) / r)
    k1, k2, _, _, k3, k4, k5, k6, *_ = _coefficients(camera)
    above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.asarray(above / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))) if k4 or k5 or k6 else above)


def _radial_slope(camera: CameraModel, r2: FloatArray) -> FloatArray:
    """Twice the derivative of :func:`_radial` by r2."""
    if camera.fisheye:
        k1, k2, k3, k4 = (float(value) for value in camera.distortion)
        r, angle = _fisheye_angle(r2)
        a2 = angle * angle
        by_angle = 1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4)))
        return np.asarray((by_angle / (1.0 + r * r) - _radial(camera, r2)) / (r * r))
    k1, k2, _, _, k3, k4, k5, k6, *_ = _coefficients(camera)
    by_above = 2.0 * k1 + r2 * (4.0 * k2 + r2 * (6.0 * k3))
    if not (k4 or k5 or k6):
        return np.asarray(by_above)
    by_below = 2.0 * k4 + r2 * (4.0 * k5 + r2 * (6.0 * k6))
    return np.asarray((by_above - _radial(camera, r2) * by_below) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))))


def pixels_from_normalized(camera: CameraModel, normalized: FloatArray) -> FloatArray:
    """Pixels (..., 2) at which ideal normalised points (..., 2) are seen."""
    return distort(camera, normalized) * focal_px(camera) + _principal_px(camera)


def project(camera: CameraModel, camera_p_mm: FloatArray) -> FloatArray:
    """Pixels (..., 2) of points (..., 3) in this camera's frame (z > 0)."""
    return pixels_from_normalized(camera, camera_p_mm[..., :2] / camera_p_mm[..., 2:3])


def _slope_roots(camera: CameraModel) -> FloatArray:
    """Where the derivative of the radial part is zero or infinite: r^2 of a polynomial lens, t^2 of a fisheye one."""
    if camera.fisheye:
        return np.asarray(polynomial.polyroots(np.append(1.0, camera.distortion) * [1.0, 3.0, 5.0, 7.0, 9.0]))
    k1, k2, _, _, k3, k4, k5, k6, *_ = _coefficients(camera)
    above, below = np.array([1.0, k1, k2, k3]), np.array([1.0, k4, k5, k6])
    # d (r A(s) / B(s)) / dr with s = r^2 has the numerator A B + 2 s (A' B - A B').
    turn = polynomial.polysub(
        polynomial.polymul(polynomial.polyder(above), below), polynomial.polymul(above, polynomial.polyder(below))
    )
    numerator = polynomial.polyadd(polynomial.polymul(above, below), 2.0 * polynomial.polymulx(turn))
    parts = [np.trim_zeros(part, "b") for part in (numerator, below)]
    return np.concatenate([polynomial.polyroots(part) for part in parts])


@lru_cache(maxsize=32)
def _radial_table(distortion: bytes, fisheye: bool) -> tuple[FloatArray, FloatArray]:
    """Radii (256,) from 0 to the reach, and the distorted radii (256,) of the radial part alone, which only grow."""
    bare = CameraModel((1, 1), np.eye(3), np.frombuffer(distortion), fisheye)
    roots = _slope_roots(bare)
    real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0.0)]
    first = math.sqrt(float(real.min())) if real.size else math.inf
    widest = min((first if fisheye else math.atan(first)) * (1.0 - 1e-9), WIDEST_RAD)  # not at a pole
    radius = np.tan(np.linspace(0.0, widest, _NODES))
    return radius, radius * _radial(bare, radius * radius)


def reach(camera: CameraModel) -> float:
    """The largest r at which the lens model holds: before it folds, and at most 89 degrees from the axis."""
    return float(_radial_table(camera.distortion.tobytes(), camera.fisheye)[0][-1])


@np.errstate(over="ignore", invalid="ignore")  # beyond what a double holds is beyond the lens too
def normalized_from_pixels(camera: CameraModel, pixels: FloatArray) -> FloatArray:
    """Ideal normalised points (..., 2) of pixels (..., 2), by Newton's method.

    NaN where the lens model cannot be inverted: nothing within its reach is seen there.
    """
    observed = (np.asarray(pixels, dtype=np.float64) - _principal_px(camera)) / focal_px(camera)
    if not camera.distortion.any() and not camera.fisheye:
        return observed
    # Start: the root of the radial part, along the observed direction.
    radius, distorted = _radial_table(camera.distortion.tobytes(), camera.fisheye)
    length = np.sqrt(np.vecdot(observed, observed))
    point = observed * (np.interp(length, distorted, radius) / np.maximum(length, 1e-300))[..., None]
    for _ in range(UNDISTORT_ITERATIONS):
        error = distort(camera, point) - observed
        if np.abs(error).max(initial=0.0) < UNDISTORT_TOLERANCE:
            break
        j = distort_jacobian(camera, point)
        det = _determinant(j)
        det = np.where(np.abs(det) < 1e-8, 1e-8, det)
        step_x = (j[..., 1, 1] * error[..., 0] - j[..., 0, 1] * error[..., 1]) / det
        step_y = (j[..., 0, 0] * error[..., 1] - j[..., 1, 0] * error[..., 0]) / det
        step = np.stack([step_x, step_y], axis=-1)
        size2 = np.vecdot(step, step)
        if size2.max(initial=0.0) > LONGEST_STEP**2:
            most = LONGEST_STEP * (1.0 + np.vecdot(point, point))  # about 11 degrees
            step *= np.minimum(1.0, most / np.maximum(np.sqrt(size2), 1e-300))[..., None]
        point = np.minimum(np.maximum(point - step, -radius[-1]), radius[-1])
    else:
        error = distort(camera, point) - observed
    within = np.vecdot(point, point) < radius[-1] ** 2
    good = within & (np.abs(error).max(axis=-1) < 10.0 * UNDISTORT_TOLERANCE)
    good &= _determinant(distort_jacobian(camera, point)) > 0.0
    return np.where(good[..., None], point, np.nan)


def in_view(camera: CameraModel, camera_p_mm: FloatArray, margin_px: float = 0.0) -> BoolArray:
    """Whether points (..., 3) in this camera's frame are seen in the image, ``margin_px`` from its edges."""
    ahead = camera_p_mm[..., 2] > _NEAREST_MM
    normalized = camera_p_mm[..., :2] / np.where(ahead, camera_p_mm[..., 2], 1.0)[..., None]
    near = ahead & (np.linalg.norm(normalized, axis=-1) < reach(camera))
    pixel = pixels_from_normalized(camera, np.where(near[..., None], normalized, 0.0))
    size = np.array(camera.image_size) - 1.0
    return np.asarray(near & ((pixel >= margin_px) & (pixel <= size - margin_px)).all(axis=-1))


def blind_px(camera: CameraModel) -> float | None:
    """How far from the image's centre the lens model fails first; None where it holds in the circle that fills it.

    The corners do not count: an endoscope shows nothing there, and a calibration saw nothing.
    """
    width, height = camera.image_size
    centre, most = 0.5 * (np.array([width, height]) - 1.0), 0.5 * (min(width, height) - 1.0)
    angle = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    radii = np.linspace(0.0, most, 33)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    seen = np.isfinite(normalized_from_pixels(camera, centre + radii[:, None, None] * ring)).all(axis=(1, 2))
    return None if seen.all() else float(radii[np.argmin(seen)])


def ideal_from_pixels(camera: CameraModel, pixels: FloatArray) -> FloatArray:
    """Ideal pixels (..., 2) of pixels (..., 2); NaN where the distortion cannot be inverted."""
    return normalized_from_pixels(camera, pixels) * focal_px(camera)


def ideal_by_lens(camera: CameraModel, ideal: FloatArray) -> FloatArray:
    """(..., 2, 3) derivative of :func:`ideal_from_pixels` by relative focal length and principal point, times -1.

    It is how much farther along x and y an ideal pixel (..., 2) would be predicted with these larger.
    """
    by_pixel = ideal_by_pixel_jacobian(camera, ideal)
    from_centre = pixels_from_ideal(camera, ideal) - _principal_px(camera)
    return np.concatenate([by_pixel @ from_centre[..., None], by_pixel], axis=-1)


def seen_by_lens(camera: CameraModel, ideal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How ideal pixels (..., 2) that are predicted are seen, within the lens' reach and outside of it alike.

    Returns:
        (..., 2, 3) as :func:`ideal_by_lens`, and (..., 2, 2) as :func:`pixel_by_ideal_jacobian`; where nothing is seen
        those of a lens without distortion.
    """
    within = np.linalg.norm(ideal / focal_px(camera), axis=-1) < reach(camera)
    by_ideal = pixel_by_ideal_jacobian(camera, np.where(within[..., None], ideal, 0.0))
    within = (within & (np.linalg.det(by_ideal) > 0.0))[..., None]
    by_ideal = np.where(within[..., None], by_ideal, np.eye(2))
    by_pixel = np.linalg.inv(by_ideal)
    from_centre = pixels_from_ideal(camera, np.where(within, ideal, 0.0)) - _principal_px(camera)
    from_centre = np.where(within, from_centre, ideal)
    return np.concatenate([by_pixel @ from_centre[..., None], by_pixel], axis=-1), by_ideal


def pixels_from_ideal(camera: CameraModel, ideal: FloatArray) -> FloatArray:
    """Pixels (..., 2) of ideal pixels (..., 2)."""
    return pixels_from_normalized(camera, ideal / focal_px(camera))


def pixel_by_ideal_jacobian(camera: CameraModel, ideal: FloatArray) -> FloatArray:
    """Derivative of :func:`pixels_from_ideal`: (..., 2, 2)."""
    f = focal_px(camera)
    return f[:, None] * distort_jacobian(camera, ideal / f) / f


def ideal_by_pixel_jacobian(camera: CameraModel, ideal: FloatArray) -> FloatArray:
    """The inverse of :func:`pixel_by_ideal_jacobian`: (..., 2, 2)."""
    return inverse_2x2(pixel_by_ideal_jacobian(camera, ideal))


def inverse_2x2(matrix: FloatArray) -> FloatArray:
    """Inverses of (..., 2, 2), at a fraction of the time of ``numpy.linalg.inv``; not finite where there is none."""
    out = np.empty_like(matrix)
    out[..., 0, 0], out[..., 1, 1] = matrix[..., 1, 1], matrix[..., 0, 0]
    out[..., 0, 1], out[..., 1, 0] = -matrix[..., 0, 1], -matrix[..., 1, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        out /= _determinant(matrix)[..., None, None]
    return out


def _determinant(matrix: FloatArray) -> FloatArray:
    """Of (..., 2, 2)."""
    return np.asarray(matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0])
