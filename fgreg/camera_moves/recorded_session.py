"""Unreported camera moves in a recorded session: the online registration's test, on the registration of all shots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.camera_moves.bayes_filter import MoveSettings
from fgreg.camera_moves.boundary import likeliest_boundary
from fgreg.camera_moves.detector import CameraMove, LoopClosure, MoveCase, find_camera_move
from fgreg.camera_moves.found import DetectedLoopClosure, DetectedMove
from fgreg.camera_moves.loop_closure import MIN_EARLIER, MOST_LOOKS, back_to
from fgreg.errors import EstimationError
from fgreg.geometry.transforms import IntArray
from fgreg.graph.contributions import contributions
from fgreg.graph.shared_state import Quadratic, one_epoch
from fgreg.graph.split_points import ALARM, logsumexp
from fgreg.model.measurements import EpochStart, Measurements
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.move_doubt import moves_in_epoch
from fgreg.registration.register import Registration, labels_and_inliers, pack_session, register

MOST_MOVES = 10
"""Largest number of moves that are looked for."""
ALARM_ONCE, ALARM_EACH = 4.0, 2.2
"""Where all pairs are tested once a move is certain from a lower score than online, where each pair brings a test: from
this score, and from this Bayes factor on average over all split points, as the sum grows with their number. One in 100
steady sessions of 25 PMs and constants within their budget reaches it."""
LEAST_OUTLIERS, MOST_LEFT = 2, 0.5
"""Outliers that may hide a move, and the largest share of them that is left after it."""
LEAST_SURE = 12
"""PMs of an epoch from which two minima may be the two sides of a move."""


@dataclass(frozen=True, slots=True, eq=False)
class EpochsFound:
    """Unreported camera moves, and loop closures (their epochs count with the moves).

    ``registration``: of the measurements with these epochs; None where they cannot be registered.
    """

    moves: tuple[DetectedMove, ...] = ()
    loop_closures: tuple[DetectedLoopClosure, ...] = ()
    registration: Registration | None = None

    @property
    def texts(self) -> tuple[str, ...]:
        """Sentences for the user."""
        return (*(move.text for move in self.moves), *(back.text for back in self.loop_closures))


def find_moves(measurements: Measurements, model: SessionModel, config: SolveConfig) -> tuple[DetectedMove, ...]:
    """The moves of :func:`find_epochs`."""
    return find_epochs(measurements, model, config).moves


def find_epochs(
    measurements: Measurements,
    model: SessionModel,
    config: SolveConfig,
) -> EpochsFound:
    """Unreported moves and loop closures, in the order of time.

    All shots are registered, and each epoch is tested for a move. After a move they are registered again as two
    epochs, and the boundary is placed where the two registrations have it, until no epoch shows a move.
    """
    moves: list[DetectedMove] = []
    registration = _registered(measurements, model, config)
    while registration is not None and len(moves) < MOST_MOVES:
        split = split_epochs(measurements, moves)
        move = _next_move(split, registration, model, config)
        if move is None:
            break
        moves = sorted([*moves, _detected(measurements, move.first, move.log_bayes)], key=lambda one: one.since)
        registration = _registered(split_epochs(measurements, moves), model, config)
        if registration is None:
            break
        before, moves = moves, placed(measurements, moves, registration, config)
        if moves != before:
            registration = _registered(split_epochs(measurements, moves), model, config)
    closures = _loop_closures(split_epochs(measurements, moves), registration, model, config)
    if closures:
        split = split_epochs(measurements, moves, closures)
        registration = _registered(split, model, config)
    return EpochsFound(tuple(moves), closures, registration)


def _registered(measurements: Measurements, model: SessionModel, config: SolveConfig) -> Registration | None:
    try:
        return register(measurements, model, config)
    except EstimationError:
        return None


def _detected(measurements: Measurements, since: int, log_bayes: float | None) -> DetectedMove:
    """A move before a pair, found when all pairs were in."""
    pairs = measurements.pairs
    return DetectedMove(pairs[since].epoch, since, pairs[since].t, pairs[since - 1].t, pairs[-1].t, log_bayes)


def _next_move(
    split: Measurements,
    registration: Registration,
    model: SessionModel,
    config: SolveConfig,
) -> CameraMove | None:
    for place in range(len(registration.epochs)):
        case = _case(split, registration, place)
        threshold = min(max(ALARM_ONCE, math.log(ALARM_EACH * len(case.pms))), ALARM)
        found = find_camera_move(case, model, config, MoveSettings(threshold=threshold))
        if isinstance(found, CameraMove):
            return found
        hidden = _move_among_inliers(split, registration, place, model, config)
        if hidden is not None:
            return hidden
    return None


def _move_among_inliers(
    split: Measurements, registration: Registration, place: int, model: SessionModel, config: SolveConfig
) -> CameraMove | None:
    """A move with inliers and outliers on both of its sides; None where there is none.

    The test starts from the inliers of one side, and such inliers have no registration. So the epoch is registered with
    the move at its likeliest place. Most outliers have to be inliers then: of false PMs hardly one becomes an inlier.
    """
    epoch = registration.epochs[place]
    pms, moves = moves_in_epoch(registration, place, outliers=True)
    labels, inlier = labels_and_inliers(registration, split)
    mine = [index for index, pair in enumerate(split.pairs) if pair.epoch == epoch]
    outliers = len({labels[index] for index in mine if not inlier[index]})
    by_split = logsumexp(moves.log, axis=1)
    if outliers < LEAST_OUTLIERS or logsumexp(by_split) < ALARM:
        return None
    best = int(np.argmax(by_split))
    first = next(index for index in mine if labels[index] == pms[best + 1])
    move = DetectedMove(epoch, first, split.pairs[first].t, split.pairs[first].t, split.pairs[first].t, None)
    divided = split_epochs(split, [move])
    found = _registered(divided, model, config)
    if found is None or not {epoch, epoch + 1} <= set(found.epochs):
        return None
    labels, inlier = labels_and_inliers(found, divided)
    left = len({(divided.pairs[index].epoch, labels[index]) for index in mine if not inlier[index]})
    if left > MOST_LEFT * outliers:
        return None
    return CameraMove(epoch, first, float(by_split[best]), float(logsumexp(by_split)))


def _case(
    split: Measurements, registration: Registration, place: int, earlier: dict[int, Quadratic] | None = None
) -> MoveCase:
    """The test's input for one of the registration's epochs; for a loop closure where ``earlier`` is given."""
    epoch = registration.epochs[place]
    labels, inlier = labels_and_inliers(registration, split)
    taken = registration.looks_of(split)
    looks: dict[int, list[int]] = {}
    for index, pair in enumerate(split.pairs):
        if pair.epoch == epoch:
            looks.setdefault(labels[index], []).append(index)
    sound = epoch not in registration.ambiguous or len(looks) >= LEAST_SURE
    return MoveCase(
        epoch=epoch,
        pms=tuple(tuple(replace(split.pairs[i], look=taken[i]) for i in indices) for indices in looks.values()),
        places=tuple(indices[0] for indices in looks.values()),
        inlier=np.array([inlier[indices[0]] for indices in looks.values()], dtype=bool),
        known=_known(registration, place, place) if sound and earlier is None else None,
        earlier=earlier or {},
    )


def _known(registration: Registration, without: int, of: int) -> Quadratic:
    """The prior of one epoch's shared variables (``of``) from everything but the pairs of one epoch (``without``)."""
    problem, optimum = registration.problem, registration.optimum
    parts = contributions(problem, optimum.state, optimum.evaluation.private).pm
    left_out = np.zeros(len(problem.pms))
    left_out[problem.beam_pm[problem.beam_epoch == without]] = 1.0
    hessian = optimum.evaluation.hessian[0] - parts.total(left_out)[0]
    gradient = optimum.evaluation.gradient[0] - left_out @ parts.gradient[0]
    mine = _columns(registration, of)
    others: IntArray = np.setdiff1d(np.arange(problem.columns.size), mine)
    if len(others):
        gain = hessian[np.ix_(mine, others)] @ np.linalg.pinv(hessian[np.ix_(others, others)], hermitian=True)
        gradient = gradient[mine] - gain @ gradient[others]
        hessian = hessian[np.ix_(mine, mine)] - gain @ hessian[np.ix_(others, mine)]
    return Quadratic(one_epoch(optimum.state, of), 0.0, gradient, 0.5 * (hessian + hessian.T))


def placed(
    measurements: Measurements,
    moves: Sequence[DetectedMove],
    registration: Registration,
    config: SolveConfig,
) -> list[DetectedMove]:
    """The moves, each at the likeliest boundary of the two epochs that it divides.

    ``registration``: of the measurements with these moves.
    """
    out = list(moves)
    for index, move in enumerate(moves):
        split = split_epochs(measurements, out)
        first = likeliest_first(split, split.pairs[move.since].epoch, registration, config)
        if first is not None:
            out[index] = _detected(measurements, first, move.log_bayes)
    return out


def likeliest_first(split: Measurements, epoch: int, registration: Registration, config: SolveConfig) -> int | None:
    """Index among the pairs of the first one of an epoch, at the likeliest boundary with the epoch before.

    None where one of the two has no registration. ``registration``: of the measurements.
    """
    if not {epoch - 1, epoch} <= set(registration.epochs):
        return None
    places = [registration.epochs.index(k) for k in (epoch - 1, epoch)]
    before, after = (_case(split, registration, place, {}) for place in places)
    pms = [*before.pms, *after.pms]
    pairs = tuple(replace(pair, pm=number, epoch=0) for number, looks in enumerate(pms) for pair in looks)
    problem = pack_session(
        Measurements((), pairs, (EpochStart(0.0),)),
        registration.model,
        replace(config, window_shape=False),
    )
    columns = [_columns(registration, place) for place in places]
    first, second = (registration.covariance[np.ix_(mine, mine)] for mine in columns)
    at = likeliest_boundary(
        problem,
        (one_epoch(registration.optimum.state, places[0]), one_epoch(registration.optimum.state, places[1])),
        (first, second),
        np.concatenate([before.inlier, after.inlier]),
        len(before.pms),
    )
    return (*before.places, *after.places)[at]


def _columns(registration: Registration, place: int) -> IntArray:
    """The columns of one epoch's shared variables."""
    columns = registration.problem.columns
    return np.asarray(np.r_[6 * place : 6 * place + 6, columns.beam : columns.size], dtype=np.int64)


def _loop_closures(
    split: Measurements,
    registration: Registration | None,
    model: SessionModel,
    config: SolveConfig,
) -> tuple[DetectedLoopClosure, ...]:
    """Epochs in which the camera is back where an earlier epoch had it, by their first pairs."""
    found = []
    for place, epoch in enumerate(() if registration is None else registration.epochs):
        assert registration is not None
        if not place or split.epochs[epoch].motion_known:
            continue
        pms = {k: len({p.pm for p in registration.measurements.pairs if p.epoch == k}) for k in range(place)}
        earlier = {registration.epochs[k]: _known(registration, place, k) for k, n in pms.items() if n >= MIN_EARLIER}
        if not earlier:
            continue
        case = _case(split, registration, place, earlier)
        looks = np.cumsum([len(pm) for pm in case.pms])
        case = replace(case, pms=case.pms[: int(np.sum(looks <= MOST_LOOKS))])
        back = find_camera_move(case, model, config)
        if isinstance(back, LoopClosure):
            found.append(DetectedLoopClosure(epoch, back.to, case.pms[-1][0].t, back.log_bayes))
    return tuple(found)


def split_epochs(
    measurements: Measurements, moves: Sequence[DetectedMove], loop_closures: Sequence[DetectedLoopClosure] = ()
) -> Measurements:
    """The measurements with an epoch more for every move found; reported motions stay between their sides.

    A loop closure links its epoch to the earlier one by a motion prior.

    All looks at a PM are of the epoch of its first, known points of that of their time.
    """
    starts: list[EpochStart] = []
    for epoch, start in enumerate(measurements.epochs):
        starts.append(start)
        starts.extend(EpochStart(move.since_t) for move in moves if move.epoch == epoch)
    for back in loop_closures:
        starts[back.epoch] = back_to(starts[back.epoch], back.to)
    first: dict[tuple[int, int], int] = {}
    for index, pair in enumerate(measurements.pairs):
        first.setdefault((pair.epoch, pair.pm), index)
    pairs = tuple(
        replace(pair, epoch=_with_moves(pair.epoch, first[pair.epoch, pair.pm], [(m.epoch, m.since) for m in moves]))
        for pair in measurements.pairs
    )
    points = tuple(
        replace(
            point,
            epoch=point.epoch
            + sum(m.epoch < point.epoch or (m.epoch == point.epoch and m.since_t <= point.t) for m in moves),
        )
        for point in measurements.points
    )
    return replace(measurements, pairs=pairs, epochs=tuple(starts), points=points)


def _with_moves(epoch: int, index: int, places: Sequence[tuple[int, int]]) -> int:
    """Epoch of what happened at ``index``, counting also moves given as (epoch, index)."""
    return epoch + sum(of < epoch or (of == epoch and at <= index) for of, at in places)


def renumbered(epoch_of: Sequence[int], shots: Sequence[int], moves: Sequence[DetectedMove]) -> tuple[int, ...]:
    """Epochs of all events of a session with the moves that were found.

    Args:
        epoch_of: epoch of every event, as reported.
        shots: index among the events of every pair that was measured.
        moves: found among those pairs.
    """
    places = [(move.epoch, shots[move.since]) for move in moves]
    return tuple(_with_moves(epoch, index, places) for index, epoch in enumerate(epoch_of))
