"""The explicit graph of a session: the variables and factors of docs/model.md, sections 3 and 4.

This is the reference. The reduced problem, with the private variables eliminated in closed form, has to reach the same
optimum; it is used where speed matters. Values and the Gauss-Newton step are in gtsam_values.py.

Shots: a *shot* is one marker observation of one spot. Aims come first, one shot each; then the pairs' shots, one per PM
and marker observation. Looks at a PM that share an observation share the shot (its pose counts once); looks with
observations of their own have shots of their own. All shots and looks of a PM share its point. The caller leaves
outliers out of the measurements.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import gtsam
import numpy as np

from fgreg.errors import EstimationError
from fgreg.factors.epoch_change import epoch_change_factor
from fgreg.factors.known_point import known_point_factor
from fgreg.factors.marker_pose import marker_pose_factor
from fgreg.factors.point_on_arc import point_on_arc_factor
from fgreg.factors.point_on_line import aim_point_on_line_factor, point_on_line_factor
from fgreg.factors.rig import RigKey, rig_prior_factor, spot_factor
from fgreg.factors.sensitivity_prior import sensitivity_prior_factor
from fgreg.factors.visible_spot import visible_spot_factor
from fgreg.geometry.rig import CAMERA, COUNT
from fgreg.geometry.transforms import FloatArray
from fgreg.graph.columns import make_columns
from fgreg.graph.known_points import point_arrays
from fgreg.graph.packing import ConstantsPrior, constants_prior, least_sigmas, line_sigma_mm, marker_gain
from fgreg.graph.visible_spots import spot_gain, usable_spot_covariance
from fgreg.model.measurements import FLOOR_MM, POSE_FLOOR, Measurements, usable_covariance, visible_spots
from fgreg.model.sensitivity import sensitivity_priors
from fgreg.model.session_model import SessionModel


class Variable(Enum):
    """The variables of the graph, by their names in docs/model.md; the value is the letter of the GTSAM symbol."""

    trus_T_camera = "T"
    marker_laser = "B"
    camera_T_marker = "M"
    trus_p_pm = "P"
    camera_p_spot = "S"
    lam = "L"
    theta = "H"
    rig = "C"

    def key(self, index: int = 0) -> int:
        """The GTSAM key of the variable with this index."""
        return int(gtsam.symbol(self.value, index))


@dataclass(frozen=True, slots=True)
class AimKeys:
    """The private variables of one calibration shot."""

    camera_T_marker: int
    lam: int
    camera_p_spot: int


@dataclass(frozen=True, slots=True)
class ShotKeys:
    """The private variables of one shot at a PM, and the first of the pairs that share it."""

    camera_T_marker: int
    lam: int
    trus_p_pm: int
    trus_T_camera: int
    pair: int


@dataclass(frozen=True, slots=True)
class GraphKeys:
    """Keys of a session's variables.

    Attributes:
        trus_T_camera: one per epoch.
        marker_laser: the beam's chart.
        rig: the constants that are variables; None where there are none.
        aims: one per aim.
        shots: one per PM and marker observation.
        pair_shot: per pair, its place in ``shots``.
        theta: one per pair.
        trus_p_pm: by PM.
        points: where the known points are in the camera's frame.
    """

    trus_T_camera: tuple[int, ...]
    marker_laser: int
    rig: RigKey | None
    aims: tuple[AimKeys, ...]
    shots: tuple[ShotKeys, ...]
    pair_shot: tuple[int, ...]
    theta: tuple[int, ...]
    trus_p_pm: dict[int, int]
    points: tuple[int, ...]

    @property
    def shared(self) -> tuple[int, ...]:
        """The shared variables: ``trus_T_camera`` per epoch, ``marker_laser``, then the rig where it is one."""
        return (*self.trus_T_camera, self.marker_laser, *([] if self.rig is None else [self.rig.key]))

    @property
    def lam(self) -> tuple[int, ...]:
        """Distances along the beam, of the aims and then of the shots."""
        return (*(aim.lam for aim in self.aims), *(shot.lam for shot in self.shots))

    @property
    def camera_T_marker(self) -> tuple[int, ...]:
        """Marker poses, of the aims and then of the shots."""
        return (*(aim.camera_T_marker for aim in self.aims), *(shot.camera_T_marker for shot in self.shots))

    @property
    def private(self) -> tuple[int, ...]:
        """All private variables in elimination order: points, distances and angles, marker poses."""
        points = (*(aim.camera_p_spot for aim in self.aims), *self.trus_p_pm.values(), *self.points)
        return (*points, *self.lam, *self.theta, *self.camera_T_marker)


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """The rig's constants that are variables, in ascending order, and their prior."""

    constants: tuple[int, ...]
    prior: ConstantsPrior


@dataclass(frozen=True, slots=True, eq=False)
class GraphOptions:
    """Options of the graph, in addition to the measurements.

    Attributes:
        marker_T_nominal: (4, 4) fixed frame of the beam's chart; None: the session's initial ``marker_T_laser``, else
            the marker's own frame. The beam has to be within some 60 deg of its z axis.
        rig: the constants that are variables, with their prior; None: those of the session.
        unknown_motion_sigma: sigmas (rad, mm) of an unknown camera motion, about no motion. They are too wide to matter
            where there are pairs, and keep an epoch without pairs from being singular. None: no factor.
    """

    marker_T_nominal: FloatArray | None = None
    rig: Rig | None = None
    unknown_motion_sigma: tuple[float, float] | None = (3.0, 1000.0)


@dataclass(frozen=True, slots=True, eq=False)
class ExplicitGraph:
    """The graph of a session, its keys, and an elimination order: private variables first, shared ones last.

    ``shared`` and ``private`` are the keys that some factor uses, in that order.
    """

    graph: gtsam.NonlinearFactorGraph
    keys: GraphKeys
    shared: tuple[int, ...]
    private: tuple[int, ...]
    measurements: Measurements
    session: SessionModel
    marker_T_nominal: FloatArray

    @property
    def ordering(self) -> gtsam.Ordering:
        """Private variables first, shared ones last."""
        return make_ordering((*self.private, *self.shared))


def make_ordering(keys: Sequence[int]) -> gtsam.Ordering:
    """Keys as GTSAM's ordering."""
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    return ordering


def _make_keys(measurements: Measurements, constants: tuple[int, ...]) -> GraphKeys:
    aims = tuple(
        AimKeys(Variable.camera_T_marker.key(i), Variable.lam.key(i), Variable.camera_p_spot.key(i))
        for i in range(len(measurements.aims))
    )
    points: dict[int, int] = {}
    places: dict[tuple[int, int], int] = {}
    shots: list[ShotKeys] = []
    pair_shot: list[int] = []
    for index, pair in enumerate(measurements.pairs):
        if not 0 <= pair.epoch < len(measurements.epochs):
            raise EstimationError(f"pair {index} is in epoch {pair.epoch}, of {len(measurements.epochs)}")
        # A PM may have any number; the index of its variable counts the PMs in order of their first looks.
        point = points.setdefault(pair.pm, Variable.trus_p_pm.key(len(points)))
        place = places.setdefault((pair.pm, pair.marker.id), len(shots))
        if place == len(shots):
            i = len(aims) + place
            registration = Variable.trus_T_camera.key(pair.epoch)
            shots.append(ShotKeys(Variable.camera_T_marker.key(i), Variable.lam.key(i), point, registration, index))
        pair_shot.append(place)
    return GraphKeys(
        trus_T_camera=tuple(Variable.trus_T_camera.key(k) for k in range(len(measurements.epochs))),
        marker_laser=Variable.marker_laser.key(),
        rig=RigKey(Variable.rig.key(), constants) if constants else None,
        aims=aims,
        shots=tuple(shots),
        pair_shot=tuple(pair_shot),
        theta=tuple(Variable.theta.key(i) for i in range(len(measurements.pairs))),
        trus_p_pm=points,
        points=tuple(Variable.camera_p_spot.key(len(aims) + i) for i in range(len(measurements.points))),
    )


def build_graph(
    measurements: Measurements, session: SessionModel, options: GraphOptions | None = None
) -> ExplicitGraph:
    """The graph of all measurements of a session.

    Args:
        measurements: inliers only.
        session: probe, stage step and noise.
        options: the defaults of :class:`GraphOptions` where None.

    Raises:
        EstimationError: a pair in an epoch that does not exist.
    """
    options = options or GraphOptions()
    nominal = options.marker_T_nominal
    if nominal is None:
        nominal = session.initial_marker_T_laser if session.initial_marker_T_laser is not None else np.eye(4)
    probe = session.probe
    looks = [pair.look for pair in measurements.pairs]
    priors = sensitivity_priors(looks, probe.sensitivity, session.stage.step_rad)
    rig = options.rig if options.rig is not None else _rig_of(measurements, session)
    keys = _make_keys(measurements, rig.constants)
    graph = gtsam.NonlinearFactorGraph()
    if keys.rig is not None:
        graph.add(rig_prior_factor(keys.rig, rig.prior.mean, rig.prior.information))
    _add_epoch_changes(graph, keys, measurements, options)
    for aim, own in zip(measurements.aims, keys.aims, strict=True):
        covariance = usable_covariance(aim.marker.covariance, POSE_FLOOR)
        gain = marker_gain(aim.marker)
        graph.add(marker_pose_factor(own.camera_T_marker, aim.marker.camera_T_marker, covariance, gain, keys.rig))
        graph.add(aim_point_on_line_factor(own.camera_T_marker, keys.marker_laser, own.lam, own.camera_p_spot, nominal))
        spot_covariance = usable_covariance(aim.covariance, (FLOOR_MM,) * 3)
        if aim.dependence is not None and keys.rig is not None:
            gain = np.zeros((3, COUNT))
            gain[:, CAMERA] = aim.dependence.gain
            graph.add(spot_factor(own.camera_p_spot, aim.camera_p_spot_mm, spot_covariance, gain, keys.rig))
        else:
            spot_noise = gtsam.noiseModel.Gaussian.Covariance(spot_covariance)
            graph.add(gtsam.PriorFactorPoint3(own.camera_p_spot, aim.camera_p_spot_mm, spot_noise))
    if keys.rig is not None:
        _add_points(graph, keys, measurements, session, keys.rig)
    spots = visible_spots(measurements.pairs)
    for shot in keys.shots:
        pair = measurements.pairs[shot.pair]
        marker = pair.marker
        covariance = usable_covariance(marker.covariance, POSE_FLOOR)
        gain = marker_gain(marker)
        graph.add(marker_pose_factor(shot.camera_T_marker, marker.camera_T_marker, covariance, gain, keys.rig))
        graph.add(
            point_on_line_factor(
                shot.trus_T_camera,
                shot.camera_T_marker,
                keys.marker_laser,
                shot.lam,
                shot.trus_p_pm,
                nominal,
                line_sigma_mm(pair.beam_offset_mm),
            )
        )
        if (spot := spots.get((pair.pm, marker.id))) is not None:
            covariance = usable_spot_covariance(spot)
            gain = spot_gain(spot)
            graph.add(
                visible_spot_factor(shot.trus_T_camera, shot.trus_p_pm, spot.camera_p_mm, covariance, gain, keys.rig)
            )
    for index, look in enumerate(looks):
        graph.add(
            point_on_arc_factor(
                keys.shots[keys.pair_shot[index]].trus_p_pm,
                keys.theta[index],
                look.scan_rad,
                look.x_mm,
                look.range_mm,
                usable_covariance(look.covariance, (FLOOR_MM,) * 2),
                probe.radius_mm,
                keys.rig,
                look.sweep,
            )
        )
        graph.add(
            sensitivity_prior_factor(
                keys.theta[index],
                look.scan_rad,
                look.range_mm,
                probe.radius_mm,
                float(priors.centre_rad[index]),
                float(priors.edge_gain[index]),
                float(priors.sigma_rad[index]),
                keys.rig,
                look.sweep,
            )
        )
    there = set(graph.keyVector())
    return ExplicitGraph(
        graph=graph,
        keys=keys,
        shared=tuple(key for key in keys.shared if key in there),
        private=tuple(key for key in keys.private if key in there),
        measurements=measurements,
        session=session,
        marker_T_nominal=nominal,
    )


def _add_points(
    graph: gtsam.NonlinearFactorGraph, keys: GraphKeys, measurements: Measurements, session: SessionModel, rig: RigKey
) -> None:
    """What camera and scanner say of the known points. (There is a rig always: the window's edge.)"""
    points = point_arrays(measurements.points, session, [point.epoch for point in measurements.points])
    for i, own in enumerate(keys.points):
        graph.add(spot_factor(own, points.camera_p_mm[i], points.covariance[i], points.seen[i], rig))
        registration = keys.trus_T_camera[points.epoch[i]]
        graph.add(
            known_point_factor(registration, own, points.trus_p_mm[i], points.trus_covariance[i], points.shown[i], rig)
        )


def _rig_of(measurements: Measurements, session: SessionModel) -> Rig:
    sigmas = least_sigmas(session.constant_sigmas)
    columns = make_columns(len(measurements.epochs), sigmas)
    prior = constants_prior(measurements, columns, sigmas, session.constant_means, session.constant_correlation)
    return Rig(columns.constants, prior)


def _add_epoch_changes(
    graph: gtsam.NonlinearFactorGraph, keys: GraphKeys, measurements: Measurements, options: GraphOptions
) -> None:
    for k, epoch in enumerate(measurements.epochs[1:], 1):
        motion, covariance = epoch.camera_new_T_camera_old, epoch.covariance
        if motion is None or covariance is None:
            if options.unknown_motion_sigma is None:
                continue
            rad, mm = options.unknown_motion_sigma
            motion, covariance = np.eye(4), np.diag([rad**2] * 3 + [mm**2] * 3)
        covariance = usable_covariance(covariance, POSE_FLOOR)
        graph.add(epoch_change_factor(keys.trus_T_camera[epoch.old(k)], keys.trus_T_camera[k], motion, covariance))
