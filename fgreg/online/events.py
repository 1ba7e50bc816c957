"""Events of the online registration, in addition to the measurement types. Millimetres, radians, seconds."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from fgreg.camera_moves.found import LOOP_TEXT
from fgreg.geometry.transforms import FloatArray
from fgreg.model.measurements import Aim, KnownPoint, Measurements, Pair


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


OnlineEvent = Aim | Pair | KnownPoint | CameraMoved | StaticTags | LoopClosed


def events_in_order(measurements: Measurements) -> Iterator[tuple[int | None, OnlineEvent]]:
    """Aims, pairs (with their index), points and reported moves in the order of time; of the same time moves first."""
    timed: list[tuple[float, int, int, int | None, OnlineEvent]] = []
    for place, start in enumerate(measurements.epochs[1:]):
        moved = CameraMoved(start.t, start.camera_new_T_camera_old, start.covariance)
        timed.append((start.t, 0, place, None, moved))
    timed.extend((aim.t, 1, place, None, aim) for place, aim in enumerate(measurements.aims))
    timed.extend((pair.t, 1, len(measurements.aims) + i, i, pair) for i, pair in enumerate(measurements.pairs))
    timed.extend((point.t, 2, place, None, point) for place, point in enumerate(measurements.points))
    for _, _, _, index, event in sorted(timed, key=lambda entry: entry[:3]):
        yield index, event
