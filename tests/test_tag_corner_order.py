"""A version of OpenCV that reads tags in another orientation is refused: checked on tags drawn from bits kept here."""

from __future__ import annotations

import time

import cv2
import numpy as np
import pytest

from fgreg.detection.tags import check_corner_order, dictionary_named, drawn_tag
from fgreg.errors import InputError
from fgreg.model.session_model import DICTIONARY_SIZES

APRILTAG_36H11_0 = 0xD5D628584
"""Tag 0 as its makers publish it, row by row from the top left."""
HALF_TURNED = int(f"{APRILTAG_36H11_0:036b}"[::-1], 2)


def test_every_dictionary_is_read_as_it_is_drawn() -> None:
    for name in DICTIONARY_SIZES:
        assert len(dictionary_named(name).bytesList) == len(
            cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList
        )


def test_official_april_tags_come_half_turned_and_a_version_that_turns_them_is_refused() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    start = time.perf_counter()
    check_corner_order(dictionary, HALF_TURNED, "DICT_APRILTAG_36h11")
    assert time.perf_counter() - start < 0.1  # 1 ms on a machine that is not busy
    # What a version that takes the tags as published would be to this one.
    with pytest.raises(InputError, match=r"found tag 0 of X turned by 180 deg: poses would be wrong"):
        check_corner_order(dictionary, APRILTAG_36H11_0, "X")
    image, _ = drawn_tag(HALF_TURNED, 6)
    quarter = np.rot90(image[16:-16, 16:-16][8:-8, 8:-8][::8, ::8] > 127)
    bits = int("".join(str(int(bit)) for bit in quarter.ravel()), 2)
    with pytest.raises(InputError, match=r"turned by (90|270) deg"):
        check_corner_order(dictionary, bits, "X")
    with pytest.raises(InputError, match="not where it is"):
        check_corner_order(dictionary, 0, "X")
