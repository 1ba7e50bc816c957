"""How well the online registration agrees with the batch solver after every event, with and without junk.

    python tools/study_online.py                          # 10 sessions of 50 pairs, clean and with 20 % junk
    python tools/study_online.py --sessions 2 --pairs 30 --junk 0.2

After each pair from the 8th on, the online optimum's Mahalanobis distance from ``register`` on the same events, by the
batch covariance. Prints, each figure beside its target: the largest distance of clean sessions (0.05), the shares of
events within 0.05 (90 %) and 0.5 (99 %) with junk, and in how many sessions the same pairs are rejected at the end
(all), for first hits and for window only.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from fgreg.config import SolveConfig
from fgreg.errors import EstimationError
from fgreg.frames import FloatArray, as_float_array, exp_so3
from fgreg.measurements import Measurements, Pair
from fgreg.models import SessionModel
from fgreg.online import OnlineRegistration
from fgreg.posterior import pose_tangent
from fgreg.registration import register
from tests.forward import make_measurements

FROM_PAIR = 8


def spoiled(measurements: Measurements, share: float, rng: np.random.Generator) -> tuple[Measurements, int]:
    """False PMs, and markers that are somewhere else, in turn; and how many."""
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


def distances(measurements: Measurements, model: SessionModel, every: int) -> tuple[FloatArray, bool]:
    """Distances (n,) in sigma from the 8th pair on, and whether the same pairs are rejected at the end."""
    engine, out = OnlineRegistration(model, judge=None), []
    for aim in measurements.aims:
        engine.add(aim)
    same = True
    for count, pair in enumerate(measurements.pairs, start=1):
        estimate = engine.add(pair)
        if count < FROM_PAIR or (count % every and count < len(measurements.pairs)):
            continue
        try:
            found = register(replace(measurements, pairs=measurements.pairs[:count]), model, SolveConfig())
        except EstimationError:
            continue
        if estimate.optimum_trus_T_camera is None:
            out.append(np.inf)
            continue
        there = found.optimum.state.trus_T_camera()[0]
        tangent = pose_tangent(there, estimate.optimum_trus_T_camera)
        out.append(float(np.sqrt(tangent @ np.linalg.solve(found.covariance[:6, :6], tangent))))
        kept = found.shots.pm_kept[found.shots.problem.look_pm]
        same = bool((kept == np.array(engine.kept)).all())
    return np.array(out), same


def study(sessions: int, pairs: int, share: float, first_hit: bool, seed: int, every: int) -> None:
    """One row."""
    found, same, junk = [], 0, 0
    for k in range(sessions):
        rng = np.random.default_rng([seed, k])
        model, measurements, _ = make_measurements(rng, pairs=pairs, first_hit=first_hit)
        measurements, bad = spoiled(measurements, share, rng)
        distance, is_same = distances(measurements, model, every)
        found.append(distance)
        same += is_same
        junk += bad
    each = np.concatenate(found)
    name = f"{'first hit' if first_hit else 'window only'}, {share:.0%} junk"
    within = f"within 0.05: {np.mean(each <= 0.05):6.1%}  within 0.5: {np.mean(each <= 0.5):6.1%}"
    target = "target: all within 0.05" if share == 0 else "targets: 90 %, 99 %"
    spread = f"median {np.median(each):.4f}  largest {each.max():8.4f}"
    print(
        f"{name:<24} {len(each):5d} events  {spread}  {within}  {target};"
        f"  same pairs rejected in {same} of {sessions} (target: all; {junk} spoiled)",
        flush=True,
    )


def main() -> None:
    """Parse and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=10)
    parser.add_argument("--pairs", type=int, default=50)
    parser.add_argument("--junk", type=float, nargs="+", default=[0.0, 0.2], help="shares of junk")
    parser.add_argument("--every", type=int, default=1, help="compare after every so many pairs")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    for share in arguments.junk:
        for first_hit in (True, False):
            study(arguments.sessions, arguments.pairs, share, first_hit, arguments.seed, arguments.every)


if __name__ == "__main__":
    main()
