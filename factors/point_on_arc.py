"""Point on arc: a PM lies on the arc of each look at it.

Equation (Song et al.'s arc; docs/model.md, section 2), t the look's stage angle, R the probe's radius, r the range:

    element centre  o = (x, R sin t, R cos t)
    arc point       a(theta) = o + c r (0, sin theta, cos theta)
    e = (p - a) along the axes  x (1, 0, 0),  radial (0, sin theta, cos theta),  tangential (0, cos theta, -sin theta)

The arc is centred on the element, because the time of flight from there is what is measured. c, the ratio of true to
assumed sound speed, is 1 unless it is a variable.

Residual: (3,) mm. Jacobians, in the order of the keys: (3, 3) trus_p_pm, (3, 1) theta, (3, 1) sound_speed_ratio.

Noise: the look's 2x2 covariance of (x, range) on the first two, so that range noise acts along the radius only (where c
is a variable it scales the range, not its sigma). The third is a definition and has the coincidence sigma.

The stage reading's noise enters by the sensitivity prior only. Here a wrong t moves the arc's centre along its tangent
by R dt, 0.02 mm for 0.1 deg at R = 10 mm, which theta compensates; the rest across the arc is negligible.
"""

from __future__ import annotations

import math

import gtsam
import numpy as np

from fgreg.factors.adapter import Residual, Row, custom_factor
from fgreg.factors.point_on_line import COINCIDENCE_SIGMA_MM
from fgreg.geometry.transforms import FloatArray, as_float_array


def residual(
    trus_p_pm: Row,
    theta_rad: float,
    sound_speed_ratio: float,
    trus_p_element: Row,
    range_mm: float,
    want_jacobians: bool = True,
) -> Residual:
    """The miss of a PM against the arc's point at ``theta_rad``.

    Args:
        trus_p_pm: (3,) mm.
        theta_rad: arc angle theta' (TRUS convention).
        sound_speed_ratio: c.
        trus_p_element: (3,) mm, (x, R sin t, R cos t) of the look.
        range_mm: of the look, from the element.
        want_jacobians: whether to compute them.

    Returns:
        error (3,) mm along (x, radial, tangential); Jacobians (3, 3), (3, 1), (3, 1), or none.
    """
    sine, cosine = math.sin(theta_rad), math.cos(theta_rad)
    dy, dz = trus_p_pm[1] - trus_p_element[1], trus_p_pm[2] - trus_p_element[2]
    reach, tangential = dy * sine + dz * cosine, dy * cosine - dz * sine
    error = (trus_p_pm[0] - trus_p_element[0], reach - sound_speed_ratio * range_mm, tangential)
    if not want_jacobians:
        return error, ()
    return error, (
        ((1.0, 0.0, 0.0), (0.0, sine, cosine), (0.0, cosine, -sine)),
        ((0.0,), (tangential,), (-reach,)),
        ((0.0,), (-range_mm,), (0.0,)),
    )


def point_on_arc_factor(
    trus_p_pm_key: int,
    theta_key: int,
    scan_rad: float,
    x_mm: float,
    range_mm: float,
    covariance: FloatArray,
    radius_mm: float,
    sound_speed_ratio_key: int | None = None,
) -> gtsam.CustomFactor:
    """The factor of a look: Point3, double, and where given the ratio, double.

    Args:
        trus_p_pm_key, theta_key, sound_speed_ratio_key: variables.
        scan_rad, x_mm, range_mm: the look.
        covariance: (2, 2) mm^2 over (x, range).
        radius_mm: of the probe.
    """
    element = (x_mm, radius_mm * math.sin(scan_rad), radius_mm * math.cos(scan_rad))
    full = np.zeros((3, 3))
    full[:2, :2] = as_float_array(covariance, 2, 2)
    full[2, 2] = COINCIDENCE_SIGMA_MM**2
    noise_model = gtsam.noiseModel.Gaussian.Covariance(full)
    if sound_speed_ratio_key is None:

        def evaluate(values: gtsam.Values, want_jacobians: bool) -> Residual:
            error, jacobians = residual(
                values.atPoint3(trus_p_pm_key).tolist(),
                values.atDouble(theta_key),
                1.0,
                element,
                range_mm,
                want_jacobians,
            )
            return error, jacobians[:2]

        return custom_factor("point on arc", noise_model, (trus_p_pm_key, theta_key), 3, (3, 1), evaluate)

    ratio_key = sound_speed_ratio_key

    def evaluate_with_ratio(values: gtsam.Values, want_jacobians: bool) -> Residual:
        return residual(
            values.atPoint3(trus_p_pm_key).tolist(),
            values.atDouble(theta_key),
            values.atDouble(ratio_key),
            element,
            range_mm,
            want_jacobians,
        )

    keys = (trus_p_pm_key, theta_key, ratio_key)
    return custom_factor("point on arc", noise_model, keys, 3, (3, 1, 1), evaluate_with_ratio)
