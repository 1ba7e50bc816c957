"""Detection of a spherical wavefront in channel data and its rough origin: delay and sum over a grid.

One-way travel: a wave from (x, r) in the image plane reaches the element at x_i at sqrt((x - x_i)^2 + r^2) / c. For
every grid point the channels' complex envelopes are taken at those times, rotated to a common phase, weighted by
(r / d)^2 (obliquity times spreading, d the distance) and summed. For noise alone the squared magnitude, divided by its
variance, is exponential with mean 1: it is the log likelihood ratio of a wave from there against none. The best points
are refined on a finer grid that includes the sound speed, so that no source is lost between grid points. Two pass
bands together cover pulses of 3 to 7 MHz.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from fgreg.detection.channels import Band, Baseband, Channels, baseband, phasor
from fgreg.geometry.transforms import BoolArray, FloatArray
from fgreg.model.session_model import ProbeModel

SEARCH_BANDS = (Band(3.5, 1.2), Band(5.9, 1.7))
SUBDIVISIONS = (2, 3)
"""Grid points per element pitch in x, for each band."""
RANGE_STEP_MM = (0.35, 0.25)
MAX_TANGENT = 1.3
"""Elements further to the side than this times the range are not used: they hardly receive the source."""
MARGIN = 12
"""Search region beyond either end of the array, in pitches."""
MIN_RANGE_MM, MAX_RANGE_MM = 2.0, 300.0
FINE_RANGE_MM = (-0.12, -0.06, 0.0, 0.06, 0.12)
COARSE_RANGE_MM = tuple(0.15 * k for k in range(-5, 6))
RATIOS = (0.94, 0.96, 0.98, 1.0, 1.02, 1.04, 1.06)
SIDELOBES_MM = tuple(0.075 * k for k in range(-4, 5))
"""If the assumed sound speed is wrong, the best grid point may be on a sidelobe at this distance in x."""
RATIO_SIGMA = 0.03
"""Prior standard deviation of the ratio of sound speeds about 1."""
MIN_SUPPORT = 6.0
"""Least sum of squared weights of the elements that could receive a point (a twentieth of a 128-element array)."""


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Tables of delay and sum for one geometry; ``lags`` are distances from element to point along x, >= 0.

    Attributes:
        range_mm: (rows,) of the grid.
        first: per lag, the first row whose points use elements this far to the side.
        index: per lag, (rows - first,) row of the baseband.
        turn: per lag, (rows - first, 1) weight times phase.
        weight2: (rows, lags) squared weights, zero where outside the record or too far to the side.
        subdivisions: points per pitch.
    """

    range_mm: FloatArray
    first: tuple[int, ...]
    index: tuple[npt.NDArray[np.intp], ...]
    turn: tuple[npt.NDArray[np.complex64], ...]
    weight2: FloatArray
    subdivisions: int


@dataclass(frozen=True, slots=True, eq=False)
class Peak:
    """A candidate source: TRUS x (mm), range (mm), ratio of sound speeds, log likelihood ratio, and its baseband."""

    x_mm: float
    range_mm: float
    ratio: float
    statistic: float
    signal: Baseband
    x_step_mm: float


def make_plan(
    elements: int,
    pitch_mm: float,
    speed_mm_us: float,
    start_us: float,
    samples: int,
    rate_mhz: float,
    carrier_mhz: float,
    subdivisions: int,
    range_step_mm: float,
) -> Plan:
    """Delays, phases and weights of a grid; the same for every frame of a session."""
    nearest = max(speed_mm_us * start_us, MIN_RANGE_MM)
    farthest = min(speed_mm_us * (start_us + samples / rate_mhz), MAX_RANGE_MM)
    range_mm = np.arange(nearest, max(farthest, nearest + 1e-9), range_step_mm)
    first, index, turn = [], [], []
    weight2 = np.zeros((range_mm.size, subdivisions * (elements + MARGIN)))
    for lag in range(weight2.shape[1]):
        aside = lag * pitch_mm / subdivisions
        begin = int(np.searchsorted(range_mm, aside / MAX_TANGENT))
        r = range_mm[begin:]
        distance = np.hypot(r, aside)
        elapsed = distance / speed_mm_us - start_us
        row = np.rint(elapsed * rate_mhz).astype(np.intp)
        inside = (row >= 0) & (row < samples)
        weight = (r / distance) ** 2
        weight2[begin:, lag] = np.where(inside, weight**2, 0.0)
        first.append(begin)
        index.append(np.where(inside, row, samples))
        turn.append((weight * np.exp(2j * np.pi * carrier_mhz * elapsed)).astype(np.complex64)[:, None])
    return Plan(range_mm, tuple(first), tuple(index), tuple(turn), weight2, subdivisions)


def delay_and_sum(data: npt.NDArray[np.complex64], plan: Plan) -> npt.NDArray[np.complex64]:
    """Coherent sums over the grid.

    Args:
        data: (samples + 1, elements) baseband, last row zero.

    Returns:
        (subdivisions, rows, elements + 2 MARGIN): point [p, j, n] is at x = x_0 + (n - MARGIN + p / subdivisions) pitch
        in element order, and at range_mm[j].
    """
    elements = data.shape[1]
    columns = elements + 2 * MARGIN
    image = np.zeros((plan.subdivisions, plan.range_mm.size, columns), dtype=np.complex64)
    work = np.empty((plan.range_mm.size, elements), dtype=np.complex64)
    for lag, (begin, index, turn) in enumerate(zip(plan.first, plan.index, plan.turn, strict=True)):
        if index.size == 0:
            break
        rows = work[: index.size]
        np.take(data, index, axis=0, out=rows, mode="clip")
        np.multiply(rows, turn, out=rows)
        # The same delays serve the points to the right (element i to column i + whole) and to the left.
        whole, part = divmod(lag, plan.subdivisions)
        start = MARGIN + whole
        stop = min(columns, start + elements)
        if start < columns:
            image[part, begin:, start:stop] += rows[:, : stop - start]
        if lag:
            start = MARGIN - whole - (1 if part else 0)
            skip = max(0, -start)
            if skip < elements:
                image[-part % plan.subdivisions, begin:, start + skip : start + elements] += rows[:, skip:]
    return image


def support(live: BoolArray, plan: Plan) -> FloatArray:
    """Sums of squared weights over live elements, same shape as :func:`delay_and_sum` returns."""
    elements = live.size
    columns = elements + 2 * MARGIN
    out = np.zeros((plan.subdivisions, plan.range_mm.size, columns))
    for part in range(plan.subdivisions):
        offset = np.arange(columns)[None, :] - MARGIN - np.arange(elements)[:, None]
        lag = np.abs(offset * plan.subdivisions + part)
        for column in range(columns):
            near = live & (lag[:, column] < plan.weight2.shape[1])
            out[part, :, column] = plan.weight2[:, lag[near, column]].sum(axis=1)
    return out


@lru_cache(maxsize=16)
def _plan_and_support(
    geometry: tuple[int, float, float, float, int, float, float, int, float], live: bytes
) -> tuple[Plan, FloatArray]:
    plan = make_plan(*geometry)
    return plan, support(np.frombuffer(live, dtype=np.bool_), plan)


def statistic_image(signal: Baseband, live: BoolArray, plan: Plan, live_support: FloatArray) -> FloatArray:
    """|sum|^2 over its variance under noise alone: exponential with mean 1. Zero where too few elements receive."""
    image = delay_and_sum(signal.data, plan)
    power = image.real**2 + image.imag**2
    enough = live_support >= min(MIN_SUPPORT, 0.25 * float(live.sum()))
    out = np.where(enough, power / (signal.variance * np.where(enough, live_support, 1.0)), 0.0)
    # Noise common to the channels, or clutter, raises the whole image: normalise by the image's own median.
    some = out[enough][::7]
    level = float(np.median(some)) / math.log(2.0) if some.size else 1.0
    return np.asarray(out / max(1.0, level))


def best_points(image: FloatArray, plan: Plan, count: int) -> list[tuple[float, float, float]]:
    """The highest points of a statistic image, a millimetre apart: (statistic, x in pitches from row 0, range)."""
    columns = np.arange(image.shape[2]) - MARGIN
    position = columns[None, :] + np.arange(plan.subdivisions)[:, None] / plan.subdivisions
    work = image.copy()
    out = []
    for _ in range(count):
        part, row, column = np.unravel_index(int(np.argmax(work)), work.shape)
        value = float(work[part, row, column])
        if value <= 0.0:
            break
        out.append((value, float(position[part, column]), float(plan.range_mm[row])))
        low, high = np.searchsorted(plan.range_mm, plan.range_mm[row] + np.array([-1.0, 1.0]))
        work[:, low:high, max(0, column - 2) : column + 3] = 0.0
    return out


def find_peaks(channels: Channels, probe: ProbeModel, speed_mm_us: float, count: int = 4) -> tuple[list[Peak], int]:
    """The most likely sources, best first, and the number of grid points searched."""
    rough: list[Peak] = []
    points = 0
    middle = 0.5 * (probe.elements - 1)
    for band, subdivisions, range_step_mm in zip(SEARCH_BANDS, SUBDIVISIONS, RANGE_STEP_MM, strict=True):
        signal = baseband(channels, band)
        geometry = (
            probe.elements,
            probe.pitch_mm,
            speed_mm_us,
            signal.start_us,
            signal.data.shape[0] - 1,
            signal.rate_mhz,
            signal.carrier_mhz,
            subdivisions,
            range_step_mm,
        )
        plan, live_support = _plan_and_support(geometry, channels.live.tobytes())
        image = statistic_image(signal, channels.live, plan, live_support)
        points += image.size
        for value, pitches, range_mm in best_points(image, plan, count):
            x_mm = (pitches - middle) * probe.pitch_mm * (-1.0 if probe.flip else 1.0)
            rough.append(Peak(x_mm, range_mm, 1.0, value, signal, probe.pitch_mm / subdivisions))
    rough.sort(key=lambda peak: -peak.statistic)
    element_x_mm = probe.element_x_mm
    fine = [
        search_nearby(peak, channels.live, element_x_mm, speed_mm_us, FINE_RANGE_MM, (1.0,)) for peak in rough[:count]
    ]
    fine.sort(key=lambda peak: -peak.statistic)
    if fine:
        fine[0] = search_nearby(fine[0], channels.live, element_x_mm, speed_mm_us, COARSE_RANGE_MM, RATIOS)
    return fine, points


def search_nearby(
    peak: Peak,
    live: BoolArray,
    element_x_mm: FloatArray,
    speed_mm_us: float,
    range_offsets_mm: tuple[float, ...],
    ratios: tuple[float, ...],
    x_offsets_mm: tuple[float, ...] | None = None,
) -> Peak:
    """The best point of a fine grid near a peak, including sound speeds with their prior; never worse than the peak."""
    x_offsets = peak.x_step_mm * np.linspace(-0.5, 0.5, 5) if x_offsets_mm is None else np.array(x_offsets_mm)
    grid = np.meshgrid(ratios, peak.range_mm + np.array(range_offsets_mm), peak.x_mm + x_offsets, indexing="ij")
    ratio, range_mm, x_mm = (axis.ravel() for axis in grid)
    range_mm = np.maximum(range_mm, 0.5 * MIN_RANGE_MM)
    index = np.flatnonzero(live)
    aside = (x_mm[:, None] - element_x_mm[None, index]) / ratio[:, None]
    path = np.hypot(range_mm[:, None], aside)
    weight = np.where(np.abs(aside) < MAX_TANGENT * range_mm[:, None], (range_mm[:, None] / path) ** 2, 0.0)
    elapsed = path / speed_mm_us - peak.signal.start_us
    outside = peak.signal.data.shape[0] - 1
    row = np.rint(elapsed * peak.signal.rate_mhz).astype(np.intp)
    inside = (row >= 0) & (row < outside)
    weight = np.where(inside, weight, 0.0)
    turn = phasor((2.0 * np.pi * peak.signal.carrier_mhz * elapsed).astype(np.float32))
    total = (weight * peak.signal.data[np.where(inside, row, outside), index[None, :]] * turn).sum(axis=1)
    variance = peak.signal.variance * np.maximum((weight**2).sum(axis=1), 0.25 * min(MIN_SUPPORT, float(index.size)))
    value = np.abs(total) ** 2 / variance - 0.5 * ((ratio - 1.0) / RATIO_SIGMA) ** 2
    best = int(np.argmax(value))
    if value[best] <= peak.statistic:
        return peak
    return replace(
        peak,
        x_mm=float(x_mm[best]),
        range_mm=float(range_mm[best]),
        ratio=float(ratio[best]),
        statistic=float(value[best]),
    )
