"""Detection of a spherical wavefront in channel data and its rough origin: delay and sum over a grid.

One-way travel: a wave from (x, r) in the image plane reaches the element at x_i at sqrt((x - x_i)^2 + r^2) / c. For
every grid point the channels' complex envelopes are taken at those times, rotated to a common phase, weighted by
(r / d)^2 (obliquity times spreading, d the distance) and summed. For noise alone the squared magnitude, divided by its
variance, is exponential with mean 1: it is the log likelihood ratio of a wave from there against none. The best points
are refined on a finer grid that includes the sound speed, so that no source is lost between grid points. Two pass
bands together cover pulses of 3 to 7 MHz.

The direct wave is the first one, which need not be the strongest. To look for a wave before another one, each channel
is muted from the other's arrival on: what is left holds nothing of it, whatever its shape, and neither sidelobes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from fgreg.detection.channels import Band, Baseband, Channels, Float32Array, baseband, phasor
from fgreg.geometry.transforms import BoolArray, FloatArray
from fgreg.model.probe_model import ProbeModel

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
SEPARATE_MM = 1.0
"""A wave at least this much before another one, in range, is another wave."""
MUTE_US = 1.0
"""A wave's channels are muted from this long before its arrival on: the rise of a long pulse."""
EARLIER_SHARE = 0.005
"""Least statistic of an earlier wave as a share of the later one's: 23 dB softer. Below are tails of filters, and what
the channels pick up from one another."""
LATER_SHARE = 0.05
"""The same of a later wave: others are of no interest."""
OTHER_POINTS = 6
"""Points of an image at which another wave is looked for, per band; known waves' sidelobes are among them."""
FLAT_COHERENCE = 0.75
"""A flat wave of at least this coherence over the whole array is removed before the search. A source's wavefront is
curved: over an array that can tell, it has 0.3."""
FLAT_TAIL = 0.01
"""A flat wave lasts while its power is above this share of its maximum."""
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

    def arrival_us(self, element_x_mm: FloatArray, speed_mm_us: float) -> FloatArray:
        """(elements,) arrival times."""
        return np.asarray(np.hypot(self.range_mm, (self.x_mm - element_x_mm) / self.ratio) / speed_mm_us)


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
def _plan_and_scale(
    geometry: tuple[int, float, float, float, int, float, float, int, float], live: bytes
) -> tuple[Plan, Float32Array]:
    """Plan, and one over the support of its points; zero where too few elements receive."""
    plan = make_plan(*geometry)
    alive = np.frombuffer(live, dtype=np.bool_)
    live_support = support(alive, plan)
    enough = live_support >= min(MIN_SUPPORT, 0.25 * float(alive.sum()))
    return plan, np.where(enough, 1.0 / np.where(enough, live_support, 1.0), 0.0).astype(np.float32)


def statistic_image(signal: Baseband, plan: Plan, scale: Float32Array) -> Float32Array:
    """|sum|^2 over its variance under noise alone: exponential with mean 1. Zero where too few elements receive."""
    image = delay_and_sum(signal.data, plan)
    out = (image.real**2 + image.imag**2) * (scale / np.float32(signal.variance))
    # Noise common to the channels, or clutter, raises the whole image: normalise by the image's own median.
    some = out.ravel()[::7]
    some = some[scale.ravel()[::7] > 0.0]
    level = float(np.median(some)) / math.log(2.0) if some.size else 1.0
    return np.asarray(out / np.float32(max(1.0, level)))


def best_points(image: Float32Array, plan: Plan, count: int, first_row: int = 0) -> list[tuple[float, float, float]]:
    """The highest points of a statistic image, a millimetre apart: (statistic, x in pitches from row 0, range).

    ``first_row``: the grid's row at which the image begins.
    """
    columns = np.arange(image.shape[2]) - MARGIN
    position = columns[None, :] + np.arange(plan.subdivisions)[:, None] / plan.subdivisions
    range_mm = plan.range_mm[first_row : first_row + image.shape[1]]
    work = image.copy()
    out = []
    for _ in range(count):
        part, row, column = np.unravel_index(int(np.argmax(work)), work.shape)
        value = float(work[part, row, column])
        if value <= 0.0:
            break
        out.append((value, float(position[part, column]), float(range_mm[row])))
        low, high = np.searchsorted(range_mm, range_mm[row] + np.array([-1.0, 1.0]))
        work[:, low:high, max(0, column - 2) : column + 3] = 0.0
    return out


@dataclass(frozen=True, slots=True, eq=False)
class SearchBand:
    """One pass band of a frame: baseband, grid, and one over the support of its points (zero where too little)."""

    signal: Baseband
    plan: Plan
    scale: Float32Array


@dataclass(frozen=True, slots=True)
class FlatWave:
    """A signal that reaches elements at the same time.

    Attributes:
        span_us: first and last arrival time.
        elements: a block of elements that receive it.
        statistic: log likelihood ratio; it compares with that of a :class:`Peak`.
        coherence: power of the mean over the mean power in the block: 1 where all receive the same.
    """

    span_us: tuple[float, float]
    elements: slice
    statistic: float
    coherence: float

    def everywhere(self, elements: int) -> bool:
        """Whether it clearly reaches the whole array."""
        return self.coherence > FLAT_COHERENCE and self.elements == slice(0, elements)


def search_bands(channels: Channels, probe: ProbeModel, speed_mm_us: float) -> tuple[SearchBand, ...]:
    """The frame in the pass bands of the search."""
    bands = []
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
        bands.append(SearchBand(signal, *_plan_and_scale(geometry, channels.live.tobytes())))
    return tuple(bands)


@dataclass(frozen=True, slots=True, eq=False)
class FrameSearch:
    """The search of one frame.

    Attributes:
        bands, images: the frame in the pass bands, and the statistic image of each.
        peaks: the most likely sources, best first.
        live, probe, speed_mm_us: live elements, set-up, assumed sound speed.
        threshold: of the statistic.
    """

    bands: tuple[SearchBand, ...]
    images: tuple[Float32Array, ...]
    peaks: list[Peak]
    live: BoolArray
    probe: ProbeModel
    speed_mm_us: float
    threshold: float


def search_frame(
    bands: tuple[SearchBand, ...],
    live: BoolArray,
    probe: ProbeModel,
    speed_mm_us: float,
    threshold: float,
    count: int = 4,
) -> FrameSearch:
    """Delay and sum over the grid of each band, and the most likely sources on a finer grid."""
    images = tuple(statistic_image(band.signal, band.plan, band.scale) for band in bands)
    search = FrameSearch(bands, images, [], live, probe, speed_mm_us, threshold)
    rough = [peak for band, image in zip(bands, images, strict=True) for peak in _peaks_of(image, band, probe, count)]
    rough.sort(key=lambda peak: -peak.statistic)
    fine = [_refined(peak, search, FINE_RANGE_MM, (1.0,)) for peak in rough[:count]]
    fine.sort(key=lambda peak: -peak.statistic)
    if fine:
        fine[0] = _refined(fine[0], search, COARSE_RANGE_MM, RATIOS)
    return replace(search, peaks=fine)


def _peaks_of(image: Float32Array, band: SearchBand, probe: ProbeModel, count: int, first_row: int = 0) -> list[Peak]:
    """The best points of an image, or of a part that begins at a row of the grid, as peaks."""
    middle, pitch_mm = 0.5 * (probe.elements - 1), probe.pitch_mm * (-1.0 if probe.flip else 1.0)
    step_mm = probe.pitch_mm / band.plan.subdivisions
    return [
        Peak((pitches - middle) * pitch_mm, range_mm, 1.0, value, band.signal, step_mm)
        for value, pitches, range_mm in best_points(image, band.plan, count, first_row)
    ]


def find_waves(flat: FlatWave | None, search: FrameSearch) -> tuple[list[Peak], FlatWave | None]:
    """The strongest wave and those before it, the first one last; or a flat wave that is stronger than one of them.

    ``flat``: the most likely flat wave of the search.
    """
    waves = [search.peaks[0]]
    while flat is None or flat.statistic < waves[-1].statistic:
        earlier, flat = find_earlier(waves[-1], search)
        if earlier is None:
            return waves, None
        waves.append(earlier)
    return waves, flat


def find_earlier(wave: Peak, search: FrameSearch) -> tuple[Peak | None, FlatWave | None]:
    """The most likely wave before another one, and a flat wave there; None where below the threshold.

    The channels are muted from the other's arrival on.
    """
    until_us = wave.arrival_us(search.probe.element_x_mm, search.speed_mm_us) - MUTE_US
    found, quiet = _most_likely(
        search,
        lambda range_mm: slice(0, int(np.searchsorted(range_mm, wave.range_mm - SEPARATE_MM))),
        lambda time_us: time_us[:, None] < until_us,
        EARLIER_SHARE * wave.statistic,
    )
    return found, None if found is None else find_flat(quiet, search.live)


def find_later(waves: Sequence[Peak], search: FrameSearch) -> Peak | None:
    """The most likely wave after the last of some waves, about whose arrivals the channels are muted."""
    arrivals = [wave.arrival_us(search.probe.element_x_mm, search.speed_mm_us) for wave in waves]
    found, _ = _most_likely(
        search,
        lambda range_mm: slice(int(np.searchsorted(range_mm, waves[-1].range_mm + SEPARATE_MM)), None),
        lambda time_us: np.all([np.abs(time_us[:, None] - arrival) > MUTE_US for arrival in arrivals], axis=0),
        LATER_SHARE * max(wave.statistic for wave in waves),
    )
    return found


def _most_likely(
    search: FrameSearch,
    rows_of: Callable[[FloatArray], slice],
    heard_at: Callable[[FloatArray], BoolArray],
    least: float,
) -> tuple[Peak | None, list[Baseband]]:
    """The most likely wave at the best points of some rows of the images, in channels that are muted in part.

    Args:
        rows_of: from the grid's ranges.
        heard_at: (samples, elements) where the channels are not muted, from the samples' arrival times.
        least: of the statistic, besides the threshold.

    Returns:
        the wave, or None; the muted basebands in which it was looked for.
    """
    threshold = max(search.threshold, least)
    found: Peak | None = None
    muted = []
    for band, image in zip(search.bands, search.images, strict=True):
        signal, rows = band.signal, rows_of(band.plan.range_mm)
        first = rows.start or 0
        peaks = _peaks_of(image[:, rows], band, search.probe, OTHER_POINTS, first) if image[:, rows].size else []
        peaks = [peak for peak in peaks if peak.statistic > threshold]
        if not peaks:
            continue
        time_us = signal.start_us + np.arange(signal.data.shape[0]) / signal.rate_mhz
        quiet = replace(signal, data=np.where(heard_at(time_us), signal.data, 0))
        muted.append(quiet)
        for peak in peaks:
            start = replace(peak, signal=quiet, statistic=0.0)
            peak = _refined(start, search, FINE_RANGE_MM, (1.0,))
            if peak.statistic > max(threshold, 0.0 if found is None else found.statistic):
                found = peak
    return None if found is None else _refined(found, search, COARSE_RANGE_MM, RATIOS), muted


def _refined(peak: Peak, search: FrameSearch, range_offsets_mm: tuple[float, ...], ratios: tuple[float, ...]) -> Peak:
    return search_nearby(peak, search.live, search.probe.element_x_mm, search.speed_mm_us, range_offsets_mm, ratios)


def find_flat(signals: Sequence[Baseband], live: BoolArray) -> FlatWave | None:
    """The most likely flat wave in basebands: in the whole array, or in a half or quarter of it."""
    best: FlatWave | None = None
    parts = min(8, live.size)
    edges = np.arange(parts + 1) * live.size // parts
    counts = np.add.reduceat(live.astype(np.int64), edges[:-1])
    sizes = dict.fromkeys(max(1, parts // fraction) for fraction in (1, 2, 4))
    blocks = [(i, i + size) for size in sizes for i in range(parts - size + 1)]
    for signal in signals:
        sums = np.add.reduceat(signal.data[:-1], edges[:-1], axis=1)
        for first, last in blocks:
            count = int(counts[first:last].sum())
            power = np.abs(sums[:, first:last].sum(axis=1)) ** 2 / (signal.variance * max(count, 1))
            at = int(np.argmax(power))
            if count == 0 or (best is not None and power[at] <= best.statistic):
                continue
            low = np.flatnonzero(power < max(FLAT_TAIL * power[at], 3.0))
            begin, end = low[low < at][-1:], low[low > at][:1]
            rows = np.array([begin[0] if begin.size else 0, end[0] if end.size else power.size - 1])
            span = signal.start_us + rows / signal.rate_mhz
            block = slice(int(edges[first]), int(edges[last]))
            each = float(np.sum(np.abs(signal.data[at, block]) ** 2)) / signal.variance
            best = FlatWave((float(span[0]), float(span[1])), block, float(power[at]), float(power[at]) / each)
    return best


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
    signal, index = peak.signal, np.flatnonzero(live)
    outside = signal.data.shape[0] - 1
    # In single precision: a phase is then right to 1e-4.
    aside = ((x_mm[:, None] - element_x_mm[None, index]) / ratio[:, None]).astype(np.float32)
    square = np.square(range_mm).astype(np.float32)[:, None]
    path2 = np.square(aside)
    near = path2 < MAX_TANGENT**2 * square
    path2 += square
    elapsed = np.sqrt(path2) * np.float32(1.0 / speed_mm_us) - np.float32(signal.start_us)
    row = np.rint(elapsed * np.float32(signal.rate_mhz)).astype(np.intp)
    near &= (row >= 0) & (row < outside)
    weight = square / path2 * near
    turn = phasor(elapsed * np.float32(2.0 * np.pi * signal.carrier_mhz))
    turn *= weight
    turn *= np.take(signal.data, row * signal.data.shape[1] + index, mode="clip")
    total = turn.sum(axis=1)
    support = np.vecdot(weight, weight).astype(np.float64)
    variance = signal.variance * np.maximum(support, 0.25 * min(MIN_SUPPORT, float(index.size)))
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
