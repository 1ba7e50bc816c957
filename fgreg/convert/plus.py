"""PLUS sequences: each frame is a look, with the marker's pose and the stage's angle from its transforms and fields.

By default a frame has ``MarkerToCameraTransform`` (mm), and the stage's angle either as a field ``StageAngle`` (deg) or
as a transform ``ProbeToStageTransform``, whose rotation about x is used (the probe's z axis along (0, sin t, cos t)).
Both transforms may be composed of others (plus_transforms.py). Optional fields: ``FgregType`` (pair, aim, track, note),
``FgregPm``, ``FgregSweep``, ``FgregAmplitude``, ``FgregX`` and ``FgregRange`` (mm; instead of the image),
``FgregText``. A mapping can name others.

A field ``XStatus`` beside a field ``X`` tells whether X is valid; of PLUS's words only OK does. Frames without a valid
status are filled with identities or old values.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.convert.drafts import Document, Draft, ImageClaim, ImageKind, Imported, rows
from fgreg.convert.mapping import RecordingMapping
from fgreg.convert.nrrd_sequence import SUFFIXES as NRRD_SUFFIXES
from fgreg.convert.nrrd_sequence import read_nrrd_sequence
from fgreg.convert.plus_transforms import Chain, Step, chain, mapped_chain
from fgreg.convert.sequence_file import SequenceFile, read_sequence
from fgreg.errors import InputError, one_line
from fgreg.geometry.quaternions import turn_about_x
from fgreg.geometry.transforms import FloatArray, is_rigid
from fgreg.model.time_sync import PairRefused
from fgreg.schema.problems import shown

_DEFAULTS = {
    "marker": "MarkerToCameraTransform",
    "scan": "StageAngle",
    "type": "FgregType",
    "pm": "FgregPm",
    "sweep": "FgregSweep",
    "amplitude": "FgregAmplitude",
    "x_mm": "FgregX",
    "range_mm": "FgregRange",
    "text": "FgregText",
}
_ENDS = {"marker": ("Marker", "Camera"), "scan": ("Probe", "Stage")}
"""Coordinate frames, from and to, of the roles that may be transforms."""
_NO_SCALE = 1e-6
"""Of a transform's scale from 1: one between two images, or of a file that knows no millimetres."""
_OF_IMAGE = re.compile(r"ImageTo[A-Z]\w*Transform")
_TYPES = {"BRIGHTNESS": ImageKind.LOG, "RF_REAL": ImageKind.CHANNELS}
"""What PLUS's image types may be: a scanner's B-mode is log-compressed, its RF lines are beamformed unless the mapping
says that each is an element's."""


def read_plus(path: Path, mapping: RecordingMapping) -> Imported:
    """Read a sequence as events.

    Raises:
        InputError: the file or a field of a frame is invalid.
    """
    sequence = read_nrrd_sequence(path) if path.suffix.lower() in NRRD_SUFFIXES else read_sequence(path)
    frames = _Frames(sequence, mapping)
    drafts: list[Draft] = []
    left_out: dict[str, list[int]] = {}
    for index in range(len(sequence.frames)):
        if mapping.frames is not None and index not in mapping.frames:
            continue
        try:
            drafts.append(Draft(frames.document(index), f"{path.name}: frame {index}"))
        except PairRefused as refused:
            left_out.setdefault(str(refused), []).append(index)
    absent = sorted(index for index in mapping.frames or () if index >= len(sequence.frames))
    if absent:
        raise InputError(f"{path.name}: frame {absent[0]}", "no such frame", f"numbers below {len(sequence.frames)}")
    drafts.sort(key=lambda draft: draft.t)
    images = frames.images

    def write(folder: Path) -> None:
        (folder / "frames").mkdir(exist_ok=True)
        for name, image in images.items():
            np.save(folder / name, image, allow_pickle=False)

    sentences = [f"{_counted(numbers)} left out: {reason}" for reason, numbers in left_out.items()]
    source = f"PLUS sequence {path.name}"
    return Imported(drafts, write, source, sentences, told=frames.told, images=frames.claim())


def _counted(frames: list[int]) -> str:
    """``frame 3 is``, or ``4 frames (3, 7 to 9) are``; ``frames`` increase."""
    if len(frames) == 1:
        return f"frame {frames[0]} is"
    all_of_them = set(frames)
    starts = [n for n in frames if n - 1 not in all_of_them]
    ends = [n for n in frames if n + 1 not in all_of_them]
    spans = [str(a) if a == b else f"{a} to {b}" for a, b in zip(starts, ends, strict=True)]
    more = ", ..." if len(spans) > 12 else ""
    return f"{len(frames)} frames ({', '.join(spans[:12])}{more}) are"


class _Frames:
    """Converts the frames of a sequence to event documents."""

    def __init__(self, sequence: SequenceFile, mapping: RecordingMapping) -> None:
        self._sequence = sequence
        self._names = _DEFAULTS | dict(mapping.fields)
        self.images: dict[str, npt.NDArray[Any]] = {}
        self.told: list[str] = []
        there = {key for fields in sequence.frames for key, value in fields.items() if value}
        for role, name in mapping.fields.items():
            if name not in there:
                expected = f"a field of the frames, for {role}: {', '.join(sorted(there))}"[:300]
                raise InputError(f"{sequence.name}: fields.{role}", f"{shown(name)} in no frame", expected)
        self._chains = {role: self._chain(role, there, mapping) for role in _ENDS}
        self.told += [way.told for way in self._chains.values() if way is not None and way.told]
        self._kind, self._mapping = mapping.images, mapping
        self._next_pm = 0

    def _chain(self, role: str, there: set[str], mapping: RecordingMapping) -> Chain | None:
        """Transforms that a role is made of; None where the mapping names a number, or there are none."""
        name, (child, parent) = self._names[role], _ENDS[role]
        if role in mapping.fields:
            is_transform = role == "marker" or name.endswith("Transform")
            return mapped_chain(name, there, child, parent) if is_transform else None
        return chain(there, child, parent)

    def document(self, index: int) -> Document:
        """The event of one frame. Raises PairRefused where tracker or scanner have no valid data at its time."""
        fields = self._sequence.frames[index]
        place = f"{self._sequence.name}: Seq_Frame{index:04d}"
        t = self._number(fields, "Timestamp", place)
        kind = self._text(fields, "type") or "pair"
        document: Document = {"type": kind, "t": t}
        if kind == "note":
            return document | {"text": self._text(fields, "text")}
        document["marker"] = {"camera_T_marker": rows(self._marker(fields, place))}
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

    def claim(self) -> ImageClaim | None:
        """What the file and the mapping say of the images that are used; None where none is."""
        if not self.images:
            return None
        name = self._sequence.name
        shapes = frozenset((image.shape, image.dtype) for image in self.images.values())
        pixel_mm = _pixel_mm(self._sequence, _orientation(self._sequence, self._mapping))
        return ImageClaim(self._image_kind(), shapes, pixel_mm, f"{name}: images")

    def _there(self, fields: Mapping[str, str], role: str) -> str | None:
        name = self._names[role]
        if not fields.get(name):
            return None
        _valid(fields, name)
        return name

    def _text(self, fields: Mapping[str, str], role: str) -> str:
        name = self._there(fields, role)
        return fields[name] if name else ""

    def _number(self, fields: Mapping[str, str], name: str, place: str) -> float:
        _valid(fields, name)
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

    def _marker(self, fields: Mapping[str, str], place: str) -> FloatArray:
        way = self._chains["marker"]
        if way is None:
            expected = "it, others that lead from Marker to Camera, or fields.marker in the mapping"
            raise InputError(place, f"no field {self._names['marker']}", expected)
        return self._transform(fields, way, place)

    def _transform(self, fields: Mapping[str, str], way: Chain, place: str) -> FloatArray:
        found: FloatArray = np.eye(4)
        for step in way.steps:
            found = self._step(fields, step, place) @ found
        return found

    def _step(self, fields: Mapping[str, str], step: Step, place: str) -> FloatArray:
        name = step.name
        if not fields.get(name):
            raise PairRefused(f"there is no {name}")
        _valid(fields, name)
        try:
            values = np.array([float(word) for word in fields[name].split()])
        except ValueError:
            values = np.zeros(0)
        if values.size != 16 or not np.isfinite(values).all() or not is_rigid(values.reshape(4, 4)):
            raise InputError(f"{place}_{name}", shown(fields[name]), "a rigid 4x4 matrix: 16 numbers, row by row")
        return step.of(values.reshape(4, 4))

    def _scan(self, fields: Mapping[str, str], place: str) -> float:
        way, name = self._chains["scan"], self._names["scan"]
        if way is None or (fields.get(name) and not name.endswith("Transform")):
            return self._number(fields, name, place)
        try:
            return math.degrees(turn_about_x(self._transform(fields, way, place)[:3, :3]))
        except ValueError as error:
            where = f"{place}_{way.steps[0].name}"
            raise InputError(where, str(error), "a rotation of the probe about its x axis") from None

    def _image(self, index: int, fields: Mapping[str, str]) -> str:
        if self._sequence.images is None or index >= len(self._sequence.images):
            raise PairRefused("there is no image")
        _valid(fields, "Image")
        orientation = _orientation(self._sequence, self._mapping)
        name = f"frames/frame-{index:06d}.npy"
        image = self._sequence.images[index]
        self.images[name] = oriented(image, orientation, self._image_kind(), self._sequence.name)
        return name

    def _image_kind(self) -> ImageKind:
        """What the images are, as the file and the mapping say.

        Raises:
            InputError: neither of the two says it, or they contradict each other.
        """
        where = f"{self._sequence.name}: UltrasoundImageType"
        stated = self._sequence.fields.get("UltrasoundImageType", "").upper()
        if stated not in ("", "XX", *_TYPES):
            expected = "BRIGHTNESS, or RF_REAL of single elements: no other type can be used"
            raise InputError(where, shown(stated), expected)
        kind = _TYPES.get(stated)
        if self._kind is None and kind is not ImageKind.LOG:
            found = stated or "nothing"
            expected = "images: channels in the mapping, where each line is a single element's and not beamformed"
            raise InputError(where, found, expected if kind else "images in the mapping: envelope, log or channels")
        if self._kind is None:
            return ImageKind.LOG
        if kind is not None and (kind is ImageKind.CHANNELS) != (self._kind is ImageKind.CHANNELS):
            raise InputError(where, stated, f"another type: the mapping says images: {self._kind}")
        return self._kind


def _valid(fields: Mapping[str, str], name: str) -> None:
    """Raises PairRefused where the status beside a field is another than OK."""
    status = fields.get(f"{name}Status", "OK")
    if status.upper() != "OK":
        raise PairRefused(f"{'ImageStatus' if name == 'Image' else name} is {one_line(status, 40) or 'nothing'}")


def _orientation(sequence: SequenceFile, mapping: RecordingMapping) -> str:
    """UltrasoundImageOrientation in capitals; of a file that has none, as 3D Slicer's, what the mapping says.

    Raises:
        InputError: the two contradict each other.
    """
    stated, mapped = (sequence.fields.get("UltrasoundImageOrientation", "").upper(), mapping.orientation or "")
    if stated in ("", "XX") or not mapped or stated[:2] == mapped[:2]:
        return mapped or stated
    where = f"{sequence.name}: UltrasoundImageOrientation"
    raise InputError(where, shown(stated), f"{mapped}, as orientation in the mapping says")


def _pixel_mm(sequence: SequenceFile, orientation: str) -> tuple[float, float] | None:
    """Pitch (depth, lateral) in mm of the images, turned as they are; None where the file has PLUS's 1 x 1 for none.

    It is ElementSpacing, or the scale of a transform from the image's pixels, such as ``ImageToProbeTransform``.
    """
    scales = ((name, text) for fields in sequence.frames for name, text in _scale_fields(fields))
    for name, text in itertools.chain([("ElementSpacing", sequence.fields.get("ElementSpacing", "1 1"))], scales):
        try:
            numbers = np.array([float(word) for word in text.split()])
            along = numbers[:2] if name == "ElementSpacing" else np.linalg.norm(numbers.reshape(4, 4)[:3, :2], axis=0)
            along_x, along_y = (float(length) for length in along)
        except ValueError:
            along_x = along_y = math.nan
        if not (0.0 < along_x < math.inf and 0.0 < along_y < math.inf):
            raise InputError(f"{sequence.name}: {name}", shown(text), "pixels of a size > 0")
        if max(abs(along_x - 1.0), abs(along_y - 1.0)) > _NO_SCALE:
            return (along_y, along_x) if orientation[:1] in ("M", "U") else (along_x, along_y)
    return None


def _scale_fields(fields: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Valid transforms of a frame from the image's pixels, by their names; one to a cropped image has no scale."""
    for name, text in fields.items():
        if _OF_IMAGE.fullmatch(name) and fields.get(f"{name}Status", "OK").upper() == "OK":
            yield name, text


def oriented(image: npt.NDArray[Any], orientation: str, kind: ImageKind, name: str) -> npt.NDArray[Any]:
    """A stored image as a session's frame: (elements, samples) of channel data, (depth, lateral) of an image.

    The first two letters of PLUS's orientation are the directions of x and y of the stored image (height, width): M or
    U to the probe's marked or unmarked side, F or N away from the probe or towards it. The marked side becomes the
    higher column or element. Log-compressed pixels keep the unsigned type that states their range.

    Raises:
        InputError: other letters.
    """
    across, down = orientation[:1], orientation[1:2]
    if {across, down} not in ({"M", "F"}, {"M", "N"}, {"U", "F"}, {"U", "N"}):
        found = shown(orientation) if orientation else "nothing"
        raise InputError(
            f"{name}: UltrasoundImageOrientation",
            found,
            "M or U and F or N, such as MFA or FMA; or orientation in the mapping",
        )
    lateral_is_x = across in "MU"
    depth_lateral = image if lateral_is_x else image.T
    if "N" in (across, down):
        depth_lateral = depth_lateral[::-1]
    if "U" in (across, down):
        depth_lateral = depth_lateral[:, ::-1]
    if kind is ImageKind.CHANNELS:
        dtype = np.int16 if image.dtype == np.int16 else np.float32
        return np.ascontiguousarray(depth_lateral.T, dtype=dtype)
    if kind is ImageKind.LOG and image.dtype.kind == "u" and image.dtype.itemsize <= 2:
        return np.ascontiguousarray(depth_lateral)
    return np.ascontiguousarray(depth_lateral, dtype=np.float32)
