"""The pixels of an image about straight edges, as the fit of a blurred step needs them (edges.py)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fgreg.geometry.transforms import BoolArray, FloatArray
from fgreg.model.camera_model import CameraModel
from fgreg.model.lens import distort_jacobian, focal_px, pixels_from_ideal

Image = npt.NDArray[np.uint8]
GreyImage = npt.NDArray[np.uint8] | npt.NDArray[np.float32]
"""Grey levels from 0 to 255, with fractions where the picture has more than 8 bits."""

CURVE_NODES = 17


@dataclass(frozen=True, slots=True, eq=False)
class EdgePixels:
    """p pixels for each of n edges, all (n, p): distance d, position u, grey level, whether it is used, and whether its
    line is odd."""

    d: FloatArray
    u: FloatArray
    grey: FloatArray
    used: BoolArray
    odd: BoolArray


def segment_frames(start: FloatArray, end: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """(middle, direction, normal, half length) of segments (n, 2) -> (n, 2).

    The normal points to the left of the direction as drawn (y down), which is outside a tag whose corners run
    clockwise as seen.
    """
    half = 0.5 * (end - start)
    length = np.linalg.norm(half, axis=-1)
    direction = half / length[..., None]
    normal = np.stack([direction[..., 1], -direction[..., 0]], axis=-1)
    return 0.5 * (start + end), direction, normal, length


def edge_pixels(
    camera: CameraModel,
    image: GreyImage,
    start: FloatArray,
    end: FloatArray,
    half_width: FloatArray,
    trim: FloatArray,
    rows: int,
) -> EdgePixels:
    """Gather pixels: one row per pixel step along the edge's major axis, and across it the pixels within half_width."""
    middle, direction, normal, half_length = segment_frames(start, end)
    n = len(start)
    # The ideal segment, trimmed at its ends, in distorted pixels.
    s_nodes = np.linspace(-1.0, 1.0, CURVE_NODES) * (half_length - trim)[:, None]
    nodes = pixels_from_ideal(camera, middle[:, None] + s_nodes[..., None] * direction[:, None])
    chord = np.abs(nodes[:, -1] - nodes[:, 0])
    major = (chord[:, 1] > chord[:, 0]).astype(np.intp)
    along_nodes = np.take_along_axis(nodes, major[:, None, None], axis=2)[..., 0]
    count = min(rows, int(chord.max()) + 1)
    steps = np.linspace(0.0, 1.0, count)
    along = np.rint(along_nodes[:, :1] + steps * (along_nodes[:, -1:] - along_nodes[:, :1]))
    fresh = np.ones(along.shape, dtype=bool)
    fresh[:, 1:] = along[:, 1:] != along[:, :-1]
    s = np.empty(along.shape)
    for k in range(n):
        forward = along_nodes[k, -1] > along_nodes[k, 0]
        order = slice(None) if forward else slice(None, None, -1)
        s[k] = np.interp(along[k], along_nodes[k, order], s_nodes[k, order])
    ideal = middle[:, None] + s[..., None] * direction[:, None]
    centre = pixels_from_ideal(camera, ideal)
    # Across: pixels along the minor axis; a slanted edge needs up to sqrt(2) more of them.
    reach = int(np.ceil(half_width.max() * np.sqrt(2.0))) + 1
    offsets = np.arange(-reach, reach + 1)
    nearest = np.rint(centre)
    # Ideal distance of a pixel to first order about its row's centre: the band is narrow.
    f = focal_px(camera)
    inverse_jacobian = np.linalg.inv(f[:, None] * distort_jacobian(camera, ideal / f) / f)
    height, width = image.shape
    parts = []
    for k in range(n):  # one edge at a time: its arrays stay in the cache
        minor, other = 1 - major[k], major[k]
        across = nearest[k, :, minor, None] + offsets
        off = across - centre[k, :, minor, None]
        beside = (nearest[k, :, other] - centre[k, :, other])[:, None]
        by_normal = normal[k] @ inverse_jacobian[k]
        d = by_normal[:, minor, None] * off + by_normal[:, other, None] * beside
        limits = (width, height)
        inside = (across >= 0) & (across < limits[minor])
        inside &= ((nearest[k, :, other] >= 0) & (nearest[k, :, other] < limits[other]) & fresh[k])[:, None]
        row, column = np.nonzero(inside & (np.abs(d) <= half_width[k]))
        by_direction = direction[k] @ inverse_jacobian[k]
        u = by_direction[row, minor] * off[row, column] + by_direction[row, other] * beside[row, 0]
        at = across[row, column].astype(np.intp), nearest[k, row, other].astype(np.intp)
        iy, ix = at if minor == 1 else at[::-1]
        parts.append((d[row, column], (s[k, row] + u) / half_length[k], image[iy, ix], iy % 2 == 1))
    return _joined(parts)


def _joined(parts: list[tuple[FloatArray, FloatArray, GreyImage, BoolArray]]) -> EdgePixels:
    """The pixels (d, u, grey, odd) of each edge as rows of one array, padded to the longest row."""
    shape = len(parts), max(1, *(len(part[0]) for part in parts)) if parts else 1
    no = np.zeros(shape, dtype=bool)
    band = EdgePixels(np.zeros(shape), np.zeros(shape), np.zeros(shape), no, no.copy())
    for k, (d, u, grey, odd) in enumerate(parts):
        count = len(d)
        band.d[k, :count], band.u[k, :count], band.grey[k, :count], band.used[k, :count] = d, u, grey, True
        band.odd[k, :count] = odd
    return band
