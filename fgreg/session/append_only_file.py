"""An append-only file of lines; each line is on disk before :meth:`AppendFile.append` returns.

Every line is written with one ``write(2)``. After a failure the file is truncated to its last whole line at once or, if
that fails too, before the next line is written.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import stat
from pathlib import Path
from typing import Self

from fgreg.errors import JournalError
from fgreg.output.atomic_file import lock

_MODE = 0o644

# Module-level names for the system calls, so that tests can make them fail like a disk.
_write = os.write
_truncate = os.ftruncate


def _sync(handle: int) -> None:
    full = getattr(fcntl, "F_FULLFSYNC", None)  # macOS: its fsync leaves data in the drive's cache
    if full is None:
        os.fsync(handle)
    else:
        fcntl.fcntl(handle, full)


def sync_path(path: Path) -> None:
    """Flush an existing file or folder to disk.

    Raises:
        OSError: it cannot be flushed.
    """
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        _sync(handle)
    finally:
        os.close(handle)


class AppendFile:
    """An open file with an exclusive advisory lock.

    Args:
        path: of the file.
        name: its name in messages.
        handle: open for reading and appending, locked.
        size: of the file's whole lines.
    """

    def __init__(self, path: Path, name: str, handle: int, size: int) -> None:
        self._path, self._name, self._handle, self._size = path, name, handle, size
        self._damaged = False

    @classmethod
    def open(cls, path: Path, name: str) -> Self:
        """Open and lock; an absent file is created, and its folder flushed to disk.

        Raises:
            JournalError: locked by another process, no regular file, or the system refuses.
        """
        for _ in range(10):
            made = not os.path.lexists(path)
            try:
                handle = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK, _MODE)
            except OSError as error:
                raise JournalError(name, f"it cannot be opened ({error.strerror})", "make it writable") from None
            try:
                there = os.fstat(handle)
                if not stat.S_ISREG(there.st_mode):
                    raise JournalError(name, "it is no regular file", "put a file in its place")
                try:
                    alone = lock(handle)
                except OSError as error:
                    raise JournalError(name, f"it cannot be locked ({error.strerror})", "use a local disk") from None
                if not alone:
                    found = "another program is recording to this session"
                    raise JournalError(name, found, "end that program first")
                if not _same_file(handle, path):  # replaced between opening and locking
                    os.close(handle)
                    continue
                if made:
                    _sync(handle)
                    sync_path(path.parent)
                return cls(path, name, handle, os.fstat(handle).st_size)
            except OSError as error:
                os.close(handle)
                raise JournalError(name, f"it cannot be created ({error.strerror})", "make room for it") from None
            except BaseException:
                os.close(handle)
                raise
        raise JournalError(name, "it is replaced again and again", "end the program that does so")

    @property
    def size(self) -> int:
        """Bytes of all whole lines."""
        return self._size

    def tail(self) -> bytes:
        """The bytes after the last line break: empty, or a truncated line."""
        end, tail = self._size, b""
        while end > 0:
            start = max(0, end - 65536)
            piece = os.pread(self._handle, end - start, start)
            at = piece.rfind(b"\n")
            tail = piece[at + 1 :] + tail
            if at >= 0:
                break
            end = start
        return tail

    def cut(self, size: int) -> None:
        """Drop all beyond ``size`` bytes.

        Raises:
            JournalError: the system refuses.
        """
        try:
            _truncate(self._handle, size)
            _sync(self._handle)
        except OSError as error:
            found = f"its last line is cut short and cannot be dropped ({error.strerror})"
            raise JournalError(self._name, found, "mend that and open it again") from None
        self._size = size

    def append(self, line: bytes, *, durable: bool = True) -> int:
        """Write one line; it is on disk when this returns or, if not ``durable``, with the next durable one.

        A line that is not durable survives a crash of the program, but not of the machine.

        Returns:
            The offset at which the line starts.

        Raises:
            JournalError: it is not written, and the file is unchanged.
        """
        if self._handle < 0:
            raise JournalError(self._name, "it is closed", "open the session again")
        self._check()
        start = self._size
        try:
            done = _write(self._handle, line)
            if done != len(line):
                raise OSError(0, f"only {done} of {len(line)} bytes were written")
            if durable:
                _sync(self._handle)
        except OSError as error:
            self._restore()
            found = f"an event could not be recorded ({error.strerror})"
            raise JournalError(self._name, found, "mend that and add the event again") from None
        except BaseException:  # an interrupt between write and sync: the line is not acknowledged
            self._restore()
            raise
        self._size = start + len(line)
        return start

    def _check(self) -> None:
        """Check that the file is the opened one and has only what was written through this object."""
        again = "add no more events; open the session again"
        if not _same_file(self._handle, self._path):
            raise JournalError(self._name, "it was removed or replaced while it was open", again)
        try:
            size = os.fstat(self._handle).st_size
            if self._damaged and size >= self._size:
                _truncate(self._handle, self._size)
                _sync(self._handle)
                self._damaged, size = False, self._size
        except OSError as error:
            found = f"what is left of a failed write cannot be dropped ({error.strerror})"
            raise JournalError(self._name, found, "mend that and add the event again") from None
        if size != self._size:
            found = f"it was changed while it was open ({size} bytes instead of {self._size})"
            raise JournalError(self._name, found, again)

    def _restore(self) -> None:
        self._damaged = True
        with contextlib.suppress(OSError):
            _truncate(self._handle, self._size)
            _sync(self._handle)
            self._damaged = False

    def close(self) -> None:
        """Unlock and close; may be called twice."""
        handle, self._handle = self._handle, -1
        if handle >= 0:
            os.close(handle)


def _same_file(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except OSError:
        return False
