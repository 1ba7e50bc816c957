"""Events as the objects that lines of ``events.jsonl`` hold: what fgreg.session.event_log reads back.

Numbers keep all their digits: the shortest text that reads back as the same double. Numbers that are not finite are
refused; JSON has none.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fgreg.errors import InputError
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

Document = dict[str, Any]

_TYPES: dict[type[Event], str] = {
    AimEvent: "aim",
    PairEvent: "pair",
    TrackEvent: "track",
    CameraMovedEvent: "camera_moved",
    RefusedEvent: "refused",
    StageEvent: "stage",
    NoteEvent: "note",
}


def type_of(event: Event) -> str:
    """The event's ``type``, as the file has it."""
    return _TYPES[type(event)]


def event_document(event: Event, folder: Path) -> Document:
    """An event as the mapping that its line holds; what is absent or has its default is left out.

    Args:
        event: ``line`` is not part of the document.
        folder: the session's folder, resolved; frames are named relative to it.

    Raises:
        InputError: a frame outside the folder.
    """
    document: Document = {"type": type_of(event), "t": _number(event.t)}
    match event:
        case AimEvent():
            document["marker"] = _marker(event.marker, folder)
            _put(document, "camera_p_spot_mm", event.camera_p_spot_mm)
            _put(document, "covariance", event.covariance)
            if event.corner is not None:
                document["corner"] = [int(entry) for entry in event.corner]
        case PairEvent():
            document["pm"] = int(event.pm)
            document["marker"] = _marker(event.marker, folder)
            document["trus"] = _trus(event.trus, folder)
        case TrackEvent():
            document["marker"] = _marker(event.marker, folder)
            looks = [_trus(look, folder) for look in event.looks]
            if len(looks) == 1:
                document["trus"] = looks[0]
            elif looks:
                document["looks"] = looks
            if event.scan_deg is not None:
                document["scan_deg"] = _number(event.scan_deg)
        case CameraMovedEvent():
            _put(document, "camera_new_T_camera_old", event.camera_new_T_camera_old)
            _put(document, "covariance", event.covariance)
            if event.detected:
                document["detected"] = True
            if event.since_t is not None:
                document["since_t"] = _number(event.since_t)
        case RefusedEvent():
            document |= {"event": event.event, "reason": event.reason}
        case StageEvent():
            document["command"] = event.command
            if event.scan_deg is not None:
                document["scan_deg"] = _number(event.scan_deg)
            if event.reason:
                document["reason"] = event.reason
        case NoteEvent():
            document["text"] = event.text
    return document


def event_line(document: Document, place: str) -> bytes:
    """A document as one line, with its line break.

    Raises:
        InputError: a number that is not finite, or something that JSON does not have; ``place`` names it in messages.
    """
    wrong = _not_finite(document)
    if wrong is not None:
        raise InputError(f"{place}: {wrong[0]}", wrong[1], "a finite number")
    try:
        text = json.dumps(document, allow_nan=False, separators=(", ", ": "))
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(place, f"something that JSON does not have ({error})", "numbers, texts, lists") from error
    return text.encode("ascii") + b"\n"


def writable(value: object) -> object:
    """A value with all that JSON does not have as texts: for the record of an event that was refused for it."""
    if isinstance(value, Mapping):
        return {str(key): writable(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [writable(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value if value is None or isinstance(value, str | int | float | bool) else str(value)


def _not_finite(value: object, path: str = "") -> tuple[str, str] | None:
    """Place and text of the first number that is not finite, or None."""
    if isinstance(value, float):
        return None if math.isfinite(value) else (path, str(value))
    entries: list[tuple[str, object]] = []
    if isinstance(value, Mapping):
        entries = [(f"{path}.{key}" if path else str(key), entry) for key, entry in value.items()]
    elif isinstance(value, list | tuple):
        entries = [(f"{path}[{i}]", entry) for i, entry in enumerate(value)]
    return next((found for at, entry in entries if (found := _not_finite(entry, at)) is not None), None)


def _number(value: float) -> float | int:
    # Whole numbers that are given as such stay so; numpy's scalars become Python's.
    return value if type(value) is int else float(value)


def _put(document: Document, key: str, array: FloatArray | None) -> None:
    if array is not None:
        document[key] = array.tolist()


def _marker(record: MarkerRecord, folder: Path) -> Document:
    document: Document = {}
    _put(document, "camera_T_marker", record.camera_T_marker)
    _put(document, "covariance", record.covariance)
    for key, path in (("left", record.left), ("right", record.right)):
        if path is not None:
            document[key] = frame_name(path, folder, f"marker.{key}")
    return document


def _trus(record: TrusRecord, folder: Path) -> Document:
    document: Document = {"scan_deg": _number(record.scan_deg)}
    for key, value in (("x_mm", record.x_mm), ("range_mm", record.range_mm)):
        if value is not None:
            document[key] = _number(value)
    if record.frame is not None:
        document["frame"] = frame_name(record.frame, folder, "trus.frame")
    _put(document, "covariance", record.covariance)
    if record.amplitude is not None:
        document["amplitude"] = _number(record.amplitude)
    if record.sweep:
        document["sweep"] = int(record.sweep)
    return document


def frame_name(path: Path, folder: Path, where: str) -> str:
    """A frame's name as events have it: relative to the session's folder, with forward slashes.

    Raises:
        InputError: the path is not inside the folder.
    """
    try:
        return path.relative_to(folder).as_posix() if path.is_absolute() else path.as_posix()
    except ValueError:
        raise InputError(where, str(path), f"a file inside the session's folder, {folder}") from None
