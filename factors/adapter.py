"""Makes a ``gtsam.CustomFactor`` from a pure residual function, with checks that GTSAM does not make.

GTSAM accepts a Jacobian of the wrong shape without an error, fails with an obscure one where a Jacobian is missing, and
returns the start where a number is NaN. So every number is checked here: wrong shapes and numbers that are not finite
raise :class:`FactorError`, which reaches the caller unchanged.

This runs once per factor and iteration, so it has to be fast. Residual functions work on plain floats (faster than
numpy for 3 x 6 blocks), the Jacobians go into one preallocated buffer in one copy, and the builder reads the keys once.
The callback does not refer to its own factor: that cycle would never be freed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import gtsam
import numpy as np

Row = Sequence[float]
Rows = Sequence[Row]
"""A small matrix as rows of floats, e.g. ``pose.matrix().tolist()``."""

Residual = tuple[Row, Sequence[Rows]]
"""Result of a residual function: error (m,), and one (m, n) Jacobian per variable (none where not wanted)."""

Evaluate = Callable[[gtsam.Values, bool], Residual]
"""Reads the variables and calls the residual function; the flag: whether Jacobians are wanted."""


class FactorError(ValueError):
    """A residual function returned a wrong shape, or a number that is not finite."""


def custom_factor(
    name: str,
    noise_model: gtsam.noiseModel.Base,
    keys: Sequence[int],
    error_dim: int,
    variable_dims: Sequence[int],
    evaluate: Evaluate,
) -> gtsam.CustomFactor:
    """A factor whose error and Jacobians come from ``evaluate``.

    Args:
        name: for error messages.
        noise_model: of dimension ``error_dim``.
        keys: of the variables, in the order of the Jacobians.
        error_dim: m.
        variable_dims: tangent dimension n of each variable.
        evaluate: ``(values, want_jacobians) -> (error (m,), [(m, n), ...])``.

    Raises:
        FactorError: here, if dimensions do not fit together; from the factor, when ``evaluate`` gives a wrong shape or
            a number that is not finite, or fails in its arithmetic (infinite angle, division by zero).
    """
    if len(keys) != len(variable_dims):
        raise FactorError(f"{name}: {len(keys)} keys but {len(variable_dims)} variable dimensions")
    if noise_model.dim() != error_dim:
        raise FactorError(f"{name}: noise model of dimension {noise_model.dim()}, expected {error_dim}")
    dims = tuple(variable_dims)
    count = len(dims)
    buffer = np.empty(error_dim * sum(dims))
    blocks, start = [], 0
    for n in dims:
        blocks.append(buffer[start : start + error_dim * n].reshape(error_dim, n))
        start += error_dim * n
    heights, widths = [error_dim] * count, [n for n in dims for _ in range(error_dim)]
    error_out = np.empty(error_dim)
    finite = math.isfinite

    def callback(_: gtsam.CustomFactor, values: gtsam.Values, jacobians_out: gtsam.JacobianVector | None) -> np.ndarray:
        want_jacobians = jacobians_out is not None
        try:
            error, jacobians = evaluate(values, want_jacobians)
        except (ArithmeticError, ValueError) as failure:
            raise FactorError(f"{name}: the residual cannot be computed here: {failure}") from failure
        if len(error) != error_dim:
            raise FactorError(f"{name}: error of length {len(error)}, expected {error_dim}")
        # A sum is finite only if its terms are, so one test covers all of them.
        if not finite(sum(error)):
            raise FactorError(f"{name}: error {list(error)} is not finite")
        error_out[:] = error
        if jacobians_out is None:
            return error_out
        if len(jacobians) != count:
            raise FactorError(f"{name}: {len(jacobians)} Jacobians, expected {count}")
        if [len(rows) for rows in jacobians] != heights or [len(row) for rows in jacobians for row in rows] != widths:
            raise FactorError(f"{name}: {_misshapen(jacobians, error_dim, dims)}")
        flat = [value for rows in jacobians for row in rows for value in row]
        if not finite(sum(flat)):
            raise FactorError(f"{name}: a Jacobian has an entry that is not finite")
        buffer[:] = flat
        for index in range(count):
            jacobians_out[index] = blocks[index]  # copied by gtsam, so the buffer may serve again
        return error_out

    return gtsam.CustomFactor(noise_model, list(keys), callback)


def _misshapen(jacobians: Sequence[Rows], error_dim: int, dims: Sequence[int]) -> str:
    """Description of the first Jacobian of a wrong shape."""
    for index, rows in enumerate(jacobians):
        if len(rows) != error_dim:
            return f"Jacobian {index} has {len(rows)} rows, expected {error_dim}"
        for row in rows:
            if len(row) != dims[index]:
                return f"Jacobian {index} has a row of {len(row)}, expected {dims[index]}"
    raise AssertionError("every Jacobian has its shape")
