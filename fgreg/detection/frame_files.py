"""Raw frames from files: images of the endoscope (one reader for all of them), NPY arrays of the probe."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from fgreg.errors import InputError
from fgreg.session.exif import UPRIGHT, orientation

Picture = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]

HOT_SHARE = 0.8
"""Largest value of a picture without its single pixels, as a share of that with them, below which those are hot."""


def read_picture(path: Path) -> Picture | None:
    """An endoscope image of a file; as :func:`decode_picture`."""
    return decode_picture(path.read_bytes(), path.name)


def decode_picture(data: bytes, name: str) -> Picture | None:
    """An endoscope image, (h, w) grey or (h, w, 3) BGR, 8 or 16 bits as stored; None where it cannot be decoded.

    Palettes become colours, fewer bits than 8 are spread to 8.

    Raises:
        InputError: parts of it are transparent, or it is to be turned before it is shown (EXIF).
    """
    picture = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED) if data else None
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


def to_display(picture: Picture) -> npt.NDArray[np.uint8]:
    """A picture in 8 bits; 16 bits are scaled by their white level."""
    if picture.dtype == np.uint8:
        return np.asarray(picture, dtype=np.uint8)
    return np.asarray(np.rint(np.minimum(picture * (255.0 / white_level(picture)), 255.0)), dtype=np.uint8)


def read_array(path: Path) -> npt.NDArray[Any] | None:
    """A probe frame as stored; None where the file cannot be read. Arrays of Python objects are refused."""
    try:
        return np.asarray(np.load(path, allow_pickle=False))
    except (ValueError, OSError, EOFError):
        return None


def png_bytes(picture: Picture) -> bytes:
    """A picture, (h, w) grey or (h, w, 3) BGR, as a PNG file."""
    done, data = cv2.imencode(".png", picture)
    if not done:
        raise ValueError(f"a picture of shape {picture.shape} cannot be encoded")
    return data.tobytes()
