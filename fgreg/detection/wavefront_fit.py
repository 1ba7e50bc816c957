"""Fit of a spherical wavefront to channel data: source x, arrival at the apex, ratio of sound speeds.

With q = assumed speed times arrival time, a source at x whose wave reaches the apex at q = r obeys, for a true speed
``ratio`` times the assumed one, ``q_i^2 = r^2 + ((x - x_i) / ratio)^2``. All channels carry the same unknown pulse s:
``b_i(t) = a_i s(t - q_i / c)``. There are two kinds of information, independent in white noise:

* *relative* delays, to a fraction of a period: with the channels shifted by the current delays, the weighted mean S is
  the pulse, and ``delta_i = -Re <S', b_i - a_i S> / (a_i <S', S'>)`` is each channel's remaining delay. That is linear
  in the data, so it also works where each single channel is below its noise;
* the *absolute* time, which for an unknown pulse is a definition: the maximum of the envelope of S.

Gauss-Newton on both gives (x, r, ratio) and, from the noise's measured autocovariance, their covariance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import fft as scipy_fft

from fgreg.detection.channels import MIN_RATE_MHZ, Band, Baseband, Channels, Complex64Array, baseband, phasor
from fgreg.detection.wavefront_search import RATIO_SIGMA
from fgreg.errors import EstimationError
from fgreg.geometry.transforms import BoolArray, FloatArray

Complex128Array = npt.NDArray[np.complex128]

WIDE_BAND = Band(5.0, 3.0)
RATIO_FLOOR = 2e-4
"""Standard deviation added to the ratio of sound speeds for the same errors as FLOOR_MM."""
FLOOR_MM = 0.0003
"""Standard deviation added to x and range for errors of sampling, interpolation and filters."""
SMOOTHINGS = (1.0, 1.4, 2.0, 3.0, 4.5, 7.0)
"""Widths of the filters before the envelope's maximum is taken, in widths of the pulse's spectrum."""
ASYMMETRY = 0.12
"""Shift of a pulse's maximum under a matched filter, as a share of its length, standard deviation: 0 for a symmetric
pulse, 0.10 for one that falls 1.25 times as slowly as it rises, 0.19 for 1.5 times (measured without noise)."""
LINEAR = 0.3
"""Curvature of the noise over the pulse's at its maximum up to which the maximum is about linear in the noise."""
MISMATCH = 0.07
"""Share of that shift that is not proportional to one over the filter's width."""
FINE_RATE_MHZ = 100.0
MAX_SIGNAL_MHZ = 16.0
SIGNIFICANT = 3.0
"""An element receives the wave if its gain exceeds this many standard deviations."""
ITERATIONS = 8
SETTLED = 0.03
"""Converged where the step is below this many standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class WavefrontFit:
    """Result of :func:`fit_wavefront`; x and range mm, covariance (2, 2), ratio without the prior on it.

    ``gain`` (elements,): the wave's amplitude in each element's channel, relative; ``amplitude`` at the strongest.
    ``misfit``: squared remaining delays over their variance, per degree of freedom; ``beyond_noise_us``: RMS of the
    remaining delays less the noise.
    """

    x_mm: float
    range_mm: float
    covariance: FloatArray
    ratio: float
    ratio_sigma: float
    amplitude: float
    gain: FloatArray
    elements_used: int
    misfit: float
    beyond_noise_us: float
    band: Band


@dataclass(frozen=True, slots=True, eq=False)
class _Noise:
    """Autocovariance of the complex noise at lags 0, 1, ... of the baseband, conj(n[k]) n[k + lag] averaged."""

    lag: Complex128Array

    def of(self, functional: Complex64Array) -> float:
        """Variance of Re <functional, noise>."""
        functional = functional.astype(np.complex128)
        spread = np.correlate(functional, functional, mode="full")
        middle = functional.size - 1
        lags = self.lag[: functional.size]
        total = spread[middle].real * lags[0].real + 2.0 * float(np.sum((spread[middle + 1 :].conj() * lags[1:]).real))
        return max(0.5 * float(total), 0.0)


def path_mm(x_mm: float, range_mm: float, ratio: float, element_x_mm: FloatArray) -> FloatArray:
    """Arrival times times assumed speed, (elements,), mm."""
    return np.asarray(np.hypot(range_mm, (x_mm - element_x_mm) / ratio))


def path_jacobian(x_mm: float, range_mm: float, ratio: float, element_x_mm: FloatArray) -> FloatArray:
    """(elements, 3) derivatives of :func:`path_mm` by x, range and ratio."""
    aside = x_mm - element_x_mm
    path = path_mm(x_mm, range_mm, ratio, element_x_mm)
    return np.column_stack([aside / ratio**2 / path, range_mm / path, -(aside**2) / ratio**3 / path])


def aligned(signal: Baseband, delay_us: FloatArray, half: int) -> Complex64Array:
    """Channels shifted so that a wave with these arrival times is at the middle of every row.

    Args:
        delay_us: (elements,) arrival times.
        half: half width of the window, in samples of the baseband.

    Returns:
        (elements, 2 half + 1), carrier at zero phase at the middle, cubic interpolation between samples.
    """
    outside = signal.data.shape[0] - 1
    position = (delay_us - signal.start_us) * signal.rate_mhz
    whole = np.floor(position).astype(np.intp)
    f = (position - whole)[:, None].astype(np.float32)
    row = whole[:, None] + np.arange(-half - 1, half + 3)[None, :]
    row[(row < 0) | (row > outside)] = outside
    block = signal.data[row, np.arange(delay_us.size)[:, None]]
    taps = (
        -f * (f - 1) * (f - 2) / 6,
        (f + 1) * (f - 1) * (f - 2) / 2,
        -(f + 1) * f * (f - 2) / 2,
        (f + 1) * f * (f - 1) / 6,
    )
    width = 2 * half + 1
    turn = np.exp(2j * np.pi * signal.carrier_mhz * (delay_us - signal.start_us)).astype(np.complex64)[:, None]
    return np.asarray(turn * sum(tap * block[:, k : k + width] for k, tap in enumerate(taps)))


def pulse_band(pulse: Complex128Array, noise_power: FloatArray, carrier_mhz: float, rate_mhz: float) -> Band:
    """Centre and width of the pulse's spectrum from a noisy pulse.

    Moments of the squared power spectrum, less the noise's power: squaring suppresses noise in the tails; for a
    Gaussian amplitude spectrum of standard deviation s the squared power has s / 2.
    """
    size = 4 * pulse.size
    frequency = carrier_mhz + np.fft.fftfreq(size, 1.0 / rate_mhz)
    power = np.clip(np.abs(np.fft.fft(pulse, size)) ** 2 - noise_power, 0.0, None) ** 2
    power[(frequency < 0.5) | (frequency > 15.0) | (power < 0.02 * power.max())] = 0.0
    if not power.any():
        return Band(carrier_mhz, 1.5)
    centre = float(power @ frequency / power.sum())
    width = 2.0 * math.sqrt(float(power @ (frequency - centre) ** 2 / power.sum()))
    return Band(min(max(centre, 1.5), 10.0), min(max(width, 0.4), 2.8))


def _gains(
    window: Complex64Array, pulse: Complex64Array, noise: _Noise, audible: BoolArray, element_x_mm: FloatArray
) -> FloatArray:
    """Amplitude of the pulse in each channel, smoothed along the array; zero where not audible or not significant.

    An element that does not receive the wave must not enter: its delays are noise, and far elements have the largest
    effect on the ratio of sound speeds.
    """
    energy = float((np.abs(pulse) ** 2).sum())
    raw = np.where(audible, (window @ pulse.conj()).real / energy, 0.0)
    width = np.ptp(element_x_mm) / 24.0
    near = np.exp(-0.5 * ((element_x_mm[:, None] - element_x_mm[None, :]) / width) ** 2) * audible[None, :]
    near /= np.maximum(near.sum(axis=1, keepdims=True), 1e-9)
    smooth = near @ raw
    sigma = np.sqrt(noise.of(pulse) * (near**2).sum(axis=1)) / energy
    return np.where(audible & (smooth > SIGNIFICANT * sigma) & (smooth > 0.05 * smooth.max()), smooth, 0.0)


def _mean_pulse(window: Complex64Array, gain: FloatArray) -> Complex64Array:
    return np.asarray((gain / float((gain**2).sum())).astype(np.float32) @ window)


def _noise_about(signal: Baseband, delay_us: FloatArray, live: BoolArray, guard_us: float, lags: int) -> _Noise:
    """Autocovariance of the noise in the live channels, from all samples further than ``guard_us`` from the wave."""
    kept = signal.data.shape[0] - 1
    channels = np.flatnonzero(live)[::2]
    time = signal.start_us + np.arange(kept) / signal.rate_mhz
    quiet = np.abs(time[:, None] - delay_us[None, channels]) > guard_us
    if quiet.mean() < 0.25:
        # The record is hardly longer than the pulse: use the median noise level, without correlation.
        flat = np.zeros(lags, dtype=np.complex128)
        flat[0] = signal.variance
        return _Noise(flat)
    size = int(scipy_fft.next_fast_len(kept + lags))
    spectrum = scipy_fft.fft(np.where(quiet, signal.data[:kept, channels], 0), size, axis=0)
    total = np.fft.ifft((np.square(spectrum.real) + np.square(spectrum.imag)).sum(axis=1, dtype=np.float64))[:lags]
    lag = total / np.maximum(_pairs_of(quiet, lags), 1.0)
    lag[0] = max(lag[0].real, 1e-3 * signal.variance)
    return _Noise(lag)


def _pairs_of(quiet: BoolArray, lags: int) -> FloatArray:
    """Number (lags,) of pairs of quiet samples (samples, channels) this far apart; each channel is loud once."""
    samples, loud = len(quiet), np.count_nonzero(~quiet, axis=0)
    first = np.argmin(quiet, axis=0)
    lag = np.arange(lags)[:, None]
    # Of all pairs: less those whose earlier sample is loud, or the later one, and again with those of which both are.
    earlier = np.clip(samples - lag - first, 0, loud)
    later = np.clip(first + loud - lag, 0, loud)
    both = np.maximum(loud - lag, 0)
    return np.asarray((samples - lag - earlier - later + both).sum(axis=1), dtype=np.float64)


def _aligned_spectrum(channels: Channels, delay_us: FloatArray, gain: FloatArray) -> tuple[FloatArray, Complex128Array]:
    """Spectrum of the pulse, no filter: channels shifted by their arrival times and averaged with ``gain`` as weights.

    Returns:
        frequencies (MHz, whole multiples of their spacing) and the one-sided spectrum; the pulse is at time 0.
    """
    step = channels.sampling_mhz / channels.padded
    high = min(channels.spectrum.shape[1], math.ceil(MAX_SIGNAL_MHZ / step))
    low = max(1, round(0.3 / step))
    frequency = step * np.arange(low, high)
    used = np.flatnonzero(gain)
    phase = (2 * np.pi * (delay_us[used] - channels.start_us))[:, None] * frequency[None, :]
    shifted = channels.spectrum[used, low:high] * phasor(phase.astype(np.float32))
    return frequency, np.asarray(gain[used] @ shifted / float((gain**2).sum()), dtype=np.complex128)


def _band_of_pulse(frequency: FloatArray, spectrum: Complex128Array, padded: int) -> Band:
    """The band of the pulse that is at time 0 of :func:`_aligned_spectrum`."""
    step = frequency[1] - frequency[0]
    carrier = round(WIDE_BAND.centre_mhz / step)
    size = int(scipy_fft.next_fast_len(max(frequency.size, math.ceil(MIN_RATE_MHZ / step))))
    rate = size * step
    bins = np.zeros(size, dtype=np.complex128)
    gains = np.exp(-0.5 * ((frequency - WIDE_BAND.centre_mhz) / WIDE_BAND.sigma_mhz) ** 2) * (2.0 * size / padded)
    bins[(round(frequency[0] / step) - carrier + np.arange(frequency.size)) % size] = spectrum * gains
    pulse = np.asarray(scipy_fft.ifft(bins))
    half, away = round(1.2 * rate), round(3.8 * rate)
    window = np.arange(-half, half + 1)
    beside = [pulse[(window + middle) % size] for middle in (-away, away)]
    longer = 4 * window.size
    floor = float(np.mean([np.abs(np.fft.fft(part, longer)) ** 2 for part in beside]))
    return pulse_band(pulse[window % size], np.full(longer, floor), carrier * step, rate)


def _envelope_maximum(
    frequency: FloatArray, spectrum: Complex128Array, band: Band, padded: int, sampling_mhz: float
) -> tuple[float, float, float]:
    """Maximum of the pulse's envelope: time after the expected one (us), its sigma, and the height.

    A matched filter is optimal for a symmetric envelope, but shifts the maximum of an asymmetric one. Less smoothing
    gives less shift and more noise. So the maximum is taken after filters of several widths w (in widths of the
    pulse's spectrum). The shift is proportional to 1 / w with one unknown factor that has a prior. Generalised least
    squares over all filters tends to the matched filter where noise dominates and to the bare envelope without noise.

    Raises:
        EstimationError: there is no maximum near the expected time.
    """
    step = frequency[1] - frequency[0]
    first = round(frequency[0] / step)
    carrier = round(band.centre_mhz / step)
    size = int(scipy_fft.next_fast_len(math.ceil(FINE_RATE_MHZ / step)))
    rate = size * step
    pulse_us = 1.0 / (2 * np.pi * band.sigma_mhz)
    offset = frequency - carrier * step
    gains = np.exp(
        -0.5 * ((frequency - band.centre_mhz)[None, :] / (np.array(SMOOTHINGS)[:, None] * band.sigma_mhz)) ** 2
    )
    bins = np.zeros((2, len(SMOOTHINGS), size), dtype=np.complex64)
    place = (first - carrier + np.arange(frequency.size)) % size
    bins[0][:, place] = spectrum * gains * (2.0 * size / padded)
    bins[1][:, place] = bins[0][:, place] * (2j * np.pi * offset)
    signals, slopes = np.asarray(scipy_fft.ifft(bins, axis=2, overwrite_x=True))
    guard = math.ceil(6 * pulse_us * rate)
    quiet = slopes[:, guard : min(size - guard, guard + round(0.8 * padded / sampling_mhz * rate)) : 3]
    if quiet.shape[1] < 10:
        raise EstimationError("the record is too short to separate the wave from the noise")
    noise = np.sqrt(0.5 / math.log(2.0) * np.median(quiet.real**2 + quiet.imag**2, axis=1))
    middle, reach = 0, math.ceil((1.5 * pulse_us + 0.25) * rate)
    width = max(1, round(0.2 * pulse_us * rate))
    times: list[float] = []
    sigmas: list[float] = []
    height = 0.0
    # RMS angular frequency of the filtered noise's slope: times sigma, it is the noise's curvature over the pulse's.
    rapidities = 2 * np.pi * np.sqrt((gains**2 @ offset**4) / (gains**2 @ offset**2))
    for smoothing, signal, level, rapidity in zip(SMOOTHINGS, signals, noise, rapidities, strict=True):
        envelope = np.abs(signal[np.arange(middle - reach - width, middle + reach + width + 1) % size])
        at = width + int(np.argmax(envelope[width : envelope.size - width]))
        left, centre, right = (math.log(max(float(envelope[at + k]), 1e-300)) for k in (-width, 0, width))
        bend = left - 2 * centre + right
        if bend >= 0.0:
            break
        middle = middle - reach - width + at
        # Curvature of a Gaussian pulse after this filter: noise can make a peak sharper than the pulse.
        expected = smoothing**2 / (1.0 + smoothing**2) / pulse_us**2
        sigma = float(level) / (math.exp(centre) * min(-bend * (rate / width) ** 2, expected))
        if times and sigma * rapidity > LINEAR:
            break
        sigmas.append(sigma)
        times.append((middle + 0.5 * (left - right) / bend * width) / rate)
        if not height:
            height = math.exp(centre) * math.sqrt(1.0 + smoothing**-2)
        reach = math.ceil(0.7 * pulse_us * rate)
    if not times:
        raise EstimationError("the wave has no maximum near the expected time")
    count = len(times)
    weighted = gains[:count] * offset
    correlation = weighted @ weighted.T
    correlation /= np.sqrt(np.outer(np.diag(correlation), np.diag(correlation)))
    shift = ASYMMETRY * pulse_us / np.array(SMOOTHINGS[:count])
    covariance = np.outer(sigmas, sigmas) * correlation + np.outer(shift, shift) + np.diag((MISMATCH * shift) ** 2)
    weight = np.linalg.solve(covariance, np.ones(count))
    best = float(weight @ times / weight.sum())
    rest = np.array(times) - best
    contradiction = max(1.0, float(rest @ np.linalg.solve(covariance, rest)) / max(count - 1, 1))
    return best, math.sqrt(contradiction / float(weight.sum())), height


def _correlated_elements(residual: FloatArray) -> float:
    """Correlation length of a residual in elements: 1 + 2 sum of its autocorrelation up to where that ends."""
    together = 1.0
    power = float(residual @ residual)
    for lag in range(1, residual.size // 2):
        correlation = float(residual[:-lag] @ residual[lag:]) / power
        if correlation < 0.1:
            break
        together += 2.0 * correlation
    return together


def fit_wavefront(
    channels: Channels,
    element_x_mm: FloatArray,
    speed_mm_us: float,
    x_mm: float,
    range_mm: float,
    ratio: float,
    ratio_sigma: float = RATIO_SIGMA,
) -> WavefrontFit:
    """Maximum-likelihood fit from a start within half a period at most elements.

    Args:
        element_x_mm: (elements,) TRUS x.
        speed_mm_us: assumed.
        x_mm, range_mm, ratio: start.
        ratio_sigma: prior on the ratio about 1.

    Raises:
        EstimationError: the fit leaves the frame, or does not converge.
    """
    state = np.array([x_mm, range_mm, ratio])
    path = path_mm(state[0], state[1], state[2], element_x_mm)
    delay_us = path / speed_mm_us
    gain = np.where(channels.live, (range_mm / path) ** 2, 0.0)
    band = _band_of_pulse(*_aligned_spectrum(channels, delay_us, gain), channels.padded)

    signal = baseband(channels, Band(band.centre_mhz, 1.6 * band.sigma_mhz))
    spread_us = 1.2 / (2 * np.pi * band.sigma_mhz)
    half = math.ceil(3.0 * spread_us * signal.rate_mhz)
    record_us = channels.samples / channels.sampling_mhz
    noise = _noise_about(signal, delay_us, channels.live, 5.0 * spread_us, 2 * half + 1)
    information = np.zeros((3, 3))
    absolute = relative = np.zeros((3, 3))
    prior = np.diag([0.0, 0.0, ratio_sigma**-2])
    height, misfit = 0.0, 1.0
    for iteration in range(ITERATIONS):
        path = path_mm(state[0], state[1], state[2], element_x_mm)
        delay_us = path / speed_mm_us
        elapsed = delay_us - channels.start_us
        audible = channels.live & (elapsed > spread_us) & (elapsed < record_us - spread_us)
        audible &= np.abs(element_x_mm - state[0]) < 2.5 * state[1]
        if audible.sum() < 4:
            raise EstimationError("the wavefront is hardly inside the record")
        window = aligned(signal, delay_us, half)
        if iteration == 0:
            gain = np.where(audible, (state[1] / path) ** 2, 0.0)
        gain = _gains(window, _mean_pulse(window, gain), noise, audible, element_x_mm)
        used = gain > 0.0
        if used.sum() < 4:
            raise EstimationError("too few elements receive the wavefront")
        pulse = _mean_pulse(window, gain)
        slope = np.gradient(pulse) * signal.rate_mhz + 2j * np.pi * signal.carrier_mhz * pulse
        energy = float((np.abs(slope) ** 2).sum())
        lateness = np.zeros(gain.size)
        beyond = (window @ slope.conj()).real[used] - gain[used] * float(np.vdot(slope, pulse).real)
        lateness[used] = -beyond / (gain[used] * energy)
        weight = gain**2 * energy**2 / max(noise.of(slope), 1e-300)
        off_us, off_sigma_us, height = _envelope_maximum(
            *_aligned_spectrum(channels, delay_us, gain), band, channels.padded, channels.sampling_mhz
        )
        jacobian = path_jacobian(state[0], state[1], state[2], element_x_mm) / speed_mm_us
        mean = weight @ jacobian / weight.sum()
        centred = jacobian - mean
        late = lateness - weight @ lateness / weight.sum()
        relative = centred.T @ (weight[:, None] * centred)
        absolute = np.outer(mean, mean) / off_sigma_us**2
        information = relative + absolute + prior
        right = (
            centred.T @ (weight * late) + mean * off_us / off_sigma_us**2 + prior @ (np.array([0.0, 0.0, 1.0]) - state)
        )
        step = np.linalg.solve(information, right)
        left_over = late - centred @ step
        misfit = float(weight @ left_over**2) / max(int(used.sum()) - 4, 1)
        step = np.clip(step, [-0.5, -0.8, -0.03], [0.5, 0.8, 0.03])
        state = state + step
        if not (np.isfinite(state).all() and 0.5 < state[1] < 310.0 and 0.8 < state[2] < 1.25):
            raise EstimationError("the fit of the wavefront does not converge")
        if np.abs(step[:2]).max() < 0.02 and float(np.max(step**2 * np.diag(information))) < SETTLED**2:
            break
    # Errors beyond the noise (a lens, layers of another speed) are correlated over neighbouring elements: correlated
    # elements count as one, and the errors move the mean, hence the range, too.
    count = int(used.sum())
    beyond_us = math.sqrt(max(misfit - 1.0, 0.0) * max(count - 4, 1) / float(weight.sum()))
    scale, common_us2 = max(1.0, misfit), 0.0
    if misfit > 1.0 + 3.0 * math.sqrt(2.0 / count):
        together = _correlated_elements((left_over * np.sqrt(weight))[used])
        scale = 1.0 + (misfit - 1.0) * together
        common_us2 = beyond_us**2 * min(1.0, together / count)
    information = relative / scale + absolute / (1.0 + common_us2 / off_sigma_us**2)
    covariance = np.linalg.inv(information + prior)[:2, :2] + np.eye(2) * FLOOR_MM**2
    # The ratio from the data alone: its information with x and range free, and the prior removed.
    own = information[2, 2] - information[2, :2] @ np.linalg.solve(information[:2, :2], information[:2, 2])
    alone = state[2] + (state[2] - 1.0) * ratio_sigma**-2 / own
    return WavefrontFit(
        x_mm=float(state[0]),
        range_mm=float(state[1]),
        covariance=covariance,
        ratio=float(alone),
        ratio_sigma=math.hypot(1.0 / math.sqrt(own), RATIO_FLOOR),
        amplitude=height * float(gain.max()),
        gain=gain,
        elements_used=int((gain > 0.1 * gain.max()).sum()),
        misfit=misfit,
        beyond_noise_us=beyond_us,
        band=band,
    )
