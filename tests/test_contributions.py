"""What PMs add to the reduced problem, by the shared variables that they depend on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgreg.graph.contributions import Parts, contributions, pm_columns, pms_by_epochs
from fgreg.graph.packing import PackedProblem, pack
from fgreg.graph.reduced_graph import evaluate
from fgreg.graph.reduced_solver import Optimum, optimize
from fgreg.graph.scaled_inverse import without_others
from fgreg.graph.shared_state import make_state
from fgreg.registration.outliers import innovations
from tests.forward import make_measurements


def _three_epochs(*, shared: bool) -> tuple[PackedProblem, Optimum, Parts]:
    """Three epochs of six PMs; ``shared``: one PM is seen in the first two, as if it were the same spot."""
    model, measurements, truth = make_measurements(
        np.random.default_rng(4), pairs=18, epochs=3, spot_sigma_mm=(1, 1, 1)
    )
    if shared:
        pairs = list(measurements.pairs)
        second = next(i for i, pair in enumerate(pairs) if pair.epoch == 1)
        pairs[second] = replace(pairs[second], pm=pairs[0].pm)
        measurements = replace(measurements, pairs=tuple(pairs))
    problem = pack(measurements, model)
    found = optimize(problem, make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser))
    return problem, found, contributions(problem, found.state, found.evaluation.private)


@pytest.mark.parametrize("shared", [False, True])
def test_hessians_of_some_pms_are_blocks_of_the_whole_ones(shared: bool) -> None:
    problem, found, parts = _three_epochs(shared=shared)
    whole = parts.pm.hessian()
    groups = pms_by_epochs(problem)
    assert sorted(np.concatenate([group.pms for group in groups])) == list(range(len(problem.pms)))
    size = problem.columns.size
    expected = size - 12  # one of three epochs
    assert [len(group.columns) for group in groups] == ([expected + 6] if shared else []) + [expected] * 3
    for group in groups:
        np.testing.assert_array_equal(group.columns, pm_columns(problem, group.pms))
        others = np.setdiff1d(np.arange(size), group.columns)
        assert not whole[:, group.pms][..., others].any()
        own = parts.pm.hessian(group.pms, group.columns)
        np.testing.assert_allclose(own, whole[:, group.pms][..., group.columns, :][..., group.columns], rtol=1e-12)
    aims = parts.aim.hessian()[0].sum(axis=0)
    total = whole[0].sum(axis=0) + aims + parts.prior_hessian[0]
    at = evaluate(problem, found.state, found.evaluation.private)
    np.testing.assert_allclose(total, at.hessian[0], rtol=1e-9, atol=1e-6)
    weight = np.linspace(0.1, 1.0, len(problem.pms))
    np.testing.assert_allclose(parts.pm.total(weight)[0], np.tensordot(weight, whole[0], 1), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("shared", [False, True])
def test_innovations_need_no_other_epochs_variables(shared: bool) -> None:
    problem, _found, parts = _three_epochs(shared=shared)
    inlier, aims = np.ones(len(problem.pms), dtype=bool), np.ones(12, dtype=bool)
    inlier[4] = False
    hessian = parts.pm.total(inlier.astype(float))[0] + parts.aim.total()[0] + parts.prior_hessian[0]
    expected = []
    for pm, own in enumerate(parts.pm.hessian()[0]):
        sign = -1.0 if inlier[pm] else 1.0
        rest, gradient = hessian + sign * own, parts.pm.gradient[0, pm]
        scale = 1.0 / np.sqrt(np.diag(rest))
        step = scale * np.linalg.solve(rest * np.outer(scale, scale), scale * gradient)
        expected.append(parts.pm.cost[0, pm] - sign * gradient @ step)
    np.testing.assert_allclose(innovations(problem, parts, inlier, aims).pm, expected, rtol=1e-5)


def test_an_epoch_without_pms_has_its_columns() -> None:
    problem, _, _ = _three_epochs(shared=False)
    none = np.zeros(0, dtype=np.int64)
    common = list(range(18, problem.columns.size))
    assert list(pm_columns(problem, none)) == common
    assert list(pm_columns(problem, none, 1)) == [*range(6, 12), *common]
    assert list(pm_columns(problem, np.array([0]), 0)) == [*range(6), *common]


def test_variables_that_are_eliminated_leave_the_covariance_of_the_rest() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(9, 9)) * np.geomspace(1e-3, 1e3, 9)
    matrix, stay = root.T @ root, np.array([1, 4, 7])
    scale = np.sqrt(np.diag(matrix))
    covariance = np.linalg.inv(matrix / np.outer(scale, scale)) / np.outer(scale, scale)
    np.testing.assert_allclose(without_others(matrix, stay) @ covariance[np.ix_(stay, stay)], np.eye(3), atol=1e-6)
    np.testing.assert_array_equal(without_others(matrix, np.arange(9)), matrix)
