"""Untold camera moves in a recorded session: where its pairs say that an epoch ends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from fgreg.config import SolveConfig
from fgreg.errors import EstimationError
from fgreg.measurements import EpochStart, Measurements
from fgreg.models import SessionModel
from fgreg.online.follow import WINDOW, EpochFollower, summarise_aims
from fgreg.online.moves import MoveSettings, MoveTest, default_scales
from fgreg.registration import pack_session, register

START = 8
"""PMs that an epoch's first registration is made of."""
CONFIRM = 10
"""PMs after an alarm that may still shift where the move is put."""


@dataclass(frozen=True, slots=True)
class DetectedMove:
    """A move found by the pairs.

    Attributes:
        epoch: camera epoch (as told) that it divides.
        since: index among all pairs of the first pair after it.
        since_t: time of that pair. last_t: of the pair before.
        alarm_t: of the pair at which the evidence sufficed.
        log_bayes: of the move there against none, when it was found.
    """

    epoch: int
    since: int
    since_t: float
    last_t: float
    alarm_t: float
    log_bayes: float

    @property
    def text(self) -> str:
        """What to tell the user; pairs are counted from 1."""
        return (
            f"the camera moved between pair {self.since} and {self.since + 1} "
            f"({self.last_t:.1f} to {self.since_t:.1f} s), untold: solved as a camera epoch of its own from there"
        )


def default_settings() -> MoveSettings:
    """Settings that the figures in tools/study_moves.py are for."""
    return MoveSettings(default_scales())


def find_moves(
    measurements: Measurements, model: SessionModel, config: SolveConfig, settings: MoveSettings | None = None
) -> tuple[DetectedMove, ...]:
    """Moves that nobody told, in the order of time, found going through each told epoch's pairs.

    An epoch's first registration takes :data:`START` PMs; a move among those is not looked for.
    """
    settings = settings or default_settings()
    found: list[DetectedMove] = []
    for epoch in range(len(measurements.epochs)):
        mine = [i for i, pair in enumerate(measurements.pairs) if pair.epoch == epoch]
        names = list(dict.fromkeys(measurements.pairs[i].pm for i in mine))
        begin = 0
        while len(names) - begin > START:
            alone = _alone(measurements, mine, names[begin:])
            result = _first_move(alone, model, config, settings)
            if result is None:
                break
            place, alarm, log_bayes = result
            since = min(i for i in mine if measurements.pairs[i].pm == names[begin + place])
            before = max((i for i in mine if i < since), default=since)
            alarm_pm = names[begin + alarm]
            alarm_t = max(measurements.pairs[i].t for i in mine if measurements.pairs[i].pm == alarm_pm)
            pairs = measurements.pairs
            found.append(DetectedMove(epoch, since, pairs[since].t, pairs[before].t, alarm_t, log_bayes))
            begin += place
    return tuple(found)


def _alone(measurements: Measurements, mine: Sequence[int], names: Sequence[int]) -> Measurements:
    """Some PMs of one epoch as an epoch 0."""
    wanted = set(names)
    pairs = tuple(replace(measurements.pairs[i], epoch=0) for i in mine if measurements.pairs[i].pm in wanted)
    return Measurements(measurements.aims, pairs, (EpochStart(pairs[0].t),))


def _first_move(
    measurements: Measurements, model: SessionModel, config: SolveConfig, settings: MoveSettings
) -> tuple[int, int, float] | None:
    """Number of the first PM after the first move, of that at which it was found, and the log Bayes factor."""
    names = list(dict.fromkeys(pair.pm for pair in measurements.pairs))
    follower = None
    for count in range(START, len(names)):
        try:
            follower = _follower(measurements, names, count, model, config)
            break
        except EstimationError:
            continue
    if follower is None:
        return None
    for count in range(follower.count + 1, len(names) + 1):
        try:
            follower.advance(count)
        except EstimationError:
            return None
        test = follower.test(settings)
        if test is None or not test.alarm:
            continue
        place = _since(test, count)
        # A few pairs more may tell better where it happened.
        for more in range(count + 1, min(count + CONFIRM, len(names)) + 1):
            follower.advance(more)
            later = follower.test(settings, WINDOW + more - count)
            if later is not None and later.alarm:
                place = _since(later, more)
        return place, count - 1, float(test.log_bayes[test.since])
    return None


def _since(test: MoveTest, count: int) -> int:
    return count - len(test.log_bayes) + test.since


def _follower(
    measurements: Measurements, names: list[int], count: int, model: SessionModel, config: SolveConfig
) -> EpochFollower:
    first = set(names[:count])
    start = replace(measurements, pairs=tuple(pair for pair in measurements.pairs if pair.pm in first))
    state = register(start, model, config).optimum.state
    problem = summarise_aims(pack_session(measurements, model, config), state)
    return EpochFollower(problem, state, count)


def split_epochs(measurements: Measurements, moves: Sequence[DetectedMove]) -> Measurements:
    """The measurements with an epoch more for every move found; motions told before stay between their sides.

    All looks at a PM are of the epoch of its first.
    """
    starts: list[EpochStart] = []
    for epoch, start in enumerate(measurements.epochs):
        starts.append(start)
        starts.extend(EpochStart(move.since_t) for move in moves if move.epoch == epoch)
    first: dict[tuple[int, int], int] = {}
    for index, pair in enumerate(measurements.pairs):
        first.setdefault((pair.epoch, pair.pm), index)
    pairs = tuple(
        replace(pair, epoch=_with_moves(pair.epoch, first[pair.epoch, pair.pm], [(m.epoch, m.since) for m in moves]))
        for pair in measurements.pairs
    )
    return replace(measurements, pairs=pairs, epochs=tuple(starts))


def _with_moves(epoch: int, index: int, places: Sequence[tuple[int, int]]) -> int:
    """Epoch of what happened at ``index``, counting moves told as (epoch, index) too."""
    return epoch + sum(of < epoch or (of == epoch and at <= index) for of, at in places)


def renumbered(epoch_of: Sequence[int], shots: Sequence[int], moves: Sequence[DetectedMove]) -> tuple[int, ...]:
    """Epochs of all events of a session with the moves told.

    Args:
        epoch_of: epoch of every event, as told.
        shots: index among the events of every pair that was measured.
        moves: found among those pairs.
    """
    places = [(move.epoch, shots[move.since]) for move in moves]
    return tuple(_with_moves(epoch, index, places) for index, epoch in enumerate(epoch_of))


__all__ = ["DetectedMove", "default_settings", "find_moves", "renumbered", "split_epochs"]
