"""Checks of the raw frames that events name, without decoding their pixels."""

from __future__ import annotations

import math
import os
import struct
import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy_format

from fgreg.errors import InputError
from fgreg.model.probe_model import ProbeModel
from fgreg.schema.files import FrameKind
from fgreg.schema.limits import FRAME_BYTES, NPY_HEADER_BYTES, PICTURE_PIXELS
from fgreg.schema.problems import shown
from fgreg.session.exif import UPRIGHT, orientation_in
from fgreg.session.yaml_loader import open_file

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True, slots=True)
class FrameUse:
    """A frame that an event names: resolved path, name in the folder, kind, and the place of the name for messages."""

    path: Path
    name: str
    kind: FrameKind
    where: str


def check_camera_frame(path: Path, name: str, where: str, image_size: tuple[int, int] | None) -> None:
    """Check that a file is a complete, upright PNG image of the camera's size, by its chunk headers.

    Args:
        path: the file.
        name: in the event.
        where: the place of the name, for messages.
        image_size: (width, height), or None where there is no camera to compare with.

    Raises:
        InputError: it is not.
    """
    with _open_frame(path, name, where) as file:
        found = _png_size(file)
        if found is None:
            raise InputError(where, f"{shown(name)}, which is not a complete PNG", "a PNG image")
        size, turned = found
        if size[0] * size[1] > PICTURE_PIXELS:
            text = f"{shown(name)} with {size[0]} x {size[1]} px"
            raise InputError(where, text, f"at most {PICTURE_PIXELS} px")
        if turned != UPRIGHT:
            text = f"{shown(name)} with EXIF orientation {turned}"
            raise InputError(where, text, "pixels as the sensor has them: orientation 1")
        if image_size is not None and size != image_size:
            expected = f"camera.image_size, {image_size[0]} x {image_size[1]}"
            raise InputError(where, f"{shown(name)} with {size[0]} x {size[1]} px", expected)


def _png_size(file: IO[bytes]) -> tuple[tuple[int, int], int] | None:
    """(width, height) and EXIF orientation of a complete PNG file, else None. Pixel data are not decoded."""
    header = file.read(33)
    if len(header) < 33 or header[:8] != _PNG_SIGNATURE or header[8:16] != b"\x00\x00\x00\x0dIHDR":
        return None
    width, height, checksum = struct.unpack(">II5xI", header[16:33])
    if checksum != zlib.crc32(header[12:29]) or not width or not height:
        return None
    end = os.fstat(file.fileno()).st_size
    at, data, turned = 33, False, UPRIGHT
    while True:
        file.seek(at)
        chunk = file.read(8)
        if len(chunk) < 8:
            return None
        length, kind = struct.unpack(">I4s", chunk)
        at += 12 + length
        if at > end:
            return None
        # Check the checksums here: for a damaged file the image library would print its own message.
        body = file.read(length + 4)
        if zlib.crc32(body[:-4], zlib.crc32(kind)) != int.from_bytes(body[-4:], "big"):
            return None
        if kind == b"IEND":
            return ((width, height), turned) if data else None
        if kind == b"eXIf":
            turned = orientation_in(body[:-4])
        data = data or kind == b"IDAT"


def trus_frame_problem(
    shape: tuple[int, ...], dtype: np.dtype[np.generic], probe: ProbeModel
) -> tuple[str, str] | None:
    """Why an array is not a TRUS frame of this probe: (found, expected); None where it is one."""
    if len(shape) != 2 or min(shape) < 2 or dtype.kind not in "iuf":
        found = f"an array of {dtype} with shape {list(shape)}"
    elif probe.image is not None or probe.holds_channels(shape, dtype):
        return None
    else:
        found = f"an array of {dtype} with shape {list(shape)}"
    ways = []
    if probe.channels is not None:
        ways.append(f"channel data (float32 or int16) of shape [{probe.elements}, samples]")
    if probe.image is not None:
        ways.append("an image of numbers, [depth, lateral]")
    return found, " or ".join(ways)


def check_trus_frame(path: Path, name: str, where: str, probe: ProbeModel | None) -> None:
    """Check that a file is an NPY array that fits this probe, by its header, length and finiteness.

    Args:
        path: the file.
        name: in the event.
        where: the place of the name, for messages.
        probe: to compare with, or None where it could not be read.

    Raises:
        InputError: it is not. Arrays of Python objects (pickles) are refused without being read.
    """
    with _open_frame(path, name, where) as file:
        header = _npy_header(file)
        if header is None:
            raise InputError(where, f"{shown(name)}, which is not an NPY array", "an NPY array")
        shape, dtype = header
        if dtype.hasobject:
            raise InputError(where, f"{shown(name)} with Python objects", "an NPY array of numbers")
        needed = file.tell() + dtype.itemsize * math.prod(shape)
        size = os.fstat(file.fileno()).st_size
        if needed > size:
            raise InputError(where, f"{shown(name)} with {size} bytes", f"{needed} bytes, as its header says")
        if size > FRAME_BYTES:
            raise InputError(where, f"{shown(name)} with {size} bytes", f"at most {FRAME_BYTES}")
        problem = None if probe is None else trus_frame_problem(shape, dtype, probe)
        if problem is not None:
            raise InputError(where, f"{shown(name)} with {problem[0]}", problem[1])
        if dtype.kind == "f" and not np.isfinite(np.frombuffer(file.read(needed - file.tell()), dtype)).all():
            raise InputError(where, f"{shown(name)} with entries that are not finite", "finite numbers")


def _npy_header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[np.generic]] | None:
    """Shape and type of an NPY file, read up to its data; None where it is not one."""
    try:
        version = npy_format.read_magic(file)
        if version not in ((1, 0), (2, 0), (3, 0)):
            return None
        at = file.tell()
        length = int.from_bytes(file.read(2 if version == (1, 0) else 4), "little")
        if length > NPY_HEADER_BYTES:
            return None
        file.seek(at)
        read = npy_format.read_array_header_1_0 if version == (1, 0) else npy_format.read_array_header_2_0
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            shape, _, dtype = read(file)
    except Exception:  # numpy parses the header as Python source, and bad bytes raise whatever that parser raises
        return None
    return (shape, dtype) if all(n >= 0 for n in shape) else None


def _open_frame(path: Path, name: str, where: str) -> IO[bytes]:
    try:
        return open_file(path, where)
    except InputError as error:
        found = "no such file" if error.found == "nothing" else error.found
        raise InputError(where, f"{shown(name)}: {found}", error.expected) from None


def check_frames(
    uses: list[FrameUse], probe: ProbeModel | None, image_size: tuple[int, int] | None
) -> list[InputError]:
    """Check each named frame once per kind; returns all problems in the order of the uses."""
    problems: list[InputError] = []
    seen: set[tuple[Path, FrameKind]] = set()
    for use in uses:
        if (use.path, use.kind) in seen:
            continue
        seen.add((use.path, use.kind))
        try:
            if use.kind is FrameKind.CAMERA:
                check_camera_frame(use.path, use.name, use.where, image_size)
            else:
                check_trus_frame(use.path, use.name, use.where, probe)
        except InputError as error:
            problems.append(error)
    return problems
