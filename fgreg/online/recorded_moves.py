"""Unreported camera moves in a recorded session: what the online engine finds, event by event."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from fgreg.camera_moves.loop_closure import back_to
from fgreg.errors import EventRefused
from fgreg.model.measurements import EpochStart, Measurements
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine import OnlineRegistration
from fgreg.online.events import CameraMoved, DetectedLoopClosure, DetectedMove, OnlineEvent


@dataclass(frozen=True, slots=True)
class EpochsFound:
    """Unreported camera moves, and loop closures (their epochs count with the moves)."""

    moves: tuple[DetectedMove, ...] = ()
    loop_closures: tuple[DetectedLoopClosure, ...] = ()

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
    """Unreported moves and loop closures in the order of time, as the online engine detects them in the same events.

    The online engine has no radius variable: ``config.estimate_radius`` is ignored here.
    """
    if config.estimate_radius:
        config = replace(config, estimate_radius=False)
    engine = OnlineRegistration(model, config, verdicts=False, start=measurements.epochs[0])
    index_of: list[int] = []
    for index, event in events_in_order(measurements):
        try:
            engine.add(event)
        except EventRefused:
            continue
        if index is not None:
            index_of.append(index)
    pairs = measurements.pairs
    found = []
    for move in engine.moves:
        since = index_of[move.since]
        found.append(replace(move, since=since, epoch=pairs[since].epoch))
    return EpochsFound(tuple(found), engine.loop_closures)


def events_in_order(measurements: Measurements) -> Iterator[tuple[int | None, OnlineEvent]]:
    """Aims, pairs (with their index) and reported moves in the order of time; of the same time moves first."""
    timed: list[tuple[float, int, int, int | None, OnlineEvent]] = []
    for place, start in enumerate(measurements.epochs[1:]):
        moved = CameraMoved(start.t, start.camera_new_T_camera_old, start.covariance)
        timed.append((start.t, 0, place, None, moved))
    timed.extend((aim.t, 1, place, None, aim) for place, aim in enumerate(measurements.aims))
    timed.extend((pair.t, 1, len(measurements.aims) + i, i, pair) for i, pair in enumerate(measurements.pairs))
    for _, _, _, index, event in sorted(timed, key=lambda entry: entry[:3]):
        yield index, event


def split_epochs(
    measurements: Measurements, moves: Sequence[DetectedMove], loop_closures: Sequence[DetectedLoopClosure] = ()
) -> Measurements:
    """The measurements with an epoch more for every move found; reported motions stay between their sides.

    A loop closure links its epoch to the earlier one by a motion prior.

    All looks at a PM are of the epoch of its first.
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
    return replace(measurements, pairs=pairs, epochs=tuple(starts))


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
