"""How long the stage goes on after the main program has failed: killed, stalled, or gone with a child left behind.

Each trial starts a main program with its watchdog and a simulated stage, lets the stage turn, and ends the main
program. Printed: time from its end to the watchdog's order to stop, as the stage's side has it, beside the deadline: at
once where the end of the connection shows it, else one heartbeat (0.5 s here) and what the watchdog's loop takes.

    python tools/bench_stage_stop.py --trials 10
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
from fgreg.motion.device import MAX_CALL_S
from fgreg.motion.watchdog import TICK_S
from tests.stage_ends import main_program, stopped_after
from tests.stage_main import LIMITS

LOOP_S = MAX_CALL_S + 2.0 * TICK_S
TARGETS_S = {"kill -9": LOOP_S, "exit": LOOP_S, "stall": LIMITS.heartbeat_s + LOOP_S}
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


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=10)
    arguments = parser.parse_args()
    met = True
    for end, target in TARGETS_S.items():
        took = 1e3 * np.array([trial(end) for _ in range(arguments.trials)])
        met &= bool(took.max() <= 1e3 * target)
        row = f"median {np.median(took):4.0f} ms   longest {took.max():4.0f} ms   deadline {1e3 * target:4.0f} ms"
        print(f"{end:<14} {row}")
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
