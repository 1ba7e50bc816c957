"""The graph with everything private eliminated in closed form, for many hypotheses at once.

Private to a PM are its point, lambda and theta' of each look, and the marker pose of each beam. Given the shared
variables (registration, beam, window edge, ...) they enter through small blocks:

- point on line, lambda free: two residuals across the beam, ``N' (trus_p_pm - beam)``. The marker pose's error
  (w, n) has a Gaussian prior and enters linearly around its current estimate, so eliminating it leaves the same
  residual, shifted, with covariance ``J Sigma J'`` (the update of an iterated Kalman filter). The estimate is
  refreshed at every evaluation, so the fixed point is the optimum of the explicit graph, not of a linearised one.
- point on arc, theta' free, and the sensitivity prior: three residuals (x, range, rotation offset) in the point.
- the point itself: a 3 x 3 Schur complement.

What is left is a normal system on the shared variables, dense and small, built by vectorised numpy: linear in the
number of pairs, and with a leading dimension S so that all starts (or posterior samples) go in one call. Costs are
chi squares (twice the negative log of the density). Same optimum as fgreg.graph, which is the reference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgreg.frames import FloatArray, hat, log_so3
from fgreg.graph.packing import EpochLink, PackedProblem
from fgreg.graph.reduced_blocks import (
    LineBlock,
    LookBlock,
    PrivateState,
    beam_columns,
    inverse2,
    inverse3,
    line_block,
    look_block,
    sum_by,
    times,
    transposed,
)
from fgreg.graph.shared_state import SharedState, step_between
from fgreg.graph.windows import log_shape_ratios


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """The reduced problem at a state.

    Attributes:
        cost: (S,) chi square, private variables at their (linearised) optimum.
        gradient: (S, D), hessian: (S, D, D): of half the cost.
        private: private variables after this evaluation's refinement, at the *same* shared variables.
        point_gain: (S, J, 3, D): how the PMs move with the shared variables.
        point_covariance: (S, J, 3, 3): of the PMs given the shared variables.
        line_residual (S, B, 2) mm, line_covariance (S, B, 2, 2), lambda_mm (S, B).
        look_residual: (S, L, 3) over (x mm, range mm, rotation rad).
        aim_residual (S, A, 2) mm, aim_covariance (S, A, 2, 2), aim_lambda_mm (S, A).
    """

    cost: FloatArray
    gradient: FloatArray
    hessian: FloatArray
    private: PrivateState
    point_gain: FloatArray
    point_covariance: FloatArray
    line_residual: FloatArray
    line_covariance: FloatArray
    lambda_mm: FloatArray
    look_residual: FloatArray
    aim_residual: FloatArray
    aim_covariance: FloatArray
    aim_lambda_mm: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _System:
    """Residuals, weights and the normal equations of the PMs at one linearisation point."""

    line: LineBlock
    line_weight: FloatArray
    look: LookBlock
    aim: LineBlock
    aim_covariance: FloatArray
    aim_weight: FloatArray
    h_pp: FloatArray
    b_p: FloatArray
    point_covariance: FloatArray
    point_step: FloatArray
    pm_cost: FloatArray
    aim_cost: FloatArray
    prior_cost: FloatArray
    private: PrivateState

    @property
    def cost(self) -> FloatArray:
        """(S,) chi square of everything."""
        return np.asarray(self.pm_cost.sum(axis=1) + self.aim_cost.sum(axis=1) + self.prior_cost)


def _system(problem: PackedProblem, state: SharedState, private: PrivateState) -> _System:
    pms = len(problem.pms)
    epoch = problem.beam_epoch
    line = line_block(
        problem.beams,
        private.beam_error,
        state,
        private.trus_p_pm[:, problem.beam_pm],
        state.rotation[:, epoch],
        state.translation_mm[:, epoch],
    )
    line_weight = inverse2(line.covariance)
    line_weighted = times(line_weight, line.residual)
    look = look_block(problem, state, private.trus_p_pm[:, problem.look_pm])
    look_weight = problem.looks.weight
    look_weighted = times(look_weight, look.residual)
    look_by_point_t = transposed(look.by_point)
    h_pp = sum_by(line.across @ line_weight @ transposed(line.across), problem.beam_pm, pms)
    h_pp = h_pp + sum_by(look_by_point_t @ look_weight @ look.by_point, problem.look_pm, pms)
    b_p = sum_by(times(line.across, line_weighted), problem.beam_pm, pms)
    b_p = b_p + sum_by(times(look_by_point_t, look_weighted), problem.look_pm, pms)
    point_covariance = inverse3(h_pp)
    point_step = -times(point_covariance, b_p)

    aim = line_block(problem.aims, private.aim_error, state, problem.aim_spot_mm + private.aim_shift, None, None)
    aim = replace(aim, residual=aim.residual - times(transposed(aim.across), private.aim_shift))
    aim_spread = problem.aim_spot_covariance @ aim.across
    aim_covariance = aim.covariance + transposed(aim.across) @ aim_spread
    aim_weight = inverse2(aim_covariance)
    aim_weighted = times(aim_weight, aim.residual)

    pm_cost = sum_by(np.sum(line.residual * line_weighted, axis=-1), problem.beam_pm, pms)
    pm_cost = pm_cost + sum_by(np.sum(look.residual * look_weighted, axis=-1), problem.look_pm, pms)
    pm_cost = pm_cost + np.sum(b_p * point_step, axis=-1)

    # The private variables' optimum at these shared ones, as linearised here.
    line_update = line.residual + times(transposed(line.across), point_step[:, problem.beam_pm])
    beam_error = -times(problem.beams.covariance @ transposed(line.marker_jacobian), times(line_weight, line_update))
    aim_error = -times(problem.aims.covariance @ transposed(aim.marker_jacobian), aim_weighted)
    aim_shift = -times(aim_spread, aim_weighted)
    return _System(
        line=line,
        line_weight=line_weight,
        look=look,
        aim=aim,
        aim_covariance=aim_covariance,
        aim_weight=aim_weight,
        h_pp=h_pp,
        b_p=b_p,
        point_covariance=point_covariance,
        point_step=point_step,
        pm_cost=pm_cost,
        aim_cost=np.sum(aim.residual * aim_weighted, axis=-1),
        prior_cost=_prior_cost(problem, state),
        private=PrivateState(private.trus_p_pm + point_step, beam_error, aim_error, aim_shift),
    )


def refine(problem: PackedProblem, state: SharedState, private: PrivateState) -> tuple[FloatArray, PrivateState]:
    """One step of the private variables at fixed shared ones: the cost (S,) and the private variables after it."""
    system = _system(problem, state, private)
    return system.cost, system.private


def log_posterior(problem: PackedProblem, state: SharedState, private: PrivateState) -> FloatArray:
    """Log density (S,) of the shared variables, up to a constant.

    Private variables: at their optimum, ``-cost / 2``. Not integrated out with flat priors, which would multiply the
    density by the volume they are free in, and so by how steeply beams happen to cross arcs: as in straight line fits
    with errors in both coordinates that estimate is inconsistent (Neyman and Scott, 1948; Kendall and Stuart, vol. 2,
    ch. 29), the one with the private variables at their optimum is not. Where the problem keeps the windows' own
    shapes, the PMs' rotations are integrated over them (fgreg.graph.windows). Where it doubts PMs, each is either good,
    or junk of the density given: the sum of both.
    """
    system = _system(problem, state, private)
    pms = _log_shapes(problem, state, system) - 0.5 * system.pm_cost
    if problem.log_junk is not None:
        pms = np.logaddexp(pms, problem.log_junk)
    return np.asarray(pms.sum(axis=1) - 0.5 * (system.aim_cost.sum(axis=1) + system.prior_cost))


def _log_shapes(problem: PackedProblem, state: SharedState, system: _System) -> FloatArray:
    """(S, J) log of what the windows' own shapes make of the Gaussian stand-ins' density of each PM."""
    if problem.shapes is None:
        return np.zeros((state.count, len(problem.pms)))
    by_point = system.look.by_point[..., 2, :]
    offset = system.look.residual[..., 2] + np.sum(by_point * system.point_step[:, problem.look_pm], axis=-1)
    variance = np.sum(by_point * times(system.point_covariance[:, problem.look_pm], by_point), axis=-1)
    return log_shape_ratios(problem, state.edge_rad, offset, variance)


@dataclass(frozen=True, slots=True, eq=False)
class _SharedDerivatives:
    """Derivatives of all residuals by the shared variables (.., D), and how the PMs move with them (S, J, 3, D)."""

    line: FloatArray
    aim: FloatArray
    h_ps: FloatArray
    point_gain: FloatArray


def _shared_derivatives(problem: PackedProblem, state: SharedState, system: _System) -> _SharedDerivatives:
    columns, size = problem.columns, problem.columns.size
    count, pms = state.count, len(problem.pms)
    line, look = system.line, system.look
    by_shared = np.zeros((count, len(problem.beam_pm), 2, size))
    pose = np.concatenate([line.to_camera @ hat(line.point_on_beam), -line.to_camera], axis=-1)
    for epoch in range(columns.epochs):
        mine = problem.beam_epoch == epoch
        by_shared[:, mine, :, 6 * epoch : 6 * epoch + 6] = pose[:, mine]
    aim_by_shared = np.zeros((count, len(problem.aims.rotation), 2, size))
    for block, columns_of in ((line, by_shared), (system.aim, aim_by_shared)):
        if not columns_of.shape[1]:
            continue
        columns_of[..., columns.beam : columns.beam + 4] = beam_columns(block, state)
        if columns.bias is not None:
            columns_of[..., columns.bias : columns.bias + 3] = block.to_camera
    h_ps = sum_by(line.across @ (system.line_weight @ by_shared), problem.beam_pm, pms)
    h_ps = h_ps + sum_by(transposed(look.by_point) @ (problem.looks.weight @ look.by_shared), problem.look_pm, pms)
    return _SharedDerivatives(by_shared, aim_by_shared, h_ps, -system.point_covariance @ h_ps)


@dataclass(frozen=True, slots=True, eq=False)
class Contributions:
    """What n parts add to the reduced problem: cost (S, n), gradient (S, n, D), hessian (S, n, D, D)."""

    cost: FloatArray
    gradient: FloatArray
    hessian: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """The reduced problem at S hypotheses, taken apart: what each PM, each aim and the priors (n = 1) add.

    ``private`` and ``point_gain`` are as in :class:`Evaluation`.
    """

    pm: Contributions
    aim: Contributions
    prior: Contributions
    private: PrivateState
    point_gain: FloatArray


def contributions(problem: PackedProblem, state: SharedState, private: PrivateState) -> Parts:
    """:func:`evaluate`, but not summed: the terms of the sum."""
    pms, size = len(problem.pms), problem.columns.size
    system = _system(problem, state, private)
    by = _shared_derivatives(problem, state, system)
    line, look, aim = system.line, system.look, system.aim
    line_t, look_t = transposed(system.line_weight @ by.line), transposed(problem.looks.weight @ look.by_shared)
    hessian = sum_by(line_t @ by.line, problem.beam_pm, pms) + sum_by(look_t @ look.by_shared, problem.look_pm, pms)
    hessian = hessian + transposed(by.h_ps) @ by.point_gain
    gradient = sum_by(times(line_t, line.residual), problem.beam_pm, pms)
    gradient = gradient + sum_by(times(look_t, look.residual), problem.look_pm, pms)
    gradient = gradient + times(transposed(by.h_ps), system.point_step)
    aim_weighted = times(system.aim_weight, aim.residual)
    aim_t = transposed(by.aim)
    prior_gradient, prior_hessian = np.zeros((state.count, size)), np.zeros((state.count, size, size))
    _add_priors(problem, state, prior_gradient, prior_hessian)
    return Parts(
        pm=Contributions(system.pm_cost, gradient, hessian),
        aim=Contributions(system.aim_cost, times(aim_t, aim_weighted), aim_t @ system.aim_weight @ by.aim),
        prior=Contributions(system.prior_cost[:, None], prior_gradient[:, None], prior_hessian[:, None]),
        private=system.private,
        point_gain=by.point_gain,
    )


def pm_contributions(problem: PackedProblem, state: SharedState, private: PrivateState) -> Contributions:
    """What each PM adds, for a state of one hypothesis: cost (J,), gradient (J, D), hessian (J, D, D)."""
    parts = contributions(problem, state, private).pm
    return Contributions(parts.cost[0], parts.gradient[0], parts.hessian[0])


def evaluate(problem: PackedProblem, state: SharedState, private: PrivateState) -> Evaluation:
    """Cost, gradient and Gauss-Newton Hessian on the shared variables, private ones eliminated.

    Args:
        problem: the packed measurements.
        state: S hypotheses.
        private: where the private variables are linearised; refined once here (returned in ``private``).
    """
    system = _system(problem, state, private)
    by = _shared_derivatives(problem, state, system)
    line, look, aim = system.line, system.look, system.aim
    weighted = system.line_weight @ by.line
    look_weighted = problem.looks.weight @ look.by_shared
    aim_weighted = system.aim_weight @ by.aim
    hessian = _stacked(by.line, weighted) + _stacked(look.by_shared, look_weighted)
    hessian += _stacked(by.h_ps, by.point_gain) + _stacked(by.aim, aim_weighted)
    gradient = _stacked(weighted, line.residual[..., None]) + _stacked(look_weighted, look.residual[..., None])
    gradient += _stacked(by.h_ps, system.point_step[..., None])
    gradient += _stacked(aim_weighted, aim.residual[..., None])
    gradient = gradient[..., 0]
    _add_priors(problem, state, gradient, hessian)
    return Evaluation(
        cost=system.cost,
        gradient=gradient,
        hessian=hessian,
        private=system.private,
        point_gain=by.point_gain,
        point_covariance=system.point_covariance,
        line_residual=line.residual,
        line_covariance=line.covariance,
        lambda_mm=line.lambda_mm,
        look_residual=look.residual,
        aim_residual=aim.residual,
        aim_covariance=system.aim_covariance,
        aim_lambda_mm=aim.lambda_mm,
    )


def _stacked(left: FloatArray, right: FloatArray) -> FloatArray:
    """Sum over entries and rows of left' right, (S, n, k, a) and (S, n, k, b): one matrix product a hypothesis."""
    count, rows = left.shape[0], left.shape[1] * left.shape[2]
    return np.asarray(transposed(left.reshape(count, rows, left.shape[3])) @ right.reshape(count, rows, right.shape[3]))


def _prior_deviation(problem: PackedProblem, state: SharedState) -> FloatArray:
    """(S, D) shared variables less their prior means, zero where there is no prior."""
    columns = problem.columns
    deviation = np.zeros((state.count, columns.size))
    deviation[:, columns.edge] = state.edge_rad
    if columns.bias is not None:
        deviation[:, columns.bias : columns.bias + 3] = state.bias_mm
    if columns.sound_speed is not None:
        deviation[:, columns.sound_speed] = state.sound_speed_ratio - problem.sound_speed_mean
    if columns.radius is not None:
        deviation[:, columns.radius] = state.radius_mm - problem.radius_mm
    return deviation


def _prior_cost(problem: PackedProblem, state: SharedState) -> FloatArray:
    cost = np.sum(problem.prior_information * _prior_deviation(problem, state) ** 2, axis=1)
    for link in problem.links:
        residual, _ = _link_residual(link, state)
        cost = cost + np.sum(residual * (residual @ link.information), axis=1)
    if problem.anchor is not None:
        step = step_between(problem.anchor.state, state, problem.columns)
        cost = cost + np.sum(step * (step @ problem.anchor.information), axis=1)
    return np.asarray(cost)


def _add_priors(problem: PackedProblem, state: SharedState, gradient: FloatArray, hessian: FloatArray) -> None:
    """Gaussian priors of the shared variables and links between epochs, added in place."""
    gradient += problem.prior_information * _prior_deviation(problem, state)
    diagonal = np.arange(problem.columns.size)
    hessian[:, diagonal, diagonal] += problem.prior_information
    for link in problem.links:
        residual, jacobian = _link_residual(link, state)
        weighted = link.information @ jacobian
        columns = np.r_[6 * link.old : 6 * link.old + 6, 6 * link.new : 6 * link.new + 6]
        hessian[:, columns[:, None], columns] += transposed(jacobian) @ weighted
        gradient[:, columns] += times(transposed(weighted), residual)
    if problem.anchor is not None:
        hessian += problem.anchor.information
        gradient += step_between(problem.anchor.state, state, problem.columns) @ problem.anchor.information


def _link_residual(link: EpochLink, state: SharedState) -> tuple[FloatArray, FloatArray]:
    """Error (S, 6) on the right of ``old_T_new`` in ``new = old * old_T_new``, and its derivative (S, 6, 12)."""
    old, new, new_R_old = link.old, link.new, link.old_T_new[:3, :3].T
    back = transposed(state.rotation[:, old])
    relative_R = back @ state.rotation[:, new]
    relative_t = times(back, state.translation_mm[:, new] - state.translation_mm[:, old])
    turn = log_so3(new_R_old @ relative_R)
    residual = np.concatenate([turn, times(new_R_old, relative_t - link.old_T_new[:3, 3])], axis=1)
    by_turn = np.eye(3) + 0.5 * hat(turn)  # inverse right Jacobian of SO(3), to first order in the error
    jacobian = np.zeros((state.count, 6, 12))
    jacobian[:, :3, :3] = -by_turn @ transposed(relative_R)
    jacobian[:, 3:, :3] = new_R_old @ hat(relative_t)
    jacobian[:, 3:, 3:6] = -new_R_old
    jacobian[:, :3, 6:9] = by_turn
    jacobian[:, 3:, 9:] = new_R_old @ relative_R
    return residual, jacobian
