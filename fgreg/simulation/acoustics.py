"""Channel data and envelope images of a point source received by the TRUS array.

Everything starts from positions in space: element i at stage angle t is at (x_i, R sin t, R cos t), the wave takes
|source - element| / c to arrive, one way. An element hears less off its axis, farther away, and when the source is off
the image plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from fgreg.geometry.transforms import FloatArray
from fgreg.model.session_model import ChannelModel, ProbeModel
from fgreg.simulation.array import TrueArray

ChannelArray = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Pulse:
    """The received pulse: a Gaussian envelope times a cosine; time 0 is the maximum of its (Hilbert) envelope.

    Attributes:
        centre_mhz: centre frequency.
        fractional_bandwidth: full width at half amplitude (-6 dB) of the spectrum, over the centre frequency.
        asymmetry: the envelope falls ``1 + asymmetry`` times as slowly as it rises (0: symmetric).
        phase_rad: of the carrier at time 0.
    """

    centre_mhz: float = 5.0
    fractional_bandwidth: float = 0.7
    asymmetry: float = 0.0
    phase_rad: float = 0.6

    @property
    def sigma_us(self) -> float:
        """Standard deviation of the rising side of the envelope."""
        sigma_mhz = self.fractional_bandwidth * self.centre_mhz / (2.0 * math.sqrt(2.0 * math.log(2.0)))
        return 1.0 / (2.0 * math.pi * sigma_mhz)

    @property
    def support_us(self) -> float:
        """Beyond this time from its maximum the pulse is below 1e-6."""
        return 5.5 * self.sigma_us * (1.0 + max(self.asymmetry, 0.0)) + abs(_envelope_peak_us(self))

    def waveform(self, time_us: FloatArray) -> FloatArray:
        """Amplitude at times after the maximum of the envelope; the envelope's maximum is 1."""
        return _waveform(self, np.asarray(time_us) + _envelope_peak_us(self))


def _waveform(pulse: Pulse, time_us: FloatArray) -> FloatArray:
    sigma = np.where(time_us > 0.0, pulse.sigma_us * (1.0 + pulse.asymmetry), pulse.sigma_us)
    carrier = np.cos(2.0 * math.pi * pulse.centre_mhz * time_us + pulse.phase_rad)
    return np.asarray(np.exp(-0.5 * (time_us / sigma) ** 2) * carrier)


@lru_cache(maxsize=32)
def _envelope_peak_us(pulse: Pulse) -> float:
    """Where the Hilbert envelope of the raw waveform peaks: not quite at 0 where it is asymmetric or short."""
    step = pulse.sigma_us / 200.0
    time = np.asarray((np.arange(8192) - 3000) * step, dtype=np.float64)
    spectrum = np.fft.fft(_waveform(pulse, time))
    spectrum[4097:] = 0.0
    spectrum[1:4096] *= 2.0
    envelope = np.abs(np.fft.ifft(spectrum))
    k = int(np.argmax(envelope))
    before, at, after = envelope[k - 1 : k + 2]
    return float(time[k] + step * 0.5 * (before - after) / (before - 2.0 * at + after))


@dataclass(frozen=True, slots=True)
class Elevation:
    """Amplitude as a function of the stage's rotation away from the source.

    ``threshold ** (|rotation / half_width| ** power)``: at the half width it reaches the threshold of hearing.
    """

    threshold: float = 0.5
    power: float = 2.0

    def amplitude(self, rotation_rad: FloatArray | float, half_width_rad: FloatArray | float) -> FloatArray:
        """Amplitude (1 in the plane) at rotation offsets, for half widths; shapes broadcast."""
        return np.asarray(self.threshold ** (np.abs(np.asarray(rotation_rad) / half_width_rad) ** self.power))


@dataclass(frozen=True, slots=True)
class Hearing:
    """Directivity and losses across the array.

    Attributes:
        element_width: of the pitch; sets the directivity sinc(width sin(angle) / wavelength) cos(angle).
        spreading: amplitude falls with distance to the power -spreading (1 spherical, 0.5 cylindrical).
        elevation: loss off the image plane; None if every source is received as if it were in the plane.
    """

    element_width: float = 0.9
    spreading: float = 1.0
    elevation: Elevation | None = field(default_factory=Elevation)


def element_positions(probe: ProbeModel, scan_rad: float, array: TrueArray | None = None) -> FloatArray:
    """TRUS positions (elements, 3), mm, in the order of the data's rows, at stage angle ``scan_rad``.

    ``array``: where it is mounted; as declared where None.
    """
    array = array or TrueArray.of(probe, {})
    x = array.pitch_ratio * probe.pitch_mm * (np.arange(probe.elements) - 0.5 * (probe.elements - 1))
    at = np.asarray(scan_rad)
    return np.asarray(array.middle_mm(at) + (-x if probe.flip else x)[:, None] * array.along(at))


def rotation_offset_rad(
    trus_p_mm: FloatArray, scan_rad: FloatArray | float, array: TrueArray | None = None
) -> FloatArray:
    """Turn of the stage (rad, TRUS convention) from ``scan_rad`` to where points (..., 3) are loudest.

    That brings them into the plane, but for an ``array`` whose window is not centred on it.
    """
    if array is None:
        offset = np.arctan2(trus_p_mm[..., 1], trus_p_mm[..., 2]) - scan_rad
    else:
        offset = array.rotation_rad(trus_p_mm, np.asarray(scan_rad))
    return np.asarray(np.remainder(offset + np.pi, 2.0 * np.pi) - np.pi)


def simulate_channels(
    probe: ProbeModel,
    trus_p_source_mm: FloatArray,
    scan_rad: float,
    rng: np.random.Generator,
    pulse: Pulse | None = None,
    snr_db: float = 15.0,
    samples: int = 1600,
    sound_speed_true_m_s: float | None = None,
    hearing: Hearing | None = None,
    half_width_rad: float | None = None,
    array: TrueArray | None = None,
) -> ChannelArray:
    """Channel data of one laser pulse, in units of the noise's standard deviation.

    Args:
        probe: with ``channels`` (sampling rate, time of sample 0, delay of the pulse).
        trus_p_source_mm: (3,).
        scan_rad: stage angle of the plane.
        rng: for the noise: white, standard deviation 1.
        snr_db: 20 log10 of (peak amplitude / sqrt 2) over the noise's standard deviation, on the element that hears
            the source loudest, *were the source in the plane*; with ``hearing.elevation`` a source off the plane is
            softer. With ``Hearing(elevation=None)`` it is the signal-to-noise ratio of this very frame.
        samples: per element.
        sound_speed_true_m_s: the tissue's; the probe's own where absent.
        half_width_rad: of the window at this depth; the probe's table where absent.
        array: where it is mounted, its pitch and the delay of its trigger (not the sound speed); as declared where
            absent.

    Returns:
        (elements, samples) float32.

    Raises:
        ValueError: the probe has no ``channels``.
    """
    channels = _channels_of(probe)
    pulse = pulse or Pulse()
    hearing = hearing or Hearing()
    speed_mm_us = (sound_speed_true_m_s or probe.sound_speed_m_s) * 1e-3
    source = np.asarray(trus_p_source_mm, dtype=np.float64)
    out = rng.standard_normal((probe.elements, samples), dtype=np.float32)
    array = array or TrueArray.of(probe, {})
    elements = element_positions(probe, scan_rad, array)
    amplitude = _element_amplitudes(probe, source, elements, pulse, hearing, speed_mm_us)
    loudest = math.sqrt(2.0) * 10.0 ** (snr_db / 20.0)
    amplitude *= loudest / amplitude.max()
    if hearing.elevation is not None:
        offset = float(rotation_offset_rad(source, scan_rad, array))
        if half_width_rad is None:
            depth = float(array.distance_mm(source, np.asarray(scan_rad)))
            half_width_rad = float(np.interp(depth, probe.sensitivity.depth_mm, probe.sensitivity.half_width_rad))
        amplitude *= float(hearing.elevation.amplitude(offset, half_width_rad))
    distance_mm = np.linalg.norm(source - elements, axis=1) - array.range_offset_mm
    centre = (distance_mm / speed_mm_us + channels.pulse_delay_us - channels.t0_us) * channels.sampling_mhz
    reach = math.ceil(pulse.support_us * channels.sampling_mhz) + 1
    index = np.rint(centre).astype(np.int64)[:, None] + np.arange(-reach, reach + 1)
    signal = amplitude[:, None] * pulse.waveform((index - centre[:, None]) / channels.sampling_mhz)
    row, column = np.nonzero((index >= 0) & (index < samples))
    out[row, index[row, column]] += signal[row, column].astype(np.float32)
    return out


def noise_channels(probe: ProbeModel, rng: np.random.Generator, samples: int = 1600) -> ChannelArray:
    """(elements, samples) of noise alone, standard deviation 1, without a source."""
    return rng.standard_normal((probe.elements, samples), dtype=np.float32)


def quantised(channels: ChannelArray, counts_per_unit: float = 12.0) -> npt.NDArray[np.int16]:
    """Channel data as int16, as a converter would deliver; ``counts_per_unit`` counts per noise standard deviation."""
    return np.asarray(np.clip(np.rint(channels * counts_per_unit), -32768, 32767).astype(np.int16))


def simulate_envelope_image(
    probe: ProbeModel,
    trus_p_source_mm: FloatArray,
    scan_rad: float,
    rng: np.random.Generator,
    shape: tuple[int, int] = (512, 256),
    pulse: Pulse | None = None,
    snr_db: float = 15.0,
    sound_speed_true_m_s: float | None = None,
    hearing: Hearing | None = None,
    half_width_rad: float | None = None,
) -> ChannelArray:
    """A beamformed, scan-converted envelope image with Rician noise, in units of the noise's standard deviation.

    The point's image is the pulse's envelope along range and a Gaussian as wide as diffraction leaves it across
    (wavelength times range over the array's length). Where the assumed sound speed is wrong the range is scaled.

    Args:
        probe: with ``image`` (pixel pitch, centre of pixel [0, 0]).
        shape: (depth, lateral) pixels.
        snr_db: of the peak in the image for a source in the plane; the rest as in :func:`simulate_channels`.

    Returns:
        (depth, lateral) float32, >= 0.

    Raises:
        ValueError: the probe has no ``image``.
    """
    if probe.image is None:
        raise ValueError("the probe has no image geometry (probe.image)")
    pulse = pulse or Pulse()
    hearing = hearing or Hearing()
    true_speed = sound_speed_true_m_s or probe.sound_speed_m_s
    source = np.asarray(trus_p_source_mm, dtype=np.float64)
    middle = np.array([0.0, probe.radius_mm * math.sin(scan_rad), probe.radius_mm * math.cos(scan_rad)])
    distance_mm = math.hypot(source[1] - middle[1], source[2] - middle[2])
    amplitude = math.sqrt(2.0) * 10.0 ** (snr_db / 20.0)
    if hearing.elevation is not None:
        offset = float(rotation_offset_rad(source, scan_rad))
        if half_width_rad is None:
            half_width_rad = float(np.interp(distance_mm, probe.sensitivity.depth_mm, probe.sensitivity.half_width_rad))
        amplitude *= float(hearing.elevation.amplitude(offset, half_width_rad))
    range_mm = distance_mm * probe.sound_speed_m_s / true_speed
    z = probe.image.origin_mm[0] + probe.image.pixel_mm[0] * np.arange(shape[0])
    x = probe.image.origin_mm[1] + probe.image.pixel_mm[1] * np.arange(shape[1])
    axial_mm = pulse.sigma_us * probe.sound_speed_m_s * 1e-3
    wavelength_mm = probe.sound_speed_m_s * 1e-3 / pulse.centre_mhz
    lateral_mm = max(0.5 * wavelength_mm * range_mm / (probe.elements * probe.pitch_mm), 0.3 * probe.pitch_mm)
    along = np.where(z > range_mm, axial_mm * (1.0 + pulse.asymmetry), axial_mm)
    axial = np.exp(-0.5 * ((z - range_mm) / along) ** 2)
    lateral = np.exp(-0.5 * ((x - source[0]) / lateral_mm) ** 2)
    noise = rng.standard_normal((2, *shape), dtype=np.float32)
    signal = (amplitude * np.outer(axial, lateral)).astype(np.float32)
    return np.asarray(np.hypot(signal + noise[0], noise[1]))


def _channels_of(probe: ProbeModel) -> ChannelModel:
    if probe.channels is None:
        raise ValueError("the probe has no channel sampling (probe.channels)")
    return probe.channels


def _element_amplitudes(
    probe: ProbeModel, source: FloatArray, elements: FloatArray, pulse: Pulse, hearing: Hearing, speed_mm_us: float
) -> FloatArray:
    """Relative amplitude on each element of a source, but for the loss off the plane."""
    away = source - elements
    distance = np.linalg.norm(away, axis=1)
    sine = np.abs(away[:, 0]) / distance
    width_in_wavelengths = hearing.element_width * probe.pitch_mm * pulse.centre_mhz / speed_mm_us
    # A broadband pulse has no nulls: the sinc stops at a floor.
    directivity = np.maximum(np.sinc(width_in_wavelengths * sine), 0.05) * np.sqrt(1.0 - sine**2)
    return np.asarray(directivity / distance**hearing.spreading)
