"""Levenberg-Marquardt on the explicit graph, with starting values and the values read back: the solver's reference.

The package solves the reduced problem and takes one Gauss-Newton step of the explicit graph as a check. This solver
finds the optimum of the explicit graph without any of the reduced one's code.

The loop is our own, over ``graph.linearize(values)`` with values that Python holds: inside GTSAM's optimizers each
callback of a Python factor copies all values, which makes one linearisation quadratic in the number of pairs.

Elimination is by QR (see :func:`fgreg.graph.gtsam_values.newton_step`), which takes about 1.6 times as long as
Cholesky. Costs are GTSAM's, half the chi square.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np

from fgreg.factors.adapter import FactorError
from fgreg.factors.point_on_line import aim_residual, residual
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray
from fgreg.graph.gtsam_graph import ExplicitGraph, ShotKeys, Variable
from fgreg.graph.gtsam_values import (
    PrivateValues,
    SharedValues,
    beam_of_chart,
    bearing_from_array,
    linear_step,
    values_at,
)
from fgreg.model.measurements import Look
from fgreg.model.sensitivity import SensitivityPrior, arc_of_rotation, sensitivity_prior
from fgreg.model.session_model import SessionModel

_START_SIGMA_MM = 1.0
_START_SPAN, _START_STEPS = 3.0, 61
"""A start weights the distance of beam and arc by the first, and tries arc angles up to the second (in sigmas) from
their expected value; number of tried angles."""


_FIRST_DAMPING, _LEAST_DAMPING, _LARGEST_DAMPING = 1e-3, 1e-12, 1e12

_SCALE: dict[Variable, tuple[float, ...]] = {
    Variable.trus_T_camera: (0.1, 0.1, 0.1, 10.0, 10.0, 10.0),
    Variable.marker_laser: (10.0, 10.0, 0.1, 0.1),
    Variable.lam: (10.0,),
    Variable.theta: (0.1,),
}
"""Scale of a step under a damping of one, in rad and mm. The other variables have priors of their own."""


class GraphOptimum(NamedTuple):
    """Result of :func:`optimize`: values, cost (half the chi square), linearisations, whether it converged."""

    values: gtsam.Values
    cost: float
    iterations: int
    converged: bool


def _cost(explicit: ExplicitGraph, values: gtsam.Values) -> float:
    """The cost, infinite where it cannot be computed."""
    try:
        cost = float(explicit.graph.error(values))
    except FactorError:
        return math.inf
    return cost if math.isfinite(cost) else math.inf


def _damped_step(
    explicit: ExplicitGraph, linear: gtsam.GaussianFactorGraph, damping: float, ordering: gtsam.Ordering
) -> gtsam.VectorValues | None:
    """The step of the damped normal equations, None where they are singular."""
    damped = gtsam.GaussianFactorGraph()
    damped.push_back(linear)
    if damping:
        _add_damping(explicit, damped, damping)
    return linear_step(damped, ordering)


def _add_damping(explicit: ExplicitGraph, damped: gtsam.GaussianFactorGraph, damping: float) -> None:
    blocks = {
        variable: (math.sqrt(damping) * np.diag(1.0 / np.array(scale)), np.zeros(len(scale)))
        for variable, scale in _SCALE.items()
    }
    units = {variable: gtsam.noiseModel.Unit.Create(len(scale)) for variable, scale in _SCALE.items()}
    keys = explicit.keys
    for variable, own in (
        (Variable.trus_T_camera, [key for key in keys.trus_T_camera if key in explicit.shared]),
        (Variable.marker_laser, [key for key in (keys.marker_laser,) if key in explicit.shared]),
        (Variable.lam, keys.lam),
        (Variable.theta, keys.theta),
    ):
        block, zero = blocks[variable]
        for key in own:
            damped.push_back(gtsam.JacobianFactor(key, block, zero, units[variable]))


def optimize(
    explicit: ExplicitGraph, values: gtsam.Values, *, max_iterations: int = 100, tolerance: float = 1e-10
) -> GraphOptimum:
    """Levenberg-Marquardt from starting values.

    A step is tried as it is. Where the cost falls by less than its linear model predicts, it is also tried with points
    and angles made consistent again (:func:`made_consistent`); the better one is taken.

    Args:
        explicit: the graph.
        values: start; not changed.
        max_iterations: largest number of linearisations.
        tolerance: converged when the predicted decrease of a step is less than this share of 1 + cost.

    Raises:
        FactorError: the start itself has a factor that cannot be computed.
    """
    ordering = explicit.ordering
    cost = float(explicit.graph.error(values))
    damping, growth = _FIRST_DAMPING, 2.0
    for iteration in range(1, max_iterations + 1):
        linear = explicit.graph.linearize(values)
        while True:
            step = _damped_step(explicit, linear, damping, ordering)
            if step is not None:
                promise = cost - float(linear.error(step))
                trial = values.retract(step)
                trial_cost = _cost(explicit, trial)
                if cost - trial_cost < 0.5 * promise:
                    consistent = made_consistent(explicit, trial)
                    consistent_cost = _cost(explicit, consistent)
                    if consistent_cost < trial_cost:
                        trial, trial_cost = consistent, consistent_cost
                small = promise < tolerance * (1.0 + cost)
                gain = min((cost - trial_cost) / max(promise, 1e-300), 1.0)
                if trial_cost < cost:
                    values, cost = trial, trial_cost
                    damping = max(damping * max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3), _LEAST_DAMPING)
                    growth = 2.0
                    if small and damping < 1.0:
                        return GraphOptimum(values, cost, iteration, True)
                    break
                if small and damping < 1.0:
                    return GraphOptimum(values, cost, iteration, True)
            damping *= growth
            growth *= 2.0
            if damping > _LARGEST_DAMPING:
                return GraphOptimum(values, cost, iteration, False)
    return GraphOptimum(values, cost, max_iterations, False)


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
    rotation = prior.centre_rad + prior.edge_gain * shared.constants[Constant.WINDOW_EDGE] + z * prior.sigma_rad
    ratio = 1.0 + float(shared.constants[Constant.SOUND_SPEED])
    reach = ratio * look.range_mm
    theta = look.scan_rad + arc_of_rotation(rotation, reach, session.probe.radius_mm)
    points = _arc_points(look, theta, session, ratio)
    feet = origin + ((points - origin) @ direction)[:, None] * direction
    best = int(np.argmin(np.sum((points - feet) ** 2, axis=1) / _START_SIGMA_MM**2 + z * z))
    return np.asarray(0.5 * (points[best] + feet[best]))


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
        poses[:, :3, 3] -= shared.constants[Constant.MARKER_BIAS_X : Constant.MARKER_BIAS_Z + 1]
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
    constants = None if keys.rig is None else np.array(keys.rig.read(values))
    for index, pair in enumerate(explicit.measurements.pairs):
        point = points[keys.trus_p_pm[pair.pm]]
        out.update(keys.theta[index], bearing_from_array(point, pair.look, radius, constants))
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
        constants=default.constants if keys.rig is None else np.array(keys.rig.read(values)),
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
