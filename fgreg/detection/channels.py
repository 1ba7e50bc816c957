"""Preprocessing of channel data: live channels, removal of flat waves, muting, complex baseband in a frequency band.

Arrays are (elements, samples); times in us after the laser pulse, frequencies in MHz.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import fft as scipy_fft

from fgreg.errors import EstimationError
from fgreg.geometry.transforms import BoolArray, FloatArray
from fgreg.model.probe_model import ChannelModel

Complex64Array = npt.NDArray[np.complex64]
Float32Array = npt.NDArray[np.float32]

PAD_US = 2.0
"""Zero padding after the record, against wrap-around of the circular filters."""
MIN_RATE_MHZ = 30.0
"""Least sampling rate of the baseband: linear interpolation of an envelope has no relevant error at it."""
LOUD = 2.0
"""A channel this many times noisier than the median channel is scaled down to it."""


@dataclass(frozen=True, slots=True)
class Band:
    """A Gaussian pass band: centre and standard deviation (MHz) of its amplitude response."""

    centre_mhz: float
    sigma_mhz: float


@dataclass(frozen=True, slots=True, eq=False)
class Channels:
    """Cleaned channel data.

    Attributes:
        spectrum: (elements, bins) one-sided spectrum of the zero-padded records.
        live: (elements,) channels that are not constant.
        samples, padded: length of the record and of its transform.
        sampling_mhz: of the record.
        start_us: arrival time, less the pulse delay, of a wave whose maximum is at sample 0.
        noise: standard deviation of a sample, robust over the live channels, frame's units.
        peak: largest sample, frame's units.
        kept: share of the live channels' samples that are not muted.
    """

    spectrum: Complex64Array
    live: BoolArray
    samples: int
    padded: int
    sampling_mhz: float
    start_us: float
    noise: float
    peak: float
    kept: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Baseband:
    """Complex envelopes of all channels in one band: the analytic signal is ``data * exp(2j pi carrier t)``.

    Attributes:
        data: (samples + 1, elements), time first; the last row is zero and stands for "outside the record".
        rate_mhz: sampling of ``data``; row 0 is at ``start_us``.
        carrier_mhz: frequency of the demodulation.
        start_us: as in :class:`Channels`.
        variance: of the complex noise, the median over the channels.
    """

    data: Complex64Array
    rate_mhz: float
    carrier_mhz: float
    start_us: float
    variance: float


def prepare_channels(frame: npt.NDArray[Any], sampling: ChannelModel) -> Channels:
    """Subtract offsets, find dead channels, scale noisy ones down.

    Args:
        frame: (elements, samples) real numbers, finite.
        sampling: rate and time origin of the samples.

    Raises:
        EstimationError: every channel is dead (constant): nothing was recorded.
    """
    data = np.array(frame, dtype=np.float32)
    # A dead channel is constant, whatever its offset.
    live = np.asarray(np.ptp(data, axis=1) > 0.0)
    if not live.any():
        raise EstimationError("all channels are constant: nothing was recorded")
    data -= data.mean(axis=1, keepdims=True)
    data[~live] = 0.0
    noise_each = np.zeros(data.shape[0])
    noise_each[live] = 1.4826 * np.median(np.abs(data[live, ::2]), axis=1)
    noise = float(np.median(noise_each[live]))
    peak = float(np.abs(data).max())
    loud = live & (noise_each > max(LOUD * noise, 1e-3 * peak))
    if loud.any() and noise > 0.0:
        data[loud] *= (noise / noise_each[loud])[:, None].astype(np.float32)
    samples = data.shape[1]
    padded = int(scipy_fft.next_fast_len(samples + math.ceil(PAD_US * sampling.sampling_mhz), real=True))
    return Channels(
        spectrum=np.asarray(scipy_fft.rfft(data, padded, axis=1)),
        live=live,
        samples=samples,
        padded=padded,
        sampling_mhz=sampling.sampling_mhz,
        start_us=sampling.t0_us - sampling.pulse_delay_us,
        noise=noise,
        peak=peak,
    )


def without_flat_wave(channels: Channels, span_us: tuple[float, float], elements: slice) -> Channels:
    """The channels without what these elements receive at the same time, each channel by its own gain.

    Args:
        span_us: first and last time of the flat wave, as arrival times.
        elements: the elements that give its shape; it is removed from all.
    """
    data = _samples(channels)
    first, last = (round((time - channels.start_us) * channels.sampling_mhz) for time in span_us)
    window = slice(max(0, first), max(0, last) + 1)
    pattern = data[elements][channels.live[elements], window].mean(axis=0)
    power = float(pattern @ pattern)
    if power > 0.0:
        data[:, window] -= np.outer(data[:, window] @ pattern / power, pattern)
    return replace(channels, spectrum=np.asarray(scipy_fft.rfft(data, channels.padded, axis=1)))


def muted(channels: Channels, from_us: FloatArray, until_us: FloatArray) -> Channels:
    """The channels with zeros between two times (elements,) each, as arrival times."""
    data = _samples(channels)
    time_us = channels.start_us + np.arange(channels.samples) / channels.sampling_mhz
    quiet = (time_us >= from_us[:, None]) & (time_us <= until_us[:, None])
    data[quiet] = 0.0
    return replace(
        channels,
        spectrum=np.asarray(scipy_fft.rfft(data, channels.padded, axis=1)),
        kept=channels.kept * (1.0 - float(quiet[channels.live].mean())),
    )


def _samples(channels: Channels) -> Float32Array:
    return np.asarray(scipy_fft.irfft(channels.spectrum, channels.padded, axis=1)[:, : channels.samples])


def baseband(channels: Channels, band: Band) -> Baseband:
    """Complex envelopes of all channels in a pass band, resampled to a lower rate that an envelope needs.

    The filter has zero phase: it does not move the maximum of a symmetric envelope.
    """
    step = channels.sampling_mhz / channels.padded
    nyquist = channels.sampling_mhz / 2.0
    low = max(1, math.ceil((band.centre_mhz - 4.0 * band.sigma_mhz) / step))
    high = min(channels.spectrum.shape[1] - 1, math.floor(min(band.centre_mhz + 4.0 * band.sigma_mhz, nyquist) / step))
    carrier = round(min(band.centre_mhz, nyquist) / step)
    length = channels.padded
    rate = channels.sampling_mhz
    if rate > 1.5 * MIN_RATE_MHZ or rate < MIN_RATE_MHZ:
        length = int(scipy_fft.next_fast_len(max(high - low + 1, math.ceil(MIN_RATE_MHZ / step))))
        rate = length * step
    bins = np.arange(low, high + 1)
    gain = np.exp(-0.5 * ((bins * step - band.centre_mhz) / band.sigma_mhz) ** 2) * (2.0 * length / channels.padded)
    shifted = np.zeros((channels.spectrum.shape[0], length), dtype=np.complex64)
    shifted[:, (bins - carrier) % length] = channels.spectrum[:, low : high + 1] * gain.astype(np.float32)
    kept = min(length, math.ceil(channels.samples * rate / channels.sampling_mhz))
    data = np.zeros((kept + 1, channels.live.size), dtype=np.complex64)
    data[:kept] = np.asarray(scipy_fft.ifft(shifted, axis=1, overwrite_x=True))[:, :kept].T
    # |complex Gaussian|^2 is exponential: its median is log 2 times its mean. A source fills few of the samples; of
    # muted samples, which are zero, the quantile is reckoned without.
    power = np.abs(data[:kept:4, channels.live]) ** 2
    variance = float(np.median(power)) / math.log(2.0 * max(channels.kept, 0.6))
    return Baseband(data, rate, carrier * step, channels.start_us, max(variance, 1e-14 * float(power.max())))


def phasor(phase_rad: Float32Array) -> Complex64Array:
    """exp(i phase); 50 times faster than the complex exponential."""
    out = np.empty(phase_rad.shape, dtype=np.complex64)
    np.cos(phase_rad, out=out.real)
    np.sin(phase_rad, out=out.imag)
    return out


def check_frame(frame: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Check that a frame is two-dimensional, not empty, real and finite; returns it as an array.

    Raises:
        ValueError: it is not; the message gives its shape or type.
    """
    data = np.asarray(frame)
    if data.ndim != 2 or 0 in data.shape:
        raise ValueError(f"a frame of shape {data.shape}, expected two dimensions, none of them empty")
    if data.dtype.kind not in "iuf":
        raise ValueError(f"a frame of type {data.dtype}, expected real numbers (float32 or int16)")
    if data.dtype.kind == "f" and not np.isfinite(data).all():
        raise ValueError(f"a frame with {int((~np.isfinite(data)).sum())} entries that are not finite")
    return data
