"""Channel data and envelope images of a point source received by the TRUS array.

Everything starts from positions in space: element i at stage angle t is at (x_i, R sin t, R cos t), the wave takes
|source - element| / c to arrive, one way. An element hears less off its axis, farther away, and when the source is off
the image plane. Options add what else a record holds: reflections, pick-up of the trigger, sound made at the probe's
face.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from fgreg.geometry.transforms import FloatArray
from fgreg.model.probe_model import ChannelModel, ProbeModel
from fgreg.simulation.array import TrueArray

ChannelArray = npt.NDArray[np.float32]
MOST_ELEVATION_RAD = math.radians(30.0)
"""Angle off the plane up to which strips of an element are fine enough."""


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
class ElementHeight:
    """A rectangular element across the image plane, in strips: each receives the wave at its own time.

    Far from the element that is the mean over a time H sin(angle) / c of the wave that a point would receive.

    Attributes:
        height_mm: H.
        focus_mm: distance at which the lens brings the wave of a source in the plane together.
    """

    height_mm: float
    focus_mm: float = math.inf

    def strips(self, pulse: Pulse, speed_mm_us: float) -> FloatArray:
        """(n, 2) where the strips are across the plane, and the lens' delay in each, mm.

        They are so fine that neighbours receive the shortest wave of a source at ``MOST_ELEVATION_RAD`` a fifth apart.
        """
        highest_mhz = pulse.centre_mhz * (1.0 + pulse.fractional_bandwidth)
        n = max(8, math.ceil(5.0 * self.height_mm * highest_mhz / speed_mm_us * math.sin(MOST_ELEVATION_RAD)))
        at = self.height_mm * ((np.arange(n) + 0.5) / n - 0.5)
        lens = np.zeros(n) if math.isinf(self.focus_mm) else self.focus_mm - np.hypot(self.focus_mm, at)
        return np.column_stack([at, lens])


@dataclass(frozen=True, slots=True)
class Hearing:
    """Directivity and losses across the array.

    Attributes:
        element_width: of the pitch; sets the directivity sinc(width sin(angle) / wavelength) cos(angle).
        spreading: amplitude falls with distance to the power -spreading (1 spherical, 0.5 cylindrical).
        elevation: loss off the image plane; None if every source is received as if it were in the plane.
        element: height and lens of the elements, which spread the wave of a source off the plane over time: a loss off
            the plane of its own (``elevation`` is None then). None: points.
    """

    element_width: float = 0.9
    spreading: float = 1.0
    elevation: Elevation | None = field(default_factory=Elevation)
    element: ElementHeight | None = None

    def __post_init__(self) -> None:
        if self.element is not None and self.elevation is not None:
            raise ValueError("an element with a height has a loss off the plane of its own: elevation has to be None")


@dataclass(frozen=True, slots=True)
class Reflection:
    """A later copy of the source's wave, as from the source's mirror image in an interface.

    Attributes:
        behind_mm: distance of the mirror image behind the source, along the range.
        aside_mm: its distance from the source along x.
        gain_db: its level over the direct wave's, each at the element that receives it loudest.
        turn_rad: change of the carrier's phase.
    """

    behind_mm: float
    aside_mm: float = 0.0
    gain_db: float = 0.0
    turn_rad: float = math.pi


@dataclass(frozen=True, slots=True)
class PickUp:
    """A signal that reaches the channels at the same time: the laser's trigger or light.

    Attributes:
        time_us: of its maximum, after the pulse.
        snr_db: as of a source, at a channel of gain 1.
        unequal: standard deviation of the channels' gains about 1.
        elements: first and last (exclusive) element that it reaches, as shares of the array.
        pulse: its waveform.
    """

    time_us: float
    snr_db: float = 20.0
    unequal: float = 0.3
    elements: tuple[float, float] = (0.0, 1.0)
    pulse: Pulse = field(default_factory=Pulse)


@dataclass(frozen=True, slots=True)
class FaceSound:
    """Sound that light makes at the probe's face: over an area, or in a spot.

    Attributes:
        snr_db: as of a source, at the element that receives it loudest.
        range_mm: from the elements to the face, mm.
        x_mm: middle of the light on the face.
        width_mm: standard deviation of the light across the face; every element receives the part before it. 0: a
            spot, whose sound runs along the array.
    """

    snr_db: float = 20.0
    range_mm: float = 1.0
    x_mm: float = 0.0
    width_mm: float = 0.0


Artefact = Reflection | PickUp | FaceSound


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
    artefacts: Sequence[Artefact] = (),
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
        artefacts: what the record holds besides.

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
    across = array.across(np.asarray(scan_rad))
    in_plane = 1.0
    if hearing.elevation is not None:
        offset = float(rotation_offset_rad(source, scan_rad, array))
        if half_width_rad is None:
            depth = float(array.distance_mm(source, np.asarray(scan_rad)))
            half_width_rad = float(np.interp(depth, probe.sensitivity.depth_mm, probe.sensitivity.half_width_rad))
        in_plane = float(hearing.elevation.amplitude(offset, half_width_rad))

    def arrive(distance_mm: FloatArray, amplitude: FloatArray, waveform: Pulse) -> None:
        _add_wave(out, (distance_mm - array.range_offset_mm) / speed_mm_us, amplitude, waveform, channels)

    def arrive_from(trus_p_mm: FloatArray, peak: float, waveform: Pulse, share: float = 1.0) -> None:
        amplitude = _element_amplitudes(probe, trus_p_mm, elements, waveform, hearing, speed_mm_us)
        amplitude *= peak / amplitude.max()
        strips = np.zeros((1, 2)) if hearing.element is None else hearing.element.strips(waveform, speed_mm_us)
        for height_mm, delay_mm in strips.tolist():
            distance = np.linalg.norm(trus_p_mm - elements - height_mm * across, axis=1)
            arrive(distance + delay_mm, amplitude * share / len(strips), waveform)

    arrive_from(source, _peak_of(snr_db), pulse, in_plane)
    along, outwards = array.along(np.asarray(scan_rad)), source - elements.mean(axis=0)
    outwards -= (outwards @ along) * along
    outwards /= np.linalg.norm(outwards)
    for artefact in artefacts:
        if isinstance(artefact, Reflection):
            mirrored = source + artefact.behind_mm * outwards + artefact.aside_mm * along
            turned = replace(pulse, phase_rad=pulse.phase_rad + artefact.turn_rad)
            arrive_from(mirrored, _peak_of(snr_db + artefact.gain_db), turned, in_plane)
        elif isinstance(artefact, FaceSound) and artefact.width_mm == 0.0:
            spot = elements.mean(axis=0) + artefact.range_mm * outwards + artefact.x_mm * along
            arrive_from(spot, _peak_of(artefact.snr_db), pulse)
        elif isinstance(artefact, FaceSound):
            light = np.exp(-0.5 * ((probe.element_x_mm - artefact.x_mm) / artefact.width_mm) ** 2)
            arrive(np.full(probe.elements, artefact.range_mm), _peak_of(artefact.snr_db) * light, pulse)
        else:
            share = (np.arange(probe.elements) + 0.5) / probe.elements
            reached = (share >= artefact.elements[0]) & (share < artefact.elements[1])
            gain = reached * (1.0 + artefact.unequal * rng.standard_normal(probe.elements))
            time_us = np.full(probe.elements, artefact.time_us)
            _add_wave(out, time_us, _peak_of(artefact.snr_db) * gain, artefact.pulse, channels)
    return out


def _peak_of(snr_db: float) -> float:
    """Peak amplitude of a wave, in standard deviations of the noise."""
    return float(math.sqrt(2.0) * 10.0 ** (snr_db / 20.0))


def _add_wave(
    out: ChannelArray, arrival_us: FloatArray, amplitude: FloatArray, pulse: Pulse, channels: ChannelModel
) -> None:
    """Add a pulse that reaches each element (elements,) at its time after the laser pulse, in place."""
    centre = (arrival_us + channels.pulse_delay_us - channels.t0_us) * channels.sampling_mhz
    reach = math.ceil(pulse.support_us * channels.sampling_mhz) + 1
    index = np.rint(centre).astype(np.int64)[:, None] + np.arange(-reach, reach + 1)
    signal = amplitude[:, None] * pulse.waveform((index - centre[:, None]) / channels.sampling_mhz)
    row, column = np.nonzero((index >= 0) & (index < out.shape[1]))
    out[row, index[row, column]] += signal[row, column].astype(np.float32)


def noise_channels(probe: ProbeModel, rng: np.random.Generator, samples: int = 1600) -> ChannelArray:
    """(elements, samples) of noise alone, standard deviation 1, without a source."""
    return rng.standard_normal((probe.elements, samples), dtype=np.float32)


def quantised(channels: ChannelArray, counts_per_unit: float = 12.0) -> npt.NDArray[np.int16]:
    """Channel data as int16, as a converter would deliver; ``counts_per_unit`` counts per noise standard deviation."""
    return np.asarray(np.clip(np.rint(channels * counts_per_unit), -32768, 32767).astype(np.int16))


def log_compressed(image: ChannelArray, range_db: float) -> npt.NDArray[np.uint8]:
    """An envelope image as on a scanner's screen: 255 for its maximum, 0 from ``range_db`` below that on."""
    level_db = 20.0 * np.log10(np.maximum(image / float(image.max()), 1e-12))
    return np.asarray(np.rint(255.0 * np.clip(1.0 + level_db / range_db, 0.0, 1.0)), dtype=np.uint8)


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
