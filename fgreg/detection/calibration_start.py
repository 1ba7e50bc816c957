"""Where a calibration starts from: a focal length from a list of them, and the poses of the board that OpenCV finds.

A lens without distortion, its centre in the middle of the picture, sees the boards best with about the right focal
length. What is left (distortion, centre) is for the joint least squares (fgreg.calibration.bundle).
"""

from __future__ import annotations

import cv2
import numpy as np

from fgreg.calibration.views import SIDES, CornerTable
from fgreg.errors import EstimationError
from fgreg.geometry.transforms import FloatArray, exp_so3, inverse, make_transform, nearest_rotation
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.lens import normalized_from_pixels, project

FOCAL_SHARES = np.geomspace(0.3, 4.0, 16)
"""Of the picture's width: fields of view of 118 to 14 degrees."""
TRIED_VIEWS = 12
"""With which focal lengths are compared."""


def bare_camera(image_size: tuple[int, int], focal: float, coefficients: int, fisheye: bool) -> CameraModel:
    """A camera of this focal length (px) without distortion, its centre in the middle of the picture."""
    width, height = image_size
    matrix = np.array([[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    return CameraModel(image_size, matrix, np.zeros(coefficients), fisheye)


def start(
    table: CornerTable, image_size: tuple[int, int], coefficients: int, fisheye: bool
) -> tuple[StereoRig, FloatArray]:
    """Cameras and the board's poses (V, 4, 4) in the left one, good enough for the least squares.

    Raises:
        EstimationError: the board cannot be placed, or no view has it in both pictures.
    """
    lenses, placed = [], []
    for side in range(int(table.side.max()) + 1):
        views = np.unique(table.view[table.side == side])
        if not views.size:
            raise EstimationError(f"the board is in no {SIDES[side]} picture")
        tried = views[np.unique(np.linspace(0, len(views) - 1, TRIED_VIEWS).astype(int))]
        best: tuple[float, CameraModel] | None = None
        for share in FOCAL_SHARES:
            camera = bare_camera(image_size, float(share) * image_size[0], coefficients, fisheye)
            errors = [_board_pose(camera, table, int(v), side)[1] for v in tried]
            error = float(np.mean(np.minimum(errors, 1e3)))
            if best is None or error < best[0]:
                best = error, camera
        assert best is not None
        lenses.append(best[1])
        placed.append({int(v): _board_pose(best[1], table, int(v), side)[0] for v in views})
    return _stereo(tuple(lenses), placed, len(table.names))


def place_boards(table: CornerTable, rig: StereoRig) -> FloatArray:
    """(V, 4, 4) poses of the board in the left camera, by either picture, with the cameras as they are.

    Raises:
        EstimationError: a board cannot be placed.
    """
    out = []
    for v in range(len(table.names)):
        for side, camera in ((0, rig.left), (1, rig.right)):
            pose = None if camera is None else _board_pose(camera, table, v, side)[0]
            if pose is not None:
                break
        if pose is None:
            raise EstimationError(f"{table.names[v]}: the board cannot be placed")
        out.append(pose if side == 0 or rig.right_T_left is None else inverse(rig.right_T_left) @ pose)
    return np.array(out)


def _board_pose(camera: CameraModel, table: CornerTable, view: int, side: int) -> tuple[FloatArray | None, float]:
    """camera_T_board (4, 4) and the mean error of its corners, px; None and inf where there is none."""
    own = (table.view == view) & (table.side == side)
    normalized, board_p, pixels = (
        normalized_from_pixels(camera, table.pixels[own]),
        table.board_p_mm[own],
        table.pixels[own],
    )
    good = np.isfinite(normalized).all(axis=1)
    if good.sum() < 6:
        return None, np.inf
    try:
        found, *placed = cv2.solvePnP(board_p[good], normalized[good], np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE)
    except cv2.error:
        return None, np.inf
    turn, shift = (np.asarray(part, dtype=np.float64).ravel() for part in placed)
    if not found or not np.isfinite(turn).all():
        return None, np.inf
    pose = make_transform(exp_so3(turn), shift)
    if float((board_p @ pose[2, :3] + pose[2, 3]).min()) <= 0.0:
        return None, np.inf
    error = project(camera, board_p @ pose[:3, :3].T + pose[:3, 3]) - pixels
    return pose, float(np.mean(np.linalg.norm(error, axis=1)))


def _stereo(
    lenses: tuple[CameraModel, ...], placed: list[dict[int, FloatArray | None]], views: int
) -> tuple[StereoRig, FloatArray]:
    if len(lenses) == 1:
        return StereoRig(lenses[0]), _whole([placed[0].get(v) for v in range(views)])
    left, right = placed
    apart = np.array(
        [b @ inverse(a) for v in range(views) if (a := left.get(v)) is not None and (b := right.get(v)) is not None]
    )
    if not len(apart):
        raise EstimationError("no view has the board in both pictures")
    turn = nearest_rotation(np.median(apart[:, :3, :3], axis=0))
    right_T_left = make_transform(turn, np.median(apart[:, :3, 3], axis=0))
    poses = []
    for v in range(views):
        seen, other = left.get(v), right.get(v)
        poses.append(inverse(right_T_left) @ other if seen is None and other is not None else seen)
    return StereoRig(lenses[0], lenses[1], right_T_left), _whole(poses)


def _whole(poses: list[FloatArray | None]) -> FloatArray:
    found = [pose for pose in poses if pose is not None]
    if len(found) < len(poses):
        raise EstimationError("the board cannot be placed in some views")
    return np.array(found)
