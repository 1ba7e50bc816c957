"""Marker pose: one detection of the marker, as a prior with the *detection's own* 6x6 covariance.

Equation. With the rig's constants c off their declared values, the detection ``[R_o, t_o]`` is moved by the twist
``(w, n) = gain c`` along the camera's axes about the marker's origin:

    M(c) = [Exp(w) R_o, t_o + n + w x n / 2]
    e = Log(M(c)^-1 * camera_T_marker)

Noise: the detection's covariance over the right tangent of the observed pose, ``observed = T * Expmap(xi)``; then
e = -xi exactly, so it is e's covariance as it stands.

Residual: (6,), rotation (rad) then translation (mm). Jacobians, in the order of the keys: (6, 6) camera_T_marker, the
derivative of Log at what it is applied to; (6, K) rig, that derivative times the one by M's right tangent, which is
``R_o' Jr(w)`` of w for the rotation and ``R_M' (I + [w]x / 2)`` of n, ``-R_M' [n]x / 2`` of w for the translation.

Where no constant matters this is GTSAM's native prior on a Pose3 (its Jacobian has been exact since 4.3).
Source: docs/model.md, sections 4 and 6; :class:`fgreg.model.measurements.CameraDependence`.
"""

from __future__ import annotations

import gtsam
import numpy as np

from fgreg.factors.adapter import Residual, Row, custom_factor
from fgreg.factors.rig import RigKey, rig_rows
from fgreg.geometry.transforms import FloatArray, as_float_array, hat


def residual(
    camera_T_marker: gtsam.Pose3,
    constants: Row,
    observed_camera_T_marker: gtsam.Pose3,
    gain: FloatArray,
    want_jacobians: bool = True,
) -> Residual:
    """The marker's pose against a detection of it.

    Args:
        camera_T_marker: the pose.
        constants: (COUNT,) the rig's, true less declared.
        observed_camera_T_marker: the detection.
        gain: (6, COUNT) twist by which errors of the constants move it.
        want_jacobians: whether to compute them.

    Returns:
        error (6,); Jacobians (6, 6), (6, COUNT), or none.
    """
    twist = gain @ np.asarray(constants)
    w, n = twist[:3], twist[3:]
    by_w = np.zeros((3, 3), order="F")
    turn = gtsam.Rot3.Expmap(w, by_w)
    observed_R = observed_camera_T_marker.rotation()
    moved = gtsam.Pose3(turn * observed_R, observed_camera_T_marker.translation() + n + 0.5 * np.cross(w, n))
    if not want_jacobians:
        return moved.logmap(camera_T_marker).tolist(), ()
    by_pose = np.zeros((6, 6), order="F")
    between = moved.between(camera_T_marker)
    error = gtsam.Pose3.Logmap(between, by_pose)
    by_twist = np.zeros((6, 6))
    by_twist[:3, :3] = observed_R.matrix().T @ by_w
    marker_R_camera = moved.rotation().matrix().T
    by_twist[3:, :3] = -0.5 * marker_R_camera @ hat(n)
    by_twist[3:, 3:] = marker_R_camera @ (np.eye(3) + 0.5 * hat(w))
    by_constants = -by_pose @ between.inverse().AdjointMap() @ by_twist @ gain
    return error.tolist(), (by_pose.tolist(), by_constants.tolist())


def marker_pose_factor(
    camera_T_marker_key: int,
    observed_camera_T_marker: FloatArray,
    covariance: FloatArray,
    gain: FloatArray | None = None,
    rig: RigKey | None = None,
) -> gtsam.NoiseModelFactor:
    """The factor of a detection: Pose3, and where given the rig, Vector K.

    Args:
        camera_T_marker_key, rig: variables.
        observed_camera_T_marker: (4, 4).
        covariance: (6, 6), right tangent (rotation rad, translation mm).
        gain: (6, COUNT) as of :func:`residual`.
    """
    observed = gtsam.Pose3(as_float_array(observed_camera_T_marker, 4, 4))
    noise_model = gtsam.noiseModel.Gaussian.Covariance(as_float_array(covariance, 6, 6))
    if rig is None or gain is None or not gain[:, rig.constants].any():
        return gtsam.PriorFactorPose3(camera_T_marker_key, observed, noise_model)
    variable, by_constants = rig, gain

    def evaluate(values: gtsam.Values, want_jacobians: bool) -> Residual:
        pose = values.atPose3(camera_T_marker_key)
        error, jacobians = residual(pose, variable.read(values), observed, by_constants, want_jacobians)
        return error, rig_rows(jacobians, variable)

    keys, sizes = (camera_T_marker_key, variable.key), (6, len(variable.constants))
    return custom_factor("marker pose", noise_model, keys, 6, sizes, evaluate)
