"""The latest snapshot in shared memory: one process writes, any number read, no one waits.

Several slots hold the last versions. The writer fills the oldest slot and then sets ``latest`` to it. A reader copies
the latest slot and uses the copy only if it is complete: the slot's version is written before and after its contents,
and there is a checksum. So a reader never blocks the writer, and a writer that dies in the middle of a version leaves
the one before. On processors that reorder stores the checksum detects what the versions alone might miss.

The memory belongs to this user only (mode 0600); its name cannot be guessed. The writer removes it when it is closed
or its process ends, and multiprocessing's resource tracker removes it when the process is killed; where both were
killed, the next writer does. Readers map it read-only and are not tracked, else the first reader to exit would remove
it for all others. A mapping stays valid after removal, so that readers still have the last estimate and its age.
"""

from __future__ import annotations

import _posixshmem
import contextlib
import copy
import mmap
import os
import secrets
import time
import weakref
from dataclasses import dataclass
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import numpy as np

from fgreg.geometry.transforms import IntArray
from fgreg.online.snapshot_record import Layout, SnapshotDecoder, encode_snapshot
from fgreg.tracking.snapshot import Snapshot

MAGIC: Final = 0x6667726567_01
SLOTS = 4
"""A reader's slot is overwritten only if the writer publishes this number of versions, less one, while it copies."""
TRIES = 100
_MAGIC, _SIZE, _DEPTHS, _CURVE, _EPOCHS, _LATEST, _ALIVE, _CLOSED, _WRITER, _HEADER = range(10)
_BEGIN, _END, _SUM, _TIME, _SLOT_HEADER = range(5)
_WORD = 8


class NoSnapshotError(Exception):
    """Nothing has been published yet."""


@dataclass(frozen=True, slots=True, eq=False)
class Received:
    """A snapshot with its version (1, 2, ...), and the seconds since it was published and since the writer's last sign.

    ``closed``: whether the writer has closed, so that there will be no more.
    """

    snapshot: Snapshot
    version: int
    age_s: float
    silent_s: float
    closed: bool


def _checksum(payload: IntArray) -> int:
    """Sum of the payload's words, modulo 2^64: a mixture of two versions almost certainly has another sum."""
    return int(np.add.reduce(payload))


def _slot_words(payload_bytes: int) -> int:
    words = _SLOT_HEADER + payload_bytes // _WORD
    return -(-words // 8) * 8  # whole cache lines


class SharedSnapshot:
    """The writer's end. Use it as a context manager, or call :meth:`close`; ``name`` is what readers need."""

    def __init__(self, layout: Layout) -> None:
        record_type = layout.dtype()
        words = _slot_words(record_type.itemsize)
        header = -(-_HEADER // 8) * 8
        remove_left_behind()
        name = f"{_prefix()}{os.getpid()}-{secrets.token_hex(6)}"
        self._memory = SharedMemory(name, create=True, size=_WORD * (header + SLOTS * words))
        self._record = np.zeros((), dtype=record_type)
        self._words: IntArray = self._record.reshape(1).view(np.int64)
        cells: IntArray = np.ndarray(header + SLOTS * words, dtype=np.int64, buffer=self._memory.buf)
        self._header: IntArray | None = cells[:header]
        self._slots: IntArray | None = cells[header:].reshape(SLOTS, words)
        self._version = 0
        # A forked child has this object too, and must not remove its parent's memory.
        self._finalizer = weakref.finalize(self, _remove, self._memory, os.getpid())
        self._header[_SIZE], self._header[_WRITER] = record_type.itemsize, os.getpid()
        self._header[_DEPTHS], self._header[_CURVE], self._header[_EPOCHS] = layout.depths, layout.curve, layout.epochs
        self._header[_ALIVE] = time.monotonic_ns()
        self._header[_MAGIC] = MAGIC

    @property
    def name(self) -> str:
        """Name of the memory, for readers."""
        return self._memory.name

    def publish(self, snapshot: Snapshot) -> int:
        """Publish a snapshot as the latest; returns its version.

        Raises:
            ValueError: it does not fit the layout, or a number is not finite (the latest stays); or this is closed.
        """
        if self._header is None or self._slots is None:
            raise ValueError("this shared snapshot is closed")
        encode_snapshot(snapshot, self._record)
        version = self._version + 1
        slot = self._slots[version % SLOTS]
        now = time.monotonic_ns()
        slot[_BEGIN] = version
        slot[_SLOT_HEADER : _SLOT_HEADER + len(self._words)] = self._words
        slot[_SUM], slot[_TIME] = _checksum(self._words), now
        slot[_END] = version
        self._header[_LATEST] = self._version = version
        self._header[_ALIVE] = now
        return version

    def touch(self) -> None:
        """Show readers that the writer runs although nothing has changed."""
        if self._header is not None:
            self._header[_ALIVE] = time.monotonic_ns()

    def close(self) -> None:
        """Mark it closed for readers, and remove the name; readers keep their mappings."""
        if self._header is not None:
            self._header[_CLOSED] = 1
            self._header = self._slots = None
            self._finalizer()

    def __enter__(self) -> SharedSnapshot:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def _prefix() -> str:
    """Beginning of the names of memory whose writers have their process number in this namespace."""
    try:
        return f"fgreg-{Path('/proc/self/ns/pid').stat().st_ino}-"
    except OSError:  # not Linux
        return "fgreg-0-"


def remove_memory(name: str) -> None:
    """Remove the memory of a writer that was killed, if it was; this program's resource tracker forgets it, too."""
    if not name:
        return
    try:
        memory = SharedMemory(name)
    except (FileNotFoundError, ValueError):  # removed; or its writer was killed before it had a size
        return
    memory.unlink()
    memory.close()


def remove_left_behind() -> None:
    """Remove the memory of writers that were killed together with the tracker of their resources (Linux)."""
    for path in Path("/dev/shm").glob(f"{_prefix()}*-*"):
        writer = path.name.split("-")[2]
        if writer.isdigit() and not Path("/proc", writer).exists():
            with contextlib.suppress(OSError):  # another user's, or removed meanwhile
                path.unlink()


def _remove(memory: SharedMemory, owner: int) -> None:
    if os.getpid() == owner:
        memory.unlink()
    try:
        memory.close()
    except BufferError:  # an array still refers to it: it is freed when the process ends
        memory._buf = memory._mmap = None  # type: ignore[attr-defined]  # or its destructor would complain


class SnapshotReader:
    """A reader's end, read-only; one per thread.

    Raises:
        FileNotFoundError: there is no such memory, or not any more.
        ValueError: it is not a shared snapshot of this version of fgreg.
    """

    def __init__(self, name: str) -> None:
        descriptor = _posixshmem.shm_open(f"/{name}", os.O_RDONLY, 0)
        try:
            self._memory = mmap.mmap(descriptor, os.fstat(descriptor).st_size, access=mmap.ACCESS_READ)
        finally:
            os.close(descriptor)
        cells: IntArray = np.frombuffer(self._memory, dtype=np.int64)
        header = -(-_HEADER // 8) * 8
        if len(cells) < header or cells[_MAGIC] != MAGIC:
            raise ValueError(f"shared memory {name} holds no snapshots of this version of fgreg")
        layout = Layout(int(cells[_DEPTHS]), int(cells[_CURVE]), int(cells[_EPOCHS]))
        self._type = layout.dtype()
        words = _slot_words(self._type.itemsize)
        if cells[_SIZE] != self._type.itemsize or len(cells) < header + SLOTS * words:
            raise ValueError(f"shared memory {name} holds no snapshots of this version of fgreg")
        self._header = cells[:header]
        self._slots = cells[header : header + SLOTS * words].reshape(SLOTS, words)
        self._payload = self._type.itemsize // _WORD
        self._forget()

    def _forget(self) -> None:
        self._decoder = SnapshotDecoder()
        self._version, self._published = 0, 0
        self._snapshot: Snapshot | None = None

    def clone(self) -> SnapshotReader:
        """Another reader of the same memory, for another thread; also after its name was removed."""
        other = copy.copy(self)
        other._forget()
        return other

    def snapshot(self) -> Snapshot:
        """The latest snapshot; the same object until there is a newer one.

        Raises:
            NoSnapshotError: nothing has been published yet.
        """
        if self._snapshot is None or int(self._header[_LATEST]) != self._version:
            self._fetch()
        if self._snapshot is None:
            raise NoSnapshotError("no estimate has been published yet")
        return self._snapshot

    def read(self) -> Received:
        """The latest snapshot with its age."""
        snapshot = self.snapshot()
        now = time.monotonic_ns()
        return Received(
            snapshot,
            self._version,
            1e-9 * (now - self._published),
            1e-9 * (now - int(self._header[_ALIVE])),
            bool(self._header[_CLOSED]),
        )

    def _fetch(self) -> None:
        for _ in range(TRIES):
            latest = int(self._header[_LATEST])
            if latest in (0, self._version):
                return
            slot = self._slots[latest % SLOTS]
            if slot[_END] != latest:
                continue
            words = slot[_SLOT_HEADER : _SLOT_HEADER + self._payload].copy()
            checksum, published = int(slot[_SUM]), int(slot[_TIME])
            if slot[_BEGIN] == latest and slot[_END] == latest and _checksum(words) == checksum:
                record: Any = words.view(self._type).reshape(())
                self._snapshot = self._decoder.decode(record)
                self._version, self._published = latest, published
                return
        # The slot was overwritten every time: the last copy is complete, but older.

    def close(self) -> None:
        """Release the memory; snapshots read before stay valid."""
        del self._header, self._slots, self._memory  # unmapped with the last reference to it
