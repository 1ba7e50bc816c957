"""The posterior behind predicted errors: known cases, and few pairs, where the Hessian is too narrow."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from credible_region import ellipsoid_contains
from fgreg.geometry.transforms import FloatArray
from fgreg.graph.packing import pack
from fgreg.graph.reduced_solver import optimize
from fgreg.graph.shared_state import make_state, step_between
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.posterior import (
    Mode,
    Posterior,
    gaussian_posterior,
    log_density,
    pose_tangent,
    predicted_tre,
    sample_posterior,
    step_of_tangent,
    tangent_of_step,
    target_errors,
    weighted_quantile,
)
from fgreg.registration.posterior_mean import posterior_mean
from fgreg.registration.register import register
from tests.forward import make_measurements


def _mode(seed: int, pairs: int, first_hit: bool = True, shapes: bool = True) -> tuple[Mode, FloatArray]:
    model, measurements, truth = make_measurements(np.random.default_rng(seed), pairs=pairs, first_hit=first_hit)
    problem = pack(measurements, model, shapes=shapes)
    start = make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser)
    found = optimize(problem, start)
    return Mode(problem, found, np.linalg.inv(found.evaluation.hessian[0])), truth.trus_T_camera[0]


def _sampled(seed: int, pairs: int, first_hit: bool = True) -> tuple[Posterior, Mode, FloatArray]:
    mode, truth = _mode(seed, pairs, first_hit)
    return sample_posterior((mode,), goal=250.0, most=3000, seed=1), mode, truth


def test_weights_and_moments_are_consistent() -> None:
    posterior, _, _ = _sampled(0, pairs=15)
    assert posterior.weight.sum() == pytest.approx(1.0)
    assert (posterior.weight >= 0).all()
    assert posterior.effective >= 250
    moment = (posterior.tangent * posterior.weight[:, None]).T @ posterior.tangent
    np.testing.assert_allclose(posterior.covariance, moment)
    assert np.linalg.eigvalsh(posterior.covariance)[0] > 0


def test_tangents_are_gtsams() -> None:
    mode, _ = _mode(0, pairs=6)
    columns = mode.problem.columns
    rng = np.random.default_rng(5)
    tangent = rng.normal(size=(20, columns.size)) * ([0.4] * 3 + [20.0] * 3 + [0.1] * (columns.size - 6))
    step = step_of_tangent(tangent, columns)
    np.testing.assert_allclose(tangent_of_step(step, columns), tangent, atol=1e-9)
    there = mode.optimum.state.take(np.zeros(20, dtype=np.int64)).retract(step, columns)
    np.testing.assert_allclose(step_between(mode.optimum.state, there, columns), step, atol=1e-9)
    base = gtsam.Pose3(mode.optimum.state.trus_T_camera()[0])
    for i in range(20):
        expected = base.compose(gtsam.Pose3.Expmap(tangent[i, :6])).matrix()
        np.testing.assert_allclose(there.trus_T_camera()[i], expected, atol=1e-9)
        np.testing.assert_allclose(pose_tangent(base.matrix(), expected), tangent[i, :6], atol=1e-8)


def test_many_pairs_are_nearly_gaussian() -> None:
    mode, _ = _mode(1, pairs=80, shapes=False)
    posterior = sample_posterior((mode,), goal=300.0, most=4000, seed=1)
    ratio = np.sqrt(np.diag(posterior.covariance)[:6] / np.diag(mode.covariance)[:6])
    assert np.all(np.abs(ratio - 1.0) < 0.02)


def test_covariances_of_few_samples_differ_little_in_every_direction() -> None:
    # By 0.4 where the mode's Gaussian is no control variate.
    mode, _ = _mode(7, pairs=15)
    one, other = (sample_posterior((mode,), goal=300.0, most=4000, seed=seed).covariance[:6, :6] for seed in (1, 2))
    assert np.abs(np.linalg.eigvals(np.linalg.solve(one, other)) - 1.0).max() < 0.2


def test_the_gaussian_stand_in_has_the_modes_moments() -> None:
    mode, _ = _mode(1, pairs=30)
    posterior = gaussian_posterior(mode, count=250, seed=3)
    np.testing.assert_allclose(posterior.covariance, mode.covariance, rtol=1e-6, atol=1e-9)
    apart = step_between(mode.optimum.state, posterior.mean, mode.problem.columns)
    assert np.abs(apart / np.sqrt(np.diag(mode.covariance))).max() < 1e-6


def test_at_few_pairs_it_covers_what_the_hessian_does_not() -> None:
    sampled, gaussian = [], []
    for seed in range(10, 20):
        posterior, mode, truth = _sampled(seed, pairs=6, first_hit=False)
        error = pose_tangent(posterior.mean.trus_T_camera()[0], truth)
        sampled.append(error @ np.linalg.solve(posterior.covariance[:6, :6], error))
        error = pose_tangent(mode.optimum.state.trus_T_camera()[0], truth)
        gaussian.append(error @ np.linalg.solve(mode.covariance[:6, :6], error))
    assert np.mean(sampled) < 0.9 * np.mean(gaussian)


def test_the_region_holds_its_share_of_the_posterior() -> None:
    posterior, _, _ = _sampled(4, pairs=6, first_hit=False)
    moved = posterior.mean.take(np.zeros(len(posterior.step), dtype=np.int64)).retract(
        posterior.step, posterior.columns
    )
    inside = np.array([ellipsoid_contains(posterior, pose) for pose in moved.trus_T_camera()])
    assert posterior.weight[inside].sum() == pytest.approx(0.95, abs=0.01)
    far = posterior.mean.trus_T_camera()[0].copy()
    far[:3, 3] += 40.0
    assert not ellipsoid_contains(posterior, far)
    assert ellipsoid_contains(posterior, posterior.mean.trus_T_camera()[0])


def test_two_minima_share_the_posterior_by_their_evidence() -> None:
    # Seen from a mode that is not the best one, samples have to find the other all the same: same posterior.
    mode, _ = _mode(2, pairs=6, first_hit=False)
    columns = mode.problem.columns
    aside = np.zeros((1, columns.size))
    aside[0, :6] = 2.0 * np.linalg.cholesky(mode.covariance[:6, :6])[:, 0]
    decoy = replace(mode, optimum=optimize(mode.problem, mode.optimum.state.retract(aside, columns), max_iterations=1))
    alone = sample_posterior((mode,), goal=800.0, most=6000, seed=1)
    both = sample_posterior((mode, decoy), goal=800.0, most=6000, seed=2)
    apart = pose_tangent(alone.mean.trus_T_camera()[0], both.mean.trus_T_camera()[0])
    assert apart @ np.linalg.solve(alone.covariance[:6, :6], apart) < 0.1
    ratio = np.sqrt(np.diag(both.covariance)[:6] / np.diag(alone.covariance)[:6])
    assert np.all(np.abs(ratio - 1.0) < 0.3)


def test_same_seed_same_samples() -> None:
    first, _, _ = _sampled(3, pairs=8)
    second, _, _ = _sampled(3, pairs=8)
    np.testing.assert_array_equal(first.step, second.step)
    np.testing.assert_array_equal(first.weight, second.weight)


def test_predicted_errors_of_a_known_shift() -> None:
    posterior, _, _ = _sampled(2, pairs=10)
    step = np.zeros_like(posterior.step)
    step[:, 3] = 2.0  # every sample 2 mm along the camera's x
    shifted = replace(posterior, step=step)
    targets = np.array([[0.0, 0.0, 40.0], [20.0, 10.0, 30.0]])
    np.testing.assert_allclose(target_errors(shifted, 0, targets), 2.0)
    tre, _, _ = predicted_tre(shifted, 0, targets)
    assert tre.mean_mm == pytest.approx(2.0)
    assert tre.p95_mm == pytest.approx(2.0)
    assert tre.worst_mm == pytest.approx(2.0)


def test_weighted_quantiles() -> None:
    values = np.array([[3.0], [1.0], [2.0], [4.0]])
    weight = np.array([0.25, 0.25, 0.25, 0.25])
    assert weighted_quantile(values, weight, 0.5)[0] == 2.0
    assert weighted_quantile(values, np.array([0.97, 0.01, 0.01, 0.01]), 0.95)[0] == 3.0


def test_the_result_has_the_optimum_besides_the_mean() -> None:
    model, measurements, truth = make_measurements(np.random.default_rng(6), pairs=8, first_hit=False)
    config = SolveConfig()
    registration = register(measurements, model, config)
    found = posterior_mean(registration, config)
    centred = found.registration
    np.testing.assert_array_equal(centred.optimum.state.trus_T_camera(), found.posterior.mean.trus_T_camera())
    np.testing.assert_array_equal(centred.covariance, found.posterior.covariance)
    assert registration.problem is not centred.problem  # the windows' sites
    # The PMs are those that go with the registration reported: on their beams as it has them.
    assert np.abs(centred.optimum.evaluation.look_residual[0, :, :2]).max() < 2.0
    gaussian = posterior_mean(
        register(measurements, model, SolveConfig(window_shape=False)), SolveConfig(window_shape=False)
    )
    assert gaussian.registration.problem.shapes is None
    assert ellipsoid_contains(found.posterior, truth.trus_T_camera[0])


def test_a_posterior_that_diverges_is_replaced_by_the_optimum() -> None:
    # The optimum with sites of five window-only pairs may be kilometres off; so may samples selected by rounding.
    model, measurements, _ = make_measurements(np.random.default_rng(3), pairs=8, first_hit=False)
    registration = register(measurements, model, SolveConfig())
    mode = Mode(registration.problem, registration.optimum, registration.covariance)
    step = np.zeros((2, mode.problem.columns.size))
    step[1, 3:6] = 1e12
    log = log_density(mode, step)
    assert np.isfinite(log[0])
    assert log[1] == -np.inf
    far = replace(mode.optimum.state, translation_mm=mode.optimum.state.translation_mm + 1e9)
    away = replace(mode, optimum=replace(mode.optimum, state=far))
    found = sample_posterior((away,), goal=100.0, most=500, seed=1)
    assert found.effective == 0.0
    assert np.isfinite(found.covariance).all()
    assert predicted_tre(found, 0, model.targets_mm)[0].worst_mm > 0.1
