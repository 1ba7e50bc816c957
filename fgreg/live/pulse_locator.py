"""Laser pulses from the probe's frames: on the host's clock, with the plane's angle and the marker's pose.

Pulses are never dropped. A worker process locates the source, and a pulse is handed on once the marker poses around it
are known. If the worker cannot keep up, pulses are handed on without a plane angle, as if the plane had been turning,
and are counted: so they do not count as pulses without a signal.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.detection.results import NoSignal, PaFind
from fgreg.drivers.base import PaFrame, host_now
from fgreg.live.actions import LocatedPulse
from fgreg.live.pa_worker import Locator
from fgreg.model.measurements import OtherPosition
from fgreg.model.session_model import SessionModel
from fgreg.model.time_sync import HELD_GAP_S, DeviceClock, PairRefused, PoseHistory

GIVE_UP_S = 1.0
"""Longest time that a pulse waits for the marker poses around it."""
LOCATE_S = 6.0
"""Longest time that a pulse waits for the worker process."""
UNREAD_S = 2.0
"""A frame that could not be processed is reported for this long."""
STOOD_RAD = 0.002
"""The plane stands still if it turns by no more than this around the pulse."""


@dataclass(slots=True, eq=False)
class _Waiting:
    """A pending pulse: its frame until it has been processed, the plane's angle, the located source."""

    pulse_s: float
    data: npt.NDArray[Any] | None
    scan_rad: float | None = None
    located: Future[PaFind | NoSignal] | None = None

    @property
    def under_way(self) -> bool:
        """Whether the frame still has to be processed."""
        return self.data is not None and (self.located is None or not self.located.done())


class PulseLocator:
    """Turns the probe's frames into pulses with source, plane angle and marker pose.

    Attributes:
        wanted: whether sources should be located, which takes processor time.
        passed_over: number of pulses that were not located for want of time.
        locator: the worker that locates sources; it is free for other jobs while ``wanted`` is False.
    """

    def __init__(self, model: SessionModel, latency_s: float = 0.0) -> None:
        self.locator = Locator(model.probe)
        self._clock = DeviceClock(latency_s)
        self._waiting: deque[_Waiting] = deque()
        self._planes: deque[tuple[float, float, bool]] = deque(maxlen=256)
        self.wanted, self.passed_over = True, 0
        self._unread, self._unread_s = "", -np.inf

    @property
    def trouble(self) -> str:
        """Why sources cannot be located now; empty if they can."""
        if host_now() - self._unread_s > UNREAD_S:
            self._unread = ""
        return self.locator.trouble or self._unread

    @property
    def waiting(self) -> int:
        """Number of pulses that have not been handed on yet."""
        return len(self._waiting)

    def plane(self, at_s: float, scan_rad: float, moving: bool) -> None:
        """Take in the plane's angle as the stage reports it."""
        if not self._planes or at_s > self._planes[-1][0]:
            self._planes.append((at_s, scan_rad, moving))

    def add_frames(self, frames: Sequence[PaFrame]) -> None:
        """Take in pulses. One is processed at a time: the next is of use only once its result is known."""
        for frame in frames:
            wanted = self.wanted and not any(pulse.under_way for pulse in self._waiting)
            self._waiting.append(_Waiting(self._clock.host_time(frame.stamp), frame.data if wanted else None))

    def complete_pulses(self, now_s: float, poses: PoseHistory) -> tuple[LocatedPulse, ...]:
        """The pulses that are complete, oldest first."""
        out = []
        self.locator.check()
        for pulse in self._waiting:
            self._locate(pulse, now_s)
            if pulse.located is not None and not pulse.located.done() and now_s - pulse.pulse_s > LOCATE_S:
                self._pass_over(pulse)
        while self._waiting:
            first = self._waiting[0]
            overdue = now_s - first.pulse_s > GIVE_UP_S
            if first.data is not None or not (poses.can_tell(first.pulse_s) or overdue):
                break
            self._waiting.popleft()
            out.append(self._complete(first, poses))
        return tuple(out)

    def _locate(self, pulse: _Waiting, now_s: float) -> None:
        """Have the source located once it is known that the plane stood still at the pulse."""
        if pulse.data is None:
            return
        if pulse.located is None:
            if (not self._planes or self._planes[-1][0] <= pulse.pulse_s) and now_s - pulse.pulse_s < GIVE_UP_S:
                return
            pulse.scan_rad = self._stood(pulse.pulse_s)
            if pulse.scan_rad is None:
                pulse.data = None
                return
            if self.locator.busy:  # still at work on a pulse that was passed over
                self._pass_over(pulse)
                return
            pulse.located = self.locator.submit(pulse.data)
        elif pulse.located.done():
            pulse.data = None

    def _pass_over(self, pulse: _Waiting) -> None:
        """Give up on locating: without a result the pulse says nothing about any plane angle."""
        if pulse.located is not None:
            pulse.located.cancel()
        pulse.data = pulse.scan_rad = pulse.located = None
        self.passed_over += 1

    def _complete(self, pulse: _Waiting, poses: PoseHistory) -> LocatedPulse:
        complete = LocatedPulse(pulse.pulse_s, pulse.scan_rad)
        try:
            complete = replace(complete, marker=poses.at(pulse.pulse_s, HELD_GAP_S))
        except PairRefused as error:
            complete = replace(complete, unpaired=str(error))
        if pulse.located is None:
            return complete
        try:
            found = pulse.located.result()
        except Exception as error:  # a fault of one frame; the next may be good
            self._unread_s = host_now()
            self._unread = f"a frame of the probe could not be processed: {error}"
            return replace(complete, scan_rad=None)  # unknown whether there was a signal
        if isinstance(found, NoSignal):
            return complete
        return replace(
            complete,
            x_mm=found.x_mm,
            range_mm=found.range_mm,
            covariance=found.covariance,
            amplitude=found.amplitude,
            others=tuple(OtherPosition(wave.x_mm, wave.range_mm, wave.covariance) for wave in found.others),
        )

    def _stood(self, t_s: float) -> float | None:
        """The plane's angle at a time; None if the plane was turning or its angle is unknown."""
        before = [plane for plane in self._planes if plane[0] <= t_s]
        after = [plane for plane in self._planes if plane[0] > t_s]
        if not before or not after:
            return None
        (t0, first, moved), (t1, second, moves) = before[-1], after[0]
        if moved or moves or abs(second - first) > STOOD_RAD or t1 - t0 > 0.5:
            return None
        return float(np.interp(t_s, (t0, t1), (first, second)))

    def close(self) -> None:
        """End the worker process."""
        self.locator.close()
