"""Time to open a recorded session again, and the difference of its estimate to the one before.

    python tools/bench_reopen.py                     # 40, 200 and 1,000 pairs
    python tools/bench_reopen.py --outliers 0.1      # a tenth of the PMs are outliers
    python tools/bench_reopen.py --process           # the registration in a process of its own, as in `fgreg live`

A simulated session without its last 20 events is opened, these events are recorded, and the session is opened again.
The estimates before and after are compared. Limits: 2 s of processor time at 1,000 pairs, 0.05 standard
deviations, the same inliers. The exit status is 1 where one is missed. Recording is timed as well: the time of an
event, and the part of it that the disk takes.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, os.fspath(Path(__file__).resolve().parent.parent))

import numpy as np

from fgreg.live.launch import EngineProcesses
from fgreg.model.events import AimEvent, CameraMovedEvent, PairEvent
from fgreg.online.engine import OnlineRegistration
from fgreg.online.live_session import LiveSession
from fgreg.session.journal import Journal
from fgreg.session.session_reader import read_session
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session
from tests.online_streams import sigmas_between

LAST = 20
OPEN_PAIRS, OPEN_S = 1000, 2.0
SIGMAS = 0.05


def spoil(path: Path, share: float, seed: int) -> None:
    """Replace a share of the recorded pairs by outliers: the detected source is not the PM."""
    rng, lines = np.random.default_rng(seed), []
    for line in path.read_text().splitlines():
        event = json.loads(line)
        if event["type"] == "pair" and rng.uniform() < share:
            event["trus"] |= {"x_mm": -event["trus"]["x_mm"] - 8.0, "range_mm": event["trus"]["range_mm"] + 9.0}
        lines.append(json.dumps(event) + "\n")
    path.write_text("".join(lines))


def bench(folder: Path, pairs: int, outliers: float, seed: int, make_engine: EngineProcesses | None) -> bool:
    """One session; whether the limits are met. ``make_engine``: of processes."""
    config = replace(PRESETS["first-hit"], pairs=pairs, tracks_heard=0, tracks_silent=0)
    write_session(simulate(config, seed), folder)
    if outliers:
        spoil(folder / "events.jsonl", outliers, seed)
    last = [e for e in read_session(folder).events if isinstance(e, AimEvent | PairEvent | CameraMovedEvent)][-LAST:]
    path = folder / "events.jsonl"
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[: last[0].line - 1]))
    add_ms: list[float] = []
    disk_ms: list[float] = []
    with LiveSession.open(folder, make_engine=make_engine) as live:
        append = live.journal.append

        def timed(event, **how):  # type: ignore[no-untyped-def]
            start = time.perf_counter()
            try:
                return append(event, **how)
            finally:
                disk_ms.append(1e3 * (time.perf_counter() - start))

        live.journal.append = timed  # type: ignore[method-assign]
        for event in last:
            start = time.perf_counter()
            live.add(event)
            add_ms.append(1e3 * (time.perf_counter() - start))
        before, kept = live.settle(), live.engine.inliers if isinstance(live.engine, OnlineRegistration) else ()
    start = time.perf_counter()
    Journal.open(folder).close()
    read_s = time.perf_counter() - start
    start, cpu = time.perf_counter(), time.process_time()
    with LiveSession.open(folder, make_engine=make_engine) as live:
        open_s, cpu_s = time.perf_counter() - start, time.process_time() - cpu
        after, again = live.estimate, live.engine.inliers if isinstance(live.engine, OnlineRegistration) else ()
    sigmas = float("inf") if after is None else sigmas_between(after, before)
    limit = f" (limit {OPEN_S:g})" if pairs == OPEN_PAIRS else ""
    print(f"{pairs} pairs, {before.epoch + 1} epochs")
    print(f"  opened again in {open_s:.2f} s, of that reading {read_s:.2f} s; processor time {cpu_s:.2f} s{limit}")
    same = "the same inliers" if again == kept else f"{sum(np.not_equal(again, kept))} inliers differ"
    print(f"  registration {sigmas:.4f} sigma from the one before (limit {SIGMAS:g}); {same}")
    for name, values in (("recorded and taken in", add_ms), ("of which checked and on disk", disk_ms)):
        p50, p99 = np.quantile(values, [0.5, 0.99])
        print(f"  {name:<28} {p50:7.2f} ms   99 % {p99:.2f}, longest {max(values):.1f}")
    return sigmas <= SIGMAS and again == kept and (pairs != OPEN_PAIRS or cpu_s <= OPEN_S)


def main() -> int:
    """Print each figure beside its limit; 1 where one is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, nargs="+", default=[40, 200, OPEN_PAIRS])
    parser.add_argument("--outliers", type=float, default=0.0, help="share of the pairs")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--process", action="store_true", help="the registration in a process of its own")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch, ExitStack() as stack:
        engines = EngineProcesses() if options.process else None
        if engines is not None:
            stack.callback(engines.close)
        met = [
            bench(Path(scratch) / str(pairs), pairs, options.outliers, options.seed, engines) for pairs in options.pairs
        ]
    return 0 if all(met) else 1


if __name__ == "__main__":
    raise SystemExit(main())
