"""Levenberg-Marquardt on the reduced problem, from many starts in parallel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from fgreg.geometry.transforms import BoolArray, IntArray
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced_blocks import PrivateState
from fgreg.graph.reduced_graph import Evaluation, Loss, evaluate, least_squares
from fgreg.graph.reduced_system import private_at, refine
from fgreg.graph.shared_state import SharedState, step_between

WEIGHT_FLOOR = 1e-12
"""Curvature added to shared variables that no measurement observes (a registration without pairs): they do not move."""


LONG_STEP = 0.1
"""Newton decrement (chi square) above which the private variables are refined before a step is accepted or rejected."""
STALLED = 1e-6
"""Newton decrement (chi square) at which a step without gain is the last: the private variables lag by as much."""
CREEPING = 30.0
"""Bound on the gain of all following steps, as a multiple of the gain that one step predicts."""


@dataclass(frozen=True, slots=True, eq=False)
class Optimum:
    """Result of :func:`optimize`: S hypotheses, each at its own local minimum, with its evaluation there."""

    state: SharedState
    evaluation: Evaluation
    converged: BoolArray
    iterations: int

    def take(self, index: int) -> Optimum:
        """One of the hypotheses."""
        one = [index]
        return Optimum(self.state.take(one), self.evaluation.take(one), self.converged[one], self.iterations)


def optimize(
    problem: PackedProblem,
    state: SharedState,
    private: PrivateState | None = None,
    *,
    max_iterations: int = 60,
    tolerance: float = 1e-6,
    keep_within: float | None = None,
    wanted: float = np.inf,
    loss: Loss = least_squares,
    start: Evaluation | None = None,
) -> Optimum:
    """Levenberg-Marquardt on the shared variables, all hypotheses in parallel.

    Args:
        problem: the packed measurements.
        state: S starts.
        private: first linearisation point of the private variables; from the arcs where None.
        max_iterations: of the outer loop.
        tolerance: a hypothesis has converged when the Newton decrement (in chi square) falls below this; the default is
            a thousandth of a standard deviation.
        keep_within: hypotheses whose cost exceeds the best converged one by more than this are stopped.
        wanted: hypotheses whose cost cannot fall below this are stopped.
        loss: of each PM's and aim's chi square (iteratively reweighted least squares).
        start: the evaluation at the starts, if there is one.
    """
    current = start
    if current is None:
        current = evaluate(problem, state, private_at(problem, state) if private is None else private, loss)
    count = state.count
    damping = np.full(count, 1e-4)
    active = np.ones(count, dtype=bool)
    iteration = 0
    for iteration in range(1, max_iterations + 1):  # noqa: B007
        index = np.flatnonzero(active)
        here_h, here_g = current.hessian[index], current.gradient[index]
        diagonal = np.arange(here_h.shape[1])
        damped = here_h.copy()
        damped[:, diagonal, diagonal] *= 1.0 + damping[index, None]
        damped[:, diagonal, diagonal] += WEIGHT_FLOOR
        step = np.asarray(-np.linalg.solve(damped, here_g[..., None])[..., 0], dtype=np.float64)
        decrement = -np.sum(step * here_g, axis=1)
        moved = state.take(index).retract(step, problem.columns)
        before = current.private.take(index)
        points = before.trus_p_pm + (current.point_gain[index] @ step[:, None, :, None])[..., 0]
        ahead = replace(before, trus_p_pm=points)
        if decrement.max() > LONG_STEP:
            ahead = refine(problem, moved, ahead)
        trial = evaluate(problem, moved, ahead, loss)
        good = np.isfinite(trial.cost) & (trial.cost <= current.cost[index] + 1e-9 * (1.0 + current.cost[index]))
        stalled = (decrement < STALLED) & (trial.cost >= current.cost[index])
        if len(index) == count and good.all():
            state, current = moved, trial
        elif good.any():
            state, current = _merged(state, moved, index[good], good), _merged(current, trial, index[good], good)
        damping[index] = np.clip(np.where(good, damping[index] * 0.1, damping[index] * 8.0), 1e-9, 1e12)
        active[index[(good & (decrement < tolerance)) | stalled | (damping[index] > 1e9)]] = False
        hopeless = current.cost[index] - CREEPING * np.maximum(decrement, 0.0) > wanted
        active[index[good & hopeless]] = False
        if keep_within is not None and not active.all():
            active &= current.cost <= current.cost[~active].min() + keep_within
        if not active.any():
            break
    return Optimum(state, current, ~active, iteration)


def distinct(problem: PackedProblem, state: SharedState, at: Evaluation) -> IntArray:
    """Indices of distinct hypotheses, best first: none is within a standard deviation of a better one."""
    left, chosen = np.argsort(at.cost), []
    while len(left):
        best = int(left[0])
        chosen.append(best)
        others = state.take(left)
        step = step_between(state.take([best]), others, problem.columns)
        near = np.einsum("sa,ab,sb->s", step, at.hessian[best], step) < 1.0
        same_chart = (others.marker_T_nominal == state.marker_T_nominal[best]).all(axis=(1, 2))
        left = left[1:][~(near & same_chart)[1:]]  # without the best one itself, also where its numbers are not finite
    return np.array(chosen)


T = TypeVar("T")


def _merged(old: T, new: T, rows: IntArray, good: BoolArray) -> T:
    """``old`` with its ``rows`` replaced by those of ``new`` that are ``good``; dataclasses of arrays (S, ...)."""
    out = {}
    for name in old.__slots__:  # type: ignore[attr-defined]
        value, other = getattr(old, name), getattr(new, name)
        if isinstance(value, np.ndarray):
            out[name] = value.copy()
            out[name][rows] = other[good]
        else:
            out[name] = _merged(value, other, rows, good)
    return type(old)(**out)
