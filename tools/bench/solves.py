"""The solve against other optimisers, by number of pairs; and the judged solve against native factors."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from bench.compare import BUDGET_S, Row, Section, Target, in_turn, rows_of, say
from bench.contenders import CONTENDERS, Case, Solver, native_star
from bench.judged import judged_pairs
from fgreg.geometry.transforms import exp_so3, make_transform
from fgreg.model.solve_config import SolveConfig
from fgreg.model.systematic import Systematic
from fgreg.registration.posterior_mean import posterior_mean
from fgreg.registration.register import register
from fgreg.registration.solve import solve
from tests.forward import make_measurements, make_session

PAIRS = (10, 30, 100, 300, 1000)
SAME_COST = 1e-6
SHAKE = make_transform(exp_so3(np.array([0.05, -0.05, 0.05])), np.array([3.0, 3.0, -3.0]))
"""Of the start, 5 deg and 5 mm from the truth."""
SMALL, NATIVE = 15, 1000
"""Pairs of the judged solve, and of the native graph beside it."""


def make_case(pairs: int, seed: int) -> Case:
    """12 aims and so many first-hit pairs of one epoch, all constants but the window's edge known."""
    model, measurements, truth = make_measurements(np.random.default_rng(seed), pairs=pairs)
    return Case(model, measurements, truth.trus_T_camera[0] @ SHAKE, truth.marker_T_laser)


def bench_solves(pairs: list[int], repeats: int, seed: int, budget_s: float = BUDGET_S) -> Section:
    """All optimisers at each number of pairs, from the same start to the same cost."""
    rows: list[Row] = []
    too_slow: dict[str, float] = {}
    ours_ms: dict[int, float] = {}
    star: dict[int, float] = {}
    for count in pairs:
        case, solvers, absent = make_case(count, seed), dict[str, Solver](), list[Row]()
        name_of = f"12 aims, {count} pairs"
        for name, make in CONTENDERS.items():
            if name in too_slow:
                note = f"not run: {too_slow[name]:.0f} s with fewer pairs"
                absent.append(Row("solve", name_of, name, note=note))
                continue
            say(f"{name_of}: {name}")
            solver = make(case)
            if solver is None:
                absent.append(Row("solve", name_of, name, note="not installed"))
            else:
                solvers[name] = solver
        notes, once_s = _first_runs(solvers)
        too_slow |= {name: once_s[name] for name in solvers if once_s[name] > budget_s}
        runs = {name: solver.run for name, solver in solvers.items() if name not in too_slow}
        times = in_turn(runs, repeats, budget_s=budget_s)
        times |= {name: [once_s[name]] for name in solvers if name in too_slow}
        found = rows_of("solve", name_of, times, notes)
        for row in found:
            say(f"  {row.name}: {row.ms:.4g} ms, {row.ratio:.3g}  {row.note}")
        rows += [*found, *absent]
        ours_ms[count] = found[0].ms or 0.0
        star[count] = next((row.ratio or 0.0 for row in found if row.name == "native factors, star"), 0.0)
        del solvers
        gc.collect()
    targets = []
    others = [r for r in rows if r.ratio is not None and "native" not in r.name and r.name != "this package"]
    if others:
        slowest = min(others, key=lambda row: row.ratio or 0.0)
        text = f"this package over the fastest of the others ({slowest.name}, {slowest.case})"
        targets.append(Target(text, 1.0 / (slowest.ratio or 1.0), 1.0))
    if NATIVE in star:
        targets.append(Target("this package over native factors (star), 1,000 pairs", 1.0 / star[NATIVE], 1.0))
    if 100 in ours_ms and NATIVE in ours_ms:
        growth = (ours_ms[NATIVE] / NATIVE) / (ours_ms[100] / 100)
        targets.append(Target("time per pair, 1,000 pairs over 100", growth, 1.5))
    return Section(tuple(rows), tuple(targets))


def _first_runs(solvers: dict[str, Solver]) -> tuple[dict[str, str], dict[str, float]]:
    """One run of each: notes on the cost that it reaches, and its time, s."""
    costs, once_s = dict[str, float](), dict[str, float]()
    notes: dict[str, str] = {}
    for name, solver in solvers.items():
        start = time.process_time()
        found = solver.run()
        once_s[name] = time.process_time() - start
        if solver.cost is not None:
            costs[name] = solver.cost(found)
    least = min(cost for name, cost in costs.items() if not solvers[name].note)
    for name, solver in solvers.items():
        above = costs[name] / least - 1.0 if name in costs else None
        if solver.note:
            notes[name] = (
                solver.note if above is None else f"{solver.note}; chi square {1.0 + above:.3g} times the least"
            )
        elif above is not None and above > SAME_COST:
            notes[name] = f"not the same cost: {above:.1e} above the least"
    return notes, once_s


def bench_judged(repeats: int, seed: int) -> Section:
    """The full solve of 12 aims and 15 pairs, with posterior, verdict and default ``systematic``; and its parts.

    Also the judged pairs of a session: each of the first 10 of an epoch, as the engine takes them in in one process.
    """
    session = make_session(systematic=Systematic())
    model, measurements, _ = make_measurements(np.random.default_rng(seed), pairs=SMALL, session=session)
    config = SolveConfig()
    registration = register(measurements, model, config)
    say(f"judged solve: {SMALL} pairs, native graph of {NATIVE}")
    runs: dict[str, Callable[[], Any]] = {
        "native factors, star": native_star(make_case(NATIVE, seed)).run,
        "solve, posterior and verdict": lambda: solve(measurements, [], model, config),
        "of which registration": lambda: register(measurements, model, config),
        "of which posterior": lambda: posterior_mean(registration, config),
    }
    case = f"12 aims, {SMALL} pairs, beside {NATIVE} native pairs"
    rows = rows_of("full solve", case, in_turn(runs, repeats), {}, own=[name for name in runs if "native" not in name])
    whole = next(row for row in rows if row.name.startswith("solve"))
    targets = [Target(f"full solve of {SMALL} pairs over native factors (star), 1,000 pairs", whole.ratio or 0.0, 3.0)]
    say("judged pairs of two epochs")
    native = native_star(make_case(NATIVE, seed)).run
    pairs = judged_pairs(native, whole.ratio or 1.0, repeats, seed)
    rows += [*pairs.rows]
    return Section(tuple(rows), (*targets, *pairs.targets))
