"""Terms of the shared variables alone: constants, anchor, known points, and the links between epochs."""

from __future__ import annotations

import numpy as np

from fgreg.geometry.transforms import FloatArray, hat, log_so3
from fgreg.graph.known_points import point_cost, point_terms
from fgreg.graph.packing import EpochLink, PackedProblem
from fgreg.graph.reduced_blocks import times, transposed
from fgreg.graph.shared_state import SharedState, step_between


def _prior_deviation(problem: PackedProblem, state: SharedState) -> FloatArray:
    """(S, K) constants that are variables, less their prior means."""
    return np.asarray(state.constants[:, problem.columns.constants] - problem.prior.mean)


def prior_cost(problem: PackedProblem, state: SharedState) -> FloatArray:
    """(S,) chi square of the priors, of the known points and of the links between epochs."""
    deviation = _prior_deviation(problem, state)
    cost = np.sum(deviation * (deviation @ problem.prior.information), axis=1)
    for link in problem.links:
        residual, _ = _link_residual(link, state)
        cost = cost + np.sum(residual * (residual @ link.information), axis=1)
    if problem.anchor is not None:
        anchor, step = problem.anchor, step_between(problem.anchor.state, state, problem.columns)
        cost = cost + anchor.cost + np.sum(step * (2.0 * anchor.gradient + step @ anchor.hessian), axis=1)
    if len(problem.points):
        cost = cost + point_cost(problem.points, state).sum(axis=1)
    return np.asarray(cost)


def prior_terms(problem: PackedProblem, state: SharedState) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The same cost (S,), and gradient (S, D) and Hessian (S, D, D) of half of it."""
    rig, size = problem.columns.rig, problem.columns.size
    gradient, hessian = np.zeros((state.count, size)), np.zeros((state.count, size, size))
    deviation = _prior_deviation(problem, state)
    gradient[:, rig] = deviation @ problem.prior.information
    hessian[:, rig, rig] = problem.prior.information
    cost = np.sum(deviation * gradient[:, rig], axis=1)
    for link in problem.links:
        residual, jacobian = _link_residual(link, state)
        weighted = link.information @ jacobian
        columns = np.r_[6 * link.old : 6 * link.old + 6, 6 * link.new : 6 * link.new + 6]
        hessian[:, columns[:, None], columns] += transposed(jacobian) @ weighted
        gradient[:, columns] += times(transposed(weighted), residual)
        cost = cost + np.sum(residual * (residual @ link.information), axis=1)
    if problem.anchor is not None:
        anchor, step = problem.anchor, step_between(problem.anchor.state, state, problem.columns)
        pull = step @ anchor.hessian
        hessian += anchor.hessian
        gradient += anchor.gradient + pull
        cost = cost + anchor.cost + np.sum(step * (2.0 * anchor.gradient + pull), axis=1)
    if len(problem.points):
        terms = point_terms(problem.points, state, problem.columns)
        gradient += terms.gradient.sum(axis=1)
        hessian += terms.hessian.sum(axis=1)
        cost = cost + terms.cost.sum(axis=1)
    return cost, gradient, hessian


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
