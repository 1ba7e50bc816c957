"""Covariances at the explicit graph's optimum: right, and refused where something is not determined."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgreg.errors import EstimationError
from fgreg.graph.gtsam_graph import GraphOptions, build_graph, make_ordering
from fgreg.graph.gtsam_values import SharedValues
from graph_covariance import GraphCovariance
from graph_optimum import initial_values, optimize, read_estimate
from tests.forward import make_measurements
from tests.graph_cases import CASES, make_case, pose_error


@pytest.mark.parametrize("case", CASES)
def test_agrees_with_the_inverse_of_the_whole_hessian(case: str) -> None:
    explicit, shared, _ = make_case(91, noise=True, **CASES[case])
    values = optimize(explicit, initial_values(explicit, shared)).values
    covariance = GraphCovariance(explicit, values)
    order = (*explicit.private, *explicit.shared)
    hessian, _ = explicit.graph.linearize(values).hessian(make_ordering(order))
    scale = 1.0 / np.sqrt(np.diag(hessian))
    full = np.linalg.inv(hessian * np.outer(scale, scale)) * np.outer(scale, scale)
    sizes = [values.zeroVectors().at(key).size for key in order]
    ends = np.cumsum(sizes)
    places = {key: slice(end - size, end) for key, size, end in zip(order, sizes, ends, strict=True)}
    n = sum(sizes[len(explicit.private) :])
    np.testing.assert_allclose(covariance.shared(), full[-n:, -n:], rtol=1e-3, atol=1e-6 * np.abs(full[-n:, -n:]).max())
    for key in order:
        expected = full[places[key], places[key]]
        sigma = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(
            covariance.of(key) / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=2e-4
        )


def test_shared_covariances_can_be_asked_for_in_any_order() -> None:
    explicit, shared, _ = make_case(92, noise=True)
    covariance = GraphCovariance(explicit, initial_values(explicit, shared))
    registration, laser = explicit.keys.trus_T_camera[0], explicit.keys.marker_laser
    one, other = covariance.shared([registration, laser]), covariance.shared([laser, registration])
    np.testing.assert_array_equal(one[:6, 6:], other[4:, :4])
    np.testing.assert_array_equal(covariance.of(laser), other[:4, :4])


def test_errors_are_as_large_as_the_covariance_says() -> None:
    registration, points, angles, chi2 = [], [], [], []
    for seed in range(40):
        explicit, shared, truth = make_case(1000 + seed, noise=True, aims=15, pairs=25)
        optimum = optimize(explicit, initial_values(explicit, shared))
        estimate = read_estimate(explicit, optimum.values, shared)
        covariance = GraphCovariance(explicit, optimum.values)
        e = pose_error(estimate.shared.trus_T_camera[0], truth.trus_T_camera[0])
        registration.append(e @ np.linalg.solve(covariance.of(explicit.keys.trus_T_camera[0]), e))
        for pm, point in truth.trus_p_pm_mm.items():
            e = estimate.trus_p_pm_mm[pm] - point
            points.append(e @ np.linalg.solve(covariance.of(explicit.keys.trus_p_pm[pm]), e))
        for index, theta in enumerate(truth.theta_rad):
            angles.append((estimate.theta_rad[index] - theta) ** 2 / covariance.of(explicit.keys.theta[index])[0, 0])
        chi2.append(2.0 * optimum.cost)
    # 6, 3 and 1 are expected; the standard errors are 0.55 for the first, and less than a tenth for the others.
    assert 4.5 < np.mean(registration) < 7.8
    assert 2.5 < np.mean(points) < 3.5
    assert 0.8 < np.mean(angles) < 1.2
    # Twice the cost is a chi square of the redundancy: 2 an aim across the beam, 2 a pair (3 residuals and the
    # sensitivity prior less distance and angle), less 6 of the registration and 4 of the beam. (The window's
    # share of the noise is uniform, of the same variance.)
    redundancy = 2 * 15 + 2 * 25 - 6 - 4
    assert abs(np.mean(chi2) - redundancy) < 4.0 * np.sqrt(2.0 * redundancy / 40)


def test_too_few_pairs_leave_the_registration_undetermined() -> None:
    # A pair is two equations with the sensitivity prior, one without.
    for pairs in (1, 2):
        explicit, shared, _ = make_case(93, noise=True, pairs=pairs)
        with pytest.raises(EstimationError, match="do not determine"):
            GraphCovariance(explicit, initial_values(explicit, shared))


def test_optimizing_what_is_undetermined_still_ends_with_a_lower_cost() -> None:
    explicit, shared, _ = make_case(94, noise=True, pairs=3)
    values = initial_values(explicit, shared)
    optimum = optimize(explicit, values)
    assert optimum.cost < explicit.graph.error(values)


def test_an_epoch_without_pairs_has_the_covariance_of_the_motion() -> None:
    session, measurements, truth = make_measurements(np.random.default_rng(95), pairs=24, epochs=2, known_motion=True)
    measurements = replace(measurements, pairs=measurements.pairs[:12])
    explicit = build_graph(measurements, session, GraphOptions(marker_T_nominal=truth.marker_T_laser))
    shared = SharedValues(truth.trus_T_camera, np.zeros(4))
    optimum = optimize(explicit, initial_values(explicit, shared))
    covariance = GraphCovariance(explicit, optimum.values)
    estimate = read_estimate(explicit, optimum.values, shared)
    first, second = (covariance.of(key) for key in explicit.keys.trus_T_camera)
    assert np.trace(second[:3, :3]) > np.trace(first[:3, :3])
    motion = measurements.epochs[1].camera_new_T_camera_old
    assert motion is not None
    np.testing.assert_allclose(
        estimate.shared.trus_T_camera[1], estimate.shared.trus_T_camera[0] @ np.linalg.inv(motion), atol=1e-6
    )
