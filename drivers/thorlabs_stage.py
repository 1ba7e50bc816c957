"""Thorlabs PRM1Z8 rotation stage on a KDC101 or TDC001 cube, over its USB serial line.

:meth:`ThorlabsStage.status` queries the cube at every call; only opening waits for a reply. Cubes sometimes leave a
query unanswered: it is repeated, and the stage counts as lost only after ``LOST_S`` without any reply. The cube
controls the speed, so its setting is read back after every order. An error that the cube reports is raised once, by the
next :meth:`ThorlabsStage.status`, and is a fault in the statuses of the next ``LOST_S``.

Before homing, the angle counts from its value at power-on.
"""

from __future__ import annotations

import errno
import math
import os
import select
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from fgreg.drivers import thorlabs_apt
from fgreg.errors import MissingExtraError
from fgreg.model.session_model import StageModel
from fgreg.model.time_sync import Stamp
from fgreg.stage.interface import StageError, StageLost, StageStatus

if TYPE_CHECKING:
    import serial

COUNTS_PER_RAD = 1919.6418578623391 * 180.0 / math.pi
VELOCITY_PER_RAD_S = 42941.66 * 180.0 / math.pi
ACCELERATION_PER_RAD_S2 = 14.66 * 180.0 / math.pi
MODELS = ("KDC101", "TDC001")
USB_ID = (0x0403, 0xFAF0)

ASK_AGAIN_S = 0.06
"""A query without a reply is repeated after this time."""
LOST_S = 1.0
"""A cube that sends nothing for this long is lost."""
OPEN_S = 0.2
"""Longest time that the cube may take for each query at the start."""
_SETTLE_S = 0.05
_WRITE_S = 0.05
_VELOCITY_SLACK = 0.02


class ThorlabsStage:
    """See ``fgreg.stage.interface.RotationStage``.

    Args:
        model: direction and zero.
        port: serial port.
        acceleration_rad_s2: of every motion.

    Raises:
        StageLost: the port cannot be opened, or no device answers.
        StageError: another device answers.
        MissingExtraError: pyserial is not installed.
    """

    def __init__(self, model: StageModel, port: str, acceleration_rad_s2: float = math.radians(20.0)) -> None:
        self._model, self._name = model, f"stage at {port}"
        self._acceleration = round(acceleration_rad_s2 * ACCELERATION_PER_RAD_S2)
        self._parser = thorlabs_apt.AptParser()
        self._lost: str | None = None
        self._status: thorlabs_apt.CubeStatus | None = None
        self._home: thorlabs_apt.HomeSettings | None = None
        self._model_name = ""
        self._received_s = self._asked_s = -math.inf
        self._before: tuple[float, int] | None = None
        self._velocity = 0.0
        self._told: int | None = None
        self._fault = ""
        self._errors: dict[str, float] = {}  # with the time each last came
        self._unraised: list[str] = []
        self._port = open_port(port)
        try:
            self._start()
        except BaseException:
            self._port.close()
            raise

    def home(self, speed_rad_s: float) -> None:
        """Start homing with the cube's own settings, but at most at this speed."""
        if self._home is None:
            raise StageError(f"{self._name} has not told how it looks for its zero position")
        velocity = min(self._home.velocity, _velocity(speed_rad_s))
        settings = thorlabs_apt.HomeSettings(self._home.direction, self._home.switch, velocity, self._home.offset)
        self._told = None
        self._write(thorlabs_apt.set_home(settings) + thorlabs_apt.short(thorlabs_apt.MOVE_HOME, thorlabs_apt.CHANNEL))

    def move_to(self, scan_rad: float, speed_rad_s: float) -> None:
        """Turn to a plane angle."""
        position = round(self._model.device_from_scan(scan_rad) * COUNTS_PER_RAD)
        self._told = _velocity(speed_rad_s)
        self._write(
            thorlabs_apt.set_velocity(self._acceleration, self._told)
            + thorlabs_apt.move_absolute(position)
            + thorlabs_apt.short(thorlabs_apt.REQ_VELOCITY, thorlabs_apt.CHANNEL)
        )

    def stop(self) -> None:
        """Stop at once, without a profile."""
        self._write(thorlabs_apt.short(thorlabs_apt.MOVE_STOP, thorlabs_apt.CHANNEL, thorlabs_apt.STOP_AT_ONCE))

    def status(self) -> StageStatus:
        """The newest status with its time of arrival; asks the cube for a newer one.

        Raises:
            StageError: the cube reports an error; the next call returns the status again.
            StageLost: it is gone, or silent.
        """
        self._read()
        now = time.monotonic()
        if now - self._received_s > LOST_S:
            raise self._give_up(f"has said nothing for {LOST_S:.0f} s: is it switched on, is its cable in?")
        if now - self._asked_s > ASK_AGAIN_S or self._received_s >= self._asked_s:
            self._asked_s = now
            self._write(thorlabs_apt.short(thorlabs_apt.REQ_STATUS, thorlabs_apt.CHANNEL))
        self._raise_error()
        return self._as_status()

    def close(self) -> None:
        """Close the port."""
        self._lost = self._lost or f"{self._name} is closed"
        try:
            self._port.close()
        except OSError:
            return

    # -- the line

    def _start(self) -> None:
        """Initialise the cube, and read its model, homing settings and status."""
        time.sleep(_SETTLE_S)
        self._port.reset_input_buffer()
        self._write(thorlabs_apt.short(thorlabs_apt.NO_FLASH))
        self._ask(thorlabs_apt.REQ_INFO, 0, lambda: bool(self._model_name))
        if not self._model_name.startswith(MODELS):
            raise StageError(f"{self._name} is a {self._model_name!r}, expected one of {', '.join(MODELS)}")
        self._write(thorlabs_apt.short(thorlabs_apt.SET_ENABLE, thorlabs_apt.CHANNEL, 1))
        self._ask(thorlabs_apt.REQ_HOME, thorlabs_apt.CHANNEL, lambda: self._home is not None)
        self._ask(thorlabs_apt.REQ_STATUS, thorlabs_apt.CHANNEL, lambda: self._status is not None)

    def _ask(self, question: int, parameter: int, answered: Callable[[], bool]) -> None:
        until = time.monotonic() + OPEN_S
        asked = -math.inf
        while not answered():
            now = time.monotonic()
            if now > until:
                raise self._give_up("does not answer: is it switched on, is it a KDC101 or TDC001?")
            if now - asked > ASK_AGAIN_S:
                asked = now
                self._write(thorlabs_apt.short(question, parameter))
            time.sleep(0.002)
            self._read()
            self._raise_error()

    def _write(self, data: bytes) -> None:
        self._check()
        try:
            write_all(self._port.fileno(), data)
        except OSError as error:  # SerialException and its timeout are OSErrors
            raise self._give_up(f"takes nothing in: {error}") from error

    def _read(self) -> None:
        self._check()
        try:
            data = self._port.read(4096)
        except (OSError, TypeError) as error:  # TypeError: pyserial's answer to a port that was closed meanwhile
            raise self._give_up(f"is gone: {error}") from error
        for message in self._parser.feed(data):
            self._take(message)

    def _take(self, message: thorlabs_apt.AptMessage) -> None:
        now = time.monotonic()
        match message.id:
            case _ if message.is_status:
                status = thorlabs_apt.read_status(message.data)
                self._take_bits(status.bits)
                self._follow(now, status.position)
                self._status, self._received_s = status, now
            case thorlabs_apt.GET_STATUS_BITS:  # without a position: no newer status
                self._take_bits(thorlabs_apt.read_status_bits(message.data))
            case thorlabs_apt.ERROR | thorlabs_apt.ERROR_WITH_NOTES:
                error = f"{self._name} reports an error: {thorlabs_apt.read_error(message)}"
                self._errors = {text: at for text, at in self._errors.items() if now - at <= LOST_S}
                if error not in self._errors:  # one that is repeated is one
                    self._unraised.append(error)
                self._errors[error] = now
            case thorlabs_apt.GET_HOME:
                self._home = thorlabs_apt.read_home(message.data)
            case thorlabs_apt.GET_INFO:
                self._model_name = thorlabs_apt.read_model(message.data)
            case thorlabs_apt.GET_VELOCITY if self._told is not None:
                _, velocity = thorlabs_apt.read_velocity(message.data)
                if velocity > self._told * (1.0 + _VELOCITY_SLACK) + 1.0:
                    turned = math.degrees(velocity / VELOCITY_PER_RAD_S)
                    told = math.degrees(self._told / VELOCITY_PER_RAD_S)
                    self._fault = f"{self._name} is set to {turned:.1f} deg/s, was told {told:.1f} deg/s"
                else:
                    self._fault = ""
            case _:
                pass

    def _take_bits(self, bits: int) -> None:
        if self._status is None:
            return
        if (bits ^ self._status.bits) & thorlabs_apt.HOMED_BIT:
            self._before, self._velocity = None, 0.0  # the zero was set: the position jumps, the stage does not
        self._status = replace(self._status, bits=bits)

    def _raise_error(self) -> None:
        if self._unraised:
            raise StageError(self._unraised.pop(0))

    def _follow(self, now: float, position: int) -> None:
        """Velocity from the positions, since the cube's own velocity differs between models.

        A position may arrive late, but was read after the one before it arrived: the time between two positions is
        taken as long as it can be, so that a late one is not a fast stage.
        """
        read_after = now if math.isinf(self._received_s) else self._received_s
        if self._before is None:
            self._before = (read_after, position)
            return
        took = now - self._before[0]
        if took >= _SETTLE_S:
            turned = (position - self._before[1]) / COUNTS_PER_RAD
            self._velocity = self._model.direction * turned / took
            self._before = (read_after, position)

    def _as_status(self) -> StageStatus:
        if self._status is None:
            raise StageError(f"{self._name} has told no status yet")
        bits = self._status.bits
        recent = (error for error, at in self._errors.items() if time.monotonic() - at <= LOST_S)
        fault = self._fault or next(recent, "")
        if bits & thorlabs_apt.MOTION_ERROR_BIT:
            fault = f"{self._name} reports a motion error: is something in its way?"
        elif bits & thorlabs_apt.OVERLOAD_BIT:
            fault = f"{self._name} reports too much current: is something in its way?"
        elif not bits & thorlabs_apt.ENABLED_BIT:
            fault = f"{self._name} has its motor switched off"
        moving, homing = bool(bits & thorlabs_apt.MOVING_BITS), bool(bits & thorlabs_apt.HOMING_BIT)
        return StageStatus(
            Stamp(self._received_s, self._received_s),
            self._model.scan_from_device(self._status.position / COUNTS_PER_RAD),
            self._velocity if moving else 0.0,
            moving,
            homing,
            bool(bits & thorlabs_apt.HOMED_BIT) and not homing,
            fault,
        )

    def _check(self) -> None:
        if self._lost is not None:
            raise StageLost(self._lost)

    def _give_up(self, reason: str) -> StageLost:
        self._lost = f"{self._name} {reason}"
        return StageLost(self._lost)


def open_stage(model: StageModel, *, port: str | None = None, acceleration_deg_s2: float = 20.0) -> ThorlabsStage:
    """The stage at a port; without a port, the only cube that is plugged in.

    Raises:
        StageLost: there is no cube, or it does not answer. StageError: there are several, or it is another device.
        MissingExtraError: pyserial is not installed.
    """
    return ThorlabsStage(model, only_port() if port is None else port, math.radians(acceleration_deg_s2))


def only_port() -> str:
    """The serial port of the only cube that is plugged in.

    Raises:
        StageLost: there is no cube. StageError: there are several. MissingExtraError: pyserial is not installed.
    """
    ports = find_ports()
    if not ports:
        raise StageLost("no Thorlabs cube is plugged in: plug one in, or name its serial port")
    if len(ports) > 1:
        raise StageError(f"several Thorlabs cubes are plugged in, name one: {', '.join(ports)}")
    return ports[0]


def find_ports() -> list[str]:
    """Serial ports of the Thorlabs cubes that are plugged in."""
    try:
        from serial.tools import list_ports
    except ImportError as error:
        raise MissingExtraError("pyserial", "stage") from error
    return sorted(found.device for found in list_ports.comports() if (found.vid, found.pid) == USB_ID)


def _velocity(speed_rad_s: float) -> int:
    return max(1, math.floor(speed_rad_s * VELOCITY_PER_RAD_S))


def write_all(fd: int, data: bytes) -> None:
    """Write to a line that does not block.

    pyserial's own timeout also runs out where this process was not scheduled, though all is written.

    Raises:
        OSError: it takes nothing in for :data:`_WRITE_S`, or is gone.
    """
    while data:
        try:
            data = data[os.write(fd, data) :]
        except BlockingIOError:
            if not select.select([], [fd], [], _WRITE_S)[1]:
                raise OSError(f"not for {1e3 * _WRITE_S:.0f} ms") from None


def open_port(port: str) -> serial.Serial:
    """Open a cube's serial line for exclusive use. Raises StageLost (another program has it), MissingExtraError."""
    try:
        import serial
    except ImportError as error:
        raise MissingExtraError("pyserial", "stage") from error
    try:
        return serial.Serial(port, 115200, rtscts=True, timeout=0, write_timeout=_WRITE_S, exclusive=True)
    except (OSError, ValueError) as error:
        if isinstance(error, OSError) and error.errno in (errno.EAGAIN, errno.EBUSY):
            raise StageLost(f"stage at {port} is in use by another program: close that one") from error
        raise StageLost(f"stage at {port} cannot be opened: {error}") from error
