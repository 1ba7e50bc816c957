"""The multi-start minima of one camera epoch, without an initial guess; before that the beam from the aims.

Levenberg-Marquardt on the reduced graph runs from all starts at once (fgreg.registration.initialization). The result is
the distinct minima with their costs. The mirrored hypothesis is searched in the same way. Where a shot does not fit,
the search uses consensus starts and a truncated cost, and tries other hypotheses, so that the verdict can name the
cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.errors import EstimationError
from fgreg.geometry.transforms import BoolArray, FloatArray, inverse, transform_points
from fgreg.graph.packing import PackedProblem, pack, search_sigmas
from fgreg.graph.reduced_blocks import arc_points
from fgreg.graph.reduced_solver import Optimum, optimize
from fgreg.graph.shared_state import SharedState, make_state, nominal_frame, stack_states
from fgreg.model.measurements import Measurements, Pair
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.initialization import beam_starts, registration_starts
from fgreg.registration.minimal_set_consensus import consensus_beams, consensus_starts
from fgreg.registration.outliers import (
    RobustOptimum,
    beyond_limit,
    graduated,
    innovations_at,
    plausible_cost,
    select_inliers,
)

SEARCH_PAIRS = 40
"""Largest number of pairs, spread over the session, in the search for minima; the joint solve uses all pairs."""
OTHERS_TOLERANCE, OTHERS_WITHIN = 1e-2, 15.0
"""Of other hypotheses (mirrored, ...) only the cost matters: Newton decrement at which their search stops, and chi
square above the best fit beyond which they are dropped."""
SAME_MINIMUM_MM = 1.5
"""Minima whose registrations differ at no target by more than this are the same."""
BEAM_CHI2 = 30.0
"""Beams whose calibration has a chi square larger than the best by more than this are not tried."""
MIN_INLIER_PMS = 7
MIN_INLIER_AIMS = 5
"""No outliers are rejected where fewer inliers than these would be left: so few shots can fit almost anything."""
SPOT_DISTANCE_MM = 45.0
"""Typical distance of a spot from the marker, which scales the beam's error in the consensus score."""
RIVAL_OVERLAP = 0.7
"""Robust minima that share a larger part of their inliers are the same: they differ by a borderline shot."""


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """One local minimum: chi square, and the state (one hypothesis)."""

    cost: float
    state: SharedState


@dataclass(frozen=True, slots=True, eq=False)
class EpochSearch:
    """Result of the search of one epoch. All costs are comparable with that of the first minimum.

    Attributes:
        minima: best first, with the chi square of the inliers.
        mirrored_cost: best cost of the mirrored hypothesis.
        mirrored_outside_cost: best cost of its minima whose beams come from outside the probe; None without any.
        outside: whether the beams come from outside the probe, at the first minimum; of a registration at its optimum.
        other_way_cost: best cost with the sign of every sweep reversed; None where every shot fits (not tried).
        own_beam_cost: best cost with a beam from the pairs alone, without the aims; None where not tried.
        clean: whether every shot fits.
    """

    minima: tuple[Minimum, ...]
    mirrored_cost: float | None
    other_way_cost: float | None = None
    own_beam_cost: float | None = None
    clean: bool = True
    mirrored_outside_cost: float | None = None
    outside: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """The beam from the aims: candidates for ``marker_T_nominal`` (z along it), best first; the inlier aims (A,)."""

    frames: tuple[FloatArray, ...]
    aim_inlier: BoolArray


def calibrate_beam(measurements: Measurements, model: SessionModel) -> Calibration:
    """Candidate beams from the aims, and from ``initial``; outliers among the aims are left out.

    Raises:
        EstimationError: no aims and no initial beam.
    """
    aims = measurements.aims
    everything = np.ones(len(aims), dtype=bool)
    candidates = [nominal_frame(origin, direction) for origin, direction in beam_starts(aims)]
    if model.initial_marker_T_laser is not None:
        candidates.append(model.initial_marker_T_laser)
    if not candidates:
        raise EstimationError("no aims and no initial.marker_T_laser: the beam has no start; take at least 6 aim shots")
    if not aims:
        return Calibration(tuple(candidates), everything)
    alone = pack(Measurements(aims, (), measurements.epochs[:1]), model, sigmas=search_sigmas(model))
    found = optimize(alone, _beam_states(candidates, model))
    if len(aims) > MIN_INLIER_AIMS and not _is_clean(alone, found):
        candidates += [nominal_frame(origin, direction) for origin, direction in consensus_beams(aims)]
        robust = graduated(alone, _beam_states(candidates, model), robust_aims=True)
        none = np.zeros(0, dtype=bool)
        kept = select_inliers(alone, robust.state.take([0]), none, robust.aim_inlier[0]).aim_inlier
        if MIN_INLIER_AIMS <= kept.sum() < len(aims):
            fitting = tuple(aim for aim, keep in zip(aims, kept, strict=True) if keep)
            alone = pack(Measurements(fitting, (), measurements.epochs[:1]), model, sigmas=search_sigmas(model))
            found = optimize(alone, _beam_states(candidates, model))
            return Calibration(tuple(_beams(found)), kept)
    return Calibration(tuple(_beams(found)), everything)


def _beam_states(frames: list[FloatArray], model: SessionModel) -> SharedState:
    return make_state(np.tile(np.eye(4), (len(frames), 1, 1, 1)), np.array(frames), constants=model.constant_means)


def _beams(found: Optimum) -> list[FloatArray]:
    """Distinct beams of a solve of the aims alone, best first, pointing from the marker to the spots."""
    cost = found.evaluation.cost
    direction, origin = found.state.beam_direction(), found.state.beam_origin()
    frames: list[FloatArray] = []
    for index in np.argsort(cost):
        if cost[index] > cost.min() + BEAM_CHI2:
            break
        lambdas = found.evaluation.aim_lambda_mm[index]
        sign = 1.0 if np.median(lambdas) >= 0 else -1.0
        frame = nominal_frame(origin[index], sign * direction[index])
        if all(frame[:3, 2] @ other[:3, 2] < np.cos(0.02) for other in frames):
            frames.append(frame)
    return frames


def _is_clean(problem: PackedProblem, found: Optimum) -> bool:
    """Whether each shot fits, and all of them together, at the best least squares optimum."""
    cost = np.where(np.isfinite(found.evaluation.cost), found.evaluation.cost, np.inf)
    best = int(np.argmin(cost))
    if cost[best] > plausible_cost(problem):
        return False
    state, private = found.state.take([best]), found.evaluation.private.take([best])
    pm, aim = np.ones(len(problem.pms), dtype=bool), np.ones(len(problem.aims.rotation), dtype=bool)
    beyond = beyond_limit(problem, innovations_at(problem, state, pm, aim, private), pm)
    return not (beyond.pm.any() or beyond.aim.any())


def _search_subset(pairs: tuple[Pair, ...]) -> tuple[Pair, ...]:
    if len(pairs) <= SEARCH_PAIRS:
        return pairs
    return tuple(pairs[i] for i in np.linspace(0, len(pairs) - 1, SEARCH_PAIRS).round().astype(int))


def _mirrored(problem: PackedProblem) -> PackedProblem:
    """The same data with lateral positions counted from the other end.

    A stage that turns the other way gives the same, apart from half a turn of the TRUS frame about z. So one hypothesis
    covers both.
    """
    looks = replace(problem.looks, x_mm=-problem.looks.x_mm)
    return replace(problem, looks=looks, points=problem.points.mirrored())


def _other_way(problem: PackedProblem) -> PackedProblem:
    """The same data with the sign of every sweep reversed."""
    looks = problem.looks
    return replace(
        problem, looks=replace(looks, sweep=-looks.sweep, centre_rad=-looks.centre_rad, edge_gain=-looks.edge_gain)
    )


def _starts(problem: PackedProblem, frames: Sequence[FloatArray], model: SessionModel) -> SharedState:
    """Starts of a one-epoch problem: for each beam the registrations that bring its lines close to the arc points."""
    arcs = arc_points(problem, np.zeros(1))[0]
    states = []
    for frame in frames:
        beams = problem.beams
        origin = (beams.rotation @ frame[:3, 3] + beams.translation_mm)[problem.look_beam]
        direction = (beams.rotation @ frame[:3, 2])[problem.look_beam]
        starts = registration_starts(origin, direction, arcs)
        states.append(make_state(starts[:, None], frame, constants=model.constant_means))
    if model.initial_trus_T_camera is not None:
        states.append(make_state(model.initial_trus_T_camera[None, None], frames[0], constants=model.constant_means))
    return stack_states(states)


def targets_moved(first: FloatArray, second: FloatArray, targets_mm: FloatArray) -> float:
    """Largest distance (mm) at a target: ``second`` applied to the camera points that ``first`` maps to the targets."""
    camera_p = transform_points(inverse(first), targets_mm)
    return float(np.linalg.norm(transform_points(second, camera_p) - targets_mm, axis=1).max())


def _distinct(cost: FloatArray, state: SharedState, targets_mm: FloatArray, keep: int = 6) -> tuple[Minimum, ...]:
    minima: list[Minimum] = []
    for index in np.argsort(cost):
        one = state.take([index])
        here = one.trus_T_camera()[0]
        if all(targets_moved(other.state.trus_T_camera()[0], here, targets_mm) > SAME_MINIMUM_MM for other in minima):
            minima.append(Minimum(float(cost[index]), one))
        if len(minima) == keep:
            break
    return tuple(minima)


def search_epoch(
    measurements: Measurements,
    model: SessionModel,
    frames: Sequence[FloatArray],
    epoch: int,
    *,
    keep_within: float = 60.0,
) -> EpochSearch:
    """All minima of one epoch's pairs with the aims; none where it has fewer than three PMs."""
    pairs = tuple(replace(pair, epoch=0) for pair in measurements.pairs if pair.epoch == epoch)
    if len({pair.pm for pair in pairs}) < 3:
        return EpochSearch((), None)
    subset = Measurements(
        measurements.aims, _search_subset(pairs), measurements.epochs[:1], measurements.points_of(epoch)
    )
    problem = pack(subset, model, sigmas=search_sigmas(model))
    found = optimize(problem, _starts(problem, frames, model), keep_within=keep_within)
    minima = _distinct(found.evaluation.cost, found.state, model.targets_mm)
    if len(problem.pms) > MIN_INLIER_PMS and not _is_clean(problem, found):
        return _search_with_outliers(subset, problem, model, frames, minima, keep_within)
    mirrored_problem = _mirrored(problem)
    # Where it fits far worse its exact cost does not matter.
    mirrored = optimize(
        mirrored_problem,
        _starts(mirrored_problem, frames, model),
        tolerance=OTHERS_TOLERANCE,
        keep_within=keep_within,
        wanted=minima[0].cost + OTHERS_WITHIN,
    )
    cost = mirrored.evaluation.cost
    return EpochSearch(
        minima,
        float(cost.min()),
        mirrored_outside_cost=_least(cost, from_outside(mirrored_problem, mirrored.state)),
        outside=bool(from_outside(problem, minima[0].state)[0]),
    )


def _least(cost: FloatArray, among: BoolArray) -> float | None:
    return float(cost[among].min()) if among.any() else None


def from_outside(problem: PackedProblem, state: SharedState, epoch: int = 0) -> BoolArray:
    """(S,) whether most beams of an epoch point towards the probe, as they do with the fibre outside.

    PMs on a nearly flat surface fit their mirror image as well. The beams then come from behind the surface, where the
    probe is.
    """
    of = problem.beam_epoch[problem.look_beam] == epoch
    points = arc_points(problem, np.zeros(1))[0][of]
    radial = points[:, 1:] / np.linalg.norm(points[:, 1:], axis=1, keepdims=True)
    camera_d = np.einsum("bij,sj->sbi", problem.beams.rotation, state.beam_direction())
    trus_d = np.einsum("sij,sbj->sbi", state.rotation[:, epoch], camera_d)[:, problem.look_beam[of]]
    return np.asarray(np.mean(np.sum(trus_d[..., 1:] * radial, axis=-1), axis=1) < 0.0)


def _search_with_outliers(
    measurements: Measurements,
    problem: PackedProblem,
    model: SessionModel,
    frames: Sequence[FloatArray],
    minima: tuple[Minimum, ...],
    keep_within: float,
) -> EpochSearch:
    """As :func:`search_epoch`, where a PM does not fit: consensus, truncated cost, then the minima of the inliers."""
    plain = [minimum.state for minimum in minima]
    robust = graduated(problem, _robust_starts(problem, frames, model, plain), keep_within=keep_within)
    base, aims_cost = float(robust.cost[0]), float(robust.aim_cost[0].sum())

    def other(of: PackedProblem) -> RobustOptimum:
        starts = _robust_starts(of, frames, model, [])
        return graduated(of, starts, keep_within=keep_within, wanted=base + OTHERS_WITHIN)

    mirrored = other(_mirrored(problem))
    other_way = other(_other_way(problem)) if problem.looks.edge_gain.any() else None
    aims = np.ones(len(problem.aims.rotation), dtype=bool)
    best = robust.state.take([0])
    kept = select_inliers(problem, best, robust.pm_inlier[0], aims, select_aims=False).pm_inlier
    if kept.sum() < MIN_INLIER_PMS:
        kept = np.ones(len(problem.pms), dtype=bool)
    names = {pm for pm, keep in zip(problem.pms, kept, strict=True) if keep}
    fitting = replace(measurements, pairs=tuple(pair for pair in measurements.pairs if pair.pm in names))
    reduced = pack(fitting, model, sigmas=search_sigmas(model))
    states = [robust.state, *plain, _starts(reduced, frames, model)]
    found = optimize(reduced, stack_states(states), keep_within=keep_within)
    all_minima = _distinct(found.evaluation.cost, found.state, model.targets_mm)
    level = all_minima[0].cost
    # Another set of shots that fit each other equally well gives an equally good registration.
    for index, of_it in enumerate(robust.pm_inlier):
        both, either = (of_it & robust.pm_inlier[0]).sum(), (of_it | robust.pm_inlier[0]).sum()
        if both < RIVAL_OVERLAP * either:
            all_minima += (Minimum(level + float(robust.cost[index]) - base, robust.state.take([index])),)
    # The pairs without the aims show a marker that was swapped or moved between calibration and registration.
    alone = pack(replace(measurements, aims=()), model, sigmas=search_sigmas(model))
    free = graduated(alone, robust.state, keep_within=keep_within, wanted=base - aims_cost + OTHERS_WITHIN)
    return EpochSearch(
        tuple(sorted(all_minima, key=lambda minimum: minimum.cost)),
        level + float(mirrored.cost.min()) - base,
        None if other_way is None else level + float(other_way.cost.min()) - base,
        level + float(free.cost.min()) + aims_cost - base,
        clean=False,
        mirrored_outside_cost=_shifted(_least(mirrored.cost, from_outside(problem, mirrored.state)), level - base),
        outside=bool(from_outside(problem, best)[0]),
    )


def _shifted(cost: float | None, by: float) -> float | None:
    return None if cost is None else cost + by


def _robust_starts(
    problem: PackedProblem, frames: Sequence[FloatArray], model: SessionModel, others: list[SharedState]
) -> SharedState:
    """Consensus starts of a one-epoch problem, and the other starts given."""
    states = list(others)
    for frame in frames:
        starts = consensus_starts(problem, frame, SPOT_DISTANCE_MM)
        if len(starts):
            states.append(make_state(starts[:, None], frame, constants=model.constant_means))
    if model.initial_trus_T_camera is not None or not states:
        guess = np.eye(4) if model.initial_trus_T_camera is None else model.initial_trus_T_camera
        states.append(make_state(guess[None, None], frames[0], constants=model.constant_means))
    return stack_states(states)


def choose_minimum(search: EpochSearch, model: SessionModel, config: SolveConfig) -> tuple[Minimum, bool]:
    """The minimum to use, and whether the choice is ambiguous.

    It is ambiguous where another minimum's cost lies within ``second_minimum_chi2`` of the best and
    ``initial.trus_T_camera`` does not clearly favour one of them (at the worst target at most half as far from it as
    the next).
    """
    rivals = [m for m in search.minima if m.cost - search.minima[0].cost < config.second_minimum_chi2]
    if len(rivals) == 1:
        return rivals[0], False
    if model.initial_trus_T_camera is None:
        return rivals[0], True
    initial = model.initial_trus_T_camera
    far = [targets_moved(initial, m.state.trus_T_camera()[0], model.targets_mm) for m in rivals]
    order = np.argsort(far)
    return rivals[order[0]], bool(far[order[0]] > 0.5 * far[order[1]])
