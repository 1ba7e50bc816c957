"""The Rerun recording and its viewer, packed into the report: opened without a network.

The viewer is the web assembly of the package ``rerun-notebook`` (the extra ``report3d``), whose script has a marked
place for an assembly that is at hand. Both are compressed here and unpacked by the browser (DecompressionStream).
"""

from __future__ import annotations

import base64
import gzip
import importlib.util
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fgreg.errors import InputError, MissingExtraError
from fgreg.viewer.recording_file import RECORDING, is_complete, is_made_from

_PLACE = re.compile(r"(//!<INLINE-MARKER-OPEN>).*?(//!<INLINE-MARKER-CLOSE>)", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Viewer3D:
    """Script, assembly and recording: base64 of gzip."""

    script: str
    assembly: str
    recording: str


def viewer_of(rrd: Path, made_from: Mapping[str, str]) -> Viewer3D:
    """A recording with the viewer that shows it; ``made_from``: the hashes of the session's files.

    Raises:
        InputError: it is not a complete recording of fgreg, or one of another session.
        MissingExtraError: the viewer is not installed.
    """
    try:
        whole = RECORDING.holds(rrd) and is_complete(rrd)
    except OSError as error:
        raise InputError(str(rrd), f"no access ({error.strerror})", "a recording: fgreg solve --rrd FILE") from None
    if not whole:
        raise InputError(str(rrd), "no complete recording", "one that fgreg solve --rrd FILE wrote")
    if not is_made_from(rrd, made_from):
        raise InputError(str(rrd), "a recording of other files", "that of this session: fgreg solve --rrd FILE")
    spec = importlib.util.find_spec("rerun_notebook")  # not imported: it would load Jupyter's widgets
    if spec is None or spec.origin is None:
        raise MissingExtraError("rerun-notebook", "report3d")
    static = Path(spec.origin).parent / "static"
    script, places = _PLACE.subn(
        r"\1\nreturn globalThis.fgregAssembly();\n\2", (static / "widget.js").read_text("utf-8")
    )
    if places != 1:
        raise InputError(
            "rerun-notebook", "a version without a place for its assembly", "the one of fgreg's extra report3d"
        )
    return Viewer3D(
        _packed(script.encode()), _packed((static / "re_viewer_bg.wasm").read_bytes()), _packed(rrd.read_bytes())
    )


def _packed(data: bytes) -> str:
    return base64.b64encode(gzip.compress(data, 9, mtime=0)).decode("ascii")
