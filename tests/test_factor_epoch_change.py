"""Epoch change: which way round the camera's motion goes, and whose tangent its covariance is over."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest

from fgreg.factors.epoch_change import epoch_change_factor
from fgreg.geometry.transforms import exp_so3, inverse, make_transform
from tests.forward import make_measurements
from tests.numerical import jacobian_mismatch, random_pose, whitened_error

OLD, NEW = range(2)


def test_jacobians() -> None:
    rng = np.random.default_rng(61)
    for _ in range(100):
        old, motion = random_pose(rng), random_pose(rng, 20.0)
        new = old.compose(motion.inverse())
        values = gtsam.Values()
        values.insert(OLD, old)
        values.insert(NEW, new.retract(np.concatenate([rng.uniform(-0.8, 0.8, 3), rng.uniform(-10, 10, 3)])))
        factor = epoch_change_factor(OLD, NEW, motion.matrix(), np.diag([0.01] * 3 + [0.3] * 3))
        mismatch = jacobian_mismatch(factor, values)
        assert set(mismatch) == {OLD, NEW}
        assert max(mismatch.values()) < 1e-8, mismatch


def test_zero_at_truth() -> None:
    _, measurements, truth = make_measurements(
        np.random.default_rng(62), aims=0, pairs=6, epochs=3, known_motion=True, noise=False
    )
    for k in (1, 2):
        start = measurements.epochs[k]
        assert start.camera_new_T_camera_old is not None
        assert start.covariance is not None
        values = gtsam.Values()
        values.insert(OLD, gtsam.Pose3(truth.trus_T_camera[k - 1]))
        values.insert(NEW, gtsam.Pose3(truth.trus_T_camera[k]))
        factor = epoch_change_factor(OLD, NEW, start.camera_new_T_camera_old, start.covariance)
        assert factor.error(values) < 1e-20


def test_by_hand() -> None:
    # The camera moves 10 mm along its own x: what it sees shifts by -10 mm in x. TRUS and camera aligned before.
    camera_new_T_camera_old = make_transform(np.eye(3), np.array([-10.0, 0.0, 0.0]))
    values = gtsam.Values()
    values.insert(OLD, gtsam.Pose3())
    values.insert(NEW, gtsam.Pose3(gtsam.Rot3(), np.array([10.0, 0.0, 0.0])))  # the camera is now 10 mm on
    factor = epoch_change_factor(OLD, NEW, camera_new_T_camera_old, np.eye(6))
    np.testing.assert_allclose(factor.unwhitenedError(values), 0.0, atol=1e-14)
    values.update(NEW, gtsam.Pose3(gtsam.Rot3(), np.array([12.0, 0.0, 0.0])))  # 2 mm too far
    np.testing.assert_allclose(factor.unwhitenedError(values), [0, 0, 0, -2.0, 0, 0], atol=1e-14)


def test_covariance_is_over_the_right_tangent_of_the_motion() -> None:
    rng = np.random.default_rng(63)
    sigma = np.array([0.01, 0.002, 0.005, 0.1, 0.5, 1.0])
    motion = random_pose(rng, 20.0).matrix()
    old = random_pose(rng)
    values = gtsam.Values()
    values.insert(OLD, old)
    values.insert(NEW, gtsam.Pose3(old.matrix() @ inverse(motion)))
    n, total = 2000, np.zeros((6, 6))
    for _ in range(n):
        xi = rng.normal(size=6) * sigma
        measured = motion @ make_transform(exp_so3(xi[:3]), xi[3:])
        e = whitened_error(epoch_change_factor(OLD, NEW, measured, np.diag(sigma**2)), values)
        total += np.outer(e, e)
    np.testing.assert_allclose(total / n, np.eye(6), atol=5.0 * math.sqrt(2.0 / n))


def test_a_covariance_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="shape"):
        epoch_change_factor(OLD, NEW, np.eye(4), np.eye(3))
