"""Agreement of the online registration with the batch solver after every event, with and without outliers.

    python tools/study_online.py                          # 10 sessions of 50 pairs, clean and with 20 % outliers
    python tools/study_online.py --sessions 2 --pairs 30 --outliers 0.2 --shapes "first hit" "three looks"

After each pair from the 8th of its camera epoch on, the online optimum's Mahalanobis distance from ``register`` on the
same events, by the batch covariance. Prints, each figure beside its target: the largest distance of clean sessions
(0.05), the shares of events within 0.05 (90 %) and 0.5 (99 %) with outliers, in how many sessions the same pairs are
rejected at the end (all); for first hits, window only, three looks at each PM, and two camera epochs. Also processor
time of ``add`` from the 41st pair of an epoch on, where outliers cause full solves.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from fgreg.errors import EstimationError
from fgreg.geometry.transforms import FloatArray, as_float_array, exp_so3
from fgreg.model.measurements import Measurements, Pair
from fgreg.model.session_model import SessionModel
from fgreg.online.engine import OnlineRegistration
from tests.forward import make_measurements
from tests.online_streams import batch, events, first, sigmas_apart

FROM_PAIR, LATE = 8, 40
SHAPES: dict[str, dict[str, Any]] = {
    "first hit": {},
    "window only": {"first_hit": False},
    "three looks": {"looks_per_pm": 3},
    "two epochs, known motion": {"epochs": 2, "known_motion": True},
    "two epochs, unknown motion": {"epochs": 2},
}


def spoiled(measurements: Measurements, share: float, rng: np.random.Generator) -> tuple[Measurements, int]:
    """Pairs with false PMs and wrong markers in turn; and their number."""
    pairs: list[Pair] = list(measurements.pairs)
    bad = np.flatnonzero(rng.random(len(pairs)) < share)
    for number, i in enumerate(bad):
        pair = pairs[i]
        if number % 2 == 0:
            look = replace(pair.look, x_mm=float(rng.uniform(-20, 20)), range_mm=float(rng.uniform(22, 42)))
            pairs[i] = replace(pair, look=look)
        else:
            pose = pair.marker.camera_T_marker.copy()
            pose[:3, :3] = exp_so3(rng.uniform(-0.6, 0.6, 3)) @ pose[:3, :3]
            pose[:3, 3] += rng.uniform(-30, 30, 3)
            pairs[i] = replace(pair, marker=replace(pair.marker, camera_T_marker=as_float_array(pose, 4, 4)))
    return replace(measurements, pairs=tuple(pairs)), len(bad)


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """Of one session: distances (n,) in sigma, whether the same pairs are rejected at the end, ms of late adds (m,)."""

    distance: FloatArray
    same: bool
    late_ms: FloatArray


def agreement(measurements: Measurements, model: SessionModel, every: int) -> Agreement:
    """The session through both, compared after each pair from the 8th of its epoch on."""
    engine, out, late = OnlineRegistration(model, verdicts=False, find_moves=False), [], []
    same, count = True, 0
    for event in events(measurements):
        begin = time.process_time()
        estimate = engine.add(event)
        taken = 1e3 * (time.process_time() - begin)
        if not isinstance(event, Pair):
            continue
        count += 1
        if engine.state.epoch_pairs > LATE:
            late.append(taken)
        last = count == len(measurements.pairs)
        if engine.state.epoch_pairs < FROM_PAIR or (count % every and not last):
            continue
        try:
            found = batch(first(measurements, count), model)
        except EstimationError:
            continue
        if estimate.epoch not in found.epochs:
            continue
        out.append(sigmas_apart(found, estimate))
        if last:
            solved = np.isin([pair.epoch for pair in measurements.pairs], found.epochs)
            same = bool((found.shots.pm_inlier[found.shots.problem.look_pm] == np.array(engine.inliers)[solved]).all())
    return Agreement(np.array(out), same, np.array(late))


def study(sessions: int, pairs: int, share: float, shape: str, seed: int, every: int) -> None:
    """One row."""
    found, bad = [], 0
    for k in range(sessions):
        rng = np.random.default_rng([seed, k])
        arguments = dict(SHAPES[shape])
        looks = arguments.get("looks_per_pm", 1)
        model, measurements, _ = make_measurements(rng, pairs=-(-pairs // looks), **arguments)
        measurements, spoilt = spoiled(measurements, share, rng)
        found.append(agreement(measurements, model, every))
        bad += spoilt
    each = np.concatenate([one.distance for one in found])
    late = np.concatenate([one.late_ms for one in found])
    within = f"within 0.05: {np.mean(each <= 0.05):6.1%}  within 0.5: {np.mean(each <= 0.5):6.1%}"
    target = "target: all within 0.05" if share == 0 else "targets: 90 %, 99 %"
    spread = f"median {np.median(each):.4f}  largest {each.max():8.4f}"
    same = sum(one.same for one in found)
    cost = f"; add from pair {LATE + 1}: median {np.median(late):.1f} ms, largest {late.max():.0f}" if len(late) else ""
    print(
        f"{f'{shape}, {share:.0%} outliers':<36} {len(each):5d} events  {spread}  {within}  {target};"
        f"  same pairs rejected in {same} of {sessions} (target: all; {bad} spoiled){cost}",
        flush=True,
    )


def main() -> None:
    """Parse and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=10)
    parser.add_argument("--pairs", type=int, default=50)
    parser.add_argument("--outliers", type=float, nargs="+", default=[0.0, 0.2], help="shares of outliers")
    parser.add_argument("--shapes", nargs="+", choices=SHAPES, default=list(SHAPES), help="kinds of session")
    parser.add_argument("--every", type=int, default=1, help="compare after every n-th pair")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    for share in arguments.outliers:
        for shape in arguments.shapes:
            study(arguments.sessions, arguments.pairs, share, shape, arguments.seed, arguments.every)


if __name__ == "__main__":
    main()
