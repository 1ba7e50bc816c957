"""A query's beam in TRUS: the line, and how it moves with the shared variables and the marker's error."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotrf

from fgreg.frames import FloatArray
from fgreg.measurements import POSE_FLOOR, MarkerObservation
from fgreg.tracking.prepared import Prepared, turn
from fgreg.tracking.snapshot import BEAM, BIAS, SHARED

MARKER = 6
"""Variables of one marker's error: a turn (rad) and a shift (mm) along the camera's axes."""
_FLOOR = np.diag(np.square(POSE_FLOOR))
_ALMOST = (1.0 - 1e-9) * _FLOOR


@dataclass(frozen=True, slots=True, eq=False)
class BeamMarker:
    """A marker observation: rotation (3, 3), translation, covariance (6, 6) along the camera's axes."""

    rotation: FloatArray
    translation: tuple[float, float, float]
    covariance: FloatArray


def read_marker(marker: MarkerObservation, *, floor: bool) -> BeamMarker:
    """The observation with its covariance along the camera's axes; ``floor``: no direction of it below the floors."""
    transform = marker.camera_T_marker
    rotation = np.ascontiguousarray(transform[:3, :3])
    x, y, z = transform[:3, 3].tolist()
    covariance = marker.covariance
    if floor and dpotrf(covariance - _ALMOST)[1] != 0:  # as measurements.usable_covariance, without its eigenvalues
        covariance = covariance + _FLOOR
    axes = np.zeros((6, 6))
    axes[:3, :3] = axes[3:, 3:] = rotation
    return BeamMarker(rotation, (x, y, z), axes @ covariance @ axes.T)


@dataclass(frozen=True, slots=True, eq=False)
class Beam:
    """The beam at some values of the variables.

    Attributes:
        start, along: point at lambda = 0 (mm) and unit direction, TRUS.
        rotation: (3, 3) ``trus_R_camera``.
    """

    start: tuple[float, float, float]
    along: tuple[float, float, float]
    rotation: FloatArray
    _origin: tuple[float, float, float]
    _direction: tuple[float, float, float]
    _marker: tuple[float, float, float]
    _chart: list[list[float]]
    _tangent: FloatArray | None

    def moves(self, lambda_mm: float) -> FloatArray:
        """How the beam's point at ``lambda_mm`` moves, in *camera* axes: (3, SHARED + MARKER), mm per unit."""
        o, d, m = self._origin, self._direction, self._marker
        f0, f1, f2 = o[0] + lambda_mm * d[0], o[1] + lambda_mm * d[1], o[2] + lambda_mm * d[2]
        c0, c1, c2 = f0 + m[0], f1 + m[1], f2 + m[2]
        n0, n1, n2 = self._chart
        k = lambda_mm
        out = np.array(
            [
                [0.0, c2, -c1, 1.0, 0, 0, n0[0], n0[1], k * n0[2], k * n0[3], 0, -1.0, 0, 0, 0, 0, 0, f2, -f1, 1.0, 0, 0],
                [-c2, 0.0, c0, 0, 1.0, 0, n1[0], n1[1], k * n1[2], k * n1[3], 0, 0, -1.0, 0, 0, 0, -f2, 0, f0, 0, 1.0, 0],
                [c1, -c0, 0.0, 0, 0, 1.0, n2[0], n2[1], k * n2[2], k * n2[3], 0, 0, 0, -1.0, 0, 0, f1, -f0, 0, 0, 0, 1.0],
            ]
        )
        if self._tangent is not None:
            out[:, :6] = out[:, :6] @ self._tangent
        return out


def _tangent_gain(w: list[float], v: list[float]) -> FloatArray:
    """(6, 6) right Jacobian of SE(3) at a tangent (w, v), to first order: ``I - ad / 2``."""
    x, y, z = 0.5 * w[0], 0.5 * w[1], 0.5 * w[2]
    p, q, r = 0.5 * v[0], 0.5 * v[1], 0.5 * v[2]
    return np.array(
        [
            [1.0, z, -y, 0.0, 0.0, 0.0],
            [-z, 1.0, x, 0.0, 0.0, 0.0],
            [y, -x, 1.0, 0.0, 0.0, 0.0],
            [0.0, r, -q, 1.0, z, -y],
            [-r, 0.0, p, -z, 1.0, x],
            [q, -p, 0.0, y, -x, 1.0],
        ]
    )


def place_beam(at: Prepared, marker: BeamMarker, shared: list[float], error: list[float]) -> Beam:
    """The beam where the shared variables are ``shared`` (SHARED,) off the snapshot's, and the marker by ``error``."""
    turned = turn((error[0], error[1], error[2]))
    camera_R_nominal = (marker.rotation if turned is None else turned @ marker.rotation) @ at.nominal
    camera_R_marker_origin = marker.rotation if turned is None else turned @ marker.rotation
    x, y, a, b = at.beam
    x, y, a, b = x + shared[BEAM], y + shared[BEAM + 1], a + shared[BEAM + 2], b + shared[BEAM + 3]
    square = 1.0 + a * a + b * b
    scale = 1.0 / math.sqrt(square)
    # Columns: the chart's point, direction, and derivatives by x, y, a, b, in the nominal frame.
    chart = np.array(
        [
            [x, a * scale, 1.0, 0.0, scale * (1.0 - a * a / square), -scale * a * b / square],
            [y, b * scale, 0.0, 1.0, -scale * a * b / square, scale * (1.0 - b * b / square)],
            [0.0, scale, 0.0, 0.0, -scale * a / square, -scale * b / square],
        ]
    )
    c0, c1, c2 = (camera_R_nominal @ chart).tolist()
    p0, p1, p2 = (camera_R_marker_origin @ at.nominal_origin).tolist()
    origin = (c0[0] + p0, c1[0] + p1, c2[0] + p2)
    direction = (c0[1], c1[1], c2[1])
    t, bias = marker.translation, at.bias
    position = (
        t[0] + error[3] - bias[0] - shared[BIAS],
        t[1] + error[4] - bias[1] - shared[BIAS + 1],
        t[2] + error[5] - bias[2] - shared[BIAS + 2],
    )
    omega = turn((shared[0], shared[1], shared[2]))
    rotation = at.rotation if omega is None else at.rotation @ omega
    (a0, s0), (a1, s1), (a2, s2) = (
        rotation @ np.array([[d, o + m] for d, o, m in zip(direction, origin, position, strict=True)])
    ).tolist()
    t0, t1, t2 = at.translation
    if omega is not None:  # GTSAM's tangent: the translation moves by V(w) v, here to second order in w
        x, y, z = shared[:3]
        p, q, r = shared[3:6]
        a, b, c = 0.5 * (y * r - z * q), 0.5 * (z * p - x * r), 0.5 * (x * q - y * p)
        k = 1.0 / 3.0
        moved = (
            p + a + k * (y * c - z * b),
            q + b + k * (z * a - x * c),
            r + c + k * (x * b - y * a),
        )
        v0, v1, v2 = (at.rotation @ moved).tolist()
        t0, t1, t2 = t0 + v0, t1 + v1, t2 + v2
    return Beam(
        start=(s0 + t0, s1 + t1, s2 + t2),
        along=(a0, a1, a2),
        rotation=rotation,
        _origin=origin,
        _direction=direction,
        _marker=position,
        _chart=[c0[2:], c1[2:], c2[2:]],
        _tangent=None if omega is None else _tangent_gain(shared[:3], shared[3:6]),
    )


def joint_covariance(at: Prepared, markers: list[BeamMarker]) -> FloatArray:
    """Covariance of the shared variables and each marker's error: (n, n), n = SHARED + MARKER * markers."""
    size = SHARED + MARKER * len(markers)
    out = np.zeros((size, size))
    out[:SHARED, :SHARED] = at.covariance
    for k, marker in enumerate(markers):
        begin = SHARED + MARKER * k
        out[begin : begin + MARKER, begin : begin + MARKER] = marker.covariance
    return out
