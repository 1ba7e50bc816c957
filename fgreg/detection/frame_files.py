"""Raw frames from files: images of the endoscope (one reader for all of them), NPY arrays of the probe."""

from __future__ import annotations

import warnings
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from fgreg.errors import InputError
from fgreg.schema.limits import PICTURE_BYTES
from fgreg.session.exif import UPRIGHT, orientation
from fgreg.workers.library_messages import printed_by_libraries

_DAMAGED = (b"Corrupt JPEG data", b"Premature end of JPEG file", b"TIFF_Error")
Picture = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]

HOT_SHARE = 0.8
"""Largest value of a picture without its single pixels, as a share of that with them, below which those are hot."""


def read_picture(path: Path) -> Picture | None:
    """An endoscope image of a file; as :func:`decode_picture`."""
    return None if path.stat().st_size > PICTURE_BYTES else decode_picture(path.read_bytes(), path.name)


def decode_picture(data: bytes, name: str) -> Picture | None:
    """An endoscope image, (h, w) grey or (h, w, 3) BGR, 8 or 16 bits as stored; None where it cannot be decoded.

    Palettes become colours, fewer bits than 8 are spread to 8.

    Raises:
        InputError: parts of it are transparent, or it is to be turned before it is shown (EXIF).
    """
    picture = _decode(data)
    if picture is None or picture.dtype not in (np.uint8, np.uint16):
        return None
    if (turned := orientation(data)) != UPRIGHT:
        expected = "pixels as the sensor has them: orientation 1"
        raise InputError(name, f"a picture with EXIF orientation {turned}", expected)
    pixels = as_picture(np.asarray(picture))
    if pixels.ndim == 3 and pixels.shape[2] == 4:
        if int(pixels[..., 3].min()) < (255 if pixels.dtype == np.uint8 else 65535):
            raise InputError(name, "a picture with transparent parts", "an opaque one")
        return as_picture(np.ascontiguousarray(pixels[..., :3]))
    return pixels


def as_picture(array: npt.NDArray[Any]) -> Picture:
    """An array of 8 or 16 bits with its type.

    Raises:
        ValueError: other numbers.
    """
    if array.dtype == np.uint16:
        return np.asarray(array, dtype=np.uint16)
    if array.dtype != np.uint8:
        raise ValueError(f"an image of type {array.dtype}, expected uint8 or uint16")
    return np.asarray(array, dtype=np.uint8)


def white_level(picture: Picture) -> int:
    """The value that stands for white: 255 of 8 bits; of 16, which 10 and 12 bits do not fill, the largest value.

    Single pixels that are far above all pairs of 2 x 2 are hot ones of the sensor, and do not count.
    """
    if picture.dtype == np.uint8:
        return 255
    top = int(picture.max())
    calm = int(cv2.erode(picture, np.ones((2, 2), dtype=np.uint8)).max())
    return max(top if calm >= HOT_SHARE * top else calm, 1)


def _decode(data: bytes) -> npt.NDArray[Any] | None:
    """``cv2.imdecode``, and None where it fails or the decoder says that the data are damaged.

    The decoders of JPEG and TIFF say so on standard error only, and give a picture that is wrong from some line on.
    """
    if not data:
        return None
    is_png = data.startswith(b"\x89PNG")  # has checksums: its decoder gives no picture at all
    try:
        with nullcontext([b""]) if is_png else printed_by_libraries() as said:
            picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:  # too many pixels
        return None
    return None if picture is None or any(word in said[0] for word in _DAMAGED) else np.asarray(picture)


def to_display(picture: Picture) -> npt.NDArray[np.uint8]:
    """A picture in 8 bits; 16 bits are scaled by their white level."""
    if picture.dtype == np.uint8:
        return np.asarray(picture, dtype=np.uint8)
    return np.asarray(np.rint(np.minimum(picture * (255.0 / white_level(picture)), 255.0)), dtype=np.uint8)


def read_array(path: Path) -> npt.NDArray[Any] | None:
    """A probe frame as stored; None where the file cannot be read. Arrays of Python objects are refused."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # old headers are read all the same
            return np.asarray(np.load(path, allow_pickle=False))
    except (ValueError, OSError, EOFError):
        return None


def png_bytes(picture: Picture) -> bytes:
    """A picture, (h, w) grey or (h, w, 3) BGR, as a PNG file."""
    done, data = cv2.imencode(".png", picture)
    if not done:
        raise ValueError(f"a picture of shape {picture.shape} cannot be encoded")
    return data.tobytes()
