"""How long it takes to open a recorded session again: reading, checking, and going on from its checkpoint.

    python tools/bench_reopen.py                     # 1,000 pairs, and 20 kept apart for a short session
    python tools/bench_reopen.py --pairs 200 1000 5000
    python tools/bench_reopen.py --process           # the registration in a process of its own, as in `fgreg live`

The estimate after reopening is compared with the one before the session was closed. Recording is timed as well: what an
event takes with the disk, and how much of that is the disk's.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, os.fspath(Path(__file__).resolve().parent.parent))

import numpy as np

from fgreg.events import AimEvent, CameraMovedEvent, PairEvent
from fgreg.live import LiveSession
from fgreg.operation.start import OneProcess
from fgreg.session.checkpoint_file import CHECKPOINT_FILE
from fgreg.session.journal import Journal
from fgreg.session.reading import read_session
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session


def bench(folder: Path, pairs: int, seed: int, make_engine: OneProcess | None) -> bool:
    """One session; whether the targets are met. ``make_engine``: of processes."""
    config = replace(PRESETS["first-hit"], pairs=pairs, tracks_heard=0, tracks_silent=0)
    write_session(simulate(config, seed), folder)
    events = read_session(folder).events
    (folder / "events.jsonl").unlink()
    add_ms, disk_ms = [], []
    with LiveSession.open(folder, make_engine=make_engine) as live:
        append = live.journal.append

        def timed(event, **how):  # type: ignore[no-untyped-def]
            start = time.perf_counter()
            try:
                return append(event, **how)
            finally:
                disk_ms.append(1e3 * (time.perf_counter() - start))

        live.journal.append = timed  # type: ignore[method-assign]
        for event in events:
            if isinstance(event, AimEvent | PairEvent | CameraMovedEvent):
                start = time.perf_counter()
                live.add(event)
                add_ms.append(1e3 * (time.perf_counter() - start))
        if make_engine is not None:
            live.settle()  # opened again it is judged; with the last event its judge may not have answered yet
        before = live.estimate
    start = time.perf_counter()
    Journal.open(folder).close()
    read_s = time.perf_counter() - start
    start, cpu = time.perf_counter(), time.process_time()
    with LiveSession.open(folder, make_engine=make_engine) as live:
        reopen_s, cpu_s = time.perf_counter() - start, time.process_time() - cpu
        after, note = live.estimate, live.checkpoints.note
    (folder / CHECKPOINT_FILE).unlink(missing_ok=True)
    start, cpu = time.perf_counter(), time.process_time()
    with LiveSession.open(folder, make_engine=make_engine):
        without_s, without_cpu_s = time.perf_counter() - start, time.process_time() - cpu
    apart = float("inf")
    if before is not None and after is not None:
        arrays = [(before.trus_T_camera, after.trus_T_camera), (before.covariance, after.covariance)]
        apart = max(float(np.abs(a - b).max()) for a, b in arrays if a is not None and b is not None)
    target_s = max(1.0, pairs / 1000.0)
    print(f"{pairs} pairs")
    print(f"  reopened in                {reopen_s:9.2f} s    target {target_s:.2f}")
    print(f"  of that, reading {read_s:.2f} s; processor time {cpu_s:.2f} s{f' ({note})' if note else ''}")
    print(f"  without a checkpoint {without_s:.2f} s; processor time of this process {without_cpu_s:.2f} s")
    print(f"  estimate, after less before {apart:8.1e}      target 1e-6")
    for name, values in (("recorded and taken in", add_ms), ("of which checked and on disk", disk_ms)):
        p50, p99 = np.quantile(values, [0.5, 0.99])
        print(f"  {name:<28} {p50:7.2f} ms   99 % {p99:.2f}, longest {max(values):.1f}")
    return apart <= 1e-6 and reopen_s <= target_s


def main() -> int:
    """Print each figure beside its target; 1 where one is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, nargs="+", default=[20, 1000])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--process", action="store_true", help="the registration in a process of its own")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch, ExitStack() as stack:
        engines = OneProcess() if options.process else None
        if engines is not None:
            stack.callback(engines.close)
        met = [bench(Path(scratch) / str(pairs), pairs, options.seed, engines) for pairs in options.pairs]
    return 0 if all(met) else 1


if __name__ == "__main__":
    raise SystemExit(main())
