"""Corners of printed squares with their covariance, from the straight edges of the squares.

OpenCV's sub-pixel refinement moves the corner of a black square inwards by a few hundredths of a pixel in a blurred
image (+0.1 to 0.2 mm of depth for a 30 mm tag), because one quadrant is black and three are white. Intersections
of lines fitted to the four edges have no such bias: see edges.py. Two corners that share an edge also share its
error, so the covariance is kept per square, (8, 8), not per corner.

Where an edge is too short or too faint, its corners fall back to sub-pixel refinement with a larger sigma. Where one
side of a corner is hidden, the corner is a point of the other side with a sigma along that side that says nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from fgreg.detection.edge_pixels import GreyImage, Image, segment_frames
from fgreg.detection.edges import EdgeStart, fit_edges
from fgreg.detection.frame_files import white_level
from fgreg.detection.step_fit import MIN_CONTRAST
from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray
from fgreg.model.camera_model import CameraModel
from fgreg.model.lens import ideal_by_pixel_jacobian, ideal_from_pixels, inverse_2x2

CORNER_FLOOR_PX = 0.003
"""Added to the sigma of corners from edges: independent errors that remain after averaging along an edge."""
FALLBACK_SIGMA_PX = 0.3
"""Sigma of a corner from sub-pixel refinement of a small or low-contrast square."""
COMMON_PX, COMMON_FALLBACK_PX = 0.002, 0.1
"""Sigma of a corner error that is the same in both views and so does not show in the residuals (pixel grid, print).
The value for corners from edges holds for edges of COMMON_LENGTH_PX and a blur of 1 px; see _with_common."""
COMMON_LENGTH_PX = 200.0
OUTWARD_PX, OUTWARD_FALLBACK_PX = 0.0015, 0.1
"""Sigma of an outward error common to all corners of all squares (bias of the method). It makes the depth too small.
From edges it is this at a blur of 1 px and grows with the blur's variance: the shape of the blur is known in part."""
BORDER_MARGIN_PX = 7.0
"""Corners nearer to the image's border than this are used only if they come from edges."""
MAX_FALLBACK_EDGE_PX = 60.0
"""Longer edges can always be fitted. If the fit fails, the detector found something other than the outline."""
LOOSE_PX = 20.0
"""Sigma along the other side of a corner of which only one side was found: that side counts, the corner does not."""
MIN_EDGE_PX = 12.0
"""Corners of shorter edges come from sub-pixel refinement."""
NEXT, PREVIOUS = np.array([1, 2, 3, 0]), np.array([3, 0, 1, 2])
"""The corner after and before each corner of a square, and the sides alike: side k runs from corner k to the next."""


@dataclass(frozen=True, slots=True, eq=False)
class SquareCorners:
    """Corners of n squares in one view.

    Attributes:
        ideal_px: (n, 4, 2), order as given.
        covariance: (n, 8, 8) px^2 over (x0, y0, x1, ...), at unit corner noise scale.
        found: (n, 4) which corners may be used.
        from_edges: (n, 4) whether a corner comes from edges (both, or one), else from sub-pixel refinement.
        common_px: (n, 4) sigma of the corner error that is the same in both views.
        outward_px: (n, 4, 2) one sigma of the outward error common to all squares.
        again: (n,) what the fit of the square in the next picture may start with; None where a side was not found.
    """

    ideal_px: FloatArray
    covariance: FloatArray
    found: BoolArray
    from_edges: BoolArray
    common_px: FloatArray
    outward_px: FloatArray
    again: tuple[EdgeStart | None, ...]


def grey(image: npt.NDArray[np.generic]) -> GreyImage:
    """(h, w) of a grey or BGR(A) image of 8 or 16 bits; of 16 bits with all their depth.

    Raises:
        ValueError: not an image of one of these kinds.
    """
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[..., 0]
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] not in (3, 4)) or 0 in image.shape:
        raise ValueError(f"image of shape {image.shape}, expected (h, w), (h, w, 3) or (h, w, 4)")
    if image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"image of type {image.dtype}, expected uint8 or uint16")
    picture: npt.NDArray[Any] = np.ascontiguousarray(image)
    if image.dtype == np.uint16:
        # 10 and 12 bit images are stored in 16 bits.
        scale = np.float32(255.0 / white_level(picture))
        picture = np.minimum(picture.astype(np.float32) * scale, np.float32(255.0))
    if picture.ndim == 3:
        code = cv2.COLOR_BGR2GRAY if picture.shape[2] == 3 else cv2.COLOR_BGRA2GRAY
        picture = np.asarray(cv2.cvtColor(picture, code))
    return picture


def eight_bit(image: GreyImage) -> Image:
    """The image in whole grey levels, for OpenCV's detectors."""
    return np.asarray(image if image.dtype == np.uint8 else np.rint(image), dtype=np.uint8)


def refine_subpixel(image: GreyImage, corners_px: FloatArray, half_window_px: int) -> FloatArray:
    """OpenCV's sub-pixel refinement of corners (n, 2); a corner that left its window keeps its start."""
    height, width = image.shape
    inside = ((corners_px >= 0.0) & (corners_px <= np.array([width, height]) - 1.0)).all(axis=1)
    if not inside.all():
        out = corners_px.copy()
        out[inside] = refine_subpixel(image, corners_px[inside], half_window_px) if inside.any() else out[inside]
        return out
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 40, 0.001)
    start = np.ascontiguousarray(corners_px, dtype=np.float32).reshape(-1, 1, 2)
    window = (half_window_px, half_window_px)
    refined = cv2.cornerSubPix(image, start.copy(), window, (-1, -1), criteria).reshape(-1, 2).astype(np.float64)
    stayed = np.abs(refined - corners_px).max(axis=1) <= half_window_px
    return np.where(stayed[:, None], refined, corners_px)


def square_corners(
    camera: CameraModel,
    image: GreyImage,
    corners_px: FloatArray,
    cells: int,
    *,
    edges: bool = True,
    last: Sequence[EdgeStart | None] = (),
) -> SquareCorners:
    """Refine the outer corners of black squares.

    Args:
        image: (h, w).
        corners_px: (n, 4, 2) from a detector, clockwise as seen.
        cells: squares along the side, border included: the black border is one cell wide.
        edges: False uses sub-pixel refinement only (for comparison).
        last: ``again`` of the same squares in the last picture, where all are known.
    """
    n = len(corners_px)
    height, width = image.shape
    sides = _lengths(corners_px[:, NEXT] - corners_px)
    cell_px = sides.min(axis=1) / cells

    # Fallback: sub-pixel refinement, not reaching past the border's inner edge.
    fallback = np.empty_like(corners_px)
    for k in range(n):
        reach = min(max(int(0.6 * cell_px[k]), 2), 5)
        fallback[k] = refine_subpixel(image, corners_px[k], reach)
    ideal = ideal_from_pixels(camera, fallback)
    # At the image's border sub-pixel refinement lacks pixels, and the corner may be the point where the border cuts
    # the tag. Only corners from edges are used there.
    margin = np.minimum(corners_px, np.array([width, height]) - 1.0 - corners_px).min(axis=2)
    found = np.isfinite(ideal).all(axis=2) & (margin > BORDER_MARGIN_PX)
    from_edges = np.zeros((n, 4), dtype=bool)
    covariance = np.zeros((n, 8, 8))
    covariance[:, np.arange(8), np.arange(8)] = FALLBACK_SIGMA_PX**2

    usable: IntArray = np.flatnonzero(np.isfinite(ideal).all(axis=(1, 2)) & (sides.min(axis=1) >= MIN_EDGE_PX))
    again: list[EdgeStart | None] = [None] * n
    if not edges or usable.size == 0:
        return _with_common(ideal, covariance, found, from_edges, sides, np.ones(n), np.zeros(n), again)

    start = ideal[usable].reshape(-1, 2)
    end = ideal[usable][:, NEXT].reshape(-1, 2)
    known = [known for k in usable.tolist() if last and (known := last[k]) is not None]
    begin = EdgeStart.joined(known) if len(known) == len(usable) else None
    fit = fit_edges(camera, image, start, end, np.repeat(cell_px[usable], 4), begin)
    middle, direction, normal, half = (a.reshape(-1, 4, *a.shape[1:]) for a in segment_frames(start, end))
    line, good = fit.line.reshape(-1, 4, 2), fit.good.reshape(-1, 4)
    line_covariance = fit.covariance.reshape(-1, 4, 2, 2)
    # A sub-pixel corner is used only on small squares whose outline separates dark from light.
    step = (fit.step > MIN_CONTRAST).reshape(-1, 4)
    found[usable] &= step & step[:, PREVIOUS] & (sides[usable].min(axis=1) < MAX_FALLBACK_EDGE_PX)[:, None]
    # A side that was not found is replaced by its starting line with a sigma that says nothing.
    line[~good] = 0.0
    line_covariance[~good] = LOOSE_PX**2 * np.eye(2)
    corner, jacobian = _crossings(line, middle, direction, normal, half)
    off = corner - start.reshape(-1, 4, 2)
    both_found, one_found = good & good[:, PREVIOUS], good.any(axis=1, keepdims=True) & ~found[usable]
    # Where there is none, or it is far off, the comparison is false.
    use = (both_found | one_found) & (np.vecdot(off, off) <= np.square(np.maximum(5.0, 0.8 * cell_px[usable]))[:, None])
    ideal[usable] = np.where(use[..., None], corner, ideal[usable])
    from_edges[usable] = use
    found[usable] |= use
    jacobian = np.where(use[:, :, None, None, None], jacobian, 0.0)
    weighed = jacobian.reshape(-1, 8, 4, 1, 2) @ line_covariance[:, None]
    from_lines = weighed.reshape(-1, 8, 8) @ jacobian.reshape(-1, 8, 8).swapaxes(1, 2)
    sigma = np.where(np.repeat(use, 2, axis=1), CORNER_FLOOR_PX, FALLBACK_SIGMA_PX)
    covariance[usable] = from_lines + np.square(sigma)[..., None] * np.eye(8)
    # A fallback corner's sigma is in image pixels: bring it to ideal ones.
    for k, c in np.argwhere(found & ~from_edges).tolist():
        inverse = ideal_by_pixel_jacobian(camera, ideal[k, c])
        covariance[k, 2 * c : 2 * c + 2, 2 * c : 2 * c + 2] = FALLBACK_SIGMA_PX**2 * inverse @ inverse.T
    blur2 = np.ones(n)
    blur2[usable] = np.square(fit.blur_px).reshape(-1, 4).mean(axis=1)
    by_response = np.zeros(n)
    by_response[usable] = (fit.by_response * fit.good).reshape(-1, 4).max(axis=1)
    for k, its, sides_good in zip(usable.tolist(), fit.again.of_squares(), good, strict=True):
        again[k] = its if sides_good.all() else None
    return _with_common(ideal, covariance, found, from_edges, sides, blur2, by_response, again)


def _lengths(vectors: FloatArray) -> FloatArray:
    """(...,) of (..., 2)."""
    return np.asarray(np.sqrt(np.vecdot(vectors, vectors)))


def _crossings(
    line: FloatArray, middle: FloatArray, direction: FloatArray, normal: FloatArray, half: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Where each side of squares meets the one before it: (k, 4, 2), and its derivatives by the lines, (k, 4, 2, 4, 2).

    Args:
        line: (k, 4, 2) of the sides, as of :class:`fgreg.detection.edges.EdgeFit`.
        middle, direction, normal, half: (k, 4, ...) of the sides, as of :func:`segment_frames`.
    """
    # n' (x - middle) = o + m * d' (x - middle) / half, for both sides
    rows = normal - (line[..., 1] / half)[..., None] * direction
    right = np.vecdot(rows, middle) + line[..., 0]
    inverse = inverse_2x2(np.stack([rows[:, PREVIOUS], rows], axis=2))
    corner = (inverse @ np.stack([right[:, PREVIOUS], right], axis=2)[..., None])[..., 0]
    jacobian, corners = np.zeros((len(line), 4, 2, 4, 2)), np.arange(4)
    for k, side in enumerate((PREVIOUS, corners)):
        place = np.vecdot(direction[:, side], corner - middle[:, side]) / half[:, side]
        jacobian[:, corners, :, side, 0] = inverse[..., k].swapaxes(0, 1)
        jacobian[:, corners, :, side, 1] = (inverse[..., k] * place[..., None]).swapaxes(0, 1)
    return corner, jacobian


def _with_common(
    ideal: FloatArray,
    covariance: FloatArray,
    found: BoolArray,
    from_edges: BoolArray,
    sides_px: FloatArray,
    blur2: FloatArray,
    by_response: FloatArray,
    again: list[EdgeStart | None],
) -> SquareCorners:
    """Add the common errors. They are larger for short edges, which average over fewer pixels.

    ``by_response`` (n,) px: one sigma by which all sides of a square lie outwards; its corners do sqrt(2) times that.
    """
    from_edge = COMMON_PX * np.sqrt(COMMON_LENGTH_PX / np.maximum(sides_px.min(axis=1), 1.0))
    common = np.where(from_edges, (from_edge * np.sqrt(blur2))[:, None], COMMON_FALLBACK_PX)
    arm = ideal - ideal.mean(axis=1, keepdims=True)
    arm /= np.maximum(_lengths(arm), 1e-9)[..., None]
    outward_px = np.hypot(OUTWARD_PX * blur2, np.sqrt(2.0) * by_response)
    outward = arm * np.where(from_edges, outward_px[:, None], OUTWARD_FALLBACK_PX)[..., None]
    return SquareCorners(ideal, covariance, found, from_edges, common, outward, tuple(again))
