"""The marginal prior of the current epoch's shared variables, from all shots outside the active window.

It comes from the reduced graph (fgreg.graph.reduced_graph), in which the private variables are eliminated. The
registrations of earlier epochs are eliminated here by the Schur complement.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fgreg.geometry.transforms import FloatArray, inverse
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced_blocks import PrivateState, initial_private
from fgreg.graph.reduced_graph import Evaluation, evaluate
from fgreg.graph.reduced_system import refine
from fgreg.graph.shared_state import Quadratic, SharedState, one_epoch
from fgreg.model.measurements import EpochStart
from fgreg.model.systematic import TEXTS
from fgreg.smoother.shared_variables import small_step

PRIVATE_ROUNDS = 3
EARLIER_ROUNDS = 8
EARLIER_SETTLED = 1e-4
"""Newton decrement (chi square) below which the earlier registrations are at their optimum."""
WEAK_RAD, WEAK_MM = 1.0, 100.0
"""Sigmas of a weak prior on each earlier registration, about its estimate: few pairs do not determine it."""
DAMPING = 10.0
"""Factor on the weak prior's information after a step that does not lower the cost."""
FAR_RAD, FAR_MM, FAR_RATIO, FAR_PX = 2e-3, 0.2, 1e-3, 1.0
"""Steps of the estimate from the linearisation point beyond which a marginal prior is linearised again."""


def marginal_prior(problem: PackedProblem, state: SharedState) -> tuple[Quadratic, SharedState]:
    """Quadratic of a problem's shots, priors and links, with all registrations but the last epoch's eliminated.

    Args:
        problem: inliers only; its last epoch is the current one.
        state: one hypothesis of the problem's epochs.

    Returns:
        the prior about the state's last epoch, and the state with the earlier registrations at their optimum given the
        other shared variables.

    Raises:
        ArithmeticError: a number is not finite.
    """
    earlier = 6 * (problem.columns.epochs - 1)
    private = _settled(problem, state, initial_private(problem, state), PRIVATE_ROUNDS)
    at = evaluate(problem, state, private)
    if earlier:
        state, at = _earlier_settled(problem, state, at, earlier)
    hessian, gradient = at.hessian[0], at.gradient[0]
    cost = float(at.cost[0])
    if earlier:
        back = np.linalg.inv(hessian[:earlier, :earlier] + np.diag(_weak(earlier)))
        cross = hessian[:earlier, earlier:]
        hessian = hessian[earlier:, earlier:] - cross.T @ back @ cross
        cost -= float(gradient[:earlier] @ back @ gradient[:earlier])
        gradient = gradient[earlier:] - cross.T @ back @ gradient[:earlier]
        hessian = 0.5 * (hessian + hessian.T)
    if not (np.isfinite(cost) and np.isfinite(gradient).all() and np.isfinite(hessian).all()):
        raise ArithmeticError("the marginal prior is not finite")
    return Quadratic(one_epoch(state, -1), cost, gradient, hessian), state


def _settled(problem: PackedProblem, state: SharedState, private: PrivateState, rounds: int) -> PrivateState:
    with np.errstate(all="ignore"):  # numbers may overflow far from the optimum: the caller checks them
        for _ in range(rounds):
            private = refine(problem, state, private)
    return private


def _earlier_settled(
    problem: PackedProblem, state: SharedState, at: Evaluation, earlier: int
) -> tuple[SharedState, Evaluation]:
    """The problem with its first ``earlier`` columns, the earlier registrations, at their optimum given all else.

    Levenberg's steps: three or four pairs before an unreported camera move determine a registration so weakly that
    full steps diverge.
    """
    damping = 1.0
    for _ in range(EARLIER_ROUNDS):
        gradient = at.gradient[0, :earlier]
        damped = at.hessian[0, :earlier, :earlier] + np.diag(damping * _weak(earlier))
        step = np.zeros((1, problem.columns.size))
        step[0, :earlier] = -np.linalg.solve(damped, gradient)
        if float(-step[0, :earlier] @ gradient) < EARLIER_SETTLED:
            break
        there, then = _moved(problem, state, at, step)
        if then.cost[0] < at.cost[0]:
            state, at, damping = there, then, 1.0
        else:
            damping *= DAMPING
    return state, at


def _weak(earlier: int) -> FloatArray:
    """(earlier,) information of the weak prior."""
    return np.tile(np.repeat([WEAK_RAD**-2, WEAK_MM**-2], 3), earlier // 6)


def _moved(
    problem: PackedProblem, state: SharedState, at: Evaluation, step: FloatArray
) -> tuple[SharedState, Evaluation]:
    """The problem after a step of its shared variables."""
    points = at.private.trus_p_pm + (at.point_gain @ step[:, None, :, None])[..., 0]
    state = state.retract(step, problem.columns)
    private = _settled(problem, state, replace(at.private, trus_p_pm=points), 1)
    return state, evaluate(problem, state, private)


def has_moved(prior: Quadratic, state: SharedState, problem: PackedProblem) -> bool:
    """Whether the estimate is too far from a prior's linearisation point, so that it has to be linearised again.

    Only variables that the prior has information on count.
    """
    step = np.abs(small_step(prior.state, state, problem.columns))
    return bool(((step > _limits(problem)) & (np.diag(prior.hessian) > 0.0)).any())


def _limits(problem: PackedProblem) -> FloatArray:
    columns = problem.columns
    limits = np.full(columns.size, FAR_MM)
    limits[:3] = limits[columns.beam + 2 : columns.beam + 4] = FAR_RAD
    for place, constant in enumerate(columns.constants, columns.first_constant):
        text = TEXTS[constant]
        limits[place] = FAR_PX if text.unit == "px" else FAR_MM if text.unit == "mm" else FAR_RATIO
    return limits


def with_registrations(common: SharedState, each: list[SharedState]) -> SharedState:
    """The common variables of one state with the registrations of several states, in their order."""
    return replace(
        common,
        rotation=np.concatenate([one.rotation for one in each], axis=1),
        translation_mm=np.concatenate([one.translation_mm for one in each], axis=1),
    )


def carried_over(state: SharedState, start: EpochStart) -> SharedState:
    """The shared variables of a new epoch: the registration moved by the measured motion, unchanged without one."""
    motion = start.camera_new_T_camera_old
    if motion is None:
        return state
    moved = state.trus_T_camera()[0] @ inverse(motion)
    return replace(state, rotation=moved[None, None, :3, :3].copy(), translation_mm=moved[None, None, :3, 3].copy())
