"""A BK scanner's OEM port, as far as the driver needs it; the framing works byte by byte and shares no code with it."""

from __future__ import annotations

import socket
import struct
import threading

import numpy as np
import numpy.typing as npt


def frame(payload: bytes) -> bytes:
    """A payload as bytes on the wire."""
    out = bytearray([1])
    for byte in payload:
        if byte in (1, 4, 27):
            out += bytes([27, 255 - byte])
        else:
            out.append(byte)
    out.append(4)
    return bytes(out)


class Unframer:
    """Payloads from the wire, one byte at a time."""

    def __init__(self) -> None:
        self._payload: bytearray | None = None
        self._inverted = False

    def feed(self, data: bytes) -> list[bytes]:
        found = []
        for byte in data:
            if byte == 1:
                self._payload, self._inverted = bytearray(), False
            elif self._payload is None:
                raise AssertionError(f"byte {byte} outside of a message")
            elif byte == 4:
                found.append(bytes(self._payload))
                self._payload = None
            elif byte == 27:
                self._inverted = True
            else:
                self._payload.append(255 - byte if self._inverted else byte)
                self._inverted = False
        return found


def grabbed(pixels: npt.NDArray[np.uint8], ticks: int = 0) -> bytes:
    """The payload of a grabbed frame."""
    data = struct.pack("<I", ticks) + pixels.tobytes()
    digits = str(len(data)).encode()
    return b"DATA:GRAB_FRAME #" + str(len(digits)).encode() + digits + data + b";"


class Scanner:
    """Answers queries; grabbed frames are sent when the test asks for them.

    Attributes:
        window: columns, rows.
        received: every payload, in order.
        grabbing: the argument of the last GRAB_FRAME.
    """

    def __init__(self) -> None:
        self.window = (6, 4)
        self.received: list[bytes] = []
        self.grabbing = b""
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._server.getsockname()[1])
        self._peer: socket.socket | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def answers(self) -> dict[bytes, bytes]:
        """By query."""
        columns, rows = self.window
        return {
            b"QUERY:US_WIN_SIZE;": b"DATA:US_WIN_SIZE %d,%d;" % (columns, rows),
            b"QUERY:B_GEOMETRY_PIXEL:A;": b"DATA:B_GEOMETRY_PIXEL:A 100,50,500,450;",
            b"QUERY:B_GEOMETRY_TISSUE:A;": b"DATA:B_GEOMETRY_TISSUE:A -0.02,0.001,0.02,0.081;",
            b"QUERY:B_GEOMETRY_US_FRAME_GRAB:A;": b"DATA:B_GEOMETRY_US_FRAME_GRAB:A 90,40,%d,%d;"
            % (90 + columns, 40 + rows),
        }

    def send(self, payload: bytes) -> None:
        self.send_raw(frame(payload))

    def send_raw(self, data: bytes) -> None:
        assert self._peer is not None
        self._peer.sendall(data)

    def hang_up(self) -> None:
        """As a scanner that is switched off; it answers again at once."""
        assert self._peer is not None
        self.grabbing = b""
        self._peer.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        if self._peer is not None:
            self._peer.close()
        self._thread.join(timeout=5.0)

    def _run(self) -> None:
        while True:
            try:
                peer, _ = self._server.accept()
            except OSError:
                return
            self._peer = peer
            unframer = Unframer()
            with peer:
                try:
                    while data := peer.recv(4096):
                        for payload in unframer.feed(data):
                            self._answer(payload)
                except OSError:
                    pass

    def _answer(self, payload: bytes) -> None:
        self.received.append(payload)
        if payload.startswith(b"QUERY:GRAB_FRAME"):
            self.send(b"ACK;")
            self.grabbing = payload
        elif payload.startswith(b"CONFIG:"):
            self.send(b"ACK;")
        else:
            self.send(self.answers().get(payload, b"ERROR:NOT_KNOWN;"))
