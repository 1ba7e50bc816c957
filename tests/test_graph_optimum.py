"""The explicit graph's optimum: the truth where there is no noise, and the same from wherever it starts."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.linalg import logm

from fgreg.factors.adapter import FactorError
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, inverse
from fgreg.graph.gtsam_graph import ExplicitGraph
from fgreg.graph.gtsam_values import SharedValues, beam_of_chart, laser_chart
from fgreg.model.session_model import NoiseModel
from fgreg.model.systematic import EXACT, Systematic
from graph_optimum import GraphEstimate, initial_values, made_consistent, optimize, read_estimate
from tests.forward import hear, make_session, with_noise
from tests.graph_cases import CASES, make_case, off_nominal, perturbed, pose_error

FULL_CASES = {
    **CASES,
    "marker bias": {"session": with_noise(make_session(), marker_bias_mm=0.5)},
    "sound speed": {"session": make_session(systematic=replace(EXACT, sound_speed=0.01))},
    "all constants": {"session": make_session(systematic=Systematic())},
    "nearly no noise": {
        "session": make_session(noise_model=NoiseModel((0.0,) * 3, (0.0,) * 3, 0.0, (0.0,) * 3, 0.0, 0.0, 0.0))
    },
}


@pytest.mark.parametrize("case", FULL_CASES)
def test_truth_costs_nothing_without_noise(case: str) -> None:
    explicit, shared, _ = make_case(71, noise=False, **FULL_CASES[case])
    # With a motion of which nothing is known, "none" is the guess: all that costs is the true motion's distance to it.
    allowed = 0.005 if case == "two epochs, unknown motion" else 1e-12
    assert explicit.graph.error(initial_values(explicit, shared)) < allowed


@pytest.mark.parametrize("case", FULL_CASES)
@pytest.mark.parametrize("seed", [72, 73])
def test_recovers_the_truth_from_a_perturbed_start(case: str, seed: int) -> None:
    explicit, shared, truth = make_case(seed, noise=False, **FULL_CASES[case])
    start = perturbed(shared, np.random.default_rng(seed), rad=0.08, mm=5.0)
    values = initial_values(explicit, start)
    optimum = optimize(explicit, values)
    estimate = read_estimate(explicit, optimum.values, start)
    assert optimum.converged
    close = 1e-2 if case == "two epochs, unknown motion" else 1e-6  # mm; there the guess of no motion pulls a little
    for k, trus_T_camera in enumerate(truth.trus_T_camera):
        error = pose_error(estimate.shared.trus_T_camera[k], trus_T_camera)
        assert np.abs(error[:3]).max() < 1e-2 * close
        assert np.abs(error[3:]).max() < close
    np.testing.assert_allclose(estimate.shared.marker_laser, shared.marker_laser, atol=close)
    np.testing.assert_allclose(estimate.shared.constants, 0.0, atol=close)
    for pm, point in truth.trus_p_pm_mm.items():
        np.testing.assert_allclose(estimate.trus_p_pm_mm[pm], point, atol=close)
    _, offset = laser_chart(truth.marker_T_laser, off_nominal(truth))
    np.testing.assert_allclose(estimate.pair_lambda_mm, np.array(truth.pair_lambda_mm) + offset, atol=5 * close)
    np.testing.assert_allclose(estimate.theta_rad, truth.theta_rad, atol=close)


@pytest.mark.parametrize("case", FULL_CASES)
def test_same_optimum_from_the_truth_and_from_elsewhere(case: str) -> None:
    for seed in (74, 75, 76):
        explicit, shared, _ = make_case(seed, noise=True, **FULL_CASES[case])
        from_truth = optimize(explicit, initial_values(explicit, shared))
        start = perturbed(shared, np.random.default_rng(seed), rad=0.08, mm=5.0)
        elsewhere = optimize(explicit, initial_values(explicit, start))
        assert from_truth.converged
        assert elsewhere.converged
        assert elsewhere.cost == pytest.approx(from_truth.cost, rel=1e-7, abs=1e-7)


@pytest.mark.parametrize(("case", "seed"), [("first hit", 25), ("three looks, own shots", 13), ("no aims", 30)])
def test_far_starts_get_there_without_creeping_along_the_coincidences(case: str, seed: int) -> None:
    # Starts 0.4 rad and 50 mm off: with straight steps alone these are still under way after a hundred.
    explicit, shared, _ = make_case(seed, noise=True, **CASES[case])
    from_truth = optimize(explicit, initial_values(explicit, shared))
    start = perturbed(shared, np.random.default_rng(seed), rad=0.4, mm=50.0)
    far = optimize(explicit, initial_values(explicit, start))
    assert far.converged
    assert far.iterations < 40
    assert far.cost == pytest.approx(from_truth.cost, rel=1e-7)


@pytest.mark.parametrize("seed", [2, 4, 6, 7])
def test_a_gain_far_beyond_what_was_promised_is_no_overflow(seed: int) -> None:
    # At sigmas of 1e-3 mm the last steps predict no decrease, and rounding may give more than that.
    explicit, shared, _ = make_case(seed, noise=True, **FULL_CASES["nearly no noise"])
    assert optimize(explicit, initial_values(explicit, shared)).converged


def test_cost_falls_with_every_iteration() -> None:
    explicit, shared, _ = make_case(77, noise=True)
    values = initial_values(explicit, perturbed(shared, np.random.default_rng(77), rad=0.15, mm=10.0))
    before = explicit.graph.error(values)
    costs = [before, *(optimize(explicit, values, max_iterations=n).cost for n in range(1, 6))]
    assert all(later < earlier for earlier, later in itertools.pairwise(costs))
    assert explicit.graph.error(values) == before, "the start is left alone"


def test_gradient_vanishes_at_the_optimum() -> None:
    explicit, shared, _ = make_case(78, noise=True, looks_per_pm=2)
    optimum = optimize(explicit, initial_values(explicit, shared))
    linear = explicit.graph.linearize(optimum.values)
    hessian, gradient = linear.hessian(explicit.ordering)
    # As a step: what is left to go, in sigmas.
    assert gradient @ np.linalg.solve(hessian, gradient) < 1e-8


def independent_chi2(explicit: ExplicitGraph, estimate: GraphEstimate) -> float:
    """The cost's definition once more, from the measurements and an estimate, by other formulas."""
    session, measurements, shared = explicit.session, explicit.measurements, estimate.shared
    origin, direction = beam_of_chart(shared.marker_laser, explicit.marker_T_nominal)

    def marker_term(observed: FloatArray, covariance: FloatArray, pose: FloatArray) -> float:
        unbiased = np.array(observed)
        unbiased[:3, 3] -= shared.constants[Constant.MARKER_BIAS_X : Constant.MARKER_BIAS_Z + 1]
        log = logm(inverse(unbiased) @ pose).real
        e = np.array([log[2, 1], log[0, 2], log[1, 0], *log[:3, 3]])
        return float(e @ np.linalg.solve(covariance, e))

    def coincide(pose: FloatArray, lambda_mm: float, point: FloatArray) -> float:
        beam = pose @ np.array([*(origin + lambda_mm * direction), 1.0])
        return float(np.sum((beam[:3] - point) ** 2)) / 1e-6

    total = 0.0
    edge_rad = shared.constants[Constant.WINDOW_EDGE]
    total += (edge_rad / session.probe.sensitivity.edge_sigma_rad) ** 2
    for index, aim in enumerate(measurements.aims):
        pose, spot = estimate.aim_camera_T_marker[index], estimate.camera_p_spot_mm[index]
        total += marker_term(aim.marker.camera_T_marker, aim.marker.covariance, pose)
        off = spot - aim.camera_p_spot_mm
        total += float(off @ np.linalg.solve(aim.covariance, off)) + coincide(pose, estimate.aim_lambda_mm[index], spot)
    seen = set()
    for index, pair in enumerate(measurements.pairs):
        pose, point, look = estimate.pair_camera_T_marker[index], estimate.trus_p_pm_mm[pair.pm], pair.look
        if (pair.pm, pair.marker.id) not in seen:
            seen.add((pair.pm, pair.marker.id))
            total += marker_term(pair.marker.camera_T_marker, pair.marker.covariance, pose)
            total += coincide(shared.trus_T_camera[pair.epoch] @ pose, estimate.pair_lambda_mm[index], point)
        distance, bearing, _ = hear(point, look.scan_rad, session.probe.radius_mm)
        # The arc point is at theta, where the point is seen but for what a sigma of 1e-3 mm lets slip; the rotation is
        # that of the arc point.
        theta = estimate.theta_rad[index]
        total += (distance * math.sin(bearing - theta)) ** 2 / 1e-6
        heard = look.range_mm * np.array([0.0, math.sin(theta), math.cos(theta)])
        heard += session.probe.radius_mm * np.array([0.0, math.sin(look.scan_rad), math.cos(look.scan_rad)])
        _, _, rotation = hear(heard, look.scan_rad, session.probe.radius_mm)
        off = np.array([point[0] - look.x_mm, distance * math.cos(bearing - theta) - look.range_mm])
        total += float(off @ np.linalg.solve(look.covariance, off))
        half_width = math.radians(6.0)
        if look.sweep:
            centre = look.sweep * (half_width + edge_rad - session.stage.step_rad / 2.0)
            sigma = math.hypot(session.stage.step_rad / math.sqrt(12.0), look.scan_sigma_rad)
        else:
            centre, sigma = 0.0, math.hypot(half_width / math.sqrt(3.0), look.scan_sigma_rad)
        total += ((rotation - centre) / sigma) ** 2
    for k, epoch in enumerate(measurements.epochs[1:]):
        assert epoch.camera_new_T_camera_old is not None
        assert epoch.covariance is not None
        motion = inverse(shared.trus_T_camera[k + 1]) @ shared.trus_T_camera[k]
        log = logm(inverse(epoch.camera_new_T_camera_old) @ motion).real
        e = np.array([log[2, 1], log[0, 2], log[1, 0], *log[:3, 3]])
        total += float(e @ np.linalg.solve(epoch.covariance, e))
    return float(total)


@pytest.mark.parametrize(
    "case", ["first hit", "window only", "three looks, own shots", "three looks, one shot", "two epochs, known motion"]
)
def test_cost_is_the_chi_square_of_the_measurements(case: str) -> None:
    explicit, shared, _ = make_case(79, noise=True, **CASES[case])
    optimum = optimize(explicit, initial_values(explicit, shared))
    estimate = read_estimate(explicit, optimum.values, shared)
    assert 2.0 * optimum.cost == pytest.approx(independent_chi2(explicit, estimate), rel=1e-7)


def test_nothing_near_the_optimum_costs_less() -> None:
    explicit, shared, _ = make_case(80, noise=True)
    optimum = optimize(explicit, initial_values(explicit, shared))
    best = read_estimate(explicit, optimum.values, shared).shared
    rng = np.random.default_rng(80)
    for _ in range(5):
        near = SharedValues(best.trus_T_camera, best.marker_laser + 0.02 * rng.normal(size=4), best.constants)
        values = made_consistent(explicit, initial_values(explicit, near))
        assert explicit.graph.error(values) > optimum.cost


def test_consistent_values_coincide() -> None:
    explicit, shared, _ = make_case(81, noise=True, looks_per_pm=3)
    values = initial_values(explicit, perturbed(shared, np.random.default_rng(81), rad=0.05, mm=3.0))
    consistent = made_consistent(explicit, values)
    assert explicit.graph.error(consistent) < 1e-2 * explicit.graph.error(values)
    for index in range(explicit.graph.size()):
        factor = explicit.graph.at(index)
        assert isinstance(factor, gtsam.NoiseModelFactor)
        keys = set(factor.keys())
        if keys & set(explicit.keys.lam):  # point on line
            assert np.abs(factor.unwhitenedError(consistent)).max() < 1e-10
        elif keys & set(explicit.keys.theta) and keys & set(explicit.keys.trus_p_pm.values()):  # point on arc
            assert abs(factor.unwhitenedError(consistent)[2]) < 1e-10


def test_a_start_that_is_not_finite_is_refused() -> None:
    explicit, shared, _ = make_case(82, noise=True)
    values = initial_values(explicit, shared)
    values.update(explicit.keys.lam[0], math.nan)
    with pytest.raises(FactorError, match="point on line"):
        optimize(explicit, values)
