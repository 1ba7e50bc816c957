"""The checkpoint beside ``events.jsonl``: a file of plain numbers that spares a program to take in all events again.

It is nobody's record: whatever is wrong with it, it is left aside, and the session is what ``events.jsonl`` says. So
that it is never taken for more than it is, it names what it stands for: which lines, by their number, length and
SHA-256, and what of the session's set-up and of the program it was made with.

The file: a line with the format, a line with the SHA-256 of all that follows, a line of JSON (what it stands for, how
many numbers, the texts), then the integers and the floats, 8 bytes each, little-endian.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
import shutil
import stat
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from fgreg.frames import FloatArray, IntArray
from fgreg.session.append_file import sync_path

CHECKPOINT_FILE = ".fgreg-online"
FORMAT = b"fgreg-online-checkpoint/1\n"
SPARE = 8
"""Disk that has to be free, in sizes of a checkpoint: events come first."""
BYTES_A_LINE, BYTES_BESIDE = 4096, 2**22
"""A checkpoint that is larger than its lines explain is not looked at."""


class NoCheckpointError(Exception):
    """There is none that can be used; the text says why."""


@dataclass(frozen=True, slots=True)
class StandsFor:
    """What a checkpoint is of.

    Attributes:
        lines, length, events_sha256: of the beginning of ``events.jsonl``.
        setup_sha256: of ``session.yaml``.
        made_by: the program, its settings, and all else that has to be the same.
    """

    lines: int
    length: int
    events_sha256: str
    setup_sha256: str
    made_by: str


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """A checkpoint as it is in the file."""

    of: StandsFor
    integers: IntArray
    floats: FloatArray
    texts: tuple[str, ...]


def stands_for(events: Path, setup: Path, lines: int, made_by: str) -> StandsFor:
    """What a checkpoint after so many lines stands for.

    Raises:
        NoCheckpointError: the file has no such lines.
        OSError: the files cannot be read.
    """
    digest, length = hashlib.sha256(), 0
    with events.open("rb") as file:
        for _ in range(lines):
            line = file.readline()
            if not line.endswith(b"\n"):
                raise NoCheckpointError(f"events.jsonl has no {lines} whole lines")
            digest.update(line)
            length += len(line)
    return StandsFor(lines, length, digest.hexdigest(), hashlib.sha256(setup.read_bytes()).hexdigest(), made_by)


def write_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Put a checkpoint in the place of the one that is there: after a crash there is the one or the other.

    Raises:
        OSError: the disk refuses, or has little room left.
    """
    numbers = len(checkpoint.integers), len(checkpoint.floats)
    head = json.dumps({"of": asdict(checkpoint.of), "numbers": numbers, "texts": checkpoint.texts}).encode()
    parts = [head + b"\n", checkpoint.integers.astype("<i8").tobytes(), checkpoint.floats.astype("<f8").tobytes()]
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    data = b"".join([FORMAT, digest.hexdigest().encode() + b"\n", *parts])
    if shutil.disk_usage(path.parent).free < SPARE * len(data):
        raise OSError(0, "little room is left on the disk")
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(8)}.tmp")
    try:
        with temporary.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    sync_path(path.parent)


def read_checkpoint(path: Path, lines: int) -> Checkpoint:
    """The checkpoint in a file, whole as it was written.

    Args:
        path: of the file.
        lines: of ``events.jsonl``.

    Raises:
        NoCheckpointError: there is none, or it is damaged.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW)
        with os.fdopen(handle, "rb") as file:
            there = os.fstat(handle)
            if not stat.S_ISREG(there.st_mode) or there.st_size > BYTES_A_LINE * lines + BYTES_BESIDE:
                raise NoCheckpointError("it is no file of a checkpoint's size")
            data = file.read(there.st_size)
    except FileNotFoundError:
        raise NoCheckpointError("there is none") from None
    except OSError as error:
        raise NoCheckpointError(f"it cannot be read ({error.strerror})") from None
    if not data.startswith(FORMAT):
        raise NoCheckpointError("it is of another format")
    start = len(FORMAT) + 65
    if data[len(FORMAT) : start] != hashlib.sha256(data[start:]).hexdigest().encode() + b"\n":
        raise NoCheckpointError("it is damaged")
    end = data.find(b"\n", start) + 1
    try:
        head = json.loads(data[start:end])
        integers, floats = (int(count) for count in head["numbers"])
        if not (integers >= 0 and floats >= 0 and len(data) == end + 8 * (integers + floats)):
            raise ValueError("its size is not what it says")
        texts = tuple(str(text) for text in head["texts"])
        of = StandsFor(**head["of"])
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise NoCheckpointError(f"its head is not as it should be ({error})") from None
    return Checkpoint(
        of,
        np.frombuffer(data, "<i8", integers, end).astype(np.int64),
        np.frombuffer(data, "<f8", floats, end + 8 * integers).astype(np.float64),
        texts,
    )


def sweep_up(path: Path) -> None:
    """Remove what a checkpoint that was cut short left behind."""
    with contextlib.suppress(OSError):
        for part in path.parent.glob(f"{path.name}.*.tmp"):
            part.unlink(missing_ok=True)
