"""Main programs that end while their stage turns, and the time until it stops: for tests and benchmark."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fgreg.stage.interface import MAX_CALL_S
from fgreg.stage.watchdog import TICK_S
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


SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL, signal.SIGSTOP)
"""Signals that end or halt a main program: Ctrl-C, SIGTERM, a closed terminal, SIGKILL, a suspension."""


@contextmanager
def live_program(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """``fgreg live`` in the simulated room, which homes the stage and searches; its session is in ``folder``."""
    code = "import sys; from fgreg.cli.main import main; sys.exit(main())"
    words = ["live", "--no-viewer", "--width", "320", "--aims", "0", "--bump-every", "inf", "--out", os.fspath(folder)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, "-c", code, *words],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def orders(folder: Path) -> list[dict[str, Any]]:
    """The orders of a live program's watchdog up to now."""
    path = folder / "stage-orders.log"
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]


def live_stopped_after(folder: Path, phase: str, number: signal.Signals) -> float:
    """Seconds from a signal to a live program, sent while its stage homes or searches, to the order that ends motion.

    0 where the stage had already been stopped for a missing heartbeat on a busy machine.
    """
    with live_program(folder) as process:
        wait_until(lambda: any(order["command"] == phase for order in orders(folder)), 120.0)
        sent = time.monotonic()
        process.send_signal(number)
        wait_until(lambda: orders(folder)[-1]["command"] == "stop")
        time.sleep(1.0)
        given = orders(folder)
    assert given[-1]["command"] == "stop"
    moved = max(i for i, order in enumerate(given) if order["command"] != "stop")
    return max(0.0, float(given[moved + 1]["t"]) - sent)


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
