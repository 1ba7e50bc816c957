"""Known point: a point that both devices locate, such as a tool's tip, is one point.

Equation (docs/model.md, section 4):

    e = trus_T_camera * camera_p - trus_p - shown c

camera_p is where the point is in the camera's frame; what the camera says of it is a prior of its own
(:func:`fgreg.factors.rig.spot_factor`). c are the rig's constants, and ``shown c`` is by how much the scanner shows the
point elsewhere than it is. Noise: the scanner's covariance.

Residual: (3,) mm, TRUS axes. Jacobians, in the order of the keys: (3, 6) trus_T_camera (right perturbation, rotation
rad then translation mm), ``R [-hat(camera_p), I]``; (3, 3) camera_p, ``R``; (3, K) rig.
"""

from __future__ import annotations

import gtsam
import numpy as np

from fgreg.factors.adapter import Residual, Row, Rows, custom_factor
from fgreg.factors.rig import RigKey, rig_rows
from fgreg.geometry.transforms import FloatArray, as_float_array


def residual(trus_T_camera: Rows, camera_p: Row, constants: Row, trus_p: Row, shown: FloatArray) -> Residual:
    """Where the registration has the point, less where the scanner has it.

    Args:
        trus_T_camera: rows of (4, 4).
        camera_p: (3,) mm.
        constants: (COUNT,) the rig's, true less declared.
        trus_p: (3,) mm, as the scanner shows it.
        shown: (3, COUNT) by how much errors of the constants move the true point, TRUS axes.

    Returns:
        error (3,) mm in TRUS axes; Jacobians (3, 6), (3, 3), (3, COUNT).
    """
    x, y, z = camera_p
    moved = (shown @ np.asarray(constants)).tolist()
    error, by_pose, by_point = [], [], []
    for i in range(3):
        a, b, c, t = trus_T_camera[i]
        error.append(a * x + b * y + c * z + t - trus_p[i] - moved[i])
        by_pose.append((c * y - b * z, a * z - c * x, b * x - a * y, a, b, c))
        by_point.append((a, b, c))
    return error, (by_pose, by_point, (-shown).tolist())


def known_point_factor(
    trus_T_camera_key: int,
    camera_p_key: int,
    trus_p: FloatArray,
    covariance: FloatArray,
    shown: FloatArray,
    rig: RigKey,
) -> gtsam.CustomFactor:
    """The factor of a point: Pose3, Point3 and the rig, Vector K.

    Args:
        trus_T_camera_key, camera_p_key, rig: variables.
        trus_p: (3,) mm. covariance: (3, 3) mm^2, TRUS axes.
        shown: (3, COUNT) as of :func:`residual`.
    """
    point = as_float_array(trus_p, 3).tolist()

    def evaluate(values: gtsam.Values, want_jacobians: bool) -> Residual:
        error, jacobians = residual(
            values.atPose3(trus_T_camera_key).matrix().tolist(),
            values.atPoint3(camera_p_key).tolist(),
            rig.read(values),
            point,
            shown,
        )
        return error, rig_rows(jacobians, rig) if want_jacobians else ()

    keys, sizes = (trus_T_camera_key, camera_p_key, rig.key), (6, 3, len(rig.constants))
    noise_model = gtsam.noiseModel.Gaussian.Covariance(as_float_array(covariance, 3, 3))
    return custom_factor("known point", noise_model, keys, 3, sizes, evaluate)
