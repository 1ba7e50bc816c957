"""What a camera reads of markers, boards and points where rig and prints are not as declared.

Two ways. Where the session has a camera (``camera_declared`` or frames) the true rig projects the true corners of the
true prints, and the pose is what fits these pixels best by the declared rig and prints: all errors that the declared
model cannot follow stay as a bias. Where the session has none, lengths of the camera's space are scaled.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from fgreg.geometry.rig import CAMERA, Constant
from fgreg.geometry.transforms import FloatArray, IntArray, as_float_array, exp_so3, make_transform, transform_points
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.session_model import BoardModel, MarkerModel
from fgreg.simulation.config import SimulationConfig
from fgreg.simulation.lens import project_points

ITERATIONS = 40
SETTLED = 1e-7
"""Number of Gauss-Newton steps at most, and the size of a step (rad, mm) that is the last."""
STEP = 1e-3
"""Of numerical derivatives, rad and mm: the cube root of the rounding of pixels. Smaller ones leave noise where the two
views disagree by more than a pixel, and the fit never settles."""
_CONSTANTS = tuple(c for c in list(Constant)[CAMERA] if not c.name.startswith("MARKER_BIAS"))


def misread(config: SimulationConfig) -> bool:
    """Whether the camera reads anything but the truth, noise and the marker's constant bias aside."""
    return config.declared_camera is not None or any(config.deviations.get(c, 0.0) for c in _CONSTANTS)


@lru_cache(maxsize=8)
def true_rig(config: SimulationConfig) -> StereoRig:
    """The rig as it is."""
    rig, by = config.camera, config.deviations
    if rig.right is None or rig.right_T_left is None:
        return replace(rig, left=_true_camera(config, rig.left, 0))
    rotation = [by.get(Constant(Constant.STEREO_ROTATION_X + i), 0.0) for i in range(3)]
    translation = [by.get(Constant(Constant.STEREO_TRANSLATION_X + i), 0.0) for i in range(3)]
    scaled = rig.right_T_left.copy()
    scaled[:3, 3] *= 1.0 + by.get(Constant.CAMERA_SCALE, 0.0)
    # Right tangent; of a rotation so small Expmap moves the origin by the translation itself.
    right_T_left = scaled @ make_transform(exp_so3(np.array(rotation)), np.array(translation))
    return StereoRig(
        _true_camera(config, rig.left, 0), _true_camera(config, rig.right, 1), as_float_array(right_T_left)
    )


def _true_camera(config: SimulationConfig, camera: CameraModel, side: int) -> CameraModel:
    by = config.deviations
    matrix = camera.matrix.copy()
    matrix[:2, :2] *= 1.0 + by.get(Constant(Constant.FOCAL_LEFT + side), 0.0)
    matrix[0, 2] += by.get(Constant(Constant.CENTRE_LEFT_X + 2 * side), 0.0)
    matrix[1, 2] += by.get(Constant(Constant.CENTRE_LEFT_Y + 2 * side), 0.0)
    return replace(camera, matrix=as_float_array(matrix))


def declared_rig(config: SimulationConfig) -> StereoRig:
    """The rig as the session has it."""
    return config.declared_camera or config.camera


def true_marker(config: SimulationConfig) -> MarkerModel:
    """The marker as it was printed: each tag in its place, of its true size."""
    scale = 1.0 + config.deviations.get(Constant.TAG_SIZE, 0.0)
    return replace(config.marker, tags=tuple(replace(t, size_mm=scale * t.size_mm) for t in config.marker.tags))


def true_board(config: SimulationConfig) -> BoardModel:
    """The board as it was printed."""
    scale, board = 1.0 + config.deviations.get(Constant.BOARD_SIZE, 0.0), config.board
    charuco = board.charuco and replace(board.charuco, marker_mm=scale * board.charuco.marker_mm)
    return replace(board, square_mm=scale * board.square_mm, charuco=charuco)


def view_shift_mm(config: SimulationConfig, camera_T_marker: FloatArray) -> FloatArray:
    """(..., 3) how far markers (..., 4, 4) seem to be beside their place because of the angle they are seen at."""
    camera_T_tag = camera_T_marker @ config.marker.tags[0].marker_T_tag
    sight, normal = camera_T_tag[..., :3, 3], camera_T_tag[..., :3, 2]
    sight = sight / np.linalg.norm(sight, axis=-1, keepdims=True)
    across = normal - np.sum(normal * sight, axis=-1, keepdims=True) * sight
    return np.asarray(config.deviations.get(Constant.VIEW_BIAS, 0.0) * across)


def marker_poses_read(config: SimulationConfig, camera_T_marker: FloatArray) -> FloatArray:
    """(n, 4, 4) poses that the session's camera and prints make of true ones (n, 4, 4)."""
    if not misread(config) or not len(camera_T_marker):
        return camera_T_marker
    shift = view_shift_mm(config, camera_T_marker)
    if not config.has_camera:
        tag = 1.0 + config.deviations.get(Constant.TAG_SIZE, 0.0)
        place = _scaled(config, camera_T_marker[:, :3, 3]) / tag
        return make_transform(camera_T_marker[:, :3, :3], place + shift)
    tags, true_tags = config.marker.tags, true_marker(config).tags
    normal = np.stack([(camera_T_marker @ tag.marker_T_tag)[:, :3, 2] for tag in tags], axis=1)
    place = np.stack([(camera_T_marker @ tag.marker_T_tag)[:, :3, 3] for tag in tags], axis=1)
    facing = np.repeat(np.sum(normal * place, axis=-1) < 0.0, 4, axis=1).astype(np.float64)
    body = np.concatenate([tag.marker_p_corners_mm for tag in tags])
    true_body = np.concatenate([tag.marker_p_corners_mm for tag in true_tags])
    found = _fitted(config, camera_T_marker, true_body, body, np.stack([facing, facing], axis=1))
    found[:, :3, 3] += shift
    return found


def spots_read(
    config: SimulationConfig, camera_p_mm: FloatArray, camera_T_board: FloatArray, corner: IntArray
) -> FloatArray:
    """(n, 3) where the session's camera and board have the corners [column, row] (n, 2) that are at (n, 3)."""
    if not misread(config) or not len(camera_p_mm):
        return camera_p_mm
    if not config.has_camera:
        return _scaled(config, camera_p_mm)
    board = config.board
    rows, columns = np.divmod(np.arange(board.rows * board.columns), board.columns)
    grid = np.stack([columns, rows, 0 * rows], axis=-1).astype(np.float64)
    # The board is held so that the true corner is where it is; the others lie about it by the true size.
    true_mm = true_board(config).square_mm
    at = np.concatenate([corner, np.zeros((len(corner), 1))], axis=1)
    origin = camera_p_mm - np.einsum("nij,nj->ni", camera_T_board[:, :3, :3], at * true_mm)
    held = make_transform(camera_T_board[:, :3, :3], origin)
    seen = np.ones((len(held), 2, len(grid)))
    for side, (camera, camera_T_left) in enumerate(_views(true_rig(config))):
        seen[:, side] = _in_image(camera, transform_points(camera_T_left @ held[:, None], grid * true_mm))
    found = _fitted(config, held, grid * true_mm, grid * board.square_mm, seen)
    return transform_points(found, at * board.square_mm)


def points_read(config: SimulationConfig, camera_p_mm: FloatArray) -> FloatArray:
    """(n, 3) where the session's camera has points (n, 3), by triangulation."""
    if not misread(config) or not len(camera_p_mm):
        return camera_p_mm
    if not config.has_camera:
        return _scaled(config, camera_p_mm)
    body, n = np.zeros((1, 3)), len(camera_p_mm)
    start = make_transform(np.broadcast_to(np.eye(3), (n, 3, 3)), camera_p_mm)
    return _fitted(config, start, body, body, np.ones((n, 2, 1)), turns=False)[:, :3, 3]


def pixels_seen(config: SimulationConfig, camera_p_mm: FloatArray) -> FloatArray:
    """(2, 2) where the true cameras, left and right, have a point (3,)."""
    views = _views(true_rig(config))
    return np.stack([project_points(camera, transform_points(turn, camera_p_mm)) for camera, turn in views])


def _scaled(config: SimulationConfig, camera_p_mm: FloatArray) -> FloatArray:
    """Points (n, 3) as read where lengths are wrong, and depths by the focal lengths: disparity grows with them."""
    by = config.deviations
    focal = 1.0 + 0.5 * (by.get(Constant.FOCAL_LEFT, 0.0) + by.get(Constant.FOCAL_RIGHT, 0.0))
    return np.asarray(camera_p_mm / (1.0 + by.get(Constant.CAMERA_SCALE, 0.0)) / np.array([1.0, 1.0, focal]))


def _views(rig: StereoRig) -> list[tuple[CameraModel, FloatArray]]:
    views = [(rig.left, np.eye(4))]
    if rig.right is not None and rig.right_T_left is not None:
        views.append((rig.right, rig.right_T_left))
    return views


def _in_image(camera: CameraModel, camera_p_mm: FloatArray) -> FloatArray:
    """1 where points (..., 3) are in the image and within 50 deg, else 0."""
    ahead = (camera_p_mm[..., 2] > 1.0) & (np.abs(camera_p_mm[..., :2]).max(axis=-1) < 1.2 * camera_p_mm[..., 2])
    pixel = project_points(camera, np.where(ahead[..., None], camera_p_mm, np.array([0.0, 0.0, 1.0])))
    inside = ((pixel >= 0.0) & (pixel <= np.array(camera.image_size) - 1.0)).all(axis=-1)
    return np.asarray(ahead & inside, dtype=np.float64)


def _fitted(
    config: SimulationConfig,
    camera_T_body: FloatArray,
    true_body_p_mm: FloatArray,
    body_p_mm: FloatArray,
    weight: FloatArray,
    turns: bool = True,
) -> FloatArray:
    """Poses (n, 4, 4) by the declared rig of what the true rig sees of bodies at ``camera_T_body`` (n, 4, 4).

    Args:
        true_body_p_mm, body_p_mm: (m, 3) points of the body, true and declared.
        weight: (n, 2, m) of a point in each view.
        turns: estimate rotations as well.

    Raises:
        ValueError: no convergence.
    """
    true_views, views = _views(true_rig(config)), _views(declared_rig(config))

    def pixels(rig: list[tuple[CameraModel, FloatArray]], pose: FloatArray, body_p: FloatArray) -> FloatArray:
        shape = (*pose.shape[:-2], len(body_p), 2)
        left_p = transform_points(pose[..., None, :, :], body_p)
        seen = [project_points(camera, transform_points(view_T_left, left_p)) for camera, view_T_left in rig]
        return np.stack([np.broadcast_to(s, shape) for s in seen], axis=-3)  # (..., views, m, 2)

    target, n = pixels(true_views, camera_T_body, true_body_p_mm), len(camera_T_body)
    columns = np.arange(0 if turns else 3, 6)
    root = np.broadcast_to(np.sqrt(weight[:, : len(views), :, None]), target.shape).reshape(n, -1)
    pose = camera_T_body.copy()
    for _ in range(ITERATIONS):
        residual = root * (target - pixels(views, pose, body_p_mm)).reshape(n, -1)
        jacobian = np.empty((n, residual.shape[1], len(columns)))
        for k, column in enumerate(columns):
            step = STEP * np.eye(6)[column]
            ahead, behind = (pixels(views, _twisted(pose, sign * step), body_p_mm) for sign in (1.0, -1.0))
            jacobian[..., k] = root * (ahead - behind).reshape(n, -1) / (2.0 * STEP)
        normal = np.swapaxes(jacobian, 1, 2) @ jacobian
        step = np.zeros((n, 6))
        step[:, columns] = np.linalg.solve(normal, np.swapaxes(jacobian, 1, 2) @ residual[..., None])[..., 0]
        pose = _twisted(pose, step)
        if np.abs(step).max(initial=0.0) < SETTLED:
            return pose
    raise ValueError("no pose fits what the true camera sees: the constants are too far off")


def _twisted(pose: FloatArray, twist: FloatArray) -> FloatArray:
    """Poses turned about their origin and shifted, along the camera's axes; twist (..., 6), rotation first."""
    return make_transform(exp_so3(twist[..., :3]) @ pose[..., :3, :3], pose[..., :3, 3] + twist[..., 3:])
