"""Kinds of values that name files: frames inside the session's folder, and files anywhere."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path, PurePosixPath, PureWindowsPath

from fgreg.errors import one_line
from fgreg.schema.kinds import JsonSchema, Kind
from fgreg.schema.limits import NAME_BYTES
from fgreg.schema.problems import FieldError, shown

_FILE_NAME = "a relative name of a file inside the session's folder"


class FrameKind(Enum):
    """Use of a frame: camera image or TRUS frame."""

    CAMERA = "camera"
    TRUS = "trus"


@dataclass(frozen=True, slots=True)
class FileName(Kind):
    """The name of a file in the session's folder, relative to it; read as its resolved path.

    The file need not exist, but must be inside the folder: names that are absolute, have ``..`` or control characters,
    or leave it by a symbolic link are refused. The folder passed must be resolved.
    """

    def read(self, value: object, folder: Path | None = None, /) -> Path:
        if not isinstance(value, str) or not value:
            raise FieldError.of(shown(value), self.expected)
        windows = PureWindowsPath(value)
        outside = PurePosixPath(value).is_absolute() or windows.drive or windows.root or ".." in windows.parts
        if outside or not value.isprintable() or len(value) > NAME_BYTES:
            raise FieldError.of(shown(value), _FILE_NAME)
        if folder is None:
            raise AssertionError("names are relative to a folder")
        try:
            path = (folder / value).resolve()
            inside = path.is_relative_to(folder) and path != folder
        except (OSError, RuntimeError, ValueError):  # loops of links, names the file system cannot have
            inside = False
        if not inside:
            raise FieldError.of(f"{shown(value)}, which leads out of the folder", _FILE_NAME)
        return path

    def write(self, value: Path, folder: Path | None = None, /) -> str:
        """With forward slashes. Raises FieldError where the path is not inside the folder."""
        try:
            return value.relative_to(folder or "").as_posix() if value.is_absolute() else value.as_posix()
        except ValueError:
            raise FieldError.of(str(value), f"a file inside the session's folder, {folder}") from None

    @property
    def expected(self) -> str:
        return "the name of a file"

    def json_schema(self, _definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return {"type": "string", "minLength": 1, "maxLength": NAME_BYTES}


@dataclass(frozen=True, slots=True)
class FrameName(FileName):
    """The name of a raw frame."""

    use: FrameKind

    @property
    def expected(self) -> str:
        return "the name of a frame"


@dataclass(frozen=True, slots=True)
class ExistingPath(Kind):
    """An existing file or folder, relative to the document's folder."""

    takes_text = True

    def read(self, value: object, folder: Path | None = None, /) -> Path:
        if not isinstance(value, str) or not value:
            raise FieldError.of(shown(value), self.expected)
        path = (folder or Path()) / value
        if not exists(path):
            found = f"nothing at {one_line(str(path), 200)}"
            raise FieldError.of(found, "a path, relative to this file's folder")
        return path

    def write(self, value: Path, _folder: Path | None = None, /) -> str:
        return str(value)

    @property
    def expected(self) -> str:
        return "a path"

    def json_schema(self, _definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return {"type": "string", "minLength": 1}


def exists(path: Path) -> bool:
    """Whether a path exists; False for names that are invalid on the file system."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False
