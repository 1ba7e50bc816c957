"""OpenIGTLink by the protocol's text, written for tests: shares no code with the drivers or with pyigtl."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

HEADER = ">H12s20sIIQQ"
SCALARS = {"i1": 2, "u1": 3, "i2": 4, "u2": 5, "i4": 6, "u4": 7, "f4": 10, "f8": 11}
POLYNOMIAL = 0x42F0E1EBA9EA3693


def _table() -> list[int]:
    table = []
    for byte in range(256):
        value = byte << 56
        for _ in range(8):
            value = ((value << 1) ^ (POLYNOMIAL if value >> 63 else 0)) & 0xFFFFFFFFFFFFFFFF
        table.append(value)
    return table


TABLE = _table()


def crc64(data: bytes) -> int:
    """ECMA-182, most significant bit first, from 0."""
    value = 0
    for byte in data:
        value = ((value << 8) & 0xFFFFFFFFFFFFFFFF) ^ TABLE[(value >> 56) ^ byte]
    return value


def transform_body(matrix: npt.NDArray[np.float64]) -> bytes:
    """Columns of the rotation, then the translation."""
    return struct.pack(">12f", *matrix[:3, :3].T.ravel(), *matrix[:3, 3])


def image_body(
    pixels: npt.NDArray[Any],
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0),
    scalar: int | None = None,
    size: tuple[int, int, int] | None = None,
    start: tuple[int, int, int] = (0, 0, 0),
) -> bytes:
    """An image (k, j, i) of one component; or a part of one of ``size``, from ``start`` on, both (k, j, i)."""
    k, j, i = pixels.shape
    order = 1 if pixels.dtype.byteorder == ">" else 2
    kind = SCALARS[pixels.dtype.str[1:]] if scalar is None else scalar
    axes = [spacing[0], 0, 0, 0, spacing[1], 0, 0, 0, spacing[2]]
    whole = (size or (k, j, i))[::-1]
    head = struct.pack(">HBBBB3H12f6H", 1, 1, kind, order, 1, *whole, *axes, 0, 0, 0, *start[::-1], i, j, k)
    return head + pixels.tobytes()


def message(
    kind: str,
    device: str,
    content: bytes,
    version: int = 1,
    metadata: Mapping[str, str] | None = None,
    sent_s: float = 0.0,
    checksum: int | None = None,
    extended: tuple[int, int, int] | None = None,
) -> bytes:
    """A message; ``checksum`` and ``extended`` (sizes of extended header, metadata header, metadata) may be false."""
    body = content
    if version == 2:
        pairs = [(key.encode(), value.encode()) for key, value in (metadata or {}).items()]
        index = struct.pack(">H", len(pairs)) + b"".join(struct.pack(">HHI", len(k), 106, len(v)) for k, v in pairs)
        data = b"".join(k + v for k, v in pairs)
        sizes = extended or (12, len(index), len(data))
        body = struct.pack(">HHII", *sizes, 0) + content + index + data
    seconds = int(sent_s)
    fraction = int((sent_s - seconds) * 2**32)
    crc = crc64(body) if checksum is None else checksum
    return struct.pack(HEADER, version, kind.encode(), device.encode(), seconds, fraction, len(body), crc) + body


@dataclass(frozen=True)
class Told:
    """A message as read."""

    version: int
    kind: str
    device: str
    sent_s: float
    content: bytes
    metadata: dict[str, str]


def read_messages(data: bytes) -> list[Told]:
    """All messages of a stream that is complete and right in every respect; asserts that it is."""
    found = []
    while data:
        version, kind, device, seconds, fraction, size, crc = struct.unpack(HEADER, data[:58])
        body, data = data[58 : 58 + size], data[58 + size :]
        assert len(body) == size
        assert crc64(body) == crc
        metadata = {}
        if version == 2:
            extended, index_size, data_size, _ = struct.unpack(">HHII", body[:12])
            assert extended == 12
            index = body[len(body) - index_size - data_size : len(body) - data_size]
            rest = body[len(body) - data_size :]
            for entry in range(struct.unpack(">H", index[:2])[0]):
                key_size, encoding, value_size = struct.unpack(">HHI", index[2 + 8 * entry : 10 + 8 * entry])
                assert encoding in (3, 106)
                metadata[rest[:key_size].decode()] = rest[key_size : key_size + value_size].decode()
                rest = rest[key_size + value_size :]
            assert not rest
            body = body[12 : len(body) - index_size - data_size]
        name, label = (raw.rstrip(b"\0").decode("ascii") for raw in (kind, device))
        found.append(Told(version, name, label, seconds + fraction / 2**32, body, metadata))
    return found


def read_message(data: bytes) -> Told:
    """The only message of a stream."""
    (only,) = read_messages(data)
    return only


def read_matrix(content: bytes) -> npt.NDArray[np.float64]:
    """A TRANSFORM's content as (4, 4)."""
    values = np.array(struct.unpack(">12f", content))
    matrix = np.eye(4)
    matrix[:3, :3] = values[:9].reshape(3, 3).T
    matrix[:3, 3] = values[9:]
    return matrix
