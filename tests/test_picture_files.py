"""Pictures as files hold them: depth, palettes, transparency, orientation. Each is right, or refused by name."""

from __future__ import annotations

import struct
import time
import zlib
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from fgreg.detection.frame_files import Picture, decode_picture, png_bytes
from fgreg.drivers.base import DeviceLost
from fgreg.drivers.endoscope import Endoscope, EndoscopeConfig, InputConfig
from fgreg.errors import InputError
from fgreg.session.frame_files import check_camera_frame

GREY = np.arange(0, 240, 10, dtype=np.uint8).reshape(4, 6)
TURNED = b"II*\0\x08\0\0\0\x01\0" + struct.pack("<HHII", 0x0112, 3, 1, 6) + b"\0\0\0\0"
UPRIGHT = TURNED.replace(struct.pack("<HHII", 0x0112, 3, 1, 6), struct.pack("<HHII", 0x0112, 3, 1, 1))


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(array: npt.NDArray[np.generic], colour: int, depth: int, *extra: tuple[bytes, bytes]) -> bytes:
    """A PNG file by the standard: rows of one filter, ``extra`` chunks before the pixels."""
    rows = array.astype(array.dtype.newbyteorder(">")) if depth == 16 else array
    data = b"".join(b"\0" + row.tobytes() for row in rows)
    head = struct.pack(">IIBBBBB", array.shape[1], array.shape[0], depth, colour, 0, 0, 0)
    chunks = [(b"IHDR", head), *extra, (b"IDAT", zlib.compress(data)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*entry) for entry in chunks)


def opaque(array: npt.NDArray[np.generic], alpha: int) -> npt.NDArray[np.generic]:
    return np.concatenate([array, np.full((*array.shape[:2], 1), alpha, array.dtype)], axis=2)


COLOUR = np.stack([GREY, GREY + 1, GREY + 2], axis=-1)
DEEP = GREY.astype(np.uint16) * 257 + 3


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (png(DEEP, 0, 16), DEEP),
        (png(COLOUR, 2, 8), COLOUR[..., ::-1]),
        (png(opaque(COLOUR, 255), 6, 8), COLOUR[..., ::-1]),
        (png(opaque(COLOUR.astype(np.uint16) * 200, 65535), 6, 16), COLOUR[..., ::-1].astype(np.uint16) * 200),
        (png(GREY // 10, 3, 8, (b"PLTE", bytes(range(72)))), (GREY // 10 * 3)[..., None] + np.array([2, 1, 0])),
        (png(GREY, 0, 8, (b"eXIf", UPRIGHT)), GREY),
    ],
)
def test_pictures_are_read_as_they_are_stored(data: bytes, expected: npt.NDArray[np.generic]) -> None:
    found = decode_picture(data, "a.png")
    assert found is not None
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == (np.uint16 if expected.dtype == np.uint16 else np.uint8)


def jpeg(exif: bytes) -> bytes:
    data = bytes(cv2.imencode(".jpg", np.full((16, 32), 80, np.uint8))[1])
    segment = b"\xff\xe1" + struct.pack(">H", 8 + len(exif)) + b"Exif\0\0" + exif
    return data[:2] + segment + data[2:]


def webp(exif: bytes) -> bytes:
    data = bytes(cv2.imencode(".webp", np.full((16, 32, 3), 80, np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 101])[1])
    extended = b"VP8X" + struct.pack("<IB3x", 10, 0x08) + (31).to_bytes(3, "little") + (15).to_bytes(3, "little")
    body = b"WEBP" + extended + data[12:] + b"EXIF" + struct.pack("<I", len(exif)) + exif
    return b"RIFF" + struct.pack("<I", len(body)) + body


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (png(opaque(COLOUR, 254), 6, 8), "a picture with transparent parts"),
        (png(GREY // 10, 3, 8, (b"PLTE", bytes(range(72))), (b"tRNS", bytes([0]))), "a picture with transparent parts"),
        (png(GREY, 0, 8, (b"eXIf", TURNED)), "a picture with EXIF orientation 6"),
        (jpeg(TURNED), "a picture with EXIF orientation 6"),
        (webp(TURNED), "a picture with EXIF orientation 6"),
    ],
)
def test_pictures_that_are_not_what_the_sensor_has_are_refused_by_name(data: bytes, message: str) -> None:
    with pytest.raises(InputError, match=f"a: found {message}"):
        decode_picture(data, "a")


def test_upright_pictures_of_other_formats_are_read() -> None:
    for data in (jpeg(UPRIGHT), webp(UPRIGHT), bytes(cv2.imencode(".tif", GREY)[1])):
        assert decode_picture(data, "a") is not None
    assert decode_picture(b"", "a") is None
    assert decode_picture(b"\xff\xd8\xff\xe1\0\0", "a") is None


def test_check_refuses_a_turned_frame_without_reading_its_pixels(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(png(GREY, 0, 8, (b"eXIf", TURNED)))
    with pytest.raises(InputError, match=r"'a\.png' with EXIF orientation 6, expected pixels as the sensor has them"):
        check_camera_frame(path, "a.png", "line 1", None)
    path.write_bytes(png(GREY, 0, 8, (b"eXIf", UPRIGHT)))
    check_camera_frame(path, "a.png", "line 1", (6, 4))


def played(folder: Path) -> tuple[list[Picture], str]:
    """All pictures of a folder that is played as an endoscope, and why it ended."""
    device = Endoscope(EndoscopeConfig(left=InputConfig(str(folder), fps=200.0)))
    found: list[Picture] = []
    until = time.monotonic() + 5.0
    try:
        while time.monotonic() < until:
            found += [frame.left for frame in device.poll()]
            time.sleep(0.001)
    except DeviceLost as lost:
        return found, str(lost)
    finally:
        device.close()
    raise AssertionError("no end")


def test_a_folder_of_deep_pictures_is_played_with_their_depth_and_a_turned_one_ends_it(tmp_path: Path) -> None:
    for number in range(3):
        (tmp_path / f"{number}.png").write_bytes(png_bytes(DEEP + np.uint16(number)))
    (tmp_path / "3.png").write_bytes(png(DEEP, 0, 16, (b"eXIf", TURNED)))
    found, why = played(tmp_path)
    assert "3.png: found a picture with EXIF orientation 6" in why
    for number, picture in enumerate(found):
        np.testing.assert_array_equal(picture, DEEP + number)
    assert len(found) == 3
    (tmp_path / "0.png").write_bytes(png(DEEP, 0, 16, (b"eXIf", TURNED)))
    with pytest.raises(InputError, match=r"0\.png: found a picture with EXIF orientation 6"):
        played(tmp_path)


def test_pictures_of_a_folder_that_cannot_be_decoded_are_told_and_counted(tmp_path: Path) -> None:
    for number in range(4):
        (tmp_path / f"{number}.png").write_bytes(png_bytes(GREY) if number % 3 == 0 else b"no picture")
    found, why = played(tmp_path)
    assert len(found) == 2
    assert "played to its end; 2 pictures could not be decoded, 1.png first" in why
