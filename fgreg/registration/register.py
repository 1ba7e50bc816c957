"""Calibration and registration in one graph, without an initial guess.

1. Beam and minima of each camera epoch (fgreg.registration.multistart).
2. All epochs together from the best of each: Levenberg-Marquardt on the reduced graph.
3. Where a shot does not fit (the stated noise does not explain its innovation), inliers are selected on the joint
   problem (fgreg.registration.outliers). The result is the plain least squares optimum of the inliers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.errors import EstimationError
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, inverse, make_transform
from fgreg.graph.packing import PackedProblem, pack
from fgreg.graph.reduced_solver import Optimum, optimize
from fgreg.graph.scaled_inverse import inverse_hessian
from fgreg.graph.shared_state import Quadratic, SharedState, make_state, nominal_frame, stack_states
from fgreg.model.measurements import Look, Measurements
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.epochs import (
    FinishedEpochs,
    epoch_chains,
    has_registration,
    last_epoch,
    restrict_epochs,
    solvable_epochs,
)
from fgreg.registration.joint_solve import Pack, Shots, only_inliers, solve_jointly
from fgreg.registration.multistart import (
    SAME_MINIMUM_MM,
    EpochSearch,
    Minimum,
    calibrate_beam,
    choose_minimum,
    from_outside,
    search_epoch,
    targets_moved,
)

SAME_CHI2 = 1e-3
"""Chi squares that differ by less are the same: three PMs fit each of their minima exactly."""


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """The joint optimum of a session (one hypothesis) and what led to it.

    Attributes:
        model: the session's set-up.
        measurements: the inliers of ``epochs``, with their epochs renumbered 0, 1, ...
        epochs: the session's numbers of the solved epochs.
        problem, optimum: packed measurements and the optimum of the reduced graph.
        searches: one for each epoch of the session; without minima where the epoch has too few pairs of its own.
        ambiguous: the session's epochs in which two minima fit equally well.
        covariance: (D, D) inverse Hessian of the shared variables (``problem.columns``).
        shots: all shots of ``epochs``, inliers and outliers.
        starts: (E, 4, 4) registrations from which the joint solve started (the first of several).
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
    starts: FloatArray

    def looks_of(self, measurements: Measurements) -> tuple[Look, ...]:
        """The look of each of the session's pairs, in the position that was taken."""
        taken = iter(self.shots.looks)
        return tuple(next(taken) if pair.epoch in self.epochs else pair.look for pair in measurements.pairs)


def labels_and_inliers(found: Registration, measurements: Measurements) -> tuple[tuple[int, ...], tuple[bool, ...]]:
    """Of each pair of the measurements that were registered: the number of its PM, and whether it is an inlier.

    An outlier look that was split off its PM has a number of its own.
    """
    shots = found.shots
    look_pm = iter(shots.problem.look_pm.tolist())
    labels, inlier = [], []
    for pair in measurements.pairs:
        pm = next(look_pm) if pair.epoch in found.epochs else None
        labels.append(pair.pm if pm is None else shots.problem.pms[pm])
        inlier.append(pm is not None and bool(shots.pm_inlier[pm]))
    return tuple(labels), tuple(inlier)


def too_few_text(pms: int, config: SolveConfig) -> str:
    """Why an epoch of so few PMs has no registration."""
    return f"{pms} pairs are too few for a registration: take at least {config.min_pairs}"


def _with_motions(
    measurements: Measurements, known: Mapping[int, FloatArray], solvable: Sequence[int]
) -> dict[int, FloatArray]:
    """trus_T_camera (4, 4) of all solvable epochs: those known, and where measured motions lead from them."""
    transforms = dict(known)
    while len(transforms) < len(solvable):
        for k in solvable:
            epoch = measurements.epochs[k]
            motion = epoch.camera_new_T_camera_old
            if not k or motion is None or not epoch.motion_known:
                continue
            old = epoch.old(k)
            if k not in transforms and old in transforms:
                transforms[k] = transforms[old] @ inverse(motion)
            elif k in transforms and old in solvable and old not in transforms:
                transforms[old] = transforms[k] @ motion
    return transforms


def joint_start(measurements: Measurements, chosen: dict[int, Minimum], solvable: list[int]) -> SharedState:
    """One state with all solvable epochs: each from its own minimum, else from another one by the measured motions."""
    transforms = _with_motions(measurements, {k: m.state.trus_T_camera()[0] for k, m in chosen.items()}, solvable)
    most = max(chosen, key=lambda k: sum(pair.epoch == k for pair in measurements.pairs))
    beam = chosen[most].state
    # A chart about the beam found: its direction is the nominal z, far from the chart's edge.
    frame = nominal_frame(beam.beam_origin()[0], beam.beam_direction()[0])
    stacked = np.stack([transforms[k] for k in solvable])[None]
    return replace(make_state(stacked, frame), constants=beam.constants)


def _points_backwards(optimum: Optimum) -> bool:
    """Whether most spots lie behind the beam's origin."""
    at = optimum.evaluation
    return bool(np.median(np.concatenate([at.lambda_mm[0], at.aim_lambda_mm[0]])) < 0)


def _turned(state: SharedState) -> SharedState:
    """The same hypothesis with the beam's chart pointing the other way."""
    frame = nominal_frame(state.beam_origin()[0], -state.beam_direction()[0])
    count = state.rotation.shape[1]
    transforms = np.stack([state.trus_T_camera(k) for k in range(count)], axis=1)
    return replace(make_state(transforms, frame), constants=state.constants)


def _best_start(
    measurements: Measurements,
    chosen: dict[int, Minimum],
    solvable: list[int],
    packed: Pack,
    finished: FinishedEpochs | None,
    *,
    clean: bool,
) -> SharedState:
    """The better of two starts; both where not every PM fitted in the searches (``clean``).

    Either each epoch starts from its own minimum, or the epochs that measured motions link start from the one with
    most pairs, and a single epoch from its prior. The start that leads to the lower cost is better.
    """
    if finished is not None:
        starts = _starts_of_prior(finished.prior, next(iter(chosen.values()), None))
    else:
        starts = [joint_start(measurements, chosen, solvable)]
        count = {k: sum(pair.epoch == k for pair in measurements.pairs) for k in chosen}
        leaders: dict[int, Minimum] = {}
        for chain in epoch_chains(measurements, solvable):
            among = [k for k in chain if k in chosen]
            best = max(among, key=lambda k: count[k])
            leaders[best] = chosen[best]
        if len(leaders) < len(chosen):
            starts.append(joint_start(measurements, leaders, solvable))
    if len(starts) == 1:
        return starts[0]
    if not clean:
        return stack_states(starts)
    problem = packed(restrict_epochs(measurements, solvable))
    found = [optimize(problem, start, max_iterations=30) for start in starts]
    return min(found, key=lambda optimum: float(optimum.evaluation.cost[0])).state


def _starts_of_prior(prior: Quadratic, chosen: Minimum | None) -> list[SharedState]:
    """Starts of one epoch with a prior: from its own minimum, and from where a measured motion leads."""
    starts = [prior.state] if has_registration(prior) else []
    if chosen is not None:
        pose = chosen.state
        starts.insert(0, replace(prior.state, rotation=pose.rotation, translation_mm=pose.translation_mm))
    return starts


def _open_minima(
    measurements: Measurements,
    searches: tuple[EpochSearch, ...],
    is_open: set[int],
    solvable: list[int],
    start: SharedState,
    model: SessionModel,
    config: SolveConfig,
    packed: Pack,
    finished: FinishedEpochs | None,
) -> tuple[SharedState, set[int]]:
    """Choose between ambiguous minima of an epoch with the data of all epochs (or the prior that they are).

    Together the epochs determine the beam and the window's edge better than the aims alone. A measured motion excludes
    minima that are far from where it leads.

    Returns:
        the start, and the epochs that stay ambiguous.
    """
    if (len(solvable) < 2 and finished is None) or not is_open:
        return start, is_open
    problem = packed(restrict_epochs(measurements, solvable))
    left = set(is_open)
    for epoch in sorted(is_open):
        search, place = searches[epoch], solvable.index(epoch)
        if not search.clean:
            continue
        rivals = [m for m in search.minima if m.cost - search.minima[0].cost < config.second_minimum_chi2]
        now = np.stack([start.trus_T_camera(i)[0] for i in range(len(solvable))])
        poses = [now]
        chain = next(chain for chain in epoch_chains(measurements, solvable) if epoch in chain)
        apart = {k: now[i] for i, k in enumerate(solvable) if k not in chain}
        for rival in rivals:
            pose = rival.state.trus_T_camera()[0]
            poses.append(now.copy())
            poses[-1][place] = pose
            if len(chain) > 1:  # epochs that motions tie to this one would hold it back where it was
                led = _with_motions(measurements, {**apart, epoch: pose}, solvable)
                poses.append(np.stack([led[k] for k in solvable]))
        many, there = start.take(np.zeros(len(poses), dtype=np.int64)), np.stack(poses)
        rotation, translation = there[:, :, :3, :3], there[:, :, :3, 3]
        found = optimize(problem, replace(many, rotation=rotation, translation_mm=translation), max_iterations=30)
        cost = np.where(np.isfinite(found.evaluation.cost), found.evaluation.cost, np.inf)
        if not np.isfinite(cost.min()):
            continue
        best = int(np.argmax(cost < cost.min() + SAME_CHI2))  # of equal ones that of the start, whatever rounds
        start, ends = found.state.take([best]), found.state.trus_T_camera(place)
        near = np.flatnonzero(cost - cost[best] < config.second_minimum_chi2)
        if all(targets_moved(ends[best], ends[i], model.targets_mm) <= SAME_MINIMUM_MM for i in near):
            left.discard(epoch)
    return start, left


def constants_of(model: SessionModel, config: SolveConfig) -> tuple[FloatArray, FloatArray]:
    """(COUNT,) prior standard deviations and means of the rig's constants: the session's, less certain where the
    configuration asks for an estimate."""
    sigmas, mean = model.constant_sigmas, model.constant_means
    if config.estimate_sound_speed:
        sigmas[Constant.SOUND_SPEED] = max(sigmas[Constant.SOUND_SPEED], config.sound_speed_sigma)
    if config.estimate_radius:
        sigmas[Constant.RADIUS] = max(sigmas[Constant.RADIUS], config.radius_sigma_mm)
    return sigmas, mean


def pack_session(measurements: Measurements, model: SessionModel, config: SolveConfig) -> PackedProblem:
    """The measurements as arrays, with the variables and shapes that the configuration asks for."""
    sigmas, mean = constants_of(model, config)
    return pack(
        measurements,
        model,
        sigmas=sigmas,
        mean=mean,
        shapes=config.window_shape,
        amplitude_sigma=config.amplitude_sigma,
    )


def register(
    measurements: Measurements,
    model: SessionModel,
    config: SolveConfig,
    searched: Mapping[int, EpochSearch] | None = None,
    finished: FinishedEpochs | None = None,
) -> Registration:
    """Calibrate and register: the joint optimum over all epochs that can be solved.

    Args:
        measurements: aims, pairs, epochs.
        model, config: of the session.
        searched: search results of epochs that are not searched again.
        finished: earlier epochs as a prior; only the last epoch is solved then.

    Raises:
        EstimationError: no beam to start from, or no epoch with three PMs.
    """
    if finished is not None:
        measurements = last_epoch(measurements)
    beam = calibrate_beam(measurements, model)
    trusted = only_inliers(measurements, (), np.zeros(0, dtype=bool), beam.aim_inlier).aims
    fitting = replace(measurements, aims=trusted)
    known = searched or {}
    searches = tuple(
        known[k] if k in known else search_epoch(fitting, model, beam.frames, k)
        for k in range(len(measurements.epochs))
    )
    solvable = solvable_epochs(measurements, searches)
    if finished is not None and not solvable:
        if not has_registration(finished.prior):
            raise EstimationError(too_few_text(len({pair.pm for pair in measurements.pairs}), config))
        solvable = [len(measurements.epochs) - 1]
    if not solvable:
        counts = [len({p.pm for p in measurements.pairs if p.epoch == k}) for k in range(len(measurements.epochs))]
        there = " and ".join(map(str, counts))
        raise EstimationError(
            f"no camera epoch has the 3 photoacoustic markers that a first solution needs (found {there}); "
            "take at least 6 pairs without moving the camera"
        )
    choices = {k: choose_minimum(search, model, config) for k, search in enumerate(searches) if search.minima}
    chosen = {k: minimum for k, (minimum, _) in choices.items()}
    clean = all(search.clean for search in searches)

    anchor = None if finished is None else finished.prior.above_minimum()

    def packed(of: Measurements) -> PackedProblem:
        return replace(pack_session(of, model, config), anchor=anchor)

    epochs = restrict_epochs(measurements, solvable)
    start = _best_start(measurements, chosen, solvable, packed, finished, clean=clean)
    is_open = {k for k, (_, undecided) in choices.items() if undecided}
    start, is_open = _open_minima(fitting, searches, is_open, solvable, start, model, config, packed, finished)
    # A motion leads from each minimum of an ambiguous epoch to one of the epoch after it.
    for chain in epoch_chains(measurements, solvable):
        if is_open.intersection(chain) or (finished is not None and finished.is_open):
            is_open.update(k for k in chain if k not in chosen)
    kept, problem, optimum, shots = solve_jointly(epochs, packed, start, beam.aim_inlier, clean=clean)
    if finished is None and _points_backwards(optimum):
        # The given nominal beam points backwards and no aim shows it: +z points towards the spots.
        start = _turned(optimum.state)
        kept, problem, optimum, shots = solve_jointly(epochs, packed, start, beam.aim_inlier, clean=clean)
    found = kept, problem, optimum, shots
    return _registration(model, tuple(solvable), searches, tuple(sorted(is_open)), start, found)


def register_near(
    measurements: Measurements,
    model: SessionModel,
    config: SolveConfig,
    start: SharedState,
    epochs: Sequence[int],
) -> Registration:
    """:func:`register` from a start near the optimum, without a search; inliers are selected again.

    Which shots were inliers before does not matter. So the result is that of :func:`register`, if ``start`` is nearest
    to the best of all minima.

    Args:
        measurements: of the session.
        model, config: as of :func:`register`.
        start: one hypothesis, with the registrations of ``epochs``.
        epochs: those to be solved.

    Raises:
        EstimationError: the shots leave the registration undetermined.
    """

    def packed(of: Measurements) -> PackedProblem:
        return pack_session(of, model, config)

    mine = restrict_epochs(measurements, list(epochs))
    aims = np.ones(len(mine.aims), dtype=bool)
    found = solve_jointly(mine, packed, start, aims, clean=False)
    searches = tuple(EpochSearch((), None, clean=False) for _ in measurements.epochs)
    return _registration(model, tuple(epochs), searches, (), start, found)


def _registration(
    model: SessionModel,
    epochs: tuple[int, ...],
    searches: tuple[EpochSearch, ...],
    ambiguous: tuple[int, ...],
    start: SharedState,
    found: tuple[Measurements, PackedProblem, Optimum, Shots],
) -> Registration:
    """A registration from the joint solve, with its covariance.

    Raises:
        EstimationError: the Hessian is singular.
    """
    kept, problem, optimum, shots = found
    covariance = inverse_hessian(optimum.evaluation.hessian[0])
    if covariance is None:
        raise EstimationError("these shots leave the registration undetermined; take more pairs")
    # Three PMs fit several minima exactly, and other epochs tell which: it need not be the first of the search.
    sides = {k: from_outside(problem, optimum.state, place) for place, k in enumerate(epochs) if searches[k].minima}
    searches = tuple(replace(of, outside=bool(sides[k][0])) if k in sides else of for k, of in enumerate(searches))
    return Registration(
        model=model,
        measurements=kept,
        epochs=epochs,
        problem=problem,
        optimum=optimum,
        searches=searches,
        ambiguous=ambiguous,
        covariance=covariance,
        shots=shots,
        starts=make_transform(start.rotation[0], start.translation_mm[0]),
    )
