"""Rendered tags: accuracy, honest covariance, and what is found at the image's border."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgreg.detection.body_pose import choose_pose
from fgreg.detection.corner_noise import pool_corner_noise
from fgreg.detection.marker import detect_marker
from fgreg.detection.pose_least_squares import CornerSet, common_covariance, corner_residuals, fit_pose
from fgreg.detection.results import MarkerFit, NotFound, RigidFit, marker_covariance
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, exp_so3, make_transform, transform_points
from fgreg.model.camera_model import StereoRig
from tests.marker_scene import (
    LEFT,
    ONE_TAG,
    RIG,
    RIGHT_T_LEFT,
    Frame,
    facing_pose,
    frames_of,
    left_pixels,
    pose_error,
    rotation_error_deg,
    surfaces_of,
)

VIEWS = 14


@pytest.fixture(scope="module")
def shots() -> list[tuple[FloatArray, Frame, Frame]]:
    rng = np.random.default_rng(7)
    out = []
    for i in range(VIEWS):
        z = rng.uniform(90, 180)
        where = (float(rng.uniform(-0.2, 0.2) * z), float(rng.uniform(-0.1, 0.1) * z), float(z))
        true = facing_pose(where, *rng.uniform((5, -180, -180), (45, 180, 180)))
        out.append((true, *frames_of(surfaces_of(ONE_TAG, true), seed=i, blur_px=rng.uniform(0.6, 1.4))))
    return out


@pytest.mark.parametrize("stereo", [True, False])
def test_accuracy_and_honest_covariance(shots: list[tuple[FloatArray, Frame, Frame]], stereo: bool) -> None:
    fits, errors, offsets = [], [], []
    for true, left, right in shots:
        fit = detect_marker(left, right if stereo else None, RIG, ONE_TAG)
        assert isinstance(fit, MarkerFit)
        assert fit.pose.views == (("left", "right") if stereo else ("left",))
        assert fit.pose.corners == (8 if stereo else 4)
        fits.append(fit)
        errors.append(pose_error(true, fit.camera_T_marker))
        offsets.append(fit.camera_T_marker[:3, 3] - true[:3, 3])
    dt = np.array(offsets)
    assert np.degrees(np.median([np.linalg.norm(e[:3]) for e in errors])) < 0.02
    assert np.median(np.linalg.norm(dt[:, :2], axis=1)) < 0.004
    assert np.median(np.abs(dt[:, 2])) < 0.015
    assert abs(dt[:, 2].mean()) < 0.01
    noise = pool_corner_noise(fit.pose for fit in fits)
    squares = [e @ np.linalg.solve(marker_covariance(f, noise), e) for e, f in zip(errors, fits, strict=True)]
    assert 2.5 < np.mean(squares) < 12.0  # 6 expected; the study over 500 views has the narrow bounds


@pytest.mark.parametrize("margin_px", [1.5, 3.0, 6.0])
@pytest.mark.parametrize("square_on", [True, False])
def test_tags_near_the_border_are_found(margin_px: float, square_on: bool) -> None:
    true = _pushed_to_the_left(margin_px, square_on)
    fit = detect_marker(frames_of(surfaces_of(ONE_TAG, true))[0], None, RIG, ONE_TAG)
    assert isinstance(fit, MarkerFit)
    assert rotation_error_deg(true, fit.camera_T_marker) < 0.1
    assert np.linalg.norm(fit.camera_T_marker[:3, 3] - true[:3, 3]) < 0.1


@pytest.mark.parametrize("margin_px", [-1.0, -3.0, -12.0])
@pytest.mark.parametrize("square_on", [True, False])
def test_a_tag_cut_by_the_border_is_refused_or_right(margin_px: float, square_on: bool) -> None:
    true = _pushed_to_the_left(margin_px, square_on)
    fit = detect_marker(frames_of(surfaces_of(ONE_TAG, true))[0], None, RIG, ONE_TAG)
    if isinstance(fit, NotFound):
        assert "tag 0" in fit.reason or "corners" in fit.reason
    else:
        assert np.linalg.norm(fit.camera_T_marker[:3, 3] - true[:3, 3]) < 0.1


def _pushed_to_the_left(margin_px: float, square_on: bool) -> FloatArray:
    rotation = np.diag([1.0, -1.0, -1.0]) @ (exp_so3(np.array([0.1, 0.2, 0.0 if square_on else 0.6])))
    low, high = -0.8, 0.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        pose = make_transform(rotation, np.array([middle * 130.0, 5.0, 130.0]))
        edge = left_pixels(pose, ONE_TAG.tags[0].marker_p_corners_mm)[:, 0].min()
        low, high = (middle, high) if edge < margin_px else (low, middle)
    return pose


def corner_set(camera_T_body: FloatArray, noise_px: float = 0.0) -> CornerSet:
    """Eight corners of a 30 mm square in two views, exact but for noise."""
    body = np.tile(ONE_TAG.tags[0].marker_p_corners_mm, (2, 1))
    views = np.repeat(np.stack([np.eye(4), RIGHT_T_LEFT]), 4, axis=0)
    p = transform_points(views @ camera_T_body, body)
    ideal = 1000.0 * p[:, :2] / p[:, 2:] + noise_px * np.random.default_rng(0).normal(size=(8, 2))
    view = np.repeat([0, 1], 4).astype(np.int64)
    focal = np.full((8, 2), 1000.0)
    by_lens = np.concatenate([ideal[..., None], np.broadcast_to(np.eye(2), (8, 2, 2))], axis=-1)
    return CornerSet(
        body, ideal, view, view, 0.01 * np.eye(16), np.full(8, 0.1), np.zeros((8, 2)), focal, views, by_lens
    )


def test_residual_jacobian_against_differences() -> None:
    pose = facing_pose((10.0, -5.0, 120.0), 25.0)
    corners = corner_set(facing_pose((10.5, -5.0, 121.0), 24.0))
    _, jacobian, _ = corner_residuals(corners, pose)
    for k in range(6):
        xi = np.zeros(6)
        xi[k] = 1e-6
        plus = corner_residuals(corners, pose @ make_transform(exp_so3(xi[:3]), xi[3:]))[0]
        minus = corner_residuals(corners, pose @ make_transform(exp_so3(-xi[:3]), -xi[3:]))[0]
        assert np.abs((plus - minus) / 2e-6 - jacobian[..., k]).max() < 1e-3


def test_common_error_of_both_views_is_not_averaged_away() -> None:
    # Depth of a square facing the camera at z: an error e outwards of all corners moves it by -z e / (f h / z).
    pose = facing_pose((0.0, 0.0, 100.0), 0.0, roll_deg=0.0)
    corners = corner_set(pose)
    outward = corners.ideal_px - corners.ideal_px.reshape(2, 4, 2).mean(axis=1).repeat(4, axis=0)
    outward *= 0.1 / np.abs(outward)  # 0.1 px along x and along y
    corners = replace(corners, common_px=np.zeros(8), outward_px=outward)
    fit = fit_pose(corners, pose)
    assert fit is not None
    sigma_depth = np.sqrt(common_covariance(corners, fit)[5, 5])
    assert sigma_depth == pytest.approx(100.0 * 0.1 / (1000.0 * 15.0 / 100.0), rel=0.02)


def test_both_poses_are_compared_again_once_the_body_has_moved() -> None:
    size = Constant.TAG_SIZE
    first = choose_pose(corner_set(facing_pose((10.0, -5.0, 120.0), 25.0), 0.02), "marker", [], size)
    assert isinstance(first, RigidFit)
    assert first.clearance is not None
    for tilt_deg, again in ((26.0, False), (30.0, True)):
        corners = corner_set(facing_pose((10.5, -5.0, 121.0), tilt_deg), 0.02)
        fit, alone = choose_pose(corners, "marker", [], size, first), choose_pose(corners, "marker", [], size)
        assert isinstance(fit, RigidFit)
        assert isinstance(alone, RigidFit)
        np.testing.assert_allclose(fit.camera_T_body, alone.camera_T_body, atol=1e-6)
        assert (fit.clearance is not None) == again
    unclear = replace(first, clearance=2.0)
    fit = choose_pose(corner_set(first.camera_T_body), "marker", [], size, unclear)
    assert isinstance(fit, RigidFit)
    assert fit.clearance is not None


def test_one_camera_rig() -> None:
    true = facing_pose((5.0, 3.0, 120.0), 30.0)
    fit = detect_marker(frames_of(surfaces_of(ONE_TAG, true))[0], None, StereoRig(LEFT), ONE_TAG)
    assert isinstance(fit, MarkerFit)
    assert rotation_error_deg(true, fit.camera_T_marker) < 0.1
