"""Raw frames from files: PNG images of the endoscope, NPY arrays of the probe."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt


def read_picture(path: Path) -> npt.NDArray[np.uint8] | None:
    """An endoscope image, (h, w) grey or (h, w, 3) BGR, 8 bit; None where the file cannot be decoded."""
    data = np.fromfile(path, dtype=np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_ANYCOLOR) if data.size else None
    return None if picture is None else np.asarray(picture, dtype=np.uint8)


def read_array(path: Path) -> npt.NDArray[Any] | None:
    """A probe frame as stored; None where the file cannot be read. Arrays of Python objects are refused."""
    try:
        return np.asarray(np.load(path, allow_pickle=False))
    except (ValueError, OSError, EOFError):
        return None


def png_bytes(picture: npt.NDArray[np.uint8]) -> bytes:
    """A picture, (h, w) grey or (h, w, 3) BGR, as a PNG file."""
    done, data = cv2.imencode(".png", picture)
    if not done:
        raise ValueError(f"a picture of shape {picture.shape} cannot be encoded")
    return data.tobytes()
