"""Levenberg-Marquardt on the explicit graph, and the covariances at its optimum.

The loop is our own, over ``graph.linearize(values)`` with values that Python holds: inside GTSAM's optimizers each
callback of a Python factor copies all values, which makes one linearisation quadratic in the number of pairs.

Elimination is by QR: GTSAM's Cholesky calls a variable undetermined as soon as the last two diagonal entries of its
factor differ by 2^12, which coincidences at 1e-3 mm beside noise of some tenths do in sound problems. QR takes some 1.6
times as long.

Costs are GTSAM's, half the chi square.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np

from fgreg.errors import EstimationError
from fgreg.factors.adapter import FactorError
from fgreg.frames import FloatArray
from fgreg.graph.explicit import ExplicitGraph, Variable, make_ordering
from fgreg.graph.explicit_values import made_consistent

_FIRST_DAMPING, _LEAST_DAMPING, _LARGEST_DAMPING = 1e-3, 1e-12, 1e12
_LEAST_EIGENVALUE = 1e-12
"""Of the information's correlation matrix: below, a combination of shared variables counts as undetermined."""

_SCALE: dict[Variable, tuple[float, ...]] = {
    Variable.trus_T_camera: (0.1, 0.1, 0.1, 10.0, 10.0, 10.0),
    Variable.marker_laser: (10.0, 10.0, 0.1, 0.1),
    Variable.lam: (10.0,),
    Variable.theta: (0.1,),
}
"""What counts as a step of one, where the damping is one: rad and mm. The others are held by their own priors."""


class GraphOptimum(NamedTuple):
    """Result of :func:`optimize`: values, cost (half the chi square), linearisations made, and whether it converged."""

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
    try:
        step = damped.optimize(ordering, gtsam.EliminateQR)
    except RuntimeError:  # GTSAM's indeterminate linear system
        return None
    return step if math.isfinite(step.squaredNorm()) else None


def optimize(
    explicit: ExplicitGraph, values: gtsam.Values, *, max_iterations: int = 100, tolerance: float = 1e-10
) -> GraphOptimum:
    """Levenberg-Marquardt from starting values.

    A step is tried as it is, and where that does not pay as its linear model says, with points and angles made
    consistent again (:func:`fgreg.graph.explicit_values.made_consistent`); the better of the two counts.

    Args:
        explicit: the graph.
        values: where to start; not changed.
        max_iterations: linearisations.
        tolerance: converged when a step promises less than this share of 1 + cost.

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


class GraphCovariance:
    """Marginal covariances at a state of the graph (Gauss-Newton), over the variables' tangents.

    Args:
        explicit: the graph.
        values: normally its optimum.

    Raises:
        EstimationError: something is not determined by these measurements.
    """

    def __init__(self, explicit: ExplicitGraph, values: gtsam.Values) -> None:
        self._linear = explicit.graph.linearize(values)
        self._private = frozenset(explicit.private)
        self._factors_of: dict[int, list[int]] = {}
        for index in range(self._linear.size()):
            for key in self._linear.at(index).keys():  # noqa: SIM118 - a method of the factor, not of a dict
                self._factors_of.setdefault(key, []).append(index)
        sizes = values.zeroVectors()
        self._columns: dict[int, slice] = {}
        start = 0
        for key in explicit.shared:
            self._columns[key] = slice(start, start + sizes.at(key).size)
            start = self._columns[key].stop
        try:
            _, rest = self._linear.eliminatePartialMultifrontal(make_ordering(explicit.private), gtsam.EliminateQR)
        except RuntimeError as failure:
            raise EstimationError("these measurements do not determine all private variables") from failure
        information, _ = rest.hessian(make_ordering(explicit.shared))
        diagonal = np.diag(information)
        if not (np.isfinite(information).all() and (diagonal > 0.0).all()):
            raise EstimationError("these measurements do not determine all shared variables")
        # Units differ by orders of magnitude; what is undetermined shows once they are taken out.
        sigma = 1.0 / np.sqrt(diagonal)
        correlation = information * np.outer(sigma, sigma)
        if np.linalg.eigvalsh(correlation)[0] < _LEAST_EIGENVALUE:
            raise EstimationError("these measurements do not determine all shared variables")
        self._shared = np.asarray(np.linalg.inv(correlation) * np.outer(sigma, sigma))

    def shared(self, keys: Sequence[int] | None = None) -> FloatArray:
        """Joint covariance of shared variables in the order of ``keys``; all of them, in the graph's, where absent."""
        if keys is None:
            return self._shared
        index = np.concatenate([np.arange(self._columns[key].start, self._columns[key].stop) for key in keys])
        return np.asarray(self._shared[np.ix_(index, index)])

    def of(self, key: int) -> FloatArray:
        """Marginal covariance of one variable, private or shared: a PM (3, 3), a distance or angle (1, 1), ...

        What is private to one PM or aim meets the rest at shared variables only. So those factors alone, with all
        else that is private eliminated, give ``R x + S s = d``, and the covariance is R^-1 (I + S C S') R^-T with C
        of the shared variables s.
        """
        if key in self._columns:
            return self.shared([key])
        others, factors = self._component(key)
        local = gtsam.GaussianFactorGraph()
        for index in factors:
            local.push_back(self._linear.at(index))
        net, _ = local.eliminatePartialSequential(make_ordering((*others, key)), gtsam.EliminateQR)
        conditional = net.back()
        blocks, _ = conditional.jacobian()
        width = blocks.shape[0]
        root, by_shared = blocks[:, :width], blocks[:, width:]
        covariance = np.eye(width)
        parents = list(conditional.keys())[1:]
        if parents:
            covariance = covariance + by_shared @ self.shared(parents) @ by_shared.T
        inverse = np.linalg.inv(root)
        return np.asarray(inverse @ covariance @ inverse.T)

    def _component(self, key: int) -> tuple[list[int], list[int]]:
        """The other private variables and the factors that hang together with one without shared variables."""
        found, factors, waiting = {key}, set[int](), [key]
        while waiting:
            for index in self._factors_of[waiting.pop()]:
                if index in factors:
                    continue
                factors.add(index)
                reached = self._private.intersection(self._linear.at(index).keys()) - found
                found |= reached
                waiting.extend(reached)
        return sorted(found - {key}), sorted(factors)
