"""Kill a recording process 200 times at random moments, and check that no acknowledged event is lost.

    python tools/study_kill.py                 # events through the whole session: disk, then estimate
    python tools/study_kill.py --journal-only  # the disk alone: more events per run
    python tools/study_kill.py --kills 1000 --seed 2

Each run opens the session again, continues after the last event, and is ended by SIGKILL. After each, every line but an
incomplete last one has to equal, byte by byte, the event given. At the end the sessions are opened once more; the
estimate has to be that of the same events without an interruption.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, os.fspath(Path(__file__).resolve().parent.parent))

from tests.kill import difference_from_uninterrupted, run_kills


def main() -> int:
    """Print each figure beside its target; 1 where one is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--journal-only", action="store_true", help="record without an estimate")
    parser.add_argument("--longest", type=int, default=60, help="events after which a new session begins (60)")
    parser.add_argument("--most", type=float, default=None, help="latest moment of a kill, seconds from the start")
    options = parser.parse_args()
    estimate = not options.journal_only
    most_s = options.most or (1.0 if estimate else 0.1)
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        toll = run_kills(
            folder,
            kills=options.kills,
            seed=options.seed,
            estimate=estimate,
            longest=options.longest,
            most_s=most_s,
        )
        worst = max(difference_from_uninterrupted(s, folder / "template") for s in toll.sessions) if estimate else 0.0
    print(f"kills                              {toll.lives:6d}      {time.monotonic() - began:.0f} s")
    print(f"events acknowledged                {toll.taken:6d}")
    print(f"on disk, killed before they were   {toll.unasked:6d}")
    print(f"last lines cut short               {toll.torn:6d}")
    print(f"acknowledged events missing        {toll.missing:6d}      target 0")
    print(f"other lines damaged                {toll.damaged:6d}      target 0")
    if estimate:
        print(f"estimate, reopened less unbroken {worst:8.1e}      target 1e-6")
    return 0 if worst <= 1e-6 and toll.missing == toll.damaged == 0 else 1


if __name__ == "__main__":
    raise SystemExit(main())
