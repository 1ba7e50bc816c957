"""Values of the explicit graph: starting values, making them consistent, reading them back.

Millimetres, radians. The distance ``lam`` is counted from where the beam crosses the nominal frame's xy plane (the
chart's origin), along the unit direction.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import gtsam
import numpy as np

from fgreg.factors.point_on_line import aim_residual, residual
from fgreg.geometry.transforms import FloatArray
from fgreg.graph.gtsam_graph import ExplicitGraph, ShotKeys
from fgreg.model.measurements import Look
from fgreg.model.sensitivity import SensitivityPrior, arc_of_rotation, sensitivity_prior
from fgreg.model.session_model import SessionModel

_START_SIGMA_MM = 1.0
_START_SPAN, _START_STEPS = 3.0, 61
"""A start weights the distance of beam and arc by the first, and tries arc angles up to the second (in sigmas) from
their expected value; number of tried angles."""


@dataclass(frozen=True, slots=True, eq=False)
class SharedValues:
    """One state of all shared variables.

    Attributes:
        trus_T_camera: (4, 4) per epoch.
        marker_laser: (4,) chart (x mm, y mm, a, b) about the graph's nominal frame.
        window_edge_rad: error of the known half width.
        marker_bias_mm: (3,) camera axes.
        sound_speed_ratio: true over assumed.
    """

    trus_T_camera: tuple[FloatArray, ...]
    marker_laser: FloatArray
    window_edge_rad: float = 0.0
    marker_bias_mm: FloatArray = field(default_factory=lambda: np.zeros(3))
    sound_speed_ratio: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class GraphEstimate:
    """Values of the graph's variables; tuples of aims and pairs are in the order of the measurements.

    Attributes:
        shared: the shared variables.
        trus_p_pm_mm: (3,) by PM.
        pair_lambda_mm, theta_rad: per pair; theta is the arc angle theta'.
        pair_camera_T_marker: (4, 4) per pair (the same where a marker observation is shared).
        aim_lambda_mm, aim_camera_T_marker, camera_p_spot_mm: per aim.
    """

    shared: SharedValues
    trus_p_pm_mm: dict[int, FloatArray]
    pair_lambda_mm: tuple[float, ...]
    theta_rad: tuple[float, ...]
    pair_camera_T_marker: tuple[FloatArray, ...]
    aim_lambda_mm: tuple[float, ...]
    aim_camera_T_marker: tuple[FloatArray, ...]
    camera_p_spot_mm: tuple[FloatArray, ...]


def laser_chart(marker_T_laser: FloatArray, marker_T_nominal: FloatArray) -> tuple[FloatArray, float]:
    """A beam in the chart of a nominal frame.

    Args:
        marker_T_laser: (4, 4), +z along the beam.
        marker_T_nominal: (4, 4), its z axis within 90 deg of the beam.

    Returns:
        (x, y, a, b) (4,), and what to add to a distance from the laser frame's origin to get it from the chart's.

    Raises:
        ValueError: the beam does not point along the nominal z axis.
    """
    nominal_R_marker = marker_T_nominal[:3, :3].T
    direction = nominal_R_marker @ marker_T_laser[:3, 2]
    origin = nominal_R_marker @ (marker_T_laser[:3, 3] - marker_T_nominal[:3, 3])
    if direction[2] <= 1e-6:
        raise ValueError("the beam does not point along the nominal frame's z axis")
    slopes = direction[:2] / direction[2]
    crossing = origin[:2] - origin[2] * slopes
    return np.concatenate([crossing, slopes]), float(origin[2] / direction[2])


def beam_of_chart(marker_laser: FloatArray, marker_T_nominal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Origin (3,) mm and unit direction (3,) of the beam in the marker frame."""
    x, y, a, b = (float(v) for v in marker_laser)
    direction = np.array([a, b, 1.0]) / math.sqrt(a * a + b * b + 1.0)
    marker_R_nominal = marker_T_nominal[:3, :3]
    return marker_R_nominal @ np.array([x, y, 0.0]) + marker_T_nominal[:3, 3], marker_R_nominal @ direction


def _arc_points(look: Look, theta_rad: FloatArray, session: SessionModel, ratio: float) -> FloatArray:
    radius, reach = session.probe.radius_mm, ratio * look.range_mm
    return np.stack(
        [
            np.full_like(theta_rad, look.x_mm),
            radius * math.sin(look.scan_rad) + reach * np.sin(theta_rad),
            radius * math.cos(look.scan_rad) + reach * np.cos(theta_rad),
        ],
        axis=-1,
    )


def _meeting_point(
    origin: FloatArray,
    direction: FloatArray,
    look: Look,
    prior: SensitivityPrior,
    session: SessionModel,
    shared: SharedValues,
) -> FloatArray:
    """The point midway between a line and a look's arc, at the arc angle where distance and prior together fit best."""
    z = np.linspace(-_START_SPAN, _START_SPAN, _START_STEPS)
    rotation = prior.centre_rad + prior.edge_gain * shared.window_edge_rad + z * prior.sigma_rad
    reach = shared.sound_speed_ratio * look.range_mm
    theta = look.scan_rad + arc_of_rotation(rotation, reach, session.probe.radius_mm)
    points = _arc_points(look, theta, session, shared.sound_speed_ratio)
    feet = origin + ((points - origin) @ direction)[:, None] * direction
    best = int(np.argmin(np.sum((points - feet) ** 2, axis=1) / _START_SIGMA_MM**2 + z * z))
    return np.asarray(0.5 * (points[best] + feet[best]))


@dataclass(frozen=True, slots=True, eq=False)
class PrivateValues:
    """One state of the private variables: distances and arc angles follow from these and the shared ones.

    Attributes:
        aim_camera_T_marker: (A, 4, 4). camera_p_spot_mm: (A, 3).
        camera_T_marker: (B, 4, 4) of the shots of pairs, in the order of the graph's keys.
        trus_p_pm_mm: (J, 3), in the order of the PMs' first looks.
    """

    aim_camera_T_marker: FloatArray
    camera_p_spot_mm: FloatArray
    camera_T_marker: FloatArray
    trus_p_pm_mm: FloatArray


def values_at(explicit: ExplicitGraph, shared: SharedValues, private: PrivateValues) -> gtsam.Values:
    """All variables at a state of the shared and private ones.

    Raises:
        ValueError: another number of registrations than epochs.
    """
    keys, measurements = explicit.keys, explicit.measurements
    if len(shared.trus_T_camera) != len(keys.trus_T_camera):
        raise ValueError(f"{len(shared.trus_T_camera)} registrations, expected {len(keys.trus_T_camera)}")
    values = gtsam.Values()
    for key, trus_T_camera in zip(keys.trus_T_camera, shared.trus_T_camera, strict=True):
        if key in explicit.shared:
            values.insert(key, gtsam.Pose3(trus_T_camera))
    if keys.marker_laser in explicit.shared:
        values.insert(keys.marker_laser, np.array(shared.marker_laser, dtype=np.float64))
    if keys.window_edge is not None:
        values.insert(keys.window_edge, float(shared.window_edge_rad))
    if keys.marker_bias is not None:
        values.insert(keys.marker_bias, np.array(shared.marker_bias_mm, dtype=np.float64))
    if keys.sound_speed_ratio is not None:
        values.insert(keys.sound_speed_ratio, float(shared.sound_speed_ratio))
    marker_p, marker_d = beam_of_chart(shared.marker_laser, explicit.marker_T_nominal)

    def place(key: int, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Insert a marker pose; the beam from it, in the camera frame."""
        values.insert(key, gtsam.Pose3(pose))
        return pose[:3, :3] @ marker_p + pose[:3, 3], pose[:3, :3] @ marker_d

    for own, pose, spot in zip(keys.aims, private.aim_camera_T_marker, private.camera_p_spot_mm, strict=True):
        origin, direction = place(own.camera_T_marker, pose)
        values.insertPoint3(own.camera_p_spot, np.array(spot))
        values.insert(own.lam, float(direction @ (spot - origin)))
    points = dict(zip(keys.trus_p_pm.values(), private.trus_p_pm_mm, strict=True))
    for key, point in points.items():
        values.insertPoint3(key, np.array(point))
    for shot, pose in zip(keys.shots, private.camera_T_marker, strict=True):
        origin, direction = place(shot.camera_T_marker, pose)
        trus_T_camera = shared.trus_T_camera[measurements.pairs[shot.pair].epoch]
        camera_p = trus_T_camera[:3, :3].T @ (points[shot.trus_p_pm] - trus_T_camera[:3, 3])
        values.insert(shot.lam, float(direction @ (camera_p - origin)))
    for index, pair in enumerate(measurements.pairs):
        point = points[keys.trus_p_pm[pair.pm]]
        values.insert(keys.theta[index], bearing_from_element(point, pair.look, explicit.session.probe.radius_mm))
    return values


def initial_values(explicit: ExplicitGraph, shared: SharedValues) -> gtsam.Values:
    """Starting values from a state of the shared variables.

    Marker poses (less the bias) and spots are at their observations. Each PM is midway between its beams and arcs (mean
    over its looks). Distances and arc angles follow from the points.

    Raises:
        ValueError: another number of registrations than epochs.
    """
    keys, session, measurements = explicit.keys, explicit.session, explicit.measurements
    marker_p, marker_d = beam_of_chart(shared.marker_laser, explicit.marker_T_nominal)

    def unbiased(observed: Iterable[FloatArray]) -> FloatArray:
        poses = np.array([*observed], dtype=np.float64).reshape(-1, 4, 4)
        poses[:, :3, 3] -= shared.marker_bias_mm
        return poses

    markers = unbiased(measurements.pairs[shot.pair].marker.camera_T_marker for shot in keys.shots)
    meetings: dict[int, list[FloatArray]] = {}
    for pair, place in zip(measurements.pairs, keys.pair_shot, strict=True):
        trus_T_marker = shared.trus_T_camera[pair.epoch] @ markers[place]
        origin, direction = trus_T_marker[:3, :3] @ marker_p + trus_T_marker[:3, 3], trus_T_marker[:3, :3] @ marker_d
        prior = sensitivity_prior(pair.look, session.probe.sensitivity, session.stage.step_rad)
        meetings.setdefault(pair.pm, []).append(_meeting_point(origin, direction, pair.look, prior, session, shared))
    private = PrivateValues(
        aim_camera_T_marker=unbiased(aim.marker.camera_T_marker for aim in measurements.aims),
        camera_p_spot_mm=np.array([aim.camera_p_spot_mm for aim in measurements.aims]).reshape(-1, 3),
        camera_T_marker=markers,
        trus_p_pm_mm=np.array([np.mean(of_pm, axis=0) for of_pm in meetings.values()]).reshape(-1, 3),
    )
    return values_at(explicit, shared, private)


def bearing_from_element(trus_p: FloatArray, look: Look, radius_mm: float) -> float:
    """Arc angle theta' (rad) of a point (3,), seen from the element at a look's stage angle.

    The branch is that within half a turn of the stage angle.
    """
    dy = float(trus_p[1]) - radius_mm * math.sin(look.scan_rad)
    dz = float(trus_p[2]) - radius_mm * math.cos(look.scan_rad)
    return look.scan_rad + math.remainder(math.atan2(dy, dz) - look.scan_rad, math.tau)


def made_consistent(explicit: ExplicitGraph, values: gtsam.Values) -> gtsam.Values:
    """The values with points that coincide by definition made to coincide exactly.

    Points are moved onto the beam of their (first) shot at its distance, and arc angles to the points' bearings. The
    markers of a PM's further shots are shifted so that their beams meet it. After a straight step the curvature leaves
    a few tenths of a millimetre, which is hundreds of sigmas of 1e-3 mm. With this correction the solver can take steps
    of a useful size.
    """
    keys, nominal = explicit.keys, explicit.marker_T_nominal.tolist()
    out = gtsam.Values(values)
    if keys.marker_laser not in explicit.shared:
        return out
    laser = values.atVector(keys.marker_laser).tolist()
    for own in keys.aims:
        marker = values.atPose3(own.camera_T_marker).matrix().tolist()
        spot = values.atPoint3(own.camera_p_spot)
        off, _ = aim_residual(marker, laser, values.atDouble(own.lam), spot.tolist(), nominal, want_jacobians=False)
        out.erase(own.camera_p_spot)
        out.insertPoint3(own.camera_p_spot, spot + off)
    points: dict[int, FloatArray] = {}
    for shot in keys.shots:
        first = shot.trus_p_pm not in points
        point = values.atPoint3(shot.trus_p_pm) if first else points[shot.trus_p_pm]
        miss = _beam_miss(values, shot, laser, point, nominal)
        if first:
            points[shot.trus_p_pm] = point + miss
            out.erase(shot.trus_p_pm)
            out.insertPoint3(shot.trus_p_pm, points[shot.trus_p_pm])
        else:
            trus_T_camera, pose = values.atPose3(shot.trus_T_camera), values.atPose3(shot.camera_T_marker)
            shift = trus_T_camera.rotation().matrix().T @ miss
            out.update(shot.camera_T_marker, gtsam.Pose3(pose.rotation(), pose.translation() - shift))
    radius = explicit.session.probe.radius_mm
    for index, pair in enumerate(explicit.measurements.pairs):
        point = points[keys.trus_p_pm[pair.pm]]
        out.update(keys.theta[index], bearing_from_element(point, pair.look, radius))
    return out


def _beam_miss(
    values: gtsam.Values, shot: ShotKeys, laser: list[float], point: FloatArray, nominal: list[list[float]]
) -> FloatArray:
    """(3,) TRUS: the shot's beam point less ``point``."""
    miss, _ = residual(
        values.atPose3(shot.trus_T_camera).matrix().tolist(),
        values.atPose3(shot.camera_T_marker).matrix().tolist(),
        laser,
        values.atDouble(shot.lam),
        point.tolist(),
        nominal,
        want_jacobians=False,
    )
    return np.array(miss)


def read_shared(explicit: ExplicitGraph, values: gtsam.Values, default: SharedValues) -> SharedValues:
    """The shared variables; those that no factor uses, or that are not variables, are taken from ``default``."""
    keys = explicit.keys
    return SharedValues(
        trus_T_camera=tuple(
            values.atPose3(key).matrix() if key in explicit.shared else fixed
            for key, fixed in zip(keys.trus_T_camera, default.trus_T_camera, strict=True)
        ),
        marker_laser=(
            values.atVector(keys.marker_laser) if keys.marker_laser in explicit.shared else default.marker_laser
        ),
        window_edge_rad=(default.window_edge_rad if keys.window_edge is None else values.atDouble(keys.window_edge)),
        marker_bias_mm=default.marker_bias_mm if keys.marker_bias is None else values.atVector(keys.marker_bias),
        sound_speed_ratio=(
            default.sound_speed_ratio if keys.sound_speed_ratio is None else values.atDouble(keys.sound_speed_ratio)
        ),
    )


def read_estimate(explicit: ExplicitGraph, values: gtsam.Values, default: SharedValues) -> GraphEstimate:
    """All variables; see :func:`read_shared` for ``default``."""
    keys = explicit.keys
    shots = [keys.shots[place] for place in keys.pair_shot]
    return GraphEstimate(
        shared=read_shared(explicit, values, default),
        trus_p_pm_mm={pm: values.atPoint3(key) for pm, key in keys.trus_p_pm.items()},
        pair_lambda_mm=tuple(values.atDouble(shot.lam) for shot in shots),
        theta_rad=tuple(values.atDouble(key) for key in keys.theta),
        pair_camera_T_marker=tuple(values.atPose3(shot.camera_T_marker).matrix() for shot in shots),
        aim_lambda_mm=tuple(values.atDouble(own.lam) for own in keys.aims),
        aim_camera_T_marker=tuple(values.atPose3(own.camera_T_marker).matrix() for own in keys.aims),
        camera_p_spot_mm=tuple(values.atPoint3(own.camera_p_spot) for own in keys.aims),
    )
