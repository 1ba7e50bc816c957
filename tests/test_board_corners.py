"""Which corner is [0, 0], where the corners are, and with what covariance."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

from fgreg.detection.board import detect_board, find_board_corners, order_corners
from fgreg.detection.corner_noise import pool_corner_noise
from fgreg.detection.results import BoardFit, NotFound, board_corner, board_covariance
from fgreg.geometry.transforms import FloatArray, as_float_array, exp_so3, make_transform, transform_points
from fgreg.model.camera_model import StereoRig
from fgreg.model.session_model import BoardModel, CharucoModel
from fgreg.simulation.surfaces import BoardSurface, PatchSurface
from tests.marker_scene import LEFT, RIG, Frame, frames_of, left_pixels, pose_error, rotation_error_deg

PLAIN = BoardModel(9, 6, 10.0)
CHARUCO = BoardModel(9, 6, 10.0, CharucoModel("DICT_5X5_100", 7.0))


def board_pose(
    board: BoardModel, roll_deg: float, tilt: tuple[float, float] = (0.3, -0.2), z: float = 170.0
) -> FloatArray:
    """The board's middle on the optical axis, turned about it by ``roll_deg`` and leaning."""
    rotation = exp_so3(np.array([*tilt, 0.0])) @ exp_so3(np.array([0.0, 0.0, np.radians(roll_deg)]))
    middle = np.array([board.columns - 1, board.rows - 1, 0.0]) * board.square_mm / 2.0
    return make_transform(rotation, np.array([0.0, 0.0, z]) - rotation @ middle)


def grid_mm(board: BoardModel) -> FloatArray:
    """(rows * columns, 3) corners in the order row * columns + column."""
    return np.array([[c, r, 0.0] for r in range(board.rows) for c in range(board.columns)]) * board.square_mm


@pytest.mark.parametrize("roll_deg", [0.0, 90.0, 180.0, -90.0, 37.0])
@pytest.mark.parametrize("board", [PLAIN, BoardModel(6, 9, 8.0), CHARUCO], ids=["plain", "tall", "charuco"])
def test_corners_are_named_by_the_convention(board: BoardModel, roll_deg: float) -> None:
    true = board_pose(board, roll_deg)
    left, _ = frames_of([BoardSurface(board, true)], far_mm=260.0)
    found = find_board_corners(left, board)
    assert found is not None
    pixels, ids = found
    assert len(ids) == 54
    expected = left_pixels(true, grid_mm(board))[ids]
    assert np.abs(pixels - expected).max() < 0.2
    assert np.sqrt(np.mean((pixels - expected) ** 2)) < 0.05


@pytest.mark.parametrize("columns", [4, 5])
def test_black_square_at_the_top_left_by_hand(columns: int) -> None:
    # Drawn square by square, black first: 40 px squares from (40, 40); corner [0, 0] at (79.5, 79.5).
    board = BoardModel(columns, 7 - columns + 2 if columns == 4 else 4, 10.0)
    image = np.full((400, 480), 220, dtype=np.uint8)
    for r in range(board.rows + 1):
        for c in range(board.columns + 1):
            if (r + c) % 2 == 0:
                image[40 + 40 * r : 80 + 40 * r, 40 + 40 * c : 80 + 40 * c] = 20
    found = find_board_corners(image, board)
    assert found is not None
    pixels, ids = found
    order = np.argsort(ids)
    expected = grid_mm(board)[:, :2] * 4.0 + 79.5
    assert np.abs(pixels[order] - expected).max() < 0.1


def test_corners_given_from_any_end_or_mirrored_are_put_in_order() -> None:
    left, _ = frames_of([BoardSurface(PLAIN, board_pose(PLAIN, 20.0))], far_mm=260.0)
    right_order = left_pixels(board_pose(PLAIN, 20.0), grid_mm(PLAIN))
    grid = right_order.reshape(6, 9, 2)
    for given in (grid, grid[::-1, ::-1], grid[:, ::-1], grid[::-1]):
        ordered = order_corners(left, given.reshape(-1, 2), PLAIN)
        assert ordered is not None
        assert np.array_equal(ordered, right_order)


def test_no_contrast_no_order() -> None:
    assert (
        order_corners(
            np.full((720, 1280), 90, dtype=np.uint8), left_pixels(board_pose(PLAIN, 0.0), grid_mm(PLAIN)), PLAIN
        )
        is None
    )


@pytest.mark.parametrize(
    ("columns", "rows", "refused"), [(8, 6, True), (7, 7, True), (9, 6, False), (6, 9, False), (2, 5, True)]
)
def test_ambiguous_plain_boards_are_refused(columns: int, rows: int, refused: bool) -> None:
    with pytest.raises(ValueError, match="columns") if refused else contextlib.nullcontext():
        BoardModel(columns, rows, 10.0)


def test_charuco_of_any_size_is_not_ambiguous() -> None:
    assert BoardModel(8, 6, 10.0, CharucoModel("DICT_5X5_100", 7.0)).markers == 31


@pytest.mark.parametrize("board", [PLAIN, CHARUCO], ids=["plain", "charuco"])
def test_corner_in_camera_with_honest_covariance(board: BoardModel) -> None:
    rng = np.random.default_rng(2)
    fits, errors, offsets = [], [], []
    for i in range(8):
        true = board_pose(board, rng.uniform(-20, 20), tuple(rng.uniform(-0.4, 0.4, 2)), rng.uniform(150, 200))
        fit = detect_board(*frames_of([BoardSurface(board, true)], seed=i, far_mm=280.0), RIG, board)
        assert isinstance(fit, BoardFit), fit
        assert fit.pose.corners == 108
        fits.append(fit)
        errors.append(pose_error(true, fit.camera_T_board))
        offsets.append((fit, true))
    noise = pool_corner_noise(fit.pose for fit in fits)
    squares = [e @ np.linalg.solve(board_covariance(f, noise), e) for e, f in zip(errors, fits, strict=True)]
    assert 1.5 < np.mean(squares) < 15.0  # 6 expected; the study has the narrow figure
    for fit, true in offsets:
        camera_p, covariance = board_corner(fit, 7, 2, noise)
        error = camera_p - transform_points(true, np.array([70.0, 20.0, 0.0]))
        assert np.linalg.norm(error) < 0.05
        assert error @ np.linalg.solve(covariance, error) < 25.0
        assert (np.linalg.eigvalsh(covariance) > 0).all()
        assert np.sqrt(np.trace(covariance)) < 0.05


def test_corner_covariance_against_samples() -> None:
    true = board_pose(PLAIN, 10.0)
    fit = detect_board(frames_of([BoardSurface(PLAIN, true)], far_mm=260.0)[0], None, RIG, PLAIN)
    assert isinstance(fit, BoardFit)
    noise = pool_corner_noise([fit.pose])
    camera_p, covariance = board_corner(fit, 8, 0, noise)
    rng = np.random.default_rng(0)
    xi = rng.multivariate_normal(np.zeros(6), board_covariance(fit, noise), size=4000)
    samples = [
        transform_points(fit.camera_T_board @ make_transform(exp_so3(x[:3]), x[3:]), np.array([80.0, 0.0, 0.0]))
        for x in xi
    ]
    assert np.abs(np.cov(np.array(samples).T) - covariance).max() < 0.1 * np.abs(covariance).max()
    assert np.linalg.norm(np.mean(samples, axis=0) - camera_p) < 0.01


def test_corner_outside_the_board_raises() -> None:
    fit = detect_board(frames_of([BoardSurface(PLAIN, board_pose(PLAIN, 0.0))], far_mm=260.0)[0], None, RIG, PLAIN)
    assert isinstance(fit, BoardFit)
    with pytest.raises(ValueError, match=r"corner \[9, 0\]"):
        board_corner(fit, 9, 0, pool_corner_noise([fit.pose]))


def _covered() -> tuple[FloatArray, tuple[Frame, Frame]]:
    true = board_pose(CHARUCO, 15.0)
    hand = true @ make_transform(np.eye(3), np.array([15.0, 20.0, -8.0]))
    return true, frames_of([BoardSurface(CHARUCO, true), PatchSurface(hand, 40.0, 30.0, 0.5)], far_mm=260.0)


def test_charuco_partly_covered_is_still_found() -> None:
    true, (left, right) = _covered()
    fit = detect_board(left, right, RIG, CHARUCO)
    assert isinstance(fit, BoardFit)
    assert 30 < fit.pose.corners < 100
    assert rotation_error_deg(true, fit.camera_T_board) < 0.05
    covered, _ = board_corner(fit, 2, 2, pool_corner_noise([fit.pose]))
    assert np.linalg.norm(covered - transform_points(true, np.array([20.0, 20.0, 0.0]))) < 0.05


@pytest.mark.parametrize("turn", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)])
def test_views_that_disagree_are_weighed_not_thrown_away(turn: tuple[float, float, float]) -> None:
    # 0.2 deg in the stereo rotation are 4 px at every corner of the right view.
    assert RIG.right_T_left is not None
    error = make_transform(exp_so3(np.radians(0.2) * np.array(turn)), np.zeros(3))
    rig = StereoRig(RIG.left, RIG.right, as_float_array(RIG.right_T_left @ error, 4, 4))
    for roll_deg in (0.0, 37.0, 80.0):
        true = board_pose(CHARUCO, roll_deg)
        fit = detect_board(*frames_of([BoardSurface(CHARUCO, true)], far_mm=260.0), rig, CHARUCO)
        assert isinstance(fit, BoardFit), fit
        assert fit.pose.corners == 108
        assert fit.pose.left_out == ()
        assert rotation_error_deg(true, fit.camera_T_board) < 0.3


@pytest.mark.parametrize("printed_legacy", [False, True])
def test_legacy_pattern_is_found_where_declared_and_hinted_at_where_not(printed_legacy: bool) -> None:
    boards = [BoardModel(8, 7, 9.0, CharucoModel("DICT_5X5_100", 6.0, legacy)) for legacy in (False, True)]
    printed, other = boards[printed_legacy], boards[not printed_legacy]
    true = board_pose(printed, 10.0)
    left, _ = frames_of([BoardSurface(printed, true)], far_mm=260.0)
    fit = detect_board(left, None, RIG, printed)
    assert isinstance(fit, BoardFit)
    assert rotation_error_deg(true, fit.camera_T_board) < 0.05
    assert np.linalg.norm(fit.camera_T_board[:3, 3] - true[:3, 3]) < 0.05
    undeclared = detect_board(left, None, RIG, other)
    assert isinstance(undeclared, NotFound)
    assert undeclared.reason.endswith(f"board.charuco.legacy: {str(printed_legacy).lower()}")
    # With an odd number of rows of squares the two are the same.
    odd = BoardModel(8, 6, 9.0, CharucoModel("DICT_5X5_100", 6.0, printed_legacy))
    image, _ = frames_of([BoardSurface(odd, board_pose(odd, 10.0))], far_mm=260.0)
    for legacy in (False, True):
        same = BoardModel(8, 6, 9.0, CharucoModel("DICT_5X5_100", 6.0, legacy))
        assert isinstance(detect_board(image, None, RIG, same), BoardFit)


def test_board_in_one_view_or_none() -> None:
    true = board_pose(PLAIN, 0.0)
    left, right = frames_of([BoardSurface(PLAIN, true)], far_mm=260.0)
    nothing = np.full_like(left, 60)
    fit = detect_board(nothing, right, RIG, PLAIN)
    assert isinstance(fit, BoardFit)
    assert fit.pose.views == ("right",)
    assert np.linalg.norm(fit.camera_T_board[:3, 3] - true[:3, 3]) < 0.1
    none = detect_board(nothing, None, StereoRig(LEFT), PLAIN)
    assert isinstance(none, NotFound)
    assert none.reason == "board: not found in the left view"
