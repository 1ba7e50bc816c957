"""Camera images of flat printed things: perspective, distortion, blur, fall-off of light and sensor noise.

Each sheet is ray cast. Rays through the corners of the pixels are intersected with the sheet; a pixel whose four
corners see one colour has that colour, all others are integrated over 64 samples of a low-discrepancy pattern that is
shifted from pixel to pixel, so that an edge has no preferred sub-pixel position. Pixel centres have integer
coordinates, as in OpenCV. Nothing here is shared with the detectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from fgreg.geometry.transforms import FloatArray
from fgreg.model.camera_model import CameraModel
from fgreg.simulation.disturbances import SpoiltView
from fgreg.simulation.lens import project_points, undistorted_rays
from fgreg.simulation.surfaces import Background, Sheet, Surface
from fgreg.simulation.textures import BLACK, WHITE, Float32Array

UInt8Image = npt.NDArray[np.uint8]

COARSE_PX = 16
"""Grid on which light and background, both smooth, are evaluated."""


@dataclass(frozen=True, slots=True)
class Optics:
    """Light, lens and sensor.

    Attributes:
        blur_px: standard deviation of the Gaussian point spread.
        white_level: grey level of white paper that faces the camera on its axis at ``reference_mm``.
        distance_exponent: the light falls with distance to this power (2: point source, no automatic gain).
        vignetting: share of the light lost in the corners of the image.
        read_noise, shot_noise: sensor noise of variance ``read_noise**2 + shot_noise * level`` (grey levels).
        samples: per pixel that sees an edge.
    """

    blur_px: float = 0.8
    white_level: float = 170.0
    reference_mm: float = 110.0
    distance_exponent: float = 1.0
    vignetting: float = 0.35
    read_noise: float = 0.6
    shot_noise: float = 0.005
    samples: int = 64


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """Undistorted rays (x, y, 1): at pixel corners (h + 1, w + 1), on the coarse grid, and how to interpolate that."""

    corner_x: Float32Array
    corner_y: Float32Array
    coarse: FloatArray
    rows_from_coarse: Float32Array
    columns_from_coarse: Float32Array
    vignette: FloatArray = field(repr=False)


def render_frame(
    camera: CameraModel,
    surfaces: Sequence[Surface],
    rng: np.random.Generator,
    optics: Optics | None = None,
    background: Background | None = None,
    spoilt: SpoiltView | None = None,
) -> UInt8Image:
    """One 8-bit grey image, (h, w).

    Args:
        camera: the lens and image size.
        surfaces: in this camera's own frame; nearer ones (by distance of their centres) hide farther ones.
        rng: for the sensor noise.
        optics: light, lens and sensor.
        background: behind all surfaces; black where absent.
        spoilt: what spoils this picture.
    """
    optics = optics or Optics()
    rays = _rays(camera.image_size, camera.matrix.tobytes(), camera.distortion.tobytes(), camera.fisheye)
    width, height = camera.image_size
    image = np.zeros((height, width), dtype=np.float32)
    if background is not None:
        image += _spread(_background_radiance(background, rays, optics), rays, (0, height), (0, width))
    sheets = [surface.sheet() for surface in surfaces]
    sheets.sort(key=_distance, reverse=True)
    for sheet in sheets:
        _paint(image, sheet, camera, rays, optics)
    if spoilt is not None:
        image = spoilt.light(image)
    image = _blurred(image, optics.blur_px)
    if spoilt is not None:
        image = spoilt.recorded(image)
    sigma = np.sqrt(np.maximum(image, 0.0) * np.float32(optics.shot_noise) + np.float32(optics.read_noise**2))
    if spoilt is not None:
        sigma *= np.float32(spoilt.what.noise_gain)
    image += sigma * rng.standard_normal(image.shape, dtype=np.float32)
    picture = np.asarray(np.clip(np.rint(image), 0.0, 255.0).astype(np.uint8))
    return picture if spoilt is None else spoilt.compressed(picture)


@lru_cache(maxsize=8)
def _rays(image_size: tuple[int, int], matrix: bytes, distortion: bytes, fisheye: bool) -> _Rays:
    camera = CameraModel(image_size, np.frombuffer(matrix).reshape(3, 3), np.frombuffer(distortion), fisheye)
    width, height = image_size
    columns, rows = np.meshgrid(np.arange(width + 1) - 0.5, np.arange(height + 1) - 0.5)
    x, y = undistorted_rays(camera, columns, rows)
    coarse_columns, columns_from_coarse = _interpolation(width)
    coarse_rows, rows_from_coarse = _interpolation(height)
    grid_columns, grid_rows = np.meshgrid(coarse_columns, coarse_rows)
    cx, cy = undistorted_rays(camera, grid_columns, grid_rows)
    half = np.array([width, height]) / 2.0
    radius2 = ((grid_columns - half[0]) ** 2 + (grid_rows - half[1]) ** 2) / float(half @ half)
    return _Rays(
        x.astype(np.float32),
        y.astype(np.float32),
        np.stack([cx, cy, np.ones_like(cx)], axis=-1),
        rows_from_coarse,
        columns_from_coarse,
        radius2,
    )


def _interpolation(pixels: int) -> tuple[FloatArray, Float32Array]:
    """Coarse positions that span 0 to pixels - 1, and the (pixels, positions) matrix of linear interpolation."""
    count = max(2, -(-pixels // COARSE_PX) + 1)
    positions = np.linspace(0.0, pixels - 1.0, count)
    at = np.arange(pixels) * ((count - 1) / (pixels - 1.0))
    left = np.minimum(at.astype(int), count - 2)
    weights = np.zeros((pixels, count), dtype=np.float32)
    weights[np.arange(pixels), left] = 1.0 - (at - left)
    weights[np.arange(pixels), left + 1] = at - left
    return positions, weights


def _spread(coarse: FloatArray, rays: _Rays, rows: tuple[int, int], columns: tuple[int, int]) -> Float32Array:
    """Bilinear interpolation of values on the coarse grid to a block of pixels."""
    left = rays.rows_from_coarse[rows[0] : rows[1]] @ coarse.astype(np.float32)
    return np.asarray(left @ rays.columns_from_coarse[columns[0] : columns[1]].T)


def _light(camera_T_surface: FloatArray, rays: _Rays, optics: Optics) -> tuple[FloatArray, FloatArray]:
    """Grey level of white on the plane for each coarse ray, and the distance along the ray (in units of z = 1)."""
    normal = camera_T_surface[:3, 2]
    offset = float(normal @ camera_T_surface[:3, 3])
    along = rays.coarse @ normal * (1.0 if offset >= 0 else -1.0)
    depth = abs(offset) / np.maximum(along, 1e-3)
    length = np.linalg.norm(rays.coarse, axis=-1)
    distance = np.clip(depth * length, 0.25 * optics.reference_mm, 8.0 * optics.reference_mm)
    incidence = np.clip(along / length, 0.0, 1.0)
    level = (
        optics.white_level
        * (optics.reference_mm / distance) ** optics.distance_exponent
        * (0.3 + 0.7 * incidence)
        * (1.0 - optics.vignetting * rays.vignette)
    )
    return level, depth


def _background_radiance(background: Background, rays: _Rays, optics: Optics) -> FloatArray:
    level, depth = _light(background.camera_T_background, rays, optics)
    camera_R_plane = background.camera_T_background[:3, :3]
    camera_p = rays.coarse * np.minimum(depth, 1e4)[..., None] - background.camera_T_background[:3, 3]
    plane_p = camera_p @ camera_R_plane
    return level * background.albedo_at(plane_p[..., 0], plane_p[..., 1])


def _outline_in_camera(sheet: Sheet) -> FloatArray:
    """(4, 3) corners of the sheet in the camera frame."""
    surface_p = np.column_stack([sheet.outline_mm, np.zeros(4)])
    return np.asarray(surface_p @ sheet.camera_T_surface[:3, :3].T + sheet.camera_T_surface[:3, 3])


def _distance(sheet: Sheet) -> float:
    return float(np.linalg.norm(_outline_in_camera(sheet).mean(axis=0))) + sheet.depth_bias_mm


def _region(sheet: Sheet, camera: CameraModel, rays: _Rays) -> tuple[int, int, int, int] | None:
    """Pixels (row0, row1, column0, column1) that may see the sheet; None where none can."""
    corners = _outline_in_camera(sheet)
    width, height = camera.image_size
    if (corners[:, 2] <= 1.0).all():
        return None
    edge = np.concatenate([np.linspace(corners[i], corners[(i + 1) % 4], 12) for i in range(4)])
    limit = 1.5 * float(np.linalg.norm(rays.coarse[..., :2], axis=-1).max())
    if (edge[:, 2] <= 1.0).any() or (np.linalg.norm(edge[:, :2], axis=1) > limit * edge[:, 2]).any():
        return 0, height, 0, width  # beyond where the distortion polynomial can be trusted
    pixels = project_points(camera, edge)
    column0, row0 = np.floor(pixels.min(axis=0)).astype(int) - 2
    column1, row1 = np.ceil(pixels.max(axis=0)).astype(int) + 3
    column0, row0, column1, row1 = max(column0, 0), max(row0, 0), min(column1, width), min(row1, height)
    return (row0, row1, column0, column1) if row0 < row1 and column0 < column1 else None


@lru_cache(maxsize=4)
def _sample_offsets(samples: int) -> Float32Array:
    """(samples, 2) Hammersley points in the unit square."""
    index = np.arange(samples)
    reversed_bits = np.zeros(samples)
    scale = 0.5
    rest = index.copy()
    while rest.any():
        reversed_bits += scale * (rest & 1)
        rest >>= 1
        scale /= 2.0
    return np.column_stack([(index + 0.5) / samples, reversed_bits]).astype(np.float32)


def _paint(image: Float32Array, sheet: Sheet, camera: CameraModel, rays: _Rays, optics: Optics) -> None:
    """Draws one sheet over what is there, in place."""
    region = _region(sheet, camera, rays)
    if region is None:
        return
    row0, row1, column0, column1 = region
    x = rays.corner_x[row0 : row1 + 1, column0 : column1 + 1]
    y = rays.corner_y[row0 : row1 + 1, column0 : column1 + 1]
    u, v = _texture_coordinates(sheet, x, y)
    if sheet.faces_camera:
        labels = sheet.texture.labels(u, v)
        albedo = np.array(sheet.albedo, dtype=np.float32)
    else:
        labels = np.minimum(sheet.texture.labels(u, v), BLACK)
        albedo = np.array([0.0, 0.3, 0.3], dtype=np.float32)  # the unprinted back
    first = labels[:-1, :-1]
    mixed = (labels[:-1, 1:] != first) | (labels[1:, :-1] != first) | (labels[1:, 1:] != first)
    colour = albedo.take(first)
    cover = (first != 0).astype(np.float32)
    mixed_rows, mixed_columns = np.nonzero(mixed)
    for start in range(0, mixed_rows.size, 16384):
        rows, columns = mixed_rows[start : start + 16384], mixed_columns[start : start + 16384]
        colour[rows, columns], cover[rows, columns] = _integrate(
            sheet, albedo, u, v, rows, columns, (row0, column0), optics.samples
        )
    level, _ = _light(sheet.camera_T_surface, rays, optics)
    colour *= _spread(level, rays, (row0, row1), (column0, column1))
    block = image[row0:row1, column0:column1]
    block *= 1.0 - cover
    block += colour


def _texture_coordinates(sheet: Sheet, x: Float32Array, y: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Texture (u, v) where rays (x, y, 1) meet the plane; far outside the sheet where they do not."""
    rotation, t = sheet.camera_T_surface[:3, :3], sheet.camera_T_surface[:3, 3]
    normal = rotation[:, 2]
    offset = float(normal @ t)
    # The ray s d meets the plane at s = offset / (n.d); there surface x = r1.(s d - t), likewise y.
    tangents = rotation[:, :2].T
    homography = np.vstack([offset * tangents - np.outer(tangents @ t, normal), normal])
    homography[:2] = sheet.texture_from_surface @ homography
    homography *= 1.0 if offset >= 0 else -1.0
    h = homography.astype(np.float32)
    w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
    np.divide(np.float32(1.0), w, out=w, where=w > 1e-9)
    behind = w <= 1e-9
    u = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) * w
    v = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) * w
    if behind.any():
        u[behind] = v[behind] = -1e6
    return u, v


def _integrate(
    sheet: Sheet,
    albedo: Float32Array,
    u: Float32Array,
    v: Float32Array,
    rows: npt.NDArray[np.intp],
    columns: npt.NDArray[np.intp],
    origin: tuple[int, int],
    samples: int,
) -> tuple[Float32Array, Float32Array]:
    """Mean colour and cover of pixels: texture coordinates are linear over one pixel to 1e-3 of its size."""
    u00, u01, u10, u11 = u[rows, columns], u[rows, columns + 1], u[rows + 1, columns], u[rows + 1, columns + 1]
    v00, v01, v10, v11 = v[rows, columns], v[rows, columns + 1], v[rows + 1, columns], v[rows + 1, columns + 1]
    # Shifts from a low-discrepancy lattice over the pixels of the whole image.
    absolute = (rows + origin[0]) * 0.5698402909980532 + (columns + origin[1]) * 0.7548776662466927
    shift_a = np.mod(absolute, 1.0).astype(np.float32)
    shift_b = np.mod(absolute * 1.618033988749895 + 0.37 * rows, 1.0).astype(np.float32)
    offsets = _sample_offsets(samples)
    a = offsets[:, 0] + shift_a[:, None]
    b = offsets[:, 1] + shift_b[:, None]
    a -= a >= 1.0
    b -= b >= 1.0
    us = u00[:, None] + a * (u01 - u00)[:, None] + b * ((u10 - u00)[:, None] + a * (u11 - u10 - u01 + u00)[:, None])
    vs = v00[:, None] + a * (v01 - v00)[:, None] + b * ((v10 - v00)[:, None] + a * (v11 - v10 - v01 + v00)[:, None])
    labels = sheet.texture.labels(us, vs)
    if not sheet.faces_camera:
        labels = np.minimum(labels, BLACK)
    black = (labels == BLACK).sum(axis=1, dtype=np.float32) / np.float32(samples)
    white = (labels == WHITE).sum(axis=1, dtype=np.float32) / np.float32(samples)
    return black * albedo[BLACK] + white * albedo[WHITE], black + white


def _blurred(image: Float32Array, sigma_px: float) -> Float32Array:
    """Separable Gaussian, edges repeated."""
    if sigma_px <= 0.0:
        return image
    radius = int(np.ceil(3.5 * sigma_px))
    taps = np.exp(-0.5 * (np.arange(radius + 1) / sigma_px) ** 2)
    taps = (taps / (taps[0] + 2.0 * taps[1:].sum())).astype(np.float32)
    for axis in (0, 1):
        padded = np.pad(image, [(radius, radius) if a == axis else (0, 0) for a in (0, 1)], mode="edge")
        length = image.shape[axis]
        image = taps[0] * _slice(padded, radius, length, axis)
        for k in range(1, radius + 1):
            both = _slice(padded, radius - k, length, axis) + _slice(padded, radius + k, length, axis)
            both *= taps[k]
            image += both
    return image


def _slice(array: Float32Array, start: int, length: int, axis: int) -> Float32Array:
    return array[start : start + length] if axis == 0 else array[:, start : start + length]
