"""Marker bodies to print: tags side by side on a plate, or round a rod, one on each side of a prism.

The prism's frame: z along the rod, up as printed, origin at the middle of the tags; x out of the first tag. Seen from
the front, the next tag is the one on the right: the strip is folded around the rod with the print outwards.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fgreg.geometry.transforms import FloatArray, inverse, make_transform, transform_points
from fgreg.model.session_model import MarkerModel, TagModel
from fgreg.schema.problems import FieldError

SAME_MM, SAME_RAD = 0.01, 1e-4
"""Differences that two descriptions of one body may have: digits left out."""
FEWEST_SIDES = 3
SQUARE = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
"""Corners of a tag of half size 1, from the top left clockwise."""


def plate(dictionary: str, ids: Sequence[int], size_mm: float, pitch_mm: float) -> MarkerModel:
    """Tags in rows on a plate, as square as may be, from the top left; the body's origin is the middle of all.

    Args:
        pitch_mm: from one tag's middle to the next one's.
    """
    columns = math.ceil(math.sqrt(len(ids)))
    rows = math.ceil(len(ids) / columns)
    tags = []
    for k, tag_id in enumerate(ids):
        row, column = divmod(k, columns)
        place = np.array([column - (columns - 1) / 2, (rows - 1) / 2 - row, 0.0]) * pitch_mm
        tags.append(TagModel(tag_id, size_mm, make_transform(np.eye(3), place)))
    return MarkerModel(dictionary, tuple(tags))


def prism(dictionary: str, ids: Sequence[int], size_mm: float, apothem_mm: float) -> MarkerModel:
    """Tags on the sides of a regular prism.

    Args:
        apothem_mm: from the axis to the printed faces.
    """
    tags = []
    for k, tag_id in enumerate(ids):
        angle = 2 * math.pi * k / len(ids)
        c, s = math.cos(angle), math.sin(angle)
        rotation = np.array([[-s, 0.0, c], [c, 0.0, s], [0.0, 1.0, 0.0]])  # right, up and out of the tag
        tags.append(TagModel(tag_id, size_mm, make_transform(rotation, apothem_mm * rotation[:, 2])))
    return MarkerModel(dictionary, tuple(tags))


def side_mm(apothem_mm: float, sides: int) -> float:
    """Width of a regular prism's sides."""
    return 2 * apothem_mm * math.tan(math.pi / sides)


def apothem_for(width_mm: float, sides: int) -> float:
    """The apothem of the prism whose sides are ``width_mm`` wide, the inverse of :func:`side_mm`."""
    return width_mm / (2 * math.tan(math.pi / sides))


def prism_apothem(marker: MarkerModel) -> float | None:
    """The apothem (mm) where a body is a prism with its tags in the strip's order, in whatever frame; else None."""
    tags, sides = marker.tags, len(marker.tags)
    if sides < FEWEST_SIDES or len({tag.size_mm for tag in tags}) > 1:
        return None
    step = float(np.linalg.norm(tags[1].marker_T_tag[:3, 3] - tags[0].marker_T_tag[:3, 3]))
    apothem = step / (2 * math.sin(math.pi / sides))
    model = prism(marker.dictionary, [tag.id for tag in tags], tags[0].size_mm, apothem)
    same = all(
        _same(tag_T_other(tags[0], tag), tag_T_other(model.tags[0], other))
        for tag, other in zip(tags, model.tags, strict=True)
    )
    return apothem if same else None


def in_planes(marker: MarkerModel) -> list[list[TagModel]]:
    """The tags of a body by the plane that they lie in, in the order of the body's list."""
    planes: list[list[TagModel]] = []
    for tag in marker.tags:
        for plane in planes:
            first_T_tag = tag_T_other(plane[0], tag)
            if abs(first_T_tag[2, 3]) < SAME_MM and first_T_tag[2, 2] > 0 and np.hypot(*first_T_tag[:2, 2]) < SAME_RAD:
                plane.append(tag)
                break
        else:
            planes.append([tag])
    return planes


def check_printable(marker: MarkerModel) -> None:
    """Check that tags do not lie on each other, nor are wider than the sides of a prism.

    Raises:
        FieldError: they do, or are.
    """
    apothem = prism_apothem(marker)
    if apothem is not None and side_mm(apothem, len(marker.tags)) < marker.tags[0].size_mm:
        expected = f"at most {side_mm(apothem, len(marker.tags)):.4g} mm, the width of the prism's sides"
        raise FieldError.of(f"{marker.tags[0].size_mm:g}", expected, "tags", 0, "size_mm")
    for plane in in_planes(marker):
        corners = [on_plane(plane[0], tag, tag.size_mm / 2 * SQUARE) for tag in plane]
        for k, one in enumerate(corners):
            for m in range(k):
                if _overlap(one, corners[m]):
                    found, index = f"tag {plane[k].id} on top of tag {plane[m].id}", marker.tags.index(plane[k])
                    raise FieldError.of(found, "tags beside each other", "tags", index, "marker_T_tag")


def on_plane(first: TagModel, tag: TagModel, points_mm: FloatArray) -> FloatArray:
    """Points (n, 2) of a tag in the plane of the first one, which it lies in."""
    tag_p = np.column_stack([points_mm, np.zeros(len(points_mm))])
    return transform_points(tag_T_other(first, tag), tag_p)[:, :2]


def _overlap(a: FloatArray, b: FloatArray) -> bool:
    """Whether two convex polygons (n, 2) share an area: no side of either separates them."""
    for polygon in (a, b):
        edges = np.roll(polygon, -1, axis=0) - polygon
        for normal in np.column_stack([-edges[:, 1], edges[:, 0]]) / np.linalg.norm(edges, axis=1)[:, None]:
            along_a, along_b = a @ normal, b @ normal
            if min(along_a.max(), along_b.max()) - max(along_a.min(), along_b.min()) < SAME_MM:
                return False
    return True


def tag_T_other(tag: TagModel, other: TagModel) -> FloatArray:
    """The pose (4, 4) of another tag of the same body in a tag's frame."""
    return np.asarray(inverse(tag.marker_T_tag) @ other.marker_T_tag)


def _same(a: FloatArray, b: FloatArray) -> bool:
    far = bool(np.abs(a[:3, 3] - b[:3, 3]).max() > SAME_MM)
    return not far and bool(np.abs(a[:3, :3] - b[:3, :3]).max() < SAME_RAD)
