"""Covariances at an optimum of the explicit graph: the reference that the reduced graph is compared with."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from fgreg.errors import EstimationError
from fgreg.geometry.transforms import FloatArray
from fgreg.graph.gtsam_graph import ExplicitGraph, make_ordering

_LEAST_EIGENVALUE = 1e-12
"""Of the information's correlation matrix: below, a combination of shared variables counts as undetermined."""


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
        # Units differ by orders of magnitude, so the rank is tested on the correlation matrix.
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

        The private variables of one PM or aim are connected to the rest by shared variables only. So those factors
        alone, with their other private variables eliminated, give ``R x + S s = d``, and the covariance is
        R^-1 (I + S C S') R^-T with C of the shared variables s.
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
