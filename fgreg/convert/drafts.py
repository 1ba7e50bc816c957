"""The intermediate form of every recording before it becomes a session: events, frames, and what was left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fgreg.geometry.transforms import FloatArray
from fgreg.model.camera_model import StereoRig

Document = dict[str, Any]


@dataclass(slots=True)
class Draft:
    """One event: the object of its line (fgreg.session.event_writer), and its origin, for messages."""

    document: Document
    where: str

    @property
    def t(self) -> float:
        """Its time, s."""
        return float(self.document["t"])


@dataclass(slots=True)
class Imported:
    """The contents of a recording.

    Attributes:
        drafts: events in time order.
        write_frames: writes all frames that the events name to a folder.
        left_out: sentences about data that did not become an event, with the reason.
        rig: the endoscope's calibration, where the recording has it.
        source: description of the recording.
    """

    drafts: list[Draft]
    write_frames: Callable[[Path], None]
    source: str
    left_out: list[str] = field(default_factory=list)
    rig: StereoRig | None = None


def rows(matrix: FloatArray) -> list[list[float]]:
    """A matrix as nested lists for a document."""
    return [[float(value) for value in row] for row in matrix]
