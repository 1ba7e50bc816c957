"""Position of the photoacoustic source in a beamformed envelope image: sub-pixel peak with covariance.

Log-compressed images (``probe.image.log_db``) are made linear first.

Power (envelope squared) is divided by the background at the same depth and smoothed at a few scales. Its maximum is
tested against the tail of the image's own distribution: an exponential fitted between two high quantiles and
extrapolated to the false-alarm rate, further where few independent speckle grains determine the tail. That needs no
model of speckle. Before the strongest peak an earlier one is looked for, since the direct wave is the first one. A bell
is then fitted to the power near the peak.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage, optimize

from fgreg.detection.channels import check_frame
from fgreg.detection.results import LEAST_RANGE_MM, NoSignal, OtherWave, PaFind
from fgreg.geometry.transforms import FloatArray
from fgreg.model.probe_model import ImageModel, ProbeModel

FALSE_ALARMS = 4e-4
SCALES_MM = ((0.0, 0.0), (0.1, 0.15), (0.2, 0.4))
"""Standard deviations (range, x) of the smoothing; the first is none."""
LOW_QUANTILE, HIGH_QUANTILE = 0.97, 0.997
AWAY_MM = (1.5, 2.5)
"""Half size (range, x) of the region around a peak that is excluded from the background."""
ROWS, ROWS_SHARE = 15, 8
"""The background's level is smoothed along depth over an eighth of the rows, at least 15."""
FIT_LEVEL = 0.25
"""Pixels above this share of the peak's power enter the fit (half the envelope)."""
FLOOR_PIXELS = 0.01
EARLIER_SHARE = 0.1
"""Least power of an earlier source as a share of a later one's: softer ones are sidelobes of the beamformer."""
FLAT_MM = 8.0
"""What is wider along x than this is a flat wave."""
OTHER_SIGMA_MM = (0.2, 0.15)
"""Standard deviations (x, range) of a peak that is not fitted."""
TYPICAL_MM, SIZE_SIGMA = (0.14, 0.2), 0.8
"""Prior of the widths (range, x) of a source's envelope, and the sigma of their logarithms."""
SKEW_SIGMA, TILT_SIGMA = 0.2, 0.5
MAX_FIT_PIXELS = 400


@dataclass(frozen=True, slots=True)
class _Peak:
    row: int
    column: int
    statistic: float
    scale: int
    clusters: int


def locate_in_image(frame: npt.NDArray[Any], probe: ProbeModel) -> PaFind | NoSignal:
    """Find the photoacoustic source in one envelope image.

    Args:
        frame: (depth, lateral) pixels of the envelope, >= 0, or log-compressed where ``probe.image.log_db`` says so.
            Rows are range, columns TRUS x, both increasing; ``probe.flip`` is the order of channels and does not flip
            the image.
        probe: with ``image``: pixel pitch and centre of pixel [0, 0], (range, x) mm.

    Returns:
        The find, or why there is none. ``range_mm`` is computed with the assumed sound speed, as in the
        image. The ratio of sound speeds is None: an envelope image does not hold the wavefront.

    Raises:
        ValueError: the probe has no image geometry, or the frame is no envelope image.
    """
    if probe.image is None:
        raise ValueError("the probe has no image geometry (probe.image)")
    image = probe.image.linear(check_frame(frame))
    if float(image.min()) < 0.0:
        raise ValueError("an envelope image with negative pixels, expected values >= 0")
    if min(image.shape) < 8:
        raise ValueError(f"an envelope image of shape {image.shape}, expected at least 8 x 8 pixels")
    if float(np.ptp(image)) == 0.0:
        return NoSignal(f"no signal: all pixels are {image[0, 0]:g}")
    range_mm = probe.image.origin_mm[0] + probe.image.pixel_mm[0] * np.arange(image.shape[0])
    usable = np.flatnonzero(range_mm > 0.0)
    if usable.size < 8:
        return NoSignal("no signal: hardly any row of the image is at a range > 0")
    first = int(usable[0])
    power = image[first:] ** 2
    level = background(power)
    relative = power / level[:, None]
    peak = _find_peak(relative, probe.image)
    # The exponential's scale is known from n independent excesses only: its predictive tail is (1 + t / n)^-n.
    head = -math.log(1 - LOW_QUANTILE)
    excess = math.log(len(SCALES_MM) * relative.size / FALSE_ALARMS) - head
    threshold = head + peak.clusters * math.expm1(min(excess / max(peak.clusters, 1), 50.0))
    if peak.statistic < threshold:
        return NoSignal(f"no signal: statistic {peak.statistic:.1f}, threshold {threshold:.1f}")
    others: list[_Peak] = []
    while (
        earlier := _find_earlier(relative, np.asarray(range_mm[first:], dtype=np.float64), peak, threshold, probe.image)
    ) is not None:
        others.append(peak)
        peak = earlier
    fit = _fit_bell(power, level, relative, peak, probe.image)
    if fit is None:
        return NoSignal(
            f"no signal: statistic {peak.statistic:.1f}, threshold {threshold:.1f}, but no peak inside the image"
        )
    row, column, amplitude, covariance = fit
    if not (np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0.0):
        return NoSignal(
            f"no signal: statistic {peak.statistic:.1f}, threshold {threshold:.1f}, but the image is too small, or cut "
            "off at a level, to say how well the position is known"
        )
    noise = math.sqrt(0.5 * float(level[peak.row]))
    return PaFind(
        x_mm=probe.image.origin_mm[1] + column * probe.image.pixel_mm[1],
        range_mm=probe.image.origin_mm[0] + (first + row) * probe.image.pixel_mm[0],
        covariance=covariance,
        amplitude=amplitude,
        snr_db=20.0 * math.log10(amplitude / (math.sqrt(2.0) * noise)),
        sound_speed_ratio=None,
        sound_speed_ratio_sigma=None,
        elements_used=None,
        statistic=peak.statistic,
        threshold=threshold,
        others=tuple(
            OtherWave(
                probe.image.origin_mm[1] + other.column * probe.image.pixel_mm[1],
                float(range_mm[first + other.row]),
                np.diag(np.square(OTHER_SIGMA_MM)),
                other.statistic,
            )
            for other in others
        ),
    )


def background(power: FloatArray) -> FloatArray:
    """Mean power of the background at each depth, (rows,), from medians along rows (exponential: median = ln 2 mean).

    A row that is bright as a whole (a flash, the probe's face) has its own level, others that of their neighbourhood.
    """
    each = np.median(power, axis=1) / math.log(2.0)
    smooth = ndimage.median_filter(each, size=min(max(ROWS, each.size // ROWS_SHARE), each.size), mode="nearest")
    level = np.maximum(smooth, 0.7 * each)
    return np.maximum(level, 1e-12 * float(power.max()))


def _find_earlier(
    relative: FloatArray, range_mm: FloatArray, peak: _Peak, threshold: float, image: ImageModel
) -> _Peak | None:
    """The strongest peak before another one; None where it is too soft, wide as a flat wave, or at the probe's face."""
    rows = np.flatnonzero((range_mm > LEAST_RANGE_MM) & (range_mm < range_mm[peak.row] - AWAY_MM[0]))
    if rows.size < 8:
        return None
    part = relative[rows[0] : rows[-1] + 1]
    found = _find_peak(part, image)
    if found.statistic < max(threshold, EARLIER_SHARE * peak.statistic):
        return None
    labels, _ = ndimage.label(part[found.row] > FIT_LEVEL * part[found.row, found.column])
    if float(np.sum(labels == labels[found.column])) * image.pixel_mm[1] > FLAT_MM:
        return None
    return replace(found, row=found.row + int(rows[0]))


def _find_peak(relative: FloatArray, image: ImageModel) -> _Peak:
    best = _Peak(0, 0, -math.inf, 0, 1)
    away = [max(1, round(size / pixel)) for size, pixel in zip(AWAY_MM, image.pixel_mm, strict=True)]
    for number, scale in enumerate(SCALES_MM):
        sigma = [size / pixel for size, pixel in zip(scale, image.pixel_mm, strict=True)]
        if number and max(sigma) < 0.4:
            continue
        smooth = (
            ndimage.gaussian_filter(relative, sigma, mode="constant", cval=1.0, truncate=3.0) if number else relative
        )
        row, column = (int(i) for i in np.unravel_index(int(np.argmax(smooth)), smooth.shape))
        rest = np.ones(smooth.shape, dtype=np.bool_)
        rest[max(0, row - away[0]) : row + away[0] + 1, max(0, column - away[1]) : column + away[1] + 1] = False
        others = smooth[rest] if rest.sum() > 0.3 * rest.size else smooth.ravel()
        low, high = np.quantile(others, (LOW_QUANTILE, HIGH_QUANTILE))
        top = float(smooth[row, column])
        decay = max(float(high - low) / math.log((1 - LOW_QUANTILE) / (1 - HIGH_QUANTILE)), 1e-9 * top)
        statistic = (top - float(low)) / decay - math.log(1 - LOW_QUANTILE)
        if statistic > best.statistic:
            _, clusters = ndimage.label(rest & (smooth > low))
            best = _Peak(row, column, statistic, number, int(clusters))
    return best


def _bell(p: FloatArray, z: FloatArray, x: FloatArray) -> FloatArray:
    """Power of a bell: log height, centre (z, x), log widths of the envelope, skew along z, tilt; pixels."""
    height, z0, x0, wide_z, wide_x, skew, tilt = np.clip(p, -1e4, [500.0, 1e4, 1e4, 6.0, 6.0, 1.5, 10.0])
    wide_z, wide_x = max(wide_z, -3.0), max(wide_x, -3.0)
    u = (z - z0) * math.exp(-wide_z)
    u = u / (1.0 + 0.5 * skew * np.tanh(3.0 * u))
    v = (x - x0 - tilt * (z - z0)) * math.exp(-wide_x)
    return np.asarray(math.exp(height) * np.exp(-(u * u + v * v)))


def _fit_bell(
    power: FloatArray, level: FloatArray, relative: FloatArray, peak: _Peak, image: ImageModel
) -> tuple[float, float, float, FloatArray] | None:
    """(row, column, amplitude, covariance (2, 2) over (x, range), mm^2) of the bell at a peak, if there is one."""
    sigma = [max(size / pixel, 0.6) for size, pixel in zip(SCALES_MM[max(peak.scale, 1)], image.pixel_mm, strict=True)]
    smooth = ndimage.gaussian_filter(power - level[:, None], sigma, mode="constant", truncate=3.0)
    reach = [max(3, round(2.0 / pixel)) for pixel in image.pixel_mm]
    low = [max(0, peak.row - reach[0]), max(0, peak.column - reach[1])]
    part = smooth[low[0] : peak.row + reach[0] + 1, low[1] : peak.column + reach[1] + 1]
    labels, _ = ndimage.label(part > FIT_LEVEL * part[peak.row - low[0], peak.column - low[1]])
    inside = labels == labels[peak.row - low[0], peak.column - low[1]]
    inside = ndimage.binary_dilation(inside)
    z, x = (index.astype(np.float64) for index in np.nonzero(inside))
    if z.size > MAX_FIT_PIXELS:
        pick = np.linspace(0, z.size - 1, MAX_FIT_PIXELS).astype(np.intp)
        z, x = z[pick], x[pick]
    z, x = z + low[0], x + low[1]
    rows, columns = z.astype(np.intp), x.astype(np.intp)
    value, mean = power[rows, columns], level[rows]
    top = max(float(smooth[peak.row, peak.column]), 1e-300)
    start = np.array([math.log(top), float(peak.row), float(peak.column), 0.0, 0.0, 0.0, 0.0])
    typical = [math.log(size / pixel) for size, pixel in zip(TYPICAL_MM, image.pixel_mm, strict=True)]
    start[3:5] = typical
    expected = np.array([*typical, 0.0, 0.0])
    prior = 1.0 / np.array([SIZE_SIGMA, SIZE_SIGMA, SKEW_SIGMA, TILT_SIGMA * image.pixel_mm[0] / image.pixel_mm[1]])

    spread = np.ones(z.size)

    def misfit(p: FloatArray) -> FloatArray:
        return np.concatenate([(value - mean - _bell(p, z, x)) / spread, (p[3:] - expected) * prior])

    solution = start
    for _ in range(2):
        # Rician pixels: variance of the power is background^2 + 2 background signal.
        signal = _bell(solution, z, x)
        spread = np.sqrt(mean**2 + 2.0 * mean * signal + (1e-3 * top) ** 2)
        result = optimize.least_squares(misfit, solution, method="lm", max_nfev=200)
        solution = np.asarray(result.x)
        centre = solution[1:3]
        if not (np.isfinite(solution).all() and np.abs(centre - [peak.row, peak.column]).max() < 2.0 * max(reach)):
            return None
    if (centre < -0.5).any() or (centre > np.array(power.shape) - 0.5).any():
        return None
    jacobian = np.asarray(result.jac)
    remaining = np.asarray(result.fun)[: z.size]
    data = z.size
    # Pixels are correlated like the background. The root of the power correlation is that of the amplitudes.
    correlation = _correlation(relative, rows, columns)
    bread = np.linalg.pinv(jacobian.T @ jacobian)
    meat = jacobian[:data].T @ correlation @ jacobian[:data] + jacobian[data:].T @ jacobian[data:]
    scale = max(1.0, float(remaining @ remaining) / max(data - 5, 1))
    covariance_px = (bread @ meat @ bread)[1:3, 1:3] * scale + np.eye(2) * FLOOR_PIXELS**2
    swap = np.array([[0.0, image.pixel_mm[1]], [image.pixel_mm[0], 0.0]])
    return float(centre[0]), float(centre[1]), math.exp(0.5 * solution[0]), swap @ covariance_px @ swap.T


def _correlation(relative: FloatArray, rows: npt.NDArray[np.intp], columns: npt.NDArray[np.intp]) -> FloatArray:
    """(n, n) correlation between pixels, from the image's background: peaks are clipped to exclude the source."""
    calm = np.minimum(relative, 6.0)
    calm = calm - calm.mean()
    spans = int(np.ptp(rows)), int(np.ptp(columns))
    shape = [length + span for length, span in zip(calm.shape, spans, strict=True)]
    spectrum = np.fft.rfft2(calm, shape)
    raw = np.fft.irfft2(np.abs(spectrum) ** 2, shape)
    table = np.zeros((spans[0] + 1, spans[1] + 1))
    for i in range(spans[0] + 1):
        # Both diagonal directions: speckle need not be symmetric.
        table[i] = np.maximum(raw[i, : spans[1] + 1], raw[i, -np.arange(spans[1] + 1)])
    table /= raw[0, 0]
    # Set correlations within the chance level of this many pixels to zero.
    chance = 4.0 / math.sqrt(relative.size)
    table = np.where(table > chance, np.sqrt(np.clip(table, 0.0, 1.0)), 0.0)
    return np.asarray(table[np.abs(rows[:, None] - rows[None, :]), np.abs(columns[:, None] - columns[None, :])])
