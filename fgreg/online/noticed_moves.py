"""Camera moves and loop closures that were detected, as reports and the recorded session have them."""

from __future__ import annotations

from dataclasses import dataclass, field

from fgreg.camera_moves.found import DetectedLoopClosure, DetectedMove
from fgreg.smoother.state import State


@dataclass(slots=True, eq=False)
class NoticedMoves:
    """What was detected, in the order of time.

    Attributes:
        moves: camera moves that were detected in this session; their epochs are numbered as reported.
        loop_closures: likewise.
        texts: of epochs that began with a detected move, also where it was detected when the session was recorded.
    """

    moves: list[DetectedMove] = field(default_factory=list)
    loop_closures: list[DetectedLoopClosure] = field(default_factory=list)
    texts: dict[int, str] = field(default_factory=dict)

    def add(
        self,
        before: State,
        epoch: int,
        first: int,
        since_t: float,
        t: float,
        log_bayes: float | None,
        *,
        recorded: bool = False,
    ) -> None:
        """Note a move that was detected, now or (``recorded``) when the session was recorded.

        Args:
            before: the state before the epoch began.
            epoch: that the move began.
            first: place of its first pair.
            since_t: time of that pair. t: of the alarm.
            log_bayes: log odds of the move; None where tags show it.
            recorded: see above.
        """
        last_t = before.shots[first - 1].pair.t if first else before.now.start.t
        move = DetectedMove(before.epoch - len(self.moves), first, since_t, last_t, t, log_bayes)
        if not recorded:
            self.moves.append(move)
        self.texts[epoch] = move.text

    def begun_by(self, state: State) -> DetectedMove | None:
        """The move with which the current epoch began; None where it was reported, or recorded as detected."""
        return next((move for move in self.moves if move.since == state.now.first), None)

    def by_pairs(self, state: State) -> bool:
        """Whether the current epoch began with a move that pairs showed (or a recorded one, where that is unknown)."""
        mine = self.begun_by(state)
        by_tags = mine is not None and mine.log_bayes is None
        return state.epoch in self.texts and not by_tags and not state.now.start.motion_known
