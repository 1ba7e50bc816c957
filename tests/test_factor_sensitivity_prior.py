"""Sensitivity prior: the window bounds the stage rotation, not the arc angle."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest

from fgreg.factors.rig import AS_DECLARED, RigKey
from fgreg.factors.sensitivity_prior import residual, sensitivity_prior_factor
from fgreg.geometry.rig import Constant
from fgreg.model.sensitivity import sensitivity_prior
from tests.forward import make_measurements, make_session, off_by
from tests.numerical import analytic_jacobian, jacobian_mismatch, numerical_jacobian

THETA, RIG = range(2)
DEG = math.pi / 180.0


@pytest.mark.parametrize("with_rig", [False, True])
def test_jacobians(with_rig: bool) -> None:
    rng = np.random.default_rng(31)
    for _ in range(100):
        values = gtsam.Values()
        scan = float(rng.uniform(-1, 1))
        values.insert(THETA, scan + float(rng.uniform(-1.5, 1.5)))
        values.insert(RIG, rng.uniform(-0.1, 0.1, 11))
        factor = sensitivity_prior_factor(
            THETA,
            scan,
            range_mm=float(rng.uniform(12, 80)),
            radius_mm=10.0,
            centre_rad=float(rng.uniform(-0.1, 0.1)),
            edge_gain=float(rng.choice([-1.0, 1.0])),
            sigma_rad=float(rng.uniform(0.005, 0.1)),
            rig=RigKey(RIG, tuple(range(11))) if with_rig else None,
            sweep=int(rng.choice([-1, 1])),
        )
        mismatch = jacobian_mismatch(factor, values)
        assert set(mismatch) == ({THETA, RIG} if with_rig else {THETA})
        assert max(mismatch.values()) < 1e-7, mismatch


def test_by_hand() -> None:
    # R = 10, r = 30, delta with sine 0.6, cosine 0.8 -> atan2(18, 34); expected at 5 deg, the edge 0.5 deg on.
    delta = math.asin(0.6)
    error, jacobians = residual(0.2 + delta, off_by(WINDOW_EDGE=0.5 * DEG), 0.2, 30.0, 10.0, 5.0 * DEG, 1.0)
    assert error[0] == pytest.approx(math.atan(18.0 / 34.0) - 5.5 * DEG, abs=1e-15)
    # d rotation / d delta = r (r + R cos) / D^2 = 30 * 38 / (18^2 + 34^2) = 1140 / 1480.
    assert jacobians[0][0][0] == pytest.approx(1140.0 / 1480.0, rel=1e-14)
    assert jacobians[1][0][Constant.WINDOW_EDGE] == -1.0


def test_six_degrees_of_rotation_are_eight_of_arc() -> None:
    error, _ = residual(math.radians(7.9968), AS_DECLARED, 0.0, 30.0, 10.0, 6.0 * DEG, 0.0)
    assert abs(math.degrees(error[0])) < 1e-4


@pytest.mark.parametrize("first_hit", [False, True])
@pytest.mark.parametrize("ratio", [1.0, 1.03])
def test_zero_at_truth(first_hit: bool, ratio: float) -> None:
    session = make_session(half_width_deg=(5.0, 6.0, 8.0))
    _, measurements, truth = make_measurements(
        np.random.default_rng(32),
        aims=0,
        pairs=20,
        noise=False,
        first_hit=first_hit,
        sound_speed_ratio=ratio,
        session=session,
    )
    for index, pair in enumerate(measurements.pairs):
        look = pair.look
        prior = sensitivity_prior(look, session.probe.sensitivity, session.stage.step_rad)
        theta = truth.theta_rad[index]
        error, _ = residual(
            theta,
            off_by(SOUND_SPEED=ratio - 1.0),
            look.scan_rad,
            look.range_mm,
            10.0,
            prior.centre_rad,
            prior.edge_gain,
        )
        assert abs(error[0]) < 1e-13


def test_error_is_wrapped() -> None:
    # The same direction a whole turn on is the same direction.
    for turns in (-2, -1, 1, 2):
        error, _ = residual(0.3 + math.tau * turns, AS_DECLARED, 0.1, 30.0, 10.0, 0.05, 0.0)
        here, _ = residual(0.3, AS_DECLARED, 0.1, 30.0, 10.0, 0.05, 0.0)
        assert error[0] == pytest.approx(here[0], abs=1e-12)
    # Behind the axis, beyond the cut: -179 deg less a centre of 5 deg is +176 deg.
    error, _ = residual(-179.0 * DEG, AS_DECLARED, 0.0, 30.0, 0.001, 5.0 * DEG, 0.0)
    assert math.degrees(error[0]) == pytest.approx(176.0, abs=0.01)


def test_window_only_does_not_depend_on_the_edge() -> None:
    _, measurements, _ = make_measurements(np.random.default_rng(33), aims=0, pairs=1, first_hit=False)
    look = measurements.pairs[0].look
    prior = sensitivity_prior(look, make_session().probe.sensitivity, 2.0 * DEG)
    values = gtsam.Values()
    values.insert(THETA, look.scan_rad + 0.02)
    values.insert(RIG, np.array([0.01]))
    rig = RigKey(RIG, (Constant.WINDOW_EDGE,))
    factor = sensitivity_prior_factor(
        THETA, look.scan_rad, look.range_mm, 10.0, prior.centre_rad, prior.edge_gain, prior.sigma_rad, rig
    )
    assert analytic_jacobian(factor, values, RIG) == 0.0
    assert numerical_jacobian(factor, values, RIG, 1e-3) == 0.0
