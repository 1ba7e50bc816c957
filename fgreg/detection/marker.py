"""Pose of the fibre's marker from one or two frames, with covariance; refused where the frames cannot tell it.

Tags are found in each view (tags.py), their corners refined by their edges (corners.py), and one pose is fitted to all
corners of both views (pose.py) from every planar hypothesis. A flat body in one view has a second pose that may fit
as well: that is reported, not guessed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fgreg.detection.camera import focal_px
from fgreg.detection.corners import (
    COMMON_FALLBACK_PX,
    COMMON_PX,
    OUTWARD_FALLBACK_PX,
    OUTWARD_PX,
    grey,
    square_corners,
)
from fgreg.detection.noise import CornerNoise, fit_covariance
from fgreg.detection.pose import (
    CornerSet,
    PoseFit,
    common_covariance,
    corner_residuals,
    fit_pose,
    fit_with_excess,
    join,
    pose_hypotheses,
    whitener,
)
from fgreg.detection.tags import FoundTag, find_tags, tag_cells
from fgreg.frames import FloatArray, log_so3
from fgreg.models import CameraModel, MarkerModel, StereoRig

VIEW_NAMES = ("left", "right")
MAX_RMS_PX = 4.0
"""Residual beyond which the corners do not belong to one body as modelled."""
OTHER_POSE_RAD = 0.02
"""Minima closer than this are one pose."""
AMBIGUITY_SIGMA_PX = 0.15
"""Corner noise against which two hypotheses are told apart: more than what is measured, for what is not modelled (a
tag that is not quite flat, a lens not quite as calibrated)."""
AMBIGUITY_CHI2 = 25.0
"""Difference in chi-square at that noise (or at the residuals', where they are larger) below which a pose is ambiguous:
odds of 2.7e5 to 1."""


@dataclass(frozen=True, slots=True)
class NotFound:
    """Nothing that can be used; the reason as a plain sentence part."""

    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class MarkerFit:
    """A marker found.

    Attributes:
        camera_T_marker: (4, 4).
        information: (6, 6) over the right tangent (rotation rad, translation mm), at corner noise scale 1.
        common_covariance: (6, 6) of the errors that residuals cannot show (method bias, errors common to both views).
        cost: whitened sum of squared residuals, chi-square of ``dof`` at scale 1.
        dof: residuals less 6.
        corners: how many, over all views.
        views: names of the views used.
        tags: ids used.
        rms_px: root mean square distance of predicted from observed corners, undistorted pixels.
        residual_sum_px2: sum of those squared distances.
        second_ratio: RMS of the second planar hypothesis over that of this one; infinite where there is no second.
        left_out: what was seen but not used, with the reason.
    """

    camera_T_marker: FloatArray
    information: FloatArray
    common_covariance: FloatArray
    cost: float
    dof: int
    corners: int
    views: tuple[str, ...]
    tags: tuple[int, ...]
    rms_px: float
    residual_sum_px2: float
    second_ratio: float
    left_out: tuple[str, ...] = ()


def marker_covariance(fit: MarkerFit, noise: CornerNoise) -> FloatArray:
    """(6, 6) covariance over the right tangent (rotation rad, translation mm) at the session's corner noise."""
    return fit_covariance(fit, noise)


def _own_tags(found: list[FoundTag], marker: MarkerModel, view: str) -> tuple[list[FoundTag], list[str]]:
    """The body's tags, each once: an id seen in two places is not used."""
    ids = {tag.id for tag in marker.tags}
    kept: dict[int, FoundTag] = {}
    twice: set[int] = set()
    for tag in found:
        if tag.id not in ids:
            continue
        other = kept.get(tag.id)
        if other is None:
            kept[tag.id] = tag
            continue
        size = max(_side(tag), _side(other))
        if np.linalg.norm(tag.corners_px.mean(axis=0) - other.corners_px.mean(axis=0)) > 0.25 * size:
            twice.add(tag.id)
        elif _side(tag) > _side(other):
            kept[tag.id] = tag  # inner and outer contour of one border
    return [tag for tag in kept.values() if tag.id not in twice], [
        f"tag {i} twice in {view} view" for i in sorted(twice)
    ]


def _side(tag: FoundTag) -> float:
    return float(np.linalg.norm(np.roll(tag.corners_px, -1, axis=0) - tag.corners_px, axis=1).max())


def view_corners(
    image: npt.NDArray[np.generic],
    camera: CameraModel,
    view: int,
    view_T_camera: FloatArray,
    marker: MarkerModel,
    *,
    edges: bool = True,
) -> tuple[CornerSet | None, tuple[int, ...], list[str]]:
    """The body's corners in one view: (corners, tag id of each group, what was left out)."""
    picture = grey(image)
    tags, left_out = _own_tags(find_tags(picture, marker.dictionary), marker, VIEW_NAMES[view])
    if not tags:
        return None, (), left_out
    cells = tag_cells(marker.dictionary)
    squares = square_corners(camera, picture, np.stack([tag.corners_px for tag in tags]), cells, edges=edges)
    models = {tag.id: tag for tag in marker.tags}
    parts, ids = [], []
    for k, tag in enumerate(tags):
        keep = squares.found[k]
        if not keep.any():
            left_out.append(f"tag {tag.id} cut by the border of the {VIEW_NAMES[view]} view")
            continue
        both, count = np.repeat(keep, 2), int(keep.sum())
        parts.append(
            CornerSet(
                models[tag.id].marker_p_corners_mm[keep],
                squares.ideal_px[k][keep],
                np.full(count, view, dtype=np.int64),
                np.zeros(count, dtype=np.int64),
                squares.covariance[k][np.ix_(both, both)],
                np.where(squares.from_edges[k][keep], COMMON_PX, COMMON_FALLBACK_PX),
                _outward(squares.ideal_px[k], squares.from_edges[k])[keep],
                np.tile(focal_px(camera), (count, 1)),
                np.tile(view_T_camera, (count, 1, 1)),
            )
        )
        ids.append(tag.id)
    return (join(parts) if parts else None), tuple(ids), left_out


def _outward(corners_px: FloatArray, from_edges: npt.NDArray[np.bool_]) -> FloatArray:
    """(4, 2) one sigma of the outward error of a square's corners."""
    arm = corners_px - corners_px.mean(axis=0)
    arm /= np.linalg.norm(arm, axis=1)[:, None]
    return np.asarray(arm * np.where(from_edges, OUTWARD_PX, OUTWARD_FALLBACK_PX)[:, None])


def _rms(residual_px: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(residual_px**2, axis=1))))


def best_poses(corners: CornerSet, *, huber: float | None = None) -> list[PoseFit]:
    """Up to two distinct minima of the joint fit, best first, from all planar hypotheses."""
    white = whitener(corners.covariance)
    ranked: list[tuple[float, FloatArray]] = []
    for pose in pose_hypotheses(corners):
        residual, _, in_front = corner_residuals(corners, pose)
        if in_front:
            # Capped, so that one bad tag does not decide which hypothesis is tried first.
            size = np.sum((white @ residual.ravel()).reshape(-1, 2) ** 2, axis=1)
            ranked.append((float(np.minimum(size, 4.0 * np.median(size) + 1e-12).sum()), pose))
    ranked.sort(key=lambda item: item[0])
    fits: list[PoseFit] = []
    tried: list[FloatArray] = []
    for _, pose in ranked:
        if any(_angle(pose, other) < 0.1 for other in tried):
            continue
        tried.append(pose)
        fit = fit_pose(corners, pose, huber=huber)
        if fit is not None and all(_angle(fit.camera_T_body, f.camera_T_body) > OTHER_POSE_RAD for f in fits):
            fits.append(fit)
        if len(tried) >= 6:
            break
    if fits:
        # Where the perspective is weak the other hypothesis mirrors the tilt; a solver may have given only one.
        fit = fit_pose(corners, _mirrored(corners, fits[0].camera_T_body), huber=huber)
        if fit is not None and all(_angle(fit.camera_T_body, f.camera_T_body) > OTHER_POSE_RAD for f in fits):
            fits.append(fit)
    return sorted(fits, key=lambda fit: fit.cost)[:2]


def _angle(a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm(log_so3(a[:3, :3].T @ b[:3, :3])))


def _mirrored(corners: CornerSet, camera_T_body: FloatArray) -> FloatArray:
    """The same place with the body plane's normal mirrored at the line of sight."""
    points = corners.body_p_mm - corners.body_p_mm.mean(axis=0)
    normal = np.linalg.svd(points)[2][2]
    centre = camera_T_body[:3, :3] @ corners.body_p_mm.mean(axis=0) + camera_T_body[:3, 3]
    sight = centre / np.linalg.norm(centre)
    out = camera_T_body.copy()
    # Half a turn about the sight mirrors the tilt and turns the body round; half a turn about its normal undoes that.
    out[:3, :3] = _half_turn(sight) @ camera_T_body[:3, :3] @ _half_turn(normal)
    out[:3, 3] = centre - out[:3, :3] @ corners.body_p_mm.mean(axis=0)
    return out


def _half_turn(axis: FloatArray) -> FloatArray:
    return 2.0 * np.outer(axis, axis) - np.eye(3)


def _without_strays(corners: CornerSet, names: list[str]) -> tuple[CornerSet, list[str]]:
    """Drop tags that do not fit the body where most of them do (a tag read wrongly, or one that came off)."""
    groups = np.unique(corners.group)
    if len(groups) < 3:
        return corners, []
    fits = best_poses(corners, huber=3.0)
    if not fits:
        return corners, []
    rms = np.array([_rms(fits[0].residual_px[corners.group == g]) for g in groups])
    stray = rms > max(5.0 * float(np.median(rms)), 2.0)
    if not stray.any() or (~stray).sum() < 2:
        return corners, []
    kept = corners.subset(~np.isin(corners.group, groups[stray]))
    return kept, [f"{names[int(g)]} is {r:.1f} px off the body" for g, r in zip(groups[stray], rms[stray], strict=True)]


def detect_marker(
    left: npt.NDArray[np.generic] | None,
    right: npt.NDArray[np.generic] | None,
    rig: StereoRig,
    marker: MarkerModel,
    *,
    edges: bool = True,
) -> MarkerFit | NotFound:
    """Find the marker in one or both frames of a shot.

    Args:
        left, right: (h, w) grey or (h, w, 3) BGR images, uint8 or uint16, of the rig's image size; None where absent.
        edges: False refines corners with OpenCV's sub-pixel method only (for comparison).

    Raises:
        ValueError: a right frame without a right camera, no frame at all, an unknown dictionary, or not an image.
    """
    if left is None and right is None:
        raise ValueError("no frame to detect in")
    parts: list[CornerSet] = []
    names: list[str] = []
    ids: list[int] = []
    left_out: list[str] = []
    if left is not None:
        corners, tags, out = view_corners(left, rig.left, 0, np.eye(4), marker, edges=edges)
        left_out += out
        if corners is not None:
            parts.append(corners)
            ids += tags
            names += [f"tag {i} in left view" for i in tags]
    if right is not None:
        if rig.right is None or rig.right_T_left is None:
            raise ValueError("a right frame, but the rig has no right camera")
        corners, tags, out = view_corners(right, rig.right, 1, rig.right_T_left, marker, edges=edges)
        left_out += out
        if corners is not None:
            parts.append(corners)
            ids += tags
            names += [f"tag {i} in right view" for i in tags]
    where = " or ".join(name for name, image in zip(VIEW_NAMES, (left, right), strict=True) if image is not None)
    if not parts:
        which = f"tag {marker.tags[0].id}" if len(marker.tags) == 1 else "no tag"
        verb = "not found" if len(marker.tags) == 1 else "found"
        extra = f" ({', '.join(left_out)})" if left_out else ""
        return NotFound(f"marker: {which} {verb} in the {where} view{extra}")
    everything = join(parts)
    kept, strays = _without_strays(everything, names)
    left_out += strays
    return _fit(kept, ids, left_out)


def _fit(corners: CornerSet, ids: list[int], left_out: list[str]) -> MarkerFit | NotFound:
    if len(corners.view) < 4:
        return NotFound(f"marker: only {len(corners.view)} corners seen, at least 4 are needed")
    # Hypotheses are weighed at a noise that forgives what is not modelled; the chosen one is then fitted at its own.
    hypotheses = best_poses(corners.with_excess(AMBIGUITY_SIGMA_PX**2))
    chosen = fit_with_excess(corners, hypotheses[0].camera_T_body) if hypotheses else None
    if chosen is None:
        return NotFound("marker: no pose fits the corners seen")
    corners, best = chosen
    rms = _rms(best.residual_px)
    views = tuple(VIEW_NAMES[v] for v in np.unique(corners.view))
    if rms > MAX_RMS_PX:
        cause = "the two views or " if len(views) == 2 else ""
        return NotFound(f"marker: corners {rms:.1f} px off the best pose; {cause}the body's tags disagree")
    dof = 2 * len(corners.view) - 6
    ratio = np.inf
    if len(hypotheses) == 2:
        first, second = hypotheses
        ratio = _rms(second.residual_px) / max(_rms(first.residual_px), 1e-9)
        if second.cost - first.cost < AMBIGUITY_CHI2 * max(1.0, first.cost / max(dof, 1)):
            what = "ambiguous single view" if len(views) == 1 else "ambiguous"
            apart = np.degrees(_angle(first.camera_T_body, second.camera_T_body))
            return NotFound(f"marker: {what}: a second pose {apart:.0f} deg away fits only {ratio:.1f} times worse")
    return MarkerFit(
        camera_T_marker=best.camera_T_body,
        information=best.information,
        common_covariance=common_covariance(corners, best),
        cost=best.cost,
        dof=dof,
        corners=len(corners.view),
        views=views,
        tags=tuple(sorted({ids[int(g)] for g in np.unique(corners.group)})),
        rms_px=rms,
        residual_sum_px2=float(np.sum(best.residual_px**2)),
        second_ratio=float(ratio),
        left_out=tuple(left_out),
    )
