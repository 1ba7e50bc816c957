"""The newest pictures of a recording, in a temporary file of bounded size: older ones make room for them."""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Self


class PictureRing:
    """Entries of any size, of which the newest are kept. Use as a context manager; the file has no name.

    Args:
        most_bytes: of the file.
        folder: in which it is.

    Attributes:
        dropped: number of entries that made room for others.
    """

    def __init__(self, most_bytes: int, folder: Path) -> None:
        self._most, self._file = most_bytes, tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115
        self._entries: deque[tuple[int, int]] = deque()  # offset and size, the oldest first
        self._at = 0
        self.dropped = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def add(self, entry: bytes) -> None:
        """Keep an entry; one that is larger than the file, or that a full disk does not take, is dropped itself."""
        size = len(entry)
        if size > self._most:
            self.dropped += 1
            return
        if self._at + size > self._most:
            while self._entries and self._entries[0][0] >= self._at:  # of the lap before, behind the last one written
                self._entries.popleft()
                self.dropped += 1
            self._at = 0
        end = self._at + size
        while self._entries and self._at < sum(self._entries[0]) and self._entries[0][0] < end:
            self._entries.popleft()
            self.dropped += 1
        try:
            self._file.seek(self._at)
            whole = self._file.write(entry) == size
        except OSError:
            whole = False
        if not whole:
            self.dropped += 1
            return
        self._entries.append((self._at, size))
        self._at = end

    def __iter__(self) -> Iterator[bytes]:
        """The entries that are kept, the oldest first."""
        for offset, size in self._entries:
            self._file.seek(offset)
            yield self._file.read(size)
