"""The intermediate form of every recording before it becomes a session: events, frames, what was left out, and what the
recording says of its frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.convert.probe_frames import DeclaredProbe
from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray
from fgreg.model.camera_model import StereoRig
from fgreg.model.probe_model import ProbeModel

Document = dict[str, Any]

PIXEL_SHARE = 0.005
"""Pixel pitches that differ by more than this share are not the same: 0.2 mm at a depth of 40 mm."""


@dataclass(slots=True)
class Draft:
    """One event: the object of its line (fgreg.session.event_writer), and its origin, for messages."""

    document: Document
    where: str

    @property
    def t(self) -> float:
        """Its time, s."""
        return float(self.document["t"])


class ImageKind(StrEnum):
    """What a probe's frames are."""

    ENVELOPE = "envelope"
    """Pixels (depth, lateral), linear."""
    LOG = "log"
    """Pixels (depth, lateral), log-compressed, as on a scanner's screen."""
    CHANNELS = "channels"
    """The signals of the single elements."""


@dataclass(frozen=True, slots=True)
class ImageClaim:
    """What a recording, or its mapping, says of the probe's frames.

    Attributes:
        kind: what they are.
        shapes: of the frames, with their types.
        pixel_mm: pitch along (depth, lateral), where the recording states one.
        where: the place of that in the recording, for messages.
    """

    kind: ImageKind
    shapes: frozenset[tuple[tuple[int, ...], np.dtype[Any]]]
    pixel_mm: tuple[float, float] | None
    where: str

    def check(self, probe: ProbeModel) -> None:
        """Hold it against ``session.yaml``, by which the frames will be read.

        Raises:
            InputError: the two contradict each other.
        """
        for shape, dtype in self.shapes:
            if (self.kind is ImageKind.CHANNELS) != probe.holds_channels(shape, dtype):
                found = f"{self.kind} frames, {dtype} of shape {list(shape)}"
                channels = (
                    "none" if probe.channels is None else f"float32 or int16 of shape [{probe.elements}, samples]"
                )
                raise InputError(self.where, found, f"what session.yaml says: channel data are {channels}")
        if self.kind is ImageKind.CHANNELS:
            return
        if probe.image is None:
            raise InputError(self.where, f"{self.kind} images", "probe.image in session.yaml")
        if self.kind is ImageKind.LOG and probe.image.log_db is None:
            expected = "probe.image.log_db in session.yaml: the dynamic range, dB"
            raise InputError(self.where, "log-compressed images", f"{expected}; or images: envelope in the mapping")
        if self.kind is ImageKind.ENVELOPE and probe.image.log_db is not None:
            raise InputError(
                self.where, "linear images", "log-compressed ones, as probe.image.log_db in session.yaml says"
            )
        if self.pixel_mm is not None and not np.allclose(
            self.pixel_mm, probe.image.pixel_mm, rtol=PIXEL_SHARE, atol=0.0
        ):
            found = "pixels of {:.6g} x {:.6g} mm (depth, lateral)".format(*self.pixel_mm)
            expected = "{:.6g} x {:.6g} mm, as probe.image.pixel_mm in session.yaml".format(*probe.image.pixel_mm)
            raise InputError(self.where, found, expected)


@dataclass(slots=True)
class Imported:
    """The contents of a recording.

    Attributes:
        drafts: events in time order.
        write_frames: writes all frames that the events name to a folder.
        left_out: sentences about data that did not become an event, with the reason.
        rig: the endoscope's calibration, where the recording has it.
        source: description of the recording.
        told: sentences about what was taken for granted.
        images: what the recording says of the probe's frames, where it says something.
        declared: what the recording says of the probe.
    """

    drafts: list[Draft]
    write_frames: Callable[[Path], None]
    source: str
    left_out: list[str] = field(default_factory=list)
    rig: StereoRig | None = None
    told: list[str] = field(default_factory=list)
    images: ImageClaim | None = None
    declared: list[DeclaredProbe] = field(default_factory=list)


def rows(matrix: FloatArray) -> list[list[float]]:
    """A matrix as nested lists for a document."""
    return [[float(value) for value in row] for row in matrix]
