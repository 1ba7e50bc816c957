"""The first pairs of an epoch, each with its full solve, beside a native graph."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from bench.compare import Row, Section, Target
from fgreg.model.measurements import Pair
from fgreg.model.systematic import Systematic
from fgreg.online.engine import OnlineRegistration
from fgreg.smoother.updates import FIRST_PAIRS
from tests.forward import make_measurements, make_session
from tests.online_streams import events

LIMIT, OF_SOLVE = 6.0, 2.0
"""Of the slowest pair: twice the full solve's limit, and twice what the full solve of 15 pairs takes."""


def judged_pairs(native: Callable[[], Any], whole_ratio: float, repeats: int, seed: int) -> Section:
    """Two epochs of ``FIRST_PAIRS`` pairs, ``repeats`` times; a native solve is timed beside every pair.

    ``whole_ratio``: what the full solve of 15 pairs takes, over a native solve.
    """
    model, measurements, _ = make_measurements(
        np.random.default_rng(seed),
        pairs=2 * FIRST_PAIRS,
        epochs=2,
        session=make_session(systematic=Systematic()),
    )
    ratios: dict[tuple[int, int], list[float]] = {}
    took_ms: dict[tuple[int, int], list[float]] = {}
    for _ in range(repeats):
        engine = OnlineRegistration(model)
        for event in events(measurements):
            start = time.process_time()
            engine.add(event)
            took = time.process_time() - start
            if not isinstance(event, Pair):
                continue
            place = engine.state.epoch, engine.state.epoch_pairs
            start = time.process_time()
            native()
            beside = time.process_time() - start
            ratios.setdefault(place, []).append(took / beside)
            took_ms.setdefault(place, []).append(1e3 * took)
    rows = []
    for (epoch, pair), own in ratios.items():
        low, _, high = statistics.quantiles(own, n=4)
        ms, ratio = statistics.median(took_ms[epoch, pair]), statistics.median(own)
        case = "judged pairs, over native factors (star) of 1,000 pairs"
        rows.append(Row("full solve", case, f"epoch {epoch}, pair {pair}", ms, ratio, low, high, len(own), worse=1))
    most = max(rows, key=lambda row: row.ratio or 0.0)
    slowest, ratio = f"slowest judged pair ({most.name})", most.ratio or 0.0
    targets = (
        Target(f"{slowest} over native factors (star), 1,000 pairs", ratio, LIMIT),
        Target(f"{slowest} over the full solve of 15 pairs", ratio / whole_ratio, OF_SOLVE),
    )
    return Section(tuple(rows), targets)
