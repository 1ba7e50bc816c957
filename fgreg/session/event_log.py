"""``events.jsonl``: what happened, one JSON object per line. Angles stay the device's, in degrees."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from fgreg.errors import InputError, one_line
from fgreg.events import (
    AimEvent,
    CameraMovedEvent,
    Event,
    MarkerRecord,
    NoteEvent,
    PairEvent,
    RefusedEvent,
    StageEvent,
    TrackEvent,
    TrusRecord,
)
from fgreg.frames import FloatArray
from fgreg.session.frames_named import FrameKind, FrameUse, locate_frame
from fgreg.session.safe_yaml import open_file
from fgreg.session.schema import NOT_NEGATIVE, Bounds, Fields, Place, shown
from fgreg.session.setup import Setup

MAX_LINE_BYTES = 1_000_000
_MAX_INTEGER_DIGITS = 30
_SECONDS = Bounds(unit="s")
SCAN_DEG = Bounds(-180.0, 180.0, unit="deg")
RANGE_MM = Bounds(0.0, 300.0, above=True, unit="mm")
LATERAL_MM = Bounds(-200.0, 200.0, unit="mm")
COORDINATE_MM = Bounds(-2000, 2000, unit="mm")

_FIELDS = {
    "aim": ("marker", "camera_p_spot_mm", "covariance", "corner"),
    "pair": ("pm", "marker", "trus"),
    "track": ("marker", "trus", "looks", "scan_deg"),
    "camera_moved": ("camera_new_T_camera_old", "covariance", "detected", "since_t"),
    "refused": ("event", "reason"),
    "stage": ("command", "scan_deg", "reason"),
    "note": ("text",),
}
_MARKER = ("camera_T_marker", "covariance", "left", "right")
_TRUS = ("scan_deg", "x_mm", "range_mm", "covariance", "amplitude", "sweep", "frame")
_TRUS_WAYS = "x_mm and range_mm, or frame"


@dataclass(slots=True)
class EventLog:
    """What an ``events.jsonl`` holds: the events that are right, warnings, and the frames that any event names."""

    events: list[Event] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    frames: list[FrameUse] = field(default_factory=list)


class _RefusedJsonError(ValueError):
    """Well-formed, but not allowed here: a key twice, a number that is none."""


def read_events(path: Path, file: str, folder: Path, setup: Setup | None, problems: list[InputError]) -> EventLog:
    """Reads the events; appends to ``problems`` all that is wrong with them.

    Args:
        path: the file.
        file: how messages name it.
        folder: the session's folder, resolved.
        setup: what the session has; None where that could not be read, and is not checked against.
    """
    log = EventLog()
    try:
        stream = open_file(path, file)
    except InputError as error:
        problems.append(error)
        return log
    last: tuple[float, int] | None = None
    with stream:
        for number, line in _lines(stream, file, problems):
            place = Place(file, line=number, line_first=True)
            value = _parse(line, place, problems, log)
            if value is None:
                continue
            reader = _EventReader(value, place, folder, setup, log, problems)
            t = reader.time(last)
            if t is not None:
                last = (t, number)
            event = reader.event(t, number)
            if event is not None:
                log.events.append(event)
    return log


@dataclass(frozen=True, slots=True)
class LineRead:
    """One line by itself: its event, the frames that it names, and what is wrong with it (then there is no event)."""

    event: Event | None
    frames: tuple[FrameUse, ...]
    problems: tuple[InputError, ...]


def read_line(
    line: bytes, number: int, file: str, folder: Path, setup: Setup | None, last: tuple[float, int] | None
) -> LineRead:
    """Reads one whole line as :func:`read_events` does.

    Args:
        line: with its line break.
        number: of the line, from 1.
        file, folder, setup: as there.
        last: time and line of the event before, None for the first.
    """
    log, problems = EventLog(), list[InputError]()
    place = Place(file, line=number, line_first=True)
    if len(line) > MAX_LINE_BYTES:
        problems.append(InputError(str(place), f"{len(line)} bytes", f"at most {MAX_LINE_BYTES}"))
        return LineRead(None, (), tuple(problems))
    event = None
    value = _parse(line, place, problems, log)
    if value is not None:
        reader = _EventReader(value, place, folder, setup, log, problems)
        event = reader.event(reader.time(last), number)
    return LineRead(None if problems else event, tuple(log.frames), tuple(problems))


def _lines(stream: IO[bytes], file: str, problems: list[InputError]) -> Iterator[tuple[int, bytes]]:
    number = 0
    while True:
        try:
            line = stream.readline(MAX_LINE_BYTES + 1)
        except OSError as error:
            problems.append(InputError(file, f"no access ({error.strerror})", "a file that can be read"))
            return
        if not line:
            return
        number += 1
        if number == 1:
            line = line.removeprefix(b"\xef\xbb\xbf")
        if len(line) > MAX_LINE_BYTES:
            # What follows cannot be told apart into lines any more.
            where = f"{file}: line {number}"
            problems.append(InputError(where, "a longer line", f"at most {MAX_LINE_BYTES} bytes"))
            return
        yield number, line


def _parse(line: bytes, place: Place, problems: list[InputError], log: EventLog) -> Mapping[str, object] | None:
    """The object on a line; None where it is bad (reported) or a last line cut short (a warning)."""
    whole = line.endswith(b"\n")
    expected = "one JSON object"
    try:
        value = json.loads(
            line.rstrip(b"\r\n").decode("utf-8"),
            object_pairs_hook=_object,
            parse_constant=_refuse_constant,
            parse_int=_integer,
        )
    except _RefusedJsonError as error:
        found, expected = str(error), "finite numbers, and each key once"
    except RecursionError:
        found = "nesting too deep"
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        if not whole:
            log.warnings.append(f"{place}: cut short, dropped")
            return None
        if isinstance(error, UnicodeDecodeError):
            found, expected = "bytes that are not UTF-8", "UTF-8 text"
        elif not line.strip():
            found = "an empty line"
        else:
            found = f"bad JSON ({error.msg}, column {error.colno})"
    else:
        if isinstance(value, dict):
            return value
        found = shown(value)
    problems.append(InputError(str(place), found, expected))
    return None


def _object(pairs: list[tuple[str, object]]) -> dict[str, object]:
    out: dict[str, object] = {}
    for key, value in pairs:
        if key in out:
            raise _RefusedJsonError(f"the key {one_line(key, 40)} twice in one object")
        out[key] = value
    return out


def _refuse_constant(name: str) -> float:
    raise _RefusedJsonError(name)


def _integer(digits: str) -> int | float:
    # Python refuses to convert thousands of digits; no field here needs more than a double holds.
    return int(digits) if len(digits) <= _MAX_INTEGER_DIGITS else float(digits)


class _EventReader:
    """Reads one line's object."""

    def __init__(
        self,
        value: Mapping[str, object],
        place: Place,
        folder: Path,
        setup: Setup | None,
        log: EventLog,
        problems: list[InputError],
    ) -> None:
        kind = value.get("type")
        self._kind = kind if isinstance(kind, str) and kind in _FIELDS else None
        # Of an event of unknown type only type and time can be judged.
        known = _FIELDS[self._kind] if self._kind is not None else tuple(value)
        self._fields = Fields(value, ("type", "t", *known), place, problems)
        self._folder = folder
        self._setup = setup
        self._log = log

    def time(self, last: tuple[float, int] | None) -> float | None:
        """``t``, or None with the problem reported; ``last`` is the time and line of the event before."""
        before = len(self._fields.problems)
        t = self._fields.number("t", _SECONDS)
        if len(self._fields.problems) > before:
            return None
        if last is not None and t < last[0]:
            self._fields.fail("t", f"{t:.17g}", f"at least {last[0]:.17g}, the time on line {last[1]}")
        return t

    def event(self, t: float | None, line: int) -> Event | None:
        self._fields.text("type", f"one of {', '.join(_FIELDS)}", allowed=tuple(_FIELDS))
        time = 0.0 if t is None else t
        match self._kind:
            case "aim":
                return self._aim(time, line)
            case "pair":
                return self._pair(time, line)
            case "track":
                return self._track(time, line)
            case "camera_moved":
                return self._camera_moved(time, line)
            case "refused":
                return self._refused(time, line)
            case "stage":
                return self._stage(time, line)
            case "note":
                return self._note(time, line)
            case _:
                return None

    def _aim(self, t: float, line: int) -> AimEvent | None:
        fields = self._fields
        marker = self._marker(fields, board="corner" if fields.has("corner") else None)
        spot_mm = covariance = corner = None
        if fields.has("corner") == fields.has("camera_p_spot_mm"):
            found = "both" if fields.has("corner") else "neither"
            fields.fail("", found, "camera_p_spot_mm or corner")
        if fields.has("camera_p_spot_mm"):
            spot_mm = fields.numbers("camera_p_spot_mm", 3, COORDINATE_MM)
        if fields.has("covariance"):
            covariance = fields.covariance("covariance", 3)
            if not fields.has("camera_p_spot_mm"):
                fields.fail("covariance", "it without camera_p_spot_mm", "both or none")
        if fields.has("corner"):
            corner = self._corner()

        def make() -> AimEvent:
            if marker is None:
                raise AssertionError("a part is missing without a problem")
            return AimEvent(t, line, marker, spot_mm, covariance, corner)

        return fields.build(make)

    def _corner(self) -> tuple[int, int] | None:
        """[column, row] of an inner corner of the session's board."""
        fields = self._fields
        value = fields.raw("corner")
        setup = self._setup
        if setup is not None and "board" not in setup.present:
            fields.fail("corner", "it without a board in session.yaml", "board: {columns, rows, square_mm}")
        if not isinstance(value, list) or len(value) != 2 or any(type(v) is not int or v < 0 for v in value):
            fields.fail("corner", shown(value), "[column, row], two integers >= 0")
            return None
        board = None if setup is None else setup.board
        if board is not None and not (value[0] < board.columns and value[1] < board.rows):
            expected = f"[column, row] of a board with {board.columns} columns and {board.rows} rows, counted from 0"
            fields.fail("corner", shown(value), expected)
        return value[0], value[1]

    def _pair(self, t: float, line: int) -> PairEvent | None:
        fields = self._fields
        pm = fields.integer("pm", 0, 2**31 - 1)
        marker = self._marker(fields)
        trus = self._trus(fields.child("trus", _TRUS))

        def make() -> PairEvent:
            if marker is None or trus is None:
                raise AssertionError("a part is missing without a problem")
            return PairEvent(t, line, pm, marker, trus)

        return fields.build(make)

    def _track(self, t: float, line: int) -> TrackEvent | None:
        fields = self._fields
        marker = self._marker(fields)
        looks: list[TrusRecord | None] = []
        if fields.has("trus"):
            looks.append(self._trus(fields.child("trus", _TRUS)))
        if fields.has("looks"):
            looks.extend(self._trus(look) for look in fields.children("looks", _TRUS))
        scan_deg = fields.number("scan_deg", SCAN_DEG) if fields.has("scan_deg") else None
        if fields.has("trus") and fields.has("looks"):
            fields.fail("looks", "it together with trus", "one of the two")
        if not (fields.has("trus") or fields.has("looks") or fields.has("scan_deg")):
            fields.fail("", "none of trus, looks, scan_deg", "one of them")

        def make() -> TrackEvent:
            if marker is None:
                raise AssertionError("a part is missing without a problem")
            return TrackEvent(t, line, marker, tuple(look for look in looks if look is not None), scan_deg)

        return fields.build(make)

    def _camera_moved(self, t: float, line: int) -> CameraMovedEvent | None:
        fields = self._fields
        transform: FloatArray | None = None
        covariance: FloatArray | None = None
        since_t: float | None = None
        if fields.has("camera_new_T_camera_old"):
            transform = fields.transform("camera_new_T_camera_old")
        if fields.has("covariance"):
            covariance = fields.covariance("covariance", 6)
            if not fields.has("camera_new_T_camera_old"):
                fields.fail("covariance", "it without camera_new_T_camera_old", "both or none")
        detected = fields.boolean("detected", default=False)
        if fields.has("since_t"):
            since_t = fields.number("since_t", _SECONDS)
            if not fields.raw("detected"):
                fields.fail("since_t", "it without detected: true", "both or none")
            elif since_t > t:
                fields.fail("since_t", shown(since_t), f"at most t, {t:.17g}")
        return fields.build(lambda: CameraMovedEvent(t, line, transform, covariance, detected, since_t))

    def _refused(self, t: float, line: int) -> RefusedEvent | None:
        fields = self._fields
        if not fields.has("event"):
            fields.fail("event", "nothing", "the event that was not taken in")
        reason, value = fields.text("reason"), fields.raw("event")
        found = RefusedEvent(t, line, value, reason)
        if (of_line := found.refused_line) is not None and not 0 < of_line < line:
            fields.fail("event", f"line {of_line}", "an earlier line of this file")
        return fields.build(lambda: found)

    def _stage(self, t: float, line: int) -> StageEvent | None:
        fields = self._fields
        command = fields.text("command")
        scan_deg = fields.number("scan_deg", SCAN_DEG) if fields.has("scan_deg") else None
        reason = fields.text("reason") if fields.has("reason") else ""
        return fields.build(lambda: StageEvent(t, line, command, scan_deg, reason))

    def _note(self, t: float, line: int) -> NoteEvent | None:
        text = self._fields.text("text")
        return self._fields.build(lambda: NoteEvent(t, line, text))

    def _marker(self, event: Fields, board: str | None = None) -> MarkerRecord | None:
        """``marker``; ``board`` names the key that asks for a board in the same frames, pose or not."""
        fields = event.child("marker", _MARKER)
        if fields is None:
            return None
        pose = covariance = left = right = None
        if fields.has("camera_T_marker"):
            pose = fields.transform("camera_T_marker")
        if fields.has("covariance"):
            covariance = fields.covariance("covariance", 6)
            if not fields.has("camera_T_marker"):
                fields.fail("covariance", "it without camera_T_marker", "both or none")
        if fields.has("left"):
            left = self._frame(fields, "left", FrameKind.CAMERA)
        if fields.has("right"):
            right = self._frame(fields, "right", FrameKind.CAMERA)
            if not fields.has("left"):
                fields.fail("left", "nothing", "a frame of the left camera too")
        if not any(fields.has(key) for key in ("camera_T_marker", "left", "right")):
            fields.fail("", "neither camera_T_marker nor left", "the marker's pose or the frames to get it from")
        if board is not None and not fields.has("left"):
            event.fail(board, "it without frames", "marker.left, the frame in which to find the board")
        if fields.has("left") and (board is not None or not fields.has("camera_T_marker")):
            self._need_camera(fields, find_marker=not fields.has("camera_T_marker"))
        return fields.build(lambda: MarkerRecord(pose, covariance, left, right))

    def _need_camera(self, fields: Fields, find_marker: bool) -> None:
        if self._setup is None:
            return
        present = self._setup.present
        if "camera" not in present:
            fields.fail("left", "a frame, but no camera in session.yaml", "camera there, or camera_T_marker here")
        elif fields.has("right") and "camera.right" not in present:
            fields.fail("right", "a frame, but no camera.right in session.yaml", "camera.right there")
        if find_marker and "marker" not in present:
            fields.fail("left", "a frame, but no marker in session.yaml", "marker there, or camera_T_marker here")

    def _trus(self, fields: Fields | None) -> TrusRecord | None:
        if fields is None:
            return None
        scan_deg = fields.number("scan_deg", SCAN_DEG)
        x_mm = range_mm = covariance = amplitude = frame = None
        if fields.has("frame"):
            frame = self._frame(fields, "frame", FrameKind.TRUS)
            if fields.has("x_mm") or fields.has("range_mm"):
                fields.fail("frame", "it together with x_mm or range_mm", _TRUS_WAYS)
            present = None if self._setup is None else self._setup.present
            if present is not None and not present & {"probe.channels", "probe.image"}:
                expected = "one of them there, to read the frame by"
                fields.fail("frame", "a frame, but neither probe.channels nor probe.image in session.yaml", expected)
        if fields.has("x_mm") or not fields.has("frame"):
            x_mm = fields.number("x_mm", LATERAL_MM)
        if fields.has("range_mm") or not fields.has("frame"):
            range_mm = fields.number("range_mm", RANGE_MM)
        if fields.has("covariance"):
            covariance = fields.covariance("covariance", 2)
            if fields.has("frame"):
                fields.fail("covariance", "it together with frame", "it with x_mm and range_mm only")
        if fields.has("amplitude"):
            amplitude = fields.number("amplitude", NOT_NEGATIVE)
        sweep = fields.choice("sweep", (0, 1, -1), default=0)
        return fields.build(
            lambda: TrusRecord(scan_deg, x_mm, range_mm, covariance, amplitude, sweep, frame),
        )

    def _frame(self, fields: Fields, key: str, kind: FrameKind) -> Path | None:
        before = len(fields.problems)
        name = fields.text(key, "the name of a frame")
        if len(fields.problems) > before:
            return None
        where = str(fields.at(key))
        try:
            path = locate_frame(self._folder, name, where)
        except InputError as error:
            fields.problems.append(error)
            return None
        self._log.frames.append(FrameUse(path, name, kind, where))
        return path
