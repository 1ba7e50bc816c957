"""A worker process: answers come back; one that fails, ends, hangs or cannot start is reported and replaced."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from fgreg.workers import progress, worker_process
from fgreg.workers.progress import DISK_S, Progress
from fgreg.workers.worker_process import WorkerProcess

PATIENCE_S = 60.0
Worker = WorkerProcess[Any, Any]


def _answer(request: Any) -> Any:
    match request:
        case "exit":
            os._exit(1)
        case "sleep":
            time.sleep(600.0)
        case "work":
            end = time.process_time() + 0.5
            while time.process_time() < end:
                pass
            return 0.5
        case "not to be sent":
            return lambda: None
        case "pid":
            return os.getpid()
        case "nice":
            return os.nice(0)
        case float() if request < 0:
            raise ValueError("a number below 0")
        case bytes():
            return len(request)
    return request / 2


def halving() -> Callable[[Any], Any]:
    return _answer


class Counter:
    """Has state: how many requests came, how often it was idle."""

    def __init__(self, begin: int, left: Path) -> None:
        self.count, self.idles, self.left = begin, 0, left

    def __call__(self, request: str) -> int:
        if request == "exit":
            os._exit(1)
        self.count += 1
        return self.idles if request == "idle" else self.count

    def idle(self) -> None:
        self.idles += 1


@contextmanager
def counting(begin: int, left: Path) -> Iterator[Counter]:
    yield Counter(begin, left)
    left.touch()


def starts_once(marker: Path) -> Callable[[Any], Any]:
    if marker.exists():
        raise LookupError("no second time")
    marker.touch()
    return _answer


@pytest.fixture
def start() -> Iterator[Callable[..., Worker]]:
    """Makes workers, and closes them."""
    made: list[Worker] = []

    def begin(make: Callable[..., Any] = halving, *arguments: Any, **options: Any) -> Worker:
        made.append(WorkerProcess(make, *arguments, name="halving", what="the halving process", **options))
        return made[-1]

    yield begin
    for worker in made:
        worker.close()
        assert not worker.alive


def asked(worker: Worker, request: Any) -> Any:
    worker.send(request)
    reply = worker.fetch(PATIENCE_S)
    assert reply is not None
    return reply[0]


def checked(worker: Worker) -> bool:
    worker.check()
    return True


def until(condition: Callable[[], object]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_answers_come_back_and_a_request_that_fails_is_reported_until_one_works(start: Callable[..., Worker]) -> None:
    worker = start()
    worker.send(3.0)
    assert worker.busy
    with pytest.raises(RuntimeError, match="busy"):
        worker.send(4.0)
    assert worker.fetch(PATIENCE_S) == (1.5,)
    assert not worker.busy
    assert worker.fetch() is None
    assert asked(worker, -1.0) is None
    assert worker.failure == "ValueError: a number below 0"
    assert not worker.lost
    assert asked(worker, 8.0) == 4.0
    assert worker.failure == ""
    assert asked(worker, bytes(3_000_000)) == 3_000_000
    assert asked(worker, "nice") == os.nice(0) + worker_process.NICENESS
    with pytest.raises(AttributeError, match="pickle"):
        worker.send(lambda: None)
    assert asked(worker, 8.0) == 4.0
    assert asked(worker, "not to be sent") is None
    assert "lambda" in worker.failure
    assert asked(worker, 8.0) == 4.0


def test_the_request_under_way_is_lost_with_its_process_and_the_next_one_is_answered(
    start: Callable[..., Worker],
) -> None:
    worker = start()
    before = asked(worker, "pid")
    assert asked(worker, "exit") is None
    assert worker.failure == "the halving process has ended"
    assert worker.trouble == "it has ended"
    assert worker.lost
    assert not worker.ready
    assert asked(worker, "pid") not in (None, before)
    assert worker.failure == worker.trouble == ""
    assert not worker.lost


def test_a_process_that_ended_while_idle_is_noticed_and_replaced(start: Callable[..., Worker]) -> None:
    worker = start()
    pid = asked(worker, "pid")
    os.kill(pid, signal.SIGKILL)
    until(lambda: checked(worker) and worker.trouble)
    assert worker.failure == ""  # no request was lost
    until(lambda: checked(worker) and worker.ready)
    assert worker.trouble == ""
    assert worker.pid != pid
    assert asked(worker, 3.0) == 1.5


def test_an_overdue_answer_is_reported_then_its_process_is_killed(
    start: Callable[..., Worker], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_process, "SLOW_S", 0.1)
    worker = start(answer_s=1.0)
    pid = asked(worker, "pid")
    worker.send("sleep")
    until(lambda: worker.fetch() is None and worker.trouble)
    assert worker.busy
    assert worker.fetch(PATIENCE_S) == (None,)
    assert "the halving process has not answered for 1." in worker.failure
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    assert asked(worker, 3.0) == 1.5
    monkeypatch.setattr(worker_process, "UNKNOWN_S", 0.3)
    assert worker._progress is not None
    worker.answer_s, worker._progress.known, worker._progress._path = 0.05, False, Path("/nowhere")  # as on macOS
    assert asked(worker, "sleep") is None
    assert re.search(r"not answered for 0\.[3-9]", worker.failure)


def test_a_process_that_works_is_slow_and_not_dead_until_it_has_worked_too_much(
    start: Callable[..., Worker], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_process, "SLOW_S", 0.15)
    worker, endless = start(answer_s=0.3), start(answer_s=PATIENCE_S, work_s=0.2)
    worker.send("work")
    endless.send("work")
    troubles = set()
    while (reply := worker.fetch(0.02)) is None:
        troubles.add(worker.trouble)
    assert reply == (0.5,)
    assert troubles == {""}
    assert endless.fetch(PATIENCE_S) == (None,)
    assert "has worked for 0.2 s without an answer" in endless.failure


def test_a_process_that_hangs_while_idle_is_reported_and_goes_on_where_it_can(
    start: Callable[..., Worker], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_process, "SLOW_S", 0.1)
    worker = start(answer_s=PATIENCE_S)
    pid = asked(worker, "pid")
    os.kill(pid, signal.SIGSTOP)
    until(lambda: checked(worker) and worker.trouble)
    worker.send(3.0)  # waits for the process
    assert worker.fetch(0.1) is None
    os.kill(pid, signal.SIGCONT)
    assert worker.fetch(PATIENCE_S) == (1.5,)
    assert worker.pid == pid
    assert worker.trouble == ""


@pytest.mark.parametrize("goes_on", [True, False])
def test_a_process_that_does_not_read_a_long_request_does_not_hold_up_its_owner(
    start: Callable[..., Worker], goes_on: bool
) -> None:
    worker = start(answer_s=PATIENCE_S if goes_on else 1.0)
    pid = asked(worker, "pid")
    os.kill(pid, signal.SIGSTOP)
    began = time.monotonic()
    worker.send(bytes(3_000_000))
    assert worker.fetch() is None
    assert time.monotonic() - began < 0.5
    if goes_on:
        os.kill(pid, signal.SIGCONT)
        assert worker.fetch(PATIENCE_S) == (3_000_000,)
    else:
        assert worker.fetch(PATIENCE_S) == (None,)
        assert worker.lost
    assert asked(worker, 3.0) == 1.5
    assert (worker.pid == pid) is goes_on


def test_state_lasts_from_request_to_request_and_begins_again_with_a_new_process(
    start: Callable[..., Worker], tmp_path: Path
) -> None:
    left = tmp_path / "left"
    worker = start(counting, 10, left, end_s=PATIENCE_S)
    assert [asked(worker, "count") for _ in range(3)] == [11, 12, 13]
    time.sleep(10 * worker_process.IDLE_S)
    assert asked(worker, "idle") > 0
    assert asked(worker, "exit") is None
    assert asked(worker, "count") == 11
    assert not left.exists()
    worker.close()
    assert left.exists()  # the context was left


def test_without_restart_every_request_fails_once_the_process_has_ended(start: Callable[..., Worker]) -> None:
    worker = start(restart=False)
    assert asked(worker, "exit") is None
    for _ in range(2):
        assert asked(worker, 3.0) is None
        assert worker.failure == "the halving process has ended"
    assert not worker.alive


def test_a_process_that_cannot_start_says_why(start: Callable[..., Worker], tmp_path: Path) -> None:
    worker = start(starts_once, tmp_path / "once")
    assert asked(worker, 3.0) == 1.5
    assert asked(worker, "exit") is None
    until(lambda: checked(worker) and "LookupError: no second time" in worker.trouble)
    (tmp_path / "once").unlink()
    until(lambda: checked(worker) and worker.ready)
    assert asked(worker, 3.0) == 1.5


def test_ctrl_c_is_not_for_workers(start: Callable[..., Worker]) -> None:
    worker = start()
    assert worker.pid is not None
    os.kill(worker.pid, signal.SIGINT)  # while it starts
    pid = asked(worker, "pid")
    os.kill(pid, signal.SIGINT)
    assert asked(worker, "pid") == pid


OWNER = """
import sys, time
from fgreg.workers.worker_process import WorkerProcess
from tests.test_worker_process import halving
if __name__ == "__main__":
    worker = WorkerProcess(halving, name="halving", what="the halving process")
    worker.send("pid")
    print(worker.fetch(60.0)[0], flush=True)
    if "busy" in sys.argv:
        worker.send(bytes(3_000_000))
    time.sleep(60.0)
"""


@pytest.mark.parametrize("state", ["idle", "busy"])
def test_a_worker_ends_with_an_owner_that_is_killed(tmp_path: Path, state: str) -> None:
    (tmp_path / "owner.py").write_text(OWNER)
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent.parent)}
    command = [sys.executable, str(tmp_path / "owner.py"), state]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as owner:
        assert owner.stdout is not None
        pid = int(owner.stdout.readline())
        owner.kill()
        owner.wait()

    def gone() -> bool:
        stat = Path(f"/proc/{pid}/stat")
        return not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] == "Z"

    until(gone)


def test_a_process_whose_disk_never_answers_hangs_and_one_that_is_ready_to_run_is_slow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, stat = [0.0], tmp_path / "stat"
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: now[0]))

    def idle_after(state: str, seconds: float) -> float:
        stat.write_text(f"1 (a) b) {state} " + "0 " * 20, encoding="ascii")
        watched = Progress(1)
        watched._path = stat
        for _ in range(round(seconds)):
            now[0] += 1.0
            watched.idle_s()
        return watched.idle_s()

    assert idle_after("R", 3.0 * DISK_S) == idle_after("D", 0.5 * DISK_S) == 0.0
    assert idle_after("D", 3.0 * DISK_S) > DISK_S
    for state in ("S", "T", "Z"):
        assert idle_after(state, 5.0) == 5.0
