"""The posterior behind predicted errors: known cases, and few pairs, where the Hessian is too narrow."""

from __future__ import annotations

import numpy as np
import pytest

from fgreg.graph.packing import pack
from fgreg.graph.reduced_solver import optimize
from fgreg.graph.shared_state import make_state, pose_difference
from fgreg.posterior import Posterior, predicted_tre, sample_posterior, target_errors, weighted_quantile
from tests.forward import make_measurements


def _sampled(
    seed: int, pairs: int, count: int = 800, first_hit: bool = True
) -> tuple[Posterior, np.ndarray, np.ndarray]:
    model, measurements, truth = make_measurements(np.random.default_rng(seed), pairs=pairs, first_hit=first_hit)
    problem = pack(measurements, model)
    start = make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser, model.probe.radius_mm)
    found = optimize(problem, start)
    hessian = np.linalg.inv(found.evaluation.hessian[0])
    posterior = sample_posterior(problem, found, hessian, count, seed=1)
    error = pose_difference(found.state, start)[0]
    return posterior, hessian, error


def test_weights_and_moments_are_consistent() -> None:
    posterior, _, _ = _sampled(0, pairs=15)
    assert posterior.weight.sum() == pytest.approx(1.0)
    assert (posterior.weight >= 0).all()
    assert posterior.effective > 100
    assert np.linalg.eigvalsh(posterior.covariance)[0] > 0


def test_many_pairs_are_nearly_gaussian() -> None:
    posterior, hessian, _ = _sampled(1, pairs=80, count=3000)
    ratio = np.sqrt(np.diag(posterior.covariance)[:6] / np.diag(hessian)[:6])
    assert np.all(np.abs(ratio - 1.0) < 0.15)


def test_at_few_pairs_it_covers_what_the_hessian_does_not() -> None:
    sampled, gaussian = [], []
    for seed in range(16):
        posterior, hessian, error = _sampled(seed, pairs=7, first_hit=False)
        sampled.append(error @ np.linalg.solve(posterior.covariance[:6, :6], error))
        gaussian.append(error @ np.linalg.solve(hessian[:6, :6], error))
    assert np.mean(sampled) < 0.9 * np.mean(gaussian)


def test_the_truth_is_where_the_posterior_says() -> None:
    nees = []
    for seed in range(12):
        posterior, _, error = _sampled(seed, pairs=12)
        nees.append(error @ np.linalg.solve(posterior.covariance[:6, :6], error))
    assert 3.0 < np.mean(nees) < 10.0


def test_same_seed_same_samples() -> None:
    first, _, _ = _sampled(3, pairs=8)
    second, _, _ = _sampled(3, pairs=8)
    np.testing.assert_array_equal(first.step, second.step)
    np.testing.assert_array_equal(first.weight, second.weight)


def test_predicted_errors_of_a_known_shift() -> None:
    posterior, _, _ = _sampled(2, pairs=10)
    step = np.zeros_like(posterior.step)
    step[:, 3] = 2.0  # every sample 2 mm along the camera's x
    shifted = Posterior(
        posterior.columns, posterior.mean, step, posterior.weight, posterior.effective, posterior.covariance
    )
    targets = np.array([[0.0, 0.0, 40.0], [20.0, 10.0, 30.0]])
    np.testing.assert_allclose(target_errors(shifted, 0, targets), 2.0)
    tre = predicted_tre(shifted, 0, targets)
    assert tre.mean_mm == pytest.approx(2.0)
    assert tre.p95_mm == pytest.approx(2.0)
    assert tre.worst_mm == pytest.approx(2.0)


def test_weighted_quantiles() -> None:
    values = np.array([[3.0], [1.0], [2.0], [4.0]])
    weight = np.array([0.25, 0.25, 0.25, 0.25])
    assert weighted_quantile(values, weight, 0.5)[0] == 2.0
    assert weighted_quantile(values, np.array([0.97, 0.01, 0.01, 0.01]), 0.95)[0] == 3.0
