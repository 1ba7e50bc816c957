"""What is read of others at most, and why: a file or message beyond a limit is refused before the work is done.

A limit is far above what real files have and far below what a machine of 8 GB lacks. Where the parser is a library's
that a file can break (end the process, loop for ever), it runs in a process of its own (:func:`confine`).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# Texts

NESTING = 32
"""Levels of a YAML text; the formats here need seven. JSON has Python's own limit, about 1,000."""
DIGITS = 30
"""Digits of a whole number; longer ones are read as doubles, which is all that any field holds."""
NAME_BYTES = 1024
"""Of a file's name with its folders; file systems have 255 for each part, and say so themselves."""

# Files of a session

SETUP_BYTES, SETUP_NODES = 4_000_000, 200_000
"""session.yaml, rig.yaml, CONFIG.yaml, mappings, calibrations: a session.yaml with 1,000 targets has 100,000 bytes."""
TRUTH_BYTES, TRUTH_NODES = 64_000_000, 2_000_000
"""ground_truth.yaml: the truth of 100,000 tracks."""
RESULT_BYTES, RESULT_NODES = 256_000_000, 8_000_000
"""result.yaml: 100,000 pairs with their covariances, in 1 GB of memory and a minute."""
LINE_BYTES = 1_000_000
"""One line of events.jsonl: a track with 1,000 looks has 150,000."""
EVENT_LINES = 200_000
"""Lines of events.jsonl: a day with two events each second, in 1 GB of memory."""
PAIRS, REPLAYED_PAIRS = 20_000, 1_000
"""Pairs of a session, and of one that is replayed. A solve of 1,000, 5,000, 20,000 takes 2, 9, 24 s and 0.2, 0.5,
1.7 GB. The online engine weighs all earlier ones at each: 1,000 take 100 s and 0.2 GB, 2,000 already 520 s, and 1,000
repeats of one shot 23 minutes."""
PROBLEMS = 1_000
"""Told of one file; who mends a file does not read more."""

# Frames

FRAME_BYTES = 64 << 20
"""A probe's frame: 256 elements of 60,000 samples in floats."""
PICTURE_PIXELS = 1 << 25
"""A picture or a frame of a video: 7680 x 4320. A PNG of 1 MB can hold a billion."""
PICTURE_BYTES = 256_000_000
"""A picture's file: 7680 x 4320 in 16 bits and three colours, not compressed."""
NPY_HEADER_BYTES = 10_000
"""numpy's own limit, which it applies after it has read a header of up to 4 GB."""

# Recordings of other programs

TABLE_BYTES, TABLE_COLUMNS = 100_000_000, 1_000
"""A CSV table: EVENT_LINES rows of 500 bytes."""
SEQUENCE_BYTES = 1 << 30
"""Pixels of a PLUS sequence, unpacked: 2,000 frames of 128 elements and 2,048 samples of 16 bits. A zlib stream can
hold a thousand times its size."""
SEQUENCE_HEADER_BYTES, SEQUENCE_FIELDS = 64_000_000, 1_000_000
"""20 fields of 64 bytes in each of 50,000 frames."""
SEQUENCE_FRAMES = 200_000
"""Numbers of frames: two hours at 25 frames in a second."""
ARRAY_BYTES, ARRAY_VARIABLES = 2 << 30, 10_000
"""An array of a MATLAB, HDF5 or UFF file, and how many of them: 1,000 frames of 256 elements and 2,048 samples in
floats."""
ARRAY_MEMORY, ARRAY_SECONDS = 3 * ARRAY_BYTES, 120.0
"""Of the process that reads such files; 2 GB take some 10 s."""
CHUNK_BYTES = 256 << 20
"""A chunk of an MCAP file, unpacked: recorders begin a new one after 1 to 16 MB, or after one picture."""
RECORDING_MEMORY = 3 << 30
"""What reading a recording may take besides what the program has: the index of a million messages, some chunks, and
the frames of a sequence twice."""

# Messages

IGTL_BODY_BYTES = 32 << 20
"""OpenIGTLink: 128 elements of 60,000 samples in floats, a volume of 256 x 256 x 256 bytes."""
BK_MESSAGE_BYTES, BK_SIDE = 16 << 20, 8192
"""BK scanners, as sent, escapes included: a colour picture of 1920 x 1080 has 6.2 million bytes."""
TYPED_LINE_BYTES = 1000
"""A line of the operator at the keyboard."""
STAGE_LINE_BYTES, STAGE_TEXT = 4096, 300
"""A message between the program and the stage's watchdog, and a text in one."""

# A process of its own

CONFINED_MEMORY = 1 << 30
"""Python, numpy and OpenCV have 0.2 GB before they have read anything."""
CONFINED_SECONDS = 5
"""For files of SETUP_BYTES: a whole one takes 0.3 s, most of it the start."""


def tell_libraries() -> None:
    """Pass limits on to libraries that read them from the environment when they are loaded, here and in children."""
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(PICTURE_PIXELS))


@contextmanager
def memory_at_most(more: int) -> Iterator[None]:
    """In the block this process gets ``more`` bytes besides what it has; then MemoryError. On Linux only."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[5])
    except (OSError, ValueError, IndexError):
        yield
        return
    import resource

    before = resource.getrlimit(resource.RLIMIT_DATA)
    _lower("RLIMIT_DATA", pages * resource.getpagesize() + more)
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def confine() -> None:
    """Keep this process within CONFINED_MEMORY and CONFINED_SECONDS of processor time."""
    _lower("RLIMIT_DATA", CONFINED_MEMORY)
    _lower("RLIMIT_CPU", CONFINED_SECONDS)
    _lower("RLIMIT_CORE", 0)


def _lower(name: str, value: int) -> None:
    """Lower a soft limit of this process, where the system has it."""
    if sys.platform == "win32":
        return
    import resource

    which = getattr(resource, name)
    soft, hard = resource.getrlimit(which)
    for known in (soft, hard):
        if known != resource.RLIM_INFINITY:
            value = min(value, known)
    resource.setrlimit(which, (value, hard))
