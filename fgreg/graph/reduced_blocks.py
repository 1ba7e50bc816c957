"""Residuals of the reduced problem in blocks, and the private variables at which they are linearised.

In public shapes S, the number of hypotheses, is the first dimension. In this module it is the last one, (n, ..., S), so
that arithmetic runs along it, and a marker's matrix multiplies all hypotheses in one product.

A beam is the line ``(x + z a, y + z b, z)`` of the chart's nominal frame. The deviation of a point ``laser_p`` of that
frame is ``laser_p_xy - (x, y) - laser_p_z (a, b)``: two residuals, linear in the chart. Their covariance follows from
the marker's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fgreg.geometry.rig import CAMERA, Constant
from fgreg.geometry.transforms import FloatArray, IntArray, exp_so3, make_transform
from fgreg.graph.columns import Columns
from fgreg.graph.packing import LINE_SIGMA_MM, BeamArrays, PackedProblem
from fgreg.graph.shared_state import SharedState
from fgreg.model.sensitivity import arc_of_rotation


@dataclass(frozen=True, slots=True, eq=False)
class PrivateState:
    """Estimates of the eliminated variables.

    PMs (S, J, 3) in TRUS mm; marker errors (w, n) of beams (S, B, 6) and of aims (S, A, 6); errors of the aimed-at
    spots' measured places, (S, A, 3) mm, camera axes.
    """

    trus_p_pm: FloatArray
    beam_error: FloatArray
    aim_error: FloatArray
    aim_shift: FloatArray

    def take(self, index: Any) -> PrivateState:
        """The hypotheses at ``index`` (anything that indexes an array's first dimension)."""
        return PrivateState(*(getattr(self, name)[index] for name in self.__slots__))


def inner(values: FloatArray) -> FloatArray:
    """(S, ...) to (..., S), contiguous."""
    return np.ascontiguousarray(values.transpose(*range(1, values.ndim), 0))


def outer(values: FloatArray) -> FloatArray:
    """(..., S) to (S, ...), a view."""
    return values.transpose(-1, *range(values.ndim - 1))


def perpendicular_basis(direction: FloatArray) -> FloatArray:
    """Two unit columns perpendicular to each unit direction: (..., 3) -> (..., 3, 2) (Duff et al., 2017)."""
    x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    out = np.empty((*direction.shape, 2))
    out[..., 0, 0], out[..., 1, 0], out[..., 2, 0] = 1.0 + sign * x * x * a, sign * b, -sign * x
    out[..., 0, 1], out[..., 1, 1], out[..., 2, 1] = b, sign + y * y * a, -y
    return out


def transposed(matrix: FloatArray) -> FloatArray:
    return matrix.swapaxes(-1, -2)


def times(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    return np.asarray((matrix @ vector[..., None])[..., 0])


_NEXT = np.array([1, 2, 0])


def cross(first: FloatArray, second: FloatArray) -> FloatArray:
    """Cross products along the second dimension: (n, 3, ...) each, broadcast."""
    return np.asarray((first * second[:, _NEXT] - first[:, _NEXT] * second)[:, _NEXT])


def inverse3(matrix: FloatArray) -> FloatArray:
    """Inverses of symmetric (n, 3, 3, S) matrices by cofactors."""
    a, b, c = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 0, 2]
    d, e, f = matrix[:, 1, 1], matrix[:, 1, 2], matrix[:, 2, 2]
    out = np.empty_like(matrix)
    first, second, third = d * f - e * e, c * e - b * f, b * e - c * d
    out[:, 0, 0] = first
    out[:, 0, 1] = out[:, 1, 0] = second
    out[:, 0, 2] = out[:, 2, 0] = third
    out[:, 1, 1] = a * f - c * c
    out[:, 1, 2] = out[:, 2, 1] = b * c - a * e
    out[:, 2, 2] = a * d - b * b
    out /= (a * first + b * second + c * third)[:, None, None]
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Groups:
    """Which group each of n entries belongs to: ``index`` (n,), and that as a matrix of ones (count, n).

    Both are None where every entry is a group of its own, in order.
    """

    index: IntArray | None
    matrix: FloatArray | None

    @classmethod
    def of(cls, index: IntArray, count: int) -> Groups:
        """Entries (n,) of ``count`` groups."""
        if len(index) == count and (index == np.arange(count)).all():
            return cls(None, None)
        matrix = np.zeros((count, len(index)))
        matrix[index, np.arange(len(index))] = 1.0
        return cls(index, matrix)

    def sum(self, values: FloatArray) -> FloatArray:
        """(n, ...) to (count, ...)."""
        if self.matrix is None:
            return values
        flat = values.reshape(len(values), math.prod(values.shape[1:]))
        return np.asarray((self.matrix @ flat).reshape(len(self.matrix), *values.shape[1:]))

    def spread(self, values: FloatArray) -> FloatArray:
        """(count, ...) to (n, ...)."""
        return values if self.index is None else values[self.index]


def moved_markers(beams: BeamArrays, error: FloatArray, constants: FloatArray) -> FloatArray:
    """(n, 4, 4) marker poses, one hypothesis, at errors (w, n) (n, 6) of their observations and constants (COUNT,).

    The marker moves by Exp of a twist about its observed origin: t + n + w x n / 2 to second order.
    """
    expected = beams.by_constants @ constants[CAMERA]
    turn, shift = error[:, :3], error[:, 3:]
    turn = turn + expected[:, :3]
    translation = beams.translation_mm + expected[:, 3:] + shift + 0.5 * np.cross(turn, shift)
    return make_transform(exp_so3(turn) @ beams.rotation, translation)


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """The beams of S hypotheses: nominal frame as rotation (3, 3, S) and origin (3, S), (x, y) and (a, b) (2, S).

    ``constants`` (C, S): those of the camera.
    """

    rotation: FloatArray
    origin_mm: FloatArray
    offset_mm: FloatArray
    slope: FloatArray
    constants: FloatArray

    @classmethod
    def of(cls, state: SharedState) -> Chart:
        """The charts of a state."""
        frame = state.marker_T_nominal
        return cls(
            inner(frame[:, :3, :3]), inner(frame[:, :3, 3]), inner(state.beam[:, :2]), inner(state.beam[:, 2:]),
            inner(state.constants[:, CAMERA]),
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class LineBlock:
    """Points against beams, at the estimated errors of the markers.

    Attributes:
        rows: (n, 4, 2, S) the residual (mm, the marker's error linearised at zero) and its derivative by the point,
            camera axes.
        by_turn: (n, 3, 2, S) derivative by the marker's turn w.
        covariance: (n, 3, S): entries 00, 01 and 11 of the covariance from the marker's pose, mm^2.
        spread: (n, 6, 2, S) the marker's covariance times the derivative by its error.
        laser_p: (n, 3, S) the point in the chart's nominal frame, mm.
    """

    rows: FloatArray
    by_turn: FloatArray
    covariance: FloatArray
    spread: FloatArray
    laser_p: FloatArray


def line_block(beams: BeamArrays, error: FloatArray, chart: Chart, camera_p: FloatArray) -> LineBlock:
    """Points (n, 3, S), camera axes, against beams of markers with errors (n, 6, S)."""
    n, count = len(error), camera_p.shape[-1]
    expected = by_constants(beams.by_constants, chart)
    turned = error[:, :3] + expected[:, :3]
    shift, half_turn = error[:, 3:], _half_hat(turned)
    # The marker moves by Exp of a twist (w, n) about its observed origin: t + n + w x n / 2 to second order.
    marker_t = beams.translation_mm[..., None] + shift + np.einsum("nijs,njs->nis", half_turn, shift)
    marker_t = marker_t + expected[:, 3:]
    from_marker = camera_p - marker_t
    turn = _exp(turned, half_turn)
    marker_p = transposed(beams.rotation) @ np.einsum("nijs,nis->njs", turn, from_marker) - chart.origin_mm[None]
    laser_p = np.einsum("ijs,nis->njs", chart.rotation, marker_p)
    across = chart.rotation[:, :2] - chart.rotation[:, 2:] * chart.slope
    marker_rows = (beams.rotation @ across.reshape(3, 2 * count)).reshape(n, 3, 2, count)
    rows = np.empty((n, 4, 2, count))
    by_camera = rows[:, 1:]
    np.einsum("nijs,njks->niks", turn, marker_rows, out=by_camera)
    by_marker = np.empty((n, 2, 3, 2, count))
    by_marker[:, 0] = cross(by_camera, (from_marker + 0.5 * shift)[:, :, None])
    np.negative(by_camera, out=by_marker[:, 1])
    by_marker = by_marker + np.einsum("ngiks,nijs->ngjks", by_marker, half_turn)
    by_marker = by_marker.reshape(n, 6, 2, count)
    spread = (beams.covariance @ by_marker.reshape(n, 6, 2 * count)).reshape(n, 6, 2, count)
    covariance = np.empty((n, 3, count))
    a, b = chart.slope
    for place, (i, j, floor) in enumerate(((0, 0, 1.0 + a * a), (0, 1, a * b), (1, 1, 1.0 + b * b))):
        np.einsum("nks,nks->ns", by_marker[:, :, i], spread[:, :, j], out=covariance[:, place])
        covariance[:, place] += (LINE_SIGMA_MM**2 + beams.offset_mm[:, None] ** 2) * floor
    residual = laser_p[:, :2] - chart.offset_mm - laser_p[:, 2:] * chart.slope
    rows[:, 0] = residual - np.einsum("nkis,nks->nis", by_marker, error)
    return LineBlock(rows, by_marker[:, :3], covariance, spread, laser_p)


def by_constants(gain: FloatArray, chart: Chart) -> FloatArray:
    """(n, k, S) what the camera's constants change, from the derivatives (n, k, C)."""
    n, k, count = gain.shape
    return np.asarray((gain.reshape(n * k, count) @ chart.constants).reshape(n, k, chart.constants.shape[1]))


def _half_hat(w: FloatArray) -> FloatArray:
    """Half the cross-product matrices (n, 3, 3, S) of vectors (n, 3, S)."""
    half = 0.5 * w
    out = np.zeros((len(w), 3, *w.shape[1:]))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -half[:, 2], half[:, 1], -half[:, 0]
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = half[:, 2], -half[:, 1], half[:, 0]
    return out


def _exp(w: FloatArray, half_hat: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3, S) by vectors (n, 3, S), their :func:`_half_hat` given (Rodrigues)."""
    half = 0.5 * np.sqrt(np.einsum("nis,nis->ns", w, w)) + 1e-30
    ratio = np.sin(half) / half
    once, twice = 2.0 * ratio * np.cos(half), 2.0 * ratio * ratio
    out = once[:, None, None] * half_hat
    out += twice[:, None, None] * np.einsum("nijs,njks->niks", half_hat, half_hat)
    for i in range(3):
        out[:, i, i] += 1.0
    return np.asarray(out)


def along_beam(state: SharedState, laser_p: FloatArray) -> FloatArray:
    """(n, S) distance from the chart's point (x, y, 0) along the unit direction, of the foot of points (n, 3, S)."""
    (x, y, a, b) = state.beam.T
    ahead = laser_p[:, 2] + (laser_p[:, 0] - x) * a + (laser_p[:, 1] - y) * b
    return np.asarray(ahead / np.sqrt(1.0 + a * a + b * b))


@dataclass(frozen=True, slots=True, eq=False)
class Whitening:
    """Cholesky factors of n x S covariances of two residuals (entries 00, 01, 11 of each)."""

    first: FloatArray
    below: FloatArray
    second: FloatArray

    @classmethod
    def of(cls, covariance: FloatArray) -> Whitening:
        """From the entries (n, 3, S)."""
        first = np.sqrt(covariance[:, 0])
        below = covariance[:, 1] / first
        return cls(first, below, np.sqrt(covariance[:, 2] - below * below))

    def rows(self, values: FloatArray) -> FloatArray:
        """Values (n, ..., 2, S) in units of their standard deviations."""
        shape = (len(self.first), *(1,) * (values.ndim - 3), self.first.shape[-1])
        first, below, second = (part.reshape(shape) for part in (self.first, self.below, self.second))
        out = np.empty(np.broadcast_shapes(values.shape, (*shape[:-1], 1, shape[-1])))
        np.divide(values[..., 0, :], first, out=out[..., 0, :])
        np.divide(values[..., 1, :] - below * out[..., 0, :], second, out=out[..., 1, :])
        return out

    def back(self, values: FloatArray) -> FloatArray:
        """From whitened values (n, 2, S) to the inverse covariance times the plain values."""
        second = values[:, 1] / self.second
        out = np.empty_like(values)
        out[:, 0], out[:, 1] = (values[:, 0] - self.below * second) / self.first, second
        return out


@dataclass(frozen=True, slots=True, eq=False)
class LookBlock:
    """Residuals (S, L, 3) over (x, range, rotation), derivatives by the point (.., 3, 3) and the shared (.., 3, D)."""

    residual: FloatArray
    by_point: FloatArray
    by_shared: FloatArray


def look_block(problem: PackedProblem, state: SharedState, points: FloatArray) -> LookBlock:
    """Looks against the points (S, L, 3), TRUS mm."""
    columns, of_looks = problem.columns, problem.columns.of_looks
    rows = look_rows(problem, state, inner(points), of_looks)
    whole = np.zeros((len(problem.look_pm), 3, columns.size, state.count))
    whole[:, :, look_columns(columns)] = rows[:, :, 4:]
    return LookBlock(outer(rows[:, :, 0]), outer(rows[:, :, 1:4]), outer(whole))


def look_columns(columns: Columns) -> slice:
    """The columns of the constants that looks depend on: the first ones of the rig's."""
    return slice(columns.first_constant, columns.first_constant + len(columns.of_looks))


def look_rows(problem: PackedProblem, state: SharedState, points: FloatArray, wanted: Sequence[int] = ()) -> FloatArray:
    """Looks against points (L, 3, S), TRUS mm: (L, 3, 4 + K, S) over (x, range, rotation).

    The residual, its derivatives by the point, and by the K ``wanted`` constants. Axes of the array's frame: along the
    array, tangential (towards larger stage angles), radial (docs/model.md, section 3).
    """
    looks = problem.looks
    c = inner(state.constants)
    x, heard_mm = looks.x_mm[:, None], looks.range_mm[:, None]
    scan = looks.scan_rad[:, None] - looks.sweep[:, None] * c[Constant.BACKLASH]
    sin_scan, cos_scan = np.sin(scan), np.cos(scan)
    across = cos_scan * points[:, 1] - sin_scan * points[:, 2]
    out_from_axis = sin_scan * points[:, 1] + cos_scan * points[:, 2]
    radius = problem.radius_mm + c[Constant.RADIUS]
    px, py, pz = points[:, 0], across - c[Constant.ARRAY_OFFSET], out_from_axis - radius
    # The array's axes, to first order in its tilts.
    in_plane, radial, steer = c[Constant.TILT_IN_PLANE], c[Constant.TILT_RADIAL], c[Constant.TILT_ELEVATION]
    qx = px + py * radial + pz * in_plane
    qy = py - pz * steer - px * radial
    qz = pz - px * in_plane + py * steer
    distance = np.maximum(np.sqrt(qy * qy + qz * qz), 1e-9)
    sin_delta, cos_delta = qy / distance, qz / distance
    heard = (1.0 + c[Constant.SOUND_SPEED]) * heard_mm + c[Constant.RANGE_OFFSET]
    towards = radius + heard * cos_delta
    rotation = np.arctan2(heard * sin_delta, towards)
    square = radius * (towards + heard * cos_delta) + heard * heard
    per_mm = heard * (heard + radius * cos_delta) / (square * distance)

    out = np.zeros((len(looks.scan_rad), 3, 4 + len(wanted), distance.shape[-1]))
    gain = looks.edge_gain[:, None]
    out[:, 0, 0] = qx - (1.0 + c[Constant.PITCH]) * x
    out[:, 1, 0] = distance - heard
    out[:, 2, 0] = rotation - looks.centre_rad[:, None] - gain * c[Constant.WINDOW_EDGE] - c[Constant.WINDOW_CENTRE]
    # Rows over the point in the array's frame, then over it in the stage's, then in TRUS.
    by_y, by_z = per_mm * cos_delta, -per_mm * sin_delta
    rows = (
        (1.0, radial, in_plane),
        (-(sin_delta * radial + cos_delta * in_plane), sin_delta + cos_delta * steer, cos_delta - sin_delta * steer),
        (-(by_y * radial + by_z * in_plane), by_y + by_z * steer, by_z - by_y * steer),
    )
    for i, (first, second, third) in enumerate(rows):
        out[:, i, 1] = first
        out[:, i, 2] = second * cos_scan + third * sin_scan
        out[:, i, 3] = third * cos_scan - second * sin_scan
    by_heard = radius * sin_delta / square
    for place, constant in enumerate(wanted, 4):
        for i, (_, second, third) in enumerate(rows):
            if constant == Constant.RADIUS:
                out[:, i, place] = -third
            elif constant == Constant.ARRAY_OFFSET:
                out[:, i, place] = -second
            elif constant == Constant.BACKLASH:
                out[:, i, place] = looks.sweep[:, None] * (second * out_from_axis - third * across)
        if constant == Constant.WINDOW_EDGE:
            out[:, 2, place] = -gain
        elif constant == Constant.WINDOW_CENTRE:
            out[:, 2, place] = -1.0
        elif constant == Constant.RADIUS:
            out[:, 2, place] -= heard * sin_delta / square
        elif constant == Constant.SOUND_SPEED:
            out[:, 1, place], out[:, 2, place] = -heard_mm, by_heard * heard_mm
        elif constant == Constant.RANGE_OFFSET:
            out[:, 1, place], out[:, 2, place] = -1.0, by_heard
        elif constant == Constant.PITCH:
            out[:, 0, place] = -x
        elif constant == Constant.TILT_IN_PLANE:
            out[:, 0, place], out[:, 1, place], out[:, 2, place] = pz, -cos_delta * px, -by_z * px
        elif constant == Constant.TILT_RADIAL:
            out[:, 0, place], out[:, 1, place], out[:, 2, place] = py, -sin_delta * px, -by_y * px
        elif constant == Constant.TILT_ELEVATION:
            out[:, 1, place] = cos_delta * py - sin_delta * pz
            out[:, 2, place] = by_z * py - by_y * pz
    return out


def expected_rotation(problem: PackedProblem, state: SharedState) -> FloatArray:
    """(S, L) centres of the looks' rotation priors, with the window's edge and centre as estimated."""
    looks = problem.looks
    edge, centre = state.constant(Constant.WINDOW_EDGE), state.constant(Constant.WINDOW_CENTRE)
    return np.asarray(looks.centre_rad + looks.edge_gain * edge[:, None] + centre[:, None])


def initial_private(problem: PackedProblem, state: SharedState) -> PrivateState:
    """PMs on their arcs at the prior's centre; marker errors zero."""
    trus_p = arc_points(problem, np.zeros(1))[0]
    first = np.full(len(problem.pms), -1, dtype=np.int64)
    first[problem.look_pm[::-1]] = np.arange(len(problem.look_pm))[::-1]
    count = state.count
    return PrivateState(
        trus_p_pm=np.repeat(trus_p[first][None], count, axis=0),
        beam_error=np.zeros((count, len(problem.beam_pm), 6)),
        aim_error=np.zeros((count, len(problem.aims.rotation), 6)),
        aim_shift=np.zeros((count, len(problem.aims.rotation), 3)),
    )


def arc_points(problem: PackedProblem, edge_rad: FloatArray) -> FloatArray:
    """(S, L, 3) TRUS points of the looks' arcs at the centre of the sensitivity prior, for window edges (S,)."""
    looks, radius = problem.looks, problem.radius_mm
    rotation = looks.centre_rad + looks.edge_gain * edge_rad[:, None]
    theta = looks.scan_rad + arc_of_rotation(rotation, looks.range_mm, radius)
    return np.stack(
        [
            np.broadcast_to(looks.x_mm, theta.shape),
            radius * np.sin(looks.scan_rad) + looks.range_mm * np.sin(theta),
            radius * np.cos(looks.scan_rad) + looks.range_mm * np.cos(theta),
        ],
        axis=-1,
    )
