"""Times against everything that people would use instead: one command, a table of ratios.

    python -m tools.bench                          # all parts
    python -m tools.bench solve marker             # these parts
    python -m tools.bench --gate                   # exit status 1 where a ratio fell by over 25 %
    python -m tools.bench --store --docs           # keep the ratios for --gate; write docs/performance.md

Contenders of a part run in turn in one process, at least 9 times, so that other load on the machine meets all alike.
Times are processor time of the process. A ratio is a contender's time over that of the first line in the same round.
The parts:

  solve         one epoch, 12 aims and 10 to 1,000 pairs: optimisers from one start to the same cost
  full-solve    search, posterior and verdict of 15 pairs, and the first pairs of two epochs, beside native factors
  online        one event: this package, rebuilding, iSAM2 with everything kept, native factors
  marker        one stereo frame: this package, OpenCV, the AprilTag library
  photoacoustic one frame of channel data: this package, delay and sum, a matched filter before it
  command       `fgreg solve` and `fgreg --help` beside importing their libraries

The contenders are the group `bench` of pyproject.toml: python -m pip install --group bench. What is not installed is a
line that says so.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

sys.path.insert(0, os.fspath(Path(__file__).resolve().parents[2]))
sys.path.insert(0, os.fspath(Path(__file__).resolve().parents[1]))

from bench.compare import BUDGET_S, Row, Section, Target, print_rows, print_targets
from bench.gate import RATIOS, losses, machine, store
from bench.page import PAGE, write_tables
from fgreg.workers.memory import keep_freed_memory
from fgreg.workers.threads import one_thread_each

LEAST_REPEATS = 9


def _parts(args: argparse.Namespace) -> dict[str, Callable[[], Section]]:
    def solves() -> Section:
        from bench.solves import bench_solves

        return bench_solves(args.pairs, args.repeats, args.seed, args.budget)

    def judged() -> Section:
        from bench.solves import bench_judged

        return bench_judged(args.repeats, args.seed)

    def online() -> Section:
        from bench.online import bench_online

        return bench_online(args.repeats, args.seed)

    def marker() -> Section:
        from bench.marker import bench_marker

        return bench_marker(args.repeats, args.seed)

    def photoacoustic() -> Section:
        from bench.photoacoustic import bench_photoacoustic

        return bench_photoacoustic(args.repeats, args.seed)

    def command() -> Section:
        from bench.command import bench_command

        return bench_command(args.repeats)

    return {
        "solve": solves,
        "full-solve": judged,
        "online": online,
        "marker": marker,
        "photoacoustic": photoacoustic,
        "command": command,
    }


def main() -> int:
    """Run the parts; 1 where ``--gate`` finds a loss."""
    parser = argparse.ArgumentParser(
        "tools.bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", metavar="PART", help="default: all")
    parser.add_argument("--repeats", type=int, default=LEAST_REPEATS, help=f"at least {LEAST_REPEATS}")
    parser.add_argument("--pairs", type=int, nargs="+", default=[10, 30, 100, 300, 1000], help="of the part solve")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--budget", type=float, default=BUDGET_S, help="seconds; a longer run is not repeated")
    parser.add_argument("--gate", action="store_true", help="compare with the stored ratios")
    parser.add_argument("--store", action="store_true", help="write the ratios of this run")
    parser.add_argument("--docs", action="store_true", help="write the tables of docs/performance.md, of all parts")
    parser.add_argument("--json", type=Path, help="write all rows and targets")
    args = parser.parse_args()
    if args.repeats < LEAST_REPEATS:
        parser.error(f"--repeats {args.repeats}, expected at least {LEAST_REPEATS}")
    parts = _parts(args)
    if min(args.pairs) < 6:
        parser.error(f"--pairs {min(args.pairs)}, expected at least 6")
    if args.gate and not RATIOS.is_file():
        parser.error(f"{RATIOS} is absent: run with --store first")
    if args.docs and args.parts:
        parser.error("--docs needs all parts")
    if unknown := [name for name in args.parts if name not in parts]:
        parser.error(f"no part {unknown[0]}; there are {', '.join(parts)}")
    rows, targets = list[Row](), list[Target]()
    keep_freed_memory()  # as in fgreg's processes; for all contenders
    begun = machine()
    print(begun, flush=True)
    for name in args.parts or parts:
        with one_thread_each():
            found = parts[name]()
        print_rows(list(found.rows))
        sys.stdout.flush()
        rows += found.rows
        targets += found.targets
    if targets:
        print_targets(targets)
    if args.json is not None:
        whole = {"machine": begun, "rows": [asdict(row) for row in rows], "targets": [asdict(t) for t in targets]}
        args.json.write_text(json.dumps(whole, indent=1) + "\n")
    if args.docs:
        write_tables(PAGE, begun, rows, targets)
    if args.store:
        store(rows, RATIOS)
    if args.gate:
        lost = losses(rows, RATIOS)
        print("\n".join([f"\nGate: {len(lost)} ratios lost over 25 %", *(f"  {text}" for text in lost)]))
        return int(bool(lost))
    return 0


if __name__ == "__main__":
    status = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)  # symforce prints times of its own at the end of a process
