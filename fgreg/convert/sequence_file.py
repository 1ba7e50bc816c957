"""PLUS sequence files: MetaImage (``.mha``, ``.mhd``) with one image and many fields for each frame.

A header of ``key = value`` lines that ends with ``ElementDataFile``, then pixels, raw or as one zlib stream. Fields of
frame 12 are called ``Seq_Frame0012_...``.
"""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.errors import InputError
from fgreg.schema.limits import SEQUENCE_BYTES, SEQUENCE_FIELDS, SEQUENCE_FRAMES, SEQUENCE_HEADER_BYTES
from fgreg.schema.problems import shown
from fgreg.session.yaml_loader import read_bounded

_TYPES = {"UCHAR": "u1", "CHAR": "i1", "USHORT": "u2", "SHORT": "i2", "UINT": "u4", "INT": "i4", "FLOAT": "f4"}
_TYPES |= {"DOUBLE": "f8"}
_FRAME_FIELD = re.compile(r"Seq_Frame([0-9]{1,9})_(\w{1,200})")


@dataclass(frozen=True, slots=True, eq=False)
class SequenceFile:
    """A sequence as stored.

    Attributes:
        name: of the file, for messages.
        fields: of the whole file, such as ``UltrasoundImageOrientation``.
        frames: fields of each frame without their prefix, such as ``ProbeToTrackerTransform``, ``Timestamp``.
        images: (frames, height, width) as stored, or None where the sequence has no images.
    """

    name: str
    fields: Mapping[str, str]
    frames: tuple[Mapping[str, str], ...]
    images: npt.NDArray[Any] | None


def read_sequence(path: Path) -> SequenceFile:
    """Read a whole sequence.

    Raises:
        InputError: not a MetaImage of three dimensions, or truncated.
    """
    name = path.name
    data = memoryview(read_bounded(path, name, SEQUENCE_HEADER_BYTES + SEQUENCE_BYTES))
    fields, start = _header(data[:SEQUENCE_HEADER_BYTES].tobytes(), name)
    if fields.get("ObjectType") != "Image":
        raise InputError(name, "another file", "a PLUS sequence (MetaImage, .mha)")
    frames: dict[int, dict[str, str]] = {}
    for key, value in fields.items():
        if match := _FRAME_FIELD.fullmatch(key):
            frames.setdefault(int(match[1]), {})[match[2]] = value
    sizes = _numbers(fields, "DimSize", name)
    if len(sizes) == 2:
        sizes.append(1)
    if len(sizes) != 3 or min(sizes) < 0:
        raise InputError(f"{name}: DimSize", shown(fields["DimSize"]), "width, height, number of frames")
    width, height, count = sizes
    if frames and max(frames) >= max(count, 1) and width and height:
        raise InputError(f"{name}: Seq_Frame{max(frames):04d}", "it", f"frames below {count}, as DimSize says")
    stated = fields["DimSize"].split()
    if fields.get("NDims", str(len(stated))) != str(len(stated)):
        raise InputError(f"{name}: NDims", shown(fields["NDims"]), f"{len(stated)}, as many as in DimSize")
    images = _images(fields, data[start:], path, (count, height, width)) if width and height and count else None
    known = max(count if images is not None else 0, 1 + max(frames, default=-1))
    if known > SEQUENCE_FRAMES:
        raise InputError(name, f"frame {known - 1}", f"numbers below {SEQUENCE_FRAMES}")
    return SequenceFile(name, fields, tuple(frames.get(i, {}) for i in range(known)), images)


def _header(data: bytes, name: str) -> tuple[dict[str, str], int]:
    """Fields in order, and where the pixels start."""
    fields: dict[str, str] = {}
    at = 0
    while at < len(data):
        end = data.find(b"\n", at)
        if end < 0:
            end = len(data)  # an .mhd may end without a line feed
        line = data[at:end]
        at = end + 1
        key, equals, value = line.partition(b"=")
        if not line.strip():
            continue
        if not equals or len(key) > 300 or b"\0" in key:
            raise InputError(name, "no header of key = value lines", "a PLUS sequence (MetaImage, .mha)")
        if len(fields) >= SEQUENCE_FIELDS:
            raise InputError(name, f"more than {SEQUENCE_FIELDS} fields", "fewer: a part of the sequence")
        field, text = key.strip().decode("latin-1"), value.strip().decode("latin-1")
        if fields.setdefault(field, text) != text and field != "Comment":
            raise InputError(f"{name}: {field[:100]}", f"{shown(fields[field])} and {shown(text)}", "one value")
        if field == "ElementDataFile":
            return fields, at
    expected = f"a whole PLUS sequence (MetaImage, .mha) with at most {SEQUENCE_HEADER_BYTES} bytes of it"
    raise InputError(name, "a header without ElementDataFile", expected)


def _numbers(fields: Mapping[str, str], key: str, name: str) -> list[int]:
    text = fields.get(key, "")
    words = text.split()
    if not words or not all(word.isdecimal() and len(word) < 10 for word in words):
        raise InputError(f"{name}: {key}", shown(text) if text else "nothing", "whole numbers")
    return [int(word) for word in words]


def read_beside(path: Path, stored: str, key: str) -> bytes:
    """The pixels' file that a header names. Raises InputError: not a file of the header's folder."""
    if not stored or Path(stored).name != stored or stored == "..":
        raise InputError(f"{path.name}: {key}", shown(stored), "LOCAL, or a file beside it")
    return read_bounded(path.with_name(stored), stored, SEQUENCE_BYTES)


def _images(
    fields: Mapping[str, str], data: bytes | memoryview, path: Path, shape: tuple[int, int, int]
) -> npt.NDArray[Any]:
    name = path.name
    kind = _TYPES.get(fields.get("ElementType", "").removeprefix("MET_"))
    if kind is None:
        raise InputError(f"{name}: ElementType", shown(fields.get("ElementType", "")), f"MET_ and {', '.join(_TYPES)}")
    if fields.get("ElementNumberOfChannels", "1") != "1":
        raise InputError(f"{name}: ElementNumberOfChannels", fields["ElementNumberOfChannels"], "1: grey images")
    if fields.get("BinaryData", "True").lower() != "true":
        raise InputError(f"{name}: BinaryData", shown(fields["BinaryData"]), "True")
    if fields.get("HeaderSize", "0") != "0":
        raise InputError(f"{name}: HeaderSize", shown(fields["HeaderSize"]), "0: pixels from the first byte on")
    axes = fields.get("TransformMatrix", "1").split()
    if axes != [str(int(i % (math.isqrt(len(axes)) + 1) == 0)) for i in range(len(axes))]:
        raise InputError(f"{name}: TransformMatrix", shown(" ".join(axes)), "that of axes as stored: 1 0 0 0 1 0 0 0 1")
    stored = fields["ElementDataFile"]
    if stored.upper() != "LOCAL":
        data = read_beside(path, stored, "ElementDataFile")
    item = np.dtype(kind).newbyteorder(">" if _big(fields) else "<")
    needed = item.itemsize * math.prod(shape)
    if needed > SEQUENCE_BYTES:
        raise InputError(f"{name}: DimSize", f"{needed} bytes", f"at most {SEQUENCE_BYTES}: a part of the sequence")
    if fields.get("CompressedData", "False").lower() == "true":
        try:
            data = zlib.decompressobj().decompress(data, needed + 1)
        except zlib.error as error:
            raise InputError(name, f"compressed data that are damaged ({error})", "a zlib stream") from None
    if len(data) != needed:
        raise InputError(name, f"{len(data)} bytes of pixels", f"{needed}, as DimSize says")
    pixels = np.frombuffer(data, dtype=item, count=needed // item.itemsize).reshape(shape)
    return pixels.astype(item.newbyteorder("="), copy=False)


def _big(fields: Mapping[str, str]) -> bool:
    keys = ("BinaryDataByteOrderMSB", "ElementByteOrderMSB")
    return any(fields.get(key, "False").lower() == "true" for key in keys)
