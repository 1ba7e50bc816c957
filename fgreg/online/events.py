"""Events of the online registration, in addition to the measurement types. Millimetres, radians, seconds."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from fgreg.geometry.transforms import FloatArray
from fgreg.model.measurements import Aim, Pair

LOOP_TEXT = "in epoch {} the camera is back where it was in epoch {}: that registration is used"


@dataclass(frozen=True, slots=True, eq=False)
class CameraMoved:
    """The camera moved: a new epoch begins.

    Attributes:
        t: when it was reported, or detected.
        camera_new_T_camera_old: (4, 4), where kinematics measured it.
        covariance: (6, 6) over its right tangent; a motion without one is not used.
        detected: whether the program detected the move.
        since_t: of a detected move: pairs from this time on belong to the new epoch.
    """

    t: float
    camera_new_T_camera_old: FloatArray | None = None
    covariance: FloatArray | None = None
    detected: bool = False
    since_t: float | None = None


@dataclass(frozen=True, slots=True)
class LoopClosed:
    """A loop closure that was detected when the session was recorded; taken in only when it is opened again.

    Attributes:
        t: when it was recorded.
        epoch: number of the epoch in which the camera is back. to: of the earlier one.
    """

    t: float
    epoch: int
    to: int

    @classmethod
    def of_note(cls, t: float, text: str) -> LoopClosed | None:
        """The loop closure that a recorded note of time ``t`` says, in the words of :class:`DetectedLoopClosure`."""
        found = re.fullmatch(LOOP_TEXT.format("([0-9]{1,9})", "([0-9]{1,9})"), text)
        return None if found is None else cls(t, int(found[1]), int(found[2]))


@dataclass(frozen=True, slots=True, eq=False)
class StaticTags:
    """Tags fixed in the room as the camera sees them now.

    Attributes:
        t: time.
        camera_T_tag: (4, 4) by tag.
        covariance: (6, 6) over the right tangent, by tag.
    """

    t: float
    camera_T_tag: Mapping[int, FloatArray]
    covariance: Mapping[int, FloatArray]


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


OnlineEvent = Aim | Pair | CameraMoved | StaticTags | LoopClosed
