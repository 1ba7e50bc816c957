"""The joint least squares of a stereo calibration: lenses, stereo pose and the board's pose in each view.

With b a corner of the board, (R, t) ``left_T_board`` of its view and right_T_left = (Q, s), the cameras see

    p = R b + t   and   q = Q p + s,     pixel = f D(x / z, y / z) + c

D the lens' distortion (fgreg.model.lens). The residual is predicted less observed pixel. Levenberg-Marquardt over all
parameters at once; the poses are eliminated view by view (Schur complement), so the normal matrix is that of the P
shared parameters. A prior (P, P) may stand beside the corners; a weak one keeps what no view determines finite.

Source: Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000, section 6.1 (elimination), 2.3 (robust weights).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from fgreg.calibration import parameters
from fgreg.calibration.views import CornerTable
from fgreg.geometry.transforms import BoolArray, FloatArray, exp_so3, hat, make_transform, nearest_rotation
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.lens import distort, distort_jacobian, focal_px, pixels_from_normalized

ITERATIONS = 100
STRAY = 5.0
"""Residual, in robust sigmas of its axis, beyond which a corner is left out (a glint, a finger, a wrong id)."""
START_PX = 0.2
"""Sigma of a corner until the residuals have said it; only the weak prior is weighed by it."""
MIN_SIGMA_PX = 0.005
"""No corner is better than this, whatever the residuals of few corners say."""
_STEP = 1e-5
"""For derivatives by the coefficients, in which D is linear or nearly so."""
_HUBER = 2.0
_FAR_PX = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is known of the parameters before: ``information`` (P, P) about those of ``mean``."""

    mean: StereoRig
    information: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """The optimum.

    Attributes:
        rig: cameras and stereo pose.
        left_T_board: (V, 4, 4).
        information: (P, P) of the corners alone on the parameters, the boards' poses eliminated.
        covariance: (P, P) with the prior.
        sigma_px: of a corner along each axis, from the residuals.
        residual_px: (n, 2) predicted less observed, of all corners.
        used: (n,) those that are no strays.
    """

    rig: StereoRig
    left_T_board: FloatArray
    information: FloatArray
    covariance: FloatArray
    sigma_px: float
    residual_px: FloatArray
    used: BoolArray


def weak_prior(start: StereoRig) -> Prior:
    """Half of the focal length, half of the picture, coefficients of 3, a rotation of 1 rad, a shift of 100 mm."""
    sigmas: list[float] = []
    lenses = []
    for camera in parameters.cameras(start):
        width, height = camera.image_size
        sigmas += [*0.5 * focal_px(camera), 0.5 * width, 0.5 * height, *[3.0] * len(camera.distortion)]
        bare = np.array(parameters.lens_vector(camera))
        bare[4:] = 0.0
        lenses.append(parameters.with_lens(camera, bare))
    if start.right is None:
        return Prior(StereoRig(lenses[0]), np.diag(np.array(sigmas) ** -2.0))
    sigmas += [1.0] * 3 + [100.0] * 3
    return Prior(StereoRig(lenses[0], lenses[1], start.right_T_left), np.diag(np.array(sigmas) ** -2.0))


def fit(table: CornerTable, start: StereoRig, left_T_board: FloatArray, prior: Prior | None = None) -> Bundle:
    """The calibration next to a start; strays are left out.

    Args:
        table: the corners.
        start: cameras, whose lens models stay.
        left_T_board: (V, 4, 4) about where the board is.
        prior: of the parameters; None: :func:`weak_prior`.
    """
    prior = prior or weak_prior(start)
    rig, poses = _minimise(table, start, left_T_board, prior, START_PX, huber=True)
    used = np.ones(len(table.view), dtype=bool)
    sigma = START_PX
    for _ in range(3):
        residual = predict(rig, poses, table)[0] - table.pixels
        robust = np.maximum(1.4826 * np.median(np.abs(residual[used])), MIN_SIGMA_PX)
        before, used = used, (np.abs(residual) < STRAY * robust).all(axis=1)
        sigma = _sigma_px(residual, used, rig, len(poses))
        rig, poses = _minimise(table.subset(used), rig, poses, prior, sigma)
        if (before == used).all():
            break
    return summed_up(table, rig, poses, prior, used)


def summed_up(
    table: CornerTable, rig: StereoRig, left_T_board: FloatArray, prior: Prior, used: BoolArray | None = None
) -> Bundle:
    """Noise, information and covariance at an optimum."""
    used = np.ones(len(table.view), dtype=bool) if used is None else used
    residual = predict(rig, left_T_board, table)[0] - table.pixels
    sigma = _sigma_px(residual, used, rig, len(left_T_board))
    shared, _, _ = _reduced(table.subset(used), rig, left_T_board, residual[used], np.ones(int(used.sum())))
    information = shared / sigma**2
    covariance = np.linalg.inv(information + prior.information)
    return Bundle(rig, left_T_board, information, 0.5 * (covariance + covariance.T), sigma, residual, used)


def reduced_gradient(table: CornerTable, bundle: Bundle) -> FloatArray:
    """(P,) half the derivative of the corners' chi square by the parameters, the boards' poses following."""
    used = bundle.used
    ones = np.ones(int(used.sum()))
    part = _reduced(table.subset(used), bundle.rig, bundle.left_T_board, bundle.residual_px[used], ones)
    return np.asarray(part[1] / bundle.sigma_px**2)


def fit_poses(table: CornerTable, rig: StereoRig, left_T_board: FloatArray) -> FloatArray:
    """(V, 4, 4) poses of the board next to a start, with the cameras as they are."""
    fixed = Prior(rig, np.eye(len(parameters.names(rig))) * 1e18)
    return _minimise(table, rig, left_T_board, fixed, START_PX, huber=True)[1]


def _sigma_px(residual: FloatArray, used: BoolArray, rig: StereoRig, views: int) -> float:
    dof = max(2 * int(used.sum()) - len(parameters.names(rig)) - 6 * views, 1)
    return max(float(np.sqrt(np.sum(residual[used] ** 2) / dof)), MIN_SIGMA_PX)


def _camera_points(rig: StereoRig, left_T_board: FloatArray, table: CornerTable) -> FloatArray:
    """(n, 3) of each corner in the frame of its camera."""
    pose = left_T_board[table.view]
    p = np.einsum("nij,nj->ni", pose[:, :3, :3], table.board_p_mm) + pose[:, :3, 3]
    if rig.right_T_left is not None:
        right = table.side == 1
        p[right] = p[right] @ rig.right_T_left[:3, :3].T + rig.right_T_left[:3, 3]
    return np.asarray(p)


def predict(rig: StereoRig, left_T_board: FloatArray, table: CornerTable) -> tuple[FloatArray, bool]:
    """(n, 2) pixels at which the corners would be seen, and whether all of them are in front of their cameras."""
    p = _camera_points(rig, left_T_board, table)
    ahead = p[:, 2] > 1e-3
    normalized = p[:, :2] / np.where(ahead, p[:, 2], 1e-3)[:, None]
    out = np.empty((len(p), 2))
    for side, camera in enumerate(parameters.cameras(rig)):
        own = table.side == side
        out[own] = pixels_from_normalized(camera, normalized[own])
    return np.clip(np.nan_to_num(out, nan=_FAR_PX), -_FAR_PX, _FAR_PX), bool(ahead.all())


def lens_jacobian(camera: CameraModel, normalized: FloatArray) -> FloatArray:
    """(n, 2, 4 + coefficients) derivative of pixels by the camera's parameters."""
    count = len(camera.distortion)
    out = np.zeros((len(normalized), 2, 4 + count))
    out[:, [0, 1], [0, 1]] = distort(camera, normalized)
    out[:, 0, 2] = out[:, 1, 3] = 1.0
    values = parameters.lens_vector(camera)
    for i in range(count):
        step = np.zeros(len(values))
        step[4 + i] = _STEP
        more, less = (distort(parameters.with_lens(camera, values + s * step), normalized) for s in (1.0, -1.0))
        out[:, :, 4 + i] = focal_px(camera) * (more - less) / (2.0 * _STEP)
    return out


def _jacobians(rig: StereoRig, left_T_board: FloatArray, table: CornerTable) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the pixels by the P parameters, (n, 2, P), and by the right tangent of the pose, (n, 2, 6)."""
    p = _camera_points(rig, left_T_board, table)
    z = p[:, 2:]
    normalized = p[:, :2] / z
    by_p = np.zeros((len(p), 2, 3))
    shared = np.zeros((len(p), 2, len(parameters.names(rig))))
    for side, (camera, columns) in enumerate(zip(parameters.cameras(rig), parameters.lens_columns(rig), strict=True)):
        own = table.side == side
        shared[own, :, columns] = lens_jacobian(camera, normalized[own])
        by_normalized = focal_px(camera)[:, None] * distort_jacobian(camera, normalized[own])
        by_p[own, :, :2] = by_normalized / z[own, None]
        by_p[own, :, 2] = -np.einsum("nij,nj->ni", by_normalized, normalized[own]) / z[own]
    turn = left_T_board[table.view][:, :3, :3]
    if rig.right_T_left is not None:
        right = table.side == 1
        by_left = by_p[right] @ rig.right_T_left[:3, :3]
        left_p = (p[right] - rig.right_T_left[:3, 3]) @ rig.right_T_left[:3, :3]
        shared[right, :, -6:-3] = -by_left @ hat(left_p)
        shared[right, :, -3:] = by_left
        by_p[right] = by_left
    by_board = by_p @ turn
    return shared, np.concatenate([-by_board @ hat(table.board_p_mm), by_board], axis=2)


def _reduced(
    table: CornerTable,
    rig: StereoRig,
    left_T_board: FloatArray,
    residual: FloatArray,
    weight: FloatArray,
    damping: float = 0.0,
) -> tuple[FloatArray, FloatArray, list[tuple[FloatArray, FloatArray]]]:
    """Normal matrix (P, P) and gradient (P,) with the poses eliminated, and of each view what gives its step."""
    shared, pose = _jacobians(rig, left_T_board, table)
    root = np.sqrt(weight)[:, None, None]
    shared, pose, r = shared * root, pose * root, residual * root[:, :, 0]
    size = shared.shape[2]
    matrix, gradient, back = np.zeros((size, size)), np.zeros(size), []
    ends = np.searchsorted(table.view, np.arange(len(left_T_board) + 1))
    for first, last in itertools.pairwise(ends):
        a = shared[first:last].reshape(-1, size)
        b = pose[first:last].reshape(-1, 6)
        e = r[first:last].ravel()
        own = b.T @ b
        own += np.diag(damping * np.diag(own) + 1e-12)
        by_pose = np.linalg.solve(own, np.column_stack([b.T @ a, b.T @ e])).astype(np.float64)
        matrix += a.T @ a - (a.T @ b) @ by_pose[:, :-1]
        gradient += a.T @ e - (a.T @ b) @ by_pose[:, -1]
        back.append((np.asarray(by_pose[:, :-1]), np.asarray(by_pose[:, -1])))
    return matrix, gradient, back


def _minimise(
    table: CornerTable,
    rig: StereoRig,
    poses: FloatArray,
    prior: Prior,
    sigma_px: float,
    *,
    huber: bool = False,
) -> tuple[StereoRig, FloatArray]:
    def evaluate(rig: StereoRig, poses: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        predicted, ahead = predict(rig, poses, table)
        residual = predicted - table.pixels
        size = np.linalg.norm(residual, axis=1)
        limit = max(_HUBER * 1.4826 * float(np.median(size)), _HUBER * MIN_SIGMA_PX) if huber else np.inf
        weight = np.minimum(1.0, limit / np.maximum(size, 1e-12))
        loss = np.where(size <= limit, size**2, limit * (2.0 * size - limit)) if huber else size**2
        off = parameters.difference(rig, prior.mean)
        focal = all(focal_px(camera).min() > 1.0 for camera in parameters.cameras(rig))
        cost = float(loss.sum()) / sigma_px**2 + float(off @ prior.information @ off)
        return residual, weight, cost if ahead and focal and np.isfinite(cost) else np.inf

    damping, poses = 1e-3, poses.copy()
    residual, weight, cost = evaluate(rig, poses)
    for _ in range(ITERATIONS):
        done = True
        pull = prior.information @ parameters.difference(rig, prior.mean)
        for _ in range(10):
            matrix, gradient, back = _reduced(table, rig, poses, residual, weight, damping)
            matrix = matrix / sigma_px**2 + prior.information
            scaled = matrix + np.diag(damping * np.diag(matrix))
            step = np.asarray(-np.linalg.solve(scaled, gradient / sigma_px**2 + pull), dtype=np.float64)
            turns = np.array([-(own + by_shared @ step) for by_shared, own in back])
            new_rig = parameters.moved(rig, step)
            new_poses = poses @ make_transform(exp_so3(turns[:, :3]), turns[:, 3:])
            trial = evaluate(new_rig, new_poses)
            if trial[2] < cost:
                done = cost - trial[2] <= 1e-8 * cost
                rig, poses, (residual, weight, cost) = new_rig, new_poses, trial
                damping = max(0.2 * damping, 1e-9)
                break
            damping *= 6.0
        if done:
            break
    poses[:, :3, :3] = np.array([nearest_rotation(pose[:3, :3]) for pose in poses])
    return rig, poses
