"""The process that locates sources in the probe's frames; started anew where it has ended or hangs."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

import numpy.typing as npt

from fgreg.detection.photoacoustic import locate_in_frame
from fgreg.detection.results import NoSignal, PaFind
from fgreg.models import ProbeModel
from fgreg.workers.worker_process import NICENESS

ASK_S = 0.2
"""It is asked this often whether it is there, also where there is nothing to locate."""
MUTE_S = 2.0
"""Without an answer for so long it is told to be gone."""
HANGS_S = 10.0
"""And ended after so long, for another to take over."""
START_S = 30.0
"""So long it may take for its first answer."""

Result = TypeVar("Result")


class Locator:
    """One process at a time.

    Attributes:
        trouble: what is wrong with it; empty where it answers.
    """

    def __init__(self, probe: ProbeModel) -> None:
        self._probe, self.trouble = probe, ""
        self._begin()

    def _begin(self) -> None:
        self._pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=_stand_back)
        self._pid: int | None = None
        self._waits_s = time.monotonic()  # for an answer, since
        self._asked_s, self._answers = self._waits_s, False
        self._asked: Future[int] | None = self._pool.submit(os.getpid)  # before any frame: it may have to be ended

    def submit(self, data: npt.NDArray[Any]) -> Future[PaFind | NoSignal]:
        """Have a source located. The future raises BrokenProcessPool where the process ended meanwhile."""
        return self.run(locate_in_frame, data, self._probe)

    def run(self, work: Callable[..., Result], *arguments: Any) -> Future[Result]:
        """Have something else done there; as :meth:`submit`."""
        try:
            found = self._pool.submit(work, *arguments)
        except BrokenProcessPool:
            self._again("it had ended")
            found = self._pool.submit(work, *arguments)
        found.add_done_callback(self._answered)
        return found

    def look_after(self, now_s: float) -> None:
        """See that it is there. Call it often."""
        if self._asked is not None and self._asked.done():
            if self._asked.exception() is not None:
                self._again("it had ended")
                return
            self._pid, self._asked = self._asked.result(), None
            self.trouble = ""
        if self._asked is None and now_s - self._asked_s > ASK_S:
            self._asked_s = self._waits_s = now_s
            try:
                self._asked = self._pool.submit(os.getpid)
            except BrokenProcessPool:
                self._again("it had ended")
        if self._answers:
            self.trouble, self._answers = "", False
        waited = now_s - self._waits_s
        if self._asked is not None and waited > (START_S if self._pid is None else MUTE_S):
            self.trouble = self.trouble or f"it has not answered for {waited:.1f} s"
            if self._pid is not None and waited > HANGS_S:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(self._pid, signal.SIGKILL)  # the pool breaks, and is begun again
                self._pid = None

    def _answered(self, found: Future[Any]) -> None:
        """On a thread of the pool's: any answer is a sign of life."""
        if not found.cancelled() and not isinstance(found.exception(), BrokenProcessPool):
            self._waits_s, self._answers = max(self._waits_s, time.monotonic()), True

    def _again(self, why: str) -> None:
        self.trouble = why
        self._pool.shutdown(wait=False, cancel_futures=True)
        self._begin()

    def close(self) -> None:
        """End the process."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def _stand_back() -> None:
    """Frames come first: sources are located in what they leave. Ctrl-C is the main program's business."""
    os.nice(NICENESS)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


__all__ = ["Locator"]
