"""Rotations and transforms against GTSAM and hand-made numbers."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest

from fgreg.geometry.transforms import (
    adjoint,
    as_float_array,
    exp_so3,
    hat,
    inverse,
    is_rigid,
    log_so3,
    make_transform,
    nearest_rotation,
    parent_from_right_covariance,
    right_from_parent_covariance,
    rotation_to_direction,
    transform_points,
)


@pytest.mark.parametrize("size", [1e-9, 1e-4, 0.3, 2.0, math.pi - 1e-6])
def test_exponential_and_logarithm_are_gtsams_and_inverse(size: float) -> None:
    w = np.random.default_rng(0).normal(size=(30, 3))
    w *= size / np.linalg.norm(w, axis=1, keepdims=True)
    r = exp_so3(w)
    np.testing.assert_allclose(r, [gtsam.Rot3.Expmap(v).matrix() for v in w], atol=1e-12)
    np.testing.assert_allclose(log_so3(r), w, atol=1e-8)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-4, 0.3, 2.0, math.pi - 1e-6])
def test_a_single_rotation_is_what_it_is_among_many(size: float) -> None:
    w = np.random.default_rng(1).normal(size=(30, 3))
    w *= size / np.linalg.norm(w, axis=1, keepdims=True)
    r = exp_so3(w)
    np.testing.assert_allclose([exp_so3(v) for v in w], r, atol=1e-14)
    np.testing.assert_allclose([log_so3(m) for m in r], log_so3(r), atol=1e-14)
    assert exp_so3(w[None, :1]).shape == (1, 1, 3, 3)
    assert log_so3(r[None, :1]).shape == (1, 1, 3)


def test_a_single_rotation_by_what_is_no_number_is_none() -> None:
    assert np.isnan(exp_so3(np.array([math.inf, 0.0, 0.0]))).any()
    assert np.isnan(log_so3(np.full((3, 3), math.nan))).any()


def test_half_a_turn_has_a_logarithm_of_length_pi() -> None:
    for axis in (np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), np.array([0, 0.6, 0.8])):
        w = log_so3(exp_so3(math.pi * axis))
        assert np.linalg.norm(w) == pytest.approx(math.pi)
        np.testing.assert_allclose(np.abs(w @ axis), math.pi)


def test_a_quarter_turn_about_x_takes_y_to_z() -> None:
    a_T_b = make_transform(exp_so3(np.array([math.pi / 2, 0, 0])), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(transform_points(a_T_b, np.array([0.0, 1.0, 0.0])), [1.0, 2.0, 4.0], atol=1e-12)
    np.testing.assert_allclose(inverse(a_T_b) @ a_T_b, np.eye(4), atol=1e-12)


def test_hat_is_the_cross_product() -> None:
    a, b = np.array([1.0, 2.0, 3.0]), np.array([-4.0, 5.0, 0.5])
    np.testing.assert_allclose(hat(a) @ b, np.cross(a, b))


def test_adjoint_is_gtsams() -> None:
    a_T_b = make_transform(exp_so3(np.array([0.3, -0.2, 0.9])), np.array([5.0, -3.0, 8.0]))
    np.testing.assert_allclose(adjoint(a_T_b), gtsam.Pose3(a_T_b).AdjointMap(), atol=1e-12)


def test_direction_rotation_turns_z_onto_it_by_the_least() -> None:
    for direction in (np.array([0.6, 0.0, 0.8]), np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])):
        r = rotation_to_direction(direction)
        np.testing.assert_allclose(r[:, 2], direction, atol=1e-12)
        assert np.linalg.det(r) == pytest.approx(1.0)
        assert np.linalg.norm(log_so3(r)) == pytest.approx(math.acos(direction[2]), abs=1e-7)


def test_covariances_change_axes_and_back() -> None:
    r = exp_so3(np.array([0.1, 0.7, -0.4]))
    covariance = np.diag([1.0, 4.0, 9.0, 16.0, 25.0, 36.0])
    right = right_from_parent_covariance(r, covariance)
    np.testing.assert_allclose(right[:3, :3], r.T @ covariance[:3, :3] @ r)
    np.testing.assert_allclose(parent_from_right_covariance(r, right), covariance, atol=1e-12)


def test_arrays_are_copied_frozen_and_checked() -> None:
    source = np.eye(4)
    frozen = as_float_array(source, 4, 4)
    source[0, 0] = 5.0
    assert frozen[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        frozen[0, 0] = 2.0
    with pytest.raises(ValueError, match="expected"):
        as_float_array(np.eye(3), 4, 4)
    with pytest.raises(ValueError, match="not finite"):
        as_float_array([1.0, math.nan])


def test_reflections_and_stretches_are_not_rigid() -> None:
    assert is_rigid(np.eye(4))
    assert not is_rigid(np.diag([1.0, 1.0, -1.0, 1.0]))
    assert not is_rigid(np.diag([1.01, 1.0, 1.0, 1.0]))
    assert not is_rigid(np.diag([1.0, 1.0, 1.0, 2.0]))
    for bad in (math.nan, math.inf):
        for at in ((0, 1), (1, 3), (3, 0)):
            matrix = np.eye(4)
            matrix[at] = bad
            assert not is_rigid(matrix)
    np.testing.assert_allclose(nearest_rotation(np.diag([1.2, 0.9, 1.1])), np.eye(3), atol=1e-12)
