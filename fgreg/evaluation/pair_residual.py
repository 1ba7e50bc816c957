"""The published figure of merit (Eq. 12), the pair residual: it is *not* a target registration error.

The beam of a held-out pair is transformed to TRUS by the registration of the others. lambda and theta' are refitted for
that pair alone; the remaining distance between line and arc is the ``pair_residual``. Both refits absorb error: a
registration that is rotated about the probe's axis by 25 mm can have a residual of 0.7 mm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fgreg.geometry.transforms import FloatArray

HALF_ARC_RAD = math.pi / 2.0
"""The arc is searched up to this angle on either side of the image plane."""
GRID = 181
NEWTON_STEPS = 8


@dataclass(frozen=True, slots=True, eq=False)
class LineToArc:
    """Nearest points of lines and arcs, all (n,): distance mm, arc angle theta' rad, distance along the line mm."""

    distance_mm: FloatArray
    theta_rad: FloatArray
    lambda_mm: FloatArray


def line_to_arc(
    trus_p: FloatArray,
    trus_d: FloatArray,
    scan_rad: FloatArray,
    x_mm: FloatArray,
    range_mm: FloatArray,
    radius_mm: float,
) -> LineToArc:
    """Least distance between beams and the arcs of looks, over lambda and theta' (within 90 deg of the plane).

    With P the projector normal to the beam and a(theta') the arc point, ``f = |P (a - p)|^2`` is searched on a 1 deg
    grid and refined by Newton steps: f has up to two minima on the half circle, so a local search is not enough.

    Args:
        trus_p, trus_d: (n, 3) a point on each beam (mm) and its unit direction, TRUS.
        scan_rad, x_mm, range_mm: (n,) of the looks; ranges as true distances (corrected for the speed of sound).
        radius_mm: of the probe.
    """
    element = np.stack([x_mm, radius_mm * np.sin(scan_rad), radius_mm * np.cos(scan_rad)], axis=-1)
    across = np.eye(3) - trus_d[:, :, None] * trus_d[:, None, :]
    start = element - trus_p

    def radial(theta: FloatArray) -> FloatArray:
        return np.stack([np.zeros_like(theta), np.sin(theta), np.cos(theta)], axis=-1)

    grid = scan_rad[:, None] + np.linspace(-HALF_ARC_RAD, HALF_ARC_RAD, GRID)
    offset = start[:, None] + range_mm[:, None, None] * radial(grid)
    square = np.sum(np.einsum("nij,ngj->ngi", across, offset) ** 2, axis=-1)
    theta = np.take_along_axis(grid, np.argmin(square, axis=1)[:, None], axis=1)[:, 0]
    low = np.maximum(theta - 2.0 * HALF_ARC_RAD / (GRID - 1), scan_rad - HALF_ARC_RAD)
    high = np.minimum(theta + 2.0 * HALF_ARC_RAD / (GRID - 1), scan_rad + HALF_ARC_RAD)
    for _ in range(NEWTON_STEPS):
        u = radial(theta)
        tangent = np.stack([np.zeros_like(theta), np.cos(theta), -np.sin(theta)], axis=-1)
        gap = np.einsum("nij,nj->ni", across, start + range_mm[:, None] * u)
        slope = range_mm * np.sum(gap * tangent, axis=-1)
        bend = range_mm**2 * np.einsum("ni,nij,nj->n", tangent, across, tangent) - range_mm * np.sum(gap * u, axis=-1)
        newton = slope / np.where(bend > 1e-9, bend, np.inf)
        theta = np.clip(theta - newton, low, high)
    point = element + range_mm[:, None] * radial(theta)
    gap = np.einsum("nij,nj->ni", across, point - trus_p)
    return LineToArc(np.linalg.norm(gap, axis=-1), theta, np.sum(trus_d * (point - trus_p), axis=-1))
