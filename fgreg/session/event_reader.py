"""Reads ``events.jsonl``: one JSON object per line, described by fgreg.model.events."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from fgreg.errors import InputError, one_line
from fgreg.model.camera_model import StereoRig
from fgreg.model.events import (
    EVENTS,
    AimEvent,
    CheckEvent,
    Event,
    HandChoice,
    MarkerRecord,
    PairEvent,
    PointEvent,
    RefusedEvent,
    SpotRecord,
    TrackEvent,
    TrusRecord,
)
from fgreg.schema.files import FrameKind
from fgreg.schema.kinds import SECONDS
from fgreg.schema.limits import DIGITS, EVENT_LINES, LINE_BYTES, PAIRS, PROBLEMS
from fgreg.schema.problems import FieldError, Problem, input_error, numbers_text, path_text, shown
from fgreg.session.frame_files import FrameUse
from fgreg.session.setup_reader import Setup
from fgreg.session.yaml_loader import open_file

_CLOSES = {"{": "}", "[": "]"}
# A text (perhaps cut short), a bracket, or what else is between them.
_PIECE = re.compile(r'"(?:[^"\\\x00-\x1f]|\\[^\x00-\x1f])*+(?:"|\\?\Z)|[{}\[\]]|[ \t,:0-9+.eEtrufalsn-]+')


@dataclass(slots=True)
class EventLog:
    """The valid events of an ``events.jsonl``, and a sentence about a last line that is cut short, where it is."""

    events: list[Event] = field(default_factory=list)
    cut_short: str = ""


@dataclass(slots=True)
class ShotsSeen:
    """What the lines up to now hold that later lines refer to.

    Attributes:
        last: time and line of the last event with a time, None before the first.
        pms: of the looks. lines: of the aims, looks and known points.
    """

    last: tuple[float, int] | None = None
    pms: set[int] = field(default_factory=set)
    lines: set[int] = field(default_factory=set)

    def add(self, event: Event) -> None:
        """One more event."""
        self.last = (event.t, event.line)
        if isinstance(event, AimEvent | PairEvent | PointEvent):
            self.lines.add(event.line)
        if isinstance(event, PairEvent):
            self.pms.add(event.pm)

    def missing(self, event: HandChoice) -> Problem | None:
        """The problem of a choice of shots that are not there; None where they are."""
        if event.pm is not None and event.pm not in self.pms:
            return Problem(("pm",), str(event.pm), f"the PM of an earlier pair: {numbers_text(self.pms)}")
        if event.shot_line is not None and event.shot_line not in self.lines:
            return Problem(("line",), str(event.shot_line), "the line of an earlier aim, pair or point")
        return None


class _RefusedJsonError(ValueError):
    """Well-formed JSON that is not allowed here: a duplicate key, NaN or infinity."""


class CutShortError(ValueError):
    """A last line without line break that is the beginning of an event's line."""


def read_events(path: Path, file: str, folder: Path, setup: Setup | None, problems: list[InputError]) -> EventLog:
    """Read the events; appends all problems to ``problems``.

    Args:
        path: the file.
        file: how messages name it.
        folder: the session's folder, resolved.
        setup: of the session; None where it could not be read: then events are not checked against it.
    """
    log = EventLog()
    try:
        stream = open_file(path, file)
    except InputError as error:
        problems.append(error)
        return log
    seen = ShotsSeen()
    pairs = 0
    with stream:
        for number, line in lines_of(stream, file, problems):
            try:
                read = read_line(line, number, file, folder, setup, seen)
            except CutShortError:
                log.cut_short = f"{file}: line {number}: cut short, dropped ({len(line)} bytes)"
                continue
            problems += read.problems
            if read.t is not None:
                seen.last = (read.t, number)
            if read.event is not None:
                seen.add(read.event)
                log.events.append(read.event)
                pairs += isinstance(read.event, PairEvent)
            if pairs > PAIRS:
                problems.append(InputError(file, f"more than {PAIRS} pairs", "fewer: several sessions"))
                break
    return log


@dataclass(frozen=True, slots=True)
class LineRead:
    """One line: its event, its time where it has one, and its problems (then there is no event)."""

    event: Event | None
    t: float | None
    problems: tuple[InputError, ...]


def read_line(line: bytes, number: int, file: str, folder: Path, setup: Setup | None, seen: ShotsSeen) -> LineRead:
    """Read one line.

    Args:
        line: with its line break.
        number: of the line, from 1.
        file, folder, setup: as of :func:`read_events`.
        seen: what the lines before hold; this one is not added.
    """
    event: Event | None = None
    t: float | None = None
    problems: list[Problem] = []
    try:
        document = parse_line(line)
        t, problems = time_of(document, seen.last)
        event = EVENTS.read(document, folder, line=number)
        problems += _misfits(event, setup, seen)
    except FieldError as error:
        problems += error.problems
    errors = tuple(input_error(problem, file, line=number) for problem in dict.fromkeys(problems))
    return LineRead(None if errors else event, t, errors)


def time_of(document: Mapping[str, object], last: tuple[float, int] | None) -> tuple[float | None, list[Problem]]:
    """The time of an event, None where it has none, and its problems."""
    if "t" not in document:
        return None, []  # reported with the other missing keys
    try:
        t = SECONDS.read(document["t"])
    except FieldError as error:
        return None, error.below("t")
    if last is not None and t < last[0]:
        return t, [Problem(("t",), f"{t:.17g}", f"at least {last[0]:.17g}, the time on line {last[1]}")]
    return t, []


def frames_of(event: Event, file: str, folder: Path) -> Iterator[FrameUse]:
    """The frames that an event names."""
    for path, record in _records(event):
        uses = (
            (("left", record.left, FrameKind.CAMERA), ("right", record.right, FrameKind.CAMERA))
            if isinstance(record, MarkerRecord)
            else (("frame", record.frame, FrameKind.TRUS),)
        )
        for key, frame, kind in uses:
            if frame is not None:
                where = f"{file}: line {event.line}: {path_text((*path, key))}"
                yield FrameUse(frame, frame.relative_to(folder).as_posix(), kind, where)


def _records(event: Event) -> Iterator[tuple[tuple[str | int, ...], MarkerRecord | TrusRecord]]:
    """The marker and the looks of an event, with their places."""
    if isinstance(event, AimEvent | PairEvent | TrackEvent):
        yield ("marker",), event.marker
    if isinstance(event, PairEvent | TrackEvent) and event.trus is not None:
        yield ("trus",), event.trus
    if isinstance(event, TrackEvent):
        for i, look in enumerate(event.several):
            yield ("looks", i), look


def _misfits(event: Event, setup: Setup | None, seen: ShotsSeen) -> Iterator[Problem]:
    """Problems of an event with respect to its session or its place in the file."""
    if isinstance(event, RefusedEvent):
        line = event.refused_line
        if line is not None and not 0 < line < event.line:
            yield Problem(("event",), f"line {line}", "an earlier line of this file")
    if isinstance(event, HandChoice) and (missing := seen.missing(event)) is not None:
        yield missing
    if setup is None:
        return
    corner = event.corner if isinstance(event, AimEvent) else None
    for path, record in _records(event):
        if isinstance(record, MarkerRecord):
            if record.left is not None and (corner is not None or record.camera_T_marker is None):
                yield from _lacks_camera(record, path, setup)
        elif record.frame is not None and not setup.present & {"probe.channels", "probe.image"}:
            found = "a frame, but neither probe.channels nor probe.image in session.yaml"
            yield Problem((*path, "frame"), found, "one of them there, to read the frame by")
    spot = event.spot if isinstance(event, PairEvent) else None
    point = event if isinstance(event, CheckEvent | PointEvent) else spot
    if point is not None and point.left is not None and not {"camera", "camera.right"} <= setup.present:
        found = "pixels, but no camera with camera.right in session.yaml"
        yield Problem(("left",) if spot is None else ("spot", "left"), found, "them there, or camera_p_mm")
    elif point is not None and setup.camera is not None:
        yield from _outside(point, () if spot is None else ("spot",), setup.camera)
    if corner is not None:
        board = setup.board
        if "board" not in setup.present:
            yield Problem(("corner",), "it without a board in session.yaml", "board: {columns, rows, square_mm}")
        elif board is not None and not (corner[0] < board.columns and corner[1] < board.rows):
            expected = f"[column, row] of a board with {board.columns} columns and {board.rows} rows, counted from 0"
            yield Problem(("corner",), shown(list(corner)), expected)


def _outside(
    point: CheckEvent | PointEvent | SpotRecord, path: tuple[str | int, ...], rig: StereoRig
) -> Iterator[Problem]:
    """Pixels that are in no picture; (0, 0) is the middle of the first one."""
    for name, pixel, camera in (("left", point.left, rig.left), ("right", point.right, rig.right)):
        if pixel is None or camera is None:
            continue
        width, height = camera.image_size
        if not (-0.5 <= pixel[0] <= width - 0.5 and -0.5 <= pixel[1] <= height - 0.5):
            found = f"({pixel[0]:g}, {pixel[1]:g})"
            yield Problem((*path, name), found, f"a pixel of a picture of {width} x {height} px")


def _lacks_camera(marker: MarkerRecord, path: tuple[str | int, ...], setup: Setup) -> Iterator[Problem]:
    if "camera" not in setup.present:
        found = "a frame, but no camera in session.yaml"
        yield Problem((*path, "left"), found, "camera there, or camera_T_marker here")
    elif marker.right is not None and "camera.right" not in setup.present:
        yield Problem((*path, "right"), "a frame, but no camera.right in session.yaml", "camera.right there")
    if marker.camera_T_marker is None and "marker" not in setup.present:
        found = "a frame, but no marker in session.yaml"
        yield Problem((*path, "left"), found, "marker there, or camera_T_marker here")


def lines_of(stream: IO[bytes], file: str, problems: list[InputError]) -> Iterator[tuple[int, bytes]]:
    """Lines with their numbers, from 1; appends a problem of the file as a whole to ``problems``."""
    number = 0
    while True:
        try:
            line = stream.readline(LINE_BYTES + 1)
        except OSError as error:
            problems.append(InputError(file, f"no access ({error.strerror})", "a file that can be read"))
            return
        if not line:
            return
        number += 1
        if number > EVENT_LINES:
            problems.append(InputError(file, f"more than {EVENT_LINES} lines", "fewer: several sessions"))
            return
        if len(problems) >= PROBLEMS:
            problems.append(InputError(file, f"more than {PROBLEMS} problems", "fewer"))
            return
        if number == 1:
            line = line.removeprefix(b"\xef\xbb\xbf")
        if len(line) > LINE_BYTES:
            # The rest cannot be split into lines.
            where = f"{file}: line {number}"
            problems.append(InputError(where, "a longer line", f"at most {LINE_BYTES} bytes"))
            return
        yield number, line


def parse_line(line: bytes) -> Mapping[str, object]:
    """The object on a line. Raises FieldError where it is invalid, CutShortError where a last line is truncated."""
    if len(line) > LINE_BYTES:
        raise FieldError.of(f"{len(line)} bytes", f"at most {LINE_BYTES}")
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
        if not line.endswith(b"\n") and is_cut_short(line):
            raise CutShortError from None
        if other := _other_content(line):
            found, expected = other, "UTF-8 text, one JSON object on each line"
        elif isinstance(error, UnicodeDecodeError):
            found, expected = "bytes that are not UTF-8", "UTF-8 text"
        elif not line.strip():
            found = "an empty line"
        else:
            found = f"bad JSON ({error.msg}, column {error.colno})"
    else:
        if isinstance(value, dict):
            return value
        found = shown(value)
    raise FieldError.of(found, expected)


def is_cut_short(tail: bytes) -> bool:
    """Whether the bytes after the last line break are the beginning of an event's line, which power loss may leave: an
    object that is opened and not closed. Zeros at the end are blocks that were never written."""
    written = tail.rstrip(b"\0")
    try:
        text = written.decode("utf-8")
    except UnicodeDecodeError as error:
        if error.reason != "unexpected end of data":
            return False
        text = written[: error.start].decode("utf-8")
    text = text.lstrip(" \t")
    open_until: list[str] = []
    at = 0
    while at < len(text):
        piece = _PIECE.match(text, at)
        if piece is None or (at == 0 and piece[0] != "{"):
            return False
        if piece[0] in _CLOSES:
            open_until.append(_CLOSES[piece[0]])
        elif piece[0] in _CLOSES.values() and (piece[0] != open_until.pop() or not open_until):
            return False
        at = piece.end()
    return True


def _other_content(line: bytes) -> str:
    """What a file is that is no text of lines; empty where that is not known."""
    if line.startswith(b"\x1f\x8b"):
        return "gzip data"
    if line.startswith((b"\xff\xfe", b"\xfe\xff")) or b"\0" in line:
        return "UTF-16 text or binary data"
    return "line breaks by CR alone" if b"\r" in line.rstrip(b"\r\n") else ""


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
    # Python refuses to convert thousands of digits; no field needs more precision than a double.
    return int(digits) if len(digits) <= DIGITS else float(digits)
