"""Independent tasks: the same results in one process, on a pool that loses a worker, on Dask, and by submitit."""

import os
import signal
import time
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from functools import partial
from multiprocessing import active_children
from pathlib import Path
from typing import Any

import pytest

from fgreg.cli.executors import open_executor
from fgreg.errors import InputError
from fgreg.workers.tasks import run_tasks

TASKS = list(range(12))
NOT_THERE = ["remote", "dask", "dask:host", "dask:tcp://127.0.0.1:9", "slurm:partition", "local:x"]


def square(task: int) -> int:
    return task * task


def killed_once(task: int, mark: Path) -> int:
    """Kills its own process at task 5, unless that was done before."""
    if task == 5 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return square(task)


def always_killed(task: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return task


def refuses(task: int) -> int:
    if task == 7:
        raise InputError("task", "7", "another one")
    return task


def refuses_or_sleeps(task: int) -> int:
    if task:
        time.sleep(60.0)
    return refuses(7 - task)


class Shaky:
    """Does one task in three; all others are lost."""

    calls = 0

    def submit(self, fn: Any, /, *args: Any) -> Future[Any]:
        handle: Future[Any] = Future()
        if self.calls % 3:
            handle.set_exception(BrokenExecutor("a worker was killed"))
        else:
            handle.set_result(fn(*args))
        self.calls += 1
        return handle


class Closed:
    """Takes nothing."""

    def submit(self, *_: Any) -> Future[Any]:
        raise RuntimeError("sbatch: invalid partition")


def test_a_killed_worker_costs_time_only(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    mark = tmp_path / "killed"
    found = run_tasks(partial(killed_once, mark=mark), TASKS, jobs=2, progress=lambda *done: seen.append(done))
    assert list(found) == [square(task) for task in TASKS]
    assert mark.exists()
    assert seen[-1] == (12, 12)


def test_workers_may_be_lost_often_where_others_get_on() -> None:
    found = run_tasks(square, TASKS, jobs=3, executor=Shaky())
    assert list(found) == [square(task) for task in TASKS]


def test_an_executor_that_takes_no_tasks_is_a_broken_one() -> None:
    with pytest.raises(BrokenExecutor, match="takes no tasks: sbatch: invalid partition"):
        list(run_tasks(square, TASKS, executor=Closed()))


def test_workers_at_work_end_with_the_run() -> None:
    begun = time.monotonic()
    with pytest.raises(InputError, match="found 7"):
        list(run_tasks(refuses_or_sleeps, [0, 1], jobs=2))
    for child in active_children():
        child.join(20.0)
    assert time.monotonic() - begun < 40.0


def test_a_worker_lost_again_and_again_ends_the_run() -> None:
    with pytest.raises(BrokenExecutor, match="lost 3 times"):
        list(run_tasks(always_killed, TASKS[:2], jobs=2))


@pytest.mark.parametrize("threads", [0, 2])
def test_an_exception_of_the_function_comes_back_as_it_is(threads: int) -> None:
    with ThreadPoolExecutor(2) as pool, pytest.raises(InputError, match="found 7"):
        list(run_tasks(refuses, TASKS, jobs=max(threads, 1), executor=pool if threads else None))


def test_the_same_on_a_dask_cluster(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster,
        open_executor(f"dask:{cluster.scheduler_address}") as executor,
    ):
        assert list(run_tasks(partial(killed_once, mark=tmp_path / "killed"), TASKS, jobs=2, executor=executor)) == [
            square(task) for task in TASKS
        ]


def test_the_same_by_submitit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("submitit")
    monkeypatch.chdir(tmp_path)
    with open_executor("submitit-local") as executor:
        assert list(run_tasks(square, TASKS[:2], executor=executor)) == [0, 1]


@pytest.mark.parametrize("named", NOT_THERE)
def test_an_executor_that_is_not_there_is_one_line(named: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fgreg.cli.executors.DASK_ANSWER_S", 0.2)
    with pytest.raises(InputError, match="--executor"), open_executor(named):
        pass
