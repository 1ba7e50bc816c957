"""Pose of a rigid body from its corners in one or two views: joint least squares, both planar hypotheses.

The residual is observed less predicted corner in ideal pixels (camera.py), whitened by the corners' covariance:

    r = W (f * pi(view_T_left * left_T_body * body_p) - observed),   W' W = inverse covariance

minimised over the right tangent (rotation rad, translation mm) of ``camera_T_body``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from fgreg.geometry.transforms import (
    BoolArray,
    FloatArray,
    IntArray,
    exp_so3,
    hat,
    inverse,
    make_transform,
    nearest_rotation,
)

ITERATIONS = 25
SEEN_PX = 2.0
"""A corner with a much larger sigma in some direction was not seen in that direction."""


@dataclass(frozen=True, slots=True, eq=False)
class CornerSet:
    """Corners of one body in all its views (n in all).

    Attributes:
        body_p_mm: (n, 3).
        ideal_px: (n, 2) observed.
        view: (n,) 0 left, 1 right.
        group: (n,) which tag (or board) of which view a corner belongs to.
        covariance: (2n, 2n) px^2 at unit corner noise scale, block diagonal over groups.
        common_px: (n,) sigma of a corner error that is the same in both views.
        outward_px: (n, 2) one sigma of a single error common to all corners: the bias of the corner method.
        focal_px: (n, 2) of the corner's camera.
        view_T_camera: (n, 4, 4) of the corner's camera from the left.
        by_lens: (n, 2, 3) derivative of the predicted corner by its camera's relative focal length and centre.
    """

    body_p_mm: FloatArray
    ideal_px: FloatArray
    view: IntArray
    group: IntArray
    covariance: FloatArray
    common_px: FloatArray
    outward_px: FloatArray
    focal_px: FloatArray
    view_T_camera: FloatArray
    by_lens: FloatArray

    def subset(self, keep: BoolArray) -> CornerSet:
        """The corners for which ``keep`` (n,) holds."""
        both = np.repeat(keep, 2)
        return CornerSet(
            self.body_p_mm[keep],
            self.ideal_px[keep],
            self.view[keep],
            self.group[keep],
            self.covariance[np.ix_(both, both)],
            self.common_px[keep],
            self.outward_px[keep],
            self.focal_px[keep],
            self.view_T_camera[keep],
            self.by_lens[keep],
        )

    def shares(self) -> FloatArray:
        """(n, 2, 2) how much a corner is known, by direction: 1 where it was seen, 0 along a side of which it is just
        some point."""
        n = len(self.view)
        blocks = self.covariance.reshape(n, 2, n, 2)[np.arange(n), :, np.arange(n)]
        return np.asarray(SEEN_PX**2 * np.linalg.inv(blocks + SEEN_PX**2 * np.eye(2)))

    @property
    def numbers(self) -> int:
        """Number of coordinates that were seen: two per corner, one where only one of its sides was."""
        return round(float(np.trace(self.shares(), axis1=1, axis2=2).sum()))

    def rms_px(self, residual_px: FloatArray) -> float:
        """Root mean square length of residuals (n, 2), as far as they were seen."""
        shares = self.shares()
        square = np.einsum("ni,nij,nj->", residual_px, shares, residual_px)
        return float(np.sqrt(2.0 * square / max(float(np.trace(shares, axis1=1, axis2=2).sum()), 1e-9)))

    def with_excess(self, variance_px2: float) -> CornerSet:
        """The same corners with this independent variance added to each coordinate."""
        return replace(self, covariance=self.covariance + variance_px2 * np.eye(len(self.covariance)))


def join(parts: list[CornerSet]) -> CornerSet:
    """All corners of several sets; their groups stay distinct."""
    groups, offset = [], 0
    for part in parts:
        groups.append(part.group + offset)
        offset += int(part.group.max(initial=-1)) + 1
    n = sum(len(part.view) for part in parts)
    covariance, at = np.zeros((2 * n, 2 * n)), 0
    for part in parts:
        size = len(part.covariance)
        covariance[at : at + size, at : at + size] = part.covariance
        at += size
    return CornerSet(
        np.concatenate([part.body_p_mm for part in parts]),
        np.concatenate([part.ideal_px for part in parts]),
        np.concatenate([part.view for part in parts]),
        np.concatenate(groups),
        covariance,
        np.concatenate([part.common_px for part in parts]),
        np.concatenate([part.outward_px for part in parts]),
        np.concatenate([part.focal_px for part in parts]),
        np.concatenate([part.view_T_camera for part in parts]),
        np.concatenate([part.by_lens for part in parts]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class PoseFit:
    """A minimum of the joint least squares.

    Attributes:
        camera_T_body: (4, 4).
        information: (6, 6) over the right tangent at unit corner noise scale.
        cost: whitened sum of squares, chi-square with ``numbers`` - 6 degrees of freedom at unit scale.
        residual_px: (n, 2) predicted less observed, ideal px.
    """

    camera_T_body: FloatArray
    information: FloatArray
    cost: float
    residual_px: FloatArray


def corner_residuals(corners: CornerSet, camera_T_body: FloatArray) -> tuple[FloatArray, FloatArray, bool]:
    """(residuals (n, 2) px, Jacobians (n, 2, 6) over the right tangent, whether all corners are in front)."""
    return _residuals(corners, _by_twist(corners), camera_T_body)


def _by_twist(corners: CornerSet) -> FloatArray:
    """(n, 3, 6) derivatives of the corners by the body's twist, in the body's frame; the same at every pose."""
    return np.concatenate([-hat(corners.body_p_mm), np.broadcast_to(np.eye(3), (len(corners.view), 3, 3))], axis=2)


def _residuals(
    corners: CornerSet, by_twist: FloatArray, camera_T_body: FloatArray
) -> tuple[FloatArray, FloatArray, bool]:
    """:func:`corner_residuals`, of corners whose :func:`_by_twist` is known."""
    view_T_body = corners.view_T_camera @ camera_T_body
    rotation = view_T_body[:, :3, :3]
    p = (rotation @ corners.body_p_mm[..., None])[..., 0] + view_T_body[:, :3, 3]
    in_front = bool((p[:, 2] > 1e-3).all())
    z = np.maximum(p[:, 2:], 1e-3)
    scale, xy = corners.focal_px / z, p[:, :2]
    residual = scale * xy - corners.ideal_px
    # d (f x / z) = f / z (dx - x / z dz)
    projection = rotation[:, :2] - (xy / z)[..., None] * rotation[:, 2:]
    return residual, (scale[..., None] * projection) @ by_twist, in_front


def whitener(covariance: FloatArray) -> FloatArray:
    """W with W' W the inverse of ``covariance``."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def fit_pose(
    corners: CornerSet, start: FloatArray, *, huber: float | None = None, settled: float = 1e-9
) -> PoseFit | None:
    """The minimum next to ``start`` (4, 4), by Levenberg-Marquardt; None where there is none in front of the camera.

    Args:
        huber: threshold of the Huber loss, in sigma of a corner (a start for the plain fit); None: plain fit.
        settled: fall of the cost, relative to 1 + cost, that is the last one.
    """
    white, by_twist = whitener(corners.covariance), _by_twist(corners)
    pose, damping = start.copy(), 1e-4
    residual, jacobian, in_front = _residuals(corners, by_twist, pose)
    if not in_front:
        return None

    def weigh(r: FloatArray) -> tuple[FloatArray, float]:
        flat = white @ r.ravel()
        if huber is None:
            return np.ones_like(flat), float(flat @ flat)
        size = np.maximum(np.linalg.norm(flat.reshape(-1, 2), axis=1), 1e-12)
        root = np.sqrt(np.minimum(1.0, huber / size))
        loss = np.where(size <= huber, size**2, huber * (2.0 * size - huber))
        return np.repeat(root, 2), float(loss.sum())

    root, cost = weigh(residual)
    for _ in range(ITERATIONS):
        j = root[:, None] * (white @ jacobian.reshape(-1, 6))
        r = root * (white @ residual.ravel())
        normal, gradient = j.T @ j, j.T @ r
        accepted = False
        for _ in range(8):
            damped = normal + damping * np.diag(np.diag(normal))
            step = np.asarray(-np.linalg.solve(damped, gradient), dtype=np.float64)
            trial = pose @ make_transform(exp_so3(step[:3]), step[3:])
            new_residual, new_jacobian, in_front = _residuals(corners, by_twist, trial)
            new_root, new_cost = weigh(new_residual)
            if in_front and new_cost <= cost:
                accepted = True
                break
            damping *= 10.0
        if not accepted:
            break
        drop = cost - new_cost
        pose, residual, jacobian, root, cost = trial, new_residual, new_jacobian, new_root, new_cost
        damping = max(damping * 0.1, 1e-12)
        if drop <= settled * (1.0 + cost) or (np.abs(step[:3]).max() < 1e-9 and np.abs(step[3:]).max() < 1e-7):
            break
    pose[:3, :3] = nearest_rotation(pose[:3, :3])
    residual, jacobian, in_front = _residuals(corners, by_twist, pose)
    if not in_front or not np.isfinite(pose).all():
        return None
    j = white @ jacobian.reshape(-1, 6)
    r = white @ residual.ravel()
    return PoseFit(pose, j.T @ j, float(r @ r), residual)


def fit_with_excess(corners: CornerSet, start: FloatArray) -> tuple[CornerSet, PoseFit] | None:
    """The plain fit; where the residuals far exceed the stated noise, with more variance for all corners.

    Errors of the body's model or of the lens calibration give all corners errors of similar size, independent of the
    image noise. The added variance brings chi-square down to three sigma above its expectation.

    Returns:
        the corners with the covariance used, and the fit; None where there is no minimum in front of the camera.
    """
    fit = fit_pose(corners, start)
    dof = corners.numbers - 6
    if fit is None or dof <= 0:
        return None if fit is None else (corners, fit)
    allowed = dof * (1.0 + 3.0 * np.sqrt(2.0 / dof))
    noisier = corners
    for _ in range(4):
        if fit.cost <= 1.02 * allowed:
            break
        # Residuals in the eigenbasis of the covariance: their chi-square is a sum over it, falling with the excess.
        values, vectors = np.linalg.eigh(corners.covariance)
        squares = (vectors.T @ fit.residual_px.ravel()) ** 2
        low, high = 0.0, float(squares.sum())
        for _ in range(50):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if float((squares / (values + middle)).sum()) > allowed else (low, middle)
        noisier = corners.with_excess(high)
        refit = fit_pose(noisier, fit.camera_T_body)
        if refit is None:
            return None
        fit = refit
    return noisier, fit


def common_covariance(corners: CornerSet, fit: PoseFit) -> FloatArray:
    """(6, 6) covariance of the pose, right tangent, from the corners' common errors, which residuals do not show.

    With the pose's response to corner errors A = (J' C^-1 J)^-1 J' C^-1, it is A (S + b b') A': S correlates a corner
    of the body with itself across views, b is the outward error.
    """
    _, jacobian, _ = corner_residuals(corners, fit.camera_T_body)
    answer = np.linalg.solve(fit.information, jacobian.reshape(-1, 6).T @ np.linalg.inv(corners.covariance))
    apart = np.linalg.norm(corners.body_p_mm[:, None] - corners.body_p_mm[None], axis=2)
    shared = (apart < 1e-6) * np.outer(corners.common_px, corners.common_px)
    outward = corners.outward_px.ravel()
    return np.asarray(answer @ (np.kron(shared, np.eye(2)) + np.outer(outward, outward)) @ answer.T)


def _rigid(rotation_vector: FloatArray, translation: FloatArray) -> FloatArray:
    return make_transform(exp_so3(np.asarray(rotation_vector).ravel()), np.asarray(translation).ravel())


def pose_hypotheses(corners: CornerSet) -> list[FloatArray]:
    """Starting poses ``camera_T_body`` from every group of at least four corners, and from each whole view."""
    sets: list[BoolArray] = [corners.group == g for g in np.unique(corners.group)]
    for v in np.unique(corners.view):
        whole = corners.view == v
        if not any(bool((whole == s).all()) for s in sets):
            sets.append(whole)
    out: list[FloatArray] = []
    for chosen in sets:
        if int(chosen.sum()) < 4:
            continue
        points, pixels = corners.body_p_mm[chosen], corners.ideal_px[chosen] / corners.focal_px[chosen]
        view_T_camera = corners.view_T_camera[chosen][0]
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        flat = spread[2] < 1e-6 * spread[0]
        method = cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_SQPNP
        try:
            _, rotations, translations, _ = cv2.solvePnPGeneric(
                points[:, None], pixels[:, None], np.eye(3), None, flags=method
            )
        except cv2.error:  # degenerate corners: no pose from this set
            continue
        for rotation_vector, translation in zip(rotations, translations, strict=True):
            view_T_body = _rigid(np.asarray(rotation_vector, np.float64), np.asarray(translation, np.float64))
            if np.isfinite(view_T_body).all():
                out.append(inverse(view_T_camera) @ view_T_body)
    return out
