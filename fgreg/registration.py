"""Calibration and registration in the one graph, from no guess: all minima worth knowing, best first.

1. Beam: lines through the aimed-at spots, refined on the aims alone (the graph without pairs).
2. Registration starts of each epoch from the beams and the arc points (fgreg.initialization).
3. Levenberg-Marquardt on the reduced graph from all of them at once; distinct minima are kept with their costs.
4. The mirrored hypothesis (stage turning the other way, or elements counted from the other end) the same way.
5. All epochs together from the best of each.

Where a shot does not fit (its innovation is beyond what the stated noise explains), 1 to 4 are done again from
consensus starts with a truncated cost, and 5 takes only the shots that are kept (fgreg.robust).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.config import SolveConfig
from fgreg.errors import EstimationError
from fgreg.frames import BoolArray, FloatArray, inverse, transform_points
from fgreg.graph.packing import PackedProblem, pack
from fgreg.graph.reduced import Evaluation, evaluate, refine
from fgreg.graph.reduced_blocks import arc_points, initial_private
from fgreg.graph.reduced_solver import Optimum, optimize
from fgreg.graph.shared_state import SharedState, make_state, nominal_frame, stack_states
from fgreg.initialization import beam_starts, registration_starts
from fgreg.measurements import EpochStart, Measurements, Pair
from fgreg.models import SessionModel
from fgreg.robust import (
    Innovations,
    RobustOptimum,
    consensus_beams,
    consensus_starts,
    deviant,
    graduated,
    innovations_at,
    plausible_cost,
    sort_shots,
)

SEARCH_PAIRS = 40
"""The search for minima looks at no more pairs than this, spread over the session; all are used from there on."""
SAME_MINIMUM_MM = 1.5
"""Minima whose registrations move no target by more than this are one."""
BEAM_CHI2 = 30.0
"""Beams of calibrations worse than the best by more than this are not tried."""
MIN_KEPT_PMS = 7
MIN_KEPT_AIMS = 5
"""Nothing is left out of fewer shots than these and one more: what is left could be made to fit anything."""
SPOT_DISTANCE_MM = 45.0
"""Typical distance of a spot from the marker: what scales the beam's error in scoring consensus."""
RIVAL_OVERLAP = 0.7
"""Robust minima that share a larger part of the shots they keep are one: they differ by a borderline shot."""


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """One local minimum: chi square, and the state (one hypothesis)."""

    cost: float
    state: SharedState


@dataclass(frozen=True, slots=True, eq=False)
class EpochSearch:
    """What the search of one epoch found.

    Attributes:
        minima: best first, with the chi square of the shots that fit.
        mirrored_cost: best cost of the mirrored hypothesis, comparable with that of the first minimum.
        other_way_cost: likewise with every sweep's sign turned round; None where all fitted and that was not tried.
        own_beam_cost: likewise with a beam of the pairs' own, whatever the aims say; None where not tried.
        clean: whether every shot fits.
    """

    minima: tuple[Minimum, ...]
    mirrored_cost: float | None
    other_way_cost: float | None = None
    own_beam_cost: float | None = None
    clean: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Shots:
    """All shots of the epochs solved, at the optimum of those kept.

    Attributes:
        problem: all of them packed; a registration's own problem where all are kept.
        evaluation: at the registration's optimum (one hypothesis).
        pm_kept (J,), aim_kept (A,): over ``problem``'s PMs and aims.
        innovations: likewise: how far each is from what the others predict.
        pm_deviant (J,), aim_deviant (A,): those beyond the limit, also where too few shots are there to leave one out.
    """

    problem: PackedProblem
    evaluation: Evaluation
    pm_kept: BoolArray
    aim_kept: BoolArray
    innovations: Innovations
    pm_deviant: BoolArray
    aim_deviant: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """The joint optimum of a session (one hypothesis) and what led to it.

    Attributes:
        model: the session's set-up.
        measurements: what entered: the shots kept of ``epochs``, with their epochs renumbered 0, 1, ...
        epochs: the session's numbers of the epochs solved.
        problem, optimum: packed measurements and the optimum of the reduced graph.
        searches: of every epoch of the session; no minima where it had too few pairs of its own.
        ambiguous: the session's epochs in which two minima cannot be told apart.
        covariance: (D, D) inverse Hessian of the shared variables (``problem.columns``).
        shots: all shots of ``epochs``, also those left out.
    """

    model: SessionModel
    measurements: Measurements
    epochs: tuple[int, ...]
    problem: PackedProblem
    optimum: Optimum
    searches: tuple[EpochSearch, ...]
    ambiguous: tuple[int, ...]
    covariance: FloatArray
    shots: Shots


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """The beam from the aims: candidates for ``marker_T_nominal`` (z along it), best first; and which aims fit (A,)."""

    frames: tuple[FloatArray, ...]
    aim_kept: BoolArray


def calibrate_beam(measurements: Measurements, model: SessionModel) -> Calibration:
    """Candidate beams from the aims, and from ``initial``; aims that do not fit the others are left out.

    Raises:
        EstimationError: no aims and no initial beam.
    """
    aims = measurements.aims
    everything = np.ones(len(aims), dtype=bool)
    candidates = [nominal_frame(origin, direction) for origin, direction in beam_starts(aims)]
    if model.initial_marker_T_laser is not None:
        candidates.append(model.initial_marker_T_laser)
    if not candidates:
        raise EstimationError(
            "no aims and no initial.marker_T_laser: the beam has nowhere to start; take at least 6 aim shots"
        )
    if not aims:
        return Calibration(tuple(candidates), everything)
    alone = pack(replace(measurements, pairs=(), epochs=measurements.epochs[:1]), model)
    found = optimize(alone, _beam_states(candidates, model))
    best = int(np.argmin(found.evaluation.cost))
    if len(aims) > MIN_KEPT_AIMS and not _is_clean(alone, found.state.take([best]), found.evaluation.cost[best]):
        candidates += [nominal_frame(origin, direction) for origin, direction in consensus_beams(aims)]
        robust = graduated(alone, _beam_states(candidates, model), robust_aims=True)
        at = int(np.argmin(robust.cost))
        none = np.zeros(0, dtype=bool)
        kept = sort_shots(alone, robust.state.take([at]), none, robust.aim_kept[at]).aim_kept
        if MIN_KEPT_AIMS <= kept.sum() < len(aims):
            fitting = tuple(aim for aim, keep in zip(aims, kept, strict=True) if keep)
            alone = pack(Measurements(fitting, (), measurements.epochs[:1]), model)
            found = optimize(alone, _beam_states(candidates, model))
            return Calibration(tuple(_beams(found)), kept)
    return Calibration(tuple(_beams(found)), everything)


def _beam_states(frames: list[FloatArray], model: SessionModel) -> SharedState:
    return make_state(np.tile(np.eye(4), (len(frames), 1, 1, 1)), np.array(frames), model.probe.radius_mm)


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


def _is_clean(problem: PackedProblem, state: SharedState, cost: float) -> bool:
    """Whether each shot and all together fit at the least squares optimum of all (one hypothesis)."""
    if cost > plausible_cost(problem):
        return False
    pm, aim = np.ones(len(problem.pms), dtype=bool), np.ones(len(problem.aims.rotation), dtype=bool)
    found = deviant(problem, innovations_at(problem, state, pm, aim))
    return not (found.pm.any() or found.aim.any())


def _search_subset(pairs: tuple[Pair, ...]) -> tuple[Pair, ...]:
    if len(pairs) <= SEARCH_PAIRS:
        return pairs
    return tuple(pairs[i] for i in np.linspace(0, len(pairs) - 1, SEARCH_PAIRS).round().astype(int))


def _mirrored(problem: PackedProblem) -> PackedProblem:
    """The same data with lateral positions counted from the other end.

    A stage that turns the other way gives this, too, but for half a turn of the TRUS frame about z: one hypothesis
    stands for both.
    """
    return replace(problem, looks=replace(problem.looks, x_mm=-problem.looks.x_mm))


def _other_way(problem: PackedProblem) -> PackedProblem:
    """The same data with the sign of every sweep turned round."""
    looks = problem.looks
    return replace(problem, looks=replace(looks, centre_rad=-looks.centre_rad, edge_gain=-looks.edge_gain))


def _starts(problem: PackedProblem, frames: Sequence[FloatArray], model: SessionModel) -> SharedState:
    """Starts of a one-epoch problem: for each beam the registrations that bring its lines to the arc points."""
    arcs = arc_points(problem, np.zeros(1))[0]
    states = []
    for frame in frames:
        beams = problem.beams
        origin = (beams.rotation @ frame[:3, 3] + beams.translation_mm)[problem.look_beam]
        direction = (beams.rotation @ frame[:3, 2])[problem.look_beam]
        starts = registration_starts(origin, direction, arcs)
        states.append(make_state(starts[:, None], frame, model.probe.radius_mm))
    if model.initial_trus_T_camera is not None:
        states.append(make_state(model.initial_trus_T_camera[None, None], frames[0], model.probe.radius_mm))
    return stack_states(states)


def targets_moved(first: FloatArray, second: FloatArray, targets_mm: FloatArray) -> float:
    """Largest distance (mm) between where two registrations (4, 4) put the camera points under the targets."""
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
    """All minima of one epoch's pairs with the aims; none where it has fewer than three pairs."""
    pairs = tuple(replace(pair, epoch=0) for pair in measurements.pairs if pair.epoch == epoch)
    if len({pair.pm for pair in pairs}) < 3:
        return EpochSearch((), None)
    subset = replace(measurements, pairs=_search_subset(pairs), epochs=measurements.epochs[:1])
    problem = pack(subset, model)
    found = optimize(problem, _starts(problem, frames, model), keep_within=keep_within)
    minima = _distinct(found.evaluation.cost, found.state, model.targets_mm)
    if len(problem.pms) > MIN_KEPT_PMS and not _is_clean(problem, minima[0].state, minima[0].cost):
        return _search_among_junk(subset, problem, model, frames, minima, keep_within)
    mirrored_problem = _mirrored(problem)
    mirrored = optimize(mirrored_problem, _starts(mirrored_problem, frames, model), keep_within=keep_within)
    return EpochSearch(minima, float(mirrored.evaluation.cost.min()))


def _search_among_junk(
    measurements: Measurements,
    problem: PackedProblem,
    model: SessionModel,
    frames: Sequence[FloatArray],
    minima: tuple[Minimum, ...],
    keep_within: float,
) -> EpochSearch:
    """As :func:`search_epoch`, where a PM deviates: consensus, truncated cost, then the minima of what is kept."""
    plain = [minimum.state for minimum in minima]
    robust = _robust_minima(problem, frames, model, plain)
    mirrored = _robust_minima(_mirrored(problem), frames, model, [])
    other_way = _robust_minima(_other_way(problem), frames, model, []) if problem.looks.edge_gain.any() else None
    order = np.argsort(robust.cost)
    aims = np.ones(len(problem.aims.rotation), dtype=bool)
    kept = sort_shots(problem, robust.state.take([order[0]]), robust.pm_kept[order[0]], aims, doubt_aims=False).pm_kept
    if kept.sum() < MIN_KEPT_PMS:
        kept = np.ones(len(problem.pms), dtype=bool)
    names = {pm for pm, keep in zip(problem.pms, kept, strict=True) if keep}
    fitting = replace(measurements, pairs=tuple(pair for pair in measurements.pairs if pair.pm in names))
    reduced = pack(fitting, model)
    states = [robust.state, *plain, _starts(reduced, frames, model)]
    found = optimize(reduced, stack_states(states), keep_within=keep_within)
    all_minima = _distinct(found.evaluation.cost, found.state, model.targets_mm)
    base, level = float(robust.cost[order[0]]), all_minima[0].cost
    # Another set of shots that fit each other as well as these do is as good an answer.
    best = robust.pm_kept[order[0]]
    for index in order[1:]:
        both, either = (robust.pm_kept[index] & best).sum(), (robust.pm_kept[index] | best).sum()
        if both < RIVAL_OVERLAP * either:
            all_minima += (Minimum(level + float(robust.cost[index]) - base, robust.state.take([index])),)
    # The pairs without the aims: a marker swapped or knocked between calibration and registration.
    free = graduated(pack(replace(measurements, aims=()), model), robust.state)
    aims_cost = float(robust.parts.aim.cost[order[0]].sum())
    return EpochSearch(
        tuple(sorted(all_minima, key=lambda minimum: minimum.cost)),
        level + float(mirrored.cost.min()) - base,
        None if other_way is None else level + float(other_way.cost.min()) - base,
        level + float(free.cost.min()) + aims_cost - base,
        clean=False,
    )


def _robust_minima(
    problem: PackedProblem, frames: Sequence[FloatArray], model: SessionModel, others: list[SharedState]
) -> RobustOptimum:
    """Minima of the truncated cost of a one-epoch problem from consensus starts, and from others."""
    states = list(others)
    for frame in frames:
        starts = consensus_starts(problem, frame, SPOT_DISTANCE_MM)
        if len(starts):
            states.append(make_state(starts[:, None], frame, model.probe.radius_mm))
    if model.initial_trus_T_camera is not None or not states:
        guess = np.eye(4) if model.initial_trus_T_camera is None else model.initial_trus_T_camera
        states.append(make_state(guess[None, None], frames[0], model.probe.radius_mm))
    return graduated(problem, stack_states(states))


def choose_minimum(search: EpochSearch, model: SessionModel, config: SolveConfig) -> tuple[Minimum, bool]:
    """The minimum to use, and whether the choice is open.

    Open: another minimum's cost lies within ``second_minimum_chi2`` of the best and ``initial.trus_T_camera`` does not
    clearly favour one of them (at most half as far from it, at the worst target, as the next).
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


def _solvable(measurements: Measurements, searches: tuple[EpochSearch, ...]) -> list[int]:
    """Epochs with minima of their own or tied to such a one by measured camera motions."""
    known = {k for k, search in enumerate(searches) if search.minima}
    tied = {k for k, e in enumerate(measurements.epochs) if k and e.camera_new_T_camera_old is not None}
    for _ in range(len(searches)):
        known |= {k for k in tied if k - 1 in known} | {k - 1 for k in tied if k in known}
    return sorted(known)


def _joint_start(
    measurements: Measurements, chosen: dict[int, Minimum], solvable: list[int], model: SessionModel
) -> SharedState:
    """All solvable epochs in one state: from their own minima, else carried over by the measured motions."""
    transforms = {k: minimum.state.trus_T_camera()[0] for k, minimum in chosen.items()}
    while len(transforms) < len(solvable):
        for k in solvable:
            motion = measurements.epochs[k].camera_new_T_camera_old
            if k and motion is not None and k not in transforms and k - 1 in transforms:
                transforms[k] = transforms[k - 1] @ inverse(motion)
            if k and motion is not None and k in transforms and k - 1 in solvable and k - 1 not in transforms:
                transforms[k - 1] = transforms[k] @ motion
    most = max(chosen, key=lambda k: sum(pair.epoch == k for pair in measurements.pairs))
    beam = chosen[most].state
    # A chart about the beam found: its direction is the nominal z, far from the chart's edge.
    frame = nominal_frame(beam.beam_origin()[0], beam.beam_direction()[0])
    stacked = np.stack([transforms[k] for k in solvable])[None]
    return make_state(stacked, frame, model.probe.radius_mm)


def restrict_epochs(measurements: Measurements, epochs: list[int]) -> Measurements:
    """The measurements of some epochs only, renumbered in order; a motion is kept where both its sides are."""
    place = {k: i for i, k in enumerate(epochs)}
    starts = tuple(measurements.epochs[k] if k - 1 in place else EpochStart(measurements.epochs[k].t) for k in epochs)
    pairs = tuple(replace(pair, epoch=place[pair.epoch]) for pair in measurements.pairs if pair.epoch in place)
    return Measurements(measurements.aims, pairs, starts)


def _keep(measurements: Measurements, pms: tuple[int, ...], pm_kept: BoolArray, aim_kept: BoolArray) -> Measurements:
    names = {pm for pm, keep in zip(pms, pm_kept, strict=True) if keep}
    return replace(
        measurements,
        aims=tuple(aim for aim, keep in zip(measurements.aims, aim_kept, strict=True) if keep),
        pairs=tuple(pair for pair in measurements.pairs if pair.pm in names),
    )


def _enough(problem: PackedProblem, pm_kept: BoolArray, aim_kept: BoolArray) -> tuple[BoolArray, BoolArray]:
    """Who is kept, where an epoch with too few left (or the aims) takes all of its own back."""
    pm_kept = pm_kept.copy()
    epoch_of = np.zeros(len(problem.pms), dtype=np.int64)
    epoch_of[problem.beam_pm] = problem.beam_epoch
    for epoch in range(problem.columns.epochs):
        mine = epoch_of == epoch
        if (pm_kept & mine).sum() < MIN_KEPT_PMS:
            pm_kept |= mine
    if aim_kept.sum() < MIN_KEPT_AIMS:
        aim_kept = np.ones_like(aim_kept)
    return pm_kept, aim_kept


def _solve_jointly(
    measurements: Measurements, model: SessionModel, start: SharedState, aim_kept: BoolArray, *, clean: bool
) -> tuple[Measurements, PackedProblem, Optimum, Shots]:
    """What is kept, packed, its optimum, and all shots judged by it.

    Args:
        measurements: of the epochs to be solved.
        model: the session's set-up.
        start: one hypothesis.
        aim_kept: (A,) aims that fitted when looked at alone.
        clean: whether no PM has deviated so far.
    """
    whole = pack(measurements, model)
    everyone = np.ones(len(whole.pms), dtype=bool), np.ones(len(measurements.aims), dtype=bool)
    if clean and aim_kept.all():
        optimum = optimize(whole, start, tolerance=1e-9)
        found = innovations_at(whole, optimum.state, *everyone)
        deviants = deviant(whole, found)
        if not (deviants.pm.any() or deviants.aim.any() or optimum.evaluation.cost[0] > plausible_cost(whole)):
            shots = Shots(whole, optimum.evaluation, *everyone, found, deviants.pm, deviants.aim)
            return measurements, whole, optimum, shots
        start = optimum.state
    robust = graduated(whole, start, robust_aims=True)
    first = _enough(whole, robust.pm_kept[0], robust.aim_kept[0])
    judged = sort_shots(whole, robust.state, *first)
    kept = _enough(whole, judged.pm_kept, judged.aim_kept)
    chosen = _keep(measurements, whole.pms, *kept)
    problem = pack(chosen, model)
    optimum = optimize(problem, judged.state, tolerance=1e-9)
    found = innovations_at(whole, optimum.state, *kept)
    deviants = deviant(whole, found)
    private = initial_private(whole, optimum.state)
    for _ in range(4):
        _, private = refine(whole, optimum.state, private)
    at = evaluate(whole, optimum.state, private)
    return chosen, problem, optimum, Shots(whole, at, *kept, found, deviants.pm, deviants.aim)


def register(measurements: Measurements, model: SessionModel, config: SolveConfig) -> Registration:
    """Calibrate and register: the joint optimum over all epochs that can be solved.

    Raises:
        EstimationError: no beam to start from, or no epoch with three PMs.
    """
    beam = calibrate_beam(measurements, model)
    trusted = _keep(measurements, (), np.zeros(0, dtype=bool), beam.aim_kept).aims
    fitting = replace(measurements, aims=trusted)
    searches = tuple(search_epoch(fitting, model, beam.frames, k) for k in range(len(measurements.epochs)))
    solvable = _solvable(measurements, searches)
    if not solvable:
        counts = [len({p.pm for p in measurements.pairs if p.epoch == k}) for k in range(len(measurements.epochs))]
        raise EstimationError(
            f"no camera epoch has the 3 photoacoustic markers that a first solution takes (found {counts}); "
            "take at least 6 pairs without moving the camera"
        )
    choices = {k: choose_minimum(search, model, config) for k, search in enumerate(searches) if search.minima}
    chosen = {k: minimum for k, (minimum, _) in choices.items()}
    start = _joint_start(measurements, chosen, solvable, model)
    clean = all(search.clean for search in searches)
    kept, problem, optimum, shots = _solve_jointly(
        restrict_epochs(measurements, solvable), model, start, beam.aim_kept, clean=clean
    )
    hessian = optimum.evaluation.hessian[0]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-30))
    try:
        covariance = np.linalg.inv(hessian * scale * scale[:, None]) * scale * scale[:, None]
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError as error:
        raise EstimationError("these shots leave the registration undetermined; take more pairs") from error
    return Registration(
        model=model,
        measurements=kept,
        epochs=tuple(solvable),
        problem=problem,
        optimum=optimum,
        searches=searches,
        ambiguous=tuple(k for k, (_, is_open) in choices.items() if is_open),
        covariance=np.asarray(covariance, dtype=np.float64),
        shots=shots,
    )
