"""How far two calibrations of one endoscope lie apart: in mm of what they locate, and in pixels of each picture.

The same pixels are taken by both. A point of the working space is seen by the one calibration and located by the other;
so is a ray of each picture. What a rigid motion of the whole space explains does not count (a registration takes it
up): points and rays are compared after their best rigid fit. Comparing two calibrations pixel by pixel, with such a
motion taken out, is what mrcal calls the projection difference (mrcal documentation, "Differencing").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgreg.calibration import parameters
from fgreg.geometry.transforms import FloatArray, nearest_rotation
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.lens import in_view, normalized_from_pixels, pixels_from_normalized, project

GRID = (15, 9)
"""Places in a picture at which calibrations are compared, across and down."""


@dataclass(frozen=True, slots=True)
class Apart:
    """How far two calibrations lie apart.

    Attributes:
        points_rms_mm, points_most_mm: of located points; NaN with one camera.
        rays_rms_px: of each picture.
    """

    points_rms_mm: float
    points_most_mm: float
    rays_rms_px: tuple[float, ...]


def picture_grid(camera: CameraModel, grid: tuple[int, int] = GRID) -> FloatArray:
    """(n, 2) pixels over the ellipse that fills the picture: an endoscope shows little in the corners."""
    x, y = np.meshgrid(*[(np.arange(count) + 0.5) / count for count in grid])
    share = np.column_stack([x.ravel(), y.ravel()])
    share = share[np.linalg.norm(share - 0.5, axis=1) <= 0.5]
    return np.asarray(share * np.array(camera.image_size, dtype=np.float64) - 0.5)


def compare(
    rig: StereoRig, other: StereoRig, depths_mm: tuple[float, ...], pixels: Sequence[FloatArray] | None = None
) -> Apart:
    """How far ``other`` is from ``rig``, over points that ``rig`` sees at some depths.

    Args:
        pixels: of each camera, (n, 2) at which they are compared; None: over the whole pictures.
    """
    pixels = [picture_grid(camera) for camera in parameters.cameras(rig)] if pixels is None else pixels
    rays = tuple(map(_rays_apart_px, parameters.cameras(rig), parameters.cameras(other), pixels))
    if rig.right is None or rig.right_T_left is None:
        return Apart(np.nan, np.nan, rays)
    normalized = normalized_from_pixels(rig.left, pixels[0])
    normalized = normalized[np.isfinite(normalized).all(axis=1)]
    flat = np.column_stack([normalized, np.ones(len(normalized))])
    points = np.concatenate([flat * depth for depth in depths_mm])
    in_right = points @ rig.right_T_left[:3, :3].T + rig.right_T_left[:3, 3]
    seen = in_view(rig.right, in_right)
    points, in_right = points[seen], in_right[seen]
    located = _locate(other, project(rig.left, points), project(rig.right, in_right))
    good = np.isfinite(located).all(axis=1)
    if good.sum() < 3:
        return Apart(np.inf, np.inf, rays)
    left, found = points[good], located[good]
    turn = nearest_rotation((left - left.mean(axis=0)).T @ (found - found.mean(axis=0)))
    off = np.linalg.norm((found - found.mean(axis=0)) @ turn.T - (left - left.mean(axis=0)), axis=1)
    return Apart(float(np.sqrt(np.mean(off**2))), float(off.max()), rays)


def _rays(camera: CameraModel, pixels: FloatArray) -> FloatArray:
    normalized = normalized_from_pixels(camera, pixels)
    ray = np.column_stack([normalized, np.ones(len(normalized))])
    return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True))


def _rays_apart_px(camera: CameraModel, other: CameraModel, pixels: FloatArray) -> float:
    mine, theirs = _rays(camera, pixels), _rays(other, pixels)
    good = np.isfinite(mine).all(axis=1) & np.isfinite(theirs).all(axis=1)
    if good.sum() < 3:
        return np.inf
    turned = mine[good] @ nearest_rotation(theirs[good].T @ mine[good]).T
    ahead = turned[:, 2] > 1e-3
    off = pixels_from_normalized(other, turned[ahead, :2] / turned[ahead, 2:]) - pixels[good][ahead]
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def _locate(rig: StereoRig, left_px: FloatArray, right_px: FloatArray) -> FloatArray:
    """(n, 3) the middle between the two rays of each point where they come nearest to one another."""
    assert rig.right is not None
    assert rig.right_T_left is not None
    a = _rays(rig.left, left_px)
    b = _rays(rig.right, right_px) @ rig.right_T_left[:3, :3]
    origin = -rig.right_T_left[:3, :3].T @ rig.right_T_left[:3, 3]
    ab = np.sum(a * b, axis=1)
    to_a, to_b = a @ origin, b @ origin
    with np.errstate(divide="ignore", invalid="ignore"):
        along_a = (to_a - ab * to_b) / (1.0 - ab**2)
        along_b = (ab * to_a - to_b) / (1.0 - ab**2)
    return np.asarray(0.5 * (a * along_a[:, None] + origin + b * along_b[:, None]))
