"""Identifies a Thorlabs cube by two queries that change nothing. The motor stays switched off."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fgreg.drivers import thorlabs_apt
from fgreg.drivers.thorlabs_stage import ASK_AGAIN_S, COUNTS_PER_RAD, MODELS, only_port, open_port
from fgreg.stage.interface import StageError, StageLost

if TYPE_CHECKING:
    from fgreg.drivers.base import DriverContext
    from fgreg.drivers.options import ThorlabsOptions

ANSWER_S = 1.0
"""Longest time that a cube may take for both replies."""


_QUESTIONS = {
    thorlabs_apt.GET_INFO: thorlabs_apt.short(thorlabs_apt.REQ_INFO),
    thorlabs_apt.GET_STATUS: thorlabs_apt.short(thorlabs_apt.REQ_STATUS, thorlabs_apt.CHANNEL),
}


@dataclass(frozen=True, slots=True)
class CubeIdentity:
    """A cube's model, serial number and device angle (deg; unless ``homed``, from the angle at power-on)."""

    port: str
    model: str
    serial: int
    device_deg: float
    homed: bool

    def __str__(self) -> str:
        zero = "knows its zero position" if self.homed else "has to find its zero position"
        return f"{self.model} no. {self.serial} at {self.port}, {self.device_deg:.1f} deg, {zero}"


def identify(port: str) -> CubeIdentity:
    """Ask the cube at a serial port.

    Raises:
        StageLost: the port cannot be opened (another program has it), or no device answers.
        StageError: another device answers.
        MissingExtraError: pyserial is not installed.
    """
    line = open_port(port)
    try:
        line.reset_input_buffer()
        line.write(thorlabs_apt.short(thorlabs_apt.NO_FLASH))
        told: dict[int, bytes] = {}
        parser = thorlabs_apt.AptParser()
        until, asked = time.monotonic() + ANSWER_S, -math.inf
        while not told.keys() >= _QUESTIONS.keys():
            now = time.monotonic()
            if now > until:
                raise StageLost(f"stage at {port} does not answer: is it switched on, is it a KDC101 or TDC001?")
            if now - asked > ASK_AGAIN_S:
                asked = now
                for answer, question in _QUESTIONS.items():
                    if answer not in told:  # other replies would be mixed with repeated ones
                        line.write(question)
            time.sleep(0.002)
            for message in parser.feed(line.read(4096)):
                if message.id in (thorlabs_apt.ERROR, thorlabs_apt.ERROR_WITH_NOTES):
                    raise StageError(f"stage at {port} reports an error: {thorlabs_apt.read_error(message)}")
                told[thorlabs_apt.GET_STATUS if message.is_status else message.id] = message.data
    except OSError as error:
        raise StageLost(f"stage at {port} is gone: {error}") from error
    finally:
        line.close()
    model = thorlabs_apt.read_model(told[thorlabs_apt.GET_INFO])
    if not model.startswith(MODELS):
        raise StageError(f"stage at {port} is a {model!r}, expected one of {', '.join(MODELS)}")
    status = thorlabs_apt.read_status(told[thorlabs_apt.GET_STATUS])
    angle = math.degrees(status.position / COUNTS_PER_RAD)
    return CubeIdentity(
        port,
        model,
        thorlabs_apt.read_serial(told[thorlabs_apt.GET_INFO]),
        angle,
        bool(status.bits & thorlabs_apt.HOMED_BIT),
    )


def ask_stage(_context: DriverContext, options: ThorlabsOptions) -> str:
    """Identify a cube; nothing moves. Raises StageError: no device answers, or another one."""
    return str(identify(options.port or only_port()))
