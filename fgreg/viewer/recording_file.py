"""How a Rerun recording of this program is told from other files, without loading Rerun."""

import re
from pathlib import Path

from fgreg.output.atomic_file import FileKind

RECORDING = FileKind("a recording", (b"RRF",), (b"fgreg",))
"""Rerun's file, with the name of this program in it."""

_END = re.compile(rb"RRF.FOOT.{4}", re.DOTALL)


def is_complete(path: Path) -> bool:
    """Whether a recording has the mark that Rerun writes at its end."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 12))
        return _END.fullmatch(file.read()) is not None
