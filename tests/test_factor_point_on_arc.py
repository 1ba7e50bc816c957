"""Point on arc: centred on the element, range noise along the radius only."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest

from fgreg.factors.point_on_arc import point_on_arc_factor, residual
from fgreg.factors.rig import AS_DECLARED, RigKey
from fgreg.geometry.transforms import FloatArray
from tests.forward import make_measurements, off_by
from tests.numerical import jacobian_mismatch, whitened_error

POINT, THETA, RIG = range(3)
RADIUS = 10.0


def random_state(rng: np.random.Generator) -> gtsam.Values:
    values = gtsam.Values()
    values.insertPoint3(POINT, rng.uniform(-60, 60, 3))
    values.insert(THETA, float(rng.uniform(-4, 4)))
    values.insert(RIG, rng.uniform(-0.1, 0.1, 11))
    return values


def random_covariance(rng: np.random.Generator) -> FloatArray:
    root = rng.uniform(0.1, 0.5, (2, 2))
    return np.asarray(root @ root.T + 0.01 * np.eye(2))


@pytest.mark.parametrize("with_rig", [False, True])
def test_jacobians(with_rig: bool) -> None:
    rng = np.random.default_rng(21)
    for _ in range(100):
        values = random_state(rng)
        factor = point_on_arc_factor(
            POINT,
            THETA,
            float(rng.uniform(-1, 1)),
            float(rng.uniform(-20, 20)),
            float(rng.uniform(5, 80)),
            random_covariance(rng),
            RADIUS,
            RigKey(RIG, tuple(range(11))) if with_rig else None,
            int(rng.choice([-1, 1])),
        )
        mismatch = jacobian_mismatch(factor, values)
        assert set(mismatch) == ({0, 1, 2} if with_rig else {0, 1})
        assert max(mismatch.values()) < 1e-8, mismatch


@pytest.mark.parametrize("ratio", [1.0, 0.97])
def test_zero_at_truth(ratio: float) -> None:
    _, measurements, truth = make_measurements(
        np.random.default_rng(22), aims=0, pairs=20, noise=False, sound_speed_ratio=ratio
    )
    for index, pair in enumerate(measurements.pairs):
        look = pair.look
        p = truth.trus_p_pm_mm[pair.pm].tolist()
        constants = off_by(SOUND_SPEED=ratio - 1.0)
        error, _ = residual(p, truth.theta_rad[index], constants, look.scan_rad, look.x_mm, look.range_mm, RADIUS)
        assert np.abs(error).max() < 1e-12


def test_by_hand() -> None:
    # Stage at 0, so the element is at (4, 0, 10). theta with sine 0.6, cosine 0.8: 30 mm on is (4, 18, 34).
    theta = math.asin(0.6)
    # A PM at (5, 20, 34), 2 mm further along y: radially 2 * 0.6, tangentially 2 * 0.8.
    error, jacobians = residual((5.0, 20.0, 34.0), theta, AS_DECLARED, 0.0, 4.0, 30.0, RADIUS)
    np.testing.assert_allclose(error, [1.0, 1.2, 1.6], atol=1e-13)
    # Turning theta on takes the axes along: the radial error falls off by the tangential part, and back.
    np.testing.assert_allclose(jacobians[1], [[0.0], [1.6], [-31.2]], atol=1e-13)
    # 1 % more sound speed puts the arc 0.3 mm further out.
    slower, _ = residual((5.0, 20.0, 34.0), theta, off_by(SOUND_SPEED=0.01), 0.0, 4.0, 30.0, RADIUS)
    np.testing.assert_allclose(np.subtract(slower, error), [0.0, -0.3, 0.0], atol=1e-13)


def test_noise_is_the_looks_own() -> None:
    covariance = np.diag([0.3**2, 0.2**2])
    factor = point_on_arc_factor(POINT, THETA, 0.4, 2.0, 30.0, covariance, RADIUS)
    values = gtsam.Values()
    out = np.array([0.0, math.sin(0.5), math.cos(0.5)])
    element = np.array([2.0, RADIUS * math.sin(0.4), RADIUS * math.cos(0.4)])
    values.insertPoint3(POINT, element + 30.2 * out + [0.3, 0.0, 0.0])  # one sigma sideways, one outwards
    values.insert(THETA, 0.5)
    np.testing.assert_allclose(np.abs(whitened_error(factor, values)), [1.0, 1.0, 0.0], atol=1e-9)


def test_correlated_covariance_counts_as_such() -> None:
    covariance = np.array([[0.09, 0.04], [0.04, 0.05]])
    factor = point_on_arc_factor(POINT, THETA, 0.0, 0.0, 30.0, covariance, RADIUS)
    values = gtsam.Values()
    values.insertPoint3(POINT, np.array([0.3, 0.0, 40.5]))
    values.insert(THETA, 0.0)
    miss = np.array([0.3, 0.5])
    assert factor.error(values) == pytest.approx(0.5 * miss @ np.linalg.solve(covariance, miss), rel=1e-10)


def test_noise_of_the_stage_reading_is_negligible_across_the_arc() -> None:
    # What the module's docstring claims: 0.1 deg moves the centre 0.0175 mm, and off the arc itself far less.
    point = (0.0, 40.0 * math.sin(0.1), 40.0 * math.cos(0.1))
    misses = []
    for scan in (0.0, math.radians(0.1)):
        element = (0.0, RADIUS * math.sin(scan), RADIUS * math.cos(scan))
        theta = math.atan2(point[1] - element[1], point[2] - element[2])
        misses.append(residual(point, theta, AS_DECLARED, scan, 0.0, 30.0, RADIUS, want_jacobians=False)[0])
    assert abs(RADIUS * math.radians(0.1)) < 0.02
    assert abs(misses[1][1] - misses[0][1]) < 0.003  # against a range sigma of 0.2
