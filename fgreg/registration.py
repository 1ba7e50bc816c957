"""Calibration and registration in the one graph, from no guess: all minima worth knowing, best first.

1. Beam: lines through the aimed-at spots, refined on the aims alone (the graph without pairs).
2. Registration starts of each epoch from the beams and the arc points (fgreg.initialization).
3. Levenberg-Marquardt on the reduced graph from all of them at once; distinct minima are kept with their costs.
4. The mirrored hypothesis (stage turning the other way, or elements counted from the other end) the same way.
5. All epochs together from the best of each.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgreg.config import SolveConfig
from fgreg.errors import EstimationError
from fgreg.frames import FloatArray, inverse, transform_points
from fgreg.graph.packing import PackedProblem, pack
from fgreg.graph.reduced_blocks import arc_points
from fgreg.graph.reduced_solver import Optimum, optimize
from fgreg.graph.shared_state import SharedState, make_state, nominal_frame, stack_states
from fgreg.initialization import beam_starts, registration_starts
from fgreg.measurements import EpochStart, Measurements, Pair
from fgreg.models import SessionModel

SEARCH_PAIRS = 40
"""The search for minima looks at no more pairs than this, spread over the session; all are used from there on."""
SAME_MINIMUM_MM = 1.5
"""Minima whose registrations move no target by more than this are one."""
BEAM_CHI2 = 30.0
"""Beams of calibrations worse than the best by more than this are not tried."""


@dataclass(frozen=True, slots=True)
class SoundSpeedPrior:
    """What is known beforehand of the ratio of true to assumed sound speed."""

    mean: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """One local minimum: chi square, and the state (one hypothesis)."""

    cost: float
    state: SharedState


@dataclass(frozen=True, slots=True, eq=False)
class EpochSearch:
    """What the search of one epoch found: minima best first, and the best cost of the mirrored hypothesis."""

    minima: tuple[Minimum, ...]
    mirrored_cost: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """The joint optimum of a session (one hypothesis) and what led to it.

    Attributes:
        model: the session's set-up.
        measurements: what entered: the pairs of ``epochs``, with their epochs renumbered 0, 1, ...
        epochs: the session's numbers of the epochs solved.
        problem, optimum: packed measurements and the optimum of the reduced graph.
        searches: of every epoch of the session; no minima where it had too few pairs of its own.
        ambiguous: the session's epochs in which two minima cannot be told apart.
        covariance: (D, D) inverse Hessian of the shared variables (``problem.columns``).
    """

    model: SessionModel
    measurements: Measurements
    epochs: tuple[int, ...]
    problem: PackedProblem
    optimum: Optimum
    searches: tuple[EpochSearch, ...]
    ambiguous: tuple[int, ...]
    covariance: FloatArray


def calibrate_beam(measurements: Measurements, model: SessionModel) -> list[FloatArray]:
    """Candidate ``marker_T_nominal`` (z along the beam), best first: from the aims, and from ``initial``.

    Raises:
        EstimationError: no aims and no initial beam.
    """
    candidates = [nominal_frame(origin, direction) for origin, direction in beam_starts(measurements.aims)]
    if model.initial_marker_T_laser is not None:
        candidates.append(model.initial_marker_T_laser)
    if not candidates:
        raise EstimationError(
            "no aims and no initial.marker_T_laser: the beam has nowhere to start; take at least 6 aim shots"
        )
    if not measurements.aims:
        return candidates
    alone = pack(replace(measurements, pairs=(), epochs=measurements.epochs[:1]), model)
    state = make_state(np.tile(np.eye(4), (len(candidates), 1, 1, 1)), np.array(candidates), model.probe.radius_mm)
    found = optimize(alone, state)
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


def _starts(problem: PackedProblem, frames: list[FloatArray], model: SessionModel) -> SharedState:
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


def _distinct(found: Optimum, targets_mm: FloatArray, keep: int = 6) -> tuple[Minimum, ...]:
    minima: list[Minimum] = []
    for index in np.argsort(found.evaluation.cost):
        state = found.state.take([index])
        here = state.trus_T_camera()[0]
        if all(targets_moved(other.state.trus_T_camera()[0], here, targets_mm) > SAME_MINIMUM_MM for other in minima):
            minima.append(Minimum(float(found.evaluation.cost[index]), state))
        if len(minima) == keep:
            break
    return tuple(minima)


def search_epoch(
    measurements: Measurements, model: SessionModel, frames: list[FloatArray], epoch: int, *, keep_within: float = 60.0
) -> EpochSearch:
    """All minima of one epoch's pairs with the aims; none where it has fewer than three pairs."""
    pairs = tuple(replace(pair, epoch=0) for pair in measurements.pairs if pair.epoch == epoch)
    if len({pair.pm for pair in pairs}) < 3:
        return EpochSearch((), None)
    subset = replace(measurements, pairs=_search_subset(pairs), epochs=measurements.epochs[:1])
    problem = pack(subset, model)
    found = optimize(problem, _starts(problem, frames, model), keep_within=keep_within)
    mirrored_problem = _mirrored(problem)
    mirrored = optimize(mirrored_problem, _starts(mirrored_problem, frames, model), keep_within=keep_within)
    return EpochSearch(_distinct(found, model.targets_mm), float(mirrored.evaluation.cost.min()))


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


def joint_start(
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


def pack_session(
    measurements: Measurements, model: SessionModel, config: SolveConfig, sound_speed: SoundSpeedPrior | None = None
) -> PackedProblem:
    """The measurements as arrays, with the variables and shapes that the configuration asks for."""
    prior = sound_speed or SoundSpeedPrior(1.0, config.sound_speed_sigma)
    return pack(
        measurements,
        model,
        sound_speed_sigma=prior.sigma if config.estimate_sound_speed else None,
        sound_speed_mean=prior.mean if config.estimate_sound_speed else 1.0,
        radius_sigma_mm=config.radius_sigma_mm if config.estimate_radius else None,
        shapes=config.window_shape,
        amplitude_sigma=config.amplitude_sigma,
    )


def register(
    measurements: Measurements, model: SessionModel, config: SolveConfig, sound_speed: SoundSpeedPrior | None = None
) -> Registration:
    """Calibrate and register: the joint optimum over all epochs that can be solved.

    ``sound_speed`` is what is known of the ratio where it is estimated; the configuration's prior where None.

    Raises:
        EstimationError: no beam to start from, or no epoch with three PMs.
    """
    frames = calibrate_beam(measurements, model)
    searches = tuple(search_epoch(measurements, model, frames, k) for k in range(len(measurements.epochs)))
    solvable = _solvable(measurements, searches)
    if not solvable:
        counts = [len({p.pm for p in measurements.pairs if p.epoch == k}) for k in range(len(measurements.epochs))]
        raise EstimationError(
            f"no camera epoch has the 3 photoacoustic markers that a first solution takes (found {counts}); "
            "take at least 6 pairs without moving the camera"
        )
    choices = {k: choose_minimum(search, model, config) for k, search in enumerate(searches) if search.minima}
    chosen = {k: minimum for k, (minimum, _) in choices.items()}
    kept = restrict_epochs(measurements, solvable)
    problem = pack_session(kept, model, config, sound_speed)
    optimum = optimize(problem, joint_start(measurements, chosen, solvable, model), tolerance=1e-9)
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
    )
