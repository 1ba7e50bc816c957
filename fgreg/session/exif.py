"""The orientation that a picture file states of itself (EXIF tag 274).

A camera's calibration is of the pixels as its sensor has them. Some readers turn a picture as the tag says and some do
not, so pictures that are not upright are refused. Reads PNG, JPEG, WebP and TIFF by their structure, no pixels.
"""

from __future__ import annotations

import struct

UPRIGHT = 1
_ORIENTATION = 0x0112


def orientation(data: bytes) -> int:
    """Of a picture file's bytes: 1 to 8; UPRIGHT where it states none."""
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return _of_chunks(data, 8, ">I4s", 4, b"eXIf")
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return _of_chunks(data, 12, "<4sI", 0, b"EXIF")
    if data[:2] == b"\xff\xd8":
        return _of_segments(data)
    return orientation_in(data)


def orientation_in(tiff: bytes) -> int:
    """Of a TIFF structure, which is what EXIF data are; UPRIGHT where it is none, or states none."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(tiff[:4])
    if order is None or len(tiff) < 10:
        return UPRIGHT
    (at,) = struct.unpack_from(order + "I", tiff, 4)
    if at + 2 > len(tiff):
        return UPRIGHT
    (count,) = struct.unpack_from(order + "H", tiff, at)
    for entry in range(at + 2, min(at + 2 + 12 * count, len(tiff) - 11), 12):
        tag, _, _, value = struct.unpack_from(order + "HHIH", tiff, entry)
        if tag == _ORIENTATION:
            return int(value)
    return UPRIGHT


def _of_chunks(data: bytes, at: int, head: str, checksum: int, wanted: bytes) -> int:
    while at + 8 <= len(data):
        fields = struct.unpack_from(head, data, at)
        kind, length = (fields[1], fields[0]) if isinstance(fields[1], bytes) else fields
        if kind == wanted:
            return orientation_in(data[at + 8 : at + 8 + length].removeprefix(b"Exif\0\0"))
        at += 8 + length + checksum + (0 if checksum else length % 2)
    return UPRIGHT


def _of_segments(data: bytes) -> int:
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        (length,) = struct.unpack_from(">H", data, at + 2)
        if data[at + 1] == 0xE1 and data[at + 4 : at + 10] == b"Exif\0\0":
            return orientation_in(data[at + 10 : at + 2 + length])
        at += 2 + max(length, 2)
    return UPRIGHT
