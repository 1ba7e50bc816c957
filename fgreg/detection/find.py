"""What a photoacoustic frame can answer: a point with its covariance, or that there is no source in it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from fgreg.frames import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PaFind:
    """One photoacoustic source found in one frame.

    Attributes:
        x_mm: TRUS x of the source.
        range_mm: distance from the element row along the image plane, as the *assumed* sound speed has it: assumed
            speed times the arrival time at the apex of the wavefront. Multiplied by the true ratio of sound speeds
            (``sound_speed_ratio`` once it is known well enough) it is the true range.
        covariance: (2, 2) over (x_mm, range_mm), mm^2.
        amplitude: peak of the wave's envelope at the strongest elements (channel data) or in the image, in the
            frame's units; comparable within one source only.
        snr_db: amplitude / sqrt(2) over the standard deviation of the noise, per sample.
        sound_speed_ratio: true over assumed sound speed as the wavefront's shape alone tells it; None for images,
            which do not hold the wavefront.
        sound_speed_ratio_sigma: its standard deviation.
        elements_used: number of elements that heard the source and entered the fit; None for images.
        statistic, threshold: the detection statistic (log likelihood ratio) and what it had to exceed.
    """

    x_mm: float
    range_mm: float
    covariance: FloatArray
    amplitude: float
    snr_db: float
    sound_speed_ratio: float | None
    sound_speed_ratio_sigma: float | None
    elements_used: int | None
    statistic: float
    threshold: float


@dataclass(frozen=True, slots=True)
class NoSignal:
    """There is no source in the frame; ``reason`` says so with the figure behind it."""

    reason: str


def pool_sound_speed_ratio(finds: Iterable[PaFind]) -> tuple[float, float] | None:
    """Ratio of true to assumed sound speed over many finds, weighted by their variances.

    The sigma is enlarged by the spread of the finds where that is larger than their sigmas explain.

    Args:
        finds: finds in channel data; those without a ratio are passed over.

    Returns:
        (ratio, sigma), or None where no find has a ratio. Worth a warning where ``abs(ratio - 1)`` exceeds both 3
        sigma and 0.005.
    """
    pairs = [
        (find.sound_speed_ratio, find.sound_speed_ratio_sigma**-2)
        for find in finds
        if find.sound_speed_ratio is not None and find.sound_speed_ratio_sigma is not None
    ]
    if not pairs:
        return None
    weight = math.fsum(w for _, w in pairs)
    ratio = math.fsum(w * value for value, w in pairs) / weight
    spread = math.fsum(w * (value - ratio) ** 2 for value, w in pairs) / max(len(pairs) - 1, 1)
    return ratio, math.sqrt(max(1.0, spread) / weight)
