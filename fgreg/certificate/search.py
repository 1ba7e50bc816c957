"""Branch and bound over all rotations: what is the least possible cost, and where may it be within a threshold.

The cells that cover all rotations are bounded and halved until none is left in question, or until so many were looked
at that the search stops: then it says what it has reached (the order and number of cells do not depend on the time).
Every cell that is put aside has a bound, so that the least of them bounds the cost of all registrations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.certificate.bound import Bounds, Intervals, first_intervals, lower_bounds, sharper_bounds
from fgreg.certificate.conditional import Conditional
from fgreg.certificate.rotations import Cells, Reach
from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray

ALONG = 4
"""Cells along each side of the first cover: 256 cells, of 25 to 47 deg."""
ROUNDS = 15
"""Largest number of times that a thorough search narrows the intervals of a cell before it is halved."""
NARROWED = 0.96
"""Intervals that narrow to more than this part of what they were are not narrowed again."""
EASY = 2_700
"""Cells up to which a search is not thorough: with first hits it mostly ends before, and sooner. With few PMs, whose
intervals stay wide, it takes more of them."""
AT_ONCE = 12_000
"""Number of cells times PMs that are bounded in one call: more do not stay in the cache."""
NEAR = 0.5
"""Part of the threshold from which on a bound is worth sharpening."""
MUCH = 0.4
"""Sides by which the bound gains as much of what it gains by the best one are halved with it."""
BALLS = np.radians(10.0) * 0.75 ** np.arange(20)
"""Radii about the estimate that are tried as one cell."""
_NONE = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """Cells that are left, with their bounds (of the same cells)."""

    cells: Cells
    bounds: Bounds

    def take(self, index: IntArray) -> Region:
        return Region(self.cells.take(index), self.bounds.take(index))


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Result of a search.

    Attributes:
        region: cells in which a registration within the threshold may be.
        least: lower bound of the cost of every registration, or the threshold where it is higher.
        looked_at: number of cells times PMs that were bounded. finished: whether none had to be left in question.
    """

    region: Region
    least: float
    looked_at: int
    finished: bool


def search(
    of: Conditional,
    threshold: float,
    *,
    reach_rad: float,
    budget: int,
    enough: float = np.inf,
    start: Region | None = None,
    spent: int = 0,
) -> Found | None:
    """Halve cells until those in which the cost may be below the threshold are small, or none is left.

    Args:
        of: the cost.
        threshold: registrations with a larger cost are of no interest.
        reach_rad: cells as small as this are not halved.
        budget: number of cells times PMs after which the search stops.
        enough: cells with a bound as high are not looked at further.
        start: cells to start from, of a search with a higher threshold; all rotations where None.
        spent: what the search that left these cells looked at.

    Returns:
        None where a PM is nearer to the array than the array to its axis.
    """
    known = first_intervals(of, threshold)
    if known is None:
        return None
    count = of.polar.shape[1]
    if start is None:
        cells = Cells.cover(ALONG)
        intervals = _repeated(known, len(cells))
    else:
        cells, intervals = start.cells, start.bounds.intervals.within(known)
    ball = _ball(of, known, threshold, enough) if np.isfinite(enough) else 0.0
    least, looked_at = min(threshold, enough), 0
    kept = [_bounded(of, cells.take(_NONE), intervals.take(_NONE), threshold)]
    while len(cells):
        outside = np.flatnonzero(farthest(cells) > ball)
        cells, intervals = cells.take(outside), intervals.take(outside)
        if not len(cells):
            break
        region = _bounded(of, cells, intervals, threshold, thorough=spent + looked_at > EASY * count)
        looked_at += len(cells) * count
        cost, left = region.bounds.cost, region.bounds.possible & (region.bounds.cost < enough)
        aside = region.bounds.possible & ~left
        if aside.any():
            least = min(least, float(cost[aside].min()))
        small = left & (region.cells.reach_rad <= reach_rad)
        split = np.flatnonzero(left & ~small)
        halves, index = region.cells.take(split).halved(_sides(region.take(split)))
        if looked_at + count * len(halves) > budget:
            kept.append(region.take(np.flatnonzero(left)))
            break
        kept.append(region.take(np.flatnonzero(small)))
        cells, intervals = halves, region.bounds.intervals.take(split[index])
    finished = all((part.cells.reach_rad <= reach_rad).all() for part in kept)
    region = _joined(kept)
    if len(region.cells):
        least = min(least, float(region.bounds.cost.min()))
    return Found(region, least, looked_at, finished)


def _bounded(
    of: Conditional, cells: Cells, intervals: Intervals, threshold: float, *, thorough: bool = False
) -> Region:
    """Cells with their bounds, in portions."""
    size = max(AT_ONCE // of.polar.shape[1], 1)
    parts = []
    for begin in range(0, max(len(cells), 1), size):
        index = np.arange(begin, min(begin + size, len(cells)))
        parts.append(_portion(of, cells.take(index), intervals.take(index), threshold, thorough))
    return _joined(parts)


def _portion(of: Conditional, cells: Cells, intervals: Intervals, threshold: float, thorough: bool) -> Region:
    rotation, reach = np.einsum("nij,jk->ikn", cells.rotation, of.rotation), cells.reach
    bounds = (narrowed if thorough else lower_bounds)(of, rotation, reach, intervals, threshold)
    near = np.flatnonzero(bounds.possible & (bounds.cost > NEAR * threshold))
    if len(near):
        bounds.put(near, sharper_bounds(of, rotation[..., near], reach.take(near), bounds.take(near), threshold))
    index = np.flatnonzero(bounds.possible)
    return Region(cells.take(index), bounds.take(index))


def narrowed(of: Conditional, rotation: FloatArray, reach: Reach, intervals: Intervals, threshold: float) -> Bounds:
    """Bounds of cells, PM by PM, with intervals narrowed as long as that helps."""
    out = lower_bounds(of, rotation, reach, intervals, threshold, pm_by_pm=True)
    index = np.arange(len(reach))
    before = intervals.half[2].sum(axis=0)
    for _ in range(1, ROUNDS):
        after = out.intervals.half[2].sum(axis=0)[index]
        index = index[out.possible[index] & (after < NARROWED * before)]
        if not len(index):
            break
        known = out.intervals.take(index)
        before = known.half[2].sum(axis=0)
        again = lower_bounds(of, rotation[..., index], reach.take(index), known, threshold, pm_by_pm=True)
        again.cost[:] = np.maximum(again.cost, out.cost[index])
        out.put(index, again)
    return out


def _ball(of: Conditional, known: Intervals, threshold: float, enough: float) -> float:
    """The largest radius about the estimate's rotation that is known to hold no lower cost than ``enough``."""
    rotation = np.repeat(of.rotation[..., None], len(BALLS), axis=-1)
    reach = Reach.ball(BALLS)
    bounds = lower_bounds(of, rotation, reach, _repeated(known, len(BALLS)), threshold)
    bounds = sharper_bounds(of, rotation, reach, bounds, threshold)
    good = bounds.cost >= enough
    return float(BALLS[good].max()) if good.any() else 0.0


def _sides(region: Region) -> BoolArray:
    """(n, 3) sides along which cells are halved: those that the bound gains most by."""
    worth = np.einsum("nik,kn->ni", region.cells.sides_rad, region.bounds.worth)
    return np.asarray(worth >= MUCH * worth.max(axis=1, keepdims=True))


def farthest(cells: Cells, rotation: FloatArray | None = None) -> FloatArray:
    """(n,) rad: the angle between a turn (3, 3), the reference's if None, and any of a cell's, at most."""
    return np.asarray(angle_between(cells.rotation, np.eye(3) if rotation is None else rotation) + cells.reach_rad)


def angle_between(first: FloatArray, second: FloatArray) -> FloatArray:
    """(...,) rad between rotations (..., 3, 3)."""
    sine = np.linalg.norm(first - second, axis=(-2, -1)) / np.sqrt(8.0)  # of half the angle
    return np.asarray(2.0 * np.arcsin(np.minimum(sine, 1.0)))


def _repeated(intervals: Intervals, times: int) -> Intervals:
    return Intervals(np.repeat(intervals.centre, times, axis=-1), np.repeat(intervals.half, times, axis=-1))


def _joined(parts: list[Region]) -> Region:
    cells = Cells(*(np.concatenate([getattr(part.cells, name) for part in parts]) for name in Cells.__slots__))
    return Region(cells, Bounds.joined([part.bounds for part in parts]))
