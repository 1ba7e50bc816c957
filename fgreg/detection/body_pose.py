"""One pose from all corners of a body: hypotheses, outlier tags, the choice between two planar poses.

Where there is no unique pose, the result is a reason.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from fgreg.detection.pose_least_squares import (
    CornerSet,
    PoseFit,
    common_covariance,
    corner_residuals,
    fit_pose,
    fit_with_excess,
    pose_hypotheses,
    whitener,
)
from fgreg.detection.results import NotFound, RigidFit
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray
from fgreg.model.camera_dependence import corner_derivatives, fitted_dependence
from fgreg.model.measurements import CameraDependence

VIEW_NAMES = ("left", "right")
MAX_RMS_PX = 4.0
"""RMS residual above which the corners do not fit the modelled body."""
MIN_NUMBERS = 8
"""Coordinates that have to be seen: four corners over all views, or as many sides."""
OTHER_POSE_RAD = 0.02
"""Minima whose rotations differ by less are the same pose."""
AMBIGUITY_SIGMA_PX = 0.15
"""Corner noise for the comparison of two hypotheses. It is larger than the measured noise, to cover model errors (a
tag that is not flat, a calibration error of the lens)."""
STRAY_PX, STRAY_START_PX = 2.0, 15.0
"""RMS above which a tag is an outlier: at the fitted pose, and at the pose of another tag."""
AMBIGUITY_CHI2 = 25.0
"""A pose is ambiguous below this difference in chi-square, at that noise or at the residuals where they are larger.
Odds of 2.7e5 to 1."""

COMPARED = 1e-5
"""Fall of the cost, relative to 1 + cost, at which a hypothesis is compared with others."""
CLEAR = 10.0
"""Clearance (:class:`RigidFit`) from which a second pose need not be looked for where the body has hardly moved."""
HARDLY_RAD, HARDLY_SHARE, AS_GOOD = 0.05, 0.1, (1.5, 0.02)
"""It has hardly moved: its rotation, its position as a share of the distance; and the corners fit as well as before,
as a factor of their RMS and pixels."""


def angle_between(a: FloatArray, b: FloatArray) -> float:
    """Angle (rad) between the rotations of two poses (4, 4)."""
    return float(np.arccos(np.clip(0.5 * (np.sum(a[:3, :3] * b[:3, :3]) - 1.0), -1.0, 1.0)))


def _ranked_hypotheses(corners: CornerSet) -> list[FloatArray]:
    """Starting poses (4, 4), lowest capped cost first."""
    white = whitener(corners.covariance)
    ranked: list[tuple[float, FloatArray]] = []
    for pose in pose_hypotheses(corners):
        residual, _, in_front = corner_residuals(corners, pose)
        if in_front:
            # Capped, so that one outlier tag does not decide the order.
            size = np.sum((white @ residual.ravel()).reshape(-1, 2) ** 2, axis=1)
            ranked.append((float(np.minimum(size, 4.0 * np.median(size) + 1e-12).sum()), pose))
    return [pose for _, pose in sorted(ranked, key=lambda item: item[0])]


def best_poses(corners: CornerSet) -> list[PoseFit]:
    """Up to two distinct minima of the joint fit, best first, from all planar hypotheses."""
    fits: list[PoseFit] = []
    tried: list[FloatArray] = []
    for pose in _ranked_hypotheses(corners):
        if any(angle_between(pose, other) < 0.1 for other in tried):
            continue
        tried.append(pose)
        fit = fit_pose(corners, pose, settled=COMPARED)
        if fit is not None and all(angle_between(fit.camera_T_body, f.camera_T_body) > OTHER_POSE_RAD for f in fits):
            fits.append(fit)
        if len(tried) >= 4:
            break
    if fits:
        # Under weak perspective the second minimum has the mirrored tilt. A solver may have returned only one of them.
        fit = fit_pose(corners, _mirrored(corners, fits[0].camera_T_body), settled=COMPARED)
        if fit is not None and all(angle_between(fit.camera_T_body, f.camera_T_body) > OTHER_POSE_RAD for f in fits):
            fits.append(fit)
    return sorted(fits, key=lambda fit: fit.cost)[:2]


def _mirrored(corners: CornerSet, camera_T_body: FloatArray) -> FloatArray:
    """Pose (4, 4) at the same position with the plane's normal mirrored at the line of sight."""
    points = corners.body_p_mm - corners.body_p_mm.mean(axis=0)
    normal = np.linalg.svd(points)[2][2]
    centre = camera_T_body[:3, :3] @ corners.body_p_mm.mean(axis=0) + camera_T_body[:3, 3]
    sight = centre / np.linalg.norm(centre)
    out = camera_T_body.copy()
    # Half a turn about the sight mirrors the tilt and rotates the body; half a turn about its normal undoes that.
    out[:3, :3] = _half_turn(sight) @ camera_T_body[:3, :3] @ _half_turn(normal)
    out[:3, 3] = centre - out[:3, :3] @ corners.body_p_mm.mean(axis=0)
    return out


def _half_turn(axis: FloatArray) -> FloatArray:
    return 2.0 * np.outer(axis, axis) - np.eye(3)


def robust_pose(corners: CornerSet) -> PoseFit | None:
    """Huber fit from the best hypothesis; None where there is none."""
    ranked = _ranked_hypotheses(corners)
    return fit_pose(corners, ranked[0], huber=3.0) if ranked else None


def without_strays(corners: CornerSet, names: list[str]) -> tuple[CornerSet, list[str]]:
    """Drop outlier tags (a misread tag, or one that came off) where most tags fit the body.

    Two candidates are robust to outliers: a Huber fit to all corners, which suits many small tags, and the pose of one
    tag with which most others agree, which suits few large tags. The one with the lower capped RMS sum is used.

    Args:
        names: of each group, for the messages.

    Returns:
        the inlier corners, and a message for each outlier tag.
    """
    groups = np.unique(corners.group)
    if len(groups) < 3:
        return corners, []
    forgiving = corners.with_excess(AMBIGUITY_SIGMA_PX**2)
    robust = robust_pose(forgiving)
    if robust is not None and (_agreement(corners, robust.camera_T_body)[0] <= STRAY_PX).all():
        return corners, []
    poses = [] if robust is None else [robust.camera_T_body]
    ranked = sorted(pose_hypotheses(corners), key=lambda pose: float(_agreement(corners, pose)[1]))
    for pose in ranked[:3]:
        agreed = np.isin(corners.group, groups[_agreement(corners, pose)[0] < STRAY_START_PX])
        fit = fit_pose(forgiving.subset(agreed), pose) if agreed.sum() >= 4 else None
        poses += [] if fit is None else [fit.camera_T_body]
    if not poses:
        return corners, []
    rms, _ = min((_agreement(corners, pose) for pose in poses), key=lambda item: item[1])
    stray = rms > max(5.0 * float(np.median(rms)), STRAY_PX)
    if not stray.any() or (~stray).sum() < 2:
        return corners, []
    kept = corners.subset(~np.isin(corners.group, groups[stray]))
    return kept, [f"{names[int(g)]} is {r:.1f} px off the body" for g, r in zip(groups[stray], rms[stray], strict=True)]


def _agreement(corners: CornerSet, camera_T_body: FloatArray) -> tuple[FloatArray, float]:
    """RMS (px) of each group at a pose, and the sum of the capped RMS: small where many groups agree."""
    residual, _, in_front = corner_residuals(corners, camera_T_body)
    each = [corners.group == g for g in np.unique(corners.group)]
    rms = np.array([corners.subset(chosen).rms_px(residual[chosen]) for chosen in each])
    return rms, float(np.minimum(rms, STRAY_START_PX).sum()) if in_front else np.inf


def _found_again(corners: CornerSet, earlier: RigidFit) -> tuple[CornerSet, PoseFit] | None:
    """The corners with the covariance used, and the pose next to that of an earlier frame, if that was clear and the
    body has hardly moved."""
    views = tuple(VIEW_NAMES[v] for v in np.unique(corners.view))
    if earlier.clearance is None or earlier.clearance < CLEAR or earlier.views != views:
        return None
    if earlier.corners != len(corners.view) or (chosen := fit_with_excess(corners, earlier.camera_T_body)) is None:
        return None
    pose, before = chosen[1].camera_T_body, earlier.camera_T_body
    moved = np.linalg.norm(pose[:3, 3] - before[:3, 3])
    still = angle_between(pose, before) < HARDLY_RAD and moved < HARDLY_SHARE * np.linalg.norm(before[:3, 3])
    as_good = corners.rms_px(chosen[1].residual_px) < AS_GOOD[0] * earlier.rms_px + AS_GOOD[1]
    return chosen if still and as_good else None


def choose_pose(
    corners: CornerSet, what: str, left_out: list[str], size: Constant, earlier: RigidFit | None = None
) -> RigidFit | NotFound:
    """The pose of a body from the better planar hypothesis, if the other one fits significantly worse.

    Args:
        what: the body's name in messages, e.g. ``marker``.
        left_out: messages about dropped corners, copied to the result.
        size: the constant that scales the body.
        earlier: its pose in an earlier frame, in which both were compared: where it hardly moved they are not again.
    """
    numbers = corners.numbers
    if numbers < MIN_NUMBERS:
        return NotFound(f"{what}: only {numbers // 2} corners seen, at least 4 are needed")
    chosen = None if earlier is None else _found_again(corners, earlier)
    ratio, clearance = (np.inf, np.inf) if earlier is None or chosen is None else (earlier.second_ratio, None)
    hypotheses: list[PoseFit] = []
    if chosen is None:
        # Hypotheses are compared at a noise that covers model errors. The chosen one is then fitted at the stated one.
        hypotheses = best_poses(corners.with_excess(AMBIGUITY_SIGMA_PX**2))
        chosen = fit_with_excess(corners, hypotheses[0].camera_T_body) if hypotheses else None
    if chosen is None:
        return NotFound(f"{what}: no pose fits the corners seen")
    stated = corners.covariance
    corners, best = chosen
    rms = corners.rms_px(best.residual_px)
    views = tuple(VIEW_NAMES[v] for v in np.unique(corners.view))
    if rms > MAX_RMS_PX:
        cause = "the two views or the model" if len(views) == 2 else "the model"
        return NotFound(f"{what}: corners {rms:.1f} px off the best pose; {cause} cannot be right")
    dof = numbers - 6
    if len(hypotheses) == 2:
        first, second = hypotheses
        ratio = corners.rms_px(second.residual_px) / max(corners.rms_px(first.residual_px), 1e-9)
        clearance = (second.cost - first.cost) / (AMBIGUITY_CHI2 * max(1.0, first.cost / max(dof, 1)))
        if clearance < 1.0:
            kind = "ambiguous single view" if len(views) == 1 else "ambiguous"
            apart = np.degrees(angle_between(first.camera_T_body, second.camera_T_body))
            return NotFound(f"{what}: {kind}: a second pose {apart:.0f} deg away fits only {ratio:.1f} times worse")
    return RigidFit(
        camera_T_body=best.camera_T_body,
        information=best.information,
        common_covariance=common_covariance(corners, best),
        cost=best.cost,
        dof=dof,
        corners=len(corners.view),
        views=views,
        rms_px=rms,
        second_ratio=float(ratio),
        clearance=clearance,
        left_out=tuple(left_out),
        tell_dependence=partial(_dependence, corners, stated, best, size),
    )


def _dependence(corners: CornerSet, stated: FloatArray, fit: PoseFit, size: Constant) -> CameraDependence:
    """Of the pose on the rig's constants; ``stated``: the corners' covariance before any excess."""
    derivatives = corner_derivatives(
        fit.camera_T_body,
        corners.body_p_mm,
        corners.view,
        corners.focal_px,
        corners.view_T_camera,
        size,
        corners.by_lens,
    )
    return fitted_dependence(fit.camera_T_body, derivatives, corners.covariance, stated, -fit.residual_px, size)
