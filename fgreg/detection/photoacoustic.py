"""Position of the photoacoustic source from channel data, or from an envelope image (envelope.py).

Channel data hold one-way travel times. A wavefront is searched by delay and sum over the image plane
(wavefront_search.py). If there is one, x, range and the ratio of sound speeds are fitted (wavefront_fit.py). A frame
without a source gives :class:`NoSignal`, not a point.

The ratio of sound speeds is always fitted too. Fixing it at 1 gains little (tools/study_photoacoustic.py has the
figures), and a sound speed that is 2 % off would then move the range unnoticed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.detection.channels import Channels, check_frame, muted, prepare_channels, without_flat_wave
from fgreg.detection.results import LEAST_RANGE_MM, NoSignal, OtherWave, PaFind
from fgreg.detection.wavefront_fit import WavefrontFit, fit_wavefront, path_mm
from fgreg.detection.wavefront_search import (
    COARSE_RANGE_MM,
    MAX_TANGENT,
    MUTE_US,
    RATIOS,
    SIDELOBES_MM,
    FrameSearch,
    Peak,
    find_flat,
    find_later,
    find_waves,
    search_bands,
    search_frame,
    search_nearby,
)
from fgreg.errors import EstimationError
from fgreg.geometry.transforms import BoolArray, FloatArray
from fgreg.model.probe_model import ProbeModel

FALSE_ALARMS = 2e-4
"""False-alarm rate: share of noise frames in which a source is found."""
ROUNDS = 6
"""A frame is searched again after a flat wave was removed, at most this many times."""
MAX_OTHERS = 2
"""Most waves besides the first one that are handed on."""
OTHER_SIGMA_MM = (0.05, 0.08)
"""Standard deviations (x, range) of a wave that is searched, not fitted."""
INDEPENDENT = 15.0
"""Independent points per grid point near the threshold, measured on frames of noise (tools/study_photoacoustic.py)."""
FLAT_PERIODS = 0.9
FLAT_SHARE = 0.4
"""A flat wave (light, interference) fits a spherical one only where the latter is flat to half a period. A source is
received over more than FLAT_PERIODS periods of path, or FLAT_SHARE of what the array could receive if that is less."""

MISFIT, SCATTER_PERIODS = 4.0, 0.14
"""Arrival times with more scatter than this, beyond the noise, are not from one source. A flat wave in part of the
channels has 0.19, a wave that tissue delays by 50 ns RMS 0.12."""


def locate_in_channels(frame: npt.NDArray[Any], probe: ProbeModel) -> PaFind | NoSignal:
    """Find the photoacoustic source in one frame of channel data.

    Args:
        frame: (elements, samples) real numbers (float32, int16, ...), rows in the order of ``probe.element_x_mm``
            (which holds ``probe.flip``). Offsets, dead (constant) channels and a flash common to all channels are
            handled. The pulse may be unknown; its spectrum must lie between 1 and 12 MHz.
        probe: with ``channels``.

    Returns:
        The find, or the reason for none with the figure. ``range_mm`` is the assumed sound speed times the arrival
        time at the apex of the wavefront (where the element at the source's x would be), *whatever the true speed is*:
        with the ratio of sound speeds the true range is ``ratio * range_mm``. ``x_mm`` needs no correction. The
        covariance holds for an unknown ratio (prior 1 +- 3 %).

    Raises:
        ValueError: the probe has no channel sampling, or the frame is not one of this probe.
    """
    if probe.channels is None:
        raise ValueError("the probe has no channel sampling (probe.channels)")
    data = check_frame(frame)
    if data.shape[0] != probe.elements:
        swapped = ", which looks transposed" if data.shape[1] == probe.elements else ""
        raise ValueError(f"channel data of shape {data.shape}{swapped}, expected ({probe.elements} elements, samples)")
    speed_mm_us = probe.sound_speed_m_s * 1e-3
    try:
        channels = prepare_channels(data, probe.channels)
    except EstimationError as error:
        return NoSignal(f"no signal: {error}")
    live, element_x_mm = channels.live, probe.element_x_mm
    found: PaFind | NoSignal | None = None
    for _ in range(ROUNDS):
        bands = search_bands(channels, probe, speed_mm_us)
        points = sum(band.scale.size for band in bands)
        threshold = math.log(INDEPENDENT * max(points, 1) / FALSE_ALARMS)
        flat = find_flat([band.signal for band in bands], live)
        if flat is None or flat.statistic < threshold or not flat.everywhere(probe.elements):
            search = search_frame(bands, live, probe, speed_mm_us, threshold)
            if not search.peaks:
                return NoSignal("no signal: no arrival from the image plane falls into the record")
            best = search.peaks[0].statistic
            if best < threshold:
                return found or NoSignal(f"no signal: statistic {best:.1f}, threshold {threshold:.1f}")
            waves, flat = find_waves(flat, search)
        if flat is not None:
            channels = without_flat_wave(channels, flat.span_us, flat.elements)
            found = NoSignal(
                f"no signal: statistic {flat.statistic:.1f}, threshold {threshold:.1f}, but the wave is flat"
            )
            continue
        same = [peak for peak in search.peaks[1:] if peak.statistic > threshold and _near(peak, waves[0])]
        for wave in (waves[-1], *(same if len(waves) == 1 else ())):
            found = _fit_wave(wave, waves[:-1], threshold, channels, probe)
            if isinstance(found, PaFind):
                return replace(found, others=_other_waves([*waves[:-1], wave], search))
        arrival_us = waves[-1].arrival_us(element_x_mm, speed_mm_us)
        channels = muted(channels, arrival_us - MUTE_US, arrival_us + MUTE_US)
    return found or NoSignal("no signal")


def _other_waves(waves: list[Peak], search: FrameSearch) -> tuple[OtherWave, ...]:
    """The waves of a frame after the first one, which is the last of ``waves``; the strongest first."""
    if len(waves) == 1 and (later := find_later(waves, search)) is not None:
        waves = [later, *waves]
    covariance = np.diag(np.square(OTHER_SIGMA_MM))
    return tuple(OtherWave(wave.x_mm, wave.range_mm, covariance, wave.statistic) for wave in waves[:-1][:MAX_OTHERS])


def _near(peak: Peak, other: Peak) -> bool:
    """Whether two peaks may be of the same wave."""
    return abs(peak.range_mm - other.range_mm) < 1.5 and abs(peak.x_mm - other.x_mm) < 3.0


def _fit_wave(
    peak: Peak, others: Sequence[Peak], threshold: float, channels: Channels, probe: ProbeModel
) -> PaFind | NoSignal:
    """Fit of one wave, the others muted, or why it is not a source's."""
    speed_mm_us, element_x_mm = probe.sound_speed_m_s * 1e-3, probe.element_x_mm
    for other in others:
        arrival_us = other.arrival_us(element_x_mm, speed_mm_us)
        channels = muted(channels, arrival_us - MUTE_US, arrival_us + MUTE_US)
    start = search_nearby(peak, channels.live, element_x_mm, speed_mm_us, COARSE_RANGE_MM[1::2], RATIOS, SIDELOBES_MM)
    but = f"no signal: statistic {peak.statistic:.1f}, threshold {threshold:.1f}, but"
    try:
        fit = fit_wavefront(channels, element_x_mm, speed_mm_us, start.x_mm, start.range_mm, start.ratio)
    except EstimationError as error:
        return NoSignal(f"{but} {error}")
    if fit.range_mm < LEAST_RANGE_MM:
        return NoSignal(
            f"{but} it comes from {fit.range_mm:.1f} mm before the elements: sound made at the probe's face"
        )
    heard, possible = heard_periods(fit, channels.live, element_x_mm, speed_mm_us)
    if heard < min(FLAT_PERIODS, FLAT_SHARE * possible):
        return NoSignal(f"{but} the wave is flat: it fits a spherical one over {heard:.1f} periods only")
    scatter = fit.beyond_noise_us * fit.band.centre_mhz
    if fit.misfit > MISFIT and scatter > SCATTER_PERIODS:
        return NoSignal(f"{but} arrival times scatter by {scatter:.2f} periods about a spherical wavefront")
    noise = max(channels.noise, 1e-6 * channels.peak)
    return PaFind(
        x_mm=fit.x_mm,
        range_mm=fit.range_mm,
        covariance=fit.covariance,
        amplitude=fit.amplitude,
        snr_db=20.0 * math.log10(max(fit.amplitude, 1e-30) / (math.sqrt(2.0) * noise)),
        sound_speed_ratio=fit.ratio,
        sound_speed_ratio_sigma=fit.ratio_sigma,
        elements_used=fit.elements_used,
        statistic=peak.statistic,
        threshold=threshold,
    )


def locate_in_frame(frame: npt.NDArray[Any], probe: ProbeModel) -> PaFind | NoSignal:
    """Find the photoacoustic source in a frame of either kind.

    For a probe with both ``channels`` and ``image``, :meth:`ProbeModel.is_channel_data` decides.

    Raises:
        ValueError: the probe has neither, or the frame fits neither.
    """
    data = check_frame(frame)
    if probe.channels is not None and (probe.image is None or probe.is_channel_data(frame)):
        return locate_in_channels(data, probe)
    if probe.image is not None:
        from fgreg.detection.envelope import locate_in_image  # loads scipy.optimize and scipy.ndimage

        return locate_in_image(data, probe)
    raise ValueError("the probe has neither channel sampling (probe.channels) nor image geometry (probe.image)")


def heard_periods(
    fit: WavefrontFit, live: BoolArray, element_x_mm: FloatArray, speed_mm_us: float
) -> tuple[float, float]:
    """Spread of path, in periods, over the elements that received the wave, and over all that could have."""
    path = path_mm(fit.x_mm, fit.range_mm, fit.ratio, element_x_mm)
    could = live & (np.abs(element_x_mm - fit.x_mm) < MAX_TANGENT * fit.range_mm)
    periods = fit.band.centre_mhz / speed_mm_us
    return float(np.ptp(path[fit.gain > 0.0])) * periods, float(np.ptp(path[could])) * periods if could.any() else 0.0
