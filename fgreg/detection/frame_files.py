"""Raw frames from files: PNG images of the endoscope, NPY arrays of the probe."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Picture = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


def read_picture(path: Path) -> Picture | None:
    """An endoscope image, (h, w) grey or (h, w, 3) BGR, 8 or 16 bits; None where the file cannot be decoded."""
    data = np.fromfile(path, dtype=np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH) if data.size else None
    if picture is not None and picture.dtype == np.uint8:
        return np.asarray(picture, dtype=np.uint8)
    if picture is not None and picture.dtype == np.uint16:
        return np.asarray(picture, dtype=np.uint16)
    return None


def to_display(picture: Picture) -> npt.NDArray[np.uint8]:
    """A picture in 8 bits; 16 bits are scaled by the largest value, since cameras fill 10 or 12 of them."""
    if picture.dtype == np.uint8:
        return np.asarray(picture, dtype=np.uint8)
    return np.asarray(np.rint(picture * (255.0 / max(int(picture.max()), 1))), dtype=np.uint8)


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
