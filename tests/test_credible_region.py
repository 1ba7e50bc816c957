"""The 95 % region of the registration: by density, so that it follows the posterior's tails."""

from __future__ import annotations

import numpy as np
import pytest

from credible_region import credible_region, ellipsoid_contains
from fgreg.geometry.transforms import exp_so3
from fgreg.graph.packing import pack
from fgreg.graph.reduced_solver import optimize
from fgreg.graph.shared_state import make_state
from fgreg.model.session_model import NoiseModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.posterior import Mode, light, log_density, pose_tangent, sample_posterior
from fgreg.registration.posterior_mean import posterior_mean
from fgreg.registration.register import register
from tests.forward import make_measurements, make_session


@pytest.mark.parametrize("first_hit", [True, False])
def test_the_truth_is_where_the_posterior_says(first_hit: bool) -> None:
    nees, in_region, in_ellipsoid = [], 0, 0
    for seed in range(12):
        model, measurements, truth = make_measurements(np.random.default_rng(300 + seed), pairs=10, first_hit=first_hit)
        found = posterior_mean(register(measurements, model, SolveConfig()), SolveConfig())
        posterior = found.posterior
        error = pose_tangent(posterior.mean.trus_T_camera()[0], truth.trus_T_camera[0])
        nees.append(error @ np.linalg.solve(posterior.covariance[:6, :6], error))
        in_ellipsoid += ellipsoid_contains(posterior, truth.trus_T_camera[0])
        in_region += credible_region(found.modes, posterior).contains(np.stack(truth.trus_T_camera))
    assert 4.0 < np.mean(nees) < 9.0  # a chi square of six: 6 +- 1
    # Of 12: fewer has a chance of 2 % where 95 % is the truth.
    assert in_region >= 10
    assert in_ellipsoid >= 10


def test_the_region_holds_its_share_of_fresh_samples_and_nothing_far() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(5), pairs=7, first_hit=False)
    found = posterior_mean(register(measurements, model, SolveConfig()), SolveConfig())
    region = credible_region(found.modes, found.posterior)
    estimate = found.posterior.mean.trus_T_camera()
    assert region.contains(estimate)
    for axis in range(3):
        turned = estimate.copy()
        turned[0, :3, :3] = turned[0, :3, :3] @ exp_so3(1.2 * np.eye(3)[axis])
        assert not region.contains(turned)
    fresh = sample_posterior(found.modes, goal=300.0, most=4000, seed=99)
    rng = np.random.default_rng(0)
    pick = rng.choice(len(fresh.weight), 150, p=fresh.weight)
    state = fresh.mean.take(np.zeros(150, dtype=np.int64)).retract(fresh.step[pick], fresh.columns)
    share = np.mean([region.contains(pose[None]) for pose in state.trus_T_camera()])
    assert 0.88 < share < 0.995


def test_two_epochs_are_tested_together() -> None:
    model, measurements, truth = make_measurements(np.random.default_rng(2), pairs=20, epochs=2)
    found = posterior_mean(register(measurements, model, SolveConfig()), SolveConfig())
    region = credible_region(found.modes, found.posterior)
    real = np.stack(truth.trus_T_camera)
    assert region.contains(real)
    assert not region.contains(real[::-1])


@pytest.mark.parametrize("bias", [0.0, 0.2])
def test_summed_aims_have_the_information_of_single_ones(bias: float) -> None:
    session = make_session(noise_model=NoiseModel(marker_bias_mm=bias))
    model, measurements, truth = make_measurements(np.random.default_rng(3), pairs=8, session=session)
    problem = pack(measurements, model, shapes=True)
    found = optimize(problem, make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser))
    covariance = np.linalg.inv(found.evaluation.hessian[0])
    mode = Mode(problem, found, covariance)
    step = np.random.default_rng(1).standard_normal((60, len(covariance))) @ np.linalg.cholesky(covariance).T
    gap = log_density(light(mode), step) - log_density(mode, step)
    assert np.std(gap) < 0.1
    assert len(light(mode).problem.aims.rotation) == 0
