"""Processor time of one full solve (registration, posterior, verdict), against another checkout of the package.

Cases: the first 3 to 15 pairs of sessions/paper, of sessions/phantom (its frames are processed before) and of simulated
sessions; simulated sessions of 25 pairs of which a fifth are outliers. Each checkout runs in a process of its own; they
take turns, one solve at a time. Printed: the median processor time (user and system, ms) of each case and the ratio to
the other checkout, the longest solve, and the differences of the two results: verdict, outliers, and the registration
in standard deviations.

    python tools/bench/checkouts.py --against ../fgreg-before
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parents[2]
PAIRS = (3, 4, 5, 6, 8, 10, 15)
OUTLIER_SHARE, OUTLIER_PAIRS = 0.2, 25
MODULES = {
    "solve": ("registration.solve", "batch"),
    "SolveConfig": ("model.solve_config", "config"),
    "read_session": ("session.session_reader", "session.reading"),
    "extract_measurements": (
        "detection.events_to_measurements",
        "detection.events_to_measurements:recognise",
        "recognition:recognise",
    ),
}
"""Where a name is, in this checkout or in an older one (with the name that it had there)."""


def _named(name: str) -> Any:
    for place in MODULES[name]:
        module, _, older_name = place.partition(":")
        with contextlib.suppress(ImportError, AttributeError):
            return getattr(importlib.import_module(f"fgreg.{module}"), older_name or name)
    raise SystemExit(f"{name} is in none of {MODULES[name]}")


def _first_pairs(measurements: Any, count: int) -> Any:
    """All aims, and the first ``count`` pairs."""
    return replace(measurements, pairs=measurements.pairs[:count])


def _cases(checkout: Path, sizes: list[int], seeds: int, *, phantom: bool) -> Iterator[tuple[str, Any, Any]]:
    """Name, model and measurements of each case; the same whatever the checkout."""
    forward, outliers = importlib.import_module("tests.forward"), importlib.import_module("tools.study_outliers")
    for name in ("paper", "phantom") if phantom else ("paper",):
        session = _named("read_session")(checkout / "sessions" / name)
        measurements = _named("extract_measurements")(session.events, session.model).measurements
        for count in sizes:
            if count <= len(measurements.pairs):
                yield f"{name} {count}", session.model, _first_pairs(measurements, count)
    for title, first_hit in (("first hit", True), ("window only", False)):
        for seed in range(seeds):
            model, measurements, _ = forward.make_measurements(
                np.random.default_rng([5, seed]), pairs=max(sizes), first_hit=first_hit
            )
            for count in sizes:
                yield f"{title} {count}", model, _first_pairs(measurements, count)
    for seed in range(seeds):
        rng = np.random.default_rng([6, seed])
        model, measurements, _ = forward.make_measurements(rng, pairs=OUTLIER_PAIRS)
        pairs = list(measurements.pairs)
        for number, index in enumerate(rng.permutation(OUTLIER_PAIRS)[: round(OUTLIER_SHARE * OUTLIER_PAIRS)]):
            pairs[index] = outliers.spoil(pairs[index], outliers.KINDS[number % len(outliers.KINDS)], rng)
        spoiled = replace(measurements, pairs=tuple(pairs))
        for count in (*(n for n in sizes if n >= 8), OUTLIER_PAIRS):
            yield f"outliers {count}", model, _first_pairs(spoiled, count)


def _answer(solution: Any) -> dict[str, Any]:
    """The part of a solution that is compared."""
    epoch, registration = solution.epochs[-1], solution.registration
    search = None if registration is None else registration.searches[-1]
    return {
        "verdict": solution.verdict.value,
        "reasons": list(solution.reasons),
        "outliers": [i for i, pair in enumerate(solution.pairs) if not pair.used],
        "pose": None if epoch.trus_T_camera is None else epoch.trus_T_camera.tolist(),
        "covariance": None if epoch.covariance is None else epoch.covariance.tolist(),
        "worst_mm": None if epoch.predicted_tre is None else epoch.predicted_tre.worst_mm,
        "minima": [] if search is None else [minimum.cost for minimum in search.minima],
        "effective": None if solution.posterior is None else solution.posterior.effective,
    }


def serve(checkout: Path, sizes: list[int], seeds: int, *, phantom: bool) -> None:
    """Solve the cases whose numbers are read from standard input; one line of JSON each."""
    cases = list(_cases(checkout, sizes, seeds, phantom=phantom))
    config, solve = _named("SolveConfig")(), _named("solve")
    print(json.dumps([name for name, _, _ in cases]), flush=True)
    for line in sys.stdin:
        _, model, measurements = cases[int(line)]
        start = time.process_time()
        solution = solve(measurements, [], model, config)
        spent = time.process_time() - start
        print(json.dumps({"ms": 1e3 * spent, **_answer(solution)}), flush=True)


def _start(checkout: Path, args: argparse.Namespace) -> tuple[Callable[[int], dict[str, Any]], list[str]]:
    """A process that solves cases with a checkout: how to ask it, and the names of the cases."""
    command = [sys.executable, os.fspath(Path(__file__).resolve()), "--serve", os.fspath(checkout)]
    command += ["--seeds", str(args.seeds), "--pairs", *map(str, args.pairs)] + ["--phantom"] * args.phantom
    environment = os.environ | {"PYTHONPATH": os.fspath(checkout), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    child = subprocess.Popen(
        command, cwd=checkout, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    if child.stdin is None or child.stdout is None:
        raise SystemExit("no pipes")
    asks, answers = child.stdin, child.stdout

    def ask(case: int) -> dict[str, Any]:
        print(case, file=asks, flush=True)
        found = answers.readline()
        if not found:
            raise SystemExit(f"{checkout}: the process ended")
        return dict(json.loads(found))

    names = answers.readline()
    if not names:
        raise SystemExit(f"{checkout}: the process ended")
    return ask, list(json.loads(names))


@dataclass
class Row:
    """Figures of the cases of one name: median time of each case (ms), here and there; cases that differ."""

    here_ms: list[float]
    there_ms: list[float]
    verdicts: int = 0
    outliers: int = 0
    apart_sigma: float = 0.0


def _apart(here: dict[str, Any], there: dict[str, Any]) -> float:
    """Distance of two registrations in standard deviations of the second's covariance, to first order."""
    if here["pose"] is None or there["pose"] is None:
        return 0.0 if here["pose"] is there["pose"] else float("inf")
    first, second = np.array(there["pose"]), np.array(here["pose"])
    back = np.linalg.inv(first) @ second
    turn = 0.5 * np.array([back[2, 1] - back[1, 2], back[0, 2] - back[2, 0], back[1, 0] - back[0, 1]])
    step = np.concatenate([turn, back[:3, 3]])
    return float(np.sqrt(step @ np.linalg.solve(np.array(there["covariance"]), step)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", type=Path, help="another checkout")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seeds", type=int, default=6, help="simulated sessions of each kind")
    parser.add_argument("--pairs", type=int, nargs="*", default=list(PAIRS))
    parser.add_argument("--phantom", action="store_true", help="sessions/phantom as well: some 20 s for its frames")
    parser.add_argument("--differences", action="store_true", help="print the cases whose results differ")
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.serve is not None:
        sys.path.insert(0, os.fspath(args.serve))
        serve(args.serve, args.pairs, args.seeds, phantom=args.phantom)
        return
    ask, names = _start(HERE, args)
    other = None if args.against is None else _start(args.against.resolve(), args)[0]
    rows: dict[str, Row] = {}
    longest = {"here": 0.0, "there": 0.0}
    for case, name in enumerate(names):
        here, there = [], []
        for _ in range(args.repeats):
            here.append(ask(case))
            there.append(here[-1] if other is None else other(case))
        row = rows.setdefault(name, Row([], []))
        row.here_ms.append(statistics.median(found["ms"] for found in here))
        row.there_ms.append(statistics.median(found["ms"] for found in there))
        longest["here"], longest["there"] = (
            max(longest["here"], row.here_ms[-1]),
            max(longest["there"], row.there_ms[-1]),
        )
        mine, theirs = here[0], there[0]
        row.verdicts += mine["verdict"] != theirs["verdict"]
        row.outliers += mine["outliers"] != theirs["outliers"]
        row.apart_sigma = max(row.apart_sigma, _apart(mine, theirs))
        if args.differences and (mine["verdict"] != theirs["verdict"] or mine["outliers"] != theirs["outliers"]):
            print(f"{name}: {mine['verdict']} {mine['outliers']}, other {theirs['verdict']} {theirs['outliers']}")
            print(*(f"  {reason}" for reason in mine["reasons"]), sep="\n")
            print(*(f"  other: {reason}" for reason in theirs["reasons"]), sep="\n")
        print(f"\r{case + 1} of {len(names)}", end="", file=sys.stderr)
    print(file=sys.stderr)
    print(f"{'case':18s}{'ms':>8s}{'other ms':>10s}{'ratio':>8s}   other verdict, outliers, apart (sigma, most)")
    for name, row in rows.items():
        here_ms, there_ms = statistics.mean(row.here_ms), statistics.mean(row.there_ms)
        print(
            f"{name:18s}{here_ms:8.1f}{there_ms:10.1f}{here_ms / there_ms:8.3f}   "
            f"{row.verdicts} {row.outliers} of {len(row.here_ms)}, {row.apart_sigma:.3f}"
        )
    here_ms, there_ms = (sum(sum(getattr(row, side)) for row in rows.values()) for side in ("here_ms", "there_ms"))
    print(f"{'all':18s}{here_ms:8.0f}{there_ms:10.0f}{here_ms / there_ms:8.3f}")
    print(f"{'longest':18s}{longest['here']:8.1f}{longest['there']:10.1f}{longest['here'] / longest['there']:8.3f}")


if __name__ == "__main__":
    main()
