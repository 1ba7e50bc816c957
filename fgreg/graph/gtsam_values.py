"""Values of the explicit graph at a state of its variables, and the Gauss-Newton step there.

Millimetres, radians. The distance ``lam`` is counted from where the beam crosses the nominal frame's xy plane (the
chart's origin), along the unit direction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import gtsam
import numpy as np

from fgreg.geometry.rig import COUNT, Constant
from fgreg.geometry.transforms import FloatArray
from fgreg.graph.gtsam_graph import ExplicitGraph
from fgreg.graph.known_points import camera_places, point_arrays
from fgreg.model.measurements import Look


@dataclass(frozen=True, slots=True, eq=False)
class SharedValues:
    """One state of all shared variables.

    Attributes:
        trus_T_camera: (4, 4) per epoch.
        marker_laser: (4,) chart (x mm, y mm, a, b) about the graph's nominal frame.
        constants: (COUNT,) of the rig, true less declared.
    """

    trus_T_camera: tuple[FloatArray, ...]
    marker_laser: FloatArray
    constants: FloatArray = field(default_factory=lambda: np.zeros(COUNT))


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
    if keys.rig is not None:
        values.insert(keys.rig.key, np.asarray(shared.constants, dtype=np.float64)[list(keys.rig.constants)])
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
    if keys.points:
        located = point_arrays(measurements.points, explicit.session, [point.epoch for point in measurements.points])
        places = camera_places(located, np.stack(shared.trus_T_camera), np.asarray(shared.constants))
        for key, point in zip(keys.points, places, strict=True):
            values.insertPoint3(key, point)
    for shot, pose in zip(keys.shots, private.camera_T_marker, strict=True):
        origin, direction = place(shot.camera_T_marker, pose)
        trus_T_camera = shared.trus_T_camera[measurements.pairs[shot.pair].epoch]
        camera_p = trus_T_camera[:3, :3].T @ (points[shot.trus_p_pm] - trus_T_camera[:3, 3])
        values.insert(shot.lam, float(direction @ (camera_p - origin)))
    for index, pair in enumerate(measurements.pairs):
        point = points[keys.trus_p_pm[pair.pm]]
        theta = bearing_from_array(point, pair.look, explicit.session.probe.radius_mm, shared.constants)
        values.insert(keys.theta[index], theta)
    return values


def bearing_from_array(trus_p: FloatArray, look: Look, radius_mm: float, constants: FloatArray | None = None) -> float:
    """Arc angle theta' (rad) of a point (3,), seen from the array at a look's stage angle.

    The branch is that within half a turn of the stage angle.

    Args:
        trus_p: (3,) mm.
        look: the look.
        radius_mm: declared, of the probe.
        constants: (COUNT,) of the rig; None: as declared.
    """
    c = np.zeros(COUNT) if constants is None else constants
    scan = look.scan_rad - look.sweep * float(c[Constant.BACKLASH])
    x, y, z = (float(v) for v in trus_p)
    across = math.cos(scan) * y - math.sin(scan) * z - float(c[Constant.ARRAY_OFFSET])
    outwards = math.sin(scan) * y + math.cos(scan) * z - radius_mm - float(c[Constant.RADIUS])
    steer = float(c[Constant.TILT_ELEVATION])
    qy = across - outwards * steer - x * float(c[Constant.TILT_RADIAL])
    qz = outwards + across * steer - x * float(c[Constant.TILT_IN_PLANE])
    return scan + math.atan2(qy, qz)


def newton_step(explicit: ExplicitGraph, values: gtsam.Values) -> gtsam.VectorValues | None:
    """The Gauss-Newton step of all variables at some values: zero at an optimum; None where it is undetermined.

    Elimination is by QR. GTSAM's Cholesky calls a variable undetermined when the last two diagonal entries of its
    factor differ by 2^12; constraints of 1e-3 mm next to noise of some tenths do that in well-posed problems.

    Raises:
        FactorError: a factor cannot be computed there.
    """
    return linear_step(explicit.graph.linearize(values), explicit.ordering)


def linear_step(linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> gtsam.VectorValues | None:
    """The minimum of a linear graph; None where it is undetermined."""
    try:
        step = linear.optimize(ordering, gtsam.EliminateQR)
    except RuntimeError:  # GTSAM's indeterminate linear system
        return None
    return step if math.isfinite(step.squaredNorm()) else None
