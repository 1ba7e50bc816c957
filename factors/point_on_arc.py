"""Point on arc: a PM lies on the arc of each look at it.

Equation (Song et al.'s arc; docs/model.md, section 3). The PM in the array's frame at the look's stage angle t, with
axes along the array, tangential and radial, and c the rig's constants (fgreg.geometry.rig):

    q0 = Rx(-t) p - (0, array_offset, R + radius),   t = reading - sweep * backlash
    q = q0 + q0 x w,   w = (-tilt_elevation, -tilt_in_plane, tilt_radial)
    e = (q_x - (1 + pitch) x,  q_y sin d + q_z cos d - r',  q_y cos d - q_z sin d)
    d = theta - t,   r' = (1 + sound_speed) r + range_offset

Rx(-t) turns the plane of stage angle t to that of 0. With all constants zero, e is the miss against the arc's point
(x, R sin t + r sin theta, R cos t + r cos theta), along x, the radial and the tangential direction at theta. The arc is
centred on the element, because the time of flight from there is what is measured.

Residual: (3,) mm. Jacobians, in the order of the keys: (3, 3) trus_p_pm, (3, 1) theta, (3, K) rig.

Noise: the look's 2x2 covariance of (x, range) on the first two, so that range noise acts along the radius only. The
third is a definition and has the coincidence sigma.

The stage reading's noise enters by the sensitivity prior only. Here a wrong t moves the arc's centre along its tangent
by R dt, 0.02 mm for 0.1 deg at R = 10 mm, which theta compensates; the rest across the arc is negligible.
"""

from __future__ import annotations

import math

import gtsam
import numpy as np

from fgreg.factors.adapter import Residual, Row, custom_factor
from fgreg.factors.point_on_line import COINCIDENCE_SIGMA_MM
from fgreg.factors.rig import AS_DECLARED, RigKey, rig_rows
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, as_float_array


def residual(
    trus_p_pm: Row,
    theta_rad: float,
    constants: Row,
    scan_rad: float,
    x_mm: float,
    range_mm: float,
    radius_mm: float,
    sweep: int = 0,
    want_jacobians: bool = True,
) -> Residual:
    """The miss of a PM against the arc's point at ``theta_rad``.

    Args:
        trus_p_pm: (3,) mm.
        theta_rad: arc angle theta' (TRUS convention).
        constants: (COUNT,) the rig's, true less declared.
        scan_rad, x_mm, range_mm: the look. sweep: +1, -1, or 0 where it is not known.
        radius_mm: declared, of the probe.
        want_jacobians: whether to compute them.

    Returns:
        error (3,) mm along (x, radial, tangential); Jacobians (3, 3), (3, 1), (3, COUNT), or none.
    """
    in_plane, about_radial = constants[Constant.TILT_IN_PLANE], constants[Constant.TILT_RADIAL]
    steer = constants[Constant.TILT_ELEVATION]
    scan = scan_rad - sweep * constants[Constant.BACKLASH]
    sin_scan, cos_scan = math.sin(scan), math.cos(scan)
    across = cos_scan * trus_p_pm[1] - sin_scan * trus_p_pm[2]
    outwards = sin_scan * trus_p_pm[1] + cos_scan * trus_p_pm[2]
    px = trus_p_pm[0]
    py = across - constants[Constant.ARRAY_OFFSET]
    pz = outwards - radius_mm - constants[Constant.RADIUS]
    qx = px + py * about_radial + pz * in_plane
    qy = py - pz * steer - px * about_radial
    qz = pz - px * in_plane + py * steer
    sine, cosine = math.sin(theta_rad - scan), math.cos(theta_rad - scan)
    heard = (1.0 + constants[Constant.SOUND_SPEED]) * range_mm + constants[Constant.RANGE_OFFSET]
    reach, tangential = qy * sine + qz * cosine, qy * cosine - qz * sine
    error = (qx - (1.0 + constants[Constant.PITCH]) * x_mm, reach - heard, tangential)
    if not want_jacobians:
        return error, ()
    # Rows over the point in the stage's frame.
    rows = (
        (1.0, about_radial, in_plane),
        (-sine * about_radial - cosine * in_plane, sine + cosine * steer, cosine - sine * steer),
        (-cosine * about_radial + sine * in_plane, cosine - sine * steer, -sine - cosine * steer),
    )
    by_point = tuple((a, b * cos_scan + c * sin_scan, c * cos_scan - b * sin_scan) for a, b, c in rows)
    by_angle = (0.0, tangential, -reach)
    by_rig = np.zeros((3, len(constants)))
    for i, (_, b, c) in enumerate(rows):
        by_rig[i, Constant.ARRAY_OFFSET], by_rig[i, Constant.RADIUS] = -b, -c
        # The stage's angle turns the point, and theta is counted from it.
        by_rig[i, Constant.BACKLASH] = sweep * (b * outwards - c * across + by_angle[i])
    by_rig[0, Constant.PITCH] = -x_mm
    by_rig[1, Constant.SOUND_SPEED], by_rig[1, Constant.RANGE_OFFSET] = -range_mm, -1.0
    by_rig[:, Constant.TILT_IN_PLANE] = (pz, -cosine * px, sine * px)
    by_rig[:, Constant.TILT_RADIAL] = (py, -sine * px, -cosine * px)
    by_rig[:, Constant.TILT_ELEVATION] = (0.0, cosine * py - sine * pz, -sine * py - cosine * pz)
    return error, (by_point, tuple((value,) for value in by_angle), by_rig.tolist())


def point_on_arc_factor(
    trus_p_pm_key: int,
    theta_key: int,
    scan_rad: float,
    x_mm: float,
    range_mm: float,
    covariance: FloatArray,
    radius_mm: float,
    rig: RigKey | None = None,
    sweep: int = 0,
) -> gtsam.CustomFactor:
    """The factor of a look: Point3, double, and where given the rig, Vector K.

    Args:
        trus_p_pm_key, theta_key, rig: variables.
        scan_rad, x_mm, range_mm, sweep: the look.
        covariance: (2, 2) mm^2 over (x, range).
        radius_mm: of the probe.
    """
    full = np.zeros((3, 3))
    full[:2, :2] = as_float_array(covariance, 2, 2)
    full[2, 2] = COINCIDENCE_SIGMA_MM**2
    noise_model = gtsam.noiseModel.Gaussian.Covariance(full)
    keys, sizes = [trus_p_pm_key, theta_key], [3, 1]
    if rig is not None:
        keys.append(rig.key)
        sizes.append(len(rig.constants))

    def evaluate(values: gtsam.Values, want_jacobians: bool) -> Residual:
        error, jacobians = residual(
            values.atPoint3(trus_p_pm_key).tolist(),
            values.atDouble(theta_key),
            AS_DECLARED if rig is None else rig.read(values),
            scan_rad,
            x_mm,
            range_mm,
            radius_mm,
            sweep,
            want_jacobians,
        )
        return error, rig_rows(jacobians, rig)

    return custom_factor("point on arc", noise_model, keys, 3, sizes, evaluate)
