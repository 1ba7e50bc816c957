"""How long it takes to open a recorded session again: reading, checking, and one full solve.

    python tools/bench_reopen.py                     # 20 and 1,000 pairs
    python tools/bench_reopen.py --pairs 200 1000 5000
    python tools/bench_reopen.py --process           # the registration in a process of its own, as in `fgreg live`

The registration after reopening is compared with the one before the session was closed (target: 0.05 sigma, the same
inliers). Recording is timed as well: what an
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

from fgreg.live.launch import OneProcess
from fgreg.model.events import AimEvent, CameraMovedEvent, PairEvent
from fgreg.online.live_session import LiveSession
from fgreg.registration.posterior import pose_tangent
from fgreg.session.journal import Journal
from fgreg.session.session_reader import read_session
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session

TARGET_S = 2.0


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
        before = live.settle()
    start = time.perf_counter()
    Journal.open(folder).close()
    read_s = time.perf_counter() - start
    start, cpu = time.perf_counter(), time.process_time()
    with LiveSession.open(folder, make_engine=make_engine) as live:
        reopen_s, cpu_s = time.perf_counter() - start, time.process_time() - cpu
        after = live.estimate
    apart = float("inf")
    if after is not None and before.trus_T_camera is not None and after.trus_T_camera is not None:
        tangent = pose_tangent(before.trus_T_camera, after.trus_T_camera)
        apart = float(np.sqrt(tangent @ np.linalg.solve(np.asarray(before.covariance), tangent)))
    same = after is not None and after.pairs == before.pairs and after.epoch == before.epoch
    print(f"{pairs} pairs")
    print(f"  reopened in                {reopen_s:9.2f} s    target {TARGET_S:.2f} at 1,000 pairs")
    print(f"  of that, reading {read_s:.2f} s; processor time {cpu_s:.2f} s")
    print(f"  registration moved by {apart:8.4f} sigma    target 0.05; {'as many' if same else 'NOT AS MANY'} inliers")
    for name, values in (("recorded and taken in", add_ms), ("of which checked and on disk", disk_ms)):
        p50, p99 = np.quantile(values, [0.5, 0.99])
        print(f"  {name:<28} {p50:7.2f} ms   99 % {p99:.2f}, longest {max(values):.1f}")
    return apart <= 0.05 and same and reopen_s <= TARGET_S


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
