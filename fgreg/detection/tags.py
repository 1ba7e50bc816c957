"""Tags of one dictionary in one image: OpenCV's ArUco detector, also at the image's border.

Corner order is top left, top right, bottom right, bottom left *as OpenCV's generateImageMarker draws the tag*. For
the AprilTag dictionaries OpenCV (4.x and 5.0) draws the official tags rotated by half a turn: for a tag printed from
the official images, ``marker_T_tag`` must include that half turn about z. A version of OpenCV that reads tags in
another orientation would turn every body: before a dictionary is used, its first tag is drawn from bits kept here and
found.
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from fgreg.detection.edge_pixels import Image
from fgreg.errors import InputError
from fgreg.geometry.transforms import BoolArray, FloatArray

BORDER_PX = 12
"""Padding of the image: a tag whose quiet zone is cut by the image's edge is then still a closed square."""

CELL_PX = 8
"""Side of a cell of the tags that the order of corners is checked on."""
_FIRST_TAGS = {
    "4X4": 0xB532,
    "5X5": 0x145B2BC,
    "6X6": 0x1E3DD82A6,
    "7X7": 0x1BAB8D94B9415,
    "ARUCO_ORIGINAL": 0x1084210,
    "ARUCO_MIP_36H12": 0xD2B63A09D,
    "APRILTAG_16H5": 0xD8C4,
    "APRILTAG_25H9": 0x11FA755,
    "APRILTAG_36H10": 0xE16549538,
    "APRILTAG_36H11": 0x21A146BAB,
}
"""Tag 0 of each family: its cells within the border, row by row, white 1, as OpenCV 4.10 to 5.0 draws it."""


@dataclass(frozen=True, slots=True, eq=False)
class FoundTag:
    """A tag as the detector reports it: id and corners (4, 2) px, accurate to a pixel or two."""

    id: int
    corners_px: FloatArray


@functools.cache
def dictionary_named(name: str) -> cv2.aruco.Dictionary:
    """The OpenCV dictionary of that name, e.g. ``DICT_4X4_50`` or ``DICT_APRILTAG_36h11``.

    Raises:
        ValueError: no such dictionary.
        InputError: this version of OpenCV reads its tags turned.
    """
    number = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if not isinstance(number, int):
        raise ValueError(f"{name} is not an OpenCV dictionary, expected e.g. DICT_4X4_50 or DICT_APRILTAG_36h11")
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    family = re.sub(r"(X\d)_\d+$", r"\1", name.removeprefix("DICT_")).upper()
    if family in _FIRST_TAGS:
        check_corner_order(dictionary, _FIRST_TAGS[family], name)
    return dictionary


def check_corner_order(dictionary: cv2.aruco.Dictionary, bits: int, name: str) -> None:
    """Check that OpenCV finds tag 0 of a dictionary with its corners where they always were; takes under a millisecond.

    Args:
        dictionary: OpenCV's.
        bits: the tag's cells within its border, row by row, white 1, as OpenCV 4.10 to 5.0 draws it.
        name: for the message.

    Raises:
        InputError: it is not found, or its corners come in another order.
    """
    image, corners = drawn_tag(bits, int(dictionary.markerSize))
    found, ids, _ = cv2.aruco.ArucoDetector(dictionary, detector_parameters()).detectMarkers(image)
    turns = -1  # quarters; none fits
    if ids is not None and np.ravel(ids).tolist() == [0]:
        seen = np.asarray(found[0], dtype=np.float64).reshape(4, 2)
        fits = [np.abs(np.roll(seen, k, axis=0) - corners).max() < CELL_PX / 2 for k in range(4)]
        turns = fits.index(True) if True in fits else -1
    if turns:
        how = f"turned by {90 * turns} deg" if turns > 0 else "not where it is"
        expected = "a version that reads it as it is drawn, such as 4.10 or 5.0"
        raise InputError(f"OpenCV {cv2.__version__}", f"tag 0 of {name} {how}: poses would be wrong", expected)


def drawn_tag(bits: int, cells: int) -> tuple[Image, FloatArray]:
    """A tag in a white image, and its corners (4, 2) px from the top left clockwise."""
    inner = np.array([int(bit) for bit in f"{bits:0{cells * cells}b}"], dtype=np.uint8).reshape(cells, cells)
    tag = np.pad(np.pad(255 * inner, 1), 2, constant_values=255)
    low, high = 2 * CELL_PX - 0.5, (4 + cells) * CELL_PX - 0.5
    corners = np.array([[low, low], [high, low], [high, high], [low, high]])
    return np.kron(tag, np.ones((CELL_PX, CELL_PX), dtype=np.uint8)), corners


def tag_cells(name: str) -> int:
    """Cells along a tag's side, black border of one cell included."""
    return int(dictionary_named(name).markerSize) + 2


def black_cells(name: str, tag_id: int) -> BoolArray:
    """(n, n) cells of a tag as OpenCV draws it, its black border of one cell included; the first row is the top."""
    cells = tag_cells(name)
    return np.asarray(cv2.aruco.generateImageMarker(dictionary_named(name), tag_id, cells)) < 128


def detector_parameters() -> cv2.aruco.DetectorParameters:
    """Parameters for tags from about 15 px to most of the image, on a light or dark background."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.minDistanceToBorder = 0
    parameters.minMarkerPerimeterRate = 0.02
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    return parameters


def halved(image: npt.NDArray[Any]) -> Image:
    """The image at half its resolution: pixel (x, y) of it is (2 x + 0.5, 2 y + 0.5) of the image."""
    height, width = (size // 2 for size in image.shape[:2])
    whole = image[: 2 * height, : 2 * width]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def find_tags(
    image: Image, dictionary: str, *, shrink: int = 1, faint: bool = False, least_px: float = 0.0
) -> list[FoundTag]:
    """All tags of a dictionary in a grey image (h, w); one id may occur several times.

    Args:
        shrink: search at this fraction of the resolution, 1, 2 or 4: enough for tags of about 20 px there.
        faint: search at lower contrast, for blurred or noisy tags.
        least_px: side of the smallest tag to be found, where that is known: what is much smaller is not looked at.
    """
    for _ in range(shrink.bit_length() - 1):
        image = halved(image)
    border = BORDER_PX // shrink
    padded = cv2.copyMakeBorder(image, border, border, border, border, cv2.BORDER_REPLICATE)
    parameters = detector_parameters()
    if faint:
        parameters.adaptiveThreshConstant = 3.0
    if least_px:
        least_rate = 0.5 * 4.0 * least_px / shrink / max(padded.shape)  # of the perimeter
        parameters.minMarkerPerimeterRate = max(parameters.minMarkerPerimeterRate, least_rate)
        # The widest window, 23 px, finds the paper's outline too, and to reject that takes most of the time.
        parameters.adaptiveThreshWinSizeMax = 13
    detector = cv2.aruco.ArucoDetector(dictionary_named(dictionary), parameters)
    corners, ids, _ = detector.detectMarkers(padded)
    if ids is None:
        return []
    # ids: (n,) in OpenCV 5, (n, 1) in 4.
    return [
        FoundTag(int(tag_id), (np.asarray(c, dtype=np.float64).reshape(4, 2) + 0.5) * shrink - 0.5 - BORDER_PX)
        for tag_id, c in zip(np.asarray(ids).ravel(), corners, strict=True)
    ]
