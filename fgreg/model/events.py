"""Recorded events of a session: one dataclass per event type of ``events.jsonl``, which it describes.

``line`` is the 1-based line in the file. Frame names are resolved paths inside the session's folder. Angles here are
those of the *device*, in degrees, as in the file; measurements.py has the numbers that the estimator uses.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from fgreg.geometry.transforms import FloatArray
from fgreg.schema.files import FrameKind, FrameName
from fgreg.schema.kinds import (
    NOT_NEGATIVE,
    POINT_MM,
    SCAN_DEG,
    SECONDS,
    Anything,
    Integer,
    IntegerPair,
    Number,
    Numbers,
)
from fgreg.schema.matrices import Covariance, Transform
from fgreg.schema.problems import FieldError, shown
from fgreg.schema.record import Key, Tagged

RANGE_MM = Number(0.0, 300.0, above=True, unit="mm")
LATERAL_MM = Number(-200.0, 200.0, unit="mm")

_PIXEL = Numbers(2, Number(-1e5, 1e5, unit="px"))
_CAMERA_FRAME = FrameName(FrameKind.CAMERA)
Seconds = Annotated[float, Key("s, not decreasing", SECONDS)]


@dataclass(frozen=True, slots=True, eq=False)
class MarkerRecord:
    """A marker as recorded: a pose, the frames to get it from, or both (then the pose wins)."""

    JSON_RULES: ClassVar = (
        {"anyOf": [{"required": ["camera_T_marker"]}, {"required": ["left"]}]},
        {"dependentRequired": {"right": ["left"]}},
    )

    camera_T_marker: Annotated[FloatArray | None, Key("the pose", Transform())] = None
    covariance: Annotated[FloatArray | None, Key("of the pose", Covariance(6), requires="camera_T_marker")] = None
    left: Annotated[Path | None, Key("frame of the left camera", _CAMERA_FRAME)] = None
    right: Annotated[Path | None, Key("frame of the right camera", _CAMERA_FRAME)] = None

    def __post_init__(self) -> None:
        if self.right is not None and self.left is None:
            raise FieldError.of("nothing", "a frame of the left camera too", "left")
        if self.camera_T_marker is None and self.left is None:
            expected = "the marker's pose or the frames to get it from"
            raise FieldError.of("neither camera_T_marker nor left", expected)


@dataclass(frozen=True, slots=True, eq=False)
class OtherRecord:
    """Another position in the plane at which the PM may be."""

    x_mm: Annotated[float, Key("as of the look", LATERAL_MM)]
    range_mm: Annotated[float, Key("as of the look", RANGE_MM)]
    covariance: Annotated[FloatArray | None, Key("over (x_mm, range_mm)", Covariance(2))] = None


@dataclass(frozen=True, slots=True, eq=False)
class TrusRecord:
    """A look as recorded: x and range, or the frame to get them from."""

    JSON_RULES: ClassVar = (
        {"anyOf": [{"required": ["x_mm", "range_mm"]}, {"required": ["frame"]}]},
        *({"not": {"required": ["frame", key]}} for key in ("x_mm", "range_mm", "covariance")),
    )

    scan_deg: Annotated[float, Key("what the device reads", SCAN_DEG)]
    x_mm: Annotated[float | None, Key("along the axis of rotation", LATERAL_MM)] = None
    range_mm: Annotated[
        float | None, Key("from the element, not from the axis: sound speed times time of flight", RANGE_MM)
    ] = None
    frame: Annotated[Path | None, Key("instead of x and range", FrameName(FrameKind.TRUS))] = None
    covariance: Annotated[FloatArray | None, Key("over (x_mm, range_mm)", Covariance(2))] = None
    amplitude: Annotated[float | None, Key("comparable only between looks at one `pm`", NOT_NEGATIVE)] = None
    sweep: Annotated[
        int,
        Key(
            "+1 or -1 where the stage was stepping that way (device angle increasing or decreasing by `step_deg`) and "
            "stopped at the first angle at which the PM was detected",
            Integer(allowed=(0, 1, -1)),
            brief=True,
        ),
    ] = 0
    others: Annotated[
        tuple[OtherRecord, ...],
        Key("where the PM may be instead: later waves in the frame, the strongest first", requires="x_mm", brief=True),
    ] = ()

    def __post_init__(self) -> None:
        if self.frame is None:
            for key, value, bounds in (("x_mm", self.x_mm, LATERAL_MM), ("range_mm", self.range_mm, RANGE_MM)):
                if value is None:
                    raise FieldError.of("nothing", bounds.expected, key)
        elif self.x_mm is not None or self.range_mm is not None:
            raise FieldError.of("it together with x_mm or range_mm", "x_mm and range_mm, or frame", "frame")
        elif self.covariance is not None:
            raise FieldError.of("it together with frame", "it with x_mm and range_mm only", "covariance")

    @property
    def needs_frame(self) -> bool:
        """Whether x and range are to be found in the frame."""
        return self.frame is not None and self.x_mm is None


@dataclass(frozen=True, slots=True, eq=False)
class AimEvent:
    """A calibration shot: the beam was aimed at a known spot."""

    JSON_RULES: ClassVar = ({"oneOf": [{"required": ["camera_p_spot_mm"]}, {"required": ["corner"]}]},)

    t: Seconds
    line: int
    marker: Annotated[MarkerRecord, Key("the marker's pose or frames")]
    camera_p_spot_mm: Annotated[FloatArray | None, Key("[x, y, z] of the spot", POINT_MM)] = None
    covariance: Annotated[FloatArray | None, Key("of the spot", Covariance(3), requires="camera_p_spot_mm")] = None
    corner: Annotated[
        tuple[int, int] | None,
        Key(
            "[column, row] of the board's corner that was aimed at, to be found in the same frames; instead of a spot",
            IntegerPair(0, 2**31 - 1, "[column, row], two integers >= 0"),
        ),
    ] = None

    def __post_init__(self) -> None:
        if self.corner is not None and self.marker.left is None:
            raise FieldError.of("it without frames", "marker.left, the frame in which to find the board", "corner")
        if (self.corner is None) == (self.camera_p_spot_mm is None):
            raise FieldError.of("neither" if self.corner is None else "both", "camera_p_spot_mm or corner")


_CAMERA_POINT = {"oneOf": [{"required": ["camera_p_mm"]}, {"required": ["left", "right"]}]}
_BOTH_VIEWS = {"dependentRequired": {"left": ["right"], "right": ["left"]}}


def _check_camera_point(point: FloatArray | None, left: FloatArray | None, right: FloatArray | None) -> None:
    """Whether a point is given in the camera's frame, or else in both views."""
    if (left is None) != (right is None):
        given, absent = ("left", "right") if right is None else ("right", "left")
        raise FieldError.of("nothing", f"[u, v], with {given}", absent)
    if (point is None) == (left is None):
        raise FieldError.of("neither" if left is None else "both", "camera_p_mm, or left and right")


@dataclass(frozen=True, slots=True, eq=False)
class SpotRecord:
    """The laser's spot on the tissue as the camera sees it: a point, or its pixels in both views."""

    JSON_RULES: ClassVar = (_CAMERA_POINT, _BOTH_VIEWS)

    camera_p_mm: Annotated[FloatArray | None, Key("[x, y, z] of the spot in the camera's frame", POINT_MM)] = None
    covariance: Annotated[
        FloatArray | None,
        Key(
            "of `camera_p_mm`, of seeing it alone; `noise.marker_translation_mm` where absent",
            Covariance(3),
            requires="camera_p_mm",
        ),
    ] = None
    left: Annotated[
        FloatArray | None, Key("[u, v] of the spot in the left frame, as recorded; instead of `camera_p_mm`", _PIXEL)
    ] = None
    right: Annotated[FloatArray | None, Key("[u, v] in the right frame", _PIXEL, requires="left")] = None

    def __post_init__(self) -> None:
        _check_camera_point(self.camera_p_mm, self.left, self.right)


@dataclass(frozen=True, slots=True, eq=False)
class PairEvent:
    """A registration shot: a beam and one look at its photoacoustic marker."""

    t: Seconds
    line: int
    pm: Annotated[int, Key("events with the same `pm` are looks at the same spot", Integer(0, 2**31 - 1))]
    marker: Annotated[MarkerRecord, Key("the marker's pose or frames")]
    trus: Annotated[TrusRecord, Key("the look")]
    spot: Annotated[SpotRecord | None, Key("the laser's spot, where the camera sees it", brief=True)] = None


@dataclass(frozen=True, slots=True, eq=False)
class TrackEvent:
    """A query: where to turn the stage for this beam."""

    JSON_RULES: ClassVar = (
        {"anyOf": [{"required": [key]} for key in ("trus", "looks", "scan_deg")]},
        {"not": {"required": ["trus", "looks"]}},
    )

    t: Seconds
    line: int
    marker: Annotated[MarkerRecord, Key("the marker's pose or frames")]
    trus: Annotated[TrusRecord | None, Key("the look, where the PM is detected now")] = None
    several: Annotated[tuple[TrusRecord, ...], Key("several such looks, instead", name="looks", brief=True)] = ()
    scan_deg: Annotated[float | None, Key("where the stage stands, where the PM is not detected", SCAN_DEG)] = None

    def __post_init__(self) -> None:
        if self.trus is not None and self.several:
            raise FieldError.of("it together with trus", "one of the two", "looks")
        if self.trus is None and not self.several and self.scan_deg is None:
            raise FieldError.of("none of trus, looks, scan_deg", "one of them")

    @property
    def looks(self) -> tuple[TrusRecord, ...]:
        """The query's looks at the PM; empty where it is not detected now."""
        return self.several if self.trus is None else (self.trus,)


@dataclass(frozen=True, slots=True, eq=False)
class CameraMovedEvent:
    """The endoscope moved: a new epoch begins."""

    JSON_RULES: ClassVar = (
        {
            "dependentSchemas": {
                "since_t": {"properties": {"detected": {"const": True}}, "required": ["detected"]},
            }
        },
    )

    t: Seconds
    line: int
    camera_new_T_camera_old: Annotated[FloatArray | None, Key("the move, where it is known", Transform())] = None
    covariance: Annotated[FloatArray | None, Key("of the move", Covariance(6), requires="camera_new_T_camera_old")] = (
        None
    )
    detected: Annotated[bool, Key("detected by a program, not reported", brief=True)] = False
    since_t: Annotated[float | None, Key("with `detected`: from when on the new epoch counts, s", SECONDS)] = None

    def __post_init__(self) -> None:
        if self.since_t is not None:
            if not self.detected:
                raise FieldError.of("it without detected: true", "both or none", "since_t")
            if self.since_t > self.t:
                raise FieldError.of(shown(self.since_t), f"at most t, {self.t:.17g}", "since_t")


@dataclass(frozen=True, slots=True, eq=False)
class PlaneRecord:
    """A point as seen in the image plane, with the stage turned to where it is brightest."""

    scan_deg: Annotated[float, Key("what the device reads", SCAN_DEG)]
    x_mm: Annotated[float, Key("along the axis of rotation", LATERAL_MM)]
    range_mm: Annotated[float, Key("from the element, not from the axis", RANGE_MM)]
    covariance: Annotated[
        FloatArray | None, Key("over (x_mm, range_mm); `noise` of session.yaml where absent", Covariance(2))
    ] = None


@dataclass(frozen=True, slots=True, eq=False)
class _SeenByBoth:
    """What ``check`` and ``point`` have in common: a point that both devices locate."""

    JSON_RULES: ClassVar = (
        _CAMERA_POINT,
        _BOTH_VIEWS,
        {"oneOf": [{"required": ["trus_p_mm"]}, {"required": ["trus"]}]},
    )

    t: Seconds
    line: int
    camera_p_mm: Annotated[FloatArray | None, Key("[x, y, z] of the point in the camera's frame", POINT_MM)] = None
    covariance: Annotated[
        FloatArray | None,
        Key(
            "of `camera_p_mm`; `noise.marker_translation_mm` where absent",
            Covariance(3),
            requires="camera_p_mm",
        ),
    ] = None
    left: Annotated[
        FloatArray | None, Key("[u, v] of the point in the left frame, as recorded; instead of `camera_p_mm`", _PIXEL)
    ] = None
    right: Annotated[FloatArray | None, Key("[u, v] in the right frame", _PIXEL, requires="left")] = None
    trus_p_mm: Annotated[FloatArray | None, Key("[x, y, z] of the point in the TRUS frame", POINT_MM)] = None
    trus_covariance: Annotated[
        FloatArray | None,
        Key("of `trus_p_mm`; that of a point seen in the plane where absent", Covariance(3), requires="trus_p_mm"),
    ] = None
    trus: Annotated[PlaneRecord | None, Key("the point as seen in the plane; instead of `trus_p_mm`")] = None

    def __post_init__(self) -> None:
        _check_camera_point(self.camera_p_mm, self.left, self.right)
        if (self.trus_p_mm is None) == (self.trus is None):
            raise FieldError.of("neither" if self.trus is None else "both", "trus_p_mm or trus")


@dataclass(frozen=True, slots=True, eq=False)
class CheckEvent(_SeenByBoth):
    """A point known to both devices. It is never added to the estimate: it checks the registration."""


@dataclass(frozen=True, slots=True, eq=False)
class PointEvent(_SeenByBoth):
    """A point known to both devices as data of the registration: a tool's tip, a bead. It never checks it."""


@dataclass(frozen=True, slots=True, eq=False)
class RefusedEvent:
    """An event that was not taken in: ``event`` as recorded (a mapping as a rule), and why.

    Where the event itself is in the file, on an earlier line, ``event`` names that line: it does not count.
    """

    t: Seconds
    line: int
    event: Annotated[
        object,
        Key(
            "the event as it was reported; where it was recorded first, on a line of its own, its `line` (a number)",
            Anything("the event that was not taken in"),
        ),
    ]
    reason: Annotated[str, Key("why")]

    @property
    def refused_line(self) -> int | None:
        """Line of the refused event, where it was recorded before it was refused."""
        line = self.event.get("line") if isinstance(self.event, Mapping) else None
        return line if type(line) is int else None


@dataclass(frozen=True, slots=True)
class _HandChoice:
    """What ``exclude`` and ``include`` have in common: a PM (all its looks), or the line of one shot."""

    JSON_RULES: ClassVar = ({"oneOf": [{"required": ["pm"]}, {"required": ["line"]}]},)

    t: Seconds
    line: int
    pm: Annotated[int | None, Key("all looks at this PM up to now", Integer(0, 2**31 - 1))] = None
    shot_line: Annotated[
        int | None,
        Key("one aim, look or known point instead: its line in this file", Integer(1, 2**31 - 1), name="line"),
    ] = None
    reason: Annotated[str, Key("why", brief=True)] = ""
    by: Annotated[str, Key("who decided it", brief=True)] = ""

    def __post_init__(self) -> None:
        if (self.pm is None) == (self.shot_line is None):
            raise FieldError.of("neither" if self.pm is None else "both", "pm or line")


@dataclass(frozen=True, slots=True)
class ExcludeEvent(_HandChoice):
    """Earlier shots that are left out by hand from here on, until an ``include``. Nothing is deleted."""


@dataclass(frozen=True, slots=True)
class IncludeEvent(_HandChoice):
    """Takes an ``exclude`` back."""


@dataclass(frozen=True, slots=True)
class StageEvent:
    """A command to the stage; it has no effect on the estimate."""

    t: Seconds
    line: int
    command: Annotated[str, Key("the command")]
    scan_deg: Annotated[float | None, Key("where to, device angle", SCAN_DEG)] = None
    reason: Annotated[str, Key("why", brief=True)] = ""


@dataclass(frozen=True, slots=True)
class NoteEvent:
    """A note by the operator, or of a loop closure by the program (fgreg.online.events); others have no effect."""

    t: Seconds
    line: int
    text: Annotated[str, Key("for the record")]


HandChoice = ExcludeEvent | IncludeEvent
"""A choice of shots by hand."""

Event = (
    AimEvent
    | PairEvent
    | TrackEvent
    | CameraMovedEvent
    | CheckEvent
    | PointEvent
    | HandChoice
    | RefusedEvent
    | StageEvent
    | NoteEvent
)

EVENTS = Tagged(
    "type",
    {
        "aim": AimEvent,
        "pair": PairEvent,
        "track": TrackEvent,
        "camera_moved": CameraMovedEvent,
        "check": CheckEvent,
        "point": PointEvent,
        "exclude": ExcludeEvent,
        "include": IncludeEvent,
        "refused": RefusedEvent,
        "stage": StageEvent,
        "note": NoteEvent,
    },
)
"""A line of ``events.jsonl``."""


Shot = AimEvent | PairEvent | TrackEvent
"""Events with a marker."""

EVIDENCE = AimEvent | PairEvent | PointEvent | CheckEvent | CameraMovedEvent
"""Events that tests of a registration rest on."""


def looks_of(event: Event) -> tuple[TrusRecord, ...]:
    """The looks of an event."""
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


def refused_evidence(events: Sequence[Event]) -> tuple[str, ...]:
    """Why each recorded aim, look, point, check or camera move was refused that does not count for that reason."""
    refused = refused_lines(events)
    return tuple(refused[event.line] for event in events if event.line in refused and isinstance(event, EVIDENCE))


def refused_lines(events: Iterable[Event]) -> dict[int, str]:
    """Lines of recorded events that were refused afterwards, each with the reason."""
    found = {}
    for event in events:
        if isinstance(event, RefusedEvent) and (line := event.refused_line) is not None:
            found[line] = event.reason
    return found
