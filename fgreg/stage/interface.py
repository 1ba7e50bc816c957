"""What the watchdog needs of a rotation stage, and what drivers raise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from fgreg.errors import FgregError
from fgreg.model.time_sync import Stamp

MAX_CALL_S = 0.1
"""No call of a driver may take longer, whatever the device does: a stop waits for no answer."""


class StageError(FgregError):
    """The stage did not do what it was told, or cannot: says which device, what happened, and what to look at."""


class StageLost(StageError):  # noqa: N818
    """The connection is gone (unplugged, switched off, silent): a new one has to be opened."""


@dataclass(frozen=True, slots=True)
class StageStatus:
    """What the stage says of itself.

    Attributes:
        stamp: when it was so.
        scan_rad: plane angle, TRUS convention; without meaning until ``homed``, but its changes are real.
        velocity_rad_s: as the device has it, same sign convention; 0 where it does not tell.
        moving, homing: a motion, the search for the zero position, is going on.
        homed: the zero position was found since power-on.
        fault: what the device complains of (limit switch, overcurrent, motor off), in words; empty: nothing.
    """

    stamp: Stamp
    scan_rad: float
    velocity_rad_s: float
    moving: bool
    homing: bool
    homed: bool
    fault: str = ""


class RotationStage(Protocol):
    """A stage that turns the probe. Angles are the *plane's* (rad, TRUS convention): the driver is made with the
    session's ``StageModel`` and converts.

    Every call returns, or raises :class:`StageError`, within :data:`MAX_CALL_S`; none waits for a motion to end. All
    calls come from one thread. A driver that loses its device raises :class:`StageLost` from every call from then on,
    except ``close``.
    """

    def home(self, speed_rad_s: float) -> None:
        """Begin to look for the zero position, no faster than this."""

    def move_to(self, scan_rad: float, speed_rad_s: float) -> None:
        """Begin to turn to an angle, no faster than this; replaces a motion under way."""

    def stop(self) -> None:
        """Stop as fast as the device can, from any state; also where nothing moves."""

    def status(self) -> StageStatus:
        """The newest status; asks for it where the device does not tell by itself."""

    def close(self) -> None:
        """Let go of the device; never raises."""
