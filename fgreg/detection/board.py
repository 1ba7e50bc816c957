"""The calibration board in one or two frames: its pose and its corners, each with covariance.

Corner [column, row] of a plain chessboard: [0, 0] is the inner corner at a black corner square such that, seen from
the front with that square at the top left, columns run right and rows run down. On a board whose columns + rows is
even half a turn gives the same picture, so it is refused. A ChArUco board names its corners itself
(row * columns + column), in OpenCV's pattern since 4.6 or the legacy one.

Board frame: origin at corner [0, 0], x along the columns, y down the rows, z away from the viewer.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from fgreg.detection.body_pose import VIEW_NAMES, choose_pose, robust_pose
from fgreg.detection.corners import eight_bit, grey, refine_subpixel
from fgreg.detection.edge_pixels import GreyImage, Image
from fgreg.detection.pose_least_squares import CornerSet, join
from fgreg.detection.results import BoardFit, NotFound
from fgreg.detection.step_fit import MIN_CONTRAST
from fgreg.detection.tags import BORDER_PX, detector_parameters, dictionary_named, halved
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.lens import focal_px, ideal_by_lens, ideal_from_pixels, pixel_by_ideal_jacobian
from fgreg.model.session_model import BoardModel

CORNER_SIGMA_PX = 0.03
"""Sigma of a refined inner corner. Four squares meet there: the image is symmetric, so blur does not bias it."""
COMMON_PX = 0.01
"""Sigma of a corner error that is the same in both views (pixel grid, print)."""
MIN_CORNERS = 6
SMALL_WIDTH_PX = 640
HALF_ENOUGH = 0.5
"""Share of the corners that must be found at half resolution; else the full resolution is used."""


def _find_chessboard(image: Image, board: BoardModel) -> FloatArray | None:
    """Inner corners (rows * columns, 2), row by row, from any end; None where the whole board is not in view."""
    size = (board.columns, board.rows)
    pad = BORDER_PX
    whole = cv2.copyMakeBorder(image, pad, pad, pad, pad, cv2.BORDER_CONSTANT, value=255)
    scale = min(1.0, SMALL_WIDTH_PX / whole.shape[1])
    small = cv2.resize(whole, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1.0 else whole
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    for picture, factor in ((whole, 1.0), (small, scale)):
        found, corners = cv2.findChessboardCorners(picture, size, flags=flags)
        if found:
            return _unscaled(corners, factor)
    found, corners = cv2.findChessboardCornersSB(small, size)
    if found:
        return _unscaled(corners, scale)
    return None


def _unscaled(corners: npt.NDArray[np.generic], scale: float) -> FloatArray:
    """Image coordinates (n, 2) px of corners found in the padded copy, which has ``scale`` times the size."""
    px = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    return np.asarray((px + 0.5) / scale - 0.5 - BORDER_PX)


def order_corners(image: Image, corners_px: FloatArray, board: BoardModel) -> FloatArray | None:
    """Corners (rows * columns, 2) in the order row * columns + column; None where squares are not distinct.

    Args:
        corners_px: (rows * columns, 2) row by row, from any end, in either direction.
    """
    grid = corners_px.reshape(board.rows, board.columns, 2)
    right = (grid[:, 1:] - grid[:, :-1]).mean(axis=(0, 1))
    down = (grid[1:] - grid[:-1]).mean(axis=(0, 1))
    if right[0] * down[1] - right[1] * down[0] < 0.0:
        grid = grid[:, ::-1]  # seen from the front, rows run down where columns run right
    # The square inside corners [c, r] and [c + 1, r + 1] is black where c + r is even.
    centres = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    height, width = image.shape
    blurred = cv2.blur(image, (3, 3))
    x = np.clip(np.rint(centres[..., 0]).astype(int), 0, width - 1)
    y = np.clip(np.rint(centres[..., 1]).astype(int), 0, height - 1)
    level = blurred[y, x].astype(np.float64)
    even = (np.add.outer(np.arange(level.shape[0]), np.arange(level.shape[1])) % 2) == 0
    if even.all():  # a 2 x 2 board has only one inner square; session.yaml's check refuses it
        return None
    # Compare neighbours, so that uneven light over the board does not matter.
    sign = np.where(even, -1.0, 1.0)
    across = (level[:, 1:] - level[:, :-1]) * sign[:, 1:]
    along = (level[1:] - level[:-1]) * sign[1:]
    vote = np.concatenate([across.ravel(), along.ravel()])
    if abs(vote.mean()) < max(0.5 * np.abs(vote).mean(), MIN_CONTRAST):
        return None
    if vote.mean() < 0.0:
        grid = grid[::-1, ::-1]
    return grid.reshape(-1, 2)


def _spacing_px(corners_px: FloatArray, ids: IntArray, board: BoardModel) -> float:
    """Smallest distance (px) between detected neighbouring corners; 0 where there are none."""
    grid = np.full((board.rows, board.columns, 2), np.nan)
    grid[ids // board.columns, ids % board.columns] = corners_px
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).ravel() for axis in (0, 1)]
    gaps = np.concatenate(steps)
    gaps = gaps[np.isfinite(gaps)]
    return float(gaps.min()) if gaps.size else 0.0


def _charuco_pattern(board: BoardModel, legacy: bool) -> cv2.aruco.CharucoBoard:
    """OpenCV's board of one of the patterns."""
    assert board.charuco is not None
    pattern = cv2.aruco.CharucoBoard(
        (board.columns + 1, board.rows + 1),
        board.square_mm,
        board.charuco.marker_mm,
        dictionary_named(board.charuco.dictionary),
    )
    pattern.setLegacyPattern(legacy)
    return pattern


def charuco_squares(board: BoardModel) -> IntArray:
    """(markers, 2) column and row of the square with each marker of a ChArUco board, in the order of their ids."""
    assert board.charuco is not None
    corners_mm = np.asarray(_charuco_pattern(board, board.charuco.legacy).getObjPoints(), dtype=np.float64)
    return np.asarray(corners_mm[:, :, :2].mean(axis=1) // board.square_mm, dtype=np.int64)


def _find_charuco(image: Image, board: BoardModel, legacy: bool) -> tuple[FloatArray, IntArray] | None:
    """Corners (n, 2) px and their ids (n,) of a board of one of the patterns; None where the board is not found."""
    pattern = _charuco_pattern(board, legacy)
    detector = cv2.aruco.CharucoDetector(pattern, cv2.aruco.CharucoParameters(), detector_parameters())
    pad = BORDER_PX
    padded = cv2.copyMakeBorder(image, pad, pad, pad, pad, cv2.BORDER_CONSTANT, value=255)
    # Half resolution first: it takes a third of the time. The caller refines at full resolution in both cases.
    for scale, picture in ((2.0, halved(padded)), (1.0, padded)):
        if scale > 1.0 and image.shape[1] < 2 * SMALL_WIDTH_PX:
            continue
        corners, ids, _, _ = detector.detectBoard(picture)
        if ids is None or len(ids) == 0:
            continue
        if scale == 1.0 or len(ids) >= HALF_ENOUGH * board.columns * board.rows:
            pixels = (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) * scale - 0.5 - pad
            return pixels, np.asarray(ids, dtype=np.int64).ravel()
    return None


def find_board_corners(image: GreyImage, board: BoardModel) -> tuple[FloatArray, IntArray] | None:
    """Refined corners (n, 2) px and their ids (row * columns + column); None where the board is not found."""
    ids: IntArray
    whole_levels = eight_bit(image)
    if board.charuco is None:
        grid = _find_chessboard(whole_levels, board)
        corners = None if grid is None else order_corners(whole_levels, grid, board)
        if corners is None:
            return None
        ids = np.arange(board.rows * board.columns, dtype=np.int64)
        reach = 0.4 * _spacing_px(corners, ids, board)
    else:
        found = _find_charuco(whole_levels, board, board.charuco.legacy)
        if found is None:
            return None
        corners, ids = found
        # The refinement must not reach the markers in the white squares.
        gap = 0.5 * (1.0 - board.charuco.marker_mm / board.square_mm)
        reach = gap * _spacing_px(corners, ids, board) - 1.0
    corners = refine_subpixel(image, corners, int(np.clip(reach, 2, 9)))
    height, width = image.shape
    inside = (np.minimum(corners, np.array([width, height]) - 1.0 - corners) > 3.0).all(axis=1)
    return corners[inside], ids[inside]


def _view_corners(
    image: npt.NDArray[np.generic], camera: CameraModel, view: int, view_T_camera: FloatArray, board: BoardModel
) -> tuple[CornerSet | None, int]:
    """The board's corners in one view, and how many more were seen where its lens cannot be inverted."""
    found = find_board_corners(grey(image), board)
    if found is None:
        return None, 0
    pixels, ids = found
    ideal = ideal_from_pixels(camera, pixels)
    good = np.isfinite(ideal).all(axis=1)
    ideal, ids = ideal[good], ids[good]
    n, blind = len(ids), int((~good).sum())
    if n == 0:
        return None, blind
    inverse = np.linalg.inv(pixel_by_ideal_jacobian(camera, ideal))
    covariance = np.zeros((n, 2, n, 2))
    covariance[np.arange(n), :, np.arange(n), :] = CORNER_SIGMA_PX**2 * inverse @ np.swapaxes(inverse, 1, 2)
    board_p = np.column_stack([ids % board.columns, ids // board.columns, np.zeros(n)]) * board.square_mm
    corners = CornerSet(
        body_p_mm=board_p,
        ideal_px=ideal,
        view=np.full(n, view, dtype=np.int64),
        group=np.zeros(n, dtype=np.int64),
        covariance=covariance.reshape(2 * n, 2 * n),
        common_px=np.full(n, COMMON_PX),
        outward_px=np.zeros((n, 2)),
        focal_px=np.tile(focal_px(camera), (n, 1)),
        view_T_camera=np.tile(view_T_camera, (n, 1, 1)),
        by_lens=ideal_by_lens(camera, ideal),
    )
    return corners, blind


def _strays(corners: CornerSet) -> BoolArray:
    """(n,) outliers: corners far from the pose of the majority of their view (a glint, a finger, a misread marker).

    Each view has its own pose here: where the views disagree (an error of the stereo calibration) none of them has
    outliers, and the joint pose weighs all.
    """
    stray = np.zeros(len(corners.view), dtype=bool)
    for view in np.unique(corners.view):
        chosen = corners.view == view
        fit = robust_pose(corners.subset(chosen))
        if fit is not None:
            size = np.linalg.norm(fit.residual_px, axis=1)
            stray[chosen] = size > max(6.0 * float(np.median(size)), 0.5)
    return stray


def _pattern_hint(images: Sequence[npt.NDArray[np.generic] | None], board: BoardModel) -> str:
    """What to declare where one of the images shows the board in the other ChArUco pattern; else nothing."""
    if board.charuco is None or board.rows % 2 == 0:  # the patterns differ where the rows of squares are even
        return ""
    other = not board.charuco.legacy
    if all(image is None or _find_charuco(eight_bit(grey(image)), board, other) is None for image in images):
        return ""
    version = "before" if other else "since"
    return f"; it looks like the pattern of OpenCV {version} 4.6: board.charuco.legacy: {str(other).lower()}"


def detect_board(
    left: npt.NDArray[np.generic] | None,
    right: npt.NDArray[np.generic] | None,
    rig: StereoRig,
    board: BoardModel,
) -> BoardFit | NotFound:
    """Find the board in one or both frames of a shot.

    Args:
        left, right: (h, w) grey or (h, w, 3) BGR images, uint8 or uint16, of the rig's image size; None where absent.

    Raises:
        ValueError: a right frame without a right camera, no frame at all, an unknown dictionary, or not an image.
    """
    if left is None and right is None:
        raise ValueError("no frame to detect in")
    if right is not None and (rig.right is None or rig.right_T_left is None):
        raise ValueError("a right frame, but the rig has no right camera")
    parts: list[CornerSet] = []
    left_out: list[str] = []
    for view, (image, camera, view_T_camera) in enumerate(
        ((left, rig.left, np.eye(4)), (right, rig.right, rig.right_T_left))
    ):
        if image is None or camera is None or view_T_camera is None:
            continue
        corners, blind = _view_corners(image, camera, view, view_T_camera, board)
        parts += [] if corners is None else [corners]
        if blind:
            left_out.append(f"{blind} corners where the {VIEW_NAMES[view]} lens model cannot be inverted")
    where = " or ".join(name for name, image in zip(VIEW_NAMES, (left, right), strict=True) if image is not None)
    if not parts:
        why = f" ({', '.join(left_out)})" if left_out else _pattern_hint([left, right], board)
        return NotFound(f"board: not found in the {where} view{why}")
    everything = join(parts)
    if len(everything.view) < MIN_CORNERS:
        return NotFound(f"board: only {len(everything.view)} corners seen in the {where} view")
    stray = _strays(everything)
    left_out += [f"{int(stray.sum())} corners off the board"] if stray.any() else []
    if 3 * int(stray.sum()) > len(stray):
        return NotFound(f"board: {int(stray.sum())} of {len(stray)} corners do not fit the board")
    pose = choose_pose(everything.subset(~stray), "board", left_out, Constant.BOARD_SIZE)
    return pose if isinstance(pose, NotFound) else BoardFit(pose, board)
