"""One video input, read by a thread of its own: a capture that is opened, read, lost and opened again.

The thread does nothing but read and stamp. What it read waits in a queue of few frames; where nobody fetches them in
time the oldest go, and are counted. A capture that ends, fails or falls silent is told once by :meth:`VideoInput.poll`;
the thread goes on trying to open it.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np

from fgreg.drivers.base import DeviceLost, Stamp, host_now
from fgreg.drivers.interlacing import Picture

SILENCE_S = 0.7
"""Without a frame for so long a device counts as lost: with the caller's own loop that is told within a second."""
_RETRY_S = 0.3
_CLOSE_S = 2.0
_PERIOD_S = 1.0 / 30.0


class Capture(Protocol):
    """What of cv2.VideoCapture is used here; image folders and tests have the same."""

    def isOpened(self) -> bool: ...
    def read(self) -> tuple[bool, Any]: ...
    def get(self, property_id: int, /) -> float: ...
    def release(self) -> None: ...


@dataclass(frozen=True, slots=True)
class Timing:
    """How an input's frames get their times.

    Attributes:
        device_clock: take the capture's own time (``CAP_PROP_POS_MSEC``: the driver's for V4L2, the position for
            files); otherwise, and where it does not advance, the host's time of arrival.
        delay_s: from the middle of the exposure to what the device stamps; subtracted.
        paced: hand frames on when their time has come, as a device would (files and folders).
        loop: begin again at the end (files and folders).
        silence_s: longest time without a frame.
    """

    device_clock: bool = True
    delay_s: float = 0.0
    paced: bool = False
    loop: bool = False
    silence_s: float = SILENCE_S

    def __post_init__(self) -> None:
        if not (self.silence_s > 0 and math.isfinite(self.silence_s) and math.isfinite(self.delay_s)):
            raise ValueError(f"silence_s is {self.silence_s}, delay_s {self.delay_s}; expected > 0, and finite")


@dataclass(frozen=True, slots=True, eq=False)
class Grabbed:
    """One frame of one input; ``index`` counts what the device delivered, fetched or not."""

    stamp: Stamp
    picture: Picture
    index: int


class Origin:
    """Where played time begins: shared by inputs that play together, set by the first frame of either."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._at: tuple[float, float] | None = None

    def due_s(self, device_s: float, host_s: float) -> float:
        """How long (s) after ``host_s`` a frame of ``device_s`` is due."""
        with self._lock:
            if self._at is None:
                self._at = device_s, host_s
            return self._at[1] + (device_s - self._at[0]) - host_s


class VideoInput:
    """A capture, kept open.

    Args:
        name: what the user calls it.
        open_capture: makes the capture; None, or one that is not opened, where the device is not there.
        timing: of its frames.
        queue: frames that may wait.
        origin: of played time, where inputs play together.
    """

    def __init__(
        self,
        name: str,
        open_capture: Callable[[], Capture | None],
        timing: Timing | None = None,
        queue: int = 8,
        origin: Origin | None = None,
    ) -> None:
        if queue < 1:
            raise ValueError(f"queue is {queue}, expected at least 1")
        self.name = name
        self._open, self._timing = open_capture, timing or Timing()
        self._waiting: deque[Grabbed] = deque()
        self._room = queue
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._dropped = self._count = 0
        self._alive = False  # a frame came, and no failure since
        self._told = False  # the present loss was told
        self._ended = False  # a file at its end
        self._why = "it could not be opened"
        self._heard_s = host_now()
        self._clock = _Clock(self._timing, origin or Origin())
        self._thread = threading.Thread(target=self._run, name=f"video {name}", daemon=True)
        self._thread.start()

    @property
    def connected(self) -> bool:
        """Whether frames come."""
        with self._lock:
            return self._alive and not self._silent()

    @property
    def ended(self) -> bool:
        """Whether this was a file that is played to its end."""
        return self._ended

    @property
    def dropped(self) -> int:
        """Frames that nobody fetched in time."""
        return self._dropped

    def poll(self) -> list[Grabbed]:
        """Frames since the last call, oldest first.

        Raises:
            DeviceLost: once for each loss, after the frames that came before it were fetched.
        """
        with self._lock:
            found = list(self._waiting)
            self._waiting.clear()
            if found:
                return found
            if self._alive and self._silent():
                self._alive, self._why = False, f"no frame for {self._timing.silence_s:g} s"
            if not self._alive and not self._told and self._silent_or_failed():
                self._told = True
                raise DeviceLost(f"video input {self.name}: {self._why}")
            return []

    def close(self) -> None:
        """Stop reading and let go of the device; twice does no harm."""
        self._stop.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(_CLOSE_S)
        with self._lock:
            self._alive = False
            self._waiting.clear()

    def _silent(self) -> bool:
        if self._timing.paced and self._count:
            return False  # as slow as its pace; it says when it is at its end
        return host_now() - self._heard_s > self._timing.silence_s

    def _silent_or_failed(self) -> bool:
        # A device that was never there gets the same time to show up as one that fell silent.
        return self._count > 0 or self._silent()

    def _run(self) -> None:
        while not self._stop.is_set():
            capture = self._opened()
            if capture is None:
                self._fail("it could not be opened", waiting=True)
                self._stop.wait(_RETRY_S)
                continue
            try:
                delivered = self._read_all(capture)
            finally:
                capture.release()
            if self._timing.paced and delivered and not self._timing.loop and not self._stop.is_set():
                self._ended = True
                self._fail("played to its end")
                return
            if not (self._timing.loop and delivered):
                self._fail("it delivers no more frames")
                self._stop.wait(_RETRY_S)

    def _opened(self) -> Capture | None:
        try:
            capture = self._open()
            if capture is None or capture.isOpened():
                return capture
            capture.release()
        except Exception as error:  # whatever a device's library raises, the thread has to live on
            self._why = f"it could not be opened ({' '.join(str(error).split())[-100:]})"
        return None

    def _read_all(self, capture: Capture) -> bool:
        """Reads until nothing more comes; whether anything came."""
        self._clock.restart()
        delivered = False
        while not self._stop.is_set():
            try:
                good, picture = capture.read()
                position_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
            except cv2.error:
                return delivered
            if not good or picture is None:
                return delivered
            stamp, due_s = self._clock.stamp(position_s, host_now())
            if due_s > 0.0 and self._stop.wait(due_s):
                return delivered
            delivered = True
            self._push(stamp if due_s <= 0.0 else Stamp(stamp.device_s, host_now()), np.asarray(picture, np.uint8))
        return delivered

    def _push(self, stamp: Stamp, picture: Picture) -> None:
        with self._lock:
            self._waiting.append(Grabbed(stamp, picture, self._count))
            self._count += 1
            if len(self._waiting) > self._room:
                self._waiting.popleft()
                self._dropped += 1
            self._heard_s = host_now()
            self._alive, self._told = True, False

    def _fail(self, why: str, *, waiting: bool = False) -> None:
        with self._lock:
            if self._alive or not waiting:
                self._why = why
            self._alive = False


class _Clock:
    """Times of an input's frames, and how long a played one has to wait for its own."""

    def __init__(self, timing: Timing, origin: Origin) -> None:
        self._timing, self._origin = timing, origin
        self._trust = timing.device_clock
        self._last_s = -math.inf
        self._shift_s = 0.0
        self._period_s = _PERIOD_S

    def restart(self) -> None:
        """The capture was opened anew: a file starts at zero again, a device's clock goes on or does not."""
        if self._timing.paced and math.isfinite(self._last_s):
            self._shift_s = self._last_s + self._period_s
        else:
            self._last_s = -math.inf
            self._trust = self._timing.device_clock

    def stamp(self, position_s: float, host_s: float) -> tuple[Stamp, float]:
        """The frame's stamp, and how long it has to wait (s) where it is played."""
        device_s = position_s + self._shift_s
        if self._timing.paced and not (math.isfinite(device_s) and device_s > self._last_s):
            # A file that does not know its positions is played at the pace it had so far.
            device_s = self._last_s + self._period_s if math.isfinite(self._last_s) else 0.0
        if self._trust and math.isfinite(device_s) and device_s > self._last_s:
            if math.isfinite(self._last_s):
                self._period_s = device_s - self._last_s
            self._last_s = device_s
        else:
            self._trust = False
            device_s = host_s
        due_s = self._origin.due_s(device_s, host_s) if self._timing.paced and self._trust else 0.0
        return Stamp(device_s - self._timing.delay_s, host_s), due_s
