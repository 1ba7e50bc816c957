"""What a driver can be told in a configuration: its keys, with type, unit, default, bounds and a line of help."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

from fgreg.errors import InputError, one_line
from fgreg.session.schema import ANY, Bounds, Fields, shown

REQUIRED: Final = object()
"""The default of a key that has none."""

_VIDEO_DEVICE = re.compile(r"/dev/video[0-9]+")
_STREAM = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]*://.+")
_SOURCE = "a video device (0, /dev/video0), a stream (rtsp://...), a video file, or a folder of pictures"


class Kind(StrEnum):
    """Of a value."""

    NUMBER = "number"
    INTEGER = "integer"
    TRUTH = "true or false"
    TEXT = "text"
    CHOICE = "choice"
    FILE = "path"
    VIDEO = "video"
    TRANSFORM = "4 x 4 matrix"


@dataclass(frozen=True, slots=True)
class Key:
    """One key.

    Attributes:
        name: as written; carries the unit where there is one.
        kind: of its value.
        help: one line.
        default: as written; None where absence has a meaning of its own, ``REQUIRED`` where it has to be there.
        bounds: of numbers; of integers, too.
        choices: of a choice.
        example: what an example shows where there is no default.
        check: raises InputError for a text that cannot be one.
        nullable: ``null`` may be written; it may, too, where it is the default.
    """

    name: str
    kind: Kind
    help: str
    default: Any = REQUIRED
    bounds: Bounds = ANY
    choices: tuple[str, ...] = ()
    example: str = ""
    check: Callable[[str], object] | None = None
    nullable: bool = False

    def read(self, fields: Fields, folder: Path) -> Any:
        """Its value; what is wrong is reported to ``fields``. Paths are relative to ``folder``."""
        if not fields.has(self.name) and self.default is not REQUIRED:
            return self.default
        if (self.nullable or self.default is None) and fields.has(self.name) and fields.raw(self.name) is None:
            return None
        value = self._value(fields, folder)
        if self.check is not None and isinstance(value, str) and value:
            try:
                self.check(value)
            except InputError as error:
                fields.fail(self.name, error.found, error.expected)
        return value

    def _value(self, fields: Fields, folder: Path) -> Any:
        match self.kind:
            case Kind.NUMBER:
                return fields.number(self.name, self.bounds)
            case Kind.INTEGER:
                return fields.integer(self.name, round(self.bounds.low), round(self.bounds.high))
            case Kind.TRUTH:
                return fields.boolean(self.name)
            case Kind.TEXT:
                return fields.text(self.name, self.help)
            case Kind.CHOICE:
                return fields.text(self.name, "one of " + ", ".join(self.choices), allowed=self.choices)
            case Kind.FILE:
                return read_path(fields, self.name, folder)
            case Kind.VIDEO:
                return _video(fields, self.name, folder)
            case Kind.TRANSFORM:
                return fields.transform(self.name)

    def line(self) -> str:
        """As in an example: ``name: value  # help; default``."""
        if self.default is REQUIRED or (self.default is None and self.example):
            value = self.example
        else:
            value = written(self.default)
        notes = [self.help]
        if self.choices:
            notes.append(", ".join(self.choices))
        if self.kind is Kind.NUMBER and self.bounds != ANY:
            notes.append(str(self.bounds))
        if self.default is None and self.example:
            notes.append("may be absent")
        return f"{self.name}: {value}  # {'; '.join(notes)}"


def written(value: object) -> str:
    """A default as YAML has it."""
    if value is None:
        return "null"
    return str(value).lower() if isinstance(value, bool) else str(value)


def read_path(fields: Fields, key: str, folder: Path) -> Path:
    """An existing file or folder that a key names, relative to ``folder``; what is wrong is reported."""
    text = fields.text(key, "a path")
    path = folder / text
    if text and not _there(path):
        fields.fail(key, f"nothing at {one_line(str(path), 200)}", "a path, relative to this file's folder")
    return path


def _video(fields: Fields, key: str, folder: Path) -> str:
    value = fields.raw(key)
    if type(value) is int and 0 <= value <= 999:
        return str(value)
    text = fields.text(key, _SOURCE)
    if not text or text.isdecimal() or _VIDEO_DEVICE.fullmatch(text) or _STREAM.fullmatch(text):
        return text
    path = folder / text
    if not (_there(path) or ("*" in path.name and _matches(path))):
        fields.fail(key, shown(value), f"{_SOURCE}; paths are relative to this file's folder")
    return str(path)


def _there(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # a name that no file system takes
        return False


def _matches(path: Path) -> bool:
    try:
        return any(path.parent.glob(path.name))
    except (OSError, ValueError, NotImplementedError):
        return False


def read_keys(keys: tuple[Key, ...], fields: Fields, folder: Path) -> Mapping[str, Any]:
    """All of them, as the factory's keyword arguments; what is wrong is reported to ``fields``."""
    return {key.name: key.read(fields, folder) for key in keys}
