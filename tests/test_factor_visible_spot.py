"""Visible spot: the PM, seen from the camera, is where the camera sees the laser's spot."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest

from fgreg.factors.adapter import FactorError
from fgreg.factors.rig import AS_DECLARED, RigKey
from fgreg.factors.visible_spot import residual, visible_spot_factor
from fgreg.geometry.rig import COUNT, Constant
from tests.forward import make_measurements, off_by
from tests.numerical import jacobian_mismatch, random_pose, whitened_error

POSE, POINT, RIG = range(3)
NO_GAIN = np.zeros((3, COUNT))
CONSTANTS = (Constant.WINDOW_EDGE, Constant.CAMERA_SCALE, Constant.FOCAL_LEFT)


def test_jacobians() -> None:
    rng = np.random.default_rng(31)
    for rig in (None, RigKey(RIG, CONSTANTS)):
        for _ in range(50):
            values = gtsam.Values()
            values.insert(POSE, random_pose(rng))
            values.insertPoint3(POINT, rng.uniform(-60, 60, 3))
            values.insert(RIG, rng.normal(size=len(CONSTANTS)) * 0.01)
            root = rng.normal(size=(3, 3))
            spread, gain = root @ root.T + np.eye(3), rng.normal(size=(3, COUNT)) * 50.0
            factor = visible_spot_factor(POSE, POINT, rng.uniform(-30, 130, 3), spread, gain, rig)
            mismatch = jacobian_mismatch(factor, values)
            assert set(mismatch) == ({POSE, POINT} if rig is None else {POSE, POINT, RIG})
            assert max(mismatch.values()) < 1e-8, mismatch


def test_zero_at_truth() -> None:
    _, measurements, truth = make_measurements(
        np.random.default_rng(32), aims=0, pairs=5, noise=False, spot_sigma_mm=(0.4, 0.4, 2.0)
    )
    for pair in measurements.pairs:
        assert pair.spot is not None
        point, spot = truth.trus_p_pm_mm[pair.pm].tolist(), pair.spot.camera_p_mm.tolist()
        error, _ = residual(truth.trus_T_camera[0].tolist(), point, AS_DECLARED, spot, NO_GAIN)
        assert np.abs(error).max() < 1e-11


def test_by_hand() -> None:
    # The camera looks along TRUS -z from 100 mm above: TRUS (7, -30, 55) is (7, 30, 45) in the camera's frame.
    trus_T_camera = [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 100.0], [0.0, 0.0, 0.0, 1.0]]
    # A baseline 1 % longer than declared: what was seen at (8, 30, 40) is truly at (8.08, 30.3, 40.4).
    gain = NO_GAIN.copy()
    gain[:, Constant.CAMERA_SCALE] = 8.0, 30.0, 40.0
    error, (by_pose, by_point, by_rig) = residual(
        trus_T_camera, (7.0, -30.0, 55.0), off_by(CAMERA_SCALE=0.01), (8.0, 30.0, 40.0), gain
    )
    np.testing.assert_allclose(error, [-1.08, -0.3, 4.6], atol=1e-13)
    # The camera turns by w about its own z: the PM moves by -w x p = w (30, -7, 0).
    np.testing.assert_allclose([row[2] for row in by_pose], [30.0, -7.0, 0.0], atol=1e-13)
    np.testing.assert_allclose(by_point, np.diag([1.0, -1.0, -1.0]), atol=1e-15)
    assert by_rig[2][Constant.CAMERA_SCALE] == -40.0


def test_the_depth_counts_less_than_what_lies_across_with_constants_as_declared() -> None:
    values = gtsam.Values()
    values.insert(POSE, gtsam.Pose3())
    values.insertPoint3(POINT, np.array([0.0, 1.0, 103.0]))
    factor = visible_spot_factor(POSE, POINT, np.array([0.0, 0.0, 100.0]), np.diag([0.25, 0.25, 9.0]), NO_GAIN + 5.0)
    np.testing.assert_allclose(whitened_error(factor, values), [0.0, 2.0, 1.0], atol=1e-12)


def test_a_state_that_is_not_finite_is_refused() -> None:
    values = gtsam.Values()
    values.insert(POSE, gtsam.Pose3())
    values.insertPoint3(POINT, np.array([0.0, math.nan, 0.0]))
    factor = visible_spot_factor(POSE, POINT, np.zeros(3), np.eye(3), NO_GAIN)
    with pytest.raises(FactorError, match="visible spot"):
        factor.linearize(values)
