"""Levenberg-Marquardt on the explicit graph.

The loop is our own, over ``graph.linearize(values)`` with values that Python holds: inside GTSAM's optimizers each
callback of a Python factor copies all values, which makes one linearisation quadratic in the number of pairs.

Elimination is by QR. GTSAM's Cholesky calls a variable undetermined when the last two diagonal entries of its factor
differ by 2^12; constraints of 1e-3 mm next to noise of some tenths do that in well-posed problems. QR takes about 1.6
times as long.

Costs are GTSAM's, half the chi square.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import gtsam
import numpy as np

from fgreg.factors.adapter import FactorError
from fgreg.graph.gtsam_graph import ExplicitGraph, Variable
from fgreg.graph.gtsam_values import made_consistent

_FIRST_DAMPING, _LEAST_DAMPING, _LARGEST_DAMPING = 1e-3, 1e-12, 1e12

_SCALE: dict[Variable, tuple[float, ...]] = {
    Variable.trus_T_camera: (0.1, 0.1, 0.1, 10.0, 10.0, 10.0),
    Variable.marker_laser: (10.0, 10.0, 0.1, 0.1),
    Variable.lam: (10.0,),
    Variable.theta: (0.1,),
}
"""Scale of a step under a damping of one, in rad and mm. The other variables have priors of their own."""


class GraphOptimum(NamedTuple):
    """Result of :func:`optimize`: values, cost (half the chi square), linearisations, whether it converged."""

    values: gtsam.Values
    cost: float
    iterations: int
    converged: bool


def _cost(explicit: ExplicitGraph, values: gtsam.Values) -> float:
    """The cost, infinite where it cannot be computed."""
    try:
        cost = float(explicit.graph.error(values))
    except FactorError:
        return math.inf
    return cost if math.isfinite(cost) else math.inf


def _damped_step(
    explicit: ExplicitGraph, linear: gtsam.GaussianFactorGraph, damping: float, ordering: gtsam.Ordering
) -> gtsam.VectorValues | None:
    """The step of the damped normal equations, None where they are singular."""
    damped = gtsam.GaussianFactorGraph()
    damped.push_back(linear)
    if damping:
        _add_damping(explicit, damped, damping)
    try:
        step = damped.optimize(ordering, gtsam.EliminateQR)
    except RuntimeError:  # GTSAM's indeterminate linear system
        return None
    return step if math.isfinite(step.squaredNorm()) else None


def _add_damping(explicit: ExplicitGraph, damped: gtsam.GaussianFactorGraph, damping: float) -> None:
    blocks = {
        variable: (math.sqrt(damping) * np.diag(1.0 / np.array(scale)), np.zeros(len(scale)))
        for variable, scale in _SCALE.items()
    }
    units = {variable: gtsam.noiseModel.Unit.Create(len(scale)) for variable, scale in _SCALE.items()}
    keys = explicit.keys
    for variable, own in (
        (Variable.trus_T_camera, [key for key in keys.trus_T_camera if key in explicit.shared]),
        (Variable.marker_laser, [key for key in (keys.marker_laser,) if key in explicit.shared]),
        (Variable.lam, keys.lam),
        (Variable.theta, keys.theta),
    ):
        block, zero = blocks[variable]
        for key in own:
            damped.push_back(gtsam.JacobianFactor(key, block, zero, units[variable]))


def optimize(
    explicit: ExplicitGraph, values: gtsam.Values, *, max_iterations: int = 100, tolerance: float = 1e-10
) -> GraphOptimum:
    """Levenberg-Marquardt from starting values.

    A step is tried as it is. Where the cost falls by less than its linear model predicts, it is also tried with points
    and angles made consistent again (:func:`fgreg.graph.gtsam_values.made_consistent`); the better one is taken.

    Args:
        explicit: the graph.
        values: start; not changed.
        max_iterations: largest number of linearisations.
        tolerance: converged when the predicted decrease of a step is less than this share of 1 + cost.

    Raises:
        FactorError: the start itself has a factor that cannot be computed.
    """
    ordering = explicit.ordering
    cost = float(explicit.graph.error(values))
    damping, growth = _FIRST_DAMPING, 2.0
    for iteration in range(1, max_iterations + 1):
        linear = explicit.graph.linearize(values)
        while True:
            step = _damped_step(explicit, linear, damping, ordering)
            if step is not None:
                promise = cost - float(linear.error(step))
                trial = values.retract(step)
                trial_cost = _cost(explicit, trial)
                if cost - trial_cost < 0.5 * promise:
                    consistent = made_consistent(explicit, trial)
                    consistent_cost = _cost(explicit, consistent)
                    if consistent_cost < trial_cost:
                        trial, trial_cost = consistent, consistent_cost
                small = promise < tolerance * (1.0 + cost)
                gain = min((cost - trial_cost) / max(promise, 1e-300), 1.0)
                if trial_cost < cost:
                    values, cost = trial, trial_cost
                    damping = max(damping * max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3), _LEAST_DAMPING)
                    growth = 2.0
                    if small and damping < 1.0:
                        return GraphOptimum(values, cost, iteration, True)
                    break
                if small and damping < 1.0:
                    return GraphOptimum(values, cost, iteration, True)
            damping *= growth
            growth *= 2.0
            if damping > _LARGEST_DAMPING:
                return GraphOptimum(values, cost, iteration, False)
    return GraphOptimum(values, cost, max_iterations, False)


def newton_step(explicit: ExplicitGraph, values: gtsam.Values) -> gtsam.VectorValues | None:
    """The Gauss-Newton step of all variables at some values: zero at an optimum; None where it is undetermined.

    Raises:
        FactorError: a factor cannot be computed there.
    """
    return _damped_step(explicit, explicit.graph.linearize(values), 0.0, explicit.ordering)
