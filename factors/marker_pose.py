"""Marker pose: one detection of the marker, as a prior with the *detection's own* 6x6 covariance.

Equation. The detection is ``observed = [R_o, t_o]`` with ``t_o = t + bias + noise``. With the bias subtracted,

    e = Log([R_o, t_o - bias]^-1 * camera_T_marker)

Noise: the detection's covariance over the right tangent of the observed pose, ``observed = T * Expmap(xi)``; then
e = -xi exactly, so it is e's covariance as it stands.

Residual: (6,), rotation (rad) then translation (mm). Jacobians, in the order of the keys: (6, 6) camera_T_marker, the
derivative of Log at what it is applied to; (6, 3) marker_bias, its translation columns times camera_R_marker', since
moving the observation by -db along the camera's axes is moving the pose by +db.

Without a bias this is GTSAM's native prior on a Pose3 (its Jacobian has been exact since 4.3).
Source: docs/model.md, section 4; :class:`fgreg.model.measurements.MarkerObservation`.
"""

from __future__ import annotations

import gtsam
import numpy as np

from fgreg.factors.adapter import Residual, Row, custom_factor
from fgreg.geometry.transforms import FloatArray, as_float_array


def residual(
    camera_T_marker: gtsam.Pose3,
    marker_bias_mm: Row,
    observed_camera_T_marker: gtsam.Pose3,
    want_jacobians: bool = True,
) -> Residual:
    """The marker's pose against a detection of it.

    Args:
        camera_T_marker: the pose.
        marker_bias_mm: (3,) along the camera's axes.
        observed_camera_T_marker: the detection.
        want_jacobians: whether to compute them.

    Returns:
        error (6,); Jacobians (6, 6), (6, 3), or none.
    """
    rotation = observed_camera_T_marker.rotation()
    unbiased = gtsam.Pose3(rotation, observed_camera_T_marker.translation() - np.asarray(marker_bias_mm))
    if not want_jacobians:
        return unbiased.logmap(camera_T_marker).tolist(), ()
    by_pose = np.zeros((6, 6), order="F")
    error = gtsam.Pose3.Logmap(unbiased.between(camera_T_marker), by_pose)
    by_bias = by_pose[:, 3:] @ camera_T_marker.rotation().matrix().T
    return error.tolist(), (by_pose.tolist(), by_bias.tolist())


def marker_pose_factor(
    camera_T_marker_key: int,
    observed_camera_T_marker: FloatArray,
    covariance: FloatArray,
    marker_bias_key: int | None = None,
) -> gtsam.NoiseModelFactor:
    """The factor of a detection: Pose3, and where given the bias, Vector 3.

    Args:
        camera_T_marker_key, marker_bias_key: variables.
        observed_camera_T_marker: (4, 4).
        covariance: (6, 6), right tangent (rotation rad, translation mm).
    """
    observed = gtsam.Pose3(as_float_array(observed_camera_T_marker, 4, 4))
    noise_model = gtsam.noiseModel.Gaussian.Covariance(as_float_array(covariance, 6, 6))
    if marker_bias_key is None:
        return gtsam.PriorFactorPose3(camera_T_marker_key, observed, noise_model)
    bias_key = marker_bias_key

    def evaluate(values: gtsam.Values, want_jacobians: bool) -> Residual:
        pose, bias = values.atPose3(camera_T_marker_key), values.atVector(bias_key).tolist()
        return residual(pose, bias, observed, want_jacobians)

    return custom_factor("marker pose", noise_model, (camera_T_marker_key, bias_key), 6, (6, 3), evaluate)
