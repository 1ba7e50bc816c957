"""Whitened PMs and windows as the camera-move test has them, and screening against the full test."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from fgreg.camera_moves.bayes_filter import MoveSettings, move_evidence
from fgreg.camera_moves.detector import screening
from fgreg.camera_moves.whitened import (
    Gaussian,
    WhitenedPms,
    WindowRows,
    gaussian_of,
    linearise,
    pivot_scale,
    settled_private,
    whiten,
)
from fgreg.graph.contributions import contributions
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.reduced_system import refine
from fgreg.graph.shared_state import SharedState, make_state
from fgreg.graph.split_points import default_scales
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.outliers import pm_degrees_of_freedom, pm_limits
from fgreg.registration.register import pack_session
from pm_selection import select_pms
from tests.camera_move_cases import move_case
from tests.forward import make_measurements

PLAIN = SolveConfig(window_shape=False)
SHAPED = SolveConfig()
FIRST = np.zeros(1, dtype=np.int64)


def _session(
    seed: int, pairs: int, *, first_hit: bool = True, looks: int = 1, config: SolveConfig = PLAIN
) -> tuple[PackedProblem, SharedState]:
    """A packed session without its aims, and the truth as a state."""
    model, measurements, truth = make_measurements(
        np.random.default_rng(seed), aims=0, pairs=pairs, first_hit=first_hit, looks_per_pm=looks
    )
    state = make_state(truth.trus_T_camera[0][None, None], truth.marker_T_laser)
    return pack_session(measurements, model, config), state


@pytest.mark.parametrize("looks", [1, 2])
def test_whitened_pairs_have_the_reduced_problems_cost_gradient_and_hessian(looks: int) -> None:
    problem, state = _session(3, 6, looks=looks)
    private = initial_private(problem, state)
    for _ in range(4):
        private = refine(problem, state, private)
    part = contributions(problem, state, private).pm
    scale = pivot_scale(problem.columns)
    terms = whiten(part, pm_degrees_of_freedom(problem), scale)
    jacobian, residual = terms.jacobian[0], terms.residual[0]
    hessian = np.swapaxes(jacobian, -1, -2) @ jacobian * scale * scale[:, None]
    np.testing.assert_allclose(hessian, part.hessian()[0] * scale * scale[:, None], rtol=1e-6, atol=1e-8)
    gradient = np.einsum("nqd,nq->nd", jacobian, residual) * scale
    np.testing.assert_allclose(gradient, part.gradient[0] * scale, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(np.sum(residual**2, axis=-1) + terms.rest[0], part.cost[0], rtol=1e-9)
    if looks == 1:  # two equations in two rows: a step can remove the whole residual
        np.testing.assert_allclose(terms.rest[0], 0.0, atol=1e-6)


def test_steps_are_counted_from_the_base_wherever_pairs_are_linearised() -> None:
    problem, base = _session(4, 5)
    step = np.zeros((2, problem.columns.size))
    step[1, :6] = [0.002, -0.001, 0.003, 0.2, -0.1, 0.3]
    many = base.take(np.zeros(2, dtype=np.int64))
    terms = linearise(problem, many.retract(step, problem.columns), base)
    there = terms.residual[1] + terms.jacobian[1] @ step[1]
    from_base = terms.residual[0] + terms.jacobian[0] @ step[1]
    # The rows may differ by a rotation: their square counts.
    np.testing.assert_allclose(np.sum(there**2, -1), np.sum(from_base**2, -1), rtol=0.1, atol=0.05)


def _alone(mean: float, sigma: float, half_width: float, soft: float) -> WhitenedPms:
    """One pair whose only information is that its rotation (the first shared variable) is in a window."""
    rows = WindowRows(
        there=np.array([True]),
        mean=np.full((1, 1), mean),
        variance=np.full((1, 1), sigma**2),
        gain=np.concatenate([np.ones((1, 1, 1)), np.zeros((1, 1, 6))], axis=2),
        low=np.array([-half_width]),
        high=np.array([half_width]),
        soft=np.array([soft]),
        site=np.array([half_width / math.sqrt(3.0)]),
    )
    return WhitenedPms(np.zeros((1, 1, 1)), np.zeros((1, 1, 1, 7)), np.zeros((1, 1)), np.array([2]), rows)


@pytest.mark.parametrize("mean", [0.0, 0.08, 0.13, -0.2])
def test_a_window_counts_as_the_interval_it_is(mean: float) -> None:
    """Evidence of steady against moved with one window, by quadrature over the rotation."""
    half_width, soft, sigma, root = 0.105, 0.004, 0.01, 0.02
    before = Gaussian(np.zeros(7), np.diag([root**2] + [1.0] * 6))
    settings = MoveSettings(outlier_probability=1e-12)
    test = move_evidence(before, _alone(mean, sigma, half_width, soft), FIRST, settings)

    def inside(spread: float) -> float:
        def density(at: float) -> float:
            edges = norm.cdf((half_width - at) / soft) - norm.cdf((-half_width - at) / soft)
            return float(edges * norm.pdf(at, mean, spread))

        return quad(density, mean - 8 * spread, mean + 8 * spread, limit=400, points=[-half_width, half_width])[0]

    scales = settings.scales
    steady = inside(math.hypot(sigma, root))
    moved = sum(
        share * inside(math.sqrt(sigma**2 + root**2 + turn**2))
        for share, turn in zip(scales.share, scales.rotation_rad, strict=True)
    )
    assert test.log_bayes[0] == pytest.approx(math.log(moved / steady), abs=2e-3)


def test_a_rotation_in_its_window_leaves_the_moments_of_the_truncated_gaussian() -> None:
    half_width, soft, sigma, root, mean = 0.105, 0.003, 0.01, 0.05, 0.12
    before = Gaussian(np.zeros(7), np.diag([root**2] + [1.0] * 6))
    tight = MoveSettings(replace(default_scales(), rotation_rad=np.full(5, 1e-9)), outlier_probability=1e-12)
    test = move_evidence(before, _alone(mean, sigma, half_width, soft), FIRST, tight)
    x = np.linspace(-0.4, 0.4, 20001)
    edge = math.hypot(sigma, soft)
    weight = norm.pdf(x, 0.0, root) * (
        norm.cdf((half_width - mean - x) / edge) - norm.cdf((-half_width - mean - x) / edge)
    )
    weight /= weight.sum()
    expected = float(weight @ x)
    assert test.moved.mean[0] == pytest.approx(expected, abs=2e-4)
    assert test.moved.covariance[0, 0] == pytest.approx(float(weight @ (x - expected) ** 2), rel=0.01)


def test_window_only_pairs_are_distinguished_from_moved_ones_by_their_windows_ends() -> None:
    """A rotation well outside the window is stronger evidence for a move than its Gaussian approximation."""
    problem, state = _session(9, 12, first_hit=False, config=SHAPED)
    terms = linearise(problem, state)
    assert terms.windows is not None
    assert terms.windows.there.all()
    assert linearise(replace(problem, shapes=None), state).windows is None
    # At the truth the rotations are inside their windows, give or take their own noise.
    sigma = np.sqrt(terms.windows.variance[0] + terms.windows.soft**2)
    assert (terms.windows.mean[0] < terms.windows.high + 4.0 * sigma).all()
    assert (terms.windows.mean[0] > terms.windows.low - 4.0 * sigma).all()


def test_first_hits_keep_their_rows() -> None:
    problem, state = _session(9, 6, first_hit=True, config=SHAPED)
    assert linearise(problem, state).windows is None


def test_screening_is_the_full_test_where_all_is_gaussian() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(10), pairs=18)
    case = move_case(measurements, model)
    assert case.inlier.all()
    assert case.known is not None
    problem = pack_session(replace(measurements, aims=()), model, PLAIN)
    parts = contributions(problem, case.known.state, settled_private(problem, case.known.state)).pm
    screened = screening(parts, case.inlier, case.known, pm_limits(problem))
    hessian = case.known.hessian + parts.hessian()[0, :8].sum(axis=0)
    gradient = case.known.gradient + parts.gradient[0, :8].sum(axis=0)
    before = gaussian_of(hessian, gradient, problem.columns)
    assert before is not None
    terms = linearise(select_pms(problem, np.arange(8, 18)), case.known.state)
    full = move_evidence(before, terms, np.arange(10), MoveSettings(outlier_probability=1e-9))
    np.testing.assert_allclose(screened[7:], full.log_bayes, atol=1e-3)
