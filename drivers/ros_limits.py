"""Bounds on what ROS 2 recordings unpack to and compute, which ``rosbags`` does not have."""

from __future__ import annotations

import importlib
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

from fgreg.errors import InputError
from fgreg.schema.limits import CHUNK_BYTES

_COMPUTED = """SELECT 1 FROM sqlite_master WHERE type NOT IN ('table', 'index')
UNION ALL SELECT 1 FROM sqlite_master JOIN pragma_table_xinfo(sqlite_master.name) AS columns WHERE columns.hidden > 0"""


def bound_chunks() -> None:
    """Let ``rosbags`` unpack a chunk of an MCAP file to the size that the chunk states, and to CHUNK_BYTES at most."""
    storage: Any = importlib.import_module("rosbags.rosbag2.storage_mcap")
    lz4: Any = importlib.import_module("lz4.frame")
    storage.DECOMPRESSORS.update(
        lz4=lambda data, size: _unpacked(lz4.LZ4FrameDecompressor(), data, size),
        zstd=lambda data, size: _unpacked(storage.zstd.ZstdDecompressor(), data, size),
    )


def _unpacked(decompressor: Any, data: bytes, size: int) -> bytes:
    """At most one byte more than ``size``, by which the caller sees that it is wrong. Raises ValueError."""
    if size > CHUNK_BYTES:
        raise ValueError(f"a chunk of {size} bytes, at most {CHUNK_BYTES} are read")
    return bytes(decompressor.decompress(data, max_length=size + 1))


def check_tables(path: Path) -> None:
    """Check that the tables of an SQLite recording hold what they give: a view or a generated column computes it.

    Raises:
        InputError: they are not.
    """
    for file in path.glob("*.db3") if path.is_dir() else [path] if path.suffix.lower() == ".db3" else []:
        try:
            with closing(sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as base:
                computed = base.execute(_COMPUTED).fetchmany(1)
        except (sqlite3.Error, ValueError):  # ValueError: names that are no text
            continue  # the reader of recordings says what is wrong
        if computed:
            raise InputError(str(file), "tables that are computed", "a recording with plain tables")
