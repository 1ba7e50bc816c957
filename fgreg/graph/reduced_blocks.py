"""Residuals of the reduced problem in blocks, and the private variables they are linearised at.

Shapes lead with S, the hypotheses side by side; see fgreg.graph.reduced for how the blocks are put together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fgreg.frames import FloatArray, IntArray, exp_so3, hat, make_transform
from fgreg.graph.packing import LINE_SIGMA_MM, BeamArrays, PackedProblem
from fgreg.graph.shared_state import SharedState
from fgreg.sensitivity import arc_of_rotation


@dataclass(frozen=True, slots=True, eq=False)
class PrivateState:
    """Estimates of the eliminated variables.

    PMs (S, J, 3) in TRUS mm; marker errors (w, n) of beams (S, B, 6) and of aims (S, A, 6); what the aimed-at spots are
    off their measured places, (S, A, 3) camera axes.
    """

    trus_p_pm: FloatArray
    beam_error: FloatArray
    aim_error: FloatArray
    aim_shift: FloatArray

    def take(self, index: Any) -> PrivateState:
        """The hypotheses at ``index`` (anything that indexes an array's first dimension)."""
        return PrivateState(*(getattr(self, name)[index] for name in self.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class LineBlock:
    across: FloatArray
    residual: FloatArray
    covariance: FloatArray
    marker_jacobian: FloatArray
    lambda_mm: FloatArray
    point_on_beam: FloatArray
    to_camera: FloatArray
    marker_rotation: FloatArray


def perpendicular_basis(direction: FloatArray) -> FloatArray:
    """Two unit columns across each unit direction: (..., 3) -> (..., 3, 2) (Duff et al., 2017)."""
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


def inverse2(matrix: FloatArray) -> FloatArray:
    """Inverses of symmetric (..., 2, 2) matrices."""
    a, b, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
    out = np.empty_like(matrix)
    det = a * d - b * b
    out[..., 0, 0], out[..., 1, 1] = d / det, a / det
    out[..., 0, 1] = out[..., 1, 0] = -b / det
    return out


def inverse3(matrix: FloatArray) -> FloatArray:
    """Inverses of (..., 3, 3) matrices by cofactors: many times faster than LAPACK one by one."""
    m = matrix
    out = np.empty_like(m)
    for i in range(3):
        for j in range(3):
            a, b, c, d = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            out[..., j, i] = m[..., a, c] * m[..., b, d] - m[..., a, d] * m[..., b, c]
    determinant = np.sum(m[..., 0, :] * out[..., :, 0], axis=-1)
    out /= determinant[..., None, None]
    return out


def sum_by(values: FloatArray, index: IntArray, groups: int) -> FloatArray:
    """Sum (S, n, ...) over entries of the same group: (S, groups, ...)."""
    if len(index) == groups and (index == np.arange(groups)).all():
        return values
    out = np.zeros((values.shape[0], groups, *values.shape[2:]))
    np.add.at(out.swapaxes(0, 1), index, values.swapaxes(0, 1))
    return out


def moved_markers(beams: BeamArrays, error: FloatArray, bias_mm: FloatArray) -> FloatArray:
    """(n, 4, 4) marker poses at errors (w, n) (n, 6) of their observations, one hypothesis, less the bias (3,).

    The marker moves by Exp of a twist about its observed origin: t + n + w x n / 2 to second order.
    """
    turn, shift = error[:, :3], error[:, 3:]
    translation = beams.translation_mm + shift + 0.5 * np.cross(turn, shift) - bias_mm
    return make_transform(exp_so3(turn) @ beams.rotation, translation)


def line_block(
    beams: BeamArrays,
    error: FloatArray,
    state: SharedState,
    points: FloatArray,
    rotation: FloatArray | None,
    translation_mm: FloatArray | None,
) -> LineBlock:
    """Two residuals across the beam for points (S, n, 3), in TRUS (with rotation, translation) or camera axes."""
    if not len(beams.rotation):
        return _no_lines(state.count)
    # The marker moves by Exp of a twist (w, n) about its observed origin: t + n + w x n / 2 to second order.
    half_turn = 0.5 * hat(error[..., :3])
    marker_rotation = exp_so3(error[..., :3]) @ beams.rotation
    origin = times(marker_rotation, state.beam_origin()[:, None, :])
    direction = times(marker_rotation, state.beam_direction()[:, None, :])
    marker_t = beams.translation_mm + error[..., 3:] + times(half_turn, error[..., 3:]) - state.bias_mm[:, None, :]
    if rotation is None or translation_mm is None:
        start, along = origin + marker_t, direction
    else:
        start, along = times(rotation, origin + marker_t) + translation_mm, times(rotation, direction)
    offset = points - start
    lambda_mm = np.sum(along * offset, axis=-1)
    basis = perpendicular_basis(along)
    residual = times(transposed(basis), offset)
    to_camera = transposed(basis) if rotation is None else transposed(basis) @ rotation
    from_marker = origin + lambda_mm[..., None] * direction
    jacobian = np.empty((*residual.shape, 6))
    turn = hat(from_marker)
    jacobian[..., :3] = to_camera @ (turn + turn @ half_turn + 0.5 * hat(error[..., 3:]))
    jacobian[..., 3:] = -to_camera @ (np.eye(3) + half_turn)
    covariance = jacobian @ beams.covariance @ transposed(jacobian)
    covariance[..., 0, 0] += LINE_SIGMA_MM**2
    covariance[..., 1, 1] += LINE_SIGMA_MM**2
    return LineBlock(
        across=basis,
        residual=residual - times(jacobian, error),
        covariance=covariance,
        marker_jacobian=jacobian,
        lambda_mm=lambda_mm,
        point_on_beam=from_marker + marker_t,
        to_camera=to_camera,
        marker_rotation=marker_rotation,
    )


def _no_lines(count: int) -> LineBlock:
    """Of no beams."""

    def none(*shape: int) -> FloatArray:
        return np.zeros((count, 0, *shape))

    return LineBlock(none(3, 2), none(2), none(2, 2), none(2, 6), none(), none(3), none(2, 3), none(3, 3))


def beam_columns(block: LineBlock, state: SharedState) -> FloatArray:
    """Derivative of the line residual by the beam chart: (S, n, 2, 4)."""
    r0 = state.marker_T_nominal[:, None, :3, :3]
    length = np.sqrt(1.0 + np.sum(state.beam[:, 2:] ** 2, axis=1))
    unit = np.concatenate([state.beam[:, 2:], np.ones((state.count, 1))], axis=1) / length[:, None]
    tilt = (np.eye(3) - unit[:, :, None] * unit[:, None, :])[:, :, :2] / length[:, None, None]
    turn = block.to_camera @ block.marker_rotation @ r0
    return -np.concatenate([turn[..., :2], block.lambda_mm[..., None, None] * (turn @ tilt[:, None])], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class LookBlock:
    """Residuals (S, L, 3) over (x, range, rotation), derivatives by the point (.., 3, 3) and the shared (.., 3, D)."""

    residual: FloatArray
    by_point: FloatArray
    by_shared: FloatArray


def look_block(problem: PackedProblem, state: SharedState, points: FloatArray) -> LookBlock:
    """Looks against the points (S, L, 3), TRUS mm."""
    looks, columns = problem.looks, problem.columns
    radius = state.radius_mm[:, None]
    ratio = state.sound_speed_ratio[:, None]
    sin_scan, cos_scan = np.sin(looks.scan_rad), np.cos(looks.scan_rad)
    dy = points[..., 1] - radius * sin_scan
    dz = points[..., 2] - radius * cos_scan
    distance = np.maximum(np.hypot(dy, dz), 1e-9)
    sin_theta, cos_theta = dy / distance, dz / distance
    sin_delta = sin_theta * cos_scan - cos_theta * sin_scan
    cos_delta = cos_theta * cos_scan + sin_theta * sin_scan
    heard = ratio * looks.range_mm
    rotation = np.arctan2(heard * sin_delta, radius + heard * cos_delta)
    square = radius**2 + heard**2 + 2.0 * radius * heard * cos_delta
    per_delta = heard * (heard + radius * cos_delta) / square
    per_range = radius * sin_delta / square

    residual = np.empty((*distance.shape, 3))
    residual[..., 0] = points[..., 0] - looks.x_mm
    residual[..., 1] = distance - heard
    residual[..., 2] = rotation - looks.centre_rad - looks.edge_gain * state.edge_rad[:, None]

    by_point = np.zeros((*distance.shape, 3, 3))
    by_point[..., 0, 0] = 1.0
    by_point[..., 1, 1], by_point[..., 1, 2] = sin_theta, cos_theta
    by_point[..., 2, 1] = per_delta * cos_theta / distance
    by_point[..., 2, 2] = -per_delta * sin_theta / distance

    by_shared = np.zeros((*distance.shape, 3, columns.size))
    by_shared[..., 2, columns.edge] = -looks.edge_gain
    if columns.sound_speed is not None:
        by_shared[..., 1, columns.sound_speed] = -looks.range_mm
        by_shared[..., 2, columns.sound_speed] = per_range * looks.range_mm
    if columns.radius is not None:
        # Moving the elements outwards by dR moves the arc's centre along the plane: range and theta' both change.
        by_shared[..., 1, columns.radius] = -cos_delta
        by_shared[..., 2, columns.radius] = per_delta * sin_delta / distance - heard * sin_delta / square
    return LookBlock(residual, by_point, by_shared)


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
