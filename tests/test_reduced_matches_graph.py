"""The reduced problem and the explicit graph are two derivations of one estimate."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fgreg.geometry.transforms import FloatArray
from fgreg.graph.contributions import contributions
from fgreg.graph.gtsam_graph import ExplicitGraph, GraphOptions, build_graph
from fgreg.graph.gtsam_values import SharedValues
from fgreg.graph.packing import PackedProblem, pack
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.reduced_graph import Costs, Weights, evaluate, log_posterior
from fgreg.graph.reduced_solver import Optimum, distinct, optimize
from fgreg.graph.reduced_system import private_at, refine
from fgreg.graph.shared_state import SharedState, make_state, stack_states, step_between
from fgreg.model.session_model import NoiseModel
from fgreg.model.systematic import Systematic
from graph_covariance import GraphCovariance
from graph_optimum import GraphOptimum, initial_values, read_shared
from graph_optimum import optimize as optimize_graph
from tests.forward import make_measurements, make_session, with_dependences

CASES: dict[str, dict[str, Any]] = {
    "first hit": {"pairs": 12},
    "window only": {"pairs": 12, "first_hit": False},
    "looks share a marker": {"pairs": 8, "looks_per_pm": 3, "share_marker": True},
    "looks with markers of their own": {"pairs": 8, "looks_per_pm": 2},
    "camera moved, motion known": {"pairs": 16, "epochs": 2, "known_motion": True},
    "spots seen": {
        "pairs": 10,
        "looks_per_pm": 2,
        "share_marker": True,
        "epochs": 2,
        "known_motion": True,
        "spot_sigma_mm": (0.4, 0.4, 1.5),
    },
    "known points": {
        "pairs": 10,
        "epochs": 2,
        "known_motion": True,
        "points": 4,
        "session": make_session(noise_model=NoiseModel(marker_bias_mm=0.2), systematic=Systematic()),
    },
    "marker bias": {"pairs": 12, "session": make_session(noise_model=NoiseModel(marker_bias_mm=0.3))},
}


def _both(case: str) -> tuple[PackedProblem, Optimum, ExplicitGraph, GraphOptimum, SharedValues]:
    model, measurements, truth = make_measurements(np.random.default_rng(4), **CASES[case])
    problem = pack(measurements, model)
    start = make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser)
    found = optimize(problem, start, tolerance=1e-12)
    options = GraphOptions(marker_T_nominal=truth.marker_T_laser, unknown_motion_sigma=None)
    explicit = build_graph(measurements, model, options)
    shared = SharedValues(truth.trus_T_camera, np.zeros(4))
    reference = optimize_graph(explicit, initial_values(explicit, shared))
    return problem, found, explicit, reference, read_shared(explicit, reference.values, shared)


@pytest.mark.parametrize("case", CASES)
def test_optimum_is_that_of_the_explicit_graph(case: str) -> None:
    problem, found, _, reference, there = _both(case)
    assert found.converged.all()
    assert reference.converged
    assert found.evaluation.cost[0] == pytest.approx(2.0 * reference.cost, rel=1e-5)
    epochs = problem.columns.epochs
    other = make_state(np.stack(there.trus_T_camera)[None], found.state.marker_T_nominal, there.marker_laser[None])
    poses = step_between(found.state, other, problem.columns)[0, : 6 * epochs]
    step = np.concatenate([poses, there.marker_laser - found.state.beam[0]])
    size = len(step)
    covariance = np.linalg.inv(found.evaluation.hessian[0])[:size, :size]
    assert np.sqrt(step @ np.linalg.solve(covariance, step)) < 2e-3


@pytest.mark.parametrize("case", CASES)
def test_covariance_is_that_of_the_explicit_graph(case: str) -> None:
    _, found, explicit, reference, _ = _both(case)
    keys = [*explicit.keys.trus_T_camera, explicit.keys.marker_laser]
    expected = GraphCovariance(explicit, reference.values).shared(keys)
    size = len(expected)
    covariance = np.linalg.inv(found.evaluation.hessian[0])[:size, :size]
    sigma = np.sqrt(np.diag(expected))
    assert np.abs((covariance - expected) / np.outer(sigma, sigma)).max() < 0.02


def _profile_cost(problem: PackedProblem, state: SharedState) -> float:
    private = initial_private(problem, state)
    for _ in range(12):
        private = refine(problem, state, private)
    return float(evaluate(problem, state, private).cost[0])


def test_gradient_is_the_derivative_of_the_profiled_cost() -> None:
    model, measurements, truth = make_measurements(
        np.random.default_rng(0),
        pairs=8,
        looks_per_pm=2,
        epochs=2,
        known_motion=True,
        spot_sigma_mm=(0.5, 0.4, 1.5),
        points=3,
        session=make_session(noise_model=NoiseModel(marker_bias_mm=0.1), systematic=Systematic()),
    )
    problem = pack(with_dependences(measurements, 5), model)
    size = problem.columns.size
    state = make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser)
    state = state.retract(np.random.default_rng(1).normal(size=(1, size)) * 0.01, problem.columns)
    private = initial_private(problem, state)
    for _ in range(12):
        at = evaluate(problem, state, private)
        private = at.private
    numerical = np.empty(size)
    for i in range(size):
        step = np.zeros((1, size))
        step[0, i] = 1e-5
        ahead = _profile_cost(problem, state.retract(step, problem.columns))
        behind = _profile_cost(problem, state.retract(-step, problem.columns))
        numerical[i] = (ahead - behind) / 2e-5 / 2.0  # the gradient is of half the chi square
    scale = np.sqrt(np.diag(at.hessian[0]))
    assert np.abs((at.gradient[0] - numerical) / scale).max() < 1e-4 * np.abs(numerical / scale).max()


def test_contributions_of_pms_sum_to_the_whole() -> None:
    model, measurements, truth = make_measurements(
        np.random.default_rng(3), pairs=9, looks_per_pm=2, spot_sigma_mm=(0.4, 0.4, 1.5)
    )
    problem = pack(measurements, model)
    found = optimize(problem, make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser))
    parts = contributions(problem, found.state, found.evaluation.private)
    alone = pack(replace(measurements, pairs=()), model)
    # Evaluated at the same shared state: what the pairs add is the whole less what aims and priors say.
    rest = evaluate(alone, found.state, _aims_only(alone, found))
    whole = evaluate(problem, found.state, found.evaluation.private)
    pm = parts.pm
    np.testing.assert_allclose(pm.hessian()[0].sum(axis=0) + rest.hessian[0], whole.hessian[0], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(pm.gradient[0].sum(axis=0) + rest.gradient[0], whole.gradient[0], atol=1e-5)
    assert pm.cost.sum() + rest.cost[0] == pytest.approx(whole.cost[0], rel=1e-9)
    others = parts.aim.hessian().sum(axis=1) + parts.prior_hessian
    np.testing.assert_allclose(others, rest.hessian, rtol=1e-9)
    assert parts.aim.cost.sum() + parts.prior_cost[0] == pytest.approx(rest.cost[0], rel=1e-9)


def _aims_only(alone: PackedProblem, found: Optimum) -> Any:
    private = initial_private(alone, found.state)
    of = found.evaluation.private
    return replace(private, aim_error=of.aim_error, aim_shift=of.aim_shift)


def test_hypotheses_side_by_side_do_not_touch_each_other() -> None:
    model, measurements, truth = make_measurements(np.random.default_rng(5), pairs=7)
    problem = pack(measurements, model)
    good = make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser)
    steps: FloatArray = np.random.default_rng(6).normal(size=(3, problem.columns.size)) * 0.02
    many = good.take([0, 0, 0]).retract(steps, problem.columns)
    together = log_posterior(problem, many, initial_private(problem, many))
    for i in range(3):
        one = many.take([i])
        assert log_posterior(problem, one, initial_private(problem, one))[0] == pytest.approx(together[i], rel=1e-12)


def test_hypotheses_that_have_come_together_go_on_as_one() -> None:
    model, measurements, truth = make_measurements(np.random.default_rng(7), pairs=8)
    problem = pack(measurements, model)
    found = optimize(problem, make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser))
    root = np.linalg.cholesky(np.linalg.inv(found.evaluation.hessian[0]))
    steps: FloatArray = np.array([0.0, 0.3, 20.0, 0.2])[:, None] * root[:, [0, 0, 0, 3]].T
    many = found.state.take([0, 0, 0, 0]).retract(steps, problem.columns)
    at = evaluate(problem, many, private_at(problem, many))
    assert list(distinct(problem, many, at)) == [0, 2]
    turned = replace(many, marker_T_nominal=many.marker_T_nominal @ np.diag([-1.0, -1.0, 1.0, 1.0]))
    both = stack_states([many, turned])
    assert len(distinct(problem, both, evaluate(problem, both, private_at(problem, both)))) >= 3


def test_a_hypothesis_that_cannot_reach_the_wanted_cost_is_dropped() -> None:
    model, measurements, truth = make_measurements(np.random.default_rng(8), pairs=10)
    problem = pack(measurements, model)
    start = make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser)
    start = start.retract(np.full((1, problem.columns.size), 0.02), problem.columns)
    free = optimize(problem, start)
    least = float(free.evaluation.cost[0])
    within = optimize(problem, start, wanted=least + 1.0)
    assert within.evaluation.cost[0] == pytest.approx(least, abs=1e-6)
    beyond = optimize(problem, start, wanted=least - 1.0)
    assert beyond.iterations < free.iterations
    assert beyond.evaluation.cost[0] > least


def test_a_loss_weighs_as_shots_left_out_do() -> None:
    model, measurements, truth = make_measurements(
        np.random.default_rng(9), pairs=9, looks_per_pm=2, spot_sigma_mm=(0.4, 0.4, 1.5)
    )
    problem = pack(measurements, model)
    state = make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser)
    private = private_at(problem, state)
    kept = np.arange(9) != 4

    def without_one(costs: Costs) -> Weights:
        pm = kept * np.ones_like(costs.pm)
        return Weights(pm, np.ones_like(costs.aim), (pm * costs.pm).sum(axis=1) + costs.aim.sum(axis=1) + costs.prior)

    weighted = evaluate(problem, state, private, without_one)
    parts = contributions(problem, state, private)
    left = [parts.prior_hessian[0], parts.pm.total(kept.astype(float))[0], parts.aim.total()[0]]
    np.testing.assert_allclose(weighted.hessian[0], sum(left), rtol=1e-6, atol=1e-6)
    rest = replace(measurements, pairs=tuple(pair for pair in measurements.pairs if pair.pm != problem.pms[4]))
    alone = pack(rest, model)
    there = evaluate(
        alone,
        state,
        replace(private, trus_p_pm=private.trus_p_pm[:, kept], beam_error=private.beam_error[:, kept[problem.beam_pm]]),
    )
    np.testing.assert_allclose(weighted.gradient, there.gradient, rtol=1e-9, atol=1e-9)
    assert weighted.cost[0] == pytest.approx(there.cost[0], rel=1e-12)
