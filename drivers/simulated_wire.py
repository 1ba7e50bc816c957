"""Messages between the simulated room's process and the drivers of its devices: a JSON header and raw bytes.

One message is two little-endian lengths (4 bytes each), the header, the payload. Both ends are this package, on one
machine, over a Unix socket in a folder that only this user can access.
"""

from __future__ import annotations

import json
import socket
import struct
from typing import Any

_LENGTHS = struct.Struct("<II")
MOST_HEADER, MOST_PAYLOAD = 1 << 16, 1 << 26


class WireClosed(Exception):  # noqa: N818
    """The other end has closed the connection, or sent an invalid message."""


def send(connection: socket.socket, header: dict[str, Any], *payload: bytes | memoryview) -> None:
    """Send one message.

    Raises:
        WireClosed: the other end has closed the connection.
    """
    text = json.dumps(header, allow_nan=False).encode()
    try:
        connection.sendall(_LENGTHS.pack(len(text), sum(len(part) for part in payload)) + text)
        for part in payload:
            connection.sendall(part)
    except OSError as error:
        raise WireClosed(str(error)) from None


def receive(connection: socket.socket) -> tuple[dict[str, Any], bytearray]:
    """The next message, waiting for it.

    Raises:
        WireClosed: the other end has closed the connection, or sent an invalid message.
    """
    header_length, payload_length = _LENGTHS.unpack(_read(connection, _LENGTHS.size))
    if header_length > MOST_HEADER or payload_length > MOST_PAYLOAD:
        raise WireClosed("a message of impossible size")
    try:
        header = json.loads(_read(connection, header_length))
    except (ValueError, RecursionError):
        raise WireClosed("a header that is not JSON") from None
    if not isinstance(header, dict):
        raise WireClosed("a header that is no mapping")
    return header, _read(connection, payload_length)


def _read(connection: socket.socket, count: int) -> bytearray:
    data = bytearray(count)
    view, done = memoryview(data), 0
    while done < count:
        try:
            # In one call if possible, since each call waits for the interpreter's lock again.
            got = connection.recv_into(view[done:], 0, socket.MSG_WAITALL)
        except OSError as error:
            raise WireClosed(str(error)) from None
        if got == 0:
            raise WireClosed("the connection was closed")
        done += got
    return data
