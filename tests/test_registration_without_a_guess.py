"""Registration from nothing: the best minimum is found, and it is the truth where there is no noise."""

from __future__ import annotations

import numpy as np
import pytest

from fgreg.errors import EstimationError
from fgreg.geometry.transforms import inverse, transform_points
from fgreg.graph.packing import pack
from fgreg.graph.reduced_solver import optimize
from fgreg.graph.shared_state import make_state
from fgreg.model.estimate import Verdict
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.multistart import calibrate_beam, search_epoch, targets_moved
from fgreg.registration.register import register
from fgreg.registration.solve import solve
from tests.forward import make_measurements


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("first_hit", [True, False])
def test_exact_measurements_give_the_truth(seed: int, first_hit: bool) -> None:
    model, measurements, truth = make_measurements(
        np.random.default_rng(seed), pairs=8, first_hit=first_hit, noise=False
    )
    found = register(measurements, model, SolveConfig())
    moved = targets_moved(truth.trus_T_camera[0], found.optimum.state.trus_T_camera()[0], model.targets_mm)
    assert moved < 0.02
    assert found.optimum.evaluation.cost[0] < 1e-3


@pytest.mark.parametrize("pairs", [6, 10, 15])
def test_no_better_minimum_near_the_truth(pairs: int) -> None:
    for seed in range(8):
        model, measurements, truth = make_measurements(np.random.default_rng(seed), pairs=pairs)
        search = search_epoch(measurements, model, calibrate_beam(measurements, model).frames, 0)
        start = make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser)
        from_truth = optimize(pack(measurements, model), start)
        assert search.minima[0].cost <= from_truth.evaluation.cost[0] + 0.01, seed


def test_two_epochs_share_the_beam_and_each_gets_its_own_registration() -> None:
    model, measurements, truth = make_measurements(np.random.default_rng(2), pairs=24, epochs=2)
    solution = solve(measurements, [], model, SolveConfig())
    assert [epoch.pairs for epoch in solution.epochs] == [12, 12]
    for epoch, real in zip(solution.epochs, truth.trus_T_camera, strict=True):
        assert epoch.trus_T_camera is not None
        assert targets_moved(real, epoch.trus_T_camera, model.targets_mm) < 4.0
    assert targets_moved(truth.trus_T_camera[0], truth.trus_T_camera[1], model.targets_mm) > 4.0


def test_a_measured_camera_motion_carries_an_epoch_with_too_few_pairs() -> None:
    model, measurements, truth = make_measurements(np.random.default_rng(2), pairs=14, epochs=2, known_motion=True)
    few = [p for p in measurements.pairs if p.epoch == 0] + [p for p in measurements.pairs if p.epoch == 1][:2]
    kept = type(measurements)(measurements.aims, tuple(few), measurements.epochs)
    solution = solve(kept, [], model, SolveConfig())
    second = solution.epochs[1]
    assert second.trus_T_camera is not None
    assert second.pairs == 2
    assert targets_moved(truth.trus_T_camera[1], second.trus_T_camera, model.targets_mm) < 8.0


def test_an_epoch_without_motion_and_pairs_has_no_transform_and_says_so() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(2), pairs=14, epochs=2)
    few = [p for p in measurements.pairs if p.epoch == 0] + [p for p in measurements.pairs if p.epoch == 1][:2]
    kept = type(measurements)(measurements.aims, tuple(few), measurements.epochs)
    solution = solve(kept, [], model, SolveConfig())
    assert solution.epochs[1].trus_T_camera is None
    assert solution.epochs[1].verdict is Verdict.REFUSED
    assert solution.verdict is Verdict.REFUSED
    assert [pair.used for pair in solution.pairs] == [True] * 7 + [False] * 2
    assert any("too few" in reason for reason in solution.reasons)


def test_no_aims_and_no_initial_beam_is_refused_with_what_to_do() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(2), aims=0, pairs=10)
    with pytest.raises(EstimationError, match="take at least 6 aim shots"):
        register(measurements, model, SolveConfig())
    solution = solve(measurements, [], model, SolveConfig())
    assert solution.verdict is Verdict.REFUSED
    assert solution.laser is None
    assert not any(pair.used for pair in solution.pairs)


def test_distances_along_the_beam_and_points_are_those_simulated() -> None:
    model, measurements, truth = make_measurements(np.random.default_rng(7), pairs=8, noise=False)
    solution = solve(measurements, [], model, SolveConfig())
    assert solution.laser is not None
    # The laser frame's origin is the beam's point nearest the marker's origin.
    origin, direction = truth.marker_T_laser[:3, 3], truth.marker_T_laser[:3, 2]
    foot = origin - (origin @ direction) * direction
    np.testing.assert_allclose(solution.laser.marker_T_laser[:3, 3], foot, atol=0.02)
    np.testing.assert_allclose(solution.laser.marker_T_laser[:3, 2], direction, atol=5e-4)
    shift = float((origin - foot) @ direction)
    for pair, lam, theta, rotation in zip(
        solution.pairs, truth.pair_lambda_mm, truth.theta_rad, truth.rotation_rad, strict=True
    ):
        assert pair.lambda_mm == pytest.approx(lam + shift, abs=0.05)
        assert pair.theta_rad == pytest.approx(theta, abs=1e-3)
        assert pair.rotation_rad == pytest.approx(rotation, abs=1e-3)
        assert pair.trus_p_pm_mm is not None
        np.testing.assert_allclose(pair.trus_p_pm_mm, truth.trus_p_pm_mm[pair.pm], atol=0.05)
        camera_p = transform_points(inverse(truth.trus_T_camera[0]), truth.trus_p_pm_mm[pair.pm])
        assert np.isfinite(camera_p).all()


def test_the_beams_gauge_has_no_variance_and_the_rest_has() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(1), pairs=12)
    laser = solve(measurements, [], model, SolveConfig()).laser
    assert laser is not None
    sigma = np.sqrt(np.diag(laser.covariance))
    assert sigma[2] == 0.0  # roll about the beam
    assert sigma[5] == 0.0  # shift along it
    assert 1e-3 < sigma[0] < 0.1
    assert 0.05 < sigma[3] < 3.0
    assert np.linalg.eigvalsh(laser.covariance)[0] > -1e-12


def test_a_nominal_tip_places_the_lasers_origin_along_the_beam() -> None:
    from dataclasses import replace

    model, measurements, truth = make_measurements(np.random.default_rng(1), pairs=12)
    tip = truth.marker_T_laser.copy()
    tip[:3, 3] += 9.0 * tip[:3, 2]
    laser = solve(measurements, [], replace(model, initial_marker_T_laser=tip), SolveConfig()).laser
    assert laser is not None
    along = (laser.marker_T_laser[:3, 3] - tip[:3, 3]) @ laser.marker_T_laser[:3, 2]
    assert abs(along) < 1e-6


@pytest.mark.parametrize("aims", [1, 2, 3])
def test_a_few_aims_start_the_beam_and_the_pairs_do_the_rest(aims: int) -> None:
    model, measurements, truth = make_measurements(np.random.default_rng(5), aims=aims, pairs=25)
    found = register(measurements, model, SolveConfig())
    moved = targets_moved(truth.trus_T_camera[0], found.optimum.state.trus_T_camera()[0], model.targets_mm)
    assert moved < 8.0
    assert found.optimum.state.beam_direction()[0] @ truth.marker_T_laser[:3, 2] > np.cos(np.radians(5.0))


def test_a_nominal_beam_the_wrong_way_round_is_turned_to_where_the_spots_are() -> None:
    from dataclasses import replace

    model, measurements, truth = make_measurements(np.random.default_rng(5), aims=0, pairs=25)
    wrong = truth.marker_T_laser @ np.diag([1.0, -1.0, -1.0, 1.0])
    solution = solve(measurements, [], replace(model, initial_marker_T_laser=wrong), SolveConfig())
    assert solution.laser is not None
    assert solution.laser.marker_T_laser[:3, 2] @ truth.marker_T_laser[:3, 2] > 0.99
    assert all(pair.lambda_mm is not None and pair.lambda_mm > 0 for pair in solution.pairs)
    assert np.linalg.det(solution.laser.marker_T_laser[:3, :3]) == pytest.approx(1.0)


def test_a_motion_without_a_covariance_gives_no_prior() -> None:
    from dataclasses import replace

    model, measurements, _ = make_measurements(np.random.default_rng(2), pairs=24, epochs=2, known_motion=True)
    starts = (measurements.epochs[0], replace(measurements.epochs[1], covariance=None))
    first = tuple(pair for pair in measurements.pairs if pair.epoch == 0)
    solution = solve(replace(measurements, epochs=starts, pairs=first), [], model, SolveConfig())
    assert solution.epochs[0].trus_T_camera is not None
    assert solution.epochs[0].verdict is not Verdict.REFUSED
    assert solution.epochs[1].trus_T_camera is None
