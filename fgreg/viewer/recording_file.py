"""How a Rerun recording of this program is told from other files, without loading Rerun."""

from fgreg.output.atomic_file import FileKind

RECORDING = FileKind("a recording", (b"RRF",), (b"fgreg",))
"""Rerun's file, with the name of this program in it."""
