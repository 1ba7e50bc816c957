"""Nonlinear least squares with the covariance of its parameters."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from fgreg.errors import EstimationError
from fgreg.geometry.transforms import FloatArray

MOST_STEPS = 100
"""Of the minimisation: recordings that fit take 5 to 20."""


@dataclass(frozen=True, slots=True, eq=False)
class Optimum:
    """Parameters (n,) at the least sum of squares, their covariance (n, n), the sum, and residuals less parameters."""

    value: FloatArray
    covariance: FloatArray
    chi_square: float
    degrees_of_freedom: int

    def sigma(self, gradient: FloatArray) -> float:
        """Standard deviation of a function of the parameters with this gradient (n,)."""
        return math.sqrt(max(float(gradient @ self.covariance @ gradient), 0.0))

    def widened(self) -> Optimum:
        """With the covariance by the residuals, where these are larger than stated."""
        factor = max(1.0, self.chi_square / max(self.degrees_of_freedom, 1))
        return Optimum(self.value, factor * self.covariance, self.chi_square, self.degrees_of_freedom)


def optimum(residuals: Callable[[FloatArray], FloatArray], start: FloatArray, scale: FloatArray) -> Optimum:
    """Minimise the squares of residuals that are divided by their standard deviations.

    Args:
        residuals: of parameters (n,).
        start: (n,). scale: (n,) steps of the parameters that change the residuals alike.

    Raises:
        EstimationError: no optimum, or a parameter that the residuals do not depend on.
    """

    def scaled(steps: FloatArray) -> FloatArray:
        return residuals(np.asarray(start + scale * steps))

    found = least_squares(scaled, np.zeros(start.size), jac="3-point", method="trf", max_nfev=MOST_STEPS)
    jacobian = np.asarray(found.jac, dtype=np.float64)
    singular = np.linalg.svd(jacobian, compute_uv=False)
    if found.status <= 0 or not np.isfinite(found.cost) or singular[-1] <= 1e-9 * singular[0]:
        raise EstimationError("these recordings do not determine their constants")
    covariance = np.linalg.inv(jacobian.T @ jacobian) * np.outer(scale, scale)
    value = np.asarray(start + scale * found.x)
    return Optimum(value, covariance, float(2.0 * found.cost), len(found.fun) - start.size)
