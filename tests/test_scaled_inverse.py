"""The inverse of a Hessian whose units differ by orders of magnitude."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fgreg.graph.scaled_inverse import inverse_hessian, scaled_inverse, scaled_solve

UNITS = np.logspace(-9, 9, 5)


def test_units_do_not_matter() -> None:
    rows = np.random.default_rng(0).normal(size=(9, 5))
    plain = rows.T @ rows
    hessian = plain * np.outer(UNITS, UNITS)
    expected = np.linalg.inv(plain) / np.outer(UNITS, UNITS)
    assert_allclose(scaled_inverse(hessian), expected, rtol=1e-9)
    assert_allclose(scaled_solve(hessian, np.eye(5)), expected, rtol=1e-9)


@pytest.mark.parametrize("rank", [4, 5])
def test_a_matrix_that_is_not_positive_definite_has_none(rank: int) -> None:
    """Singular up to rounding, or with a negative direction."""
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(5, 5)))[0]
    values = np.array([1.0, 2.0, 3.0, 4.0, 0.0 if rank == 4 else -0.5])
    hessian = (turn * values) @ turn.T * np.outer(UNITS, UNITS)
    assert inverse_hessian(hessian) is None
    with pytest.raises(np.linalg.LinAlgError):
        scaled_inverse(hessian)
