"""Pose of the fibre's marker from one or two frames, with covariance; refused where the frames do not determine it.

Tags are found in each view (tags.py), their corners refined by their edges (corners.py), and one pose is fitted to all
corners of both views (body_pose.py) from every planar hypothesis. A flat body in one view may have a second pose that
fits equally well: then the result is a reason, not a pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from fgreg.detection.body_pose import VIEW_NAMES, choose_pose, without_strays
from fgreg.detection.corners import eight_bit, grey, square_corners
from fgreg.detection.edge_pixels import GreyImage, Image
from fgreg.detection.edges import EdgeStart
from fgreg.detection.pose_least_squares import CornerSet, join
from fgreg.detection.results import MarkerFit, NotFound
from fgreg.detection.spoilt_tags import find_spoilt_tags
from fgreg.detection.tags import FoundTag, find_tags, tag_cells
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.lens import focal_px, ideal_by_lens, ideal_from_pixels
from fgreg.model.session_model import MarkerModel

LARGE_WIDTH_PX = 1000
"""In images of at least this width a single tag is first searched at half resolution."""
LEAST_SIDE_PX = 30.0
"""Shortest side of tags that were found before, at the resolution at which they are searched again."""


def _own_tags(found: list[FoundTag], marker: MarkerModel, view: str) -> tuple[list[FoundTag], list[str]]:
    """The body's tags, each once, and messages: an id seen at two positions is not used."""
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


@dataclass(frozen=True, slots=True, eq=False)
class ViewCorners:
    """Detection in one view: the corners, the tag id of each group, messages about what was left out, and the outlines
    (4 n, 2) px of the tags from the detector.

    ``others``: tags of the dictionary that are not the body's, as the detector reports them; None where only a part of
    the image was searched. ``again``: by tag id, what the fit of its edges in the next image may start with.
    """

    corners: CornerSet | None
    ids: tuple[int, ...]
    left_out: tuple[str, ...]
    outlines_px: FloatArray
    others: tuple[FoundTag, ...] | None = None
    again: Mapping[int, EdgeStart] = field(default_factory=dict)


Window = tuple[int, int, int, int]
"""Part of an image, px: first and last column, first and last row, the last ones exclusive."""


@dataclass(frozen=True, slots=True, eq=False)
class Near:
    """Where the tags were in the last image of this view.

    Attributes:
        window: the part of the image to be searched.
        shortest_px: the shortest side of a tag.
        again: as of :class:`ViewCorners`.
    """

    window: Window
    shortest_px: float
    again: Mapping[int, EdgeStart]


def _tags_in(
    picture: Image, marker: MarkerModel, view: str, near: Near | None
) -> tuple[list[FoundTag], list[str], tuple[FoundTag, ...] | None]:
    """The body's tags in the whole image or within ``near``, messages about what was left out, and all other tags."""
    if near is not None:
        shrink = next((times for times in (4, 2) if near.shortest_px >= times * LEAST_SIDE_PX), 1)
        left, right, top, bottom = near.window
        part = picture[top:bottom, left:right]
        found = find_tags(part, marker.dictionary, shrink=shrink, least_px=near.shortest_px)
        return *_own_tags(_moved(found, near.window), marker, view), None
    large = len(marker.tags) == 1 and picture.shape[1] >= LARGE_WIDTH_PX
    ids = {tag.id for tag in marker.tags}
    tags: list[FoundTag] = []
    left_out: list[str] = []
    others: list[FoundTag] = []
    for shrink, faint in ((2, False), (1, False), (2, True))[0 if large else 1 :]:
        if tags or (faint and left_out):
            break
        found = find_tags(picture, marker.dictionary, shrink=shrink, faint=faint)
        tags, left_out = _own_tags(found, marker, view)
        others = max(others, [tag for tag in found if tag.id not in ids], key=len)
    return tags, left_out, tuple(others)


def _spoilt_tags_in(picture: Image, marker: MarkerModel, near: Near | None) -> list[FoundTag]:
    ids = frozenset(tag.id for tag in marker.tags)
    if near is None:
        return find_spoilt_tags(picture, marker.dictionary, ids)
    return _moved(find_spoilt_tags(_part(picture, near.window), marker.dictionary, ids), near.window)


def _part(picture: Image, window: Window) -> Image:
    left, right, top, bottom = window
    return np.ascontiguousarray(picture[top:bottom, left:right])


def _moved(tags: list[FoundTag], window: Window) -> list[FoundTag]:
    """Tags found in a part of an image, in the whole image's pixels."""
    corner = np.array([window[0], window[2]], dtype=np.float64)
    return [FoundTag(tag.id, tag.corners_px + corner) for tag in tags]


def _why_unused(tag: FoundTag, camera: CameraModel, view: str) -> str:
    if not np.isfinite(ideal_from_pixels(camera, tag.corners_px)).all():
        return f"where the {view} lens model cannot be inverted"
    return f"cut by the border of the {view} view"


def view_corners(
    image: npt.NDArray[np.generic],
    camera: CameraModel,
    view: int,
    view_T_camera: FloatArray,
    marker: MarkerModel,
    *,
    edges: bool = True,
    near: Near | None = None,
) -> ViewCorners:
    """The body's corners in one view, ``view`` 0 (left) or 1 (right); ``near``: search only there."""
    picture = grey(image)
    whole_levels = eight_bit(picture)
    last = {} if near is None else near.again
    again: dict[int, EdgeStart] = {}

    def refined(tags: list[FoundTag]) -> list[CornerSet]:
        sets, starts = _corner_sets(tags, picture, camera, view, view_T_camera, marker, edges, last)
        again.update(starts)
        return sets

    tags, left_out, others = _tags_in(whole_levels, marker, VIEW_NAMES[view], near)
    sets = refined(tags)
    if not left_out and all(corners.numbers < 6 for corners in sets):
        # Not one tag of which three sides are seen: lines may show more than the outlines that were found.
        spoilt = _spoilt_tags_in(whole_levels, marker, near)
        shown = refined(spoilt)
        if sum(corners.numbers for corners in shown) > sum(corners.numbers for corners in sets):
            tags, sets = spoilt, shown
    return replace(_in_view(tags, sets, left_out, camera, view, others), again=again)


def _in_view(
    tags: list[FoundTag],
    sets: list[CornerSet],
    left_out: list[str],
    camera: CameraModel,
    view: int,
    others: tuple[FoundTag, ...] | None = None,
) -> ViewCorners:
    used = [(tag.id, corners) for tag, corners in zip(tags, sets, strict=True) if len(corners.view)]
    left_out += [
        f"tag {tag.id} {_why_unused(tag, camera, VIEW_NAMES[view])}"
        for tag, corners in zip(tags, sets, strict=True)
        if not len(corners.view)
    ]
    outlines = np.concatenate([tag.corners_px for tag in tags]) if tags else np.empty((0, 2))
    joined = join([corners for _, corners in used]) if used else None
    return ViewCorners(joined, tuple(i for i, _ in used), tuple(left_out), outlines, others)


def tag_corners(
    image: npt.NDArray[np.generic],
    camera: CameraModel,
    view: int,
    view_T_camera: FloatArray,
    marker: MarkerModel,
    found: Sequence[FoundTag],
    *,
    edges: bool = True,
) -> dict[int, CornerSet]:
    """Refined corners of a body's tags, by id, from what the detector has found in this view already."""
    tags, _ = _own_tags(list(found), marker, VIEW_NAMES[view])
    sets, _ = _corner_sets(tags, grey(image), camera, view, view_T_camera, marker, edges)
    return {tag.id: corners for tag, corners in zip(tags, sets, strict=True)}


def _corner_sets(
    tags: list[FoundTag],
    picture: GreyImage,
    camera: CameraModel,
    view: int,
    view_T_camera: FloatArray,
    marker: MarkerModel,
    edges: bool,
    last: Mapping[int, EdgeStart] = MappingProxyType({}),
) -> tuple[list[CornerSet], dict[int, EdgeStart]]:
    """The refined corners of each tag, none where the image's border cuts all of them; and by id, what the fit of its
    edges in the next image may start with."""
    if not tags:
        return [], {}
    cells, corners_px = tag_cells(marker.dictionary), np.stack([tag.corners_px for tag in tags])
    begin = [last.get(tag.id) for tag in tags]
    squares = square_corners(camera, picture, corners_px, cells, edges=edges, last=begin)
    models = {tag.id: tag for tag in marker.tags}
    sets = []
    for k, tag in enumerate(tags):
        keep = squares.found[k]
        both, count = np.repeat(keep, 2), int(keep.sum())
        sets.append(
            CornerSet(
                models[tag.id].marker_p_corners_mm[keep],
                squares.ideal_px[k][keep],
                np.full(count, view, dtype=np.int64),
                np.zeros(count, dtype=np.int64),
                squares.covariance[k][np.ix_(both, both)],
                squares.common_px[k][keep],
                squares.outward_px[k][keep],
                np.tile(focal_px(camera), (count, 1)),
                np.tile(view_T_camera, (count, 1, 1)),
                ideal_by_lens(camera, squares.ideal_px[k][keep]),
            )
        )
    return sets, {tag.id: start for tag, start in zip(tags, squares.again, strict=True) if start is not None}


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
    views: list[ViewCorners | None] = [None, None]
    if left is not None:
        views[0] = view_corners(left, rig.left, 0, np.eye(4), marker, edges=edges)
    if right is not None:
        views[1] = right_corners(right, rig, marker, edges=edges)
    return marker_from_views(views[0], views[1], marker)


def right_corners(
    right: npt.NDArray[np.generic], rig: StereoRig, marker: MarkerModel, *, edges: bool = True
) -> ViewCorners:
    """:func:`view_corners` of the right view. Raises ValueError where the rig has none."""
    if rig.right is None or rig.right_T_left is None:
        raise ValueError("a right frame, but the rig has no right camera")
    return view_corners(right, rig.right, 1, rig.right_T_left, marker, edges=edges)


def marker_from_views(
    left: ViewCorners | None, right: ViewCorners | None, marker: MarkerModel, earlier: MarkerFit | None = None
) -> MarkerFit | NotFound:
    """The marker's pose from its views; a view without a frame is None. Raises ValueError where both are None.

    ``earlier``: the fit of an earlier frame, of the same tags, as of :func:`fgreg.detection.body_pose.choose_pose`.
    """
    seen = [(name, view) for name, view in zip(VIEW_NAMES, (left, right), strict=True) if view is not None]
    if not seen:
        raise ValueError("no frame to detect in")
    left_out = [text for _, view in seen for text in view.left_out]
    parts = [view.corners for _, view in seen if view.corners is not None]
    if not parts:
        which = f"tag {marker.tags[0].id}" if len(marker.tags) == 1 else "no tag"
        verb = "not found" if len(marker.tags) == 1 else "found"
        extra = f" ({', '.join(left_out)})" if left_out else ""
        return NotFound(f"marker: {which} {verb} in the {' or '.join(name for name, _ in seen)} view{extra}")
    ids = [i for _, view in seen if view.corners is not None for i in view.ids]
    names = [f"tag {i} in {name} view" for name, view in seen if view.corners is not None for i in view.ids]
    kept, strays = without_strays(join(parts), names)
    tags = tuple(sorted({ids[int(g)] for g in np.unique(kept.group)}))
    before = earlier.pose if earlier is not None and earlier.tags == tags else None
    pose = choose_pose(kept, "marker", left_out + strays, Constant.TAG_SIZE, before)
    return pose if isinstance(pose, NotFound) else MarkerFit(pose, tags)
