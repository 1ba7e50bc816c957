"""A query's beam in TRUS: the line, and how it moves with the shared variables and the marker's error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotrf

from fgreg.frames import FloatArray
from fgreg.measurements import POSE_FLOOR, MarkerObservation
from fgreg.tracking.prepared import Prepared, SharedPlace, turn
from fgreg.tracking.snapshot import SHARED

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
    _chart: list[list[float]]
    _marker: tuple[float, float, float]
    _tangent: FloatArray | None

    def moves(self, lambda_mm: float) -> FloatArray:
        """How the beam's point at ``lambda_mm`` moves, in *camera* axes: (3, SHARED + MARKER), mm per unit."""
        k, (m0, m1, m2) = lambda_mm, self._marker
        (o0, d0, x0, y0, a0, b0), (o1, d1, x1, y1, a1, b1), (o2, d2, x2, y2, a2, b2) = self._chart
        f0, f1, f2 = o0 + k * d0, o1 + k * d1, o2 + k * d2
        c0, c1, c2 = f0 + m0, f1 + m1, f2 + m2
        # Columns: registration 6, beam 4, edge, bias 3, sound speed, radius; the marker's turn 3, shift 3.
        out = np.array(
            [
                [0, c2, -c1, 1.0, 0, 0, x0, y0, k * a0, k * b0, 0, -1.0, 0, 0, 0, 0, 0, f2, -f1, 1.0, 0, 0],
                [-c2, 0, c0, 0, 1.0, 0, x1, y1, k * a1, k * b1, 0, 0, -1.0, 0, 0, 0, -f2, 0, f0, 0, 1.0, 0],
                [c1, -c0, 0, 0, 0, 1.0, x2, y2, k * a2, k * b2, 0, 0, 0, -1.0, 0, 0, f1, -f0, 0, 0, 0, 1.0],
            ]
        )
        if self._tangent is not None:
            out[:, :6] = out[:, :6] @ self._tangent
        return out


def place_beam(at: SharedPlace, marker: BeamMarker, error: list[float]) -> Beam:
    """The beam of a marker that is off by ``error`` (MARKER,): turn (rad) and shift (mm) along the camera's axes."""
    turned = turn((error[0], error[1], error[2]))
    rows = ((marker.rotation if turned is None else turned @ marker.rotation) @ at.chart).tolist()
    (o0, d0, *_), (o1, d1, *_), (o2, d2, *_) = rows
    (t0, t1, t2), (b0, b1, b2) = marker.translation, at.bias
    m0, m1, m2 = t0 + error[3] - b0, t1 + error[4] - b1, t2 + error[5] - b2
    s, a = (np.array([[o0 + m0, o1 + m1, o2 + m2], [d0, d1, d2]]) @ at.rotation.T).tolist()
    p0, p1, p2 = at.translation
    return Beam(
        start=(s[0] + p0, s[1] + p1, s[2] + p2),
        along=(a[0], a[1], a[2]),
        rotation=at.rotation,
        _chart=rows,
        _marker=(m0, m1, m2),
        _tangent=at.tangent,
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
