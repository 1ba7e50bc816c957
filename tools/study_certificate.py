"""The certificate (fgreg.certificate) on simulated sessions: what it proves, the gap it reaches, how long it takes.

    python tools/study_certificate.py --sessions 100         # rows of sessions: first hit and window only
    python tools/study_certificate.py --scenes 1000          # the minima of scenes, against the best known one

Rows: 12 aims, noise as published or as detected frames leave it, the rig as uncertain as declared. Good sessions
count: one minimum, no outlier. Printed, of these: the share whose gap is at most 1e-3 and 1e-2, the share for which
others within 9.2 of chi square are excluded beyond the angle and shift shown (medians), the share certified, and the
certificate's processor time (of its thread).

Scenes: 4 to 8 pairs, first hit or (every fourth) window only, noise as published. The best known minimum is the best of
the multi-start search and of ``--starts`` random registrations, by local searches on the whole graph. Each of the best
four distinct minima is handed to the certificate as if it were the estimate. Wrong: a certificate on a minimum that is
more than 1e-3 above the best known. Ambiguous: another minimum is within 9.2 of the best known. Each scene is one line,
and their sum is printed at the end, or at Ctrl-C (``timeout -s INT 3600 python ...``): of as many as were done.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeGuard

import numpy as np

from fgreg.certificate.certify import Certificate, certify
from fgreg.cli.options import CERTIFICATE_BUDGET
from fgreg.detection.events_to_measurements import extract_measurements
from fgreg.errors import EstimationError
from fgreg.geometry.transforms import FloatArray, exp_so3, make_transform
from fgreg.graph.reduced_blocks import arc_points
from fgreg.graph.reduced_solver import Optimum, optimize
from fgreg.graph.shared_state import SharedState
from fgreg.model.session_model import NoiseModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.multistart import SAME_MINIMUM_MM, targets_moved
from fgreg.registration.proof import other_minima, without_pairs
from fgreg.registration.register import Registration, register
from fgreg.session.session_reader import read_session
from fgreg.simulation.config import Sweep
from fgreg.simulation.presets import FIRST_HIT
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session
from study_pool import add_pool_options, pool_of
from systematic_cells import NOISES

ROWS = [(sweep, noise, pairs) for sweep in ("first hit", "window") for noise in NOISES for pairs in (6, 10, 15, 25)]
CONFIG = SolveConfig()
SAME_COST = 1e-3
BATCH = 100
MOST_MINIMA = 4
ENDED = 16
"""Best of the local searches' ends that are searched on to their minima."""
Task = tuple[str, str, int, int]
"""Sweep, noise, pairs, seed."""


@dataclass(frozen=True)
class Shown:
    """One certificate, and its processor time."""

    certificate: Certificate | None
    certified: bool
    time_s: float


def session(sweep: str, noise: NoiseModel, pairs: int, seed: int) -> Registration | None:
    """A simulated session, registered; None where it has no registration."""
    way = Sweep.WINDOW if sweep == "window" else Sweep.ALTERNATING
    config = replace(FIRST_HIT, pairs=pairs, noise=noise, sweep=way, tracks_heard=0, tracks_silent=0)
    with tempfile.TemporaryDirectory() as folder:
        write_session(simulate(config, seed), Path(folder) / "session")
        read = read_session(Path(folder) / "session")
    try:
        return register(extract_measurements(read.events, read.model).measurements, read.model, CONFIG)
    except EstimationError:
        return None


def is_good(found: Registration | None) -> TypeGuard[Registration]:
    """Whether a session has one minimum and no outlier."""
    return found is not None and not found.ambiguous and found.searches[0].clean and bool(found.shots.pm_inlier.all())


def shown(found: Registration, budget: int) -> Shown:
    """The certificate of the first epoch, timed."""
    optimum, begin = found.optimum, time.process_time()
    apart = without_pairs(found, 0)
    within = CONFIG.second_minimum_chi2
    private = optimum.evaluation.private
    certificate = certify(found.problem, optimum.state, private, 0, apart, within_chi2=within, budget=budget)
    certified = False
    if certificate is not None:
        others = other_minima(found, 0, certificate.starts, CONFIG)
        certified = certificate.is_least and certificate.is_alone and certificate.holds_without_pairs and not others
    return Shown(certificate, bool(certified), time.process_time() - begin)


def good_session(task: Task, budget: int) -> Shown | None:
    """The certificate of a session; None where it is not good."""
    sweep, noise, pairs, seed = task
    found = session(sweep, NOISES[noise], pairs, seed)
    return shown(found, budget) if is_good(found) else None


def row(tasks: Sequence[Task], found: Iterable[Shown | None]) -> dict[str, object]:
    """The figures of one kind of session."""
    (sweep, noise, pairs, _), every = tasks[0], list(found)
    results = [result for result in every if result is not None]
    gone = len(every) - len(results)
    there = [result.certificate for result in results if result.certificate is not None]
    alone = [c for c in there if c.is_alone]
    times = sorted(result.time_s for result in results)
    gaps = np.array([min(c.gap, 1.0) for c in there])
    return {
        "sweep": sweep,
        "noise": noise,
        "pairs": pairs,
        "good": len(results),
        "not_good": gone,
        "gap_1e-3": float(np.mean(gaps <= 1.0001e-3)),
        "gap_1e-2": float(np.mean(gaps <= 1e-2)),
        "gap_median_of_the_rest": float(np.median(gaps[gaps > 1e-2])) if (gaps > 1e-2).any() else None,
        "alone": len(alone) / max(len(there), 1),
        "within_deg": math.degrees(float(np.median([c.within_rad for c in alone]))) if alone else None,
        "within_mm": float(np.median([c.within_mm for c in alone])) if alone else None,
        "certified": float(np.mean([result.certified for result in results])),
        "median_s": float(np.median(times)),
        "p99_s": times[min(int(0.99 * len(times)), len(times) - 1)],
    }


def random_minima(found: Registration, starts: int, rng: np.random.Generator) -> list[Optimum]:
    """Local searches on the whole graph from random registrations, in batches."""
    problem, state = found.problem, found.optimum.state
    arcs = arc_points(problem, np.zeros(1))[0]
    direction = problem.beams.rotation @ state.beam_direction()[0]
    origin = problem.beams.rotation @ state.beam_origin()[0] + problem.beams.translation_mm
    out = []
    for begin in range(0, starts, BATCH):
        count = min(BATCH, starts - begin)
        rotation = exp_so3(_random_turns(count, rng))
        spots = origin + rng.uniform(10.0, 90.0, (count, 1, 1)) * direction
        middle = np.einsum("sij,sj->si", rotation, spots.mean(axis=1))
        states = state.take(np.zeros(count, dtype=np.int64))
        poses = make_transform(rotation, arcs.mean(axis=0) - middle)
        states = replace(states, rotation=poses[:, None, :3, :3], translation_mm=poses[:, None, :3, 3])
        out.append(optimize(problem, states, keep_within=200.0))
    return out


def _random_turns(count: int, rng: np.random.Generator) -> FloatArray:
    """(count, 3) rotation vectors of uniform rotations."""
    q = rng.normal(size=(count, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    q *= np.where(q[:, :1] < 0.0, -1.0, 1.0)
    sine = np.linalg.norm(q[:, 1:], axis=1, keepdims=True)
    return np.asarray(2.0 * np.arctan2(sine, q[:, :1]) * q[:, 1:] / np.maximum(sine, 1e-12))


def distinct_minima(found: Registration, optima: Sequence[Optimum]) -> list[Optimum]:
    """The ``MOST_MINIMA`` best minima, no two with nearly the same registration."""
    targets = found.model.targets_mm

    def distinct(costs: FloatArray, state: SharedState, most: int) -> list[int]:
        poses, out = state.trus_T_camera(), list[int]()
        for index in np.argsort(costs).tolist():
            if len(out) == most or not np.isfinite(costs[index]):
                break
            if all(targets_moved(poses[other], poses[index], targets) > SAME_MINIMUM_MM for other in out):
                out.append(index)
        return out

    names = SharedState.__slots__
    state = SharedState(*(np.concatenate([getattr(one.state, name) for one in optima]) for name in names))
    chosen = distinct(np.concatenate([one.evaluation.cost for one in optima]), state, ENDED)
    ended = optimize(found.problem, state.take(chosen))  # those far above the best were stopped on their way
    costs = np.where(ended.converged, ended.evaluation.cost, np.inf)
    return [ended.take(index) for index in distinct(costs, ended.state, MOST_MINIMA)]


@dataclass(frozen=True)
class Scene:
    """Chi squares of a scene's minima, and whether each was certified; none where there is no scene."""

    seed: int
    sweep: str
    pairs: int
    costs: tuple[float, ...] = ()
    certified: tuple[bool, ...] = ()
    by_multistart: bool = False

    @property
    def ambiguous(self) -> bool:
        return len(self.costs) > 1 and self.costs[1] - self.costs[0] < CONFIG.second_minimum_chi2

    @property
    def text(self) -> str:
        if not self.costs:
            return f"seed {self.seed}: no registration, or outliers"
        pairs = zip(self.costs, self.certified, strict=True)
        minima = ", ".join(f"{cost:.2f}{' certified' if certified else ''}" for cost, certified in pairs)
        return f"seed {self.seed}: {self.sweep}, {self.pairs} pairs: {minima}{' (ambiguous)' if self.ambiguous else ''}"


def scene(seed: int, starts: int, budget: int) -> Scene:
    """Certificates on every minimum of a random scene."""
    rng = np.random.default_rng(seed)
    pairs, sweep = int(rng.integers(4, 9)), "window" if seed % 4 == 3 else "first hit"
    found = session(sweep, NOISES["published"], pairs, seed)
    if found is None or not found.shots.pm_inlier.all():
        return Scene(seed, sweep, pairs)
    minima = distinct_minima(found, [found.optimum, *random_minima(found, starts, rng)])
    costs = tuple(float(one.evaluation.cost[0]) for one in minima)
    certified = tuple(shown(replace(found, optimum=one), budget).certified for one in minima)
    by_multistart = float(found.optimum.evaluation.cost[0]) <= costs[0] + SAME_COST
    return Scene(seed, sweep, pairs, costs, certified, by_multistart)


def scenes(found: Iterable[Scene]) -> dict[str, object]:
    """Totals of scenes, each printed as it is done; of those before an interruption."""
    tally: Counter[str] = Counter()
    wrong: list[str] = []
    try:
        for one in found:
            print(one.text, flush=True)
            if not one.costs:
                tally["no registration, or outliers"] += 1
                continue
            tally["scenes"] += 1
            tally["minima"] += len(one.costs)
            tally["best known is the multi-start's"] += one.by_multistart
            tally["ambiguous"] += one.ambiguous
            best = [cost <= one.costs[0] + SAME_COST for cost in one.costs]
            tally["best and not ambiguous"] += 0 if one.ambiguous else sum(best)
            for is_best, certified in zip(best, one.certified, strict=True):
                tally["certified, best known"] += certified and is_best
                tally["certified, wrong"] += certified and not is_best
                tally["certified, of ambiguous scenes"] += certified and one.ambiguous
            if any(one.certified) and (one.ambiguous or any(one.certified[1:])):
                wrong.append(one.text)
    except KeyboardInterrupt:
        print("interrupted")
    return {**tally, "to_look_at": wrong}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=0, help="of each row (0: none)")
    parser.add_argument("--scenes", type=int, default=0, help="with their minima (0: none)")
    parser.add_argument("--starts", type=int, default=1000, help="random registrations of each scene")
    parser.add_argument("--pairs", type=int, nargs="*", default=(6, 10, 15, 25))
    parser.add_argument("--sweep", choices=("first hit", "window"), nargs="*", default=("first hit", "window"))
    parser.add_argument("--seed", type=int, default=1, help="of the first session; the others follow")
    parser.add_argument("--budget", type=int, default=CERTIFICATE_BUDGET)
    parser.add_argument("--json", action="store_true", help="print one JSON document at the end")
    add_pool_options(parser)
    args = parser.parse_args()
    results: list[dict[str, object]] = []
    with pool_of(args) as pool:
        for sweep, noise, pairs in ROWS if args.sessions else ():
            if sweep in args.sweep and pairs in args.pairs:
                tasks = [(sweep, noise, pairs, args.seed + index) for index in range(args.sessions)]
                results.append(row(tasks, pool.map(partial(good_session, budget=args.budget), tasks)))
                print({key: round(v, 4) if isinstance(v, float) else v for key, v in results[-1].items()}, flush=True)
        if args.scenes:
            work = partial(scene, starts=args.starts, budget=args.budget)
            results.append(scenes(pool.map(work, range(args.seed, args.seed + args.scenes))))
            print(results[-1])
    if args.json:
        print(json.dumps(results))


if __name__ == "__main__":
    main()
