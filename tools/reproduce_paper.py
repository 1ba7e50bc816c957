"""Every table of the publication: published, its method and the conventional one run here, fgreg, and the bound.

    python tools/reproduce_paper.py                          all tables, 100 sessions a row, about an hour on one core
    python tools/reproduce_paper.py --sessions 20 --slow 1   a first look
    python tools/reproduce_paper.py --only pairs bound --markdown table.md

Columns: (a) is the published alternating method (baseline_alternating.py), started --guess-deg and --guess-mm from the
truth, theta' kept within the known deviation; (b) is registration by PMs seen in both frames (closed form). fgreg needs
no guess. Two measures, never mixed: ``TRE`` is the true error at 27 targets, ``pair residual`` is Eq. 12 of the
publication (line to arc of held-out pairs, lambda and theta' refitted), which is what was published as TRE.
``bound`` is the posterior Cramer-Rao bound at the truth (root of the mean over targets of the trace).

Scene (the publication states none): PMs on a curved tissue surface 22 to 42 mm from a probe of 10 mm radius, x within
20 mm, stage angle within 35 deg; camera 125 to 150 mm away; beams within 20 deg of their mean about two axes, fibre 20
to 60 mm from the spot; marker noise 0.1, 0.1, 0.8 mm and 0.01 rad with a constant bias of 0.1 mm; PM noise 0.3 mm
lateral, 0.2 mm range; stage 0.1 deg; 12 calibration shots with 1 mm aiming error. Window +-6 deg of stage rotation, the
PM anywhere in it. For (b): PM seen by the camera with 0.1, 0.1, 0.8 mm, by the probe with 0.3 and 0.2 mm and 0.5 deg.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.simulation.presets import PRESETS
from paper_sessions import (
    Job,
    Row,
    calibration,
    deviating,
    one_out,
    positions,
    registration,
    run_job,
    timing,
    tracking,
)
from study_pool import Pool, add_pool_options, pool_of

PUBLISHED_CALIBRATION = {5: 2.12, 10: 1.71, 20: 1.39, 30: 1.30, 40: 1.18}
PUBLISHED_DEVIATION = {0: 1.51, 5: 1.62, 10: 1.96, 15: 1.98, 20: 2.21}
PUBLISHED_PAIRS = {4: 2.95, 5: 2.23, 6: 1.86, 7: 1.73, 8: 1.58, 9: 1.45, 10: 1.15}
PUBLISHED_ONE_OUT = "2.06 +- 1.97"
PUBLISHED_TRACKING = "1.06 +- 0.56"
PUBLISHED_SECONDS = {0: 50.6, 5: 79.6, 10: 81.8, 15: 101.3, 20: 125.8}
PUBLISHED_POSITIONS = "126 against 6"
BOUND_PAIRS = (10, 15, 25)
BOUND_COLUMNS = ("gaussian_tre", "optimum_tre", "tre")


# ---- tables ----


def rms(values: Sequence[FloatArray]) -> float:
    return math.sqrt(float(np.mean([np.mean(np.asarray(v) ** 2) for v in values])))


def mean_std(values: Sequence[FloatArray]) -> tuple[float, float]:
    flat = np.concatenate([np.ravel(v) for v in values])
    return float(flat.mean()), float(flat.std())


def plus_minus(values: Sequence[FloatArray]) -> str:
    mean, std = mean_std(values)
    return f"{mean:.2f} +- {std:.2f}"


def ratio_to_bound(rows: Sequence[Row], which: str = "tre") -> tuple[float, float]:
    """Root mean square TRE over root mean bound, and its standard error (jackknife over sessions)."""
    error = np.array([float(np.mean(row[which] ** 2)) for row in rows])
    bound = np.array([row["bound2"] for row in rows])
    n = len(rows)
    ratio = math.sqrt(error.mean() / bound.mean())
    left = np.sqrt((error.sum() - error) / (bound.sum() - bound))
    return ratio, math.sqrt((n - 1) / n * float(np.sum((left - left.mean()) ** 2)))


class Runner:
    """Runs jobs over all cores and gathers rows by key, in the order of the seeds."""

    def __init__(self, args: argparse.Namespace, pool: Pool) -> None:
        self.args, self.pool = args, pool

    def run(self, title: str, jobs: Sequence[Job]) -> dict[Any, list[Row]]:
        out: dict[Any, list[Row]] = {}
        for done, rows in enumerate(self.pool.map(run_job, jobs), 1):
            for key, row in rows.items():
                out.setdefault(key, []).append(row)
            print(f"\r{title}: {done} of {len(jobs)}   ", end="", file=sys.stderr, flush=True)
        print(file=sys.stderr)
        return out

    def seeds(self, count: int) -> range:
        return range(self.args.seed, self.args.seed + count)


Table = tuple[str, list[str], list[list[str]]]


def cell(value: float | None, decimals: int = 2) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.{decimals}f}"


def calibration_table(runner: Runner) -> Table:
    sizes = tuple(PUBLISHED_CALIBRATION)
    rows = runner.run(
        "calibration", [Job(calibration, PRESETS["paper"], s, sizes) for s in runner.seeds(runner.args.sessions)]
    )
    body = []
    for size in sizes:
        mine = rows[size]
        figures = [mean_std([r[k] for r in mine])[0] for k in ("a_spot", "fgreg_spot", "a_beam", "fgreg_beam")]
        bound = math.sqrt(float(np.mean([r["bound2"] for r in mine])))
        root = rms([r["fgreg_beam"] for r in mine])
        body.append(
            [str(size), cell(PUBLISHED_CALIBRATION[size]), *(cell(f) for f in figures), cell(root), cell(bound)]
        )
    head = ["poses", "published", "(a) spot", "fgreg spot", "(a) beam", "fgreg beam", "fgreg beam rms", "bound rms"]
    title = "Calibration error, mm (spot: held-out spot to line, 1 mm aiming error in it; beam: true, 20 to 60 mm out)"
    return title, head, body


def registration_body(keys: Sequence[Any], rows: dict[Any, list[Row]], published: dict[int, float]) -> list[list[str]]:
    body = []
    for key in keys:
        mine = rows[key]
        good = [r for r in mine if "tre" in r]
        slow = [r for r in mine if "a_tre" in r]
        ratio, error = ratio_to_bound(good)
        body.append(
            [
                str(key),
                cell(published.get(key)),
                cell(mean_std([r["a_residual"] for r in slow])[0] if slow else None),
                cell(mean_std([r["residual"] for r in good])[0]),
                cell(mean_std([r["best_residual"] for r in good])[0]),
                cell(mean_std([r["a_tre"] for r in slow])[0] if slow else None),
                cell(mean_std([r["b_tre"] for r in mine])[0]),
                cell(mean_std([r["tre"] for r in good])[0]),
                cell(mean_std([r["best"] for r in good])[0]),
                f"{100 * (np.mean([r['ambiguous'] for r in good]) if good else 1):.0f} %",
                cell(rms([r["tre"] for r in good])),
                cell(math.sqrt(float(np.mean([r["bound2"] for r in mine])))),
                f"{ratio:.2f} +- {error:.2f}",
            ]
        )
    return body


REGISTRATION_HEAD = [
    "published",
    "(a) pair residual",
    "fgreg pair residual",
    "of the best minimum",
    "(a) TRE",
    "(b) TRE",
    "fgreg TRE",
    "best minimum",
    "ambiguous",
    "fgreg TRE rms",
    "bound rms",
    "ratio",
]


def deviation_table(runner: Runner) -> Table:
    args, jobs = runner.args, []
    for degrees in PUBLISHED_DEVIATION:
        for place, seed in enumerate(runner.seeds(args.sessions)):
            jobs.append(
                Job(
                    registration,
                    deviating(degrees),
                    seed,
                    (10,),
                    place < args.slow,
                    math.radians(degrees),
                    (args.guess_deg, args.guess_mm),
                    args.max_rounds,
                    degrees,
                )
            )
    rows = runner.run("deviations", jobs)
    title = "Simulated registration against deviation (arc angle off the plane, deg), 10 pairs, mm"
    return title, ["deg", *REGISTRATION_HEAD], registration_body(list(PUBLISHED_DEVIATION), rows, PUBLISHED_DEVIATION)


def pairs_table(runner: Runner) -> Table:
    args, sizes = runner.args, tuple(PUBLISHED_PAIRS)
    window = math.radians(8.0)  # 6 deg of stage rotation at 30 mm
    jobs = [
        Job(
            registration,
            PRESETS["paper"],
            seed,
            sizes,
            place < args.slow,
            window,
            (args.guess_deg, args.guess_mm),
            args.max_rounds,
        )
        for place, seed in enumerate(runner.seeds(args.sessions))
    ]
    title = "Registration against number of pairs, mm (window only; fewer than 6 pairs are always refused as open)"
    return title, ["pairs", *REGISTRATION_HEAD], registration_body(sizes, runner.run("pairs", jobs), PUBLISHED_PAIRS)


def first_hit_table(runner: Runner) -> Table:
    config = replace(PRESETS["first-hit"], noise=PRESETS["paper"].noise)
    jobs = [Job(registration, config, seed, tuple(PUBLISHED_PAIRS)) for seed in runner.seeds(runner.args.sessions)]
    title = "The same with sweeps stopped at the first hit from either side (2 deg steps), as fgreg plans them, mm"
    body = registration_body(tuple(PUBLISHED_PAIRS), runner.run("first hit", jobs), PUBLISHED_PAIRS)
    return title, ["pairs", *REGISTRATION_HEAD], body


def bound_table(runner: Runner) -> Table:
    seeds = runner.seeds(runner.args.bound_sessions)
    jobs = [Job(registration, PRESETS["paper"], s, BOUND_PAIRS, gaussian=True) for s in seeds]
    rows = runner.run("bound", jobs)
    body = []
    for size in BOUND_PAIRS:
        good = [r for r in rows[size] if "tre" in r]
        bound = math.sqrt(float(np.mean([r["bound2"] for r in good])))
        figures = [f"{r:.3f} +- {e:.3f}" for r, e in (ratio_to_bound(good, name) for name in BOUND_COLUMNS)]
        body.append([str(size), str(len(good)), cell(rms([r["gaussian_tre"] for r in good])), cell(bound), *figures])
    title = "Against the posterior Cramer-Rao bound, Gaussian window (target: ratio at most 1.07, standard error 0.02)"
    head = ["pairs", "sessions", "fgreg TRE rms, mm", "bound rms, mm", "ratio", "of the graph's optimum"]
    head += ["of the posterior mean, windows in their own shape"]
    return title, head, body


def one_out_table(runner: Runner) -> Table:
    count = max(2, runner.args.sessions // 5)
    rows = runner.run("leave one out", [Job(one_out, PRESETS["paper"], s) for s in runner.seeds(count)])[15]
    figures = [plus_minus([r[key] for r in rows]) for key in ("b_point", "residual", "tre")]
    head = ["published", "(b) point distance", "fgreg pair residual", "fgreg TRE of the whole"]
    return "Leave-one-out with 15 pairs, mm", head, [[PUBLISHED_ONE_OUT, *figures]]


def tracking_table(runner: Runner) -> Table:
    kinds = {"window only": PRESETS["paper"], "first hit": PRESETS["first-hit"]}
    jobs = [Job(tracking, c, s, key=k) for k, c in kinds.items() for s in runner.seeds(runner.args.sessions)]
    rows = runner.run("tracking", jobs)
    body = [[k, PUBLISHED_TRACKING, plus_minus([r["track"] for r in rows[k]])] for k in kinds]
    return "Tracking error with 10 pairs, deg (PM detected once)", ["sweeps", "published", "fgreg"], body


def timing_table(runner: Runner) -> Table:
    args = runner.args
    guess = (args.guess_deg, args.guess_mm)
    jobs = [
        Job(timing, deviating(d), s, guess=guess, max_rounds=args.max_rounds, key=d)
        for d in PUBLISHED_SECONDS
        for s in runner.seeds(max(args.slow, 1))
    ]
    body = []
    for degrees, rows in runner.run("solve time", jobs).items():
        names = ("a_s", "own_s", "same_s", "fgreg_s", "a_cost", "same_cost", "a_own_cost", "own_cost")
        middle = {name: float(np.median([r[name] for r in rows])) for name in names}
        body.append(
            [
                str(degrees),
                cell(PUBLISHED_SECONDS[degrees], 1),
                cell(middle["a_s"], 1),
                f"{sum(r['converged'] for r in rows)} of {len(rows)}",
                cell(middle["a_own_cost"], 1),
                cell(1e3 * middle["own_s"], 1),
                cell(middle["own_cost"], 1),
                f"{np.median([r['a_s'] / r['own_s'] for r in rows]):.0f}",
                cell(middle["a_cost"], 4),
                cell(1e3 * middle["same_s"], 1),
                cell(middle["same_cost"], 4),
                f"{np.median([r['a_s'] / r['same_s'] for r in rows]):.0f}",
                cell(1e3 * middle["fgreg_s"], 0),
            ]
        )
    head = ["deg", "published, s", "(a), s", "(a) converged", "(a) chi square", "fgreg, ms", "its chi square"]
    head += ["times faster", "(a) cost, mm2", "fgreg on that cost, ms", "down to", "times faster", "from no guess, ms"]
    title = (
        "Solve time with 10 pairs, processor time on one core, medians (fgreg from (a)'s guess but for the last column)"
    )
    return title, head, body


def positions_table(runner: Runner) -> Table:
    steps = (1.0, 2.0, 5.0, 10.0)
    count = max(2, runner.args.sessions // 5)
    rows = runner.run(
        "positions", [Job(positions, PRESETS["paper"], s, key=k) for k in steps for s in runner.seeds(count)]
    )
    body = [[f"{k:.0f}", PUBLISHED_POSITIONS, cell(mean_std([r["visited"] for r in rows[k]])[0], 1)] for k in steps]
    title = "Stage positions per PM: a sweep in from one end of an 84 deg field up to the first hit"
    return title, ["step, deg", "published (conventional against arc to line)", "fgreg"], body


TABLES: dict[str, Callable[[Runner], Table]] = {
    "calibration": calibration_table,
    "deviations": deviation_table,
    "pairs": pairs_table,
    "first-hit": first_hit_table,
    "bound": bound_table,
    "leave-one-out": one_out_table,
    "tracking": tracking_table,
    "times": timing_table,
    "positions": positions_table,
}


def as_markdown(table: Table) -> str:
    title, head, body = table
    lines = [f"### {title}", "", "| " + " | ".join(head) + " |", "|" + "---:|" * len(head)]
    lines += ["| " + " | ".join(row) + " |" for row in body]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", choices=list(TABLES), default=list(TABLES), help="some tables only")
    parser.add_argument("--sessions", type=int, default=100, help="a row")
    parser.add_argument("--bound-sessions", type=int, default=1200, help="of the comparison with the bound")
    parser.add_argument("--slow", type=int, default=5, help="sessions a row for (a), minutes each")
    parser.add_argument("--max-rounds", type=int, default=100_000, help="of (a), if it does not converge before")
    parser.add_argument("--guess-deg", type=float, default=5.0, help="rotation of (a)'s first guess from the truth")
    parser.add_argument("--guess-mm", type=float, default=5.0, help="shift of (a)'s first guess from the truth")
    parser.add_argument("--seed", type=int, default=1, help="of the first session of each row; the others follow")
    add_pool_options(parser)
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables there as well")
    parser.add_argument("--json", action="store_true", help="print one JSON document instead of Markdown")
    args = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    tables: list[Table] = []
    with pool_of(args) as pool:
        runner = Runner(args, pool)
        for name in args.only:
            tables.append(TABLES[name](runner))
            if not args.json:
                print(as_markdown(tables[-1]), flush=True)
    if args.json:
        print(json.dumps([{"title": t, "columns": h, "rows": b} for t, h, b in tables], indent=2))
    if args.markdown is not None:
        args.markdown.write_text("\n".join(as_markdown(table) for table in tables), encoding="utf-8")


if __name__ == "__main__":
    main()
