"""Window, latency of the stage, backlash and hearing threshold from sweeps past a still PM (docs/setup.md, section 3).

The stage turns past the PM at constant speed, in both senses. A pulse that came at time t was at device angle

    theta = u(t + delay) - sense * backlash

u the stage's reading by the time at which it came. The PM is heard from the lower to the upper edge, and between them
its amplitude is log a = log a0 - k (phi - theta)^2. A delay moves what is seen in either sense apart by 2 delay speed,
a backlash by 2 backlash: sweeps at two speeds tell them apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from fgreg.errors import EstimationError
from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray
from fgreg.setup.constants import Declared, Found
from fgreg.setup.optimum import Optimum, optimum

LEAST_HEARD = 5
"""Pulses in a pass with the PM heard."""
SILENT = 2
"""Pulses without it on either side."""
MOVING = 0.1
"""Of the largest speed: from there on the stage moves."""
SPEED_S = 0.1
"""Half of the time over which speed is taken."""
INNER = 0.8
"""Share of the window in which amplitudes count: nearer to its edges only the louder ones are heard."""
SPEEDS = 1.5
"""Ratio of the speeds from which delay and backlash are told apart."""
DELAY_SIGMA_S, BACKLASH_SIGMA_RAD = 1.0, math.radians(2.0)
"""Weak priors."""
SOFT_RAD = math.radians(0.2)
"""Of an edge, without amplitudes."""
SLOWEST_RAD_S = math.radians(0.05)
"""No stage is swept more slowly: times are in another unit."""
NARROWEST_RAD = math.radians(0.2)
"""No window has a smaller half width: angles are in another unit."""
DISAGREE = 10.0
"""Chi square per degree of freedom from which the passes are not of one still PM."""


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """One recording: pulses (n,) with their times, whether the PM was heard, amplitude (NaN: none) and true range (mm);
    readings (m,) of the stage with theirs (s, rad)."""

    name: str
    pulse_s: FloatArray
    heard: BoolArray
    amplitude: FloatArray
    range_mm: FloatArray
    stage_s: FloatArray
    stage_rad: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Pass:
    """The PM heard once: sense and speed (rad/s), times of both crossings, heard pulses."""

    sense: int
    speed: float
    enters_s: float
    leaves_s: float
    step_s: float
    heard: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class _Fitted:
    """A sweep with its passes. ``first``: index of its first parameter: edges, then phi, log a0, k of a ``bell``."""

    sweep: Sweep
    passes: tuple[_Pass, ...]
    first: int
    bell: bool


def window_of(sweeps: Sequence[Sweep], declared: Declared) -> list[Found]:
    """What sweeps show.

    Raises:
        EstimationError: one of them cannot be used, with its name.
    """
    fitted, first = [], 2
    for sweep in sweeps:
        passes = _passes(sweep)
        inner = np.concatenate([sweep.amplitude[one.heard] for one in passes])
        bell = bool(np.count_nonzero(np.nan_to_num(inner) > 0.0) >= 2 * LEAST_HEARD)
        fitted.append(_Fitted(sweep, passes, first, bell))
        first += 5 if bell else 2
    speeds = [one.speed for of in fitted for one in of.passes]
    if min(speeds) < SLOWEST_RAD_S:
        slow = f"{fitted[0].sweep.name}: the stage turns at {math.degrees(min(speeds)):.2g} deg/s"
        raise EstimationError(f"{slow}: give t in s, scan_deg in degrees")
    told = max(speeds) >= SPEEDS * min(speeds)
    backlash_sigma = BACKLASH_SIGMA_RAD if told else declared.backlash_sigma_rad
    start, scale = _start(fitted, first)
    spread = {of.first: 0.1 for of in fitted}
    found: Optimum | None = None
    for use_bells in (False, True, True):  # edges first: they say which amplitudes are inside
        at = start if found is None else found.value
        inside = {of.first: _inside(of, at) if use_bells and of.bell else [] for of in fitted}
        if found is not None and use_bells:
            at = _bells(fitted, at, inside)
            spread = {of.first: _spread(of, at, inside[of.first]) for of in fitted}

        found = optimum(partial(_residuals, fitted, at, inside, spread, backlash_sigma, declared), at, scale)
    assert found is not None
    if found.chi_square > DISAGREE * max(found.degrees_of_freedom, 1):
        names = ", ".join(of.sweep.name for of in fitted)
        raise EstimationError(f"the passes of {names} do not agree: the PM has to stand still, the stage at one speed")
    return _results(found.widened(), fitted, told)


def _residuals(
    fitted: Sequence[_Fitted],
    at: FloatArray,
    inside: Mapping[int, list[IntArray]],
    spread: Mapping[int, float],
    backlash_sigma: float,
    declared: Declared,
    p: FloatArray,
) -> FloatArray:
    """Of the parameters ``p``: priors, crossings of the edges, and amplitudes ``inside`` the window, if any.

    ``at``: parameters that the edges' standard deviations are for. ``spread``: of the log amplitudes of each sweep.
    """
    parts = [np.array([p[0] / DELAY_SIGMA_S, p[1] / backlash_sigma])]
    for of in fitted:
        parts.append(_edges(of, p, at, spread[of.first], declared))
        bell = slice(of.first + 2, of.first + 5)
        if of.bell and not inside[of.first]:
            parts.append(p[bell] - at[bell])  # not yet fitted
        for one, heard in zip(of.passes, inside[of.first], strict=False):
            phi, log, k = p[bell]
            away = phi - _theta(of.sweep, one, of.sweep.pulse_s[heard], p)
            parts.append((np.log(of.sweep.amplitude[heard]) - (log - k * away**2)) / spread[of.first])
    return np.concatenate(parts)


def _theta(sweep: Sweep, one: _Pass, t_s: FloatArray | float, p: FloatArray) -> FloatArray:
    """Device angles of the plane at pulses that came at these times."""
    return np.asarray(np.interp(np.asarray(t_s) + p[0], sweep.stage_s, sweep.stage_rad) - one.sense * p[1])


def _edges(of: _Fitted, p: FloatArray, at: FloatArray, spread: float, declared: Declared) -> FloatArray:
    """Residuals of the crossings of both edges in each pass."""
    lower, upper = p[of.first : of.first + 2]
    out = []
    for one in of.passes:
        step = one.speed * one.step_s
        soft = SOFT_RAD
        if of.bell:  # an amplitude that scatters is heard a little sooner or later
            k, half = at[of.first + 4], 0.5 * float(at[of.first + 1] - at[of.first])
            soft = min(spread / (2.0 * k * half), half)
        sigma = math.sqrt(max(step**2 / 12.0, step * soft / math.sqrt(math.pi)) + declared.noise.scan_rad**2)
        for t_s, entering in ((one.enters_s, True), (one.leaves_s, False)):
            edge = lower if entering is (one.sense > 0) else upper
            out.append((float(_theta(of.sweep, one, t_s, p)) - edge) / sigma)
    return np.array(out)


def _passes(sweep: Sweep) -> tuple[_Pass, ...]:
    """The passes of a recording, in order. Raises EstimationError where there are not both senses."""
    if sweep.stage_s.size < 4 or sweep.pulse_s.size < 2 * SILENT + LEAST_HEARD:
        found = f"{sweep.pulse_s.size} pulses and {sweep.stage_s.size} readings of the stage"
        raise EstimationError(f"{sweep.name} has {found}: too few for a sweep past a PM")

    def reading(t_s: FloatArray) -> FloatArray:
        return np.asarray(np.interp(t_s, sweep.stage_s, sweep.stage_rad))

    speed = (reading(sweep.pulse_s + SPEED_S) - reading(sweep.pulse_s - SPEED_S)) / (2.0 * SPEED_S)
    sense = np.where(np.abs(speed) > MOVING * np.abs(speed).max(initial=0.0), np.sign(speed), 0.0).astype(int)
    breaks = np.flatnonzero(np.diff(sense)) + 1
    out = []
    for run in np.split(np.arange(sense.size), breaks):
        if sense[run[0]] == 0:
            continue
        one = _pass(sweep, run, int(sense[run[0]]), float(np.median(np.abs(speed[run]))))
        if one is not None:
            out.append(one)
    if {one.sense for one in out} != {1, -1}:
        found = "in one sense only" if out else "in neither sense"
        raise EstimationError(
            f"{sweep.name} passes the PM {found}: turn the stage past it both ways, from silence to silence"
        )
    return tuple(out)


def _pass(sweep: Sweep, run: IntArray, sense: int, speed: float) -> _Pass | None:
    """The pass within a run of pulses; None where the PM is not heard from silence to silence."""
    heard = sweep.heard[run].copy()
    for i in range(2, heard.size - 2):  # a pulse that failed
        if not heard[i] and heard[[i - 2, i - 1, i + 1, i + 2]].all():
            heard[i] = True
    where = np.flatnonzero(heard)
    if where.size < LEAST_HEARD:
        return None
    middle = int(where[where.size // 2])
    t = sweep.pulse_s[run]
    cell = np.gradient(t)
    # What was heard, counted in pulses, and not the first and the last: these lie too far out where an edge is soft.
    enters = float(t[middle] - 0.5 * (t[middle] - t[middle - 1]) - cell[:middle][heard[:middle]].sum())
    leaves = float(t[middle] + 0.5 * (t[middle + 1] - t[middle]) + cell[middle + 1 :][heard[middle + 1 :]].sum())
    if (t < enters).sum() < SILENT or (t > leaves).sum() < SILENT:
        return None
    return _Pass(sense, speed, enters, leaves, float(np.median(cell)), run[where])


def _start(fitted: Sequence[_Fitted], size: int) -> tuple[FloatArray, FloatArray]:
    start, scale = np.zeros(size), np.ones(size)
    scale[:2] = 0.01, math.radians(0.1)
    for of in fitted:
        ends = np.array([[_theta(of.sweep, one, t, start) for t in (one.enters_s, one.leaves_s)] for one in of.passes])
        start[of.first : of.first + 2] = ends.min(axis=1).mean(), ends.max(axis=1).mean()
        scale[of.first : of.first + 2] = math.radians(0.1)
        if of.bell:
            lower, upper = start[of.first : of.first + 2]
            k = math.log(2.0) / (0.5 * (upper - lower)) ** 2
            start[of.first + 2 : of.first + 5] = 0.5 * (lower + upper), 0.0, k
            scale[of.first + 2 : of.first + 5] = math.radians(0.1), 0.1, 0.1 * k
    return start, scale


def _inside(of: _Fitted, p: FloatArray) -> list[IntArray]:
    """Of each pass, the pulses with an amplitude that are well inside the window."""
    lower, upper = p[of.first : of.first + 2]
    out = []
    for one in of.passes:
        angle = _theta(of.sweep, one, of.sweep.pulse_s[one.heard], p)
        inner = np.abs(angle - 0.5 * (lower + upper)) < INNER * 0.5 * (upper - lower)
        out.append(one.heard[inner & (np.nan_to_num(of.sweep.amplitude[one.heard]) > 0.0)])
    return out


def _bells(fitted: Sequence[_Fitted], p: FloatArray, inside: Mapping[int, list[IntArray]]) -> FloatArray:
    """The parameters with the bells fitted to the amplitudes at these angles."""
    p = p.copy()
    for of in fitted:
        if not of.bell:
            continue
        angle = np.concatenate(
            [_theta(of.sweep, one, of.sweep.pulse_s[h], p) for one, h in zip(of.passes, inside[of.first], strict=True)]
        )
        log = np.log(np.concatenate([of.sweep.amplitude[heard] for heard in inside[of.first]]))
        if angle.size < LEAST_HEARD:
            raise EstimationError(f"{of.sweep.name} has {angle.size} amplitudes within the window: turn more slowly")
        middle = float(angle.mean())
        a, b, c = np.polyfit(angle - middle, log, 2)
        if a >= 0.0:
            raise EstimationError(f"{of.sweep.name} has amplitudes that do not fall off to both sides of the PM")
        p[of.first + 2 : of.first + 5] = middle - b / (2.0 * a), c - b * b / (4.0 * a), -a
    return p


def _spread(of: _Fitted, p: FloatArray, inside: list[IntArray]) -> float:
    """Standard deviation of the log amplitudes about each pass' own bell: a delay moves them apart."""
    if not of.bell:
        return 0.1
    square, dof = 0.0, 0
    for one, heard in zip(of.passes, inside, strict=True):
        if heard.size > 3:
            angle = _theta(of.sweep, one, of.sweep.pulse_s[heard], p)
            log, angle = np.log(of.sweep.amplitude[heard]), angle - angle.mean()
            square += float(np.sum((log - np.polyval(np.polyfit(angle, log, 2), angle)) ** 2))
            dof += heard.size - 3
    return max(math.sqrt(square / dof), 0.01) if dof else 0.1


def _results(found: Optimum, fitted: Sequence[_Fitted], told: bool) -> list[Found]:
    p, sigma = found.value, np.sqrt(np.diag(found.covariance))
    passes = sum(len(of.passes) for of in fitted)
    how = f"{passes} passes of the stage in both senses"
    out = []
    thresholds = []
    for of in fitted:
        heard = np.concatenate([one.heard for one in of.passes])
        depth = float(np.median(of.sweep.range_mm[heard]))
        half = 0.5 * float(p[of.first + 1] - p[of.first])
        if half < NARROWEST_RAD:
            narrow = f"{of.sweep.name}: a window of half width {math.degrees(half):.2g} deg"
            raise EstimationError(f"{narrow}: give scan_deg in degrees")
        g = np.zeros(p.size)
        g[of.first : of.first + 2] = -0.5, 0.5
        text = f"{len(of.passes)} passes of {of.sweep.name}, where the PM begins and ends to be heard"
        name = "probe.sensitivity.half_width_deg"
        out.append(Found(name, math.degrees(half), math.degrees(found.sigma(g)), "deg", text, depth_mm=depth))
        if not of.bell:
            continue
        for place, edge in ((0, "lower_edge_deg"), (1, "upper_edge_deg")):
            g = np.zeros(p.size)
            g[of.first + place], g[of.first + 2] = 1.0, -1.0
            value = math.degrees(float(p[of.first + place] - p[of.first + 2]))
            text = f"{of.sweep.name}: device angle from where the PM is loudest"
            out.append(Found(edge, value, math.degrees(found.sigma(g)), "deg", text, depth_mm=depth))
        thresholds.append(_threshold(found, of))
    if thresholds:
        weight = np.array([1.0 / sigma**2 for _, sigma in thresholds])
        log = float(weight @ [value for value, _ in thresholds] / weight.sum())
        value, spread = math.exp(log), math.exp(log) / math.sqrt(float(weight.sum()))
        text = f"{how}: the amplitude at the edges of the window"
        out.append(Found("settings.hearing_threshold", value, spread, "", text))
    text = how + ("" if told else "; all at one speed, so that a backlash as declared is part of the sigma")
    out.append(Found("stage_less_pulse_latency_s", float(p[0]), float(sigma[0]), "s", text))
    if told:
        text = f"{how}, at two speeds or more"
        out.append(Found("backlash_deg", math.degrees(float(p[1])), math.degrees(float(sigma[1])), "deg", text))
    return out


def _threshold(found: Optimum, of: _Fitted) -> tuple[float, float]:
    """Log amplitude at the edges, the mean of both, and its standard deviation."""
    lower, upper, phi, log, k = found.value[of.first : of.first + 5]
    square = 0.5 * ((lower - phi) ** 2 + (upper - phi) ** 2)
    g = np.zeros(found.value.size)
    g[of.first : of.first + 5] = -k * (lower - phi), -k * (upper - phi), k * (lower + upper - 2.0 * phi), 1.0, -square
    return float(log - k * square), found.sigma(g)
