"""What the probe's sensitivity window says about a look, in terms of stage rotation (design.md, Geometry).

A PM at range r from the element, delta off the plane on its arc, comes into the plane when the stage turns by

    rotation = atan2(r sin delta, R + r cos delta),        R the probe's radius,

since the arc is centred on the element but the stage turns about the axis, R behind it. The window was measured by
turning the stage: it bounds the rotation. At R = 10 mm, r = 30 mm, 6 deg of rotation is 8.0 deg of arc.

Everything here is pure and works on arrays as well as on numbers; millimetres and radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fgreg.frames import FloatArray
from fgreg.measurements import Look
from fgreg.models import ProbeModel, SensitivityModel

_Angles = npt.ArrayLike


def wrap_angle(angle_rad: _Angles) -> FloatArray:
    """Angles into (-pi, pi]."""
    return np.asarray(np.pi - np.mod(np.pi - np.asarray(angle_rad, dtype=np.float64), 2.0 * np.pi))


def rotation_of_arc(delta_rad: _Angles, range_mm: _Angles, radius_mm: float) -> FloatArray:
    """Stage rotation (rad) that brings a PM into the plane, from its arc angle off the plane and its range."""
    delta, r = np.asarray(delta_rad, dtype=np.float64), np.asarray(range_mm, dtype=np.float64)
    return np.asarray(np.arctan2(r * np.sin(delta), radius_mm + r * np.cos(delta)))


def rotation_of_arc_derivatives(
    delta_rad: _Angles, range_mm: _Angles, radius_mm: float
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of :func:`rotation_of_arc` by delta (rad / rad) and by range (rad / mm).

    With D^2 = R^2 + r^2 + 2 R r cos delta, the squared distance from the axis:
    r (r + R cos delta) / D^2 and R sin delta / D^2.
    """
    delta, r = np.asarray(delta_rad, dtype=np.float64), np.asarray(range_mm, dtype=np.float64)
    cosine = np.cos(delta)
    distance2 = radius_mm * radius_mm + r * r + 2.0 * radius_mm * r * cosine
    return np.asarray(r * (r + radius_mm * cosine) / distance2), np.asarray(radius_mm * np.sin(delta) / distance2)


def arc_of_rotation(rotation_rad: _Angles, range_mm: _Angles, radius_mm: float) -> FloatArray:
    """Arc angle off the plane (rad) for a stage rotation: the inverse of :func:`rotation_of_arc`.

    By the law of sines in the triangle axis, element, PM: R / sin(delta - rotation) = r / sin(rotation), so
    delta = rotation + asin(R sin(rotation) / r), on the branch that contains 0. A PM nearer to the element than R
    can be at most asin(r / R) off, seen from the axis; for rotations beyond, the arc angle that comes nearest.
    """
    rotation, r = np.asarray(rotation_rad, dtype=np.float64), np.asarray(range_mm, dtype=np.float64)
    widest = np.where(r < radius_mm, np.arcsin(np.minimum(r / radius_mm, 1.0)), np.pi)
    rotation = np.clip(rotation, -widest, widest)
    return np.asarray(rotation + np.arcsin(np.clip(radius_mm * np.sin(rotation) / r, -1.0, 1.0)))


@dataclass(frozen=True, slots=True)
class SensitivityPrior:
    """What one look says: its stage rotation is ``centre + edge_gain * window_edge``, give or take ``sigma``.

    Attributes:
        centre_rad: expected stage rotation.
        edge_gain: +1 or -1 where the window's edge was met sweeping that way, else 0.
        sigma_rad: standard deviation about it, stage reading included.
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
    First hit (sweep s = +-1): nothing was heard a step earlier, so the rotation is uniform over (w - step, w] ahead in
    the sweep's direction: centre s (w - step / 2), sigma step / sqrt(12), and an error of the known half width moves
    it by s. A step of 2 w or more tells nothing beyond the window, and the case above is what it comes to.

    Args:
        range_mm: (n,) observed ranges, the depths at which the window's half width w is taken.
        sweep: (n,) +1, -1 or 0.
        scan_sigma_rad: (n,) of the stage reading, added in square.
        sensitivity: the window.
        step_rad: the sweep's increment.
    """
    s = np.asarray(sweep, dtype=np.float64)
    w = sensitivity.half_width_at(np.asarray(range_mm, dtype=np.float64))
    span = np.where((s != 0.0) & (step_rad < 2.0 * w), step_rad, 2.0 * w)  # of rotations that fit what was heard
    informed = span < 2.0 * w
    return SensitivityPriors(
        centre_rad=np.asarray(np.where(informed, s * (w - span / 2.0), 0.0)),
        edge_gain=np.asarray(np.where(informed, s, 0.0)),
        sigma_rad=np.asarray(np.sqrt(span * span / 12.0 + np.square(np.asarray(scan_sigma_rad, dtype=np.float64)))),
    )


def sensitivity_priors(looks: Sequence[Look], probe: ProbeModel, step_rad: float) -> SensitivityPriors:
    """The priors of n looks, arrays (n,); see :func:`window_priors`."""
    return window_priors(
        [look.range_mm for look in looks],
        [look.sweep for look in looks],
        [look.scan_sigma_rad for look in looks],
        probe.sensitivity,
        step_rad,
    )


def sensitivity_prior(look: Look, probe: ProbeModel, step_rad: float) -> SensitivityPrior:
    """The prior of one look; see :func:`window_priors`."""
    priors = sensitivity_priors([look], probe, step_rad)
    return SensitivityPrior(float(priors.centre_rad[0]), float(priors.edge_gain[0]), float(priors.sigma_rad[0]))
