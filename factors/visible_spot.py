"""Visible spot: the camera sees the laser's spot on the tissue, and the sound of a PM comes from there.

Equation (the point that the point-based registration pairs; docs/model.md, section 4):

    e = trus_T_camera^-1 * trus_p_pm - camera_p_spot - gain c

c are the rig's constants, and ``gain c`` is by how much they move what two cameras see. Noise: the spot's covariance,
which includes how far the sound's origin lies from the visible spot.

Residual: (3,) mm, camera axes. Jacobians, in the order of the keys: (3, 6) trus_T_camera (right perturbation, rotation
rad then translation mm), ``[hat(p), -I]`` with p the PM in the camera's frame; (3, 3) trus_p_pm, ``R'``; (3, K) rig.
"""

from __future__ import annotations

import gtsam
import numpy as np

from fgreg.factors.adapter import Residual, Row, Rows, custom_factor
from fgreg.factors.rig import RigKey, rig_rows
from fgreg.geometry.transforms import FloatArray, as_float_array


def residual(
    trus_T_camera: Rows,
    trus_p_pm: Row,
    constants: Row,
    camera_p_spot: Row,
    gain: FloatArray,
    want_jacobians: bool = True,
) -> Residual:
    """The PM, seen from the camera, against the spot.

    Args:
        trus_T_camera: rows of (4, 4).
        trus_p_pm: (3,) mm.
        constants: (COUNT,) the rig's, true less declared.
        camera_p_spot: (3,) mm, as seen.
        gain: (3, COUNT) by how much errors of the constants move what is seen.
        want_jacobians: whether to compute them.

    Returns:
        error (3,) mm in camera axes; Jacobians (3, 6), (3, 3), (3, COUNT), or none.
    """
    (a, b, c, tx), (d, e, f, ty), (g, h, i, tz), _ = trus_T_camera
    x, y, z = trus_p_pm[0] - tx, trus_p_pm[1] - ty, trus_p_pm[2] - tz
    px, py, pz = a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z
    moved = (gain @ np.asarray(constants)).tolist()
    error = (px - camera_p_spot[0] - moved[0], py - camera_p_spot[1] - moved[1], pz - camera_p_spot[2] - moved[2])
    if not want_jacobians:
        return error, ()
    by_pose = ((0.0, -pz, py, -1.0, 0.0, 0.0), (pz, 0.0, -px, 0.0, -1.0, 0.0), (-py, px, 0.0, 0.0, 0.0, -1.0))
    return error, (by_pose, ((a, d, g), (b, e, h), (c, f, i)), (-gain).tolist())


def visible_spot_factor(
    trus_T_camera_key: int,
    trus_p_pm_key: int,
    camera_p_spot: FloatArray,
    covariance: FloatArray,
    gain: FloatArray,
    rig: RigKey | None = None,
) -> gtsam.CustomFactor:
    """The factor of a spot: Pose3, Point3, and where given the rig, Vector K.

    Args:
        trus_T_camera_key, trus_p_pm_key, rig: variables.
        camera_p_spot: (3,) mm. covariance: (3, 3) mm^2, camera axes.
        gain: (3, COUNT) as of :func:`residual`.
    """
    spot, by_constants = as_float_array(camera_p_spot, 3).tolist(), as_float_array(gain, 3, len(gain[0]))
    variable = rig if rig is not None and by_constants[:, rig.constants].any() else None
    declared = [0.0] * by_constants.shape[1]

    def evaluate(values: gtsam.Values, want_jacobians: bool) -> Residual:
        error, jacobians = residual(
            values.atPose3(trus_T_camera_key).matrix().tolist(),
            values.atPoint3(trus_p_pm_key).tolist(),
            declared if variable is None else variable.read(values),
            spot,
            by_constants,
            want_jacobians,
        )
        return error, rig_rows(jacobians, variable)

    keys, sizes = [trus_T_camera_key, trus_p_pm_key], [6, 3]
    if variable is not None:
        keys.append(variable.key)
        sizes.append(len(variable.constants))
    noise_model = gtsam.noiseModel.Gaussian.Covariance(as_float_array(covariance, 3, 3))
    return custom_factor("visible spot", noise_model, keys, 3, sizes, evaluate)
