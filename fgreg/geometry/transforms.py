"""Rotations and rigid transforms as plain arrays, and the frame convention in one place.

Frames: ``camera`` (left optical frame, OpenCV axes), ``marker`` (the fiducial body), ``laser`` (+z along the
beam, rigid to ``marker``), ``trus`` (probe housing; x along the rotation axis, the image plane points along
(0, sin t, cos t) at stage angle t), ``board`` (calibration board), ``tag`` (one printed square).

``a_T_b`` is a (4, 4) matrix that maps coordinates in b to coordinates in a; inner names cancel. Millimetres and
radians. A 6-vector over a transform is GTSAM's tangent: rotation, then translation, as ``T * Expmap(xi)``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

RIGID_TOLERANCE = 1e-4
"""Largest entry of R'R - I (and of det R - 1) for which a matrix from a file still counts as rigid."""


def as_float_array(values: Any, *shape: int) -> FloatArray:
    """A read-only float64 copy of ``values``.

    Args:
        values: anything numpy can convert.
        shape: expected shape; -1 leaves a dimension open. No shape: any.

    Raises:
        ValueError: wrong shape, or an entry that is not finite.
    """
    array = np.array(values, dtype=np.float64)
    if shape and (array.ndim != len(shape) or any(n not in (-1, m) for n, m in zip(shape, array.shape, strict=True))):
        raise ValueError(f"shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise ValueError("an entry is not finite")
    array.flags.writeable = False
    return array


def hat(w: FloatArray) -> FloatArray:
    """Cross-product matrices of vectors: (..., 3) -> (..., 3, 3), ``hat(w) @ v == cross(w, v)``."""
    w = np.asarray(w, dtype=np.float64)
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -w[..., 2], w[..., 1]
    out[..., 1, 0], out[..., 1, 2] = w[..., 2], -w[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -w[..., 1], w[..., 0]
    return out


def exp_so3(w: FloatArray) -> FloatArray:
    """Rotation matrices of rotation vectors (Rodrigues): (..., 3) rad -> (..., 3, 3)."""
    w = np.asarray(w, dtype=np.float64)
    if w.size == 3:  # a single one: plain floats, a fifth of the time
        return _exp_one(*w.ravel().tolist()).reshape(*w.shape, 3)
    angle2 = np.sum(w * w, axis=-1)
    small = angle2 < 1e-12
    angle = np.sqrt(np.where(small, 1.0, angle2))
    a = np.where(small, 1.0 - angle2 / 6.0, np.sin(angle) / angle)
    b = np.where(small, 0.5 - angle2 / 24.0, (1.0 - np.cos(angle)) / (angle * angle))
    k = hat(w)
    return np.asarray(np.eye(3) + a[..., None, None] * k + b[..., None, None] * (k @ k))


def _exp_one(x: float, y: float, z: float) -> FloatArray:
    """:func:`exp_so3` of one vector."""
    angle2 = x * x + y * y + z * z
    if not math.isfinite(angle2):
        return np.full((3, 3), math.nan)
    if angle2 < 1e-12:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        angle = math.sqrt(angle2)
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle2
    bxy, bxz, byz = b * x * y, b * x * z, b * y * z
    return np.array(
        [
            [1.0 - b * (y * y + z * z), bxy - a * z, bxz + a * y],
            [bxy + a * z, 1.0 - b * (x * x + z * z), byz - a * x],
            [bxz - a * y, byz + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )


def log_so3(rotation: FloatArray) -> FloatArray:
    """Rotation vectors of rotation matrices: (..., 3, 3) -> (..., 3) rad, of length at most pi."""
    r = np.asarray(rotation, dtype=np.float64)
    if r.size == 9:  # a single one: plain floats, a tenth of the time
        return _log_one(*r.ravel().tolist()).reshape(r.shape[:-1])
    # Through the unit quaternion, built from the largest of its four components: stable up to half a turn.
    m00, m11, m22 = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    q2 = 0.25 * np.stack([1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22], axis=-1)
    a, b, c = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    d, e, f = r[..., 1, 0] + r[..., 0, 1], r[..., 0, 2] + r[..., 2, 0], r[..., 2, 1] + r[..., 1, 2]
    rows = np.stack(
        [
            np.stack([4 * q2[..., 0], a, b, c], axis=-1),
            np.stack([a, 4 * q2[..., 1], d, e], axis=-1),
            np.stack([b, d, 4 * q2[..., 2], f], axis=-1),
            np.stack([c, e, f, 4 * q2[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    best = np.argmax(q2, axis=-1)
    q = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1)
    angle = 2.0 * np.arctan2(sine, q[..., 0])
    scale = np.where(sine < 1e-9, 2.0, angle / np.where(sine < 1e-9, 1.0, sine))
    return np.asarray(scale[..., None] * q[..., 1:])


def _log_one(
    m00: float, m01: float, m02: float, m10: float, m11: float, m12: float, m20: float, m21: float, m22: float
) -> FloatArray:
    """:func:`log_so3` of one matrix."""
    squares = (1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22)
    a, b, c, d, e, f = m21 - m12, m02 - m20, m10 - m01, m10 + m01, m02 + m20, m21 + m12
    best = squares.index(max(squares))
    largest = squares[best]
    w, x, y, z = ((largest, a, b, c), (a, largest, d, e), (b, d, largest, f), (c, e, f, largest))[best]
    length = math.copysign(math.sqrt(w * w + x * x + y * y + z * z), w)
    w, x, y, z = w / length, x / length, y / length, z / length
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if sine < 1e-9 else 2.0 * math.atan2(sine, w) / sine
    return np.array([scale * x, scale * y, scale * z])


def make_transform(rotation: FloatArray, translation_mm: FloatArray) -> FloatArray:
    """Transforms from rotations (..., 3, 3) and translations (..., 3): (..., 4, 4)."""
    rotation = np.asarray(rotation, dtype=np.float64)
    out = np.zeros((*rotation.shape[:-2], 4, 4))
    out[..., :3, :3] = rotation
    out[..., :3, 3] = translation_mm
    out[..., 3, 3] = 1.0
    return out


def inverse(a_T_b: FloatArray) -> FloatArray:
    """``b_T_a``, batched over leading dimensions."""
    b_R_a = np.swapaxes(a_T_b[..., :3, :3], -1, -2)
    return make_transform(b_R_a, -np.einsum("...ij,...j->...i", b_R_a, a_T_b[..., :3, 3]))


def transform_points(a_T_b: FloatArray, b_p: FloatArray) -> FloatArray:
    """Points (..., 3) in frame b, expressed in frame a; transform and points broadcast."""
    return np.asarray(np.einsum("...ij,...j->...i", a_T_b[..., :3, :3], b_p) + a_T_b[..., :3, 3])


def adjoint(a_T_b: FloatArray) -> FloatArray:
    """(6, 6) map of tangents through a transform: ``a_T_b Exp(xi) = Exp(adjoint(a_T_b) xi) a_T_b``."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = a_T_b[:3, :3]
    out[3:, :3] = hat(a_T_b[:3, 3]) @ a_T_b[:3, :3]
    return out


def nearest_rotation(matrix: FloatArray) -> FloatArray:
    """The rotation closest to a (3, 3) matrix in the Frobenius norm."""
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt)


def is_rigid(matrix: FloatArray, tolerance: float = RIGID_TOLERANCE) -> bool:
    """Whether a (4, 4) matrix is a proper rigid transform within ``tolerance``."""
    # Plain floats: a fifth of the time that numpy takes for one. A comparison with what is not a number is false.
    (a, b, c, x), (d, e, f, y), (g, h, i, z), (p, q, r, s) = matrix.tolist()
    off = (
        *(a * a + d * d + g * g - 1.0, b * b + e * e + h * h - 1.0, c * c + f * f + i * i - 1.0),
        *(a * b + d * e + g * h, a * c + d * f + g * i, b * c + e * f + h * i),
        a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) - 1.0,
        *(p, q, r, s - 1.0),
    )
    return math.isfinite(x + y + z) and all(-tolerance <= value <= tolerance for value in off)


def rotation_to_direction(direction: FloatArray) -> FloatArray:
    """The smallest rotation that turns +z to a unit vector (3,)."""
    x, y, z = (float(v) for v in direction)
    if z < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    k = 1.0 / (1.0 + z)
    return np.array([[1.0 - k * x * x, -k * x * y, x], [-k * x * y, 1.0 - k * y * y, y], [-x, -y, z]])


def right_from_parent_covariance(rotation: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariance over the right tangent from one over the parent's axes.

    Parent's axes: ``observed = [Exp(w) R, t + n]``, (w, n) about the child's origin along the parent's axes.
    Right tangent: ``observed = T * Expmap(xi)``. To first order ``xi = blkdiag(R', R') (w, n)``.

    Args:
        rotation: ``parent_R_child``, (..., 3, 3).
        covariance: (..., 6, 6), rad and mm.
    """
    turn = np.zeros((*np.asarray(rotation).shape[:-2], 6, 6))
    turn[..., :3, :3] = np.swapaxes(rotation, -1, -2)
    turn[..., 3:, 3:] = turn[..., :3, :3]
    turned = turn @ covariance @ np.swapaxes(turn, -1, -2)
    return np.asarray(0.5 * (turned + np.swapaxes(turned, -1, -2)))  # symmetric to the last digit


def parent_from_right_covariance(rotation: FloatArray, covariance: FloatArray) -> FloatArray:
    """Inverse of :func:`right_from_parent_covariance`."""
    return right_from_parent_covariance(np.swapaxes(rotation, -1, -2), covariance)
