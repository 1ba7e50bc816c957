"""What happened in a session, as recorded: one dataclass per event type of ``events.jsonl``.

``line`` is the 1-based line in the file. Frame names are resolved paths inside the session's folder. Angles here are
still the *device's*, in degrees, as the file has them: measurements.py holds what the estimator sees.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from fgreg.frames import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class MarkerRecord:
    """A marker as recorded: a pose, the frames to get it from, or both (then the pose wins)."""

    camera_T_marker: FloatArray | None = None
    covariance: FloatArray | None = None
    left: Path | None = None
    right: Path | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TrusRecord:
    """A look as recorded: x and range, or the frame to get them from."""

    scan_deg: float
    x_mm: float | None = None
    range_mm: float | None = None
    covariance: FloatArray | None = None
    amplitude: float | None = None
    sweep: int = 0
    frame: Path | None = None

    @property
    def needs_frame(self) -> bool:
        """Whether x and range are to be found in the frame."""
        return self.frame is not None and self.x_mm is None


@dataclass(frozen=True, slots=True, eq=False)
class AimEvent:
    """A calibration shot: the beam was aimed at a known spot."""

    t: float
    line: int
    marker: MarkerRecord
    camera_p_spot_mm: FloatArray | None = None
    covariance: FloatArray | None = None
    corner: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PairEvent:
    """A registration shot: a beam and one look at its photoacoustic marker."""

    t: float
    line: int
    pm: int
    marker: MarkerRecord
    trus: TrusRecord


@dataclass(frozen=True, slots=True, eq=False)
class TrackEvent:
    """A query: where to turn the stage for this beam."""

    t: float
    line: int
    marker: MarkerRecord
    looks: tuple[TrusRecord, ...] = ()
    scan_deg: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CameraMovedEvent:
    """The endoscope moved: a new epoch begins."""

    t: float
    line: int
    camera_new_T_camera_old: FloatArray | None = None
    covariance: FloatArray | None = None
    detected: bool = False
    since_t: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RefusedEvent:
    """An event that was not taken in: ``event`` as recorded (a mapping as a rule), and why.

    Where the event itself is in the file, on an earlier line, ``event`` names that line: it does not count.
    """

    t: float
    line: int
    event: object
    reason: str

    @property
    def refused_line(self) -> int | None:
        """Line of the refused event, where it was recorded before it was refused."""
        line = self.event.get("line") if isinstance(self.event, Mapping) else None
        return line if type(line) is int else None


@dataclass(frozen=True, slots=True)
class StageEvent:
    """What the stage was told: of no effect on an estimate."""

    t: float
    line: int
    command: str
    scan_deg: float | None = None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class NoteEvent:
    """Somebody's words: of no effect on an estimate."""

    t: float
    line: int
    text: str


Event = AimEvent | PairEvent | TrackEvent | CameraMovedEvent | RefusedEvent | StageEvent | NoteEvent


Shot = AimEvent | PairEvent | TrackEvent
"""Events with a marker."""


def looks_of(event: Event) -> tuple[TrusRecord, ...]:
    """The looks that an event brings."""
    if isinstance(event, PairEvent):
        return (event.trus,)
    return event.looks if isinstance(event, TrackEvent) else ()


def needs_marker_frames(record: MarkerRecord, *, redetect: bool) -> bool:
    """Whether the marker is to be found in the frames rather than taken from the recorded pose."""
    return record.left is not None and (record.camera_T_marker is None or redetect)


def needs_board(event: Shot) -> bool:
    """Whether the board is to be found in the frames of an aim, rather than the spot taken as recorded."""
    return isinstance(event, AimEvent) and event.camera_p_spot_mm is None


def needs_frames(event: Event, *, redetect: bool) -> bool:
    """Whether anything of an event is to be found in its frames."""
    if isinstance(event, Shot) and (needs_board(event) or needs_marker_frames(event.marker, redetect=redetect)):
        return True
    return any(look.needs_frame for look in looks_of(event))


def refused_lines(events: Iterable[Event]) -> dict[int, str]:
    """Lines of recorded events that were refused afterwards, each with the reason."""
    found = {}
    for event in events:
        if isinstance(event, RefusedEvent) and (line := event.refused_line) is not None:
            found[line] = event.reason
    return found
