"""The camera model against OpenCV's own, its inverse, its Jacobian, and where it has no inverse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgreg.detection.marker import detect_marker
from fgreg.detection.results import MarkerFit, NotFound
from fgreg.geometry.transforms import as_float_array
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.lens import (
    blind_px,
    distort,
    distort_jacobian,
    focal_px,
    ideal_by_lens,
    ideal_from_pixels,
    in_view,
    normalized_from_pixels,
    pixel_by_ideal_jacobian,
    pixels_from_ideal,
    pixels_from_normalized,
    project,
    reach,
    seen_by_lens,
)
from fgreg.model.plausible import implausible_camera
from fgreg.simulation.lens import project_points
from fgreg.simulation.render import Optics, render_frame
from tests.lens_models import LENSES, WIDE, opencv_pixels
from tests.marker_scene import LEFT, ONE_TAG, facing_pose, rotation_error_deg, surfaces_of


@pytest.mark.parametrize("name", LENSES)
def test_all_lens_models_are_opencvs_with_inverse_and_jacobian(name: str) -> None:
    camera = LENSES[name]
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-90, 90, (100, 2)), rng.uniform(90, 200, 100)])
    expected = opencv_pixels(camera, points)
    pixels = project(camera, points)
    assert np.abs(pixels - expected).max() < 1e-9
    assert np.abs(project_points(camera, points) - expected).max() < 1e-9  # the simulator's
    assert project_points(camera, points[:0]).shape == (0, 2)
    normalized = points[:, :2] / points[:, 2:]
    assert np.abs(normalized_from_pixels(camera, pixels) - normalized).max() < 1e-8
    for k in range(2):
        d = np.eye(2)[k] * 1e-6
        numeric = (distort(camera, normalized + d) - distort(camera, normalized - d)) / 2e-6
        assert np.abs(numeric - distort_jacobian(camera, normalized)[..., k]).max() < 1e-7
    assert np.abs(distort_jacobian(camera, np.zeros((1, 2))) - np.eye(2)).max() < 1e-9


@pytest.mark.parametrize("name", LENSES)
def test_every_pixel_of_the_image_comes_back(name: str) -> None:
    camera = LENSES[name]
    grid = np.stack(np.meshgrid(np.linspace(0, 1279, 33), np.linspace(0, 719, 19)), axis=-1).reshape(-1, 2)
    rays = np.column_stack([normalized_from_pixels(camera, grid), np.ones(len(grid))])
    assert np.abs(opencv_pixels(camera, rays) - grid).max() < 1e-6
    assert blind_px(camera) is None


@pytest.mark.parametrize("name", LENSES)
def test_ideal_pixels_move_with_focal_length_and_centre_as_stated(name: str) -> None:
    camera = LENSES[name]
    ideal = np.array([[10.0, -5.0], [300.0, 150.0], [-420.0, 210.0]])
    by_lens = ideal_by_lens(camera, ideal)
    for k, step in enumerate((1e-6, 1e-3, 1e-3)):
        ends = []
        for sign in (1.0, -1.0):
            matrix = camera.matrix.copy()
            if k == 0:
                matrix[:2, :2] *= 1.0 + sign * step
            else:
                matrix[k - 1, 2] += sign * step
            # The pixel that a camera with these constants would see, in the ideal pixels of the declared one.
            seen = pixels_from_normalized(replace(camera, matrix=matrix), ideal / focal_px(camera))
            ends.append(ideal_from_pixels(camera, seen))
        numeric = (ends[0] - ends[1]) / (2.0 * step)
        assert np.abs(numeric - by_lens[..., k]).max() < 1e-4 * np.abs(by_lens[..., k]).max()
    predicted_by_lens, by_ideal = seen_by_lens(camera, ideal)
    np.testing.assert_allclose(predicted_by_lens, by_lens)
    np.testing.assert_allclose(by_ideal, pixel_by_ideal_jacobian(camera, ideal))


def test_beyond_its_reach_a_lens_is_taken_as_undistorted() -> None:
    folded = replace(LENSES["five"], distortion=as_float_array([-0.5, 0, 0, 0, 0]))
    beyond = np.array([[600.0, 100.0]])  # r = 1.01, the reach is 0.82
    by_lens, by_ideal = seen_by_lens(folded, beyond)
    np.testing.assert_array_equal(by_lens[0], np.array([[600.0, 1.0, 0.0], [100.0, 0.0, 1.0]]))
    np.testing.assert_array_equal(by_ideal[0], np.eye(2))


def test_a_wide_fisheye_lens_sees_85_degrees_from_the_axis() -> None:
    # Without coefficients the distance from the centre is f times the angle: 600 px * 85 deg = 890.1 px.
    camera = CameraModel((1920, 1920), as_float_array([[600, 0, 960], [0, 600, 960], [0, 0, 1]]), np.zeros(4), True)
    angle = np.radians(85.0)
    ray = np.array([np.sin(angle), 0.0, np.cos(angle)])
    assert project(camera, ray) == pytest.approx([960.0 + 600.0 * angle, 960.0])
    assert np.arctan(normalized_from_pixels(camera, np.array([960.0 + 600.0 * angle, 960.0]))[0]) == pytest.approx(
        angle
    )
    assert in_view(camera, np.stack([100.0 * ray, -100.0 * ray])).tolist() == [True, False]
    assert np.isnan(normalized_from_pixels(camera, np.array([960.0 + 600.0 * np.radians(95.0), 960.0]))).all()


def test_marker_is_found_through_a_fisheye_lens() -> None:
    camera = LENSES["fisheye"]
    true = facing_pose((45.0, -20.0, 70.0), 20.0)
    rng = np.random.default_rng(0)
    image = render_frame(camera, surfaces_of(ONE_TAG, true), rng, Optics(blur_px=0.8))
    fit = detect_marker(image, None, StereoRig(camera), ONE_TAG)
    assert isinstance(fit, MarkerFit)
    assert rotation_error_deg(true, fit.camera_T_marker) < 0.1
    assert np.linalg.norm(fit.camera_T_marker[:3, 3] - true[:3, 3]) < 0.05
    plain = replace(camera, fisheye=False)  # taken for k1, k2, p1, p2
    wrong = detect_marker(image, None, StereoRig(plain), ONE_TAG)
    assert isinstance(wrong, NotFound) or np.linalg.norm(wrong.camera_T_marker[:3, 3] - true[:3, 3]) > 1.0


def test_a_tag_where_the_lens_model_folds_is_named() -> None:
    plain = replace(LENSES["five"], distortion=as_float_array(np.zeros(5)))
    image = render_frame(
        plain, surfaces_of(ONE_TAG, facing_pose((95.0, 40.0, 120.0), 10.0)), np.random.default_rng(0), Optics()
    )
    folded = replace(plain, distortion=as_float_array([-0.9, 0, 0, 0, 0]))
    fit = detect_marker(image, None, StereoRig(folded), ONE_TAG)
    assert isinstance(fit, NotFound)
    assert "tag 0 where the left lens model cannot be inverted" in fit.reason


def test_hand_computed_point() -> None:
    camera = CameraModel((100, 100), as_float_array([[100, 0, 50], [0, 200, 40], [0, 0, 1]]), as_float_array([0.1] * 5))
    # x = 0.5, y = 0: r2 = 0.25, radial = 1 + 0.1 (0.25 + 0.0625 + 0.015625) = 1.0328125,
    # xd = 0.51640625 + 0.1 (0.25 + 0.5) = 0.59140625, yd = 0.1 * 0.25 = 0.025
    pixel = project(camera, np.array([1.0, 0.0, 2.0]))
    assert pixel == pytest.approx([50 + 59.140625, 40 + 5.0])


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
    # With k1 = -0.5 the distorted radius r (1 - r^2 / 2) grows up to r = sqrt(2 / 3), to 0.544: nothing is seen beyond.
    camera = CameraModel(
        (1000, 1000), as_float_array(np.diag([1000.0, 1000.0, 1.0])), as_float_array([-0.5, 0, 0, 0, 0])
    )
    out = normalized_from_pixels(camera, np.array([[600.0, 0.0], [500.0, 0.0]]))
    assert np.isnan(out[0]).all()
    x = out[1, 0]
    assert x * (1 - 0.5 * x * x) == pytest.approx(0.5)
    assert x < reach(camera) == pytest.approx(np.sqrt(2 / 3))
    # Farther out the formula comes back into the image, upside down: at r = 2 to -2.
    assert project(camera, np.array([200.0, 0.0, 100.0]))[0] == pytest.approx(-2000.0)
    centred = replace(camera, matrix=as_float_array([[600, 0, 500], [0, 600, 500], [0, 0, 1]]))
    assert in_view(centred, np.array([[50.0, 0.0, 100.0], [145.0, 0.0, 100.0]])).tolist() == [True, False]
    # 0.544 * 600 px = 326.6 px; rings are 499.5 / 32 px apart.
    found = blind_px(centred)
    assert found is not None
    assert 326.6 < found < 326.6 + 15.7
    assert any("left.distortion cannot be inverted" in text for text in implausible_camera(StereoRig(centred)))


def test_a_rational_model_ends_at_its_pole() -> None:
    # 1 - r^2 / 4 is zero at r = 2.
    camera = CameraModel((1000, 1000), WIDE, as_float_array([0, 0, 0, 0, 0, -0.25, 0, 0]))
    assert reach(camera) == pytest.approx(2.0)
