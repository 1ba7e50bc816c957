"""Known point: the registration has a point that both devices locate where the scanner has it."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from fgreg.factors.adapter import FactorError
from fgreg.factors.known_point import known_point_factor, residual
from fgreg.factors.rig import AS_DECLARED, RigKey
from fgreg.geometry.rig import COUNT, Constant
from fgreg.model.scanner_dependence import scanner_gain
from tests.forward import make_measurements, off_by
from tests.numerical import jacobian_mismatch, random_pose

POSE, POINT, RIG = range(3)
CONSTANTS = (Constant.WINDOW_EDGE, Constant.RADIUS, Constant.PITCH)


def test_jacobians() -> None:
    rng = np.random.default_rng(41)
    for _ in range(50):
        values = gtsam.Values()
        values.insert(POSE, random_pose(rng))
        values.insertPoint3(POINT, rng.uniform(-60, 130, 3))
        values.insert(RIG, rng.normal(size=len(CONSTANTS)) * 0.1)
        root, shown = rng.normal(size=(3, 3)), rng.normal(size=(3, COUNT)) * 10.0
        spread, trus_p = root @ root.T + np.eye(3), rng.uniform(-40, 40, 3)
        factor = known_point_factor(POSE, POINT, trus_p, spread, shown, RigKey(RIG, CONSTANTS))
        mismatch = jacobian_mismatch(factor, values)
        assert set(mismatch) == {POSE, POINT, RIG}
        assert max(mismatch.values()) < 1e-8, mismatch


def test_zero_at_truth() -> None:
    _, measurements, truth = make_measurements(np.random.default_rng(42), aims=0, pairs=4, points=3, noise=False)
    for point in measurements.points:
        places = point.camera_p_mm.tolist(), AS_DECLARED, point.trus_p_mm.tolist(), np.zeros((3, COUNT))
        error, _ = residual(truth.trus_T_camera[0].tolist(), *places)
        assert np.abs(error).max() < 1e-11


def test_by_hand() -> None:
    # The camera looks along TRUS -z from 100 mm above: (7, 30, 45) of the camera is (7, -30, 55) in TRUS.
    trus_T_camera = [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 100.0], [0.0, 0.0, 0.0, 1.0]]
    # At 45 deg to -y, 50 mm from the axis, 40 from the element. 2 % more pitch: it truly is 0.14 mm further along;
    # 1 mm more radius: 1 mm further out, which is (0, -0.6, 0.8).
    shown = scanner_gain(10.0, np.array([[7.0, -30.0, 40.0]]))[0]
    constants = off_by(PITCH=0.02, RADIUS=1.0)
    error, (by_pose, by_point, by_rig) = residual(
        trus_T_camera, (7.0, 30.0, 45.0), constants, (7.0, -30.0, 40.0), shown
    )
    np.testing.assert_allclose(error, [-0.14, 0.6, 14.2], atol=1e-12)
    # The camera turned by w about its own x: the point goes by w x p = w (0, -45, 30), in TRUS w (0, 45, -30).
    np.testing.assert_allclose([row[0] for row in by_pose], [0.0, 45.0, -30.0], atol=1e-13)
    np.testing.assert_allclose(by_point, np.diag([1.0, -1.0, -1.0]), atol=1e-15)
    assert by_rig[0][Constant.PITCH] == -7.0
    # A range 1 % too short: 0.4 mm further out. An array 1 mm beside the axis, towards larger angles (0, 0.8, 0.6).
    np.testing.assert_allclose(shown[:, Constant.SOUND_SPEED], [0.0, -24.0, 32.0], atol=1e-12)
    np.testing.assert_allclose(shown[:, Constant.ARRAY_OFFSET], [0.0, 0.8, 0.6], atol=1e-12)


def test_a_state_that_is_not_finite_is_refused() -> None:
    values = gtsam.Values()
    values.insert(POSE, gtsam.Pose3())
    values.insertPoint3(POINT, np.array([0.0, np.inf, 0.0]))
    values.insert(RIG, np.zeros(len(CONSTANTS)))
    factor = known_point_factor(POSE, POINT, np.zeros(3), np.eye(3), np.zeros((3, COUNT)), RigKey(RIG, CONSTANTS))
    with pytest.raises(FactorError, match="known point"):
        factor.linearize(values)
