"""How good a calibration is: coverage of the pictures, halves against each other, what the views do not determine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincc

from fgreg.calibration import parameters
from fgreg.calibration.bundle import Bundle, fit, lens_jacobian
from fgreg.calibration.comparison import Apart, compare, picture_grid
from fgreg.calibration.views import SIDES, CornerTable
from fgreg.geometry.transforms import FloatArray, IntArray
from fgreg.model.camera_model import StereoRig
from fgreg.model.lens import focal_px, normalized_from_pixels

MAP = (12, 7)
"""Cells of a coverage map, across and down."""
SEEN_SHARE = 0.7
"""Of the cells that should have corners; an endoscope's round picture leaves a fifth of them black."""
HALF_VIEWS = 4
"""Least views of a half."""
UNLIKELY = 0.01
"""Probability below which two halves count as different."""
FOCAL_SHARE, CENTRE_SHARE, BASELINE_SHARE = 0.005, 0.005, 0.02
"""Sigmas, relative to focal length, width of the picture and baseline, from which a parameter is not determined."""
ROTATION_RAD = float(np.radians(0.2))
LENS_PX = 1.0
"""Sigma of a pixel by the lens' coefficients alone, from which they are not determined."""


@dataclass(frozen=True, slots=True, eq=False)
class Halves:
    """Every other view against those between.

    Attributes:
        apart: the two calibrations, where the pictures have corners.
        p: probability of a difference of the rig's constants as large, by their covariances.
        factor: by which all sigmas are to grow, so that the halves agree; 1 where they do.
    """

    apart: Apart
    p: float
    factor: float


def coverage(table: CornerTable, image_size: tuple[int, int], side: int) -> IntArray:
    """(down, across) number of corners in each cell of a picture."""
    width, height = image_size
    x, y = (table.pixels[table.side == side] + 0.5).T
    counts, _, _ = np.histogram2d(y, x, bins=(MAP[1], MAP[0]), range=((0.0, height), (0.0, width)))
    return np.asarray(counts, dtype=np.int64)


def seen_pixels(table: CornerTable, rig: StereoRig) -> list[FloatArray]:
    """Of each camera, (n, 2) pixels over the cells of its picture that have corners."""
    out = []
    for side, camera in enumerate(parameters.cameras(rig)):
        seen = coverage(table, camera.image_size, side) > 0
        pixels = picture_grid(camera)
        column, row = ((pixels + 0.5) / camera.image_size * MAP).astype(int).T
        out.append(pixels[seen[row, column]])
    return out


def view_residuals(table: CornerTable, bundle: Bundle) -> FloatArray:
    """(V, 2) RMS length (px) of each view's residuals in the left and the right picture, strays left out; NaN: none."""
    out = np.full((len(table.names), 2), np.nan)
    square = np.sum(bundle.residual_px**2, axis=1)
    for v in range(len(table.names)):
        for side in range(2):
            own = (table.view == v) & (table.side == side) & bundle.used
            if own.any():
                out[v, side] = np.sqrt(square[own].mean())
    return out


def board_depths_mm(table: CornerTable, left_T_board: FloatArray) -> tuple[float, float, float]:
    """Depths of the corners in the left camera: 5th, 50th and 95th percentile."""
    pose = left_T_board[table.view]
    z = np.einsum("nj,nj->n", pose[:, 2, :3], table.board_p_mm) + pose[:, 2, 3]
    near, middle, far = np.percentile(z, (5, 50, 95))
    return float(near), float(middle), float(far)


def halves(table: CornerTable, bundle: Bundle) -> Halves | None:
    """Calibrate with every other view and with the others; None where there are too few, or a half has no pairs."""
    parts = [np.arange(first, len(table.names), 2) for first in range(2)]
    if min(map(len, parts)) < HALF_VIEWS:
        return None
    fits = []
    for chosen in parts:
        part = table.of_views(chosen)
        sides = [set(part.view[part.side == side].tolist()) for side in range(len(parameters.cameras(bundle.rig)))]
        if not set.intersection(*sides):
            return None
        fits.append(fit(part, bundle.rig, bundle.left_T_board[chosen]))
    first, second = fits
    _, by = parameters.constants(bundle.rig)
    off = by @ parameters.difference(first.rig, second.rig)
    spread = by @ (first.covariance + second.covariance) @ by.T
    chi_square, count = float(off @ np.linalg.solve(spread, off)), len(off)
    p = float(gammaincc(0.5 * count, 0.5 * chi_square))
    factor = float(np.sqrt(chi_square / count)) if p < UNLIKELY else 1.0
    depths, pixels = board_depths_mm(table, bundle.left_T_board), seen_pixels(table, bundle.rig)
    return Halves(compare(first.rig, second.rig, depths, pixels), p, max(factor, 1.0))


def not_determined(rig: StereoRig, covariance: FloatArray) -> list[str]:
    """Names of parameters that the views do not determine, each with its sigma.

    Of the lens' coefficients only what they do to pixels counts: single ones may be uncertain together.
    """
    sigma, names = np.sqrt(np.diag(covariance)), parameters.names(rig)
    units = parameters.per_unit(rig)
    limits = np.full(len(sigma), np.inf)
    for camera, columns in zip(parameters.cameras(rig), parameters.lens_columns(rig), strict=True):
        first = columns.start
        limits[first : first + 2] = FOCAL_SHARE * focal_px(camera)
        limits[first + 2 : first + 4] = CENTRE_SHARE * camera.image_size[0]
        normalized = normalized_from_pixels(camera, picture_grid(camera))
        by = lens_jacobian(camera, normalized[np.isfinite(normalized).all(axis=1)])[:, :, 4:]
        lens = slice(first + 4, columns.stop)
        spread = np.einsum("nip,pq,niq->n", by, covariance[lens, lens], by)
        if spread.size and float(np.median(spread)) > 0.0 and np.sqrt(np.percentile(spread, 90)) > LENS_PX:
            worst = by[np.argmin(np.abs(spread - np.percentile(spread, 90)))]
            effect = np.linalg.norm(worst, axis=0) * sigma[lens]
            limits[lens] = np.where(effect > LENS_PX, 0.0, np.inf)
    if rig.right_T_left is not None:
        limits[-6:-3] = ROTATION_RAD
        limits[-3:] = BASELINE_SHARE * float(np.linalg.norm(rig.right_T_left[:3, 3]))
    return [f"{names[i]} (sigma {sigma[i] * units[i]:.2g})" for i in np.flatnonzero(sigma > limits)]


def empty_parts(counts: IntArray) -> list[str]:
    """Which thirds of a picture hardly have corners, in words; empty where the picture is covered."""
    if float((counts > 0).mean()) >= SEEN_SHARE:
        return []
    rows, columns = np.array_split(np.arange(MAP[1]), 3), np.array_split(np.arange(MAP[0]), 3)
    words = []
    for r, vertical in zip(rows, ("upper", "", "lower"), strict=True):
        for c, horizontal in zip(columns, ("left", "", "right"), strict=True):
            if float((counts[np.ix_(r, c)] > 0).mean()) < 0.5:
                words.append(" ".join(filter(None, (vertical, horizontal))) or "middle")
    return words


def conditions(
    table: CornerTable, bundle: Bundle, covariance: FloatArray, both: Halves | None, image_size: tuple[int, int]
) -> list[str]:
    """What falls short, one sentence each, with what to do about it."""
    out = []
    if names := not_determined(bundle.rig, covariance):
        out.append(
            f"the views do not determine {', '.join(names)}: add views tilted by 20 to 40 degrees about both axes, at "
            "several distances, and into the corners of the pictures"
        )
    out += [
        f"the {SIDES[side]} pictures have few corners in: {', '.join(parts)}; hold the board there too"
        for side in range(len(parameters.cameras(bundle.rig)))
        if (parts := empty_parts(coverage(table, image_size, side)))
    ]
    if both is None:
        out.append(f"too few views for a comparison of two halves: take {2 * HALF_VIEWS} or more")
    elif both.factor > 1.0:
        out.append(
            f"two halves of the views differ by more than their sigmas say (p {both.p:.1g}); all sigmas are "
            f"multiplied by {both.factor:.1f}: is the board flat and the focus fixed? Other lens models: --model"
        )
    pose = bundle.rig.right_T_left
    if pose is not None and pose[0, 3] > 0.5 * float(np.linalg.norm(pose[:3, 3])):
        beside = f"the right camera is {pose[0, 3]:.1f} mm to the left of the left one"
        out.append(f"{beside}: were left and right pictures exchanged?")
    strays = float((~bundle.used).mean())
    if strays > 0.05:
        out.append(
            f"{100 * strays:.0f} % of the corners do not fit and are left out: was the board moving, is it flat?"
        )
    return out
