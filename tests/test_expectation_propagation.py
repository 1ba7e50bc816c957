"""Sites that pull far off: a step is shortened until it leads down, or they are given up, and nothing overflows."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from fgreg.graph.expectation_propagation import _step, with_sites
from fgreg.graph.reduced_graph import evaluate
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.register import Registration, register
from tests.forward import make_measurements


@pytest.fixture(scope="module")
def found() -> Registration:
    model, measurements, _ = make_measurements(np.random.default_rng(2), aims=6, pairs=8)
    return register(measurements, model, SolveConfig())


def stepped(found: Registration, off_rad: float, precision: float) -> tuple[float, float | None]:
    """Cost before and after one step where every site is so far off; None where they are given up."""
    problem = found.problem
    signs = np.where(np.arange(len(problem.look_pm)) % 2 == 0, 1.0, -1.0)
    pulled = with_sites(problem, problem.looks.centre_rad + off_rad * signs, np.full(len(signs), precision))
    state, private = found.optimum.state, found.optimum.evaluation.private
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        at = evaluate(pulled, state, private)
        made = _step(pulled, state, at)
    return float(at.cost[0]), None if made is None else float(made[1].cost[0])


@pytest.mark.parametrize("off_rad", [0.0, 0.02, 0.1, 0.3, 1.0])
@pytest.mark.parametrize("precision", [1e2, 1e4])
def test_a_step_leads_down_or_is_not_taken(found: Registration, off_rad: float, precision: float) -> None:
    before, after = stepped(found, off_rad, precision)
    assert np.isfinite(before)
    assert after is None or after <= before + 1e-9 * (1.0 + before)


def test_near_by_sites_are_followed_and_far_ones_are_given_up(found: Registration) -> None:
    before, after = stepped(found, 0.01, 1e3)
    assert after is not None
    assert after < before
    assert stepped(found, 1e6, 1e4)[1] is None


def test_a_whole_step_that_leads_up_is_shortened(found: Registration) -> None:
    problem, state = found.problem, found.optimum.state
    rng = np.random.default_rng(0)
    shortened = 0
    for precision in (10.0, 1e2, 1e3):
        for off_rad in (0.1, 0.3, 0.6, 1.0):
            signs = rng.choice([-1.0, 1.0], len(problem.look_pm))
            pulled = with_sites(problem, problem.looks.centre_rad + off_rad * signs, np.full(len(signs), precision))
            at = evaluate(pulled, state, found.optimum.evaluation.private)
            step = -np.linalg.solve(at.hessian[0], at.gradient[0])
            points = at.private.trus_p_pm + (at.point_gain @ step[None, None, :, None])[..., 0]
            moved = state.retract(step[None], problem.columns)
            whole = evaluate(pulled, moved, replace(at.private, trus_p_pm=points))
            made = _step(pulled, state, at)
            assert made is None or made[1].cost[0] <= at.cost[0] + 1e-9 * (1.0 + at.cost[0])
            shortened += bool(whole.cost[0] > at.cost[0]) and made is not None
    assert shortened >= 3
