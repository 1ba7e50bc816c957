"""PLUS sequences: each frame is a look, with the marker's pose and the stage's angle from its transforms and fields.

By default a frame has ``MarkerToCameraTransform`` (mm), and the stage's angle either as a field ``StageAngle`` (deg) or
as a transform ``ProbeToStageTransform``, whose rotation about x is used (the probe's z axis along (0, sin t, cos t)).
Optional fields: ``FgregType`` (pair, aim, track, note), ``FgregPm``, ``FgregSweep``, ``FgregAmplitude``,
``FgregX`` and ``FgregRange`` (mm; instead of the image), ``FgregText``. A mapping can name others.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.convert.drafts import Document, Draft, Imported, rows
from fgreg.convert.mapping import RecordingMapping
from fgreg.convert.sequence_file import SequenceFile, read_sequence
from fgreg.errors import InputError
from fgreg.geometry.quaternions import turn_about_x
from fgreg.geometry.transforms import FloatArray, is_rigid
from fgreg.model.time_sync import PairRefused
from fgreg.schema.problems import shown

_DEFAULTS = {
    "marker": ("MarkerToCameraTransform",),
    "scan": ("StageAngle", "ProbeToStageTransform"),
    "type": ("FgregType",),
    "pm": ("FgregPm",),
    "sweep": ("FgregSweep",),
    "amplitude": ("FgregAmplitude",),
    "x_mm": ("FgregX",),
    "range_mm": ("FgregRange",),
    "text": ("FgregText",),
}
_BAD_STATUS = ("INVALID", "MISSING", "OUT_OF_VIEW", "TRACKER_ERROR")


def read_plus(path: Path, mapping: RecordingMapping) -> Imported:
    """Read a sequence as events.

    Raises:
        InputError: the file or a field of a frame is invalid.
    """
    sequence = read_sequence(path)
    frames = _Frames(sequence, mapping)
    drafts: list[Draft] = []
    left_out: list[str] = []
    for index in range(len(sequence.frames)):
        if mapping.frames is not None and index not in mapping.frames:
            continue
        try:
            drafts.append(Draft(frames.document(index), f"{path.name}: frame {index}"))
        except PairRefused as refused:
            left_out.append(f"frame {index} is left out: {refused}")
    absent = sorted(index for index in mapping.frames or () if index >= len(sequence.frames))
    if absent:
        raise InputError(f"{path.name}: frame {absent[0]}", "no such frame", f"numbers below {len(sequence.frames)}")
    drafts.sort(key=lambda draft: draft.t)
    images = frames.images

    def write(folder: Path) -> None:
        (folder / "frames").mkdir(exist_ok=True)
        for name, image in images.items():
            np.save(folder / name, image, allow_pickle=False)

    return Imported(drafts, write, f"PLUS sequence {path.name}", left_out)


class _Frames:
    """Converts the frames of a sequence to event documents."""

    def __init__(self, sequence: SequenceFile, mapping: RecordingMapping) -> None:
        self._sequence = sequence
        self._names = {
            role: (mapping.fields[role],) if role in mapping.fields else _DEFAULTS[role] for role in _DEFAULTS
        }
        self.images: dict[str, npt.NDArray[Any]] = {}
        fields = [fields for fields in sequence.frames if fields]
        for role, name in mapping.fields.items():
            if not any(name in entry for entry in fields):
                there = ", ".join(sorted({key for entry in fields for key in entry}))
                expected = f"a field of the frames, for {role}: {there}"[:300]
                raise InputError(f"{sequence.name}: fields.{role}", f"{shown(name)} in no frame", expected)
        self._next_pm = 0

    def document(self, index: int) -> Document:
        """The event of one frame. Raises PairRefused where tracker or scanner have no valid data at its time."""
        fields = self._sequence.frames[index]
        place = f"{self._sequence.name}: Seq_Frame{index:04d}"
        t = self._number(fields, "Timestamp", place)
        kind = self._text(fields, "type") or "pair"
        document: Document = {"type": kind, "t": t}
        if kind == "note":
            return document | {"text": self._text(fields, "text")}
        document["marker"] = {"camera_T_marker": rows(self._transform(fields, "marker", place))}
        if kind == "track":
            return document | {"scan_deg": self._scan(fields, place)}
        if kind != "pair":
            return document
        trus: Document = {"scan_deg": self._scan(fields, place)}
        for role in ("x_mm", "range_mm", "amplitude"):
            if name := self._there(fields, role):
                trus[role] = self._number(fields, name, place)
        if name := self._there(fields, "sweep"):
            trus["sweep"] = self._whole(fields, name, place)
        if "x_mm" not in trus and "range_mm" not in trus:
            trus["frame"] = self._image(index, fields)
        name = self._there(fields, "pm")
        document["pm"] = self._whole(fields, name, place) if name else self._next_pm
        self._next_pm = max(self._next_pm, document["pm"] + 1)
        return document | {"trus": trus}

    def _there(self, fields: Mapping[str, str], role: str) -> str | None:
        return next((name for name in self._names[role] if fields.get(name)), None)

    def _text(self, fields: Mapping[str, str], role: str) -> str:
        name = self._there(fields, role)
        return fields[name] if name else ""

    def _number(self, fields: Mapping[str, str], name: str, place: str) -> float:
        try:
            value = float(fields.get(name, ""))
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"{place}_{name}", shown(fields[name]) if name in fields else "nothing", "a finite number")
        return value

    def _whole(self, fields: Mapping[str, str], name: str, place: str) -> int:
        value = self._number(fields, name, place)
        if value != round(value):
            raise InputError(f"{place}_{name}", shown(fields[name]), "a whole number")
        return round(value)

    def _transform(self, fields: Mapping[str, str], role: str, place: str) -> FloatArray:
        name = self._there(fields, role)
        if name is None:
            names = " or ".join(self._names[role])
            raise InputError(place, f"no field {names}", f"it, or fields.{role} in the mapping")
        status = fields.get(f"{name}Status", "OK")
        if status in _BAD_STATUS:
            raise PairRefused(f"{name} is {status}")
        try:
            values = np.array([float(word) for word in fields[name].split()])
        except ValueError:
            values = np.zeros(0)
        if values.size != 16 or not np.isfinite(values).all() or not is_rigid(values.reshape(4, 4)):
            raise InputError(f"{place}_{name}", shown(fields[name]), "a rigid 4x4 matrix: 16 numbers, row by row")
        return values.reshape(4, 4)

    def _scan(self, fields: Mapping[str, str], place: str) -> float:
        name = self._there(fields, "scan")
        if name is None or not name.endswith("Transform"):
            return self._number(fields, name or self._names["scan"][0], place)
        try:
            return math.degrees(turn_about_x(self._transform(fields, "scan", place)[:3, :3]))
        except ValueError as error:
            raise InputError(f"{place}_{name}", str(error), "a rotation of the probe about its x axis") from None

    def _image(self, index: int, fields: Mapping[str, str]) -> str:
        if self._sequence.images is None or index >= len(self._sequence.images):
            raise PairRefused("there is no image")
        if fields.get("ImageStatus", "OK") == "INVALID":
            raise PairRefused("ImageStatus is INVALID")
        orientation = self._sequence.fields.get("UltrasoundImageOrientation", "MFA").upper()
        is_rf = self._sequence.fields.get("UltrasoundImageType", "BRIGHTNESS").upper().startswith("RF_REAL")
        name = f"frames/frame-{index:06d}.npy"
        self.images[name] = oriented(self._sequence.images[index], orientation, is_rf, self._sequence.name)
        return name


def oriented(image: npt.NDArray[Any], orientation: str, is_rf: bool, name: str) -> npt.NDArray[Any]:
    """A stored image as a session's frame: (elements, samples) of channel data, (depth, lateral) of an envelope.

    The first two letters of PLUS's orientation are the directions of x and y of the stored image (height, width): M or
    U to the probe's marked or unmarked side, F or N away from the probe or towards it. The marked side becomes the
    higher column or element.

    Raises:
        InputError: other letters.
    """
    across, down = orientation[:1], orientation[1:2]
    if {across, down} not in ({"M", "F"}, {"M", "N"}, {"U", "F"}, {"U", "N"}):
        found = shown(orientation)
        raise InputError(f"{name}: UltrasoundImageOrientation", found, "M or U and F or N, such as MFA or FMA")
    lateral_is_x = across in "MU"
    depth_lateral = image if lateral_is_x else image.T
    if "N" in (across, down):
        depth_lateral = depth_lateral[::-1]
    if "U" in (across, down):
        depth_lateral = depth_lateral[:, ::-1]
    if is_rf:
        kind = np.int16 if image.dtype == np.int16 else np.float32
        return np.ascontiguousarray(depth_lateral.T, dtype=kind)
    return np.ascontiguousarray(depth_lateral, dtype=np.float32)
