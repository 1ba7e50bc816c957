"""The information of the probe's sensitivity window on a look, as stage rotation (docs/model.md, section 2).

A PM at range r from the element, delta off the plane on its arc, comes into the plane when the stage turns by

    rotation = atan2(r sin delta, R + r cos delta),        R the probe's radius,

since the arc is centred on the element but the stage turns about the axis, R behind it. The window was measured by
turning the stage, so it bounds the rotation. At R = 10 mm, r = 30 mm, 6 deg of rotation is 8.0 deg of arc.

All functions are pure and work on arrays and on numbers; millimetres and radians.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import log_ndtr

from fgreg.geometry.transforms import FloatArray
from fgreg.model.measurements import Look
from fgreg.model.probe_model import SensitivityModel

_Angles = npt.ArrayLike

MIN_SOFTNESS_RAD = 1e-3
"""Least softness of a window's edge (0.06 deg): no probe's window has a step as its edge."""


def wrap_angle(angle_rad: _Angles) -> FloatArray:
    """Angles into (-pi, pi]."""
    return np.asarray(np.pi - np.mod(np.pi - np.asarray(angle_rad, dtype=np.float64), 2.0 * np.pi))


def rotation_of_arc(delta_rad: _Angles, range_mm: _Angles, radius_mm: float) -> FloatArray:
    """Stage rotation (rad) that brings a PM into the plane, from its arc angle off the plane and its range."""
    delta, r = np.asarray(delta_rad, dtype=np.float64), np.asarray(range_mm, dtype=np.float64)
    return np.asarray(np.arctan2(r * np.sin(delta), radius_mm + r * np.cos(delta)))


def arc_of_rotation(rotation_rad: _Angles, range_mm: _Angles, radius_mm: float) -> FloatArray:
    """Arc angle off the plane (rad) for a stage rotation: the inverse of :func:`rotation_of_arc`.

    By the law of sines in the triangle axis, element, PM: R / sin(delta - rotation) = r / sin(rotation), so
    delta = rotation + asin(R sin(rotation) / r), on the branch that contains 0. Seen from the axis, a PM nearer to the
    element than R is at most asin(r / R) off the plane; larger rotations give the nearest arc angle.
    """
    rotation, r = np.asarray(rotation_rad, dtype=np.float64), np.asarray(range_mm, dtype=np.float64)
    widest = np.where(r < radius_mm, np.arcsin(np.minimum(r / radius_mm, 1.0)), np.pi)
    rotation = np.clip(rotation, -widest, widest)
    return np.asarray(rotation + np.arcsin(np.clip(radius_mm * np.sin(rotation) / r, -1.0, 1.0)))


AMPLITUDE_SIGMA = 0.05
"""Relative noise of amplitudes."""
TABLE_SIZE, TABLE_MARGIN_RAD = 241, math.radians(3.0)
"""Number of plane angles at which amplitudes are compared with the curve, and their margin beyond the window."""


@dataclass(frozen=True, slots=True)
class SensitivityPrior:
    """Gaussian prior of one look's stage rotation: ``centre + edge_gain * window_edge``, with sigma ``sigma_rad``.

    Attributes:
        centre_rad: expected stage rotation.
        edge_gain: +1 or -1 where the window's edge was met sweeping that way, else 0.
        sigma_rad: standard deviation about it, including the stage reading's.
    """

    centre_rad: float
    edge_gain: float
    sigma_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class SensitivityPriors:
    """:class:`SensitivityPrior` of n looks: arrays (n,)."""

    centre_rad: FloatArray
    edge_gain: FloatArray
    sigma_rad: FloatArray


def window_priors(
    range_mm: _Angles, sweep: _Angles, scan_sigma_rad: _Angles, sensitivity: SensitivityModel, step_rad: float
) -> SensitivityPriors:
    """The priors of n looks from plain arrays.

    Window only (sweep 0): uniform over +-w, as a Gaussian of sigma w / sqrt(3).
    First hit (sweep s = +-1): one step earlier was silent, so the rotation is uniform over (w - step, w] ahead in the
    sweep's direction: centre s (w - step / 2), sigma step / sqrt(12). An error of the half width moves the centre by s.
    A step of 2 w or more adds no information to the window, so the prior is that of the first case.

    Args:
        range_mm: (n,) observed ranges, the depths at which the window's half width w is taken.
        sweep: (n,) +1, -1 or 0.
        scan_sigma_rad: (n,) of the stage reading and of the window from PM to PM, added in square.
        sensitivity: the window.
        step_rad: the sweep's increment.
    """
    s = np.asarray(sweep, dtype=np.float64)
    w = sensitivity.half_width_at(np.asarray(range_mm, dtype=np.float64))
    span = np.where((s != 0.0) & (step_rad < 2.0 * w), step_rad, 2.0 * w)  # width of the interval of possible rotations
    informed = span < 2.0 * w
    return SensitivityPriors(
        centre_rad=np.asarray(np.where(informed, s * (w - span / 2.0), 0.0)),
        edge_gain=np.asarray(np.where(informed, s, 0.0)),
        sigma_rad=np.asarray(np.sqrt(span * span / 12.0 + np.square(np.asarray(scan_sigma_rad, dtype=np.float64)))),
    )


def sensitivity_priors(looks: Sequence[Look], sensitivity: SensitivityModel, step_rad: float) -> SensitivityPriors:
    """The priors of n looks, arrays (n,); see :func:`window_priors`."""
    return window_priors(
        [look.range_mm for look in looks],
        [look.sweep for look in looks],
        _end_sigmas(looks),
        sensitivity,
        step_rad,
    )


def _end_sigmas(looks: Sequence[Look]) -> list[float]:
    """Standard deviation (rad) of each look's window ends against the plane: stage reading, and from PM to PM."""
    return [math.hypot(look.scan_sigma_rad, look.window_sigma_rad) for look in looks]


def sensitivity_prior(look: Look, sensitivity: SensitivityModel, step_rad: float) -> SensitivityPrior:
    """The prior of one look; see :func:`window_priors`."""
    priors = sensitivity_priors([look], sensitivity, step_rad)
    return SensitivityPrior(float(priors.centre_rad[0]), float(priors.edge_gain[0]), float(priors.sigma_rad[0]))


@dataclass(frozen=True, slots=True, eq=False)
class WindowShapes:
    """Intervals of stage rotation of n looks, arrays (n,): the window in its own shape, not as a Gaussian.

    The likelihood of a rotation is one inside ``(low + low_gain * window_edge, high + high_gain * window_edge)`` and
    zero outside, softened by the stage reading's noise.

    Attributes:
        low_rad, high_rad: the interval's ends.
        low_gain, high_gain: their derivative by the error of the half width: -1, +1 for the window itself, the sweep's
            sign for both ends of a first hit.
        soft_rad: standard deviation of the ends' softness.
    """

    low_rad: FloatArray
    high_rad: FloatArray
    low_gain: FloatArray
    high_gain: FloatArray
    soft_rad: FloatArray


def window_shapes(looks: Sequence[Look], sensitivity: SensitivityModel, step_rad: float) -> WindowShapes:
    """The intervals of n looks; the cases are those of :func:`window_priors`."""
    s = np.array([look.sweep for look in looks], dtype=np.float64)
    w = sensitivity.half_width_at(np.array([look.range_mm for look in looks], dtype=np.float64))
    informed = (s != 0.0) & (step_rad < 2.0 * w)
    near = w - step_rad
    return WindowShapes(
        low_rad=np.where(informed & (s > 0), near, -w),
        high_rad=np.where(informed & (s < 0), -near, w),
        low_gain=np.where(informed, s, -1.0),
        high_gain=np.where(informed, s, 1.0),
        soft_rad=np.maximum(_end_sigmas(looks), MIN_SOFTNESS_RAD).reshape(len(looks)),
    )


def log_interval(low: _Angles, high: _Angles, sigma: _Angles) -> FloatArray:
    """Log of the probability that a Gaussian of mean 0 and ``sigma`` lies between ``low`` and ``high``; any shapes.

    Exact in both tails, where the difference of the two distribution functions would be 0.
    """
    per_sigma = 1.0 / np.asarray(sigma, dtype=np.float64)
    a, b = np.asarray(low, dtype=np.float64) * per_sigma, np.asarray(high, dtype=np.float64) * per_sigma
    flip = a + b > 0.0  # on the side where the distribution function is small
    lower, upper = np.where(flip, -b, a), np.where(flip, -a, b)
    log_upper = log_ndtr(upper)
    return np.asarray(log_upper + np.log(-np.expm1(np.minimum(log_ndtr(lower) - log_upper, -1e-16))))


def interval_moments(low: _Angles, high: _Angles, sigma: _Angles) -> tuple[FloatArray, FloatArray]:
    """First and minus second derivative of :func:`log_interval` by a common shift of the Gaussian's mean.

    With ``low`` and ``high`` counted from the mean, densities p at the ends and the probability Z between:
    g = (p(low) - p(high)) / Z, and g^2 - (low p(low) - high p(high)) / (sigma^2 Z).
    """
    a, b = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    sigma = np.asarray(sigma, dtype=np.float64)
    scale = -0.5 * np.log(2.0 * np.pi) - np.log(sigma) - log_interval(a, b, sigma)
    at_low, at_high = np.exp(scale - 0.5 * (a / sigma) ** 2), np.exp(scale - 0.5 * (b / sigma) ** 2)
    slope = at_low - at_high
    return slope, slope * slope - (a * at_low - b * at_high) / sigma**2


@dataclass(frozen=True, slots=True, eq=False)
class AmplitudeTable:
    """Log likelihood (G,) of a PM's amplitudes at plane angles (G,), 0 at its best; ``used``: False without amplitudes.

    The plane angle is that at which the image plane passes through the PM: scan angle plus rotation.
    """

    plane_rad: FloatArray
    log_likelihood: FloatArray
    used: bool


@dataclass(frozen=True, slots=True, eq=False)
class AmplitudeCurve:
    """Log amplitude (m,) against stage rotation (m,), and its slope (m,) per rad."""

    rotation_rad: FloatArray
    log_amplitude: FloatArray
    slope: FloatArray


def amplitude_curve(sensitivity: SensitivityModel) -> AmplitudeCurve | None:
    """The logarithm of a session's amplitude curve, where it has one."""
    rotations, curve = sensitivity.curve_rotation_rad, sensitivity.curve_amplitude
    if rotations is None or curve is None:
        return None
    log = np.asarray(np.log(np.maximum(curve, 1e-3 * float(np.max(curve)))))
    return AmplitudeCurve(rotations, log, np.asarray(np.gradient(log, rotations)))


def amplitude_table(looks: Sequence[Look], sensitivity: SensitivityModel, amplitude_sigma: float) -> AmplitudeTable:
    """Likelihood of a PM's plane angle from the amplitudes of its looks, with the unknown peak eliminated.

    ``log amplitude = log peak + log curve(rotation) + noise``: at a plane angle each look gives one estimate of the
    peak. With a flat prior on the logarithm of the peak the likelihood is that of their scatter about the weighted
    mean. The stage reading's noise enters by the curve's slope. Needs two looks with amplitudes, and a curve.
    """
    scan = np.array([look.scan_rad for look in looks])
    detected = [(look.scan_rad, look.scan_sigma_rad, look.amplitude) for look in looks if look.amplitude]
    reach = float(sensitivity.half_width_rad.max()) + TABLE_MARGIN_RAD
    plane = np.linspace(scan.min() - reach, scan.max() + reach, TABLE_SIZE)
    curve = amplitude_curve(sensitivity)
    if len(detected) < 2 or curve is None:
        return AmplitudeTable(plane, np.zeros(TABLE_SIZE), False)
    at, at_sigma, amplitude = np.array(detected, dtype=np.float64).T[:, :, None]
    rotation = plane - at
    peak = np.log(amplitude) - np.interp(rotation, curve.rotation_rad, curve.log_amplitude)
    slope = np.interp(rotation, curve.rotation_rad, curve.slope)
    weight = 1.0 / (amplitude_sigma**2 + (slope * at_sigma) ** 2)
    mean = np.sum(weight * peak, axis=0) / np.sum(weight, axis=0)
    log = -0.5 * np.sum(weight * (peak - mean) ** 2 - np.log(weight), axis=0) - 0.5 * np.log(np.sum(weight, axis=0))
    return AmplitudeTable(plane, log - log.max(), True)
