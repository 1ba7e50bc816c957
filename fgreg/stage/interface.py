"""Interface of a rotation stage for the watchdog, and the errors of its drivers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from fgreg.errors import FgregError
from fgreg.model.time_sync import Stamp

MAX_CALL_S = 0.1
"""Longest call of a driver, whatever the device does; a stop waits for no reply."""


class StageError(FgregError):
    """The stage did not or cannot carry out a call; the text names device, symptom and what to check."""


class StageLost(StageError):  # noqa: N818
    """The connection is lost (unplugged, switched off, silent); a new one has to be opened."""


@dataclass(frozen=True, slots=True)
class StageStatus:
    """Status that the stage reports.

    Attributes:
        stamp: time of the status.
        scan_rad: plane angle, TRUS convention; only its changes have a meaning until ``homed``.
        velocity_rad_s: from the device, same sign convention; 0 if unknown.
        moving, homing: whether a motion, or homing, is under way.
        homed: whether the zero position was found since power-on.
        fault: the device's fault (limit switch, overcurrent, motor off), in words; empty if there is none.
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
        """Start homing, at most at this speed."""

    def move_to(self, scan_rad: float, speed_rad_s: float) -> None:
        """Start to turn to an angle, at most at this speed; replaces a motion under way."""

    def stop(self) -> None:
        """Stop as fast as the device can, in any state, also at rest."""

    def status(self) -> StageStatus:
        """The newest status; queries the device if it does not report by itself."""

    def close(self) -> None:
        """Release the device; never raises."""
