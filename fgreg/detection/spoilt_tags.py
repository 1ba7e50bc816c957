"""Tags that the ArUco detector misses because their outline is broken: found by the four lines of their sides.

A speck or a stain on the outline breaks the contour that the detector needs, but leaves straight parts of the sides.
Line segments (OpenCV's LSD) with the dark side on their right are joined into four-sided outlines, clockwise as seen:
where two sides meet no corner need be seen. The cells inside an outline then tell which tag it is; some of them may be
spoilt. The result is a start, accurate to a pixel or two.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from fgreg.detection.edge_pixels import Image
from fgreg.detection.step_fit import MIN_CONTRAST
from fgreg.detection.tags import FoundTag, dictionary_named, halved
from fgreg.geometry.transforms import BoolArray, FloatArray

MAX_SEGMENTS = 80
"""The longest ones are used."""
MIN_SEGMENT_PX = 5.0
MIN_SIDE_PX = 16.0
MIN_TURN_RAD, MAX_TURN_RAD = 0.4, 2.75
"""Angle between neighbouring sides."""
MAX_GAP = 2.5
"""How far beyond its segments a corner may be, as a share of the longer one."""
SLACK = 0.1
"""A segment may reach beyond its side's ends by this share of the side."""
LEAST_SEEN = 0.3
"""Share of the outline that the four segments have to cover."""
MAX_OUTLINES = 400
SAMPLES = 3
"""A cell's level is the median of SAMPLES x SAMPLES pixels."""
MAX_WRONG_FRAME, MAX_WRONG_BITS = 0.3, 0.13
"""Share of the cells of border and quiet zone, and of the code's, that may be spoilt."""


def find_spoilt_tags(image: Image, dictionary: str, ids: frozenset[int]) -> list[FoundTag]:
    """The tags with these ids, each once, where a broken outline and its cells show them.

    Args:
        image: (h, w) uint8.
    """
    segments = _segments(image)
    outlines = _outlines(segments)
    if not len(outlines):
        return []
    found: dict[int, tuple[float, FloatArray]] = {}
    for tag_id, match, corners in _read(image, outlines, dictionary):
        if tag_id in ids and match > found.get(tag_id, (0.0, corners))[0]:
            found[tag_id] = match, corners
    return [FoundTag(tag_id, corners) for tag_id, (_, corners) in sorted(found.items())]


def _segments(image: Image) -> FloatArray:
    """Line segments (n, 2, 2) px, start and end, dark on the right of their direction as drawn (y down)."""
    half = halved(image)
    lines = cv2.createLineSegmentDetector().detect(half)[0]
    if lines is None:
        return np.empty((0, 2, 2))
    out = np.asarray(lines, dtype=np.float64).reshape(-1, 2, 2)
    along = out[:, 1] - out[:, 0]
    length = np.linalg.norm(along, axis=1)
    out, along, length = (a[np.argsort(-length)[:MAX_SEGMENTS]] for a in (out, along, length))
    keep = length > MIN_SEGMENT_PX
    out, along = out[keep], along[keep] / length[keep, None]
    right = np.stack([-along[:, 1], along[:, 0]], axis=1)
    smooth = np.asarray(cv2.blur(half, (3, 3)), dtype=np.uint8)
    middle = out.mean(axis=1)
    brighter = _level(smooth, middle + 2.5 * right) > _level(smooth, middle - 2.5 * right)
    out[brighter] = out[brighter, ::-1]
    return np.asarray(2.0 * out + 0.5)


def _level(image: Image, px: FloatArray) -> FloatArray:
    """Grey level at the pixels nearest to points (..., 2)."""
    height, width = image.shape
    x = np.clip(np.rint(px[..., 0]), 0, width - 1).astype(np.intp)
    y = np.clip(np.rint(px[..., 1]), 0, height - 1).astype(np.intp)
    return image[y, x].astype(np.float64)


def _outlines(segments: FloatArray) -> FloatArray:
    """Corners (n, 4, 2) px of outlines whose sides are four of the segments, the most of them seen first."""
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    length = np.linalg.norm(along, axis=1)
    along = along / length[:, None]
    # Where side j follows side i clockwise: s along i from its start, and t along j.
    cross = along[:, None, 0] * along[None, :, 1] - along[:, None, 1] * along[None, :, 0]
    turn = np.arctan2(cross, along @ along.T)
    between = start[None] - start[:, None]
    safe = np.where(np.abs(cross) < 1e-6, 1.0, cross)
    s = (between[..., 0] * along[None, :, 1] - between[..., 1] * along[None, :, 0]) / safe
    t = (between[..., 0] * along[:, None, 1] - between[..., 1] * along[:, None, 0]) / safe
    longer = np.maximum(length[:, None], length[None])
    follows = (turn > MIN_TURN_RAD) & (turn < MAX_TURN_RAD)
    follows &= (s > 0.5 * length[:, None]) & (t < 0.5 * length[None])
    follows &= (s < length[:, None] + MAX_GAP * longer) & (t > -MAX_GAP * longer)
    # Four sides i, j, k, l in turn, i the first in the list.
    i, j, k = np.nonzero(follows[:, :, None] & follows[None])
    first = (j > i) & (k > i)
    i, j, k = i[first], j[first], k[first]
    path, last = np.nonzero(follows[k] & follows[:, i].T & (np.arange(len(segments)) > i[:, None]))
    side = np.stack([i[path], j[path], k[path], last], axis=1)
    if not len(side):
        return np.empty((0, 4, 2))
    ends = s[side, np.roll(side, -1, axis=1)]  # along each side, where the next one meets it
    begins = t[np.roll(side, 1, axis=1), side]
    size = ends - begins
    slack = SLACK * size
    ok = (size > MIN_SIDE_PX) & (begins < slack) & (length[side] < ends + slack)
    seen = length[side].sum(axis=1) / np.maximum(size.sum(axis=1), 1e-9)
    good = np.flatnonzero(ok.all(axis=1) & (seen > LEAST_SEEN) & (size.max(axis=1) < 5.0 * size.min(axis=1)))
    good = good[np.argsort(-seen[good])[:MAX_OUTLINES]]
    return np.asarray(start[side[good]] + begins[good][..., None] * along[side[good]])


@lru_cache(maxsize=8)
def _codes(dictionary: str) -> BoolArray:
    """(ids, 4, n, n) white cells of every tag as printed, turned clockwise by 0, 90, 180, 270 deg; border included."""
    book = dictionary_named(dictionary)
    cells = int(book.markerSize) + 2
    tags = [
        np.asarray(cv2.aruco.generateImageMarker(book, number, cells)) > 127 for number in range(len(book.bytesList))
    ]
    return np.array([[np.rot90(tag, -turn) for turn in range(4)] for tag in tags])


def _read(image: Image, outlines: FloatArray, dictionary: str) -> list[tuple[int, float, FloatArray]]:
    """Id, share of matching cells and corners (4, 2) as printed of each outline (n, 4, 2) that holds a tag."""
    codes = _codes(dictionary)
    cells = codes.shape[-1]
    # One pixel of each cell tells the most of them apart.
    white, contrast = _white_cells(image, outlines, cells, 1)
    outlines = outlines[(contrast > MIN_CONTRAST) & _framed(white, MAX_WRONG_FRAME + 0.1)]
    if not len(outlines):
        return []
    white, contrast = _white_cells(image, outlines, cells, SAMPLES)
    flat = codes[..., 1:-1, 1:-1].reshape(-1, (cells - 2) ** 2)
    out = []
    for k in np.flatnonzero((contrast > MIN_CONTRAST) & _framed(white, MAX_WRONG_FRAME)).tolist():
        wrong = (flat != white[k, 2:-2, 2:-2].ravel()).mean(axis=1)
        best = int(np.argmin(wrong))
        if wrong[best] <= MAX_WRONG_BITS and (wrong <= wrong[best]).sum() == 1:
            inner, outer = _wrong_frame(white[k : k + 1])
            match = 3.0 - float(wrong[best]) - float(inner[0]) - float(outer[0])
            out.append((best // 4, match, np.roll(outlines[k], -(best % 4), axis=0)))
    return out


def _wrong_frame(white: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Shares (n,) of the border that are white, and of the quiet zone that are not."""
    n = white.shape[-1]
    depth = np.minimum(*np.meshgrid(*[np.minimum(np.arange(n), np.arange(n)[::-1])] * 2))
    return white[:, depth == 1].mean(axis=1), 1.0 - white[:, depth == 0].mean(axis=1)


def _framed(white: BoolArray, most: float) -> BoolArray:
    inner, outer = _wrong_frame(white)
    return (inner <= most) & (outer <= most)


def _white_cells(image: Image, outlines: FloatArray, cells: int, samples: int) -> tuple[BoolArray, FloatArray]:
    """Which cells (n, cells + 2, cells + 2) are white, and the contrast (n,); ``samples`` x ``samples`` pixels each.

    The outermost are the quiet zone about the outlines (n, 4, 2), close to them.
    """
    centre = np.concatenate([[-0.4], np.arange(cells) + 0.5, [cells + 0.4]])
    at = (centre[:, None] + (np.arange(samples) + 0.5) / samples - 0.5).ravel() / cells
    u, v = np.meshgrid(at, at)
    # The homography of the unit square (Heckbert, Fundamentals of Texture Mapping, 1989).
    p0, p1, p2, p3 = (outlines[:, i, :, None, None] for i in range(4))
    d1, d2, sums = p1 - p2, p3 - p2, p0 - p1 + p2 - p3
    det = d1[:, 0] * d2[:, 1] - d2[:, 0] * d1[:, 1]
    g = ((sums[:, 0] * d2[:, 1] - d2[:, 0] * sums[:, 1]) / det)[:, None]
    h = ((d1[:, 0] * sums[:, 1] - sums[:, 0] * d1[:, 1]) / det)[:, None]
    px = ((p1 - p0 + g * p1) * u + (p3 - p0 + h * p3) * v + p0) / np.maximum(g * u + h * v + 1.0, 1e-3)
    level = _level(image, np.moveaxis(px, 1, -1)).reshape(-1, cells + 2, samples, cells + 2, samples)
    level = np.median(level, axis=(2, 4))
    inside = level[:, 1:-1, 1:-1]
    border = np.ones((cells, cells), dtype=bool)
    border[1:-1, 1:-1] = False
    dark, light = np.median(inside[:, border], axis=1), np.quantile(inside[:, ~border], 0.9, axis=1)
    return level > (0.5 * (dark + light))[:, None, None], light - dark
