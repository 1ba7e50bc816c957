"""Sensitivity prior: a PM heard at stage angle t lies within the sensitivity window about the plane.

Equation (docs/model.md, section 2). With delta = theta - t, R the probe's radius and r the range, both with the rig's
constants (fgreg.geometry.rig):

    rotation = atan2(r sin delta, R + r cos delta)      the *stage* rotation that brings the PM into the plane
    e = rotation - centre - gain * window_edge - window_centre

The window was measured by turning the stage, so it bounds the rotation, not delta: at R = 10 mm, r = 30 mm, 6 deg of
rotation is 8.0 deg of arc. This prior is what fixes the roll about the TRUS x axis.

Two cases, whose centre, gain and sigma come from :mod:`fgreg.model.sensitivity`: window only (centre 0, gain 0), and a
sweep that stopped at its first hit (the offset is then close to the window's near edge, and ``window_edge``, the error
of the known half width, one unknown of the session, moves it).

Residual: (1,) rad, wrapped to (-pi, pi]. Jacobians, in the order of the keys: (1, 1) theta, (1, K) rig.
"""

from __future__ import annotations

import math

import gtsam

from fgreg.factors.adapter import Residual, Row, custom_factor
from fgreg.factors.rig import AS_DECLARED, RigKey, rig_rows
from fgreg.geometry.rig import Constant


def residual(
    theta_rad: float,
    constants: Row,
    scan_rad: float,
    range_mm: float,
    radius_mm: float,
    centre_rad: float,
    edge_gain: float,
    sweep: int = 0,
    want_jacobians: bool = True,
) -> Residual:
    """The rotation offset of an arc angle against its expected value.

    Args:
        theta_rad: arc angle theta' (TRUS convention).
        constants: (COUNT,) the rig's, true less declared.
        scan_rad: reading of the stage angle. sweep: +1, -1, or 0 where it is not known.
        range_mm: observed range, from the element.
        radius_mm: declared, of the probe.
        centre_rad, edge_gain: expected rotation, ``centre + gain * window_edge``.
        want_jacobians: whether to compute them.

    Returns:
        error (1,) rad; Jacobians (1, 1), (1, COUNT), or none.
    """
    delta = theta_rad - scan_rad + sweep * constants[Constant.BACKLASH]
    reach = (1.0 + constants[Constant.SOUND_SPEED]) * range_mm + constants[Constant.RANGE_OFFSET]
    radius = radius_mm + constants[Constant.RADIUS]
    sine, cosine = math.sin(delta), math.cos(delta)
    up, along = reach * sine, radius + reach * cosine
    expected = centre_rad + edge_gain * constants[Constant.WINDOW_EDGE] + constants[Constant.WINDOW_CENTRE]
    miss = math.atan2(up, along) - expected
    error = (math.pi - (math.pi - miss) % math.tau,)  # into (-pi, pi]
    if not want_jacobians:
        return error, ()
    distance2 = up * up + along * along
    by_theta = reach * (reach + radius * cosine) / distance2
    by_reach = radius * sine / distance2
    by_rig = [0.0] * len(constants)
    by_rig[Constant.WINDOW_EDGE], by_rig[Constant.WINDOW_CENTRE] = -edge_gain, -1.0
    by_rig[Constant.RADIUS] = -up / distance2
    by_rig[Constant.SOUND_SPEED], by_rig[Constant.RANGE_OFFSET] = by_reach * range_mm, by_reach
    by_rig[Constant.BACKLASH] = sweep * by_theta
    return error, (((by_theta,),), (by_rig,))


def sensitivity_prior_factor(
    theta_key: int,
    scan_rad: float,
    range_mm: float,
    radius_mm: float,
    centre_rad: float,
    edge_gain: float,
    sigma_rad: float,
    rig: RigKey | None = None,
    sweep: int = 0,
) -> gtsam.CustomFactor:
    """The factor of a look: theta, double, and where given the rig, Vector K.

    ``sigma_rad`` is of the rotation offset about its centre. Without ``rig`` the constants are as declared.
    """
    keys, sizes = [theta_key], [1]
    if rig is not None:
        keys.append(rig.key)
        sizes.append(len(rig.constants))

    def evaluate(values: gtsam.Values, want_jacobians: bool) -> Residual:
        error, jacobians = residual(
            values.atDouble(theta_key),
            AS_DECLARED if rig is None else rig.read(values),
            scan_rad,
            range_mm,
            radius_mm,
            centre_rad,
            edge_gain,
            sweep,
            want_jacobians,
        )
        return error, rig_rows(jacobians, rig)

    noise_model = gtsam.noiseModel.Isotropic.Sigma(1, sigma_rad)
    return custom_factor("sensitivity prior", noise_model, keys, 1, sizes, evaluate)
