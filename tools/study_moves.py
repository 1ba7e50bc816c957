"""Finding out that the camera moved: power and false alarms, beside the ideal detector.

Poses with the documented noise, 12 aims. What is measured:

  clean     streams of steady pairs: false alarms (target: at most 1 in 2,000 pairs)
  junk      the same with a fifth of the pairs replaced by junk
  shifts    15 steady pairs, then a shift in a random direction about the camera: share found within so many pairs
            (targets: 5 mm or 3 deg, first-hit: 80 % within 2 and 93 % within 6; window only: 55 % and 85 %; 2 mm or
            1 deg, first-hit: 50 % within 6 and 80 % within 15)

The ideal detector is told the old registration, the beam, the window's edge and the very shift, and sums up
likelihood ratios (Shiryaev and Roberts); its threshold is set to the same rate of false alarms on clean pairs.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from fgreg.online.follow import EpochFollower, select_pms, summarise_aims

from fgreg.config import SolveConfig
from fgreg.errors import EstimationError
from fgreg.frames import FloatArray, exp_so3, inverse, make_transform
from fgreg.graph.reduced import log_posterior, refine
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.shared_state import make_state
from fgreg.measurements import Measurements
from fgreg.models import SessionModel
from fgreg.online.moves import ALARM, MoveSettings, MoveTest
from fgreg.registration import pack_session, register

sys.path.insert(0, os.fspath(Path(__file__).resolve().parent.parent))
from study_junk import KINDS, spoil

from tests.forward import Truth, make_measurements, random_marker_T_laser, random_trus_T_camera

STEADY = 15
AFTER = 15
START = 8
RATE = 2000.0
CONFIG = SolveConfig()


def random_direction(rng: np.random.Generator) -> FloatArray:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def shift_of(rng: np.random.Generator, mm: float, degrees: float) -> FloatArray:
    """camera_new_T_camera_old: by so many mm or turned by so many degrees, each half the time."""
    if rng.uniform() < 0.5:
        return make_transform(np.eye(3), mm * random_direction(rng))
    return make_transform(exp_so3(math.radians(degrees) * random_direction(rng)), np.zeros(3))


def two_epochs(
    seed: int, motion: FloatArray, before: int, after: int, *, first_hit: bool
) -> tuple[SessionModel, Measurements, tuple[Truth, Truth]]:
    """Pairs before and after a motion, all told to be of epoch 0; same beam, same window edge."""
    rng = np.random.default_rng(seed)
    trus_T_camera, beam = random_trus_T_camera(rng), random_marker_T_laser(rng)
    model, first, truth = make_measurements(
        np.random.default_rng([seed, 1]), aims=12, pairs=before, first_hit=first_hit, marker_T_laser=beam,
        trus_T_camera=trus_T_camera,
    )  # fmt: skip
    # The same seed draws the same window edge; without aims all that follows is drawn anew.
    _, second, moved = make_measurements(
        np.random.default_rng([seed, 1]), aims=0, pairs=after, first_hit=first_hit, marker_T_laser=beam,
        trus_T_camera=trus_T_camera @ inverse(motion),
    )  # fmt: skip
    shift_t = first.pairs[-1].t if first.pairs else 0.0
    later = tuple(
        replace(pair, t=pair.t + shift_t, pm=pair.pm + before, marker=replace(pair.marker, id=pair.marker.id + 100000))
        for pair in second.pairs
    )
    return model, Measurements(first.aims, first.pairs + later, first.epochs), (truth, moved)


def ideal_ratios(
    model: SessionModel, measurements: Measurements, truth: Truth, old: FloatArray, new: FloatArray
) -> FloatArray:
    """(n,) log likelihood ratio of each pair, new against old registration, all else known."""
    problem = replace(pack_session(replace(measurements, aims=()), model, CONFIG), anchor=None)
    state = make_state(np.stack([old, new])[:, None], truth.marker_T_laser, model.probe.radius_mm)
    state = replace(state, edge_rad=np.full(2, truth.window_edge_rad))
    out = np.zeros(len(problem.pms))
    for j in range(len(out)):
        one = select_pms(problem, np.array([j]))
        private = initial_private(one, state)
        for _ in range(4):
            _, private = refine(one, state, private)
        log = log_posterior(one, state, private)
        out[j] = log[1] - log[0]
    return out


def shiryaev_roberts(ratios: FloatArray) -> FloatArray:
    """(n,) log of R_n = (1 + R_(n-1)) exp(ratio_n)."""
    out, log_r = np.empty(len(ratios)), -np.inf
    for n, ratio in enumerate(ratios):
        log_r = float(np.logaddexp(0.0, log_r) + ratio)
        out[n] = log_r
    return out


def follow(
    model: SessionModel, measurements: Measurements, settings: MoveSettings, from_pair: int = START
) -> list[MoveTest | None]:
    """Tests after each pair from number ``from_pair`` + 1 on."""
    registration = register(replace(measurements, pairs=measurements.pairs[:START]), model, CONFIG)
    problem = pack_session(measurements, model, CONFIG)
    problem = summarise_aims(problem, registration.optimum.state)
    follower = EpochFollower(problem, registration.optimum.state, START)
    tests = []
    for n in range(START + 1, len(problem.pms) + 1):
        follower.advance(n)
        tests.append(follower.test(settings) if n > from_pair else None)
    return tests[from_pair - START :]


def excursions(scores: FloatArray, threshold: float) -> int:
    """How often a score comes to pass the threshold."""
    above = np.concatenate([[False], scores > threshold])
    return int(np.sum(above[1:] & ~above[:-1]))


def clean_scores(seed: int, *, pairs: int, first_hit: bool, junk: float) -> list[float] | None:
    """Scores of one steady stream; a share of its pairs replaced by junk. None where it could not be registered."""
    rng = np.random.default_rng([seed, 3])
    model, measurements, _ = make_measurements(rng, aims=12, pairs=pairs, first_hit=first_hit)
    if junk > 0.0:
        spoilt = rng.uniform(size=pairs) < junk
        spoilt[:START] = False  # what the first registration does about junk is not in question here
        kinds = rng.integers(len(KINDS), size=pairs)
        measurements = replace(
            measurements,
            pairs=tuple(
                spoil(pair, KINDS[kind], rng) if bad else pair
                for pair, bad, kind in zip(measurements.pairs, spoilt, kinds, strict=True)
            ),
        )
    try:
        found = follow(model, measurements, MoveSettings())
    except EstimationError:
        return None
    return [test.score if test is not None else -math.inf for test in found]


def ideal_clean_scores(seed: int, *, pairs: int, first_hit: bool, mm: float, degrees: float) -> list[float]:
    """Scores of the ideal detector on one steady stream, looking for a random shift."""
    rng = np.random.default_rng([seed, 4])
    motion = shift_of(rng, mm, degrees)
    model, measurements, truth = make_measurements(rng, aims=0, pairs=pairs, first_hit=first_hit)
    old = truth.trus_T_camera[0]
    return [float(x) for x in shiryaev_roberts(ideal_ratios(model, measurements, truth, old, old @ inverse(motion)))]


@dataclass(frozen=True, slots=True)
class Shifted:
    """Scores after each pair from the shift on, ours and the ideal detector's; where the likeliest move is then."""

    scores: list[float]
    ideal: list[float]
    since: list[int]


def shift_scores(seed: int, *, first_hit: bool, mm: float, degrees: float) -> Shifted:
    """One shift after the steady pairs."""
    motion = shift_of(np.random.default_rng([seed, 5]), mm, degrees)
    model, measurements, (truth, moved) = two_epochs(seed, motion, STEADY, AFTER, first_hit=first_hit)
    found = follow(model, measurements, MoveSettings(), STEADY)
    ratios = ideal_ratios(model, measurements, truth, truth.trus_T_camera[0], moved.trus_T_camera[0])
    return Shifted(
        scores=[test.score if test is not None else -math.inf for test in found],
        ideal=shiryaev_roberts(ratios)[STEADY:].tolist(),
        since=[-1 if test is None else k + 1 - (len(test.log_bayes) - test.since) for k, test in enumerate(found)],
    )


def threshold_at(scores: list[list[float]], per_pairs: float) -> float:
    """The lowest threshold with at most one excursion in so many pairs."""
    pairs = sum(len(row) for row in scores)
    for threshold in np.arange(0.0, 20.0, 0.05):
        if sum(excursions(np.array(row), float(threshold)) for row in scores) <= pairs / per_pairs:
            return float(threshold)
    return 20.0


def first_above(rows: FloatArray, threshold: float) -> FloatArray:
    """Pairs after the shift at which each row passes the threshold; infinite where it does not."""
    above = rows > threshold
    return np.where(above.any(axis=1), above.argmax(axis=1) + 1.0, np.inf)


def report_shifts(name: str, found: list[Shifted], ideal_threshold: float, targets: dict[int, float]) -> None:
    ours = first_above(np.array([row.scores for row in found]), ALARM)
    ideal = first_above(np.array([row.ideal for row in found]), ideal_threshold)
    print(f"{name} ({len(found)} shifts; threshold {ALARM:.2f}, ideal {ideal_threshold:.2f})")
    for count in (1, 2, 4, 6, 10, 15):
        target = f"   target {100 * targets[count]:.0f} %" if count in targets else ""
        share, best = float(np.mean(ours <= count)), float(np.mean(ideal <= count))
        print(f"  within {count:2d} pairs: {100 * share:5.1f} %   ideal {100 * best:5.1f} %{target}")
    error = [row.since[int(at) - 1] for row, at in zip(found, ours, strict=True) if np.isfinite(at)]
    late = np.mean([abs(e) <= 1 for e in error]) if error else float("nan")
    print(f"  first pair after the move, told at the alarm: right or next to it in {100 * late:.0f} %")


ROWS = (
    ("5 mm or 3 deg, first-hit", 5.0, 3.0, True, {2: 0.80, 6: 0.93}),
    ("5 mm or 3 deg, window only", 5.0, 3.0, False, {2: 0.55, 6: 0.85}),
    ("2 mm or 1 deg, first-hit", 2.0, 1.0, True, {6: 0.50, 15: 0.80}),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--what", default="clean,junk,shifts", help="which parts, with commas between")
    parser.add_argument("--shifts", type=int, default=500, help="shifts of each row")
    parser.add_argument("--clean-pairs", type=int, default=40000, help="steady pairs of each kind")
    parser.add_argument("--stream", type=int, default=108, help="pairs of each steady stream; the first 8 register it")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    what = set(args.what.split(","))
    if not what <= {"clean", "junk", "shifts"}:
        parser.error(f"--what is {args.what}, expected some of clean, junk, shifts")
    per_stream = args.stream - START
    seeds = [1000000 * args.seed + s for s in range(-(-args.clean_pairs // per_stream))]
    with ProcessPoolExecutor(args.jobs) as pool:
        for part, junk in (("clean", 0.0), ("junk", 0.2)):
            if part not in what:
                continue
            for first_hit in (True, False):
                started = time.perf_counter()
                one = partial(clean_scores, pairs=args.stream, first_hit=first_hit, junk=junk)
                streams = [row for row in pool.map(one, seeds, chunksize=4) if row is not None]
                tests = sum(len(row) for row in streams)
                alarms = sum(excursions(np.array(row), ALARM) for row in streams)
                name = f"{100 * junk:.0f} % junk, {'first-hit' if first_hit else 'window only'}"
                print(
                    f"{name}: {alarms} false alarms in {tests} pairs (1 in {tests / max(alarms, 1):.0f}"
                    f"{'; target 1 in 2000' if not junk else ''}), {len(seeds) - len(streams)} streams not registered, "
                    f"{time.perf_counter() - started:.0f} s",
                    flush=True,
                )
                for threshold in (5.0, 5.2, 5.4, 5.6, 6.0, 6.5, 7.6):
                    count = sum(excursions(np.array(row), threshold) for row in streams)
                    print(f"  threshold {threshold:.1f}: {count}", flush=True)
        if "shifts" in what:
            for name, mm, degrees, first_hit, targets in ROWS:
                one_ideal = partial(ideal_clean_scores, pairs=per_stream, first_hit=first_hit, mm=mm, degrees=degrees)
                ideal = list(pool.map(one_ideal, seeds[: max(len(seeds) // 4, 1)], chunksize=4))
                one_shift = partial(shift_scores, first_hit=first_hit, mm=mm, degrees=degrees)
                found = list(pool.map(one_shift, [7000000 * args.seed + s for s in range(args.shifts)], chunksize=4))
                report_shifts(name, found, threshold_at(ideal, RATE), targets)
                sys.stdout.flush()


if __name__ == "__main__":
    main()
