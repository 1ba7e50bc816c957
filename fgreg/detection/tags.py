"""Tags of one dictionary in one image: OpenCV's ArUco detector, also at the image's border.

Corner order is top left, top right, bottom right, bottom left *as OpenCV's generateImageMarker draws the tag*. For
the AprilTag dictionaries OpenCV (4.x and 5.0) draws the official tags rotated by half a turn: for a tag printed from
the official images, ``marker_T_tag`` must include that half turn about z.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from fgreg.detection.edges import Image
from fgreg.geometry.transforms import FloatArray

BORDER_PX = 12
"""Padding of the image: a tag whose quiet zone is cut by the image's edge is then still a closed square."""


@dataclass(frozen=True, slots=True, eq=False)
class FoundTag:
    """A tag as the detector reports it: id and corners (4, 2) px, accurate to a pixel or two."""

    id: int
    corners_px: FloatArray


def dictionary_named(name: str) -> cv2.aruco.Dictionary:
    """The OpenCV dictionary of that name, e.g. ``DICT_4X4_50`` or ``DICT_APRILTAG_36h11``.

    Raises:
        ValueError: no such dictionary.
    """
    number = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if not isinstance(number, int):
        raise ValueError(f"{name} is not an OpenCV dictionary, expected e.g. DICT_4X4_50 or DICT_APRILTAG_36h11")
    return cv2.aruco.getPredefinedDictionary(number)


def tag_cells(name: str) -> int:
    """Cells along a tag's side, black border of one cell included."""
    return int(dictionary_named(name).markerSize) + 2


def detector_parameters() -> cv2.aruco.DetectorParameters:
    """Parameters for tags from about 15 px to most of the image, on a light or dark background."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.minDistanceToBorder = 0
    parameters.minMarkerPerimeterRate = 0.02
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    return parameters


def halved(image: npt.NDArray[Any]) -> Image:
    """The image at half its resolution: pixel (x, y) of it is (2 x + 0.5, 2 y + 0.5) of the image."""
    return np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def find_tags(image: Image, dictionary: str, *, half: bool = False, faint: bool = False) -> list[FoundTag]:
    """All tags of a dictionary in a grey image (h, w); one id may occur several times.

    Args:
        half: search at half resolution: a quarter of the time, enough for tags of about 40 px and more.
        faint: search at half resolution and lower contrast, for blurred or noisy tags.
    """
    half = half or faint
    padded = cv2.copyMakeBorder(image, BORDER_PX, BORDER_PX, BORDER_PX, BORDER_PX, cv2.BORDER_REPLICATE)
    parameters = detector_parameters()
    if half:
        padded = halved(padded)
    if faint:
        parameters.adaptiveThreshConstant = 3.0
    detector = cv2.aruco.ArucoDetector(dictionary_named(dictionary), parameters)
    corners, ids, _ = detector.detectMarkers(padded)
    if ids is None:
        return []
    scale = 2.0 if half else 1.0
    # ids: (n,) in OpenCV 5, (n, 1) in 4.
    return [
        FoundTag(int(tag_id), (np.asarray(c, dtype=np.float64).reshape(4, 2) + 0.5) * scale - 0.5 - BORDER_PX)
        for tag_id, c in zip(np.asarray(ids).ravel(), corners, strict=True)
    ]
