"""Pictures made of known points by OpenCV's projection: where the points are afterwards, by the changed model."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from fgreg.detection.frame_files import Picture
from fgreg.drivers.interlacing import Fields, field_camera, field_rig, split
from fgreg.drivers.rectification import rectification
from fgreg.errors import InputError
from fgreg.geometry.transforms import as_float_array, exp_so3, make_transform
from fgreg.model.camera_model import CameraModel, StereoRig
from tests.lens_models import LENSES, opencv_pixels

SIZE = (640, 480)
LEFT_P = np.array([[-20.0, -12.0, 100.0], [5.0, 3.0, 80.0], [22.0, 15.0, 110.0], [10.0, -14.0, 90.0]])


def rig() -> StereoRig:
    distortion = as_float_array([-0.25, 0.1, 0.001, -0.0005, 0.0])
    left = CameraModel(SIZE, as_float_array([[800, 0, 322], [0, 790, 236], [0, 0, 1]]), distortion)
    right = CameraModel(SIZE, as_float_array([[806, 0, 310], [0, 798, 243], [0, 0, 1]]), distortion)
    turn = exp_so3(as_float_array([0.02, 0.03, -0.015]))
    return StereoRig(left, right, as_float_array(make_transform(turn, np.array([-5.0, 0.2, 0.1]))))


def seen(camera: CameraModel, camera_p: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    pixels, _ = cv2.projectPoints(camera_p, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def spots(pixels: npt.NDArray[np.float64], size: tuple[int, int], sigma: tuple[float, float]) -> npt.NDArray[np.uint8]:
    """A picture of one bright Gaussian spot at each pixel position."""
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    picture = np.zeros(size[::-1])
    for px, py in pixels:
        picture += 200.0 * np.exp(-0.5 * (((x - px) / sigma[0]) ** 2 + ((y - py) / sigma[1]) ** 2))
    return np.round(picture).astype(np.uint8)


def centroid(picture: Picture, near: npt.NDArray[np.float64], reach: int = 16) -> npt.NDArray[np.float64]:
    x0, y0 = (round(v) - reach for v in near)
    part = picture[y0 : y0 + 2 * reach + 1, x0 : x0 + 2 * reach + 1].astype(float)
    y, x = np.mgrid[y0 : y0 + 2 * reach + 1, x0 : x0 + 2 * reach + 1]
    return np.asarray(np.array([(part * x).sum(), (part * y).sum()]) / part.sum(), dtype=np.float64)


def test_points_in_rectified_pictures_are_where_the_rectified_model_says_on_the_same_line() -> None:
    endoscope = rig()
    found = rectification(endoscope)
    assert endoscope.right is not None
    assert endoscope.right_T_left is not None
    assert found.rig.right_T_left is not None
    right_p = LEFT_P @ endoscope.right_T_left[:3, :3].T + endoscope.right_T_left[:3, 3]
    left = found.left(spots(seen(endoscope.left, LEFT_P), SIZE, (3.0, 3.0)))
    right = found.right(spots(seen(endoscope.right, right_p), SIZE, (3.0, 3.0)))
    # Pinhole by hand, from the attributes only.
    rectified_p = LEFT_P @ found.rectified_R_left.T
    k, shift = found.rig.left.matrix, found.rig.right_T_left[:3, 3]
    for p in rectified_p:
        expected_left = np.array([k[0, 0] * p[0] / p[2] + k[0, 2], k[1, 1] * p[1] / p[2] + k[1, 2]])
        expected_right = expected_left + np.array([k[0, 0] * shift[0] / p[2], 0.0])
        at_left, at_right = centroid(left, expected_left), centroid(right, expected_right)
        np.testing.assert_allclose(at_left, expected_left, atol=0.08)
        np.testing.assert_allclose(at_right, expected_right, atol=0.08)
        assert at_left[1] == pytest.approx(at_right[1], abs=0.08)
    np.testing.assert_allclose(shift[1:], 0.0)
    assert -shift[0] == pytest.approx(np.linalg.norm(endoscope.right_T_left[:3, 3]))
    np.testing.assert_array_equal(found.rig.left.distortion, np.zeros(5))


@pytest.mark.parametrize("name", LENSES)
def test_rectified_pixels_are_taken_from_where_each_lens_model_sees_them(name: str) -> None:
    wide = LENSES[name]
    camera = replace(wide, image_size=(320, 180), matrix=as_float_array(np.diag([0.25, 0.25, 1.0]) @ wide.matrix))
    endoscope = StereoRig(camera, camera, rig().right_T_left)
    found = rectification(endoscope)
    k = found.rig.left.matrix
    pixels = np.array([[5.0, 7.0], [160.0, 90.0], [300.0, 10.0], [225.0, 175.0]])
    rays = np.column_stack([(pixels - k[:2, 2]) / k[[0, 1], [0, 1]], np.ones(4)])
    for maps, turn in ((found.left_maps, found.rectified_R_left), (found.right_maps, found.rectified_R_right)):
        column, row = pixels.astype(int).T
        taken = np.column_stack([maps[0][row, column], maps[1][row, column]])
        expected = opencv_pixels(camera, rays @ turn)
        inside = ((expected >= 0.0) & (expected <= [319.0, 179.0])).all(axis=1)
        assert inside.sum() >= 2
        np.testing.assert_allclose(taken[inside], expected[inside], atol=1e-3)


def test_a_lens_that_folds_within_the_picture_is_not_rectified() -> None:
    folded = replace(LENSES["five"], distortion=as_float_array([-0.5, 0, 0, 0, 0]))
    with pytest.raises(InputError, match=r"camera\.left\.distortion: found a lens model that cannot be inverted"):
        rectification(StereoRig(folded, folded, rig().right_T_left))


def test_rectified_turns_fit_together_and_agree_with_opencv() -> None:
    endoscope = rig()
    found = rectification(endoscope)
    assert endoscope.right is not None
    assert endoscope.right_T_left is not None
    right_R_left = endoscope.right_T_left[:3, :3]
    np.testing.assert_allclose(found.rectified_R_right.T @ found.rectified_R_left, right_R_left, atol=1e-9)
    r1, r2, *_ = cv2.stereoRectify(
        endoscope.left.matrix,
        endoscope.left.distortion,
        endoscope.right.matrix,
        endoscope.right.distortion,
        SIZE,
        np.ascontiguousarray(right_R_left),
        np.ascontiguousarray(endoscope.right_T_left[:3, 3:]),
    )
    # OpenCV shares the last turn out a little differently; the axis along the baseline is the same.
    np.testing.assert_allclose(found.rectified_R_left[0], r1[0], atol=1e-9)
    np.testing.assert_allclose(found.rectified_R_right[0], r2[0], atol=1e-9)
    np.testing.assert_allclose(found.rectified_R_left, r1, atol=2e-3)


def test_half_height_fields_keep_their_geometry_when_rectified() -> None:
    endoscope = field_rig(rig(), Fields.TOP)
    matrix = rectification(endoscope).rig.left.matrix
    assert matrix[0, 0] / matrix[1, 1] == pytest.approx(2.0, rel=0.03)


def test_one_camera_and_cameras_one_above_the_other_are_not_rectified() -> None:
    endoscope = rig()
    with pytest.raises(InputError, match="found nothing, expected two cameras"):
        rectification(StereoRig(endoscope.left))
    above = as_float_array(make_transform(np.eye(3), np.array([0.0, -5.0, 0.0])))
    with pytest.raises(InputError, match="expected cameras side by side"):
        rectification(StereoRig(endoscope.left, endoscope.right, above))
    with pytest.raises(InputError, match="320 x 480 px, expected 640 x 480 px"):
        rectification(endoscope).left(np.zeros((480, 320), dtype=np.uint8))


@pytest.mark.parametrize("fields", [Fields.TOP, Fields.BOTTOM])
def test_points_in_a_field_are_where_the_fields_camera_says(fields: Fields) -> None:
    camera = rig().left
    frame = spots(seen(camera, LEFT_P), SIZE, (3.0, 4.0))
    [field] = split(frame, fields)
    half = field_camera(camera, fields)
    assert field.shape == (240, 640)
    assert half.image_size == (640, 240)
    for expected in seen(half, LEFT_P):
        np.testing.assert_allclose(centroid(field, expected), expected, atol=0.03)


def test_both_fields_of_a_moving_point_are_pictures_of_their_own_moments_with_one_camera_model() -> None:
    camera = rig().left
    early, late = LEFT_P, LEFT_P + np.array([1.5, 0.0, 0.0])
    frame = spots(seen(camera, early), SIZE, (3.0, 4.0))
    frame[1::2] = spots(seen(camera, late), SIZE, (3.0, 4.0))[1::2]
    first, second = split(frame, Fields.BOTH)
    half = field_camera(camera, Fields.BOTH)
    for picture, points in ((first, early), (second, late)):
        for expected in seen(half, points):
            np.testing.assert_allclose(centroid(picture, expected), expected, atol=0.05)


def test_a_frame_with_an_odd_number_of_lines_gives_two_fields_of_one_height() -> None:
    frame = np.arange(7, dtype=np.uint8)[:, None].repeat(2, axis=1)
    first, second = split(frame, Fields.BOTH)
    assert first[:, 0].tolist() == [0, 2, 4]
    assert second[:, 0].tolist() == [1, 2, 4]  # no upper neighbour; then the means of 1, 3 and 3, 5
    [whole] = split(frame, Fields.WHOLE)
    assert whole is frame
