"""Time until the stage stops after the main program has failed: killed, stalled, or ended with a child left behind.

Each trial starts a main program with its watchdog and a simulated stage, lets the stage turn, and ends the main
program. Printed: time from its end to the watchdog's stop order, recorded at the stage, beside the deadline: immediate
where the connection ends, else one heartbeat (0.5 s here) and one cycle of the watchdog's loop.
``--live``: the same for signals to ``fgreg live`` in its simulated room (heartbeat 1 s), while its stage homes and as
it searches, by the watchdog's own log.

    python tools/bench_stage_stop.py --trials 10
    python tools/bench_stage_stop.py --trials 5 --live
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, os.fspath(Path(__file__).resolve().parent.parent))
from fgreg.stage.interface import MAX_CALL_S
from fgreg.stage.watchdog import TICK_S
from tests.stage_ends import SIGNALS, live_stopped_after, main_program, stopped_after
from tests.stage_main import LIMITS

LOOP_S = MAX_CALL_S + 2.0 * TICK_S
TARGETS_S = {"kill -9": LOOP_S, "exit": LOOP_S, "stall": LIMITS.heartbeat_s + LOOP_S}
LIVE_S = 1.0 + LOOP_S
TARGETS_S["fork and die"] = LIMITS.heartbeat_s + LOOP_S


def trial(end: str) -> float:
    """Seconds from the end of one main program to the order to stop."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with main_program(folder, end) as (process, _, began):
            if end == "kill -9":
                began = time.monotonic()
                process.send_signal(signal.SIGKILL)
            return stopped_after(folder / "trace", began)


def live_trial(phase: str, number: signal.Signals) -> float:
    """Seconds from a signal to ``fgreg live`` to the order to stop."""
    with tempfile.TemporaryDirectory() as name:
        return live_stopped_after(Path(name) / "session", phase, number)


def show(end: str, took_s: list[float], target_s: float) -> bool:
    """One line; whether the deadline was met."""
    took = 1e3 * np.array(took_s)
    row = f"median {np.median(took):4.0f} ms   longest {took.max():4.0f} ms   deadline {1e3 * target_s:4.0f} ms"
    print(f"{end:<16} {row}", flush=True)
    return bool(took.max() <= 1e3 * target_s)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--live", action="store_true", help="signals to fgreg live")
    arguments = parser.parse_args()
    if arguments.live:
        cases = [(phase, number) for number in SIGNALS for phase in ("home", "search")]
        met = [
            show(f"{number.name} {phase}", [live_trial(phase, number) for _ in range(arguments.trials)], LIVE_S)
            for phase, number in cases
        ]
    else:
        met = [show(end, [trial(end) for _ in range(arguments.trials)], target) for end, target in TARGETS_S.items()]
    return 0 if all(met) else 1


if __name__ == "__main__":
    sys.exit(main())
