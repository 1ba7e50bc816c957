"""Sensitivity prior: a PM heard at stage angle t lies within the sensitivity window about the plane.

Equation (docs/model.md, section 2). With delta = theta - t, R the probe's radius and r the observed range:

    rotation = atan2(c r sin delta, R + c r cos delta)      the *stage* rotation that brings the PM into the plane
    e = rotation - centre - gain * window_edge

The window was measured by turning the stage, so it bounds the rotation, not delta: at R = 10 mm, r = 30 mm, 6 deg of
rotation is 8.0 deg of arc. This prior is what fixes the roll about the TRUS x axis.

Two cases, whose centre, gain and sigma come from :mod:`fgreg.model.sensitivity`: window only (centre 0, gain 0), and a
sweep that stopped at its first hit (the offset is then close to the window's near edge, and ``window_edge``, the error
of the known half width, one unknown of the session, moves it).

Residual: (1,) rad, wrapped to (-pi, pi]. Jacobians, in the order of the keys: (1, 1) theta, (1, 1) window_edge,
(1, 1) sound_speed_ratio.
"""

from __future__ import annotations

import math

import gtsam

from fgreg.factors.adapter import Residual, custom_factor


def residual(
    theta_rad: float,
    window_edge_rad: float,
    sound_speed_ratio: float,
    scan_rad: float,
    range_mm: float,
    radius_mm: float,
    centre_rad: float,
    edge_gain: float,
    want_jacobians: bool = True,
) -> Residual:
    """The rotation offset of an arc angle against its expected value.

    Args:
        theta_rad: arc angle theta' (TRUS convention).
        window_edge_rad: error of the known half width.
        sound_speed_ratio: c.
        scan_rad: stage angle t.
        range_mm: observed range, from the element.
        radius_mm: of the probe.
        centre_rad, edge_gain: expected rotation, ``centre + gain * window_edge``.
        want_jacobians: whether to compute them.

    Returns:
        error (1,) rad; Jacobians (1, 1), (1, 1), (1, 1), or none.
    """
    delta = theta_rad - scan_rad
    reach = sound_speed_ratio * range_mm
    sine, cosine = math.sin(delta), math.cos(delta)
    up, along = reach * sine, radius_mm + reach * cosine
    miss = math.atan2(up, along) - centre_rad - edge_gain * window_edge_rad
    error = (math.pi - (math.pi - miss) % math.tau,)  # into (-pi, pi]
    if not want_jacobians:
        return error, ()
    distance2 = up * up + along * along
    by_theta = reach * (reach + radius_mm * cosine) / distance2
    by_ratio = range_mm * radius_mm * sine / distance2
    return error, (((by_theta,),), ((-edge_gain,),), ((by_ratio,),))


def sensitivity_prior_factor(
    theta_key: int,
    scan_rad: float,
    range_mm: float,
    radius_mm: float,
    centre_rad: float,
    edge_gain: float,
    sigma_rad: float,
    window_edge_key: int | None = None,
    sound_speed_ratio_key: int | None = None,
) -> gtsam.CustomFactor:
    """The factor of a look: theta, and where given window_edge and sound_speed_ratio; all are doubles.

    ``sigma_rad`` is of the rotation offset about its centre. Without ``window_edge_key`` the edge counts as exact,
    without ``sound_speed_ratio_key`` the ratio is 1.
    """
    keys = [theta_key]
    slots = [0]
    for slot, key in ((1, window_edge_key), (2, sound_speed_ratio_key)):
        if key is not None:
            keys.append(key)
            slots.append(slot)

    def evaluate(values: gtsam.Values, want_jacobians: bool) -> Residual:
        error, jacobians = residual(
            values.atDouble(theta_key),
            0.0 if window_edge_key is None else values.atDouble(window_edge_key),
            1.0 if sound_speed_ratio_key is None else values.atDouble(sound_speed_ratio_key),
            scan_rad,
            range_mm,
            radius_mm,
            centre_rad,
            edge_gain,
            want_jacobians,
        )
        return error, [jacobians[slot] for slot in slots] if want_jacobians else ()

    noise_model = gtsam.noiseModel.Isotropic.Sigma(1, sigma_rad)
    return custom_factor("sensitivity prior", noise_model, keys, 1, [1] * len(keys), evaluate)
