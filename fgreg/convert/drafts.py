"""What every kind of recording is turned into before it becomes a session: events, frames, and what was left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fgreg.geometry.transforms import FloatArray
from fgreg.model.session_model import StereoRig

Document = dict[str, Any]


@dataclass(slots=True)
class Draft:
    """One event: the object of its line (fgreg.session.event_writer), and where it came from, for messages."""

    document: Document
    where: str

    @property
    def t(self) -> float:
        """Its time, s."""
        return float(self.document["t"])


@dataclass(slots=True)
class Imported:
    """A recording, read.

    Attributes:
        drafts: events in time order.
        write_frames: writes all frames that the events name below a folder.
        left_out: plain sentences on what did not become an event, and why.
        rig: the endoscope's calibration, where the recording has it.
        source: what it was, for the record.
    """

    drafts: list[Draft]
    write_frames: Callable[[Path], None]
    source: str
    left_out: list[str] = field(default_factory=list)
    rig: StereoRig | None = None


def rows(matrix: FloatArray) -> list[list[float]]:
    """A matrix as the lists that a document holds."""
    return [[float(value) for value in row] for row in matrix]
