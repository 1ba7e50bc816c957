"""The benchmark compares like with like: the problem given to other optimisers, and the gate on stored ratios."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from bench.compare import Row, in_turn, rows_of
from bench.contenders import Case, SparseProblem, explicit_own, reduced
from bench.gate import losses, store
from tests.forward import make_measurements


def _case() -> Case:
    model, measurements, truth = make_measurements(np.random.default_rng(3), pairs=6)
    return Case(model, measurements, truth.trus_T_camera[0], truth.marker_T_laser)


def test_jacobian_of_the_arrays() -> None:
    problem = SparseProblem(_case().scene())
    rng = np.random.default_rng(0)
    x = problem.start() + 0.05 * rng.normal(size=problem.size)
    direction = rng.normal(size=problem.size)
    step = 1e-6
    numerical = (problem.residual(x + step * direction) - problem.residual(x - step * direction)) / (2.0 * step)
    assert problem.jacobian(x) @ direction == pytest.approx(numerical, rel=1e-6, abs=1e-6 * np.abs(numerical).max())


def test_arrays_have_the_explicit_graphs_cost() -> None:
    case = _case()
    costs = []
    for solver in (reduced(case), explicit_own(case)):
        assert solver.cost is not None
        costs.append(solver.cost(solver.run()))
    assert costs[0] == pytest.approx(costs[1], rel=1e-6)


def test_ratios_are_of_the_same_round() -> None:
    ticks = iter([0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 3.0, 0.0, 4.0, 4.0, 16.0])
    times = in_turn({"ours": lambda: None, "other": lambda: None}, 2, clock=lambda: next(ticks))
    rows = rows_of("section", "case", times, {})
    assert [row.ratio for row in rows] == [1.0, 2.5]  # rounds of 2 and 3
    assert [row.ms for row in rows] == [2500.0, 7000.0]
    assert [row.worse for row in rows] == [0, -1]
    assert [row.worse for row in rows_of("section", "case", times, {}, own=["other"])] == [0, 1]


def test_gate_fails_on_a_loss_of_over_a_quarter(tmp_path: Path) -> None:
    path = tmp_path / "ratios.json"
    base, other = Row("solve", "10 pairs", "this package", 1.0, 1.0, 1.0, 1.0, 9), "scipy least_squares"

    def rows(of_other: float, of_own: float) -> list[Row]:
        own = Row("marker", "frame", "this package", of_own, of_own, of_own, of_own, 9, worse=1)
        return [base, Row("solve", "10 pairs", other, of_other, of_other, of_other, of_other, 9, worse=-1), own]

    store(rows(5.0, 2.0), path)
    assert json.loads(path.read_text()) == {"marker | frame | this package": 2.0, f"solve | 10 pairs | {other}": 5.0}
    assert not losses(rows(4.1, 2.4), path)
    assert losses(rows(3.9, 2.4), path) == [f"solve | 10 pairs | {other}: 3.9, stored 5"]
    assert losses(rows(7.0, 2.6), path) == ["marker | frame | this package: 2.6, stored 2"]
