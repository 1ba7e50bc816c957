"""B-mode pictures of a BK scanner over its OEM interface, for overlay. There is no channel data on it.

A message on the wire is ``0x01 payload 0x04``; the bytes 01, 04 and 1B of a payload are sent as ``1B`` and their
inverse. Payloads are text that ends in ``;``, but for grabbed frames: ``DATA:GRAB_FRAME #6307204`` (one digit: how many
digits follow; those: how many bytes follow), four bytes of a time stamp of no documented unit, the pixels row by row,
``;``.

The driver asks for the window's size and geometry, subscribes to their changes, and asks for frames at a given rate.
Queries and replies are those that PLUS (vtkPlusBkProFocusOemVideoSource) uses with ProFocus and bk5000; tested against
an emulator only.
"""

from __future__ import annotations

import itertools
import math
import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fgreg.drivers.base import BmodeFrame
from fgreg.drivers.stream_decoder import Decoder, Rejections, StreamBroken
from fgreg.drivers.tcp_device import LinkedDevice
from fgreg.drivers.tcp_link import Endpoint, TcpLink
from fgreg.errors import InputError, one_line
from fgreg.model.time_sync import Stamp
from fgreg.schema.limits import BK_MESSAGE_BYTES, BK_SIDE

if TYPE_CHECKING:
    from fgreg.drivers.base import BmodeSource, DriverContext
    from fgreg.drivers.options import BkOptions

START, END, ESCAPE = b"\x01", b"\x04", b"\x1b"
ESCAPED = {bytes([byte]): ESCAPE + bytes([byte ^ 0xFF]) for byte in (0x01, 0x04, 0x1B)}
INVERTED = np.array([pair[1] for pair in ESCAPED.values()], dtype=np.uint8)
STAMP_BYTES = 4
SUBSCRIBED = ("US_WIN_SIZE", "B_GEOMETRY_PIXEL", "B_GEOMETRY_TISSUE", "B_GEOMETRY_US_FRAME_GRAB")
ASKED = ("US_WIN_SIZE", "B_GEOMETRY_PIXEL:A", "B_GEOMETRY_TISSUE:A", "B_GEOMETRY_US_FRAME_GRAB:A")
RECTANGLES = {"B_GEOMETRY_PIXEL": "screen", "B_GEOMETRY_TISSUE": "tissue_m", "B_GEOMETRY_US_FRAME_GRAB": "grabbed"}
FRAME = re.compile(rb"DATA:GRAB_FRAME #([1-9])")
VALUES = re.compile(r"S?DATA:([A-Z_]+)(?::A)? (.*);")
ASK_AGAIN_S = 1.0


def encode(payload: str) -> bytes:
    """A message as sent."""
    body = payload.encode("ascii").replace(ESCAPE, ESCAPED[ESCAPE])
    for byte in (START, END):
        body = body.replace(byte, ESCAPED[byte])
    return START + body + END


def unescape(body: bytes) -> bytes:
    """The payload of the bytes between 01 and 04. Raises ValueError on an invalid escape."""
    raw = np.frombuffer(body, dtype=np.uint8)
    at = np.flatnonzero(raw == ESCAPE[0])
    if not at.size:
        return body
    if at[-1] == raw.size - 1 or not np.isin(raw[at + 1], INVERTED).all():
        raise ValueError("an escape that is none")
    plain = raw.copy()
    plain[at + 1] = ~raw[at + 1]
    return np.delete(plain, at).tobytes()


@dataclass(frozen=True, slots=True)
class OemMessage:
    """One payload; ``index`` counts the grabbed frames, -1 for the others."""

    payload: bytes
    host_s: float
    index: int

    @property
    def nbytes(self) -> int:
        """Memory held, about."""
        return 256 + len(self.payload)


class OemDecoder(Decoder[OemMessage]):
    """Turns one connection's bytes into payloads. Bytes outside a message and cut-off messages are left out.

    Args:
        rejections: counts what is left out.
        counter: numbers the grabbed frames across connections.
    """

    def __init__(self, rejections: Rejections, counter: Iterator[int]) -> None:
        super().__init__(rejections)
        self._counter = counter
        self._buffer = bytearray()

    @property
    def partial(self) -> bool:
        """Whether a message has begun and is not complete."""
        return bool(self._buffer)

    def feed(self, data: bytes, host_s: float) -> list[OemMessage]:
        """Messages completed by these bytes. Raises StreamBroken if a message is too long."""
        messages = []
        *complete, rest = data.split(END)
        self.completed += len(complete)
        for piece in complete:
            whole, self._buffer = bytes(self._buffer) + piece, bytearray()
            before, start, body = whole.rpartition(START)
            if before or not start:
                self.rejections.add("bytes outside of a message")
            if not start:
                continue
            try:
                payload = unescape(body)
            except ValueError as error:
                self.rejections.add(str(error))
                continue
            grabbed = payload.startswith(b"DATA:GRAB_FRAME")
            messages.append(OemMessage(payload, host_s, next(self._counter) if grabbed else -1))
        self._buffer += rest
        if self._buffer and START not in self._buffer:
            self.rejections.add("bytes outside of a message")
            self._buffer.clear()
        if len(self._buffer) > BK_MESSAGE_BYTES:
            raise StreamBroken(f"no end of a message within {BK_MESSAGE_BYTES} bytes")
        return messages


@dataclass(frozen=True, slots=True)
class _Geometry:
    """Geometry of the scanner's window: in screen pixels, and in metres of tissue."""

    window: tuple[int, int] | None = None  # columns, rows
    screen: tuple[float, ...] | None = None  # left, top, right, bottom of the tissue rectangle
    tissue_m: tuple[float, ...] | None = None  # the same
    grabbed: tuple[float, ...] | None = None  # the same of what is sent

    @property
    def falls(self) -> bool:
        """Whether the lateral position decreases from column to column."""
        if self.screen is None or self.tissue_m is None:
            return False
        return (self.tissue_m[2] < self.tissue_m[0]) != (self.screen[2] < self.screen[0])

    def pixel_mm(self) -> tuple[float, float] | None:
        """Pixel size along depth and laterally; None if it is unknown or impossible."""
        if self.screen is None or self.tissue_m is None:
            return None
        columns, rows = self.screen[2] - self.screen[0], self.screen[3] - self.screen[1]
        if not (columns and rows):
            return None
        size = (
            1e3 * abs((self.tissue_m[3] - self.tissue_m[1]) / rows),
            1e3 * abs((self.tissue_m[2] - self.tissue_m[0]) / columns),
        )
        return size if all(0.0 < side < 10.0 for side in size) else None

    def origin_mm(self) -> tuple[float, float] | None:
        """Depth and lateral position of the first grabbed pixel's centre, if all rectangles count the same pixels.

        None if it is unknown, or if depth points upwards in the picture.
        """
        size = self.pixel_mm()
        if size is None or self.screen is None or self.tissue_m is None or self.grabbed is None:
            return None
        if (self.tissue_m[3] > self.tissue_m[1]) != (self.screen[3] > self.screen[1]):
            return None
        down, right = self.grabbed[1] - self.screen[1], self.grabbed[0] - self.screen[0]
        lateral = -size[1] if self.falls else size[1]
        return 1e3 * self.tissue_m[1] + down * size[0], 1e3 * self.tissue_m[0] + right * lateral


class BkOemScanner(LinkedDevice[OemMessage]):
    """BmodeSource: a BK scanner.

    The time stamps on the wire have no documented unit, so both times are the host's.

    Args:
        endpoint: the scanner's address; its OEM port is 7915 as a rule.
        rate_hz: pictures per second to ask for.
        silent_s: a scanner that says nothing for this long counts as lost; a frozen picture is silent.
        flip: whether the columns run against TRUS x.
    """

    _role = "BK scanner"

    def __init__(self, endpoint: Endpoint, rate_hz: int = 20, silent_s: float | None = 0.8, flip: bool = False) -> None:
        if endpoint.listen:
            raise InputError("BK scanner", str(endpoint), "an address to connect to")
        if not 1 <= rate_hz <= 100:
            raise InputError("BK scanner: rate_hz", str(rate_hz), "1 to 100")
        watched = ",".join(f'"{name}"' for name in SUBSCRIBED)
        greeting = [f"QUERY:{name};" for name in ASKED]
        greeting += [f"CONFIG:DATA:SUBSCRIBE {watched};", f'QUERY:GRAB_FRAME "ON",{rate_hz};']
        counter = itertools.count()
        super().__init__(
            TcpLink(
                endpoint,
                lambda rejections: OemDecoder(rejections, counter),
                greeting=b"".join(encode(text) for text in greeting),
                farewell=encode('QUERY:GRAB_FRAME "OFF";'),
                silent_s=silent_s,
            )
        )
        self._geometry, self._flip = _Geometry(), flip
        self._asked_s = -math.inf

    def poll(self) -> Sequence[BmodeFrame]:
        """Pictures since the last call. Raises DeviceLost."""
        frames = []
        for message in self._messages():
            try:
                if message.index >= 0:
                    frames.append(self._picture(message))
                else:
                    self._text(message.payload)
            except ValueError as error:
                self._link.rejections.add(str(error))
        return frames

    def _picture(self, message: OemMessage) -> BmodeFrame:
        begin = FRAME.match(message.payload)
        if begin is None:
            raise ValueError("a grabbed frame without its size")
        digits = message.payload[begin.end() : begin.end() + int(begin.group(1))]
        if not (digits.isdigit() and len(digits) == int(begin.group(1))):
            raise ValueError("a grabbed frame without its size")
        data = memoryview(message.payload)[begin.end() + len(digits) :]
        told = int(digits)
        if told > len(data):
            raise ValueError(f"a grabbed frame of {told} bytes of which {len(data)} arrived")
        window = self._geometry.window
        if window is None:
            raise ValueError("a grabbed frame before the size of the window")
        columns, rows = window
        grey = told - STAMP_BYTES == columns * rows
        if not grey and told - STAMP_BYTES != 3 * columns * rows:
            self._ask_again()
            raise ValueError(f"a grabbed frame of {told} bytes for a window of {columns} x {rows}")
        pixels = np.frombuffer(data[STAMP_BYTES:told], dtype=np.uint8)
        image = pixels.reshape((rows, columns) if grey else (rows, columns, 3))
        falls = self._geometry.falls != self._flip  # TRUS x, from column to column
        pixel_mm, origin_mm = self._geometry.pixel_mm(), self._geometry.origin_mm()
        if pixel_mm is not None and origin_mm is not None:
            x_mm = -origin_mm[1] if self._flip else origin_mm[1]
            origin_mm = (origin_mm[0], x_mm - (columns - 1) * pixel_mm[1] if falls else x_mm)
        stamp = Stamp(message.host_s, message.host_s)
        return BmodeFrame(stamp, (image[:, ::-1] if falls else image).copy(), message.index, pixel_mm, origin_mm)

    def _ask_again(self) -> None:
        """Ask for the geometry again after an unannounced change of the window."""
        now = time.monotonic()
        if now - self._asked_s > ASK_AGAIN_S:
            self._asked_s = now
            self._link.offer(b"".join(encode(f"QUERY:{name};") for name in ASKED))

    def _text(self, payload: bytes) -> None:
        text = payload.decode("ascii", "replace")
        if text.startswith(("ACK", "EVENT", "ALIVE")):
            return
        told = VALUES.fullmatch(text)
        if told is None:
            raise ValueError(f"not understood: {one_line(text, 60)}")
        name, values = told.group(1), told.group(2)
        if name == "US_WIN_SIZE":
            columns, rows = (int(value) for value in _numbers(values, 2))
            if not (1 <= columns <= BK_SIDE and 1 <= rows <= BK_SIDE):
                raise ValueError(f"a window of {columns} x {rows}")
            self._geometry = replace(self._geometry, window=(columns, rows))
        elif name in RECTANGLES:
            told_of: dict[str, Any] = {RECTANGLES[name]: _numbers(values, 4)}
            self._geometry = replace(self._geometry, **told_of)


def _numbers(text: str, count: int) -> tuple[float, ...]:
    """The first ``count`` of a list of numbers. Raises ValueError."""
    numbers = tuple(float(value) for value in text.split(",")[:count])
    if len(numbers) != count or not all(math.isfinite(number) for number in numbers):
        raise ValueError(f"not {count} numbers: {one_line(text, 60)}")
    return numbers


def open_scanner(_context: DriverContext, options: BkOptions) -> BmodeSource:
    """Pictures of a BK scanner."""
    return BkOemScanner(Endpoint(options.host, options.port), options.rate_hz, options.silent_s, options.flip)
