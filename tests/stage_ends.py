"""Main programs that come to an end while their stage turns, and how long it then took to stop: tests and benchmark."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from fgreg.motion.device import MAX_CALL_S
from fgreg.motion.watchdog import TICK_S
from tests.stage_main import LIMITS
from tests.traced_stage import read_trace

ROOT = Path(__file__).resolve().parents[1]
DEADLINE_S = LIMITS.heartbeat_s + MAX_CALL_S + 2.0 * TICK_S + 0.25
"""From the main program's last sign of life to the order to stop; the last term is for a busy machine."""


@contextmanager
def main_program(folder: Path, end: str) -> Iterator[tuple[subprocess.Popen[str], int, float]]:
    """A main program whose stage turns: process, the watchdog's id, time at which its end begins."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.stage_main", str(folder), end],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    try:
        assert process.stdout is not None
        began = process.stdout.readline().split()
        assert began[:1] == ["moving"], "the main program did not come so far"
        watchdog = int(began[1])
        yield process, watchdog, float(process.stdout.readline())
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def wait_until(condition: Callable[[], object], seconds: float = 10.0) -> None:
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "did not happen"
        time.sleep(0.02)


def is_gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def stopped_after(trace: Path, since_s: float) -> float:
    """Seconds from a moment to the first order to stop after it; the stage stands in the end and got no other order."""
    wait_until(lambda: any(line["what"] == "stop" and line["t"] >= since_s for line in read_trace(trace)))
    wait_until(lambda: [line for line in read_trace(trace) if line["what"] == "status"][-1]["moving"] is False)
    after = [line for line in read_trace(trace) if line["t"] >= since_s]
    assert not [line for line in after if line["what"] in ("move", "home")]
    last = [line for line in after if line["what"] == "status"][-1]
    assert last["deg"] < 50.0, "it went all the way"
    return float(next(line["t"] for line in after if line["what"] == "stop")) - since_s
