"""Inverses of positive definite matrices whose rows have different units: mm, radians, pixels and ratios.

Each is scaled to a unit diagonal first; without that, rounding alone would make some of them singular.
"""

from __future__ import annotations

import numpy as np

from fgreg.geometry.transforms import FloatArray, IntArray

UNKNOWN = 1e-9
"""Eigenvalue of a Hessian with a unit diagonal below which a direction is not determined."""
SINGULAR = 1e13
"""Trace of the inverse, of a matrix with a unit diagonal, from which it is rounding error."""


def scaled_solve(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solution (n, m) of a positive definite system (n, n) with right-hand sides (n, m).

    Raises:
        numpy.linalg.LinAlgError: the matrix is singular.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    return np.asarray(scale[:, None] * np.linalg.solve(matrix * np.outer(scale, scale), scale[:, None] * right))


def scaled_inverse(matrix: FloatArray) -> FloatArray:
    """The inverse (n, n), symmetric.

    Raises:
        numpy.linalg.LinAlgError: the matrix is singular or not positive definite.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    outer = np.outer(scale, scale)
    inverse = np.linalg.inv(matrix * outer)
    inverse = 0.5 * (inverse + inverse.T)
    np.linalg.cholesky(inverse)
    if not np.trace(inverse) < SINGULAR:
        raise np.linalg.LinAlgError("singular up to rounding")
    return np.asarray(inverse * outer, dtype=np.float64)


def without_others(matrix: FloatArray, stay: IntArray) -> FloatArray:
    """Schur complement (K, K) of a Hessian (D, D): of the variables ``stay`` (K,), all others eliminated.

    Directions in which the others are not determined have no influence.
    """
    others = np.setdiff1d(np.arange(len(matrix)), stay)
    if not len(others):
        return matrix[np.ix_(stay, stay)]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix)[others], 1e-30))
    block = matrix[np.ix_(others, others)] * scale * scale[:, None]
    across = matrix[np.ix_(others, stay)] * scale[:, None]
    reduced = matrix[np.ix_(stay, stay)] - across.T @ np.linalg.pinv(block, rcond=UNKNOWN, hermitian=True) @ across
    return np.asarray(0.5 * (reduced + reduced.T))


def inverse_hessian(hessian: FloatArray) -> FloatArray | None:
    """The inverse (D, D) of a Hessian; None where it is not positive definite."""
    try:
        return scaled_inverse(hessian)
    except np.linalg.LinAlgError:
        return None
