"""The camera model against OpenCV's own, its inverse, its Jacobian, and where it has no inverse."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from fgreg.detection.camera import (
    distort,
    distort_jacobian,
    ideal_from_pixels,
    normalized_from_pixels,
    pixel_by_ideal_jacobian,
    pixels_from_ideal,
    project,
)
from fgreg.detection.marker import detect_marker
from fgreg.detection.results import MarkerFit, NotFound
from fgreg.geometry.transforms import as_float_array
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.simulation.lens import project_points
from fgreg.simulation.render import Optics, render_frame
from tests.marker_scene import LEFT, ONE_TAG, facing_pose, rotation_error_deg, surfaces_of


def test_projection_is_opencvs() -> None:
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-60, 60, (50, 2)), rng.uniform(80, 200, 50)])
    expected, _ = cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), LEFT.matrix, LEFT.distortion)
    assert np.abs(project(LEFT, points) - expected.reshape(-1, 2)).max() < 1e-9


LENSES = [
    ([-0.1, 0.06, 0.001, -0.002], False),
    ([-0.1, 0.06, 0.001, -0.002, 0.01, 0.02, 0.03, 0.001], False),
    ([-0.1, 0.06, 0.001, -0.002, 0.01, 0.02, 0.03, 0.001, 0.002, 0.001, -0.001, 0.002], False),
    ([0.1, -0.05, 0.01, 0.002], True),
]
WIDE = as_float_array([[600.0, 0.0, 640.0], [0.0, 605.0, 360.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(("distortion", "fisheye"), LENSES, ids=["four", "rational", "prism", "fisheye"])
def test_all_lens_models_are_opencvs_with_inverse_and_jacobian(distortion: list[float], fisheye: bool) -> None:
    camera = CameraModel((1280, 720), WIDE, as_float_array(distortion), fisheye)
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-90, 90, (100, 2)), rng.uniform(90, 200, 100)])
    see = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    expected, _ = see(points[:, None], np.zeros(3), np.zeros(3), WIDE, np.array(distortion))
    pixels = project(camera, points)
    assert np.abs(pixels - expected.reshape(-1, 2)).max() < 1e-9
    assert np.abs(project_points(camera, points) - expected.reshape(-1, 2)).max() < 1e-9  # the simulator's own
    normalized = points[:, :2] / points[:, 2:]
    assert np.abs(normalized_from_pixels(camera, pixels) - normalized).max() < 1e-8
    for k in range(2):
        d = np.eye(2)[k] * 1e-6
        numeric = (distort(camera, normalized + d) - distort(camera, normalized - d)) / 2e-6
        assert np.abs(numeric - distort_jacobian(camera, normalized)[..., k]).max() < 1e-7
    assert np.abs(distort_jacobian(camera, np.zeros((1, 2))) - np.eye(2)).max() < 1e-9


def test_marker_is_found_through_a_fisheye_lens() -> None:
    camera = CameraModel((1280, 720), WIDE, as_float_array([0.1, -0.05, 0.01, 0.002]), fisheye=True)
    true = facing_pose((45.0, -20.0, 70.0), 20.0)
    rng = np.random.default_rng(0)
    image = render_frame(camera, surfaces_of(ONE_TAG, true), rng, Optics(blur_px=0.8))
    fit = detect_marker(image, None, StereoRig(camera), ONE_TAG)
    assert isinstance(fit, MarkerFit)
    assert rotation_error_deg(true, fit.camera_T_marker) < 0.1
    assert np.linalg.norm(fit.camera_T_marker[:3, 3] - true[:3, 3]) < 0.05
    plain = CameraModel((1280, 720), WIDE, camera.distortion)  # taken for k1, k2, p1, p2
    wrong = detect_marker(image, None, StereoRig(plain), ONE_TAG)
    assert isinstance(wrong, NotFound) or np.linalg.norm(wrong.camera_T_marker[:3, 3] - true[:3, 3]) > 1.0


def test_hand_computed_point() -> None:
    camera = CameraModel((100, 100), as_float_array([[100, 0, 50], [0, 200, 40], [0, 0, 1]]), as_float_array([0.1] * 5))
    # x = 0.5, y = 0: r2 = 0.25, radial = 1 + 0.1 (0.25 + 0.0625 + 0.015625) = 1.0328125,
    # xd = 0.51640625 + 0.1 (0.25 + 0.5) = 0.59140625, yd = 0.1 * 0.25 = 0.025
    pixel = project(camera, np.array([1.0, 0.0, 2.0]))
    assert pixel == pytest.approx([50 + 59.140625, 40 + 5.0])


def test_pixels_come_back() -> None:
    grid = np.stack(np.meshgrid(np.linspace(0, 1279, 17), np.linspace(0, 719, 11)), axis=-1)
    assert np.abs(pixels_from_ideal(LEFT, ideal_from_pixels(LEFT, grid)) - grid).max() < 1e-6


def test_jacobians_against_differences() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-0.5, 0.5, (20, 2))
    step = 1e-6
    for k in range(2):
        d = np.eye(2)[k] * step
        numeric = (distort(LEFT, points + d) - distort(LEFT, points - d)) / (2 * step)
        assert np.abs(numeric - distort_jacobian(LEFT, points)[..., k]).max() < 1e-8
        ideal = points * 1000.0
        d = np.eye(2)[k] * 1e-3
        numeric = (pixels_from_ideal(LEFT, ideal + d) - pixels_from_ideal(LEFT, ideal - d)) / 2e-3
        assert np.abs(numeric - pixel_by_ideal_jacobian(LEFT, ideal)[..., k]).max() < 1e-7


def test_no_inverse_is_nan_and_not_a_guess() -> None:
    # With k1 = -0.5 the distorted radius r (1 - r^2 / 2) is at most 0.544: nothing is seen beyond.
    camera = CameraModel(SIZE_1000, as_float_array(np.diag([1000.0, 1000.0, 1.0])), as_float_array([-0.5, 0, 0, 0, 0]))
    out = normalized_from_pixels(camera, np.array([[600.0, 0.0], [500.0, 0.0]]))
    assert np.isnan(out[0]).all()
    x = out[1, 0]
    assert x * (1 - 0.5 * x * x) == pytest.approx(0.5)
    assert x < np.sqrt(2 / 3)  # before the fold


SIZE_1000 = (1000, 1000)
