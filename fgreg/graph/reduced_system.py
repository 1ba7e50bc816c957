"""The residuals of all shots in units of their standard deviations, and the private variables that fit them best.

How these are eliminated is described in fgreg.graph.reduced_graph.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fgreg.geometry.rig import CAMERA
from fgreg.geometry.transforms import FloatArray
from fgreg.graph.packing import BeamArrays, PackedProblem
from fgreg.graph.reduced_blocks import (
    Chart,
    Groups,
    PrivateState,
    Whitening,
    by_constants,
    cross,
    initial_private,
    inner,
    inverse3,
    line_block,
    look_columns,
    look_rows,
    outer,
    transposed,
)
from fgreg.graph.shared_state import SharedState
from fgreg.graph.visible_spots import spot_derivatives, spot_rows

DIVERGED_MM = 1.0
"""A PM that moves by more in one step, after several, does not converge."""


@dataclass(frozen=True, slots=True, eq=False)
class System:
    """Residuals in units of their standard deviations, and the normal equations of the PMs, at one linearisation point.

    S is the last dimension. Lines are the beams of the PMs, then those of the aims (n = B + A).

    Attributes:
        line: (n, 4, 2, S) residual and derivative by the point, camera axes, of points ``camera_p`` (n, 3, S).
        laser_p: (n, 3, S) those points in the chart's nominal frame. whitening: of the lines.
        beam_by_point: (B, 3, 2, S) derivative by the PM, TRUS axes.
        spot: (N, 3, S) residual of the visible spots. spot_by_point: (N, 3, 3, S) derivative by the PM, TRUS axes.
        by_turn: (n, 3, 2, S) derivative of the residuals by the markers' turns, mm per rad.
        look: (L, 3, 4 + K, S) residual, derivatives by the PM and by the constants that looks depend on (K = 0 where
            derivatives by shared variables are not wanted); ``look_raw`` the same in mm and rad.
        aim_residual_mm: (A, 2, S) in the chart's coordinates.
        point_step: (J, 3, S), point_covariance: (J, 3, 3, S).
        pm_cost: (J, S), aim_cost: (A, S).
    """

    beams: Groups
    looks: Groups
    spots: Groups
    line: FloatArray
    by_turn: FloatArray
    camera_p: FloatArray
    laser_p: FloatArray
    whitening: Whitening
    beam_by_point: FloatArray
    spot: FloatArray
    spot_by_point: FloatArray
    look: FloatArray
    look_raw: FloatArray
    aim_residual_mm: FloatArray
    point_covariance: FloatArray
    point_step: FloatArray
    pm_cost: FloatArray
    aim_cost: FloatArray
    private: PrivateState

    @property
    def moved_mm(self) -> FloatArray:
        """(J, S) how far the PMs move from the linearisation point."""
        return np.asarray(np.sqrt(np.einsum("nis,nis->ns", self.point_step, self.point_step)))


def system_at(
    problem: PackedProblem, state: SharedState, private: PrivateState, *, derivatives: bool = False
) -> System:
    pms, count = len(problem.pms), len(problem.beam_pm)
    chart = Chart.of(state)
    beams, looks = Groups.of(problem.beam_pm, pms), Groups.of(problem.look_pm, pms)
    points, shift = inner(private.trus_p_pm), inner(private.aim_shift)
    rotation, translation = inner(state.rotation), inner(state.translation_mm)
    if len(rotation) > 1:
        rotation, translation = rotation[problem.beam_epoch], translation[problem.beam_epoch]
    camera_p = np.einsum("nijs,nis->njs", rotation, beams.spread(points) - translation)
    markers, error = problem.beams, inner(private.beam_error)
    if len(shift):
        camera_p = np.concatenate([camera_p, problem.aim_spot_mm[..., None] + shift])
        markers, error = _joined(markers, problem.aims), np.concatenate([error, inner(private.aim_error)])
    block = line_block(markers, error, chart, camera_p)
    # The error of an aim's measured spot is eliminated like the marker's error.
    by_spot = block.rows[count:, 1:]
    spot_spread = _times_each(problem.aim_spot_covariance, by_spot)
    expected_shift = shift
    if len(shift):
        expected_shift = by_constants(problem.aim_spot_by_constants, chart)
        block.rows[count:, 0] -= np.einsum("niks,nis->nks", by_spot, shift - expected_shift)
        for place, (i, j) in enumerate(((0, 0), (0, 1), (1, 1))):
            block.covariance[count:, place] += np.einsum("nks,nks->ns", by_spot[:, :, i], spot_spread[:, :, j])
    whitening = Whitening.of(block.covariance)
    line = whitening.rows(block.rows)
    by_point = np.einsum("nijs,njks->niks", rotation, line[:count, 1:])

    look_raw = look_rows(problem, state, looks.spread(points), problem.columns.of_looks if derivatives else ())
    look = _times_each(_look_root(problem.looks.weight), look_raw)
    look_by_point, look_residual = look[:, :, 1:4], look[:, :, 0]

    h_pp = beams.sum(np.einsum("niks,njks->nijs", by_point, by_point))
    h_pp = h_pp + looks.sum(np.einsum("nkis,nkjs->nijs", look_by_point, look_by_point))
    b_p = beams.sum(np.einsum("niks,nks->nis", by_point, line[:count, 0]))
    b_p = b_p + looks.sum(np.einsum("nkis,nks->nis", look_by_point, look_residual))
    at = problem.spots.beam
    spots = Groups.of(problem.beam_pm[at], pms)
    turn = rotation[at] if len(rotation) > 1 else rotation
    spot, spot_by_point = spot_rows(problem.spots, camera_p[at], turn, chart.constants)
    if len(at):
        h_pp = h_pp + spots.sum(np.einsum("niks,njks->nijs", spot_by_point, spot_by_point))
        b_p = b_p + spots.sum(np.einsum("niks,nks->nis", spot_by_point, spot))
    point_covariance = inverse3(h_pp)
    point_step = -np.einsum("nijs,njs->nis", point_covariance, b_p)
    line_cost = np.einsum("nis,nis->ns", line[:, 0], line[:, 0])
    pm_cost = beams.sum(line_cost[:count]) + looks.sum(np.einsum("nks,nks->ns", look_residual, look_residual))
    pm_cost = pm_cost + np.einsum("nis,nis->ns", b_p, point_step)
    if len(at):
        pm_cost = pm_cost + spots.sum(np.einsum("nks,nks->ns", spot, spot))

    # Optimum of the private variables at these shared ones, as linearised here.
    updated = line[:, 0].copy()
    updated[:count] += np.einsum("niks,nis->nks", by_point, beams.spread(point_step))
    back = whitening.back(updated)
    error = -np.einsum("niks,nks->nis", block.spread, back)
    refined = PrivateState(
        trus_p_pm=outer(points + point_step),
        beam_error=outer(error[:count]),
        aim_error=outer(error[count:]),
        aim_shift=outer(expected_shift - np.einsum("niks,nks->nis", spot_spread, back[count:])),
    )
    return System(
        beams=beams,
        looks=looks,
        spots=spots,
        line=line,
        by_turn=block.by_turn,
        camera_p=camera_p,
        laser_p=block.laser_p,
        whitening=whitening,
        beam_by_point=by_point,
        spot=spot,
        spot_by_point=spot_by_point,
        look=look,
        look_raw=look_raw,
        aim_residual_mm=block.rows[count:, 0],
        point_covariance=point_covariance,
        point_step=point_step,
        pm_cost=pm_cost,
        aim_cost=line_cost[count:],
        private=refined,
    )


def _joined(first: BeamArrays, second: BeamArrays) -> BeamArrays:
    return BeamArrays(*(np.concatenate([getattr(first, name), getattr(second, name)]) for name in BeamArrays.__slots__))


def _times_each(matrix: FloatArray, values: FloatArray) -> FloatArray:
    """Products (n, i, ..., S) of matrices (n, i, j), the same for all hypotheses, with values (n, j, ..., S)."""
    flat = values.reshape(*values.shape[:2], math.prod(values.shape[2:]))
    return np.asarray((matrix @ flat).reshape(len(matrix), matrix.shape[1], *values.shape[2:]))


def _look_root(weight: FloatArray) -> FloatArray:
    """U (L, 3, 3) with ``U' U`` the weights, which couple x and range only."""
    root = np.zeros_like(weight)
    root[:, 0, 0] = np.sqrt(weight[:, 0, 0])
    root[:, 0, 1] = weight[:, 0, 1] / root[:, 0, 0]
    root[:, 1, 1] = np.sqrt(weight[:, 1, 1] - root[:, 0, 1] ** 2)
    root[:, 2, 2] = np.sqrt(weight[:, 2, 2])
    return root


def refine(problem: PackedProblem, state: SharedState, private: PrivateState) -> PrivateState:
    """The private variables after one step at fixed shared ones."""
    return system_at(problem, state, private).private


def private_at(problem: PackedProblem, state: SharedState) -> PrivateState:
    """The private variables at shared ones, from the arcs.

    From a far start a PM may converge to the far side of its arc, where it seems to fit; hence the start on the arcs.
    """
    private = initial_private(problem, state)
    for _ in range(3):
        private = refine(problem, state, private)
    return private


@dataclass(frozen=True, slots=True, eq=False)
class SharedDerivatives:
    """Derivatives of all residuals by the shared variables, in units of standard deviations.

    ``line`` (S, B + A, 2, D); ``spot`` (S, N, 3, D); ``h_ps`` (S, J, 3, D) of the PMs' normal equations,
    ``point_gain`` (S, J, 3, D) how the PMs move with the shared variables.
    """

    line: FloatArray
    spot: FloatArray
    h_ps: FloatArray
    point_gain: FloatArray


def shared_derivatives(problem: PackedProblem, state: SharedState, system: System) -> SharedDerivatives:
    columns, pms = problem.columns, len(problem.beam_pm)
    by_camera = system.line[:, 1:]
    lines = len(by_camera)
    line = np.zeros((state.count, lines, 2, columns.size))
    pose = np.empty((pms, 6, 2, state.count))
    pose[:, :3] = cross(by_camera[:pms], system.camera_p[:pms, :, None])
    np.negative(by_camera[:pms], out=pose[:, 3:])
    pose = pose.transpose(3, 0, 2, 1)
    for epoch in range(columns.epochs):
        mine = np.flatnonzero(problem.beam_epoch == epoch) if columns.epochs > 1 else slice(0, pms)
        line[:, mine, :, 6 * epoch : 6 * epoch + 6] = pose[:, mine]
    chart = np.zeros((lines, 4, 2, state.count))
    chart[:, 0, 0] = chart[:, 1, 1] = -1.0
    chart[:, 2, 0] = chart[:, 3, 1] = -system.laser_p[:, 2]
    line[..., columns.beam : columns.beam + 4] = system.whitening.rows(chart).transpose(3, 0, 2, 1)
    of_camera = columns.of_camera
    if of_camera:
        at = [constant - CAMERA.start for constant in of_camera]
        gain = np.concatenate([problem.beams.by_constants, problem.aims.by_constants])[..., at]
        turned, shifted = gain[:, :3].swapaxes(1, 2), gain[:, 3:].swapaxes(1, 2)
        moved = system.whitening.rows(_times_each(turned, system.by_turn)) - _times_each(shifted, by_camera)
        if lines > pms:
            moved[pms:] += _times_each(problem.aim_spot_by_constants[..., at].swapaxes(1, 2), by_camera[pms:])
        line[..., columns.size - len(of_camera) :] = moved.transpose(3, 0, 2, 1)
    h_ps = summed(system.beams, outer(system.beam_by_point) @ line[:, :pms])
    by_look = np.einsum("nkis,nkjs->nijs", system.look[:, :, 1:4], system.look[:, :, 4:])
    h_ps[..., look_columns(columns)] += outer(system.looks.sum(by_look))
    at_beam = problem.spots.beam
    spot = spot_derivatives(problem.spots, problem.beam_epoch[at_beam], system.camera_p[at_beam], columns)
    if len(at_beam):
        h_ps += summed(system.spots, outer(system.spot_by_point) @ spot)
    return SharedDerivatives(line, spot, h_ps, -outer(system.point_covariance) @ h_ps)


def summed(groups: Groups, values: FloatArray) -> FloatArray:
    """(S, n, ...) to (S, count, ...)."""
    return groups.sum(values.swapaxes(0, 1)).swapaxes(0, 1)


def stacked(left: FloatArray, right: FloatArray) -> FloatArray:
    """Sum over entries and rows of left' right, (S, n, k, a) and (S, n, k, b): one matrix product a hypothesis."""
    count, rows = left.shape[0], left.shape[1] * left.shape[2]
    return np.asarray(transposed(left.reshape(count, rows, left.shape[3])) @ right.reshape(count, rows, right.shape[3]))
