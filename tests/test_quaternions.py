"""Quaternions against figures by hand, there and back, and where they are none."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fgreg.geometry.quaternions import quaternion_from_rotation, rotation_from_quaternion, turn_about_x
from fgreg.geometry.transforms import as_float_array, exp_so3


def test_a_turn_about_x_by_hand() -> None:
    # Half angle with sine 0.6: the turn's cosine is 1 - 2 * 0.36 = 0.28, its sine 2 * 0.6 * 0.8 = 0.96.
    expected = as_float_array([[1, 0, 0], [0, 0.28, -0.96], [0, 0.96, 0.28]])
    np.testing.assert_allclose(rotation_from_quaternion(0.6, 0.0, 0.0, 0.8), expected, atol=1e-12)
    assert quaternion_from_rotation(expected) == pytest.approx((0.6, 0.0, 0.0, 0.8))


def test_there_and_back_at_random_half_a_turn_and_none() -> None:
    rng = np.random.default_rng(1)
    turns = [exp_so3(rng.normal(size=3)) for _ in range(50)]
    for rotation in [np.eye(3), np.diag([-1.0, 1.0, -1.0]), np.diag([1.0, -1.0, -1.0]), *turns]:
        found = quaternion_from_rotation(rotation)
        assert found[3] >= 0.0
        np.testing.assert_allclose(rotation_from_quaternion(*found), rotation, atol=1e-9)
        minus = (-value for value in found)
        np.testing.assert_allclose(rotation_from_quaternion(*minus), rotation, atol=1e-9)


@pytest.mark.parametrize("values", [(0.5, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0)])
def test_what_is_no_unit_quaternion_is_refused(values: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValueError, match="a quaternion of length"):
        rotation_from_quaternion(*values)


def test_the_stage_angle_of_a_probe_is_where_its_z_axis_points() -> None:
    t = math.radians(20.0)
    # Columns: the probe's axes in its holder's frame; z along (0, sin t, cos t).
    rotation = as_float_array([[1, 0, 0], [0, math.cos(t), math.sin(t)], [0, -math.sin(t), math.cos(t)]])
    assert turn_about_x(rotation) == pytest.approx(t)
    with pytest.raises(ValueError, match="not about x"):
        turn_about_x(exp_so3(np.array([0.0, 0.3, 0.0])))
