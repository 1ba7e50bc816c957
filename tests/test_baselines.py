"""The methods that fgreg is compared with work as published."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from baseline_alternating import LinesAndArcs, cost_and_error, register_alternating
from baseline_point_based import register_points
from fgreg.evaluation.pair_residual import line_to_arc
from fgreg.geometry.transforms import FloatArray, exp_so3, make_transform, transform_points
from tests.forward import Truth, make_measurements, random_trus_T_camera


def _data(seed: int, pairs: int = 10, noise: bool = True) -> tuple[LinesAndArcs, Truth]:
    model, measurements, truth = make_measurements(np.random.default_rng(seed), pairs=pairs, noise=noise)
    beams = np.stack([pair.marker.camera_T_marker @ truth.marker_T_laser for pair in measurements.pairs])
    looks = [pair.look for pair in measurements.pairs]
    data = LinesAndArcs(
        beams[:, :3, 3],
        beams[:, :3, 2],
        np.array([look.scan_rad for look in looks]),
        np.array([look.x_mm for look in looks]),
        np.array([look.range_mm for look in looks]),
        model.probe.radius_mm,
    )
    return data, truth


def _off(trus_T_camera: FloatArray, degrees: float, mm: float) -> FloatArray:
    turn = exp_so3(np.radians(degrees) * np.array([0.3, 0.8, 0.52]))
    centre = np.array([0.0, 0.0, 42.0])
    shift = np.array([0.6, 0.0, 0.8]) * mm
    return np.asarray(make_transform(turn, centre - turn @ centre + shift) @ trus_T_camera)


def test_points_seen_in_both_frames_give_the_transform_back() -> None:
    rng = np.random.default_rng(0)
    truth = random_trus_T_camera(rng)
    camera_p = rng.uniform(-20, 20, (5, 3)) + np.array([0, 0, 110])
    np.testing.assert_allclose(register_points(camera_p, transform_points(truth, camera_p)), truth, atol=1e-9)


def test_flat_points_do_not_give_a_reflection() -> None:
    rng = np.random.default_rng(1)
    truth = random_trus_T_camera(rng)
    camera_p = np.column_stack([rng.uniform(-20, 20, (4, 2)), np.full(4, 110.0)])
    found = register_points(camera_p, transform_points(truth, camera_p) + rng.normal(0, 0.1, (4, 3)))
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)
    assert np.linalg.norm(transform_points(found, camera_p) - transform_points(truth, camera_p), axis=1).max() < 0.5


def test_too_few_points_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 3"):
        register_points(np.zeros((2, 3)), np.zeros((2, 3)))


def test_the_published_cost_is_zero_at_the_truth_without_noise() -> None:
    data, truth = _data(2, noise=False)
    lam, theta = np.array(truth.pair_lambda_mm), np.array(truth.theta_rad)
    transform = truth.trus_T_camera[0]
    cost, error = cost_and_error(data, transform[:3, :3], transform[:3, 3], lam, theta)
    assert cost < 1e-12
    assert error.shape == (10, 3)


def test_descent_lowers_the_cost_and_fits_lambda_and_theta() -> None:
    data, truth = _data(3)
    guess = _off(truth.trus_T_camera[0], 5.0, 5.0)
    short = register_alternating(data, guess, max_rounds=5)
    longer = register_alternating(data, guess, max_rounds=150)
    assert longer.cost_mm2 < short.cost_mm2
    assert (short.rounds, longer.rounds) == (5, 150)
    # At its registration lambda and theta' are nearly what line to arc gives in closed form: never better than that.
    transform = longer.trus_T_camera
    trus_d = data.camera_d @ transform[:3, :3].T
    trus_p = transform_points(transform, data.camera_p)
    least = line_to_arc(trus_p, trus_d, data.scan_rad, data.x_mm, data.range_mm, data.radius_mm).distance_mm
    assert np.mean(least**2) <= longer.cost_mm2 + 1e-12
    assert longer.cost_mm2 < 1.05 * np.mean(least**2)


def test_theta_stays_within_its_bound() -> None:
    data, truth = _data(4)
    limit = math.radians(2.0)
    found = register_alternating(data, _off(truth.trus_T_camera[0], 8.0, 8.0), limit_rad=limit, max_rounds=60)
    assert np.abs(found.theta_rad - data.scan_rad).max() <= limit + 1e-12


def test_it_ends_by_itself_where_theta_is_known() -> None:
    data, truth = _data(5, noise=False)
    # Arcs of no extent are points: the problem is well posed, and the descent gets to the truth.
    known = replace(data, scan_rad=np.array(truth.theta_rad), radius_mm=0.0)
    y = data.radius_mm * np.sin(data.scan_rad) + data.range_mm * np.sin(truth.theta_rad)
    z = data.radius_mm * np.cos(data.scan_rad) + data.range_mm * np.cos(truth.theta_rad)
    known = replace(known, scan_rad=np.arctan2(y, z), range_mm=np.hypot(y, z))
    found = register_alternating(known, _off(truth.trus_T_camera[0], 3.0, 3.0), limit_rad=0.0, tolerance=1e-4)
    assert found.converged
    assert found.cost_mm2 < 1e-2
