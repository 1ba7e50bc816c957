"""The rig's constants in a factor: which of them a variable holds, and an aimed-at spot that depends on them."""

from __future__ import annotations

import gtsam
import numpy as np

from fgreg.factors.marker_pose import marker_pose_factor
from fgreg.factors.rig import RigKey, rig_prior_factor, spot_factor
from fgreg.geometry.rig import COUNT
from tests.numerical import jacobian_mismatch, whitened_error

SPOT, RIG = range(2)
HELD = (2, 5, 11)


def test_a_spot_moves_with_the_constants_by_their_gain() -> None:
    rng = np.random.default_rng(61)
    gain = rng.normal(size=(3, COUNT))
    covariance = np.diag([0.04, 0.09, 0.25])
    factor = spot_factor(SPOT, np.array([1.0, 2.0, 80.0]), covariance, gain, RigKey(RIG, HELD))
    values = gtsam.Values()
    values.insert(SPOT, np.array([1.5, 1.0, 83.0]))
    held = np.array([0.2, -1.0, 3.0])
    values.insert(RIG, held)
    expected = np.array([0.5, -1.0, 3.0]) - sum(gain[:, c] * x for c, x in zip(HELD, held, strict=True))
    np.testing.assert_allclose(whitened_error(factor, values), expected / np.array([0.2, 0.3, 0.5]), atol=1e-9)
    mismatch = jacobian_mismatch(factor, values)
    assert set(mismatch) == {SPOT, RIG}
    assert max(mismatch.values()) < 1e-8


def test_constants_that_are_no_variables_are_as_declared() -> None:
    values = gtsam.Values()
    values.insert(RIG, np.array([4.0, 5.0, 6.0]))
    expected = np.zeros(COUNT)
    expected[list(HELD)] = 4.0, 5.0, 6.0
    assert RigKey(RIG, HELD).read(values) == expected.tolist()


def test_the_prior_weighs_by_its_information() -> None:
    information = np.array([[4.0, 1.0, 0.0], [1.0, 3.0, 0.0], [0.0, 0.0, 2.0]])
    factor = rig_prior_factor(RigKey(RIG, HELD), np.array([1.0, 0.0, 0.0]), information)
    values = gtsam.Values()
    values.insert(RIG, np.array([2.0, 3.0, -1.0]))
    e = np.array([1.0, 3.0, -1.0])
    assert factor.error(values) == 0.5 * float(e @ information @ e)


def test_a_pose_that_no_constant_of_the_variable_moves_has_one_variable() -> None:
    gain = np.zeros((6, COUNT))
    gain[0, 3] = 1.0
    for held, keys in (((2,), [SPOT]), ((2, 3), [SPOT, RIG])):
        assert list(marker_pose_factor(SPOT, np.eye(4), np.eye(6), gain, RigKey(RIG, held)).keys()) == keys
