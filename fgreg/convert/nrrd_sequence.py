"""Sequences in NRRD files (``.seq.nrrd``, ``.nrrd``, ``.nhdr``), as PLUS and 3D Slicer write them; by ``pynrrd``.

PLUS writes the fields of a frame as in its MetaImages, ``Seq_Frame0012_...``, and the image's status as ``..._Status``.
Slicer has one list axis, first or last, with values (``axis 3 index values``): times where its label is ``time``,
and attributes of the items (``axis 3 item 12 ...``). Both become a :class:`SequenceFile`.
"""

from __future__ import annotations

import bz2
import io
import math
import re
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.convert.sequence_file import SequenceFile, read_beside
from fgreg.errors import InputError, MissingExtraError
from fgreg.schema.limits import SEQUENCE_BYTES
from fgreg.schema.problems import shown
from fgreg.session.yaml_loader import read_bounded

SUFFIXES = (".nrrd", ".nhdr")
_FRAME_FIELD = re.compile(r"Seq_Frame([0-9]{1,9})_(\w{1,200})")
_ITEM_FIELD = re.compile(r"axis ([0-9]{1,2}) item ([0-9]{1,9}) (\w{1,200})")
_NAMES = {
    "ultrasound image orientation": "UltrasoundImageOrientation",
    "ultrasound image type": "UltrasoundImageType",
}


def read_nrrd_sequence(path: Path) -> SequenceFile:
    """Read a whole sequence.

    Raises:
        InputError: no NRRD file, not a list of grey images, or truncated.
        MissingExtraError: ``pynrrd`` is not installed.
    """
    try:
        import nrrd
    except ImportError:
        raise MissingExtraError("pynrrd", "nrrd") from None
    name = path.name
    data = read_bounded(path, name, SEQUENCE_BYTES)
    lines, start = _header_lines(data, name)
    try:
        header: dict[str, Any] = dict(nrrd.read_header(lines))
        sizes = [int(size) for size in header["sizes"]]
    except Exception as error:  # the parser raises whatever a bad value makes it raise
        raise _unreadable(name, error) from None
    axis, domain = _axes(header, sizes, name)
    count = 1 if axis is None else sizes[axis]
    raw = _pixel_bytes(header, data[start:], path, math.prod(sizes))
    try:
        inside = {key: value for key, value in header.items() if key not in ("data file", "datafile")}
        stored = nrrd.read_data(inside | {"encoding": "raw"}, io.BytesIO(raw), index_order="C")
    except Exception as error:
        raise _unreadable(name, error) from None
    last = len(sizes) - 1
    images = stored[None] if axis is None else np.moveaxis(stored, last - axis, 0)
    images = images.reshape(count, sizes[domain[1]], sizes[domain[0]])
    fields = {_NAMES.get(key, key): str(value) for key, value in header.items()}
    spacing = _spacing(header, domain)
    if spacing is not None:
        fields["ElementSpacing"] = spacing
    frames = _frames(header, axis, count, name)
    return SequenceFile(name, fields, frames, _native(images))


def _header_lines(data: bytes, name: str) -> tuple[list[str], int]:
    """The header's lines, and where the pixels start. A field that is there twice with one value counts once."""
    if not data.startswith(b"NRRD"):
        raise InputError(name, "another file", "a sequence in an NRRD file")
    ends = [(at, size) for mark in (b"\n\n", b"\r\n\r\n") if (at := data.find(mark)) >= 0 for size in [len(mark)]]
    at, size = min(ends, default=(len(data), 0))
    lines: list[str] = []
    seen: dict[str, str] = {}
    for line in data[:at].decode("utf-8", errors="replace").splitlines():
        key, colon, value = line.partition(":")
        key, value = key.strip(), value.removeprefix("=").strip()
        if colon and not line.startswith("#"):
            if seen.get(key, value) != value:
                raise InputError(f"{name}: {key[:100]}", f"{shown(seen[key])} and {shown(value)}", "one value")
            if key in seen:
                continue
            seen[key] = value
        lines.append(line)
    return lines, at + size


def _axes(header: Mapping[str, Any], sizes: list[int], name: str) -> tuple[int | None, list[int]]:
    """The axis of the frames, None for one image, and the two axes of an image."""
    kinds = [str(kind) for kind in header.get("kinds", ())]
    if len(kinds) != len(sizes):
        kinds = ["domain"] * min(2, len(sizes)) + ["list"] * (len(sizes) - 2)
    frames = [i for i, kind in enumerate(kinds) if kind in ("list", "time")]
    domain = [i for i, kind in enumerate(kinds) if kind in ("domain", "space")]
    flat = [i for i in domain[2:] if sizes[i] == 1]
    if (
        min(sizes, default=0) < 1
        or len(frames) > 1
        or len(frames) + len(domain) != len(sizes)
        or len(domain) - len(flat) != 2
    ):
        found = f"sizes {' '.join(map(str, sizes))} of kinds {' '.join(kinds)}"
        raise InputError(f"{name}: kinds", found, "two axes of a grey image (domain) and one of frames (list)")
    return (frames[0] if frames else None), domain[:2]


def _pixel_bytes(header: Mapping[str, Any], data: bytes, path: Path, points: int) -> bytes:
    """The pixels' bytes, uncompressed; no more than the sizes need."""
    name = path.name
    for key in ("line skip", "lineskip", "byte skip", "byteskip"):
        if int(header.get(key, 0)) != 0:
            raise InputError(f"{name}: {key}", str(header[key]), "0: pixels right after the header")
    stored = header.get("data file", header.get("datafile"))
    if stored is not None:
        if str(stored).startswith("LIST") or "%" in str(stored):
            raise InputError(f"{name}: data file", shown(str(stored)), "one file beside it")
        data = read_beside(path, str(stored), "data file")
    if points > SEQUENCE_BYTES:
        raise InputError(f"{name}: sizes", f"{points} pixels", f"at most {SEQUENCE_BYTES}")
    most = min(8 * points, SEQUENCE_BYTES) + 1
    encoding = str(header.get("encoding", ""))
    try:
        match encoding:
            case "raw":
                return data
            case "gz" | "gzip":
                return zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(data, most)
            case "bz2" | "bzip2":
                return bz2.BZ2Decompressor().decompress(data, most)
    except (zlib.error, OSError) as error:
        raise InputError(name, f"compressed data that are damaged ({error})", f"a {encoding} stream") from None
    raise InputError(f"{name}: encoding", shown(encoding), "raw, gzip or bzip2")


def _frames(header: Mapping[str, Any], axis: int | None, count: int, name: str) -> tuple[Mapping[str, str], ...]:
    """Fields of each frame without their prefix."""
    frames: list[dict[str, str]] = [{} for _ in range(count)]
    for key, value in header.items():
        if match := _FRAME_FIELD.fullmatch(key):
            index, field = int(match[1]), match[2]
        elif (match := _ITEM_FIELD.fullmatch(key)) and int(match[1]) == axis:
            index, field = int(match[2]), match[3]
        else:
            continue
        if index >= count:
            raise InputError(f"{name}: {key}", "it", f"frames below {count}, as sizes says")
        frames[index]["ImageStatus" if field == "Status" else field] = str(value)
    times = _times(header, axis, count, name)
    for frame, t in zip(frames, times, strict=False):
        frame.setdefault("Timestamp", t)
    return tuple(frames)


def _times(header: Mapping[str, Any], axis: int | None, count: int, name: str) -> list[str]:
    """The values of the list axis where they are times in seconds, else nothing."""
    values = str(header.get(f"axis {axis} index values", "")).split()
    labels, units = header.get("labels", ()), header.get("units", ())
    if axis is None or not values or axis >= len(labels) or str(labels[axis]).strip('"').lower() != "time":
        return []
    unit = str(units[axis]).strip('"') if axis < len(units) else "s"
    if unit not in ("s", "ms", ""):
        raise InputError(f"{name}: units", shown(unit), "s or ms, of the times of the frames")
    if len(values) != count:
        raise InputError(f"{name}: axis {axis} index values", f"{len(values)} values", f"{count}, one for each frame")
    try:
        return [repr(float(value) / 1000.0) for value in values] if unit == "ms" else values
    except ValueError:
        raise InputError(f"{name}: axis {axis} index values", shown(values[0]), "times in ms") from None


def _spacing(header: Mapping[str, Any], domain: list[int]) -> str | None:
    """Distances of the pixels along the two axes of an image, as MetaImage's ElementSpacing; None where unknown."""
    directions = header.get("space directions")
    if directions is not None:
        found = [float(np.linalg.norm(np.asarray(directions[i], dtype=np.float64))) for i in domain]
    elif (spacings := header.get("spacings")) is not None:
        found = [float(spacings[i]) for i in domain]
    else:
        return None
    return " ".join(repr(value) for value in found) if all(map(math.isfinite, found)) else None


def _native(images: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return np.ascontiguousarray(images, dtype=images.dtype.newbyteorder("="))


def _unreadable(name: str, error: Exception) -> InputError:
    words = (" ".join(str(error).split()) or type(error).__name__)[:160]
    return InputError(name, f"an NRRD file that cannot be read ({words})", "a whole sequence")
