"""Moment matching of one PM's windows (fgreg.graph.sites) on the few numbers that a query comes down to.

What the looks' rotations are is a small Gaussian once the geometry is linearised: mean (L,) and covariance (L, L) with
a Gaussian site on each. A site is replaced by one that, with all else (its cavity), has the moments that the window
gives; with one look its cavity does not depend on it, so that once is enough.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fgreg.frames import FloatArray
from fgreg.graph.sites import LEAST_SITE
from fgreg.graph.windows import LEAST_PRECISION
from fgreg.tracking.windows import LookWindow, interval_derivatives

SWEEPS = 30
SETTLED = 0.003
"""Sites have settled when no rotation moves by more than this share of its standard deviation in a sweep."""


@dataclass(frozen=True, slots=True, eq=False)
class AmplitudeShape:
    """Log likelihood (G,) of a PM's amplitudes and of the window of its look ``look``, at rotations (G,) of it."""

    look: int
    rotation: FloatArray
    log: FloatArray


@dataclass(slots=True)
class Sites:
    """Gaussian stand-ins of looks' windows: centres (rad) and precisions (rad^-2)."""

    centre: list[float]
    precision: list[float]


def gaussian_sites(windows: list[LookWindow]) -> Sites:
    """The windows' own Gaussians, of the same mean and variance as the interval alone."""
    return Sites([w.centre for w in windows], [1.0 / (w.sigma * w.sigma) for w in windows])


def settle_sites(
    sites: Sites,
    mean: list[float],
    covariance: list[list[float]],
    windows: list[LookWindow],
    shape: AmplitudeShape | None,
) -> Sites | None:
    """The sites for the windows' shapes; None where they do not settle.

    Args:
        sites: those that ``mean`` (L,) and ``covariance`` (L, L) of the looks' ``rotation - gain * edge`` include.
        windows: of the looks.
        shape: of the look that stands for the amplitudes.
    """
    count = len(windows)
    centre, precision = list(sites.centre), list(sites.precision)
    mean, spread = list(mean), [list(row) for row in covariance]
    for _ in range(SWEEPS):
        moved = 0.0
        for i, window in enumerate(windows):
            variance = spread[i][i]
            q = max(1.0 / variance - precision[i], LEAST_PRECISION)
            cavity = (mean[i] / variance - precision[i] * centre[i]) / q
            if shape is not None and shape.look == i:
                new_centre, new_precision = _amplitude_site(shape, cavity, q)
            else:
                new_centre, new_precision = _interval_site(window, cavity, q)
            change = new_precision - precision[i]
            pull = new_precision * new_centre - precision[i] * centre[i]
            scale = 1.0 + change * variance
            if not scale > 1e-12:
                return None
            step = (pull - change * mean[i]) / scale
            column = [row[i] for row in spread]
            for j in range(count):
                mean[j] += column[j] * step
                for k in range(count):
                    spread[j][k] -= column[j] * column[k] * change / scale
            centre[i], precision[i] = new_centre, new_precision
            moved = max(moved, abs(step) * math.sqrt(variance))
        if count == 1 or moved < SETTLED:
            return Sites(centre, precision)
    return None


def _interval_site(window: LookWindow, cavity: float, q: float) -> tuple[float, float]:
    sigma = math.sqrt(window.soft * window.soft + 1.0 / q)
    slope, curvature = interval_derivatives(window.low - cavity, window.high - cavity, sigma)
    left = max(1.0 - curvature / q, 1e-6)  # what share of the cavity's variance is left
    precision = max(curvature / left, LEAST_SITE)
    if precision > LEAST_SITE:
        return (slope + cavity * curvature) / left / precision, precision
    return cavity + slope / precision, precision


def _amplitude_site(shape: AmplitudeShape, cavity: float, q: float) -> tuple[float, float]:
    away = shape.rotation - cavity
    log = shape.log - 0.5 * q * away * away
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    first = float(weight @ away)
    second = max(float(weight @ (away * away)) - first * first, 1e-12)
    precision = max(1.0 / second - q, LEAST_SITE)
    return cavity + first * (1.0 + q / precision), precision
