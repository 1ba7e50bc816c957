"""One look's sensitivity window in plain floats: the same numbers as fgreg.sensitivity, without arrays' overhead.

A query has one look, or a few; numpy takes longer to be called than the arithmetic of one look takes.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

from scipy.special import erfcx

from fgreg.measurements import Look
from fgreg.sensitivity import MIN_SOFTNESS_RAD

_ROOT2 = math.sqrt(2.0)
_DENSITY = math.sqrt(2.0 / math.pi)


@dataclass(frozen=True, slots=True)
class LookWindow:
    """What the window says about one look's stage rotation (rad).

    ``rotation - gain * window_edge`` lies in (low, high), the ends' softness ``soft`` (sigma); as a Gaussian it has
    mean ``centre`` and standard deviation ``sigma``. See fgreg.sensitivity.window_priors and window_shapes.
    """

    centre: float
    gain: float
    sigma: float
    low: float
    high: float
    soft: float


def interpolated(at: float, x: Sequence[float], y: Sequence[float]) -> float:
    """``y`` at ``at``, linear between the increasing ``x`` and constant beyond them."""
    i = bisect_right(x, at)
    if i == 0:
        return y[0]
    if i == len(x):
        return y[-1]
    return y[i - 1] + (at - x[i - 1]) / (x[i] - x[i - 1]) * (y[i] - y[i - 1])


def look_window(look: Look, half_width_rad: float, step_rad: float, edge_variance: float) -> LookWindow:
    """The window of a look.

    Args:
        look: what was heard.
        half_width_rad: of the window at its depth.
        step_rad: the sweep's increment.
        edge_variance: of the half width, rad^2: of a window known as a whole it moves the ends apart, which counts as
            softness here (as in fgreg.graph.sites).
    """
    w, s, noise = half_width_rad, float(look.sweep), look.scan_sigma_rad
    soft = max(noise, MIN_SOFTNESS_RAD)
    if s == 0.0 or step_rad >= 2.0 * w:
        sigma = math.sqrt(w * w / 3.0 + noise * noise)
        return LookWindow(0.0, 0.0, sigma, -w, w, math.sqrt(soft * soft + edge_variance))
    near = w - step_rad
    low, high = (near, w) if s > 0.0 else (-w, -near)
    sigma = math.sqrt(step_rad * step_rad / 12.0 + noise * noise)
    return LookWindow(s * (w - 0.5 * step_rad), s, sigma, low, high, soft)


def interval_derivatives(low: float, high: float, sigma: float) -> tuple[float, float]:
    """First and minus second derivative, by the mean, of the log probability that a Gaussian lies in (low, high).

    ``low`` and ``high`` counted from the mean; fgreg.sensitivity.interval_moments in floats. Exact far out in a tail
    too: there densities and probability are taken relative to the density at the nearer end.
    """
    a, b = low / sigma, high / sigma
    mirrored = a + b > 0.0
    if mirrored:
        a, b = -b, -a
    # Now b is the end nearer to the mean, or they enclose it.
    if b < 0.0:
        fall = math.exp(0.5 * (b - a) * (b + a))  # density at a over that at b
        at_b = _DENSITY / max(float(erfcx(-b / _ROOT2)) - fall * float(erfcx(-a / _ROOT2)), 1e-300)
        at_a = fall * at_b
    else:
        inside = max(0.5 * (math.erfc(-b / _ROOT2) - math.erfc(-a / _ROOT2)), 1e-300)
        at_a = 0.5 * _DENSITY * math.exp(-0.5 * a * a) / inside
        at_b = 0.5 * _DENSITY * math.exp(-0.5 * b * b) / inside
    slope = at_a - at_b
    curvature = slope * slope - (a * at_a - b * at_b)
    if mirrored:
        slope = -slope
    return slope / sigma, curvature / (sigma * sigma)
