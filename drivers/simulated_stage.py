"""A simulated rotation stage with limited speed and acceleration; it loses its zero at power-off, and can have faults.

Its position follows from time alone: a trapezoidal speed profile towards the target, integrated in short steps at each
call. The true angle (``device_rad``) is kept apart from the reported one, which is wrong before homing.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fgreg.model.session_model import StageModel
from fgreg.model.time_sync import Stamp
from fgreg.stage.interface import StageLost, StageStatus

if TYPE_CHECKING:
    from fgreg.drivers.base import DriverContext
    from fgreg.drivers.options import StandInOptions

_STEP_S = 1e-3
_STANDS_RAD_S = 1e-9


@dataclass(slots=True)
class Misbehaviour:
    """Faults of the stage, for tests and rehearsals.

    Attributes:
        deaf: ignores all commands, stops included.
        lost: every call raises, as if unplugged.
        frozen: repeats the last status.
        speed_factor: ratio of the actual to the ordered speed.
        reversed: turns the wrong way.
        says_it_stands: its moving flag never comes on.
    """

    deaf: bool = False
    lost: bool = False
    frozen: bool = False
    speed_factor: float = 1.0
    reversed: bool = False
    says_it_stands: bool = False


class SimulatedStage:
    """A stage with realistic limits of speed and acceleration.

    Args:
        model: direction and zero.
        device_rad: true angle at power-on, which the stage does not know.
        homed: whether it knows its zero position at power-on.
        max_speed_rad_s, acceleration_rad_s2: of the motor; default a PRM1Z8's.
        clock: host time, s.
    """

    def __init__(
        self,
        model: StageModel,
        *,
        device_rad: float = 0.0,
        homed: bool = False,
        max_speed_rad_s: float = math.radians(25.0),
        acceleration_rad_s2: float = math.radians(25.0),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.model, self.wrong = model, Misbehaviour()
        self.device_rad, self.velocity_rad_s = device_rad, 0.0
        self._max_speed, self._acceleration, self._clock = max_speed_rad_s, acceleration_rad_s2, clock
        self._offset = 0.0 if homed else -device_rad  # reported = true + offset
        self._homed, self._homing = homed, False
        self._target: float | None = None  # true device angle
        self._speed = 0.0
        self._at = clock()
        self._last: StageStatus | None = None

    def home(self, speed_rad_s: float) -> None:
        """Start homing."""
        self._advance()
        if not self.wrong.deaf:
            self._homed, self._homing = False, True
            self._target, self._speed = 0.0, min(speed_rad_s, self._max_speed)

    def move_to(self, scan_rad: float, speed_rad_s: float) -> None:
        """Start to turn to a plane angle."""
        self._advance()
        if not self.wrong.deaf:
            self._homing = False
            self._target = self.model.device_from_scan(scan_rad) - self._offset
            self._speed = min(speed_rad_s, self._max_speed)

    def stop(self) -> None:
        """Brake."""
        self._advance()
        if not self.wrong.deaf:
            self._target, self._homing = None, False

    def status(self) -> StageStatus:
        """The reported status."""
        self._advance()
        if self.wrong.frozen and self._last is not None:
            return self._last
        moving = abs(self.velocity_rad_s) > _STANDS_RAD_S or (
            self._target is not None and self._target != self.device_rad
        )
        self._last = StageStatus(
            Stamp(self._at, self._at),
            self.model.scan_from_device(self.device_rad + self._offset),
            self.model.direction * self.velocity_rad_s,
            moving and not self.wrong.says_it_stands,
            self._homing,
            self._homed,
        )
        return self._last

    def close(self) -> None:
        """Brake and close."""
        self._target, self._homing = None, False

    def _advance(self) -> None:
        if self.wrong.lost:
            raise StageLost("simulated stage: unplugged")
        now = self._clock()
        while self._at < now - 1e-12:
            step = min(_STEP_S, now - self._at)
            self._at += step
            self._step(step)
        self._at = now

    def _step(self, dt: float) -> None:
        """Integrate a short time: the largest speed from which the stage can still brake before its target, limited by
        the acceleration."""
        wanted, way = 0.0, 0.0
        if self._target is not None:
            way = self._target - self.device_rad
            brakes = math.sqrt(2.0 * self._acceleration * abs(way))
            wanted = math.copysign(min(self._speed * self.wrong.speed_factor, brakes, abs(way) / dt), way)
            wanted = -wanted if self.wrong.reversed else wanted
        change = self._acceleration * dt
        self.velocity_rad_s += min(change, max(-change, wanted - self.velocity_rad_s))
        self.device_rad += self.velocity_rad_s * dt
        near = self._target is not None and abs(self._target - self.device_rad) < 1e-6
        if near and abs(self.velocity_rad_s) <= 2.0 * change:
            self.device_rad, self.velocity_rad_s = self._target or 0.0, 0.0
            if self._homing:
                self._homing, self._homed, self._offset = False, True, 0.0
            self._target = None


def open_stage(model: StageModel, **options: float) -> SimulatedStage:
    """A stage for the watchdog: options are those of :class:`SimulatedStage`, angles in degrees.

    ``device_deg``, ``homed``, ``max_speed_deg_s``, ``acceleration_deg_s2``.
    """
    return SimulatedStage(
        model,
        device_rad=math.radians(options.pop("device_deg", 0.0)),
        homed=bool(options.pop("homed", False)),
        max_speed_rad_s=math.radians(options.pop("max_speed_deg_s", 25.0)),
        acceleration_rad_s2=math.radians(options.pop("acceleration_deg_s2", 25.0)),
        **options,  # type: ignore[arg-type]
    )


def ask_stage(_context: DriverContext, _options: StandInOptions) -> str:
    """Nobody is there."""
    return "simulated: nothing turns"
