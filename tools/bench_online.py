"""Latency of the online registration over a long session of several camera epochs, each figure beside its limit.

    python tools/bench_online.py                       # 2,000 pairs in 7 epochs
    python tools/bench_online.py --pairs 300 --epochs 1

The run is in one process; the full solve is timed separately. ``add`` without it is the time of an event where the full
solve has a worker process, with the update by its results. ``add`` with it, over the first 10 pairs of each epoch, is
the time in replay and tests. Also ``track``, and the time to open the session's first 1,000 pairs again.
``python -m tools.bench online`` compares one event with other ways of keeping the estimate.

Printed are wall time and processor time of the thread. On a machine that does other work as well, only the processor
time is the engine's own, so the limits apply to it. The exit status is 1 where one is missed.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from fgreg.model.measurements import Measurements, Pair, Track
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine import OnlineRegistration
from fgreg.online.full_solve import FullSolveCase
from fgreg.online.solver import InProcessSolver
from fgreg.smoother.updates import FIRST_PAIRS
from tests.forward import make_measurements
from tests.online_streams import events, first, restored

ADD_MS = {50.0: 30.0, 99.0: 60.0}
FIRST_MS = {100.0: 300.0}
TRACK_MS = {50.0: 5.0}
OPEN_PAIRS, OPEN_S = 1000, 2.0
EDGE = 500
"""Pairs at either end of the session whose medians show whether ``add`` has become slower."""

Times = tuple[float, float]
"""Milliseconds: wall, processor."""


def now() -> Times:
    """Both clocks."""
    return 1e3 * time.perf_counter(), 1e3 * time.thread_time()


def since(start: Times) -> Times:
    """Time since ``start`` on both."""
    end = now()
    return end[0] - start[0], end[1] - start[1]


class TimedSolver(InProcessSolver):
    """The full solve in this process. ``spent``: its time since the last reset."""

    spent: Times = (0.0, 0.0)

    def submit(self, case: FullSolveCase) -> None:
        """Solve, and add up the time."""
        start = now()
        super().submit(case)
        took = since(start)
        self.spent = (self.spent[0] + took[0], self.spent[1] + took[1])


def row(name: str, times: list[Times], limits: dict[float, float]) -> bool:
    """Percentiles beside their limits; whether they are met by processor time."""
    met = True
    for clock, values in zip(("wall", "processor"), np.array(times).T, strict=True):
        shown = []
        for share in (50.0, 99.0, 100.0):
            value = float(np.percentile(values, share))
            limit = f" (limit {limits[share]:g})" if share in limits else ""
            shown.append(f"{'largest' if share == 100.0 else f'p{share:g}'} {value:.1f}{limit}")
            if clock == "processor" and share in limits:
                met &= value <= limits[share]
        print(f"{name if clock == 'wall' else '':<42} {clock:<9} ms  {'  '.join(shown)}  of {len(values)}")
    return met


def bench(model: SessionModel, measurements: Measurements) -> bool:
    """One session; whether the limits are met."""
    engine = OnlineRegistration(model)
    engine._solver = solver = TimedSolver(model, SolveConfig(), verdicts=True)
    alone: list[Times] = []
    whole: list[Times] = []
    tracks: list[Times] = []
    for event in events(measurements):
        solver.spent = (0.0, 0.0)
        start = now()
        estimate = engine.add(event)
        took = since(start)
        if not isinstance(event, Pair):
            continue
        alone.append((took[0] - solver.spent[0], took[1] - solver.spent[1]))
        if engine.state.epoch_pairs <= FIRST_PAIRS:
            whole.append(took)
        start = now()
        engine.track(Track(event.t, estimate.epoch, event.marker, (event.look,)))
        tracks.append(since(start))
    found = f"{len(measurements.pairs)} pairs, {len(measurements.epochs)} epochs"
    print(f"{found}; {sum(engine.inliers)} inliers, {len(engine.moves)} camera moves detected")
    met = row("add without the full solve", alone, ADD_MS)
    met &= row(f"add with it, first {FIRST_PAIRS} pairs of an epoch", whole, FIRST_MS)
    met &= row("track", tracks, TRACK_MS)
    if len(alone) >= 2 * EDGE:
        late, early = (np.median(part, axis=0) for part in (alone[-EDGE:], alone[:EDGE]))
        ratio = "wall {:.2f}, processor {:.2f}".format(*(late / early))
        print(f"{'add, last over first ' + str(EDGE) + ' pairs':<42} {ratio}")
    return met


def bench_opening(model: SessionModel, measurements: Measurements, *, worker: bool) -> bool:
    """Take in all events at once; whether that is within the limit."""
    with OnlineRegistration(model, full_solve="worker" if worker else "in_process") as engine:
        start = now()
        restored(engine, measurements)
        wall, processor = since(start)
    count = len(measurements.pairs)
    limit = f" (limit {OPEN_S:g})" if count == OPEN_PAIRS else ""
    print(f"{f'{count} pairs opened again':<42} wall {wall / 1e3:.2f} s  processor {processor / 1e3:.2f} s{limit}")
    return count != OPEN_PAIRS or processor <= 1e3 * OPEN_S


def main() -> int:
    """Parse and run; 1 where a limit is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=2000)
    parser.add_argument("--epochs", type=int, default=7)
    parser.add_argument("--known-motion", action="store_true", help="the motions between the epochs are measured")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    model, measurements, _ = make_measurements(
        np.random.default_rng(arguments.seed),
        pairs=arguments.pairs,
        epochs=arguments.epochs,
        known_motion=arguments.known_motion,
    )
    met = bench(model, measurements)
    met &= bench_opening(model, first(measurements, min(OPEN_PAIRS, arguments.pairs)), worker=True)
    return 0 if met else 1


if __name__ == "__main__":
    raise SystemExit(main())
