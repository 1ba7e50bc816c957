"""Influence of each pair: the closed form against solving again, and the pair of largest influence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fgreg.graph.packing import pack
from fgreg.graph.reduced_solver import optimize
from fgreg.graph.shared_state import step_between
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.influence import influences
from fgreg.registration.register import register
from tests.forward import make_measurements


def test_closed_form_agrees_with_solving_again() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(1), pairs=14)
    found = register(measurements, model, SolveConfig())
    for item in influences(found, model.targets_mm):
        rest = replace(measurements, pairs=tuple(p for p in measurements.pairs if p.pm != item.pm))
        again = optimize(pack(rest, model), found.optimum.state)
        actual = step_between(found.optimum.state, again.state, found.problem.columns)[0, :6]
        sigma = np.sqrt(np.diag(found.covariance)[:6])
        # One Newton step: right up to the curvature, a few per cent of a sigma here.
        assert np.max(np.abs(item.step - actual) / sigma) < 0.12
        assert item.expected_without_mm > item.expected_mm


def test_an_outlier_has_the_largest_influence() -> None:
    for seed in (3, 4):
        model, measurements, _ = make_measurements(np.random.default_rng(seed), pairs=14)
        pairs = list(measurements.pairs)
        pairs[4] = replace(pairs[4], look=replace(pairs[4].look, x_mm=pairs[4].look.x_mm + 10.0))
        # Solved with it as an inlier: registering would reject it as an outlier.
        clean, moved = register(measurements, model, SolveConfig()), replace(measurements, pairs=tuple(pairs))
        problem = pack(moved, model)
        found = replace(clean, measurements=moved, problem=problem, optimum=optimize(problem, clean.optimum.state))
        items = sorted(influences(found, model.targets_mm), key=lambda item: -item.moved_mm)
        assert items[0].pm == 4
        assert items[0].moved_mm > 1.5 * items[1].moved_mm


def test_a_pair_that_alone_determines_something_has_infinite_influence() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(3), pairs=12, epochs=2)
    # Without epoch 1's pairs that registration is undetermined; three leave it just determined, two do not.
    kept = tuple(p for p in measurements.pairs if p.epoch == 0 or p.pm in (6, 7, 8))
    found = register(replace(measurements, pairs=kept), model, SolveConfig())
    items = {item.pm: item for item in influences(found, model.targets_mm)}
    assert np.isfinite(items[0].moved_mm)
    assert items[0].epoch == 0
    assert items[7].epoch == 1
    assert items[7].expected_without_mm > 5.0 * items[7].expected_mm
