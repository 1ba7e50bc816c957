"""Simulated images against OpenCV's own drawing and projection, and against positions computed by hand."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fgreg.geometry.transforms import FloatArray, exp_so3, make_transform, transform_points
from fgreg.model.camera_model import CameraModel
from fgreg.model.session_model import BoardModel, CharucoModel
from fgreg.simulation.config import default_rig
from fgreg.simulation.lens import project_points, undistorted_rays
from fgreg.simulation.render import Optics, render_frame
from fgreg.simulation.surfaces import Background, BoardSurface, PatchSurface, Surface, TagSurface
from fgreg.simulation.textures import board_texture

LENS = default_rig().left
PERFECT = CameraModel((400, 300), np.array([[600.0, 0, 200.0], [0, 600.0, 150.0], [0, 0, 1.0]]), np.zeros(5))
SHARP = Optics(blur_px=0.0, vignetting=0.0, read_noise=0.0, shot_noise=0.0, distance_exponent=0.0)
CHARUCO = BoardModel(9, 6, 9.0, CharucoModel("DICT_5X5_100", 6.5))


def towards_camera(rotation_vector: list[float], position_mm: list[float]) -> FloatArray:
    """A pose of a tag that faces the camera (y up in the image), turned by a rotation vector."""
    return make_transform(exp_so3(np.array(rotation_vector)) @ np.diag([1.0, -1.0, -1.0]), np.array(position_mm))


def at(rotation_vector: list[float], position_mm: list[float]) -> FloatArray:
    return make_transform(exp_so3(np.array(rotation_vector)), np.array(position_mm))


def pixel(image: np.ndarray, camera: CameraModel, camera_T_surface: FloatArray, point: list[float]) -> int:
    column, row = np.rint(project_points(camera, transform_points(camera_T_surface, np.array(point)))).astype(int)
    return int(image[row, column])


def grid(corner_id: np.ndarray, square_mm: float) -> FloatArray:
    """Board points of inner corners, numbered along rows of nine."""
    return np.asarray(np.stack([corner_id % 9, corner_id // 9, 0 * corner_id], -1) * square_mm, dtype=np.float64)


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def test_projection_is_opencvs() -> None:
    points = rng().uniform([-60, -35, 80], [60, 35, 160], (200, 3))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), LENS.matrix, LENS.distortion)
    np.testing.assert_allclose(project_points(LENS, points), expected.reshape(-1, 2), atol=1e-9)


def test_undistorted_rays_project_back_to_their_pixels() -> None:
    strong = replace(LENS, distortion=np.array([-0.35, 0.15, 0.002, -0.001, -0.02]))
    columns, rows = np.meshgrid(np.linspace(-0.5, 1279.5, 23), np.linspace(-0.5, 719.5, 17))
    for camera in (LENS, strong):
        x, y = undistorted_rays(camera, columns, rows)
        back, _ = cv2.projectPoints(
            np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3),
            np.zeros(3),
            np.zeros(3),
            camera.matrix,
            camera.distortion,
        )
        np.testing.assert_allclose(back.reshape(-1, 2), np.stack([columns, rows], -1).reshape(-1, 2), atol=1e-7)


def test_a_lens_that_folds_the_image_is_refused() -> None:
    with pytest.raises(ValueError, match="cannot be inverted"):
        undistorted_rays(replace(LENS, distortion=np.array([-2.5, 0, 0, 0, 0])), np.array([0.0]), np.array([0.0]))


@pytest.mark.parametrize("tag_id", [0, 7, 49])
def test_tag_shows_opencvs_bits_the_right_way_up(tag_id: int) -> None:
    # 24 mm across 6 modules of 4 mm at 120 mm: 20 px a module, centred on the image.
    pose = towards_camera([0, 0, 0], [0, 0, 120])
    image = render_frame(PERFECT, [TagSurface("DICT_4X4_50", tag_id, 24.0, pose)], rng(), SHARP)
    book = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    expected = cv2.aruco.generateImageMarker(book, tag_id, 6) > 127
    centres = (np.arange(6) - 2.5) * 20.0
    rows = np.rint(150.0 + centres).astype(int)
    columns = np.rint(200.0 + centres).astype(int)
    assert ((image[np.ix_(rows, columns)] > 80) == expected).all()
    # One module of white around it, nothing beyond.
    assert image[150, 200 - 70] > 120
    assert image[150, 200 - 85] == 0


def test_tag_corners_are_where_the_tag_frame_says() -> None:
    pose = towards_camera([0.4, -0.3, 1.9], [12.0, -5.0, 105.0])
    image = render_frame(LENS, [TagSurface("DICT_4X4_50", 3, 25.0, pose)], rng(), Optics())
    corners, ids, _ = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)).detectMarkers(
        image
    )
    assert np.asarray(ids).ravel().tolist() == [3]
    h = 12.5
    expected = project_points(
        LENS, transform_points(pose, np.array([[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]], float))
    )
    # Whole-pixel detection: order and orientation are at stake here, not accuracy.
    assert np.abs(np.asarray(corners[0]).reshape(4, 2) - expected).max() < 1.5


def test_board_texture_is_opencvs_board() -> None:
    board = cv2.aruco.CharucoBoard((10, 7), 9.0, 6.5, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100))
    drawn = board.generateImage((1800, 1260)) > 127  # 20 px a mm
    v, u = np.mgrid[0.2:63.0:0.37, 0.2:90.0:0.37]
    ours = board_texture(CHARUCO).labels((u + 9.0).astype(np.float32), (v + 9.0).astype(np.float32)) == 2
    theirs = drawn[(v * 20).astype(int), (u * 20).astype(int)]
    assert (ours != theirs).mean() < 0.004  # samples that fall on an edge


@pytest.mark.parametrize("charuco", [True, False])
def test_board_corners_lie_on_the_boards_own_grid(charuco: bool) -> None:
    board = CHARUCO if charuco else replace(CHARUCO, charuco=None)
    pose = at([0.25, -0.3, 0.2], [-36.0, -20.0, 118.0])
    image = render_frame(LENS, [BoardSurface(board, pose)], rng(), Optics(), Background(at([0, 0, 0], [0, 0, 170.0])))
    index = np.arange(54)
    expected = project_points(LENS, transform_points(pose, grid(index, board.square_mm)))
    start = np.ascontiguousarray(expected + 0.4, dtype=np.float32).reshape(-1, 1, 2)
    found = cv2.cornerSubPix(image, start, (6, 6), (-1, -1), (3, 60, 1e-4)).reshape(-1, 2)
    error = found - expected
    assert np.abs(error.mean(axis=0)).max() < 0.01
    assert np.sqrt((error**2).mean()) < 0.06
    # The black corner square is at the top left, seen from the front.
    assert pixel(image, LENS, pose, [-4.5, -4.5, 0]) < 40
    assert pixel(image, LENS, pose, [-8.6, 4.5, 0]) > 60
    assert pixel(image, LENS, pose, [4.5, -8.6, 0]) > 60


def test_charuco_corner_ids_count_along_the_rows() -> None:
    pose = at([0.1, 0.2, -0.3], [-38.0, -20.0, 120.0])
    image = render_frame(LENS, [BoardSurface(CHARUCO, pose)], rng(), Optics())
    board = cv2.aruco.CharucoBoard((10, 7), 9.0, 6.5, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100))
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(image)
    ids = np.asarray(ids).ravel()
    assert ids.size > 45
    expected = project_points(LENS, transform_points(pose, grid(ids, 9.0)))
    assert np.abs(np.asarray(corners).reshape(-1, 2) - expected).max() < 0.4


@pytest.mark.parametrize("shift_px", [0.0, 0.13, 0.41, 0.77])
def test_edges_have_no_preferred_sub_pixel_position(shift_px: float) -> None:
    # An axis-aligned patch of 60.25 x 40.5 px: each column's centroid has to move with the patch.
    pose = at([0, 0, 0], [shift_px / 5.0, 0.6 * shift_px / 5.0, 120.0])
    patch = PatchSurface(pose, 60.25 / 5.0, 40.5 / 5.0, 1.0)
    image = render_frame(PERFECT, [patch], rng(), SHARP).astype(float)
    columns, rows = np.arange(400), np.arange(300)
    assert (image.sum(0) @ columns) / image.sum() == pytest.approx(200.0 + shift_px, abs=0.01)
    assert (image.sum(1) @ rows) / image.sum() == pytest.approx(150.0 + 0.6 * shift_px, abs=0.01)
    middle = image[150, 200]
    assert image[140:160].sum() / (20 * middle) == pytest.approx(60.25, abs=0.12)


def test_nearer_surfaces_hide_farther_ones_in_any_order() -> None:
    board_pose, tag_pose = at([0, 0, 0], [-36.0, -22.0, 130.0]), towards_camera([0, 0, 0.3], [0, 0, 95.0])
    surfaces: list[Surface] = [TagSurface("DICT_4X4_50", 1, 25.0, tag_pose), BoardSurface(CHARUCO, board_pose)]
    one = render_frame(LENS, surfaces, rng(), Optics())
    other = render_frame(LENS, surfaces[::-1], rng(), Optics())
    np.testing.assert_array_equal(one, other)
    assert pixel(one, LENS, tag_pose, [0, 14.3, 0]) > 130  # quiet zone
    assert pixel(one, LENS, tag_pose, [0, 11.0, 0]) < 40  # border
    cover = PatchSurface(at([0, 0, 0], [0, 0, 80.0]), 30.0, 4.0, 0.5)
    hidden = render_frame(LENS, [cover, *surfaces], rng(), Optics())
    assert pixel(hidden, LENS, at([0, 0, 0], [0, 0, 80.0]), [0, 0, 0]) == pytest.approx(0.5 * 170 * 110 / 80, abs=8)


def test_back_of_a_tag_has_no_pattern() -> None:
    pose = at([0, 0.2, 0], [0, 0, 100.0])  # z away from the camera
    image = render_frame(PERFECT, [TagSurface("DICT_4X4_50", 1, 25.0, pose)], rng(), SHARP)
    inside = image[130:170, 180:220]
    assert inside.min() > 20
    assert int(inside.max()) - int(inside.min()) < 6


def test_what_is_behind_the_camera_is_not_drawn() -> None:
    behind = TagSurface("DICT_4X4_50", 1, 25.0, towards_camera([0, 0, 0], [0, 0, -100.0]))
    assert render_frame(PERFECT, [behind], rng(), SHARP).max() == 0
    # A sheet that runs from before the camera to behind it shows only the part before it, below the horizon.
    floor = PatchSurface(at([np.pi / 2 - 0.01, 0, 0], [0, 20.0, 0.0]), 60.0, 600.0, 1.0)
    image = render_frame(PERFECT, [floor], rng(), SHARP)
    assert image[:140].max() == 0
    assert image[290, 200] > 0


def test_noise_is_about_one_grey_level_and_light_falls_off() -> None:
    wide = PatchSurface(at([0, 0, 0], [0, 0, 140.0]), 500.0, 400.0, 1.0)
    image = render_frame(LENS, [wide], rng(), Optics()).astype(float)
    middle = image[330:390, 610:670]
    assert 0.8 < middle.std() < 1.3
    assert image[:20, :20].mean() < 0.75 * middle.mean()
    near = render_frame(LENS, [replace(wide, camera_T_patch=at([0, 0, 0], [0, 0, 90.0]))], rng(), Optics())
    assert near[330:390, 610:670].mean() == pytest.approx(middle.mean() * 140 / 90, rel=0.03)


def test_blur_has_the_width_it_says() -> None:
    dot = PatchSurface(at([0, 0, 0], [0, 0, 120.0]), 0.2, 0.2, 1.0)  # one pixel
    image = render_frame(PERFECT, [dot], rng(), replace(SHARP, blur_px=1.5, white_level=5000.0)).astype(float)
    columns = np.arange(400) - 200.0
    profile = image.sum(axis=0)
    variance = (profile @ columns**2) / profile.sum()
    assert variance == pytest.approx(1.5**2 + 1 / 12, rel=0.08)


def test_same_generator_same_image() -> None:
    tag = TagSurface("DICT_4X4_50", 1, 25.0, towards_camera([0.2, 0.1, 0], [0, 0, 100.0]))
    np.testing.assert_array_equal(render_frame(LENS, [tag], rng()), render_frame(LENS, [tag], rng()))


@pytest.mark.parametrize(("dictionary", "tag_id"), [("DICT_NONE", 0), ("ArucoDetector", 0), ("DICT_4X4_50", 50)])
def test_unknown_tags_are_refused(dictionary: str, tag_id: int) -> None:
    tag = TagSurface(dictionary, tag_id, 25.0, towards_camera([0, 0, 0], [0, 0, 100.0]))
    with pytest.raises(ValueError, match="expected"):
        render_frame(PERFECT, [tag], rng())
