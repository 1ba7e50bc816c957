"""Writes events as lines of ``events.jsonl``, the inverse of fgreg.session.event_reader.

Numbers are written as the shortest text that reads back as the same double. Numbers that are not finite are refused,
since JSON has none.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fgreg.errors import InputError
from fgreg.model.events import EVENTS, Event
from fgreg.schema.problems import FieldError, path_text

Document = dict[str, Any]


def type_of(event: Event) -> str:
    """The event's ``type`` in the file."""
    return EVENTS.names[type(event)]


def event_document(event: Event, folder: Path) -> Document:
    """An event as the mapping of its line; absent values and defaults are left out.

    Args:
        event: ``line`` is not part of the document.
        folder: the session's folder, resolved; frames are named relative to it.

    Raises:
        InputError: a frame outside the folder.
    """
    try:
        return EVENTS.write(event, folder)
    except FieldError as error:
        problem = error.problems[0]
        raise InputError(path_text(problem.path), problem.found, problem.expected) from None


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
    """A value with everything that JSON lacks converted to text, to record a refused event."""
    if isinstance(value, Mapping):
        return {str(key): writable(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [writable(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value if value is None or isinstance(value, str | int | float | bool) else str(value)


def _not_finite(value: object, path: str = "") -> tuple[str, str] | None:
    """Path and text of the first number that is not finite, or None."""
    if isinstance(value, float):
        return None if math.isfinite(value) else (path, str(value))
    entries: list[tuple[str, object]] = []
    if isinstance(value, Mapping):
        entries = [(f"{path}.{key}" if path else str(key), entry) for key, entry in value.items()]
    elif isinstance(value, list | tuple):
        entries = [(f"{path}[{i}]", entry) for i, entry in enumerate(value)]
    return next((found for at, entry in entries if (found := _not_finite(entry, at)) is not None), None)
