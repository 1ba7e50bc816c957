"""Files that are complete or absent, and that replace nothing but an older file of their own kind.

A file is written under a temporary name beside its place, locked meanwhile, flushed to disk and renamed. What a run
leaves under such a name when it is killed is found by fgreg.output.leftovers.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from fgreg.errors import InputError

SESSION_FILES = ("session.yaml", "events.jsonl", "ground_truth.yaml", "result.yaml")
"""Names that only a session's own files have."""
PART, SWAP, OLDER = "part", "swap", "older"
"""Endings of temporary names: not complete; complete, while it changes places with an older one; that older one."""

_HEAD_BYTES = 1_000_000
_NAME_BYTES = 180


@dataclass(frozen=True, slots=True)
class FileKind:
    """What an output is, told by its content.

    Attributes:
        name: in messages, with its article: ``a result``.
        starts: first bytes; one of them.
        has: what the first megabyte holds besides, all of them.
        file_name: the name among ``SESSION_FILES`` that files of this kind have.
    """

    name: str
    starts: tuple[bytes, ...]
    has: tuple[bytes, ...] = ()
    file_name: str = ""

    def holds(self, path: Path) -> bool:
        """Whether ``path`` is a regular file of this kind; a link is not.

        Raises:
            OSError: it cannot be read.
        """
        if path.is_symlink() or not path.is_file():
            return False
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
        return head.startswith(self.starts) and all(part in head for part in self.has)


def check_output(path: Path, kind: FileKind) -> None:
    """Whether a file can be written to ``path``: to be asked before the work begins.

    Raises:
        InputError: its folder is absent or cannot be written to, it has the name of another file of a session, or it
            exists and is not an older file of its kind.
    """
    try:
        if not path.parent.is_dir():
            raise InputError(str(path.parent), "no such folder", f"a folder to write {path.name} to")
        if path.is_dir() and not path.is_symlink():
            raise InputError(str(path), "a folder", f"a file name for {kind.name}")
        if path.name in SESSION_FILES and path.name != kind.file_name:
            raise InputError(str(path), "the name of a session's own file", f"another name for {kind.name}")
        if os.path.lexists(path) and not kind.holds(path):
            found = "a link" if path.is_symlink() else f"a file that is not {kind.name}"
            raise InputError(str(path), found, "a new name, or that of an older one")
        if not os.access(path.parent, os.W_OK | os.X_OK):
            raise InputError(str(path.parent), "a folder that cannot be written to", f"one to write {path.name} to")
        path.lstat()  # whether the system takes the name
    except FileNotFoundError:
        return
    except (OSError, ValueError) as error:
        raise InputError(str(path), f"no access ({why_refused(error)})", f"a place for {kind.name}") from None


def check_outputs(outputs: Iterable[tuple[str, Path | None, FileKind]]) -> None:
    """:func:`check_output` of all files of a command, as (option, path, kind); None: it is not wanted.

    Raises:
        InputError: as :func:`check_output`, or two have the same place.
    """
    wanted = [(option, path, kind) for option, path, kind in outputs if path is not None]
    places: dict[str, str] = {}
    for option, path, _ in wanted:
        other = places.setdefault(os.path.realpath(path), option)
        if other != option:
            raise InputError(option, f"{path}, where {other} goes", "a file of its own")
    for option, path, kind in wanted:
        try:
            check_output(path, kind)
        except InputError as error:
            where = f"{option}: {error.where}" if option.startswith("--") else error.where
            raise InputError(where, error.found, error.expected) from None


class NewFile:
    """A file under construction, at ``part``, for ``path``. As a context manager it is kept at the end of the block.

    After an exception it is dropped, and an older one is unchanged.

    Raises:
        InputError: as :func:`check_output`, or the system refuses.
    """

    def __init__(self, path: Path, kind: FileKind) -> None:
        check_output(path, kind)
        self.path, self._kind = path, kind
        self.part = beside(path, PART)
        try:
            self._handle = os.open(self.part, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise _refused(path, error) from None
        with contextlib.suppress(OSError):  # a file system without locks
            lock(self._handle)

    def keep(self) -> None:
        """Flush it to disk and give it its name; an older one is replaced.

        Raises:
            InputError: the system refuses, or something else is in its place by now.
        """
        try:
            os.fsync(self._handle)
            check_output(self.path, self._kind)
            self.part.replace(self.path)
            sync_folder(self.path.parent)
        except OSError as error:
            raise _refused(self.path, error) from None
        finally:
            self.drop()

    def drop(self) -> None:
        """Remove it, unless it was kept."""
        handle, self._handle = self._handle, -1
        if handle >= 0:
            with contextlib.suppress(OSError):
                self.part.unlink(missing_ok=True)
            os.close(handle)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.keep()
        else:
            self.drop()


def write_file(path: Path, content: str | bytes, kind: FileKind) -> None:
    """Write a file; an older one of its kind is replaced.

    Raises:
        InputError: as :class:`NewFile`.
    """
    data = content.encode("utf-8") if isinstance(content, str) else content
    with NewFile(path, kind) as new:
        try:
            new.part.write_bytes(data)
        except OSError as error:
            raise _refused(path, error) from None


def beside(path: Path, ending: str) -> Path:
    """A new temporary name beside ``path``."""
    return path.with_name(f".{short_name(path)}.{secrets.token_hex(8)}.{ending}")


def short_name(path: Path) -> str:
    """The name of ``path``, short enough for what a temporary name adds to it."""
    return os.fsencode(path.name)[:_NAME_BYTES].decode("utf-8", errors="ignore")


def lock(handle: int) -> bool:
    """Lock an open file or folder for this process; whether nobody else has it.

    Raises:
        OSError: the file system has no locks.
    """
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def sync_folder(folder: Path) -> None:
    """Flush a rename to disk; file systems that do not support it are ignored."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def why_refused(error: OSError | ValueError) -> str:
    """An error of the file system, in its own words."""
    return getattr(error, "strerror", None) or str(error)


def _refused(path: Path, error: OSError) -> InputError:
    return InputError(str(path), f"a file that cannot be written ({why_refused(error)})", "a writable place")
