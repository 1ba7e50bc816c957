"""One video input, read in a thread of its own, which opens the capture again after a loss.

The thread only reads and stamps. Frames wait in a short queue; if they are not fetched in time, the oldest are dropped
and counted. :meth:`VideoInput.poll` raises once if a capture ends, fails or falls silent; the thread keeps trying to
open it.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import cv2

from fgreg.detection.frame_files import Picture, as_picture
from fgreg.drivers.base import DeviceLost, host_now
from fgreg.errors import InputError
from fgreg.model.time_sync import Stamp

SILENCE_S = 0.7
"""A device without a frame for this long counts as lost, so that the loss is reported within a second."""
_RETRY_S = 0.3
_CLOSE_S = 2.0
_PERIOD_S = 1.0 / 30.0


class Capture(Protocol):
    """The part of cv2.VideoCapture that is used here; image folders and tests implement it too."""

    def isOpened(self) -> bool: ...
    def read(self) -> tuple[bool, Any]: ...
    def get(self, property_id: int, /) -> float: ...
    def release(self) -> None: ...


@dataclass(frozen=True, slots=True)
class Timing:
    """How an input's frames get their times.

    Attributes:
        device_clock: take the capture's own time (``CAP_PROP_POS_MSEC``: the driver's for V4L2, the position for
            files); otherwise, and if it does not advance, the host's time of arrival.
        delay_s: from the middle of the exposure to the device's stamp; subtracted.
        paced: hand frames on in real time, as a device would (files and folders).
        loop: start again at the end (files and folders).
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
    """One frame of one input; ``index`` counts all frames of the device, fetched or not."""

    stamp: Stamp
    picture: Picture
    index: int


class Origin:
    """Start of playback: shared by inputs that play together, set by the first frame of any of them."""

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
        name: shown to the user.
        open_capture: makes the capture; None, or one that is not opened, if the device is absent.
        timing: of its frames.
        queue: largest number of waiting frames.
        origin: of playback, shared by inputs that play together.
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
        self._received_s = host_now()
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
        """Whether a file has been played to its end."""
        return self._ended

    @property
    def dropped(self) -> int:
        """Number of frames that were not fetched in time, or could not be decoded."""
        return self._dropped

    def poll(self) -> list[Grabbed]:
        """Frames since the last call, oldest first.

        Raises:
            DeviceLost: once for each loss, after the frames before it have been fetched.
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
        """Stop reading and release the device; may be called twice."""
        self._stop.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(_CLOSE_S)
        with self._lock:
            self._alive = False
            self._waiting.clear()

    def _silent(self) -> bool:
        if self._timing.paced and self._count:
            return False  # it waits for its pace, and reports its end
        return host_now() - self._received_s > self._timing.silence_s

    def _silent_or_failed(self) -> bool:
        # A device that has not connected yet gets the same time as one that fell silent.
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
            except (InputError, ValueError) as error:  # pictures that must not be used: opening again mends nothing
                self._fail(str(error))
                return
            finally:
                capture.release()
            skipped = list(getattr(capture, "unreadable", ()))  # of a folder of pictures
            self._dropped += len(skipped)
            besides = f"; {len(skipped)} pictures could not be decoded, {skipped[0].name} first" if skipped else ""
            if self._timing.paced and delivered and not self._timing.loop and not self._stop.is_set():
                self._ended = True
                self._fail(f"played to its end{besides}")
                return
            if not (self._timing.loop and delivered):
                self._fail(f"it delivers no more frames{besides}")
                self._stop.wait(_RETRY_S)

    def _opened(self) -> Capture | None:
        try:
            capture = self._open()
            if capture is None or capture.isOpened():
                return capture
            capture.release()
        except Exception as error:  # the thread has to survive any error of a device's library
            self._why = f"it could not be opened ({' '.join(str(error).split())[-100:]})"
        return None

    def _read_all(self, capture: Capture) -> bool:
        """Read until the capture ends; whether any frame came. InputError or ValueError: it has unusable pictures."""
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
            self._push(stamp if due_s <= 0.0 else Stamp(stamp.device_s, host_now()), as_picture(picture))
        return delivered

    def _push(self, stamp: Stamp, picture: Picture) -> None:
        with self._lock:
            self._waiting.append(Grabbed(stamp, picture, self._count))
            self._count += 1
            if len(self._waiting) > self._room:
                self._waiting.popleft()
                self._dropped += 1
            self._received_s = host_now()
            self._alive, self._told = True, False

    def _fail(self, why: str, *, waiting: bool = False) -> None:
        with self._lock:
            if self._alive or not waiting:
                self._why = why
            self._alive = False


class _Clock:
    """Stamps an input's frames, and computes how long a played frame has to wait."""

    def __init__(self, timing: Timing, origin: Origin) -> None:
        self._timing, self._origin = timing, origin
        self._trust = timing.device_clock
        self._last_s = -math.inf
        self._shift_s = 0.0
        self._period_s = _PERIOD_S

    def restart(self) -> None:
        """The capture was opened again: a file starts at zero, a device's clock may continue or restart."""
        if self._timing.paced and math.isfinite(self._last_s):
            self._shift_s = self._last_s + self._period_s
        else:
            self._last_s = -math.inf
            self._trust = self._timing.device_clock

    def stamp(self, position_s: float, host_s: float) -> tuple[Stamp, float]:
        """The frame's stamp, and how long a played frame has to wait (s)."""
        device_s = position_s + self._shift_s
        if self._timing.paced and not (math.isfinite(device_s) and device_s > self._last_s):
            # A file without positions continues at its last frame period.
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
