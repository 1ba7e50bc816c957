"""Frames made small for documents."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from fgreg.detection.frame_files import Picture, to_display

QUALITY = 70


def thumbnail(picture: Picture, width: int) -> tuple[bytes, int, int]:
    """A picture, (h, w) grey or (h, w, 3) BGR, as a JPEG of at most ``width`` px; its width and height."""
    shown: npt.NDArray[np.uint8] = to_display(picture)
    rows, columns = shown.shape[:2]
    if columns > width:
        size = (width, max(1, round(rows * width / columns)))
        shown = np.asarray(cv2.resize(shown, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    done, data = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not done:
        raise ValueError(f"a picture of shape {picture.shape} cannot be encoded")
    return data.tobytes(), shown.shape[1], shown.shape[0]
