"""Epoch change: the camera moved, and the registration with it.

Equation (the session format's ``trus_T_camera[k+1] = trus_T_camera[k] * inv(camera_new_T_camera_old)``, solved for the
motion):

    e = Log(camera_new_T_camera_old^-1 * trus_T_camera[k+1]^-1 * trus_T_camera[k])

Noise: the motion's covariance over its own right tangent, ``measured = motion * Expmap(xi)``; then e = -xi exactly.

Residual: (6,), rotation (rad) then translation (mm). Jacobians: (6, 6) for each pose. This is GTSAM's native between
factor, from k+1 to k (its Jacobians have been exact since 4.3). Source: docs/model.md, section 4.
"""

from __future__ import annotations

import gtsam

from fgreg.geometry.transforms import FloatArray, as_float_array


def epoch_change_factor(
    old_trus_T_camera_key: int,
    new_trus_T_camera_key: int,
    camera_new_T_camera_old: FloatArray,
    covariance: FloatArray,
) -> gtsam.BetweenFactorPose3:
    """The factor between two epochs.

    Args:
        old_trus_T_camera_key, new_trus_T_camera_key: epochs k and k + 1.
        camera_new_T_camera_old: (4, 4), the camera's motion.
        covariance: (6, 6), right tangent of the motion (rotation rad, translation mm).
    """
    motion = gtsam.Pose3(as_float_array(camera_new_T_camera_old, 4, 4))
    noise_model = gtsam.noiseModel.Gaussian.Covariance(as_float_array(covariance, 6, 6))
    return gtsam.BetweenFactorPose3(new_trus_T_camera_key, old_trus_T_camera_key, motion, noise_model)
