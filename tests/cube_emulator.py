"""A KDC101 with a PRM1Z8 at the other end of a pty, checked by an independent protocol library: orders are read by its
parsers or compared with its packed messages, replies have to pass through its unpacker."""

from __future__ import annotations

import os
import select
import struct
import threading
import time
import tty
from typing import Any

import thorlabs_apt_protocol as library
from thorlabs_apt_protocol.functions import _pack
from thorlabs_apt_protocol.parsing import id_to_func
from thorlabs_apt_protocol.unpacker import Unpacker

COUNTS_PER_DEG = 1919.6418578623391
VELOCITY_PER_DEG_S, ACCELERATION_PER_DEG_S2 = 42941.66, 14.66
_TO_CUBE = {"dest": 0x50, "source": 0x01}
_SHORT = {
    0x0018: library.hw_no_flash_programming(**_TO_CUBE),
    0x0005: library.hw_req_info(**_TO_CUBE),
    0x0210: library.mod_set_chanenablestate(**_TO_CUBE, chan_ident=1, enable_state=1),
    0x0414: library.mot_req_velparams(**_TO_CUBE, chan_ident=1),
    0x0441: library.mot_req_homeparams(**_TO_CUBE, chan_ident=1),
    0x0443: library.mot_move_home(**_TO_CUBE, chan_ident=1),
    0x0465: library.mot_move_stop(**_TO_CUBE, chan_ident=1, stop_mode=1),
    0x0490: library.mot_req_dcstatusupdate(**_TO_CUBE, chan_ident=1),
}
_READ_AS = {0x0413: 0x0415, 0x0440: 0x0442, 0x0453: 0x0452}
"""Orders with data have the layout of the replies that the library knows."""


class CubeEmulator:
    """Runs in a thread of its own; change its public attributes to cause faults.

    Attributes:
        device_deg: true angle of the stage.
        orders: (name, value) of each order received.
        complaints: messages that the library would not have sent.
        drop: share of replies that get lost, every n-th: 0 none, 2 every second, 1 all.
        garbage: bytes sent before every reply.
        deaf_to_velocity: whether set velocities are ignored.
        behind: bytes sent right behind the next reply, once.
        status_id: of the reply to a request for a status; ``status_more``: bytes at its end, of a second channel.
        claims_rest: its moving bits never come on.
    """

    def __init__(self, device_deg: float = 0.0, model: bytes = b"KDC101\0\0") -> None:
        self.device_deg, self.model = device_deg, model
        self.orders: list[tuple[str, float]] = []
        self.complaints: list[str] = []
        self.drop, self.garbage, self.deaf_to_velocity, self.extra_bits = 0, b"", False, 0
        self.behind, self.status_id, self.status_more, self.claims_rest = b"", 0x0491, b"", False
        self.speed_deg_s, self.home_speed_deg_s, self.enabled, self.homed = 25.0, 10.0, False, False
        self._offset = -device_deg
        self._target: float | None = None
        self._homing = False
        self._rate = 0.0
        self._replies = 0
        self._at = time.monotonic()
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        self._slave: int | None = slave
        self._in = b""
        self._stop = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Pull the plug."""
        self._stop = True
        self._thread.join()
        for fd in (self._master, self._slave):
            if fd is not None:
                os.close(fd)
        self._master, self._slave = -1, None

    def _run(self) -> None:
        while not self._stop:
            self._turn()
            if select.select([self._master], [], [], 0.002)[0]:
                self._in += os.read(self._master, 4096)
                self._read()

    def _turn(self) -> None:
        now = time.monotonic()
        step = self._rate * (now - self._at)
        self._at = now
        if self._target is None:
            return
        way = self._target - self.device_deg
        if abs(way) > step:
            self.device_deg += step if way > 0 else -step
            return
        self.device_deg, self._target = self._target, None
        if self._homing:
            self._homing, self.homed, self._offset = False, True, 0.0
            self._reply(_pack(0x0444, 0x01, 0x50, param1=1))
        else:
            self._reply(_pack(0x0464, 0x01, 0x50, data=self._status_data()))

    def _read(self) -> None:
        while len(self._in) >= 6:
            message_id, length = struct.unpack_from("<HH", self._in)
            size = 6 + (length if self._in[4] & 0x80 else 0)
            if len(self._in) < size:
                return
            message, self._in = self._in[:size], self._in[size:]
            if message_id in _READ_AS:
                other = _READ_AS[message_id]
                fields = id_to_func[other](struct.pack("<H", other) + message[2:])
                self._order(message_id, fields, message)
            elif _SHORT.get(message_id) == message:
                self._short(message_id)
            else:
                self.complaints.append(f"unknown message {message.hex()}")

    def _order(self, message_id: int, fields: dict[str, Any], message: bytes) -> None:
        if message_id == 0x0413:
            again = library.mot_set_velparams(
                **_TO_CUBE,
                chan_ident=1,
                min_velocity=fields["min_velocity"],
                acceleration=fields["acceleration"],
                max_velocity=fields["max_velocity"],
            )
            if not self.deaf_to_velocity:
                self.speed_deg_s = fields["max_velocity"] / VELOCITY_PER_DEG_S
            self.orders.append(("velocity", fields["max_velocity"] / VELOCITY_PER_DEG_S))
        elif message_id == 0x0440:
            again = library.mot_set_homeparams(
                **_TO_CUBE,
                chan_ident=1,
                home_dir=fields["home_dir"],
                limit_switch=fields["limit_switch"],
                home_velocity=fields["home_velocity"],
                offset_distance=fields["offset_distance"],
            )
            if (fields["home_dir"], fields["limit_switch"], fields["offset_distance"]) != (2, 1, 7680):
                self.complaints.append(f"changed how the zero is found: {fields}")
            self.home_speed_deg_s = fields["home_velocity"] / VELOCITY_PER_DEG_S
        else:
            again = library.mot_move_absolute(**_TO_CUBE, chan_ident=1, position=fields["absolute_position"])
            self.orders.append(("move", fields["absolute_position"] / COUNTS_PER_DEG))
            self._target = fields["absolute_position"] / COUNTS_PER_DEG - self._offset
            self._rate, self._homing = self.speed_deg_s, False
        if again != message:
            self.complaints.append(f"{message.hex()}, the library says {again.hex()}")

    def _short(self, message_id: int) -> None:
        if message_id == 0x0005:
            info = struct.pack("<l8sH4B60sHHH", 27000001, self.model, 16, 1, 2, 3, 0, b"", 1, 0, 1)
            self._reply(_pack(0x0006, 0x01, 0x50, data=info))
        elif message_id == 0x0210:
            self.enabled = True
        elif message_id == 0x0414:
            velocity = round(self.speed_deg_s * VELOCITY_PER_DEG_S)
            self._reply(_pack(0x0415, 0x01, 0x50, data=struct.pack("<H3l", 1, 0, 293, velocity)))
        elif message_id == 0x0441:
            velocity = round(self.home_speed_deg_s * VELOCITY_PER_DEG_S)
            self._reply(_pack(0x0442, 0x01, 0x50, data=struct.pack("<3Hll", 1, 2, 1, velocity, 7680)))
        elif message_id == 0x0443:
            self.orders.append(("home", self.home_speed_deg_s))
            self._target, self._rate, self._homing, self.homed = 0.0, self.home_speed_deg_s, True, False
        elif message_id == 0x0465:
            self.orders.append(("stop", self.device_deg))
            self._target, self._homing = None, False
            self._reply(_pack(0x0466, 0x01, 0x50, data=self._status_data()))
        elif message_id == 0x0490:
            self._reply(_pack(self.status_id, 0x01, 0x50, data=self._status_data()))

    def _status_data(self) -> bytes:
        bits = self.extra_bits | (0x400 if self.homed else 0) | (0x80000000 if self.enabled else 0)
        if self._target is not None and not self.claims_rest:
            bits |= 0x10 if self._target > self.device_deg else 0x20
            bits |= 0x200 if self._homing else 0
        position = round((self.device_deg + self._offset) * COUNTS_PER_DEG)
        return struct.pack("<HlhHL", 1, position, 0, 0, bits) + self.status_more

    def _reply(self, message: bytes) -> None:
        unpacker = Unpacker(on_error="raise")
        unpacker.feed(message)
        assert len(list(unpacker)) == 1
        self._replies += 1
        if self.drop and self._replies % self.drop == 0:
            return
        behind, self.behind = self.behind, b""
        os.write(self._master, self.garbage + message + behind)
