"""Devices of a live session that are lost and come back: time until it is reported, and until they are used again.

A session runs in the simulated room (a process of its own) with the code of ``fgreg live``. Faults are caused one after
another, each for some seconds and several times. Printed for each: time from the fault until it is reported to the
operator; time from its end until the return is reported, and until the next stage order; and the activity of the
session during the fault, per second: frames processed, pulses taken in, orders given. Exit status 1 where a report came
later than a second, or not at all.

    python tools/study_lost.py --repeat 10 --fault camera-frozen watchdog-killed
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

sys.path.insert(0, os.fspath(Path(__file__).resolve().parent.parent))
from fgreg.model.events import NoteEvent
from fgreg.session.session_reader import read_session
from tests.live_rig import STUDIED, Trial, rig, trial

TOLD_S = 1.0


def show(name: str, trials: Sequence[Trial]) -> bool:
    """One line; whether all was reported in time."""

    def column(values: Sequence[float]) -> str:
        known = [value for value in values if math.isfinite(value)]
        return f"{np.median(known):6.2f} {max(known):6.2f}" if known else "     -      -"

    told = [one.reported_s for one in trials]
    rates = np.mean([one.rates for one in trials], axis=0)
    print(
        f"{name:<16} {len(trials):>3}  {column(told)}   {column([one.back_s for one in trials])}   "
        f"{column([one.order_s for one in trials])}   {rates[0]:6.1f} {rates[1]:6.1f} {rates[2]:6.1f}",
        flush=True,
    )
    return all(value <= TOLD_S for value in told)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=10)
    parser.add_argument("--lasts", type=float, default=3.0, help="seconds that a fault lasts (default: %(default)s)")
    parser.add_argument("--fault", nargs="+", choices=sorted(STUDIED), default=list(STUDIED))
    arguments = parser.parse_args()
    print("                      reported s         back s      next order s     frames pulses orders, per s meanwhile")
    print("fault          times  median    max   median    max   median    max")
    in_time = True
    for name in arguments.fault:
        fault = STUDIED[name]
        with tempfile.TemporaryDirectory() as folder, rig(Path(folder) / "session") as case:
            trials = [trial(case, fault, arguments.lasts) for _ in range(arguments.repeat)]
            case.session.recorder.close()
            notes = [e for e in read_session(Path(folder) / "session").events if isinstance(e, NoteEvent)]
            lost = sum(one.text.startswith(f"{fault.role} lost") for one in notes)
            told = [said for _, said in case.operator.messages if " lost: " in said]
            own = [said for said in told if said.startswith(f"{fault.role} lost")]
            for said in told:
                if said not in own:
                    print(f"{name}: also reported: {said}")
            if lost != len(own):
                print(f"{name}: reported {len(own)} times, recorded {lost} times")
                in_time = False
        in_time &= show(name, trials)
    return 0 if in_time else 1


if __name__ == "__main__":
    sys.exit(main())
