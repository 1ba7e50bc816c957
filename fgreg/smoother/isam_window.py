"""The active window: recent pairs as factors in iSAM2, and one marginal prior of everything older.

All variables of a recent pair are in the graph as in the reference (fgreg.graph.gtsam_graph): its marker pose, PM,
lambda and theta' are *variables*. Two facts of GTSAM's Python wrapper determine how iSAM2 is used here:

- A Python factor gets a copy of all values unless their C++ object has a live Python wrapper. So the linearisation
  point is held as long as iSAM2 (``ActiveWindow.theta``).
- An update that throws leaves iSAM2 unusable. So every update works on a copy, and the copy becomes the active window
  only if the update succeeds and every number is finite.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.linalg.lapack import dgeqrf, dtrtrs

from fgreg.factors.marker_pose import marker_pose_factor
from fgreg.factors.point_on_arc import point_on_arc_factor
from fgreg.factors.point_on_line import point_on_line_factor
from fgreg.factors.rig import RigKey
from fgreg.factors.sensitivity_prior import sensitivity_prior_factor
from fgreg.factors.visible_spot import visible_spot_factor
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray
from fgreg.graph.columns import Columns
from fgreg.graph.gtsam_graph import Variable, make_ordering
from fgreg.graph.gtsam_values import beam_of_chart, bearing_from_array
from fgreg.graph.packing import line_sigma_mm, marker_gain
from fgreg.graph.shared_state import Quadratic, SharedState
from fgreg.graph.visible_spots import spot_gain, usable_spot_covariance
from fgreg.model.measurements import FLOOR_MM, POSE_FLOOR, Pair, usable_covariance, visible_spots
from fgreg.model.sensitivity import arc_of_rotation, sensitivity_priors
from fgreg.model.session_model import SessionModel
from fgreg.model.systematic import TEXTS
from fgreg.smoother.shared_variables import Layout, finite, marginal_prior_factor, number_at

THRESHOLDS: dict[Variable, tuple[float, ...]] = {
    Variable.trus_T_camera: (6e-4, 6e-4, 6e-4, 0.06, 0.06, 0.06),
    Variable.marker_laser: (0.03, 0.03, 6e-4, 6e-4),
    Variable.camera_T_marker: (1e-3, 1e-3, 1e-3, 0.03, 0.03, 0.03),
    Variable.trus_p_pm: (0.1, 0.1, 0.1),
    Variable.lam: (0.15,),
    Variable.theta: (1.5e-3,),
}
"""Steps (rad, mm) beyond which a variable is linearised again."""
RIG_STEPS = {"": 6e-4, "mm": 0.03, "deg": 3e-4, "px": 0.3}
"""The same of the rig's constants, by their unit (in rad for degrees)."""
PRIVATE_STEPS = 10
SETTLED_MM = 0.5
"""The private variables of a new pair have converged after a step that moves the PM by less: the rest is of second
order, some hundredths of a millimetre."""
FAR_CHI2 = 1e4
"""Chi square of a PM whose beam and arc do not meet."""


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """The looks at one PM as factors, their private variables at their optimum given the shared ones.

    Attributes:
        graph: the factors. values: of the private variables.
        rows, residual: (m, D) and (m,): the factors linearised on the shared variables, private ones eliminated: the
            cost ``|residual + rows d|^2`` of steps d from ``state``, with m degrees of freedom.
        state: shared variables at the linearisation point.
        far: whether no place was found where they fit.
        first: number of the first of the private variables.
    """

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    rows: FloatArray
    residual: FloatArray
    state: SharedState
    far: bool
    first: int

    @property
    def quadratic(self) -> Quadratic:
        """As cost, gradient and Hessian on the shared variables."""
        cost = float(self.residual @ self.residual)
        return Quadratic(
            self.state,
            max(cost, FAR_CHI2) if self.far else cost,
            self.rows.T @ self.residual,
            self.rows.T @ self.rows,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """The looks at one inlier PM, in the active window.

    Attributes:
        label: PM number (one of its own where a look was split off as an outlier).
        places: of its pairs in the session's order.
        pairs: the pairs.
        prepared: their factors, prepared when the group was added.
        slots: of the factors in iSAM2; empty before they are in it.
    """

    label: int
    places: tuple[int, ...]
    pairs: tuple[Pair, ...]
    prepared: Prepared
    slots: tuple[int, ...] = ()


def private_keys(pairs: Sequence[Pair], first: int) -> tuple[list[int], list[int], int, list[int]]:
    """Keys of marker poses, lambdas (one of each per marker observation), PM, and thetas (one per look)."""
    shots = len({pair.marker.id for pair in pairs})
    markers = [Variable.camera_T_marker.key(first + i) for i in range(shots)]
    lambdas = [Variable.lam.key(first + i) for i in range(shots)]
    return markers, lambdas, Variable.trus_p_pm.key(first), [Variable.theta.key(first + i) for i in range(len(pairs))]


def free_number(groups: Sequence[Group], count: int) -> int:
    """The first of ``count`` consecutive numbers that no private variables of the groups have.

    Numbers are used again, so that GTSAM has few keys: making a value of type double for each is slow.
    """
    free = 0
    for first, taken in sorted((group.prepared.first, len(group.pairs)) for group in groups):
        if free + count <= first:
            break
        free = max(free, first + taken)
    return free


def prepare(
    pairs: Sequence[Pair], layout: Layout, state: SharedState, epoch: int, model: SessionModel, first: int
) -> Prepared:
    """Factors of the looks at one PM, and Gauss-Newton on its private variables with the shared ones fixed.

    Args:
        pairs: the looks.
        layout: of the shared variables.
        state: their values.
        epoch: index of the registration's variable.
        model: the session's set-up.
        first: number of the first of its private variables; ``len(pairs)`` numbers are used.

    Raises:
        FactorError: a factor that cannot be computed here.
        ArithmeticError: numbers that are not finite.
    """
    windows = windows_of(pairs, model)
    graph = factors_of(pairs, windows, layout, epoch, model, first)
    private = _beginning(pairs, windows, layout, state, model, first)
    held = gtsam.Values()
    layout.insert(held, state, epoch)
    values, rows, residual, far = _settle(graph, private, held, private_sizes(pairs, first), layout, epoch)
    return Prepared(graph, values, rows, residual, state, far, first)


def private_sizes(pairs: Sequence[Pair], first: int) -> dict[int, int]:
    """Keys of the private variables with their tangent dimensions, in the order in which they are eliminated."""
    markers, lambdas, point, thetas = private_keys(pairs, first)
    return {**dict.fromkeys(markers, 6), **dict.fromkeys(lambdas, 1), point: 3, **dict.fromkeys(thetas, 1)}


Windows = tuple[list[float], list[float], list[float]]


def windows_of(pairs: Sequence[Pair], model: SessionModel) -> Windows:
    """Centre, gain of the edge, and sigma of each look's rotation."""
    priors = sensitivity_priors([pair.look for pair in pairs], model.probe.sensitivity, model.stage.step_rad)
    return priors.centre_rad.tolist(), priors.edge_gain.tolist(), priors.sigma_rad.tolist()


def factors_of(
    pairs: Sequence[Pair], windows: Windows, layout: Layout, epoch: int, model: SessionModel, first: int
) -> gtsam.NonlinearFactorGraph:
    """The looks at one PM as factors (arguments as of :func:`prepare`; ``windows`` as of :func:`windows_of`)."""
    markers, lambdas, point, thetas = private_keys(pairs, first)
    shared, columns = layout.keys(epoch), layout.columns
    rig = RigKey(shared[2], columns.constants)
    radius_mm = model.probe.radius_mm
    centres, gains, sigmas = windows
    graph = gtsam.NonlinearFactorGraph()
    spots = visible_spots(pairs)
    shot_of: dict[int, int] = {}
    for i, pair in enumerate(pairs):
        look, marker = pair.look, pair.marker
        if marker.id not in shot_of:
            shot = shot_of[marker.id] = len(shot_of)
            covariance = usable_covariance(marker.covariance, POSE_FLOOR)
            graph.add(marker_pose_factor(markers[shot], marker.camera_T_marker, covariance, marker_gain(marker), rig))
            sigma_mm = line_sigma_mm(pair.beam_offset_mm)
            graph.add(
                point_on_line_factor(
                    shared[0], markers[shot], shared[1], lambdas[shot], point, layout.marker_T_nominal, sigma_mm
                )
            )
            if (spot := spots.get((pair.pm, marker.id))) is not None:
                covariance = usable_spot_covariance(spot)
                graph.add(visible_spot_factor(shared[0], point, spot.camera_p_mm, covariance, spot_gain(spot), rig))
        covariance = usable_covariance(look.covariance, (FLOOR_MM,) * 2)
        graph.add(
            point_on_arc_factor(
                point,
                thetas[i],
                look.scan_rad,
                look.x_mm,
                look.range_mm,
                covariance,
                radius_mm,
                rig,
                look.sweep,
            )
        )
        graph.add(
            sensitivity_prior_factor(
                thetas[i], look.scan_rad, look.range_mm, radius_mm, centres[i], gains[i], sigmas[i], rig, look.sweep
            )
        )
    return graph


def _beginning(
    pairs: Sequence[Pair], windows: Windows, layout: Layout, state: SharedState, model: SessionModel, first: int
) -> gtsam.Values:
    """Starting values of the private variables: the PM on the first look's arc, at the centre of its prior."""
    markers, lambdas, point, thetas = private_keys(pairs, first)
    radius_mm = model.probe.radius_mm
    centres, gains, _ = windows
    look = pairs[0].look
    constants = state.constants[0]
    reach = (1.0 + float(constants[Constant.SOUND_SPEED])) * look.range_mm + float(constants[Constant.RANGE_OFFSET])
    expected = centres[0] + gains[0] * float(constants[Constant.WINDOW_EDGE])
    theta = look.scan_rad + float(arc_of_rotation(expected, look.range_mm, radius_mm))
    trus_p = np.array(
        [
            look.x_mm,
            radius_mm * math.sin(look.scan_rad) + reach * math.sin(theta),
            radius_mm * math.cos(look.scan_rad) + reach * math.cos(theta),
        ]
    )
    values = gtsam.Values()
    values.insert(point, trus_p)
    camera_p = state.rotation[0, 0].T @ (trus_p - state.translation_mm[0, 0])
    origin, direction = beam_of_chart(state.beam[0], layout.marker_T_nominal)
    shot_of: dict[int, int] = {}
    for i, pair in enumerate(pairs):
        if pair.marker.id not in shot_of:
            shot = shot_of[pair.marker.id] = len(shot_of)
            pose = pair.marker.camera_T_marker
            values.insert(markers[shot], gtsam.Pose3(pose))
            lam = float(direction @ (pose[:3, :3].T @ (camera_p - pose[:3, 3]) - origin))
            values.insert(number_at(lambdas[shot], lam))
        own = bearing_from_array(trus_p, pair.look, radius_mm, constants)
        values.insert(number_at(thetas[i], own))
    return values


def _settle(
    graph: gtsam.NonlinearFactorGraph,
    private: gtsam.Values,
    held: gtsam.Values,
    sizes: dict[int, int],
    layout: Layout,
    epoch: int,
) -> tuple[gtsam.Values, FloatArray, FloatArray, bool]:
    """The private values at their optimum, the shared variables' rows and residual there, and whether it converged."""
    own = sum(sizes.values())
    there = set(graph.keyVector())
    shared = [(key, size) for key, size in zip(layout.keys(epoch), layout.sizes, strict=True)]
    ordering = make_ordering([*sizes, *(key for key, _ in shared if key in there)])
    far = True
    for _ in range(PRIVATE_STEPS):
        values = gtsam.Values(held)
        values.insert(private)
        system = graph.linearize(values).augmentedJacobian(ordering)
        if not math.isfinite(system.sum()):
            raise ArithmeticError("a pair's linear system is not finite")
        # Triangular, with the private variables first: the rows below theirs depend on the shared variables only.
        turned = dgeqrf(system)[0]
        step, singular = dtrtrs(turned[:own, :own], turned[:own, -1])
        if singular:
            raise np.linalg.LinAlgError("a pair's linear system is singular")
        # By retraction: to set a double goes through all of the wrapper's overloads, ten times as slow.
        delta, at = gtsam.VectorValues(), 0
        for key, size in sizes.items():
            delta.insert(key, step[at : at + size])
            if size == 3:
                far = float(np.linalg.norm(step[at : at + size])) > SETTLED_MM
            at += size
        private = private.retract(delta)
        if not far:
            break
    # The rows on the shared variables; absent variables (the edge) get zeros.
    left = np.triu(turned[own:, own:])
    rows = np.zeros((len(left), layout.columns.size))
    at, column = 0, 0
    for key, size in shared:
        if key in there:
            rows[:, column : column + size] = left[:, at : at + size]
            at += size
        column += size
    return private, rows, -left[:, -1], far


@dataclass(frozen=True, slots=True, eq=False)
class ActiveWindow:
    """iSAM2 with the recent pairs in it, and the shared variables' Gaussian.

    Attributes:
        isam: never updated in place once it is here.
        theta: its linearisation point, held so that Python factors do not get copies of it.
        epoch: index of the registration's variable.
        groups: oldest first.
        prior_slot: of the marginal prior.
        state: the estimate (one hypothesis, one epoch).
        covariance: (D, D) of the shared variables.
    """

    isam: gtsam.ISAM2
    theta: gtsam.Values
    epoch: int
    groups: tuple[Group, ...]
    prior_slot: int
    state: SharedState
    covariance: FloatArray


def empty_isam(columns: Columns, *, spots: bool = False) -> gtsam.ISAM2:
    """iSAM2 that eliminates by QR (see fgreg.graph.gtsam_values.newton_step); re-linearises by the thresholds above.

    ``spots``: the spots of aims are variables too, with the thresholds of PMs.
    """
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    parameters.relinearizeSkip = 1
    parameters.findUnusedFactorSlots = True
    parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
    thresholds = gtsam.ISAM2ThresholdMap()
    for variable, steps in THRESHOLDS.items():
        thresholds.insert((variable.value, np.array(steps)))
    if spots:
        thresholds.insert((Variable.camera_p_spot.value, np.array(THRESHOLDS[Variable.trus_p_pm])))
    rig_steps = [RIG_STEPS[TEXTS[constant].unit] for constant in columns.constants]
    thresholds.insert((Variable.rig.value, np.array(rig_steps)))
    parameters.setRelinearizeThreshold(thresholds)
    return gtsam.ISAM2(parameters)


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """Change of an active window by an update: groups to add, labels of groups to remove, a new marginal prior."""

    add: tuple[Group, ...] = ()
    remove: tuple[int, ...] = ()
    prior: Quadratic | None = None


def open_active_window(groups: Sequence[Group], prior: Quadratic, layout: Layout, epoch: int) -> ActiveWindow:
    """A new active window of these groups and a marginal prior, whose state is the start.

    Raises:
        ArithmeticError: an indeterminate system, or a result that is not finite.
        RuntimeError: another failure of GTSAM.
    """
    isam = empty_isam(layout.columns)
    theta = isam.getLinearizationPoint()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    layout.insert(values, prior.state, epoch)
    graph.add(marginal_prior_factor(prior, layout, epoch))
    for group in groups:
        graph.push_back(group.prepared.graph)
        values.insert(group.prepared.values)
    slots = _update(isam, graph, values)
    placed = _placed(groups, slots[1:])
    return _read(isam, theta, layout, epoch, placed, slots[0], prior.state)


def updated(active: ActiveWindow, change: Change, layout: Layout) -> ActiveWindow:
    """The active window after one update of iSAM2; the given one does not change.

    Raises:
        ArithmeticError: an indeterminate system, or a result that is not finite.
        RuntimeError: another failure of GTSAM.
    """
    isam = gtsam.ISAM2(active.isam)
    theta = isam.getLinearizationPoint()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    removed = [slot for group in active.groups if group.label in change.remove for slot in group.slots]
    if change.prior is not None:
        graph.add(marginal_prior_factor(change.prior, layout, active.epoch))
        removed.append(active.prior_slot)
    for group in change.add:
        graph.push_back(group.prepared.graph)
        values.insert(group.prepared.values)
    slots = _update(isam, graph, values, removed)
    prior_slot = active.prior_slot if change.prior is None else slots.pop(0)
    stay = [group for group in active.groups if group.label not in change.remove]
    groups = (*stay, *_placed(change.add, slots))
    return _read(isam, theta, layout, active.epoch, groups, prior_slot, active.state)


def _update(
    isam: gtsam.ISAM2, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, removed: Sequence[int] = ()
) -> list[int]:
    """Update in place; returns the slots of the new factors."""
    try:
        return list(isam.update(graph, values, list(removed)).getNewFactorsIndices())
    except RuntimeError as error:
        if "ndetermina" not in str(error):  # GTSAM writes "Indeterminate" and "Indeterminant"
            raise
        raise ArithmeticError("the pairs leave the registration undetermined") from error


def _placed(groups: Sequence[Group], slots: Sequence[int]) -> tuple[Group, ...]:
    """Groups with the slots of their factors, which are in the same order."""
    out, at = [], 0
    for group in groups:
        size = group.prepared.graph.size()
        out.append(replace(group, slots=tuple(slots[at : at + size])))
        at += size
    return tuple(out)


def _read(
    isam: gtsam.ISAM2,
    theta: gtsam.Values,
    layout: Layout,
    epoch: int,
    groups: tuple[Group, ...],
    prior_slot: int,
    like: SharedState,
) -> ActiveWindow:
    state = layout.read(isam, epoch, like)
    covariance = np.asarray(isam.jointMarginalCovariance(list(layout.keys(epoch))).fullMatrix())
    if not (finite(state) and np.isfinite(covariance).all() and (np.diag(covariance) > 0).all()):
        raise ArithmeticError("the estimate or its covariance is not finite")
    return ActiveWindow(isam, theta, epoch, groups, prior_slot, state, covariance)
