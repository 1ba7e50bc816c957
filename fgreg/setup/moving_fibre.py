"""Latency of the camera against the pulses, from a fibre that is moved while it is heard (docs/setup.md, section 4).

The stage stands still, the fibre's tip or spot moves along the probe. Of a pulse that came at time t the marker has
position p and rotation R as they came from the camera at t + delay, and

    x = a + n p + sum of m * R

n the direction of the probe's axis in the camera's frame, m (3, 3) the product n q' of it and the tip q in the marker's
frame. Linear in all but the delay, with the nine numbers of m free: the product alone has long valleys.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from fgreg.errors import EstimationError
from fgreg.geometry.transforms import BoolArray, FloatArray
from fgreg.model.session_model import NoiseModel
from fgreg.setup.constants import Found
from fgreg.setup.optimum import optimum

LEAST_PULSES = 20
LEAST_TRAVEL_MM = 3.0
"""Standard deviation of x: less than that tells little."""
WIDEST_S = 0.5
"""Largest delay."""
PRIOR = np.array([1.0] * 3 + [100.0] * 9)
"""Weak priors of n and of m, mm."""
LEAST_SIGMA_MM = 0.05
"""No PM is located better, and between two poses the marker does not move quite straight."""
BLOCKS = 8
"""Parts in time, each of which is left out once: what the marker's noise does to pulses in a row goes together."""
SCALE = np.array([0.01, *[0.1] * 3, *[10.0] * 9, 1.0])
"""Steps of delay, n, m and a that change x alike."""
SMOOTH_S = 0.25
"""Half of the time over which the marker's poses are smoothed."""
WORST_S = 0.03
"""Standard deviation from which a delay is not determined."""
LEAST_EXPLAINED = 0.5
"""Share of the variance of x that the marker has to explain: else it is not the fibre's marker."""
MISFIT = 2.5
"""Of the noise of x: beyond it the clocks are apart. What the hand does again some seconds later fits roughly, too."""


@dataclass(frozen=True, slots=True, eq=False)
class Movement:
    """One recording: pulses (n,) with time and x; poses (m,) of the marker with theirs (4, 4)."""

    name: str
    pulse_s: FloatArray
    x_mm: FloatArray
    marker_s: FloatArray
    camera_T_marker: FloatArray


def camera_latency(movements: Sequence[Movement], noise: NoiseModel) -> Found:
    """How much later than the pulses the camera's pictures come; ``noise`` as declared.

    Raises:
        EstimationError: a recording cannot be used, with its name.
    """
    delays, sigmas = zip(*(_delay(one, noise) for one in movements), strict=True)
    weight = np.array([1.0 / sigma**2 for sigma in sigmas])
    value = float(weight @ delays / weight.sum())
    pulses = sum(one.pulse_s.size for one in movements)
    how = f"{pulses} pulses while the fibre moved along the probe: x of the PM against the marker"
    return Found("camera_less_pulse_latency_s", value, float(1.0 / math.sqrt(weight.sum())), "s", how)


def _delay(one: Movement, noise: NoiseModel) -> tuple[float, float]:
    order = np.argsort(one.marker_s, kind="stable")
    times, poses = one.marker_s[order], one.camera_T_marker[order]
    if times.size < LEAST_PULSES:
        raise EstimationError(f"{one.name} has {times.size} poses of the marker: {LEAST_PULSES} or more needed")
    usable = (one.pulse_s > times[0] + WIDEST_S) & (one.pulse_s < times[-1] - WIDEST_S)
    t, x = one.pulse_s[usable], one.x_mm[usable]
    if t.size < LEAST_PULSES:
        text = f"{t.size} pulses with the PM heard, {WIDEST_S:g} s within those of the marker"
        raise EstimationError(f"{one.name} has {text}: {LEAST_PULSES} or more needed")
    if float(np.std(x)) < LEAST_TRAVEL_MM:
        text = f"moves the PM by {np.std(x):.1f} mm RMS along the probe"
        raise EstimationError(f"{one.name} {text}: {LEAST_TRAVEL_MM:g} or more needed, to and fro")
    columns = np.concatenate([poses[:, :3, 3], poses[:, :3, :3].reshape(-1, 9)], axis=1)
    columns = _smooth(times, columns - columns.mean(axis=0))

    def predicted(p: FloatArray) -> FloatArray:
        """x (n,) of delay, n, m (row by row) and a."""
        at = np.stack([np.interp(t + p[0], times, column) for column in columns.T], axis=1)
        return np.asarray(at @ p[1:13] + p[13])

    start = _start(predicted, x)
    misfit = predicted(start) - x
    if float(misfit @ misfit) > (1.0 - LEAST_EXPLAINED) * float(np.sum((x - x.mean()) ** 2)):
        raise EstimationError(f"{one.name}: the marker's movement does not explain where the PM is heard")
    sigma = max(math.sqrt(float(misfit @ misfit) / max(t.size - start.size, 1)), LEAST_SIGMA_MM)

    def residuals(p: FloatArray, kept: BoolArray | slice = slice(None)) -> FloatArray:
        return np.concatenate([(predicted(p) - x)[kept] / sigma, p[1:13] / PRIOR])

    found = optimum(residuals, start, SCALE).widened()
    # Smoothing leaves less than a third of the marker's noise.
    expected = math.hypot(noise.lateral_mm, float(np.max(noise.marker_translation_mm)) / 3.0, LEAST_SIGMA_MM)
    misfit_mm = math.sqrt(float(np.mean((predicted(found.value) - x) ** 2)))
    if misfit_mm > MISFIT * expected:
        text = f"the PM is {misfit_mm:.1f} mm RMS from where the marker says, {expected:.1f} by the declared noise"
        raise EstimationError(f"{one.name}: {text}: give t of both in s, by one clock")
    if abs(found.value[0]) > 0.9 * WIDEST_S:
        raise EstimationError(f"{one.name}: a delay beyond {WIDEST_S:g} s, or a movement that repeats itself too fast")
    blocks = np.arange(t.size) * BLOCKS // t.size
    without = [optimum(partial(residuals, kept=blocks != k), found.value, SCALE).value[0] for k in range(BLOCKS)]
    jackknife = math.sqrt((BLOCKS - 1) * float(np.var(without)))
    sigma_s = max(jackknife, math.sqrt(float(found.covariance[0, 0])))
    if sigma_s > WORST_S:
        raise EstimationError(
            f"{one.name}: movements along and about the probe go together: move it without turning it"
        )
    return float(found.value[0]), sigma_s


def _start(predicted: Callable[[FloatArray], FloatArray], x: FloatArray) -> FloatArray:
    """Parameters near the optimum: the best delay of a grid, all others linear in x."""
    best, least = np.zeros(14), math.inf
    for delay in np.linspace(-WIDEST_S, WIDEST_S, 51):
        rows = np.stack([predicted(np.r_[delay, unit]) for unit in np.eye(13)], axis=1)
        weighed = np.vstack([rows, np.eye(12, 13) / PRIOR[:, None]])
        p = np.r_[delay, np.linalg.lstsq(weighed, np.r_[x, np.zeros(12)], rcond=None)[0]]
        cost = float(np.sum((rows @ p[1:] - x) ** 2))
        if cost < least:
            best, least = p, cost
    return best


def _smooth(times: FloatArray, columns: FloatArray) -> FloatArray:
    """Columns (m, k) with less noise: at each time the parabola through the samples about it.

    Noise of the marker makes its part in x look smaller than it is (errors in variables), and where movements along and
    about the probe go together that moves the delay. The samples used lie on both sides alike: no delay.
    """
    out = columns.copy()
    for i, t in enumerate(times):
        near = np.abs(times - t) <= SMOOTH_S
        if near.sum() > 3:
            out[i] = np.linalg.pinv(np.vander(times[near] - t, 3, increasing=True))[0] @ columns[near]
    return out
