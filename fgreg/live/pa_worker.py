"""Locates photoacoustic sources in a worker process, so that the live loop is not blocked."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy.typing as npt

from fgreg.detection.photoacoustic import locate_in_frame
from fgreg.detection.results import NoSignal, PaFind
from fgreg.errors import FgregError
from fgreg.model.probe_model import ProbeModel
from fgreg.workers.worker_process import Work, WorkerProcess

ANSWER_S, START_S = 10.0, 30.0
"""A process that takes longer to answer or to start is killed and replaced."""

Result = TypeVar("Result")


@dataclass(slots=True, eq=False)
class _Job:
    found: Future[Any]
    task: tuple[Callable[..., Any], tuple[Any, ...]]
    again: bool = False


class Locator:
    """Runs jobs one after the other in a worker process. For one thread, which calls :meth:`check` often.

    A job whose process ended is repeated once by the next process, and not again: the job may be the cause.
    """

    def __init__(self, probe: ProbeModel) -> None:
        self._probe = probe
        self._worker: WorkerProcess[Any, Any] = WorkerProcess(
            _doing, name="fgreg-locator", what="the locating process", answer_s=ANSWER_S, start_s=START_S
        )
        self._waiting: deque[_Job] = deque()
        self._under_way: _Job | None = None

    @property
    def trouble(self) -> str:
        """What is wrong with the process; empty if it answers."""
        return self._worker.trouble

    @property
    def pid(self) -> int | None:
        """Id of the process; None if there is none."""
        return self._worker.pid

    @property
    def ready(self) -> bool:
        """Whether the process has started."""
        return self._worker.ready

    @property
    def busy(self) -> bool:
        """Whether a job is running or waiting."""
        return self._under_way is not None or bool(self._waiting)

    def submit(self, data: npt.NDArray[Any]) -> Future[PaFind | NoSignal]:
        """Locate a source in one frame's data. The future raises FgregError if that fails."""
        return self.run(locate_in_frame, data, self._probe)

    def run(self, work: Callable[..., Result], *arguments: Any) -> Future[Result]:
        """Run another function in the process; the future is as that of :meth:`submit`."""
        job = _Job(Future(), (work, arguments))
        self._waiting.append(job)
        self._begin_next()
        return job.found

    def check(self) -> None:
        """Take in results, and restart the process if it has ended or hangs."""
        self._worker.check()
        job, reply = self._under_way, self._worker.fetch()
        if job is not None and reply is not None:
            if self._worker.lost and not job.again:
                job.again = True
                self._worker.send(job.task)
                return
            self._under_way = None
            if self._worker.failure:
                job.found.set_exception(FgregError(self._worker.failure))
            else:
                job.found.set_result(reply[0])
        self._begin_next()

    def _begin_next(self) -> None:
        while self._under_way is None and self._waiting:
            job = self._waiting.popleft()
            if job.found.set_running_or_notify_cancel():
                self._under_way = job
                self._worker.send(job.task)

    def close(self) -> None:
        """End the process."""
        self._worker.close()


def _doing() -> Work[Any, Any]:
    return _do


def _do(task: tuple[Callable[..., Any], tuple[Any, ...]]) -> Any:
    work, arguments = task
    return work(*arguments)
