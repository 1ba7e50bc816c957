"""Marker pose: the detection's own covariance, in the right tangent, and its constant bias."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest

from fgreg.factors.marker_pose import marker_pose_factor, residual
from fgreg.factors.rig import AS_DECLARED, RigKey
from fgreg.geometry.rig import COUNT, Constant
from fgreg.geometry.transforms import FloatArray, exp_so3, make_transform
from fgreg.model.measurements import default_marker_covariance
from fgreg.model.session_model import NoiseModel
from tests.numerical import jacobian_mismatch, random_pose, whitened_error

POSE, RIG = range(2)
BIAS = (Constant.MARKER_BIAS_X, Constant.MARKER_BIAS_Y, Constant.MARKER_BIAS_Z)
BIAS_GAIN = np.zeros((6, COUNT))
BIAS_GAIN[3:, BIAS] = -np.eye(3)


def biased(bias_mm: list[float]) -> list[float]:
    """All constants as declared but for the marker's bias."""
    out = list(AS_DECLARED)
    out[BIAS[0] : BIAS[-1] + 1] = bias_mm
    return out


def random_covariance(rng: np.random.Generator) -> FloatArray:
    root = rng.normal(size=(6, 6)) * np.array([0.01] * 3 + [0.3] * 3)[:, None]
    return np.asarray(root @ root.T + np.diag([1e-5] * 3 + [1e-3] * 3))


@pytest.mark.parametrize("with_rig", [False, True])
def test_jacobians(with_rig: bool) -> None:
    rng = np.random.default_rng(51)
    for _ in range(100):
        pose = random_pose(rng)
        # Up to some 1.5 rad and 10 mm from the detection: the derivative of Log is far from the identity there.
        observed = pose.retract(np.concatenate([rng.uniform(-0.9, 0.9, 3), rng.uniform(-10, 10, 3)]))
        values = gtsam.Values()
        values.insert(POSE, pose)
        values.insert(RIG, rng.uniform(-0.2, 0.2, COUNT))
        gain = rng.normal(size=(6, COUNT)) * np.array([0.3] * 3 + [3.0] * 3)[:, None]
        rig = RigKey(RIG, tuple(range(COUNT))) if with_rig else None
        factor = marker_pose_factor(POSE, observed.matrix(), random_covariance(rng), gain, rig)
        mismatch = jacobian_mismatch(factor, values)
        assert set(mismatch) == ({POSE, RIG} if with_rig else {POSE})
        assert max(mismatch.values()) < 1e-8, mismatch


def test_native_prior_is_the_same_as_the_residual_without_bias() -> None:
    rng = np.random.default_rng(52)
    for _ in range(20):
        pose = random_pose(rng)
        observed = pose.retract(rng.uniform(-0.5, 0.5, 6))
        values = gtsam.Values()
        values.insert(POSE, pose)
        native = marker_pose_factor(POSE, observed.matrix(), np.eye(6))
        error, jacobians = residual(pose, AS_DECLARED, observed, BIAS_GAIN)
        np.testing.assert_allclose(native.unwhitenedError(values), error, atol=1e-12)
        np.testing.assert_allclose(native.linearize(values).jacobian()[0], np.array(jacobians[0]), atol=1e-9)


def test_zero_at_truth() -> None:
    rng = np.random.default_rng(53)
    pose, bias = random_pose(rng), rng.uniform(-2, 2, 3)
    observed = gtsam.Pose3(pose.rotation(), pose.translation() + bias)  # observed = true + bias
    error, _ = residual(pose, biased(bias.tolist()), observed, BIAS_GAIN)
    assert np.abs(error).max() < 1e-12


def test_by_hand() -> None:
    # A marker turned a quarter turn about the camera's z: its x axis is the camera's y. Observed 3 mm further along
    # the camera's y, of which 1 mm is bias: the pose is 2 mm back along the marker's own x.
    quarter = exp_so3(np.array([0.0, 0.0, math.pi / 2]))
    pose = gtsam.Pose3(make_transform(quarter, np.array([5.0, 0.0, 80.0])))
    observed = gtsam.Pose3(make_transform(quarter, np.array([5.0, 3.0, 80.0])))
    error, _ = residual(pose, biased([0.0, 1.0, 0.0]), observed, BIAS_GAIN)
    np.testing.assert_allclose(error, [0.0, 0.0, 0.0, -2.0, 0.0, 0.0], atol=1e-13)


def test_covariance_is_in_the_right_tangent_of_the_observed_pose() -> None:
    # The marker lies on its side: 0.8 mm of depth noise is along the marker's own x, whatever the camera calls it.
    side = exp_so3(np.array([0.0, math.pi / 2, 0.0]))  # marker x -> camera -z
    observed = make_transform(side, np.array([0.0, 0.0, 100.0]))
    covariance = default_marker_covariance(observed, NoiseModel())
    factor = marker_pose_factor(POSE, observed, covariance)
    for offset, sigmas in (((0.0, 0.0, 0.8), 1.0), ((0.1, 0.0, 0.0), 1.0), ((0.0, 0.0, 0.1), 0.125)):
        values = gtsam.Values()
        values.insert(POSE, gtsam.Pose3(make_transform(side, np.array([0.0, 0.0, 100.0]) + offset)))
        assert float(np.linalg.norm(whitened_error(factor, values))) == pytest.approx(sigmas, rel=1e-9)


@pytest.mark.parametrize("with_bias", [False, True])
def test_normalised_error_of_simulated_detections_is_one(with_bias: bool) -> None:
    # The format's noise, drawn about the camera's axes; the covariance is of the right tangent.
    rng = np.random.default_rng(54)
    noise = NoiseModel(marker_translation_mm=(0.1, 0.2, 0.8), marker_rotation_rad=(0.01, 0.02, 0.03))
    bias = np.array([0.5, -0.4, 0.3]) if with_bias else np.zeros(3)
    total, n = np.zeros((6, 6)), 3000
    for _ in range(n):
        pose = random_pose(rng).matrix()
        w = rng.normal(size=3) * noise.marker_rotation_rad
        t = rng.normal(size=3) * noise.marker_translation_mm
        observed = make_transform(exp_so3(w) @ pose[:3, :3], pose[:3, 3] + t + bias)
        covariance = default_marker_covariance(observed, noise)
        values = gtsam.Values()
        values.insert(POSE, gtsam.Pose3(pose))
        values.insert(RIG, bias)
        rig = RigKey(RIG, BIAS) if with_bias else None
        e = whitened_error(marker_pose_factor(POSE, observed, covariance, BIAS_GAIN, rig), values)
        total += np.outer(e, e)
    np.testing.assert_allclose(total / n, np.eye(6), atol=5.0 * math.sqrt(2.0 / n))
