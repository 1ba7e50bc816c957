"""How a Rerun recording of this program is told from other files, without loading Rerun."""

import hashlib
import json
import re
import uuid
from collections.abc import Mapping
from pathlib import Path

from fgreg.output.atomic_file import FileKind

RECORDING = FileKind("a recording", (b"RRF",), (b"fgreg",))
"""Rerun's file, with the name of this program in it."""

_HEAD_BYTES = 100_000
_END = re.compile(rb"RRF.FOOT.{4}", re.DOTALL)


def is_complete(path: Path) -> bool:
    """Whether a recording has the mark that Rerun writes at its end."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 12))
        return _END.fullmatch(file.read()) is not None


def recording_id(made_from: Mapping[str, str]) -> str:
    """An id of its own for a recording that names what it was made from: hashes of the session's files."""
    return f"{_mark(made_from)}-{uuid.uuid4().hex}"


def is_made_from(path: Path, made_from: Mapping[str, str]) -> bool:
    """Whether a recording is of a session whose files have these hashes."""
    with path.open("rb") as file:
        return _mark(made_from).encode() in file.read(_HEAD_BYTES)


def _mark(made_from: Mapping[str, str]) -> str:
    return hashlib.sha256(json.dumps(dict(made_from), sort_keys=True).encode()).hexdigest()[:32]
