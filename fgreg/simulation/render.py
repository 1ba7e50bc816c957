"""Camera images of flat printed things: perspective, distortion, blur, fall-off of light, motion and sensor noise.

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
from fgreg.simulation.blood import transmission
from fgreg.simulation.disturbances import Disturbances, SpoiltView, compressed, video_levels
from fgreg.simulation.highlights import Wetness, highlights
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
        colour: pictures are blue, green and red: of tissue as the blood in it has it, all else is grey.
    """

    blur_px: float = 0.8
    white_level: float = 170.0
    reference_mm: float = 110.0
    distance_exponent: float = 1.0
    vignetting: float = 0.35
    read_noise: float = 0.6
    shot_noise: float = 0.005
    samples: int = 64
    colour: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """A time in which light falls on some lines of the sensor.

    Attributes:
        moves: (4, 4) each, motion of what is held in a hand, in this camera's frame, at times that are even in it; none
            where it is still.
        spoilt: what spoils the light.
        lines: rows of the image.
    """

    moves: tuple[FloatArray, ...] = ()
    spoilt: SpoiltView | None = None
    lines: slice = field(default_factory=lambda: slice(None))


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """Undistorted rays (x, y, 1): at pixel corners (h + 1, w + 1), on the coarse grid, and how to interpolate that."""

    corner_x: Float32Array
    corner_y: Float32Array
    coarse: FloatArray
    rows_from_coarse: Float32Array
    columns_from_coarse: Float32Array
    vignette: FloatArray = field(repr=False)

    def centres(self, rows: tuple[int, int], columns: tuple[int, int]) -> tuple[Float32Array, Float32Array]:
        """x and y of rays through the middle of a block's pixels."""
        block = slice(rows[0], rows[1] + 1), slice(columns[0], columns[1] + 1)
        x, y = self.corner_x[block], self.corner_y[block]
        return tuple(0.25 * (c[:-1, :-1] + c[1:, :-1] + c[:-1, 1:] + c[1:, 1:]) for c in (x, y))  # type: ignore[return-value]


def render_frame(
    camera: CameraModel,
    surfaces: Sequence[Surface],
    rng: np.random.Generator,
    optics: Optics | None = None,
    background: Background | None = None,
    *,
    held: Sequence[Surface] = (),
    exposures: Sequence[Exposure] = (Exposure(),),
    disturbances: Disturbances | None = None,
    wet: Wetness | None = None,
) -> UInt8Image:
    """One 8-bit image, (h, w) grey or (h, w, 3) blue, green and red.

    Args:
        camera: the lens and image size.
        surfaces: in this camera's own frame; nearer ones (by distance of their centres) hide farther ones.
        rng: for the sensor noise.
        optics: light, lens and sensor.
        background: behind all surfaces; black where absent.
        held: surfaces held in a hand, which moves; while it does they are before all others.
        exposures: all lines belong to one of them.
        disturbances: of sensor and video.
        wet: where absent nothing mirrors.
    """
    optics, disturbances = optics or Optics(), disturbances or Disturbances()
    rays = _rays(camera.image_size, camera.matrix.tobytes(), camera.distortion.tobytes(), camera.fisheye)
    width, height = camera.image_size
    moving = any(exposure.moves for exposure in exposures)
    canvas = _Canvas.blank(height, width, 3 if optics.colour else 1)
    if background is not None:
        _paint_background(canvas, background, rays, optics, wet)
    _paint_all(canvas, [*surfaces, *(() if moving else held)], camera, rays, optics, wet)
    planes = [np.empty((height, width), dtype=np.float32) for _ in canvas.planes]
    for exposure in exposures:
        seen = [canvas] if not moving else [canvas.copy() for _ in exposure.moves]
        for one, move in zip(seen, exposure.moves, strict=False):
            _paint_all(one, [surface.seen_from(move) for surface in held], camera, rays, optics, wet)
        light = [
            np.asarray(sum(parts) / np.float32(len(seen))) for parts in zip(*(s.planes for s in seen), strict=True)
        ]
        if exposure.spoilt is not None:
            light = exposure.spoilt.light(light, seen[len(seen) // 2].distance_mm)
        for plane, part in zip(planes, light, strict=True):
            plane[exposure.lines] = _blurred(part, optics.blur_px)[exposure.lines]
    recorded = planes if not disturbances.deinterlace else [plane[::2] for plane in planes]
    picture = np.stack([_sensed(plane, rng, optics, disturbances) for plane in recorded], axis=-1)
    return compressed(picture if optics.colour else np.ascontiguousarray(picture[..., 0]), disturbances)


def _sensed(light: Float32Array, rng: np.random.Generator, optics: Optics, what: Disturbances) -> UInt8Image:
    """What the sensor makes of light (h, w), in 8 bits."""
    level = light if what.exposure == 1.0 else light * np.float32(what.exposure)
    sigma = np.sqrt(np.maximum(level, 0.0) * np.float32(optics.shot_noise) + np.float32(optics.read_noise**2))
    level = level + np.float32(what.noise_gain) * sigma * rng.standard_normal(level.shape, dtype=np.float32)
    if what.video_curve:
        level = video_levels(level)
    return np.asarray(np.clip(np.rint(level), 0.0, 255.0).astype(np.uint8))


@dataclass(frozen=True, slots=True, eq=False)
class _Canvas:
    """Light, (h, w) each plane, and the distance (h, w) mm of what is seen."""

    planes: list[Float32Array]
    distance_mm: Float32Array

    @staticmethod
    def blank(height: int, width: int, colours: int) -> _Canvas:
        empty = [np.zeros((height, width), dtype=np.float32) for _ in range(colours + 1)]
        return _Canvas(empty[1:], empty[0])

    def copy(self) -> _Canvas:
        return _Canvas([plane.copy() for plane in self.planes], self.distance_mm.copy())


def _paint_background(
    canvas: _Canvas, background: Background, rays: _Rays, optics: Optics, wet: Wetness | None
) -> None:
    height, width = canvas.distance_mm.shape
    level, distance, plane_p = _background(background, rays, optics)
    radiance = level * background.albedo_at(plane_p[..., 0], plane_p[..., 1])
    whole = (0, height), (0, width)
    canvas.distance_mm[:] = _spread(distance, rays, *whole)
    tissue = optics.colour and background.blood_mm > 0.0
    films = transmission(background.film_mm_at(plane_p[..., 0], plane_p[..., 1]), 3) if tissue else None
    for number, plane in enumerate(canvas.planes):
        plane += _spread(radiance if films is None else background.pale * radiance * films[number], rays, *whole)
    if wet is not None and background.slope > 0.0:
        x, y = rays.centres(*whole)
        shine = highlights(background.camera_T_background, x, y, background.slope, wet) * _spread(level, rays, *whole)
        for plane in canvas.planes:
            plane += shine


def _paint_all(
    canvas: _Canvas,
    surfaces: Sequence[Surface],
    camera: CameraModel,
    rays: _Rays,
    optics: Optics,
    wet: Wetness | None,
) -> None:
    """Draws surfaces over what is there, in place, the farthest first."""
    for sheet in sorted((surface.sheet() for surface in surfaces), key=_distance, reverse=True):
        _paint(canvas, sheet, camera, rays, optics, wet)


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
    """Grey level of white on the plane for each coarse ray, and the depth there."""
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


def _background(background: Background, rays: _Rays, optics: Optics) -> tuple[FloatArray, FloatArray, FloatArray]:
    """For each coarse ray: level of white, distance, and the point (..., 3) of the background's plane."""
    level, depth = _light(background.camera_T_background, rays, optics)
    camera_p = rays.coarse * np.minimum(depth, 1e4)[..., None]
    camera_R_plane = background.camera_T_background[:3, :3]
    plane_p = (camera_p - background.camera_T_background[:3, 3]) @ camera_R_plane
    return level, np.linalg.norm(camera_p, axis=-1), plane_p


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


def _paint(
    canvas: _Canvas, sheet: Sheet, camera: CameraModel, rays: _Rays, optics: Optics, wet: Wetness | None
) -> None:
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
    level, depth = _light(sheet.camera_T_surface, rays, optics)
    white = _spread(level, rays, (row0, row1), (column0, column1))
    colour *= white
    if wet is not None and sheet.slope > 0.0:
        at = rays.centres((row0, row1), (column0, column1))
        colour += cover * white * highlights(sheet.camera_T_surface, *at, sheet.slope, wet)
    for plane in canvas.planes:
        block = plane[row0:row1, column0:column1]
        block *= 1.0 - cover
        block += colour
    away = depth * np.linalg.norm(rays.coarse, axis=-1)
    block = canvas.distance_mm[row0:row1, column0:column1]
    np.copyto(block, _spread(away, rays, (row0, row1), (column0, column1)), where=cover > 0.5)


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
