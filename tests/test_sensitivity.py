"""Rotation against arc angle, and the information of window and sweep on a look."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from fgreg.model.measurements import Look
from fgreg.model.sensitivity import (
    amplitude_table,
    arc_of_rotation,
    interval_moments,
    log_interval,
    rotation_of_arc,
    sensitivity_prior,
    sensitivity_priors,
    window_priors,
    window_shapes,
    wrap_angle,
)
from tests.forward import hear, make_measurements, make_session

DEG = math.pi / 180.0


def look(range_mm: float, sweep: int = 0, scan_sigma_deg: float = 0.1) -> Look:
    return Look(0.0, scan_sigma_deg * DEG, 0.0, range_mm, np.eye(2), sweep)


def test_six_degrees_of_rotation_are_eight_of_arc() -> None:
    # By hand: sin 6 deg = 0.104528; times 10 / 30 is 0.034843, the sine of 1.9968 deg.
    assert math.degrees(arc_of_rotation(6.0 * DEG, 30.0, 10.0)) == pytest.approx(7.9968, abs=1e-4)
    assert math.degrees(rotation_of_arc(7.9968 * DEG, 30.0, 10.0)) == pytest.approx(6.0, abs=1e-4)


def test_small_rotations_are_r_over_R_plus_r_of_the_arc() -> None:
    assert float(rotation_of_arc(1e-5, 30.0, 10.0)) == pytest.approx(0.75e-5, rel=1e-8)


def test_rotation_agrees_with_the_points_themselves() -> None:
    rng = np.random.default_rng(41)
    p = np.stack([np.zeros(200), rng.uniform(-20, 20, 200), rng.uniform(25, 60, 200)], axis=1)
    scan = np.arctan2(p[:, 1], p[:, 2]) + rng.uniform(-0.5, 0.5, 200)
    for point, t in zip(p, scan, strict=True):
        distance, theta, rotation = hear(point, float(t), 10.0)
        assert float(rotation_of_arc(theta - t, distance, 10.0)) == pytest.approx(rotation, abs=1e-12)


def test_arc_of_rotation_is_the_inverse() -> None:
    rng = np.random.default_rng(42)
    r = rng.uniform(3.0, 80.0, 500)
    delta = rng.uniform(-1.2, 1.2, 500)
    rotation = rotation_of_arc(delta, r, 10.0)
    back = arc_of_rotation(rotation, r, 10.0)
    # Nearer than R two arc angles have the same rotation; the one on the branch through 0 comes back.
    on_branch = np.abs(delta - rotation) < np.pi / 2
    assert on_branch.mean() > 0.9
    np.testing.assert_allclose(back[on_branch], delta[on_branch], atol=1e-9)
    np.testing.assert_allclose(rotation_of_arc(back, r, 10.0), rotation, atol=1e-9)


def test_rotation_out_of_reach_gives_the_arc_angle_that_comes_nearest() -> None:
    delta = arc_of_rotation([0.5, -0.5], 2.0, 10.0)
    reached = rotation_of_arc(delta, 2.0, 10.0)
    every = rotation_of_arc(np.linspace(-np.pi, np.pi, 20001), 2.0, 10.0)
    np.testing.assert_allclose(reached, [every.max(), every.min()], atol=1e-7)


def test_first_hit_is_five_degrees_ahead_not_zero() -> None:
    # docs/model.md, section 2: 6 deg and 2 deg steps, 5 +- 0.6 deg, not 0 +- 3.5.
    probe = make_session().probe
    for sweep in (1, -1):
        prior = sensitivity_prior(look(30.0, sweep, 0.0), probe.sensitivity, 2.0 * DEG)
        assert math.degrees(prior.centre_rad) == pytest.approx(5.0 * sweep)
        assert math.degrees(prior.sigma_rad) == pytest.approx(2.0 / math.sqrt(12.0))
        assert prior.edge_gain == sweep
    window = sensitivity_prior(look(30.0, 0, 0.0), probe.sensitivity, 2.0 * DEG)
    assert (window.centre_rad, window.edge_gain) == (0.0, 0.0)
    assert math.degrees(window.sigma_rad) == pytest.approx(6.0 / math.sqrt(3.0))


def test_stage_noise_adds_in_square() -> None:
    prior = sensitivity_prior(look(30.0, 1, 0.3), make_session().probe.sensitivity, 2.0 * DEG)
    assert math.degrees(prior.sigma_rad) == pytest.approx(math.hypot(2.0 / math.sqrt(12.0), 0.3))


def test_half_width_is_taken_at_the_looks_depth() -> None:
    probe = make_session(half_width_deg=(5.0, 6.0, 9.0)).probe
    ranges = [10.0, 25.0, 30.0, 40.0, 90.0]
    priors = sensitivity_priors([look(r, 1) for r in ranges], probe.sensitivity, 2.0 * DEG)
    np.testing.assert_allclose(np.degrees(priors.centre_rad), [4.0, 4.5, 5.0, 7.0, 8.0])


def test_a_step_wider_than_the_window_adds_no_information_to_the_window() -> None:
    probe = make_session().probe
    wide = sensitivity_prior(look(30.0, 1), probe.sensitivity, 15.0 * DEG)
    window = sensitivity_prior(look(30.0, 0), probe.sensitivity, 15.0 * DEG)
    assert wide == window


def test_arrays_and_single_looks_agree() -> None:
    session, measurements, _ = make_measurements(np.random.default_rng(44), aims=0, pairs=9)
    looks = [pair.look for pair in measurements.pairs]
    many = sensitivity_priors(looks, session.probe.sensitivity, session.stage.step_rad)
    for index, one in enumerate(looks):
        single = sensitivity_prior(one, session.probe.sensitivity, session.stage.step_rad)
        assert single.centre_rad == many.centre_rad[index]
        assert single.edge_gain == many.edge_gain[index]
        assert single.sigma_rad == many.sigma_rad[index]


@pytest.mark.parametrize("first_hit", [False, True])
def test_centre_and_sigma_are_those_of_simulated_sweeps(first_hit: bool) -> None:
    session = make_session(edge_sigma_deg=1.0)
    offsets = []
    for seed in range(30):
        _, measurements, truth = make_measurements(
            np.random.default_rng(1000 + seed), aims=0, pairs=100, first_hit=first_hit, session=session
        )
        looks = [pair.look for pair in measurements.pairs]
        priors = window_priors(
            [one.range_mm for one in looks],
            [one.sweep for one in looks],
            [one.scan_sigma_rad for one in looks],
            session.probe.sensitivity,
            session.stage.step_rad,
        )
        # Against the stage's reading, as the estimator has it.
        rotation = np.array(truth.rotation_rad) + truth.scan_rad - [one.scan_rad for one in looks]
        expected = priors.centre_rad + priors.edge_gain * truth.window_edge_rad
        offsets.append((rotation - expected) / priors.sigma_rad)
    z = np.concatenate(offsets)
    assert abs(z.mean()) < 4.0 / math.sqrt(z.size)
    # A window known to be wider by the edge is wider by as much for looks that know only the window: some 1 % here.
    assert z.std() == pytest.approx(1.0, abs=0.05)


def test_wrap_angle() -> None:
    np.testing.assert_allclose(
        wrap_angle([0.0, np.pi, -np.pi, 3 * np.pi, 2 * np.pi + 0.1, -4.0]),
        [0.0, np.pi, np.pi, np.pi, 0.1, -4.0 + 2 * np.pi],
        atol=1e-12,
    )


def test_interval_probabilities_hold_far_out_in_both_tails() -> None:
    low, high = np.array([-1.0, 3.0, -60.0, 40.0]), np.array([0.5, 4.0, -50.0, 1e9])
    expected = [np.log(stats.norm.cdf(0.5) - stats.norm.cdf(-1.0)), np.log(stats.norm.sf(3.0) - stats.norm.sf(4.0))]
    expected += [stats.norm.logcdf(-50.0), stats.norm.logsf(40.0)]
    np.testing.assert_allclose(log_interval(low, high, 1.0), expected, rtol=1e-12)
    assert log_interval(-0.2, 0.3, 0.1) == pytest.approx(float(log_interval(-2.0, 3.0, 1.0)))


@pytest.mark.parametrize("mean", [-9.0, -1.0, 0.2, 3.0, 40.0])
def test_moments_are_derivatives_of_the_probability(mean: float) -> None:
    def log(shift: float) -> float:
        return float(log_interval(-1.3 - mean - shift, 0.8 - mean - shift, 0.6))

    slope, curvature = interval_moments(-1.3 - mean, 0.8 - mean, 0.6)
    assert slope == pytest.approx((log(1e-5) - log(-1e-5)) / 2e-5, rel=1e-6)
    assert curvature == pytest.approx(-(log(1e-3) - 2.0 * log(0.0) + log(-1e-3)) / 1e-6, rel=1e-4)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_moments_far_out_stay_finite(sign: float) -> None:
    low, high = sorted((sign * 500.0, sign * 501.0))
    slope, curvature = interval_moments(low, high, 1.0)
    # Nearly all of the remaining mass is at the nearer end, and so is the mean.
    assert slope == pytest.approx(sign * 500.0, rel=1e-4)
    assert -1e-4 <= curvature <= 1.0 + 1e-4


def test_intervals_are_those_of_the_sweeps() -> None:
    probe = make_session().probe
    shapes = window_shapes([look(30.0, 1), look(30.0, -1), look(30.0, 0)], probe.sensitivity, 2.0 * DEG)
    np.testing.assert_allclose(np.degrees(shapes.low_rad), [4.0, -6.0, -6.0])
    np.testing.assert_allclose(np.degrees(shapes.high_rad), [6.0, -4.0, 6.0])
    np.testing.assert_array_equal(shapes.low_gain, [1.0, -1.0, -1.0])
    np.testing.assert_array_equal(shapes.high_gain, [1.0, -1.0, 1.0])
    wide = window_shapes([look(30.0, 1)], probe.sensitivity, 13.0 * DEG)
    assert (wide.low_gain[0], wide.high_gain[0]) == (-1.0, 1.0)


def _ladder(plane_deg: float, scans_deg: list[float], peak: float) -> list[Look]:
    """Looks whose amplitudes are exactly a bell's that is halved at 6 deg."""
    covariance = np.diag([0.09, 0.04])
    return [
        Look(s * DEG, 0.1 * DEG, 0.0, 30.0, covariance, amplitude=peak * 0.5 ** (((plane_deg - s) / 6.0) ** 2))
        for s in scans_deg
    ]


@pytest.mark.parametrize("peak", [0.01, 1.0, 300.0])
def test_amplitudes_find_the_plane_whatever_the_peak(peak: float) -> None:
    sensitivity = make_session(curve=True).probe.sensitivity
    # No look is at the peak itself: all three are on one flank of the curve.
    table = amplitude_table(_ladder(4.3, [-0.5, 1.5, 3.0], peak), sensitivity, 0.05)
    assert table.used
    best = table.plane_rad[np.argmax(table.log_likelihood)]
    assert math.degrees(best) == pytest.approx(4.3, abs=0.15)
    weight = np.exp(table.log_likelihood)
    weight /= weight.sum()
    mean = weight @ table.plane_rad
    sigma = math.degrees(math.sqrt(weight @ (table.plane_rad - mean) ** 2))
    # log a_i = log p - ln 2 (phi - t_i)^2 / 36: linear in phi up to the peak's part, slope 2 ln 2 t_i / 36.
    times = np.array([-0.5, 1.5, 3.0])
    slope = 2.0 * math.log(2.0) / 36.0 * (times - times.mean())
    assert sigma == pytest.approx(0.05 / np.linalg.norm(slope), rel=0.15)


def test_amplitudes_carry_no_information_alone_or_without_a_curve() -> None:
    with_curve, without = make_session(curve=True).probe.sensitivity, make_session().probe.sensitivity
    assert not amplitude_table(_ladder(1.0, [0.0], 1.0), with_curve, 0.05).used
    assert not amplitude_table(_ladder(1.0, [0.0, 2.0], 1.0), without, 0.05).used
    assert not amplitude_table([look(30.0, 0), look(30.0, 0)], with_curve, 0.05).used
