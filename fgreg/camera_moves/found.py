"""Unreported camera moves and loop closures that were detected."""

from __future__ import annotations

from dataclasses import dataclass

LOOP_TEXT = "in epoch {} the camera is back where it was in epoch {}: that registration is used"


@dataclass(frozen=True, slots=True)
class DetectedMove:
    """An unreported camera move that was detected.

    Attributes:
        epoch: camera epoch (numbered as reported) that it divides.
        since: index among all pairs of the first pair after it (where tags showed it: of the next pair).
        since_t: time of that pair, or of the first frame of tags after it. last_t: of the pair before.
        alarm_t: of the event at which it was detected.
        log_bayes: of a move there against none, where pairs showed it; None where tags did.
    """

    epoch: int
    since: int
    since_t: float
    last_t: float
    alarm_t: float
    log_bayes: float | None

    @property
    def text(self) -> str:
        """Sentence for the user; pairs are counted from 1."""
        return (
            f"the camera moved between pair {self.since} and {self.since + 1} "
            f"({self.last_t:.1f} to {self.since_t:.1f} s), unreported: a camera epoch of its own begins there"
        )


@dataclass(frozen=True, slots=True)
class DetectedLoopClosure:
    """A loop closure: by the pairs, the camera is back where an earlier epoch had it.

    Attributes:
        epoch: number of the epoch in which it is back. to: of the earlier one.
        t: of the pair at which it was detected. log_bayes: of the same place against elsewhere; None where it was
            detected when the session was recorded.
    """

    epoch: int
    to: int
    t: float
    log_bayes: float | None

    @property
    def text(self) -> str:
        """Sentence for the user, and for the session's record (:meth:`LoopClosed.of_note`)."""
        return LOOP_TEXT.format(self.epoch, self.to)
