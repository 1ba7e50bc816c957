"""The part of Thorlabs' APT protocol that one DC servo cube with a rotation stage needs: packing, and a parser.

A message is six bytes (id, then two parameters or the length of what follows, destination, source), little endian, with
bit 7 of the destination set where data follow. There is no checksum. Source: Thorlabs, "APT Communications Protocol".

The parser tolerates lost bytes: bytes that cannot be a message are skipped one by one. So is a message that names
another channel, or that is followed by bytes that cannot begin a message: its end was lost, and it contains the
beginning of the next one. A message that is not known here may follow, and is skipped.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from fgreg.errors import one_line

HOST, CUBE, CHANNEL = 0x01, 0x50, 1

NO_FLASH, SET_ENABLE, REQ_INFO, GET_INFO = 0x0018, 0x0210, 0x0005, 0x0006
SET_VELOCITY, REQ_VELOCITY, GET_VELOCITY = 0x0413, 0x0414, 0x0415
SET_HOME, REQ_HOME, GET_HOME = 0x0440, 0x0441, 0x0442
MOVE_HOME, HOMED, MOVE_ABSOLUTE, MOVE_COMPLETED, MOVE_STOP, STOPPED = 0x0443, 0x0444, 0x0453, 0x0464, 0x0465, 0x0466
REQ_STATUS, GET_STATUS, GET_OTHER_STATUS, GET_STATUS_BITS = 0x0490, 0x0491, 0x0481, 0x042A
GET_POSITION = 0x0412
ERROR, ERROR_WITH_NOTES = 0x0080, 0x0081
STOP_AT_ONCE = 1

MOVING_BITS, HOMING_BIT, HOMED_BIT = 0x000000F0, 0x00000200, 0x00000400
MOTION_ERROR_BIT, OVERLOAD_BIT, ENABLED_BIT = 0x00004000, 0x01000000, 0x80000000

_HEADER_BYTES, _STATUS_BYTES, _MOST_BYTES = 6, 14, 255
_LONG_STATUS_BYTES = 28
"""A status of newer controllers: as the short one, then as much again for a second channel."""
_MOST_ID = 0x0FFF
_DATA_BYTES: dict[int, tuple[int, ...]] = {
    **{GET_INFO: (84,), GET_VELOCITY: (14,), GET_HOME: (14,), GET_POSITION: (6,), GET_STATUS_BITS: (6,)},
    **dict.fromkeys((GET_STATUS, GET_OTHER_STATUS), (_STATUS_BYTES, _LONG_STATUS_BYTES)),
    **dict.fromkeys((MOVE_COMPLETED, STOPPED), (0, _STATUS_BYTES, _LONG_STATUS_BYTES)),
    **{HOMED: (0,), ERROR: (0,), ERROR_WITH_NOTES: (68,)},
}
"""Messages of the cube that are understood, with their possible numbers of data bytes."""
_WITHOUT_CHANNEL = (GET_INFO, ERROR_WITH_NOTES)


@dataclass(frozen=True, slots=True)
class AptMessage:
    """One message of the cube: ``data`` is empty for the short ones, which have a ``parameter``."""

    id: int
    data: bytes
    parameter: int = 0

    @property
    def is_status(self) -> bool:
        """Whether it has a position and status bits."""
        return self.id in (GET_STATUS, GET_OTHER_STATUS, MOVE_COMPLETED, STOPPED) and bool(self.data)


@dataclass(frozen=True, slots=True)
class CubeStatus:
    """Position in encoder counts, and the status bits."""

    position: int
    bits: int


@dataclass(frozen=True, slots=True)
class HomeSettings:
    """The cube's homing settings, in its own units."""

    direction: int
    switch: int
    velocity: int
    offset: int


def short(message_id: int, first: int = 0, second: int = 0) -> bytes:
    """A message without data."""
    return struct.pack("<HBBBB", message_id, first, second, CUBE, HOST)


def long(message_id: int, data: bytes) -> bytes:
    """A message with data."""
    return struct.pack("<HHBB", message_id, len(data), CUBE | 0x80, HOST) + data


def move_absolute(position: int) -> bytes:
    """Turn to a position (counts)."""
    return long(MOVE_ABSOLUTE, struct.pack("<Hi", CHANNEL, position))


def set_velocity(acceleration: int, velocity: int) -> bytes:
    """Acceleration and highest velocity, the cube's units."""
    return long(SET_VELOCITY, struct.pack("<Hiii", CHANNEL, 0, acceleration, velocity))


def set_home(settings: HomeSettings) -> bytes:
    """Set the homing settings."""
    fields = (settings.direction, settings.switch, settings.velocity, settings.offset)
    return long(SET_HOME, struct.pack("<HHHii", CHANNEL, *fields))


def read_status(data: bytes) -> CubeStatus:
    """Read a status message's data: the first channel's."""
    _, position, _, bits = struct.unpack_from("<HiII", data)
    return CubeStatus(position, bits)


def read_status_bits(data: bytes) -> int:
    """The status bits that come without a position."""
    return int(struct.unpack("<HI", data)[1])


def read_error(message: AptMessage) -> str:
    """What an error message says, as one line."""
    if not message.data:
        return f"code {message.parameter}" if message.parameter else "without a code"
    about, code, notes = struct.unpack("<HH64s", message.data)
    words = one_line(notes.split(b"\0")[0].decode("ascii", "replace").strip()) or "without a text"
    return f"code {code}, {words}" + (f", about message 0x{about:04X}" if about else "")


def read_velocity(data: bytes) -> tuple[int, int]:
    """Acceleration and highest velocity."""
    _, _, acceleration, velocity = struct.unpack("<Hiii", data)
    return acceleration, velocity


def read_home(data: bytes) -> HomeSettings:
    """Read the homing settings."""
    _, direction, switch, velocity, offset = struct.unpack("<HHHii", data)
    return HomeSettings(direction, switch, velocity, offset)


def read_model(data: bytes) -> str:
    """Model name of the cube."""
    return data[4:12].split(b"\0")[0].decode("ascii", "replace").strip()


def read_serial(data: bytes) -> int:
    """Serial number of the cube."""
    return int(struct.unpack_from("<I", data)[0])


class AptParser:
    """Parses bytes into messages; keeps incomplete ones.

    Attributes:
        skipped: number of bytes skipped.
    """

    def __init__(self) -> None:
        self._buffer = b""
        self.skipped = 0

    def feed(self, data: bytes) -> list[AptMessage]:
        """Messages that are complete now."""
        self._buffer += data
        found = []
        while len(self._buffer) >= _HEADER_BYTES:
            message_id, parameter, destination, _ = struct.unpack_from("<HHBB", self._buffer)
            follows = parameter if destination & 0x80 else 0
            size = _HEADER_BYTES + follows
            known = follows in _DATA_BYTES.get(message_id, ()) and _is_header(self._buffer)
            if known and len(self._buffer) < size:
                break
            data, rest = self._buffer[_HEADER_BYTES:size], self._buffer[size:]
            whole = known and _names_channel(message_id, data)
            follower_known = len(rest) >= 2 and struct.unpack_from("<H", rest)[0] in _DATA_BYTES
            if whole and 0 < len(rest) < _HEADER_BYTES and not follower_known:
                break  # too little of what follows to tell
            if whole and (not rest or follower_known or _is_header(rest)):
                found.append(AptMessage(message_id, data, 0 if follows else parameter))
                self._buffer = rest
            else:
                self._buffer = self._buffer[1:]
                self.skipped += 1
        return found


def _names_channel(message_id: int, data: bytes) -> bool:
    return not data or message_id in _WITHOUT_CHANNEL or struct.unpack_from("<H", data)[0] == CHANNEL


def _is_header(data: bytes) -> bool:
    """Whether six bytes can be the header of any message of the cube's to the host."""
    message_id, length, destination, source = struct.unpack_from("<HHBB", data)
    fits = not destination & 0x80 or length <= _MOST_BYTES
    return 0 < message_id <= _MOST_ID and source == CUBE and destination & 0x7F in (0, HOST) and fits
