"""How poses and spots that the cameras measure depend on the cameras' constants and on the prints, to first order.

A corner b of a body (a marker, a board) is seen by the left camera (frame ``camera``) and by the right one at

    p = R b (1 + size) + t,   q = right_R_left (p + w_s x p + v_s) + right_t_left (1 + scale)
    pixel = f (1 + focal) D(x / z, y / z) + centre,   of p or q

with (R, t) ``camera_T_body``, ``size`` the constant TAG_SIZE or BOARD_SIZE, (w_s, v_s) STEREO_ROTATION and
STEREO_TRANSLATION, ``scale`` CAMERA_SCALE, D the lens' distortion. The pose's twist (w, n), about the body's origin
along the camera's axes, moves it to (Exp(w) R, t + n). With J and C the derivatives of all corners by the twist and by
the constants c, W a weight (inverse covariance) and r observed less predicted corners at the fitted pose:

    twist(c) = -(J' W J)^-1 J' W C c,   L = C - J (J' W J)^-1 J' W C,   information = L' W L,   pull = L' W r

Corners are in ideal pixels: without distortion, counted from the principal point (fgreg.model.lens).
"""

from __future__ import annotations

import math

import numpy as np

from fgreg.geometry.rig import COUNT, Constant
from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray, hat, rotation_to_direction, transform_points
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.lens import focal_px, seen_by_lens
from fgreg.model.measurements import CameraDependence
from fgreg.model.session_model import SessionModel

CONSTANTS = COUNT - Constant.MARKER_BIAS_X
"""Number of constants of ``CAMERA``: columns of all derivatives."""
MODEL_PX = 0.1
"""Sigma of a corner, added to its noise where corners tell about the constants. What the lens model and the flatness of
a print leave is the same in shot after shot, so it does not average out. In rendered frames, which have neither, the
size of a tag scatters by 0.01 % from shot to shot; with this its sigma is 0.2 % per shot."""
_NEAREST_MM = 1.0
"""Points nearer than this to the camera's plane are not projected."""
_REGULAR = (1e-6,) * 3 + (1e-10,) * 3
"""Added to normal matrices of nominal detections (px^2 by rad^2 and mm^2), which may be singular."""


def column(constant: Constant) -> int:
    """Column of a constant of ``CAMERA`` in derivatives."""
    return constant - Constant.MARKER_BIAS_X


_FOCAL = (column(Constant.FOCAL_LEFT), column(Constant.FOCAL_RIGHT))
_CENTRE = tuple(slice(column(first), column(first) + 2) for first in (Constant.CENTRE_LEFT_X, Constant.CENTRE_RIGHT_X))
_TURN = slice(column(Constant.STEREO_ROTATION_X), column(Constant.STEREO_ROTATION_Z) + 1)
_SHIFT = slice(column(Constant.STEREO_TRANSLATION_X), column(Constant.STEREO_TRANSLATION_Z) + 1)
_SCALE, _TAG = column(Constant.CAMERA_SCALE), column(Constant.TAG_SIZE)
_BOARD, _VIEW_BIAS = column(Constant.BOARD_SIZE), column(Constant.VIEW_BIAS)


def corner_derivatives(
    camera_T_body: FloatArray,
    body_p_mm: FloatArray,
    view: IntArray,
    focal: FloatArray,
    view_T_camera: FloatArray,
    size: Constant,
    by_lens: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of n corners (ideal px) by the pose's twist, (..., n, 2, 6), and by the constants, (..., n, 2, 19).

    Args:
        camera_T_body: (..., 4, 4).
        body_p_mm: (n, 3).
        view: (n,) 0 left, 1 right.
        focal: (n, 2) px of the corner's camera.
        view_T_camera: (n, 4, 4) of the corner's camera from the left one.
        size: TAG_SIZE or BOARD_SIZE.
        by_lens: (..., n, 2, 3) derivative by the camera's focal length (relative) and centre.
    """
    arm = body_p_mm @ np.swapaxes(camera_T_body[..., :3, :3], -1, -2)
    p = arm + camera_T_body[..., None, :3, 3]
    rotation = view_T_camera[:, :3, :3]
    ideal, z = _ideal_px(camera_T_body, body_p_mm, focal, view_T_camera)
    projection = np.zeros((*z.shape, 2, 3))
    projection[..., 0, 0] = focal[:, 0] / z
    projection[..., 1, 1] = focal[:, 1] / z
    projection[..., 2] = -ideal / z[..., None]
    by_camera_p = projection @ rotation
    out = np.zeros((*z.shape, 2, CONSTANTS))
    for side in range(2):
        own = (view == side)[:, None]
        out[..., _FOCAL[side]] = own * by_lens[..., 0]
        out[..., _CENTRE[side]] = own[..., None] * by_lens[..., 1:]
    right = (view == 1)[:, None]
    out[..., _SCALE] = right * np.einsum("...nij,nj->...ni", projection, view_T_camera[:, :3, 3])
    out[..., _TURN] = right[..., None] * (-by_camera_p @ hat(p))
    out[..., _SHIFT] = right[..., None] * by_camera_p
    out[..., column(size)] = np.einsum("...nij,...nj->...ni", by_camera_p, arm)
    return np.concatenate([-by_camera_p @ hat(arm), by_camera_p], axis=-1), out


def _ideal_px(
    camera_T_body: FloatArray, body_p_mm: FloatArray, focal: FloatArray, view_T_camera: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Ideal pixels (..., n, 2) of corners and their depths (..., n), mm; arguments as of :func:`corner_derivatives`."""
    p = transform_points(camera_T_body[..., None, :, :], body_p_mm)
    q = np.einsum("nij,...nj->...ni", view_T_camera[:, :3, :3], p) + view_T_camera[:, :3, 3]
    z = np.maximum(q[..., 2], _NEAREST_MM)
    return focal * q[..., :2] / z[..., None], z


def _pixel_derivatives(
    rig: StereoRig, camera_T_body: FloatArray, corners_mm: FloatArray, size: Constant
) -> tuple[FloatArray, FloatArray]:
    """:func:`corner_derivatives` of corners (n, 3) in all v views of a rig, left first, in pixels as they are seen.

    Returns:
        (..., v n, 2, 6) and (..., v n, 2, 19).
    """
    views = _views(rig)
    n = len(corners_mm)
    view = np.repeat(np.arange(len(views)), n)
    view_T_camera = np.repeat(np.stack([transform for _, transform in views]), n, axis=0)
    focal = np.repeat(np.stack([focal_px(camera) for camera, _ in views]), n, axis=0)
    body_p = np.tile(corners_mm, (len(views), 1))
    ideal, _ = _ideal_px(camera_T_body, body_p, focal, view_T_camera)
    seen = [seen_by_lens(camera, ideal[..., k * n : (k + 1) * n, :]) for k, (camera, _) in enumerate(views)]
    by_lens, by_ideal = (np.concatenate(parts, axis=-3) for parts in zip(*seen, strict=True))
    J, C = corner_derivatives(camera_T_body, body_p, view, focal, view_T_camera, size, by_lens)
    return by_ideal @ J, by_ideal @ C


def _views(rig: StereoRig) -> list[tuple[CameraModel, FloatArray]]:
    """Each camera with ``view_T_camera`` (4, 4)."""
    views = [(rig.left, np.eye(4))]
    if rig.right is not None and rig.right_T_left is not None:
        views.append((rig.right, rig.right_T_left))
    return views


def fitted_dependence(
    camera_T_body: FloatArray,
    derivatives: tuple[FloatArray, FloatArray],
    fitted: FloatArray,
    covariance: FloatArray,
    residual_px: FloatArray,
    size: Constant,
) -> CameraDependence:
    """Dependence of a pose (4, 4) that was fitted to n corners.

    Where the corners miss the body by more than their noise and ``MODEL_PX`` explain, what they tell about the
    constants is weighed down to what is plausible (``plausible_share``).

    Args:
        derivatives: of the corners, (n, 2, 6) and (n, 2, 19) (:func:`corner_derivatives`).
        fitted: (2n, 2n) covariance of the corners that the pose was fitted with.
        covariance: (2n, 2n) stated one.
        residual_px: (n, 2) observed less predicted.
        size: TAG_SIZE (then the body is the marker, and has VIEW_BIAS) or BOARD_SIZE.
    """
    J, C = derivatives[0].reshape(-1, 6), derivatives[1].reshape(-1, CONSTANTS)
    turned = np.linalg.solve(fitted, J).T
    gain = -np.linalg.solve(turned @ J, turned @ C)
    if size is Constant.TAG_SIZE:
        gain = gain + _view_bias_gain(camera_T_body)
    both = np.column_stack([C, residual_px.ravel()])
    weight = np.linalg.inv(covariance + MODEL_PX**2 * np.eye(len(both)))
    both -= J @ np.linalg.solve(J.T @ weight @ J, J.T @ weight @ both)  # what no pose explains
    square = both.T @ weight @ both
    degrees = len(both) - 6
    share = plausible_share(square[-1, -1], degrees)
    information = 0.5 * share * (square + square.T)[:-1, :-1]
    return CameraDependence(np.asarray(gain), information, share * square[:-1, -1], float(square[-1, -1]), degrees)


def plausible_share(chi_square: float, degrees_of_freedom: int) -> float:
    """Factor (at most 1) that brings a chi square down to three sigma above its expectation."""
    allowed = degrees_of_freedom + 3.0 * math.sqrt(2.0 * degrees_of_freedom)
    return 1.0 if chi_square <= allowed else allowed / chi_square


def corner_dependence(camera_T_board: FloatArray, board_p_mm: FloatArray, board: CameraDependence) -> CameraDependence:
    """Dependence of a spot on the board, ``board_p_mm`` (3,), from that of the board's pose (4, 4)."""
    arm = camera_T_board[:3, :3] @ board_p_mm
    gain = board.gain[3:] - hat(arm) @ board.gain[:3]
    gain[:, _BOARD] += arm
    return CameraDependence(gain, board.information, board.pull, board.chi_square, board.degrees_of_freedom)


def nominal_pose_gain(model: SessionModel, camera_T_marker: FloatArray) -> FloatArray:
    """(..., 6, 19) gain of marker poses (..., 4, 4) that came without frames.

    That of a detection of all tags that face the camera, all corners equally well in pixels. Where the session does not
    say what the cameras or the tags are: distances scale with CAMERA_SCALE and TAG_SIZE, depths with both focal
    lengths' mean.
    """
    t = camera_T_marker[..., :3, 3]
    plain = np.zeros((*t.shape[:-1], 6, CONSTANTS))
    plain[..., 3:, :] = _plain_gain(t)
    plain[..., 3:, _TAG] = t
    if model.camera is None or model.marker is None:
        return plain + _view_bias_gain(camera_T_marker)
    tags = model.marker.tags
    centre = camera_T_marker[..., None, :, :] @ np.stack([tag.marker_T_tag for tag in tags])
    facing = np.sum(centre[..., :3, 2] * centre[..., :3, 3], axis=-1) < 0.0
    facing |= ~facing.any(axis=-1, keepdims=True)  # a marker whose tags' frames are not as printed
    corners = np.concatenate([tag.marker_p_corners_mm for tag in tags])
    gain = _nominal_gain(
        model.camera, camera_T_marker, corners, np.repeat(facing, 4, axis=-1), Constant.TAG_SIZE, plain
    )
    return gain + _view_bias_gain(camera_T_marker)


def nominal_spot_gain(model: SessionModel, camera_p_mm: FloatArray) -> FloatArray:
    """(..., 3, 19) gain of spots (..., 3) that came without frames.

    That of the centre of the session's board, seen from the front there. Without cameras or board: distances scale with
    CAMERA_SCALE, depths with both focal lengths' mean.
    """
    p = np.asarray(camera_p_mm, dtype=np.float64)
    plain = _plain_gain(p)
    if model.camera is None or model.board is None:
        return plain
    board = model.board
    across, down = (0.5 * board.square_mm * (count - 1) for count in (board.columns, board.rows))
    corners = np.array([[x, y, 0.0] for x in (-across, across) for y in (-down, down)])
    flat = p.reshape(-1, 3)
    camera_T_board = np.zeros((len(flat), 4, 4))
    camera_T_board[:, :3, 3], camera_T_board[:, 3, 3] = flat, 1.0
    for pose, spot in zip(camera_T_board, flat, strict=True):
        pose[:3, :3] = rotation_to_direction(spot / max(float(np.linalg.norm(spot)), _NEAREST_MM))
    body = np.zeros((len(flat), 6, CONSTANTS))
    body[:, 3:] = plain.reshape(-1, 3, CONSTANTS)
    facing = np.ones((len(flat), 4), dtype=bool)
    gain = _nominal_gain(model.camera, camera_T_board, corners, facing, Constant.BOARD_SIZE, body)
    return gain[:, 3:].reshape(plain.shape)


def nominal_point_gain(model: SessionModel, camera_p_mm: FloatArray) -> FloatArray:
    """(n, 3, 19) gain of points (n, 3) that both cameras see, each alone.

    Without two cameras: distances scale with CAMERA_SCALE, depths with both focal lengths' mean.
    """
    rig = model.camera
    if rig is None or rig.right is None or rig.right_T_left is None:
        return _plain_gain(camera_p_mm)
    camera_T_point = np.tile(np.eye(4), (len(camera_p_mm), 1, 1))
    camera_T_point[:, :3, 3] = camera_p_mm
    J, C = _pixel_derivatives(rig, camera_T_point, np.zeros((1, 3)), Constant.TAG_SIZE)
    J, C = J[..., 3:].reshape(-1, 4, 3), C.reshape(-1, 4, CONSTANTS)
    turned = np.swapaxes(J, -1, -2)
    return -np.asarray(np.linalg.solve(turned @ J, turned @ C))


def nominal_pose_dependence(model: SessionModel, camera_T_marker: FloatArray) -> CameraDependence:
    """Dependence of a marker pose (4, 4) that came without frames: nothing tells about the constants."""
    return _untold(nominal_pose_gain(model, camera_T_marker))


def nominal_spot_dependence(model: SessionModel, camera_p_mm: FloatArray) -> CameraDependence:
    """Dependence of a spot (3,) that came without frames: nothing tells about the constants."""
    return _untold(nominal_spot_gain(model, camera_p_mm))


def nominal_point_dependence(model: SessionModel, camera_p_mm: FloatArray) -> CameraDependence:
    """Dependence of a point (3,) that the cameras see by itself: it tells nothing about the constants."""
    return _untold(nominal_point_gain(model, camera_p_mm[None])[0])


def _untold(gain: FloatArray) -> CameraDependence:
    return CameraDependence(gain, np.zeros((CONSTANTS, CONSTANTS)), np.zeros(CONSTANTS))


def _plain_gain(p: FloatArray) -> FloatArray:
    """(..., 3, 19) shift of points (..., 3) where only lengths and focal lengths are known to matter."""
    out = np.zeros((*p.shape, CONSTANTS))
    out[..., _SCALE] = p
    out[..., 2, _FOCAL] = 0.5 * p[..., 2:]
    return out


def _nominal_gain(
    rig: StereoRig,
    camera_T_body: FloatArray,
    corners_mm: FloatArray,
    used: BoolArray,
    size: Constant,
    plain: FloatArray,
) -> FloatArray:
    """(..., 6, 19) of poses (..., 4, 4) fitted to corners (n, 3) of a body, ``used`` (..., n) of them, in all views.

    Where a corner is behind a camera: ``plain``.
    """
    in_front = np.ones(camera_T_body.shape[:-2], dtype=bool)
    views = _views(rig)
    for _, transform in views:
        depth = transform_points((transform @ camera_T_body)[..., None, :, :], corners_mm)[..., 2]
        in_front &= ((depth > _NEAREST_MM) | ~used).all(axis=-1)
    J, C = _pixel_derivatives(rig, camera_T_body, corners_mm, size)
    weight = np.tile(used, len(views))[..., None, None]
    lead = camera_T_body.shape[:-2]
    J, C = (J * weight).reshape(*lead, -1, 6), (C * weight).reshape(*lead, -1, CONSTANTS)
    turned = np.swapaxes(J, -1, -2)
    gain = -np.linalg.solve(turned @ J + np.diag(_REGULAR), turned @ C)
    return np.where(in_front[..., None, None], gain, plain)


def _view_bias_gain(camera_T_marker: FloatArray) -> FloatArray:
    """(..., 6, 19) with the column of VIEW_BIAS only: it is of measured less true position, so with a minus."""
    normal, t = camera_T_marker[..., :3, 2], camera_T_marker[..., :3, 3]
    sight = t / np.maximum(np.linalg.norm(t, axis=-1, keepdims=True), _NEAREST_MM)
    out = np.zeros((*normal.shape[:-1], 6, CONSTANTS))
    out[..., 3:, _VIEW_BIAS] = np.sum(normal * sight, axis=-1, keepdims=True) * sight - normal
    return out
