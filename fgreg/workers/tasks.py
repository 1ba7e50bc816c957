"""Independent tasks on any executor: one process, the cores of this machine, or a cluster.

An executor is what has `submit(function, *arguments)`, whose answer has `done()` and `result()`: each
`concurrent.futures.Executor` (Dask's by `Client.get_executor()`), and submitit's for SLURM. Results come in the order
of the tasks, so that the same seeds give the same numbers wherever they are computed.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from typing import Any, Protocol, TypeVar

from fgreg.workers.memory import keep_freed_memory
from fgreg.workers.parent import end_with_parent
from fgreg.workers.threads import one_thread_each

TaskT = TypeVar("TaskT")
ResultT = TypeVar("ResultT")
POLL_S = 0.02
TRIES = 3
"""A part of the tasks whose worker was lost this often, with no other part done between, is the cause itself."""
PARTS_PER_JOB = 4
MOST_PER_PART = 8
"""Tasks sent to a worker at once, on this machine: few, so that progress is seen."""


class Handle(Protocol):
    """A submitted call."""

    def done(self) -> bool: ...

    def result(self) -> Any: ...


class Executor(Protocol):
    """Where calls run: `concurrent.futures.Executor`, or submitit's."""

    def submit(self, fn: Callable[..., Any], /, *args: Any) -> Handle: ...


def _begin() -> None:
    """First of all in a worker process."""
    end_with_parent()
    keep_freed_memory()


class _LocalPool:
    """The cores of this machine. A pool that lost a worker takes nothing more, so that another one follows it."""

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._pool: ProcessPoolExecutor | None = None

    def submit(self, fn: Callable[..., Any], /, *args: Any) -> Handle:
        from multiprocessing import get_context

        with one_thread_each():
            if self._pool is not None:
                try:
                    return self._pool.submit(fn, *args)
                except BrokenExecutor:
                    self._pool.shutdown(wait=False)
            # spawn: a fork would inherit the threads of the linear algebra libraries in an undefined state.
            self._pool = ProcessPoolExecutor(self._jobs, get_context("spawn"), _begin)
            return self._pool.submit(fn, *args)

    def close(self) -> None:
        """End the workers, also those at work: no one waits for what they do."""
        if self._pool is not None:
            workers = [*(self._pool._processes or {}).values()]  # later Pythons have `terminate_workers`
            self._pool.shutdown(wait=False, cancel_futures=True)
            for worker in workers:
                worker.terminate()


def run_tasks(
    function: Callable[[TaskT], ResultT],
    tasks: Sequence[TaskT],
    *,
    jobs: int = 1,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[ResultT]:
    """Results of ``function`` for each task, in the order of the tasks.

    Args:
        function: importable by its name, or a partial of such a function; the same task gives the same result.
        tasks: what can be pickled.
        jobs: processes. 1 without an executor: this process. More require an importable main script (guard its main).
        executor: where to run; this machine where None.
        progress: called with (tasks done, all) as they are done, in any order.

    Raises:
        BrokenExecutor: the worker of the same tasks was lost ``TRIES`` times, or the executor takes no tasks.
        Exception: what the function raised, with the worker's traceback as a note.
    """
    jobs = max(min(jobs, len(tasks)), 1)
    if executor is None and jobs == 1:
        for count, task in enumerate(tasks, 1):
            found = function(task)
            if progress is not None:
                progress(count, len(tasks))
            yield found
        return
    size = -(-len(tasks) // (PARTS_PER_JOB * jobs))
    if executor is None:
        size = min(size, MOST_PER_PART)
    parts = [tasks[at : at + size] for at in range(0, len(tasks), size)]
    pool = _LocalPool(jobs) if executor is None else None
    where: Executor = executor if executor is not None else pool  # type: ignore[assignment]
    running: dict[int, Handle] = {}
    try:
        for index, part in enumerate(parts):
            running[index] = _submitted(where, function, part)
        yield from _in_order(function, parts, running, where, progress)
    finally:
        for handle in running.values():
            getattr(handle, "cancel", lambda: None)()
        if pool is not None:
            pool.close()


def _in_order(
    function: Callable[[TaskT], ResultT],
    parts: Sequence[Sequence[TaskT]],
    running: dict[int, Handle],
    where: Executor,
    progress: Callable[[int, int], None] | None,
) -> Iterator[ResultT]:
    """Results of the parts in their order; removes what is done from ``running``."""
    ready: dict[int, list[ResultT]] = {}
    lost = [0] * len(parts)
    total, done, following = sum(map(len, parts)), 0, 0
    while following < len(parts):
        for index, handle in list(running.items()):
            if not handle.done():
                continue
            del running[index]
            try:
                found, error = handle.result()
            except Exception as loss:  # the function's own exceptions come as a value
                lost[index] += 1
                if lost[index] == TRIES:
                    raise BrokenExecutor(f"a worker was lost {TRIES} times at the same tasks: {loss}") from loss
                running[index] = _submitted(where, function, parts[index])
                continue
            if error is not None:
                raise error
            ready[index] = found
            done += len(found)
            lost = [0] * len(parts)  # a pool that loses one worker loses the tasks of all others, too
            if progress is not None:
                progress(done, total)
        if following in ready:
            yield from ready.pop(following)
            following += 1
        else:
            time.sleep(POLL_S)


def _submitted(where: Executor, function: Callable[[TaskT], ResultT], part: Sequence[TaskT]) -> Handle:
    try:
        return where.submit(_run_part, function, part)
    except Exception as error:  # each executor has its own: a scheduler that is gone, a queue that SLURM does not have
        raise BrokenExecutor(f"it takes no tasks: {str(error) or type(error).__name__}") from error


def _run_part(
    function: Callable[[TaskT], ResultT], part: Sequence[TaskT]
) -> tuple[list[ResultT] | None, Exception | None]:
    """Results, or the exception: what else comes back from a worker means that it was lost."""
    try:
        return [function(task) for task in part], None
    except Exception as error:
        error.add_note(traceback.format_exc())
        return None, error
