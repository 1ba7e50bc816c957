"""The pixels of an image about straight edges, as the fit of a blurred step needs them (edges.py)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.geometry.transforms import BoolArray, FloatArray
from fgreg.model.camera_model import CameraModel
from fgreg.model.lens import ideal_by_pixel_jacobian, pixels_from_ideal

Image = npt.NDArray[np.uint8]
GreyImage = npt.NDArray[np.uint8] | npt.NDArray[np.float32]
"""Grey levels from 0 to 255, with fractions where the picture has more than 8 bits."""

PixelArray = npt.NDArray[np.floating[Any]]
"""Of single precision, but for tests of the model."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgePixels:
    """p pixels for each of n edges, all (n, p): distance d, position u, grey level, whether it is used, and whether its
    line is odd."""

    d: PixelArray
    u: PixelArray
    grey: PixelArray
    used: BoolArray
    odd: BoolArray

    def some(self, one_in: int) -> EdgePixels:
        """Every so many-th pixel."""
        pixels = slice(None, None, one_in)
        return EdgePixels(
            self.d[:, pixels], self.u[:, pixels], self.grey[:, pixels], self.used[:, pixels], self.odd[:, pixels]
        )


def segment_frames(start: FloatArray, end: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """(middle, direction, normal, half length) of segments (n, 2) -> (n, 2).

    The normal points to the left of the direction as drawn (y down), which is outside a tag whose corners run
    clockwise as seen.
    """
    half = 0.5 * (end - start)
    length = np.sqrt(np.vecdot(half, half))
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
    """Gather pixels: lines of the image that cross an edge, at most so many rows, and in each those within half_width.

    The lines are multiples of a step in the whole image, in quarters: a start a little off gives the same pixels.
    """
    middle, direction, normal, half_length = segment_frames(start, end)
    edge, inner = np.arange(len(start)), (half_length - trim)[:, None]
    # The ideal segment, trimmed at its ends, in pixels: its ends and its middle.
    nodes = pixels_from_ideal(
        camera, middle[:, None] + (np.array([-1.0, 0.0, 1.0]) * inner)[..., None] * direction[:, None]
    )
    chord = np.abs(nodes[:, 2] - nodes[:, 0])
    major = (chord[:, 1] > chord[:, 0]).astype(np.intp)
    minor = 1 - major
    begin, half_way, finish = nodes[edge, :, major].T[..., None]
    low, high = np.minimum(begin, finish), np.maximum(begin, finish)
    quarters = np.maximum(np.ceil(4.0 * (high - low) / rows), 4.0)
    step = 0.25 * np.where(quarters % 8.0 == 0.0, quarters + 1.0, quarters)  # odd and even lines
    first = np.ceil(low / step)
    line = np.floor((first + np.arange(max(1, int(((high - low) / step).max()) + 1))) * step)
    crossing = line <= high
    line = np.minimum(line, np.floor(high))
    # Where a line crosses, by the parabola through the three: to a fraction of a pixel, and the rest to first order.
    s = (
        inner
        * (line - half_way)
        * (
            (line - begin) / ((finish - begin) * (finish - half_way))
            - (line - finish) / ((begin - finish) * (begin - half_way))
        )
    )
    ideal = middle[:, None] + s[..., None] * direction[:, None]
    centre = pixels_from_ideal(camera, ideal)
    nearest = np.rint(centre)
    nearest[edge, :, major] = line
    beside = nearest - centre
    pixel = nearest.astype(np.intp)
    # Across: pixels along the minor axis, as many as the most slanted edge needs.
    slant = chord[edge, minor] / np.maximum(chord[edge, major], 1e-9)
    reach = int(1.05 * float((half_width * np.hypot(1.0, slant)).max()) + 0.5)
    offsets = np.arange(-reach, reach + 1)
    # Ideal place of a pixel to first order about its row's point: the band is narrow.
    axes = np.stack([normal, direction / half_length[:, None]], axis=1)  # of d and u
    by_pixel = axes[:, None] @ ideal_by_pixel_jacobian(camera, ideal)
    rest = by_pixel[edge, :, :, major] * beside[edge, :, major, None]
    rest[..., 1] += s / half_length[:, None]
    off = (beside[edge, :, minor, None] + offsets).astype(np.float32)
    d, u = (
        off * by_pixel[edge, :, axis, minor, None].astype(np.float32) + rest[..., axis, None].astype(np.float32)
        for axis in range(2)
    )
    limits, steps = np.array(image.shape[::-1]), np.array([1, image.shape[1]])
    lines, across = pixel[edge, :, major], pixel[edge, :, minor]
    used = np.abs(d) <= half_width.astype(np.float32)[:, None, None]
    used &= (crossing & (lines >= 0) & (lines < limits[major, None]))[..., None]
    if across.min() < reach or (across.max(axis=1) >= limits[minor] - reach).any():
        at = across[..., None] + offsets
        used &= (at >= 0) & (at < limits[minor, None, None])
    at = (across * steps[minor, None] + lines * steps[major, None])[..., None] + offsets * steps[minor, None, None]
    grey = np.take(image, at, mode="clip").astype(np.float32)
    odd = (pixel[..., 1:] + offsets * minor[:, None, None]) & 1 == 1
    n = len(start)
    return EdgePixels(d.reshape(n, -1), u.reshape(n, -1), grey.reshape(n, -1), used.reshape(n, -1), odd.reshape(n, -1))
