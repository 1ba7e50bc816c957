"""Levenberg-Marquardt on the reduced problem, many starts side by side."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgreg.frames import BoolArray, FloatArray, IntArray
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced import Evaluation, evaluate, refine
from fgreg.graph.reduced_blocks import PrivateState, initial_private
from fgreg.graph.shared_state import SharedState

WEIGHT_FLOOR = 1e-12
"""Curvature lent to shared variables that nothing observes (a registration without pairs): they stay where they are."""


CREEPING = 10.0
"""At most so many times what one step promised is what all the steps after it may still gain."""


@dataclass(frozen=True, slots=True, eq=False)
class Optimum:
    """Result of :func:`optimize`: S hypotheses, each at its own local minimum, with its evaluation there."""

    state: SharedState
    evaluation: Evaluation
    converged: BoolArray
    iterations: int


def optimize(
    problem: PackedProblem,
    state: SharedState,
    private: PrivateState | None = None,
    *,
    max_iterations: int = 60,
    tolerance: float = 1e-6,
    keep_within: float | None = None,
    best_cost: float = np.inf,
) -> Optimum:
    """Levenberg-Marquardt on the shared variables, all hypotheses side by side.

    Args:
        problem: the packed measurements.
        state: S starts.
        private: where to linearise the private variables first; from the arcs where None.
        max_iterations: of the outer loop.
        tolerance: a hypothesis has converged when the Newton decrement (in chi square) falls below this; the default is
            a thousandth of a standard deviation.
        keep_within: stop early on hypotheses whose cost exceeds the best converged one by more than this.
        best_cost: a cost that is known to be reached otherwise: hypotheses that will not come to within ``keep_within``
            of it are left where they are.
    """
    if private is None:
        private = initial_private(problem, state)
        for _ in range(3):
            _, private = refine(problem, state, private)
    current = evaluate(problem, state, private)
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
        _, ahead = refine(problem, moved, replace(before, trus_p_pm=points))
        trial = evaluate(problem, moved, ahead)
        good = np.isfinite(trial.cost) & (trial.cost <= current.cost[index] + 1e-9 * (1.0 + current.cost[index]))
        if len(index) == count and good.all():
            state, current = moved, trial
        elif good.any():
            state = _merge_state(state, moved, index, good)
            current = _merge_evaluation(current, trial, index, good)
        damping[index] = np.clip(np.where(good, damping[index] * 0.1, damping[index] * 8.0), 1e-9, 1e12)
        active[index[(good & (decrement < tolerance)) | (damping[index] > 1e9)]] = False
        if keep_within is not None:
            if not active.all():
                active &= current.cost <= current.cost[~active].min() + keep_within
            hopeless = current.cost[index] - CREEPING * np.maximum(decrement, 0.0) > best_cost + keep_within
            active[index[good & hopeless]] = False
        if not active.any():
            break
    return Optimum(state, current, ~active, iteration)


def _replace_rows(old: FloatArray, new: FloatArray, rows: IntArray, good: BoolArray) -> FloatArray:
    out = old.copy()
    out[rows[good]] = new[good]
    return out


def _merge_state(old: SharedState, new: SharedState, rows: IntArray, good: BoolArray) -> SharedState:
    """``old`` with its ``rows`` replaced by those of ``new`` that are ``good``."""
    return SharedState(
        *(_replace_rows(getattr(old, name), getattr(new, name), rows, good) for name in SharedState.__slots__)
    )


def _merge_evaluation(old: Evaluation, new: Evaluation, rows: IntArray, good: BoolArray) -> Evaluation:
    arrays = {
        name: _replace_rows(getattr(old, name), getattr(new, name), rows, good)
        for name in Evaluation.__slots__
        if name != "private"
    }
    private = PrivateState(
        *(
            _replace_rows(getattr(old.private, name), getattr(new.private, name), rows, good)
            for name in PrivateState.__slots__
        )
    )
    return Evaluation(private=private, **arrays)
