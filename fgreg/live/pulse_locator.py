"""Laser pulses from the probe's frames: on the host's clock, with where the plane stood and where the marker was.

Pulses are never dropped: the source is located in a process of its own, and a pulse is handed on once the marker's
poses about it are known. Where that process cannot keep up, pulses are handed on as if the plane had turned, and
counted: then no one takes them for silent.
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
from fgreg.model.session_model import SessionModel
from fgreg.model.time_sync import DeviceClock, PairRefused, PoseHistory

GIVE_UP_S = 0.5
"""A pulse waits for the poses about it no longer than this."""
LOCATE_S = 2.0
"""A pulse waits for the locating process no longer than this."""
UNREAD_S = 2.0
"""So long it is told that a frame could not be looked into."""
STOOD_RAD = 0.002
"""The plane stands if it has turned by no more than this about the pulse."""


@dataclass(slots=True, eq=False)
class _Waiting:
    """A pulse under way: its frame until that was looked into, where the plane stood, what is located."""

    pulse_s: float
    data: npt.NDArray[Any] | None
    scan_rad: float | None = None
    located: Future[PaFind | NoSignal] | None = None

    @property
    def under_way(self) -> bool:
        """Whether it is still to be looked into."""
        return self.data is not None and (self.located is None or not self.located.done())


class PulseLocator:
    """Pulses with what was heard, where the plane stood, and where the marker was.

    Attributes:
        listening: whether anybody wants to know what is heard: locating a source takes time.
        passed_over: pulses that would have been located, had there been time.
        locator: the process that locates sources; it has time for other things while nobody listens.
    """

    def __init__(self, model: SessionModel, latency_s: float = 0.0) -> None:
        self.locator = Locator(model.probe)
        self._clock = DeviceClock(latency_s)
        self._waiting: deque[_Waiting] = deque()
        self._planes: deque[tuple[float, float, bool]] = deque(maxlen=256)
        self.listening, self.passed_over = True, 0
        self._unread, self._unread_s = "", -np.inf

    @property
    def trouble(self) -> str:
        """Why nothing is located now; empty where it is."""
        if host_now() - self._unread_s > UNREAD_S:
            self._unread = ""
        return self.locator.trouble or self._unread

    @property
    def waiting(self) -> int:
        """Pulses that have not been handed on yet."""
        return len(self._waiting)

    def plane(self, at_s: float, scan_rad: float, moving: bool) -> None:
        """Where the plane stands, as the stage reports it."""
        if not self._planes or at_s > self._planes[-1][0]:
            self._planes.append((at_s, scan_rad, moving))

    def hear(self, frames: Sequence[PaFrame]) -> None:
        """Take in pulses. One at a time is looked into: the next is of use once it is known what came of that."""
        for frame in frames:
            wanted = self.listening and not any(pulse.under_way for pulse in self._waiting)
            self._waiting.append(_Waiting(self._clock.host_time(frame.stamp), frame.data if wanted else None))

    def heard(self, now_s: float, poses: PoseHistory) -> tuple[LocatedPulse, ...]:
        """The pulses that are complete, in their order."""
        out = []
        self.locator.check()
        for pulse in self._waiting:
            self._look_into(pulse, now_s)
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

    def _look_into(self, pulse: _Waiting, now_s: float) -> None:
        """Have the source located, once it is known that the plane stood at the pulse; a turning one is of no use."""
        if pulse.data is None:
            return
        if pulse.located is None:
            if (not self._planes or self._planes[-1][0] <= pulse.pulse_s) and now_s - pulse.pulse_s < GIVE_UP_S:
                return
            pulse.scan_rad = self._stood(pulse.pulse_s)
            if pulse.scan_rad is None:
                pulse.data = None
                return
            if self.locator.busy:  # with a pulse that was passed over
                self._pass_over(pulse)
                return
            pulse.located = self.locator.submit(pulse.data)
        elif pulse.located.done():
            pulse.data = None

    def _pass_over(self, pulse: _Waiting) -> None:
        """Nobody knows whether anything was heard: then the pulse says nothing of any angle."""
        if pulse.located is not None:
            pulse.located.cancel()
        pulse.data = pulse.scan_rad = pulse.located = None
        self.passed_over += 1

    def _complete(self, pulse: _Waiting, poses: PoseHistory) -> LocatedPulse:
        heard = LocatedPulse(pulse.pulse_s, pulse.scan_rad)
        try:
            heard = replace(heard, marker=poses.at(pulse.pulse_s))
        except PairRefused as error:
            heard = replace(heard, unpaired=str(error))
        if pulse.located is None:
            return heard
        try:
            found = pulse.located.result()
        except Exception as error:  # of one frame: the next one may be as it should
            self._unread_s = host_now()
            self._unread = f"a frame of the probe could not be looked into: {error}"
            return replace(heard, scan_rad=None)  # nobody knows whether anything was heard there
        if isinstance(found, NoSignal):
            return heard
        return replace(
            heard, x_mm=found.x_mm, range_mm=found.range_mm, covariance=found.covariance, amplitude=found.amplitude
        )

    def _stood(self, t_s: float) -> float | None:
        """The plane's angle at a time; None where it turned then, or nobody knows."""
        before = [plane for plane in self._planes if plane[0] <= t_s]
        after = [plane for plane in self._planes if plane[0] > t_s]
        if not before or not after:
            return None
        (t0, first, moved), (t1, second, moves) = before[-1], after[0]
        if moved or moves or abs(second - first) > STOOD_RAD or t1 - t0 > 0.5:
            return None
        return float(np.interp(t_s, (t0, t1), (first, second)))

    def close(self) -> None:
        """End the process."""
        self.locator.close()
