"""Whitened pairs and windows as the test for moves has them, and the cheap look beside the proper test."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from fgreg.camera_moves.bayes_filter import MoveSettings, check_for_move, quick_score
from fgreg.camera_moves.whitened import (
    Gaussian,
    WhiteTerms,
    WindowRows,
    add_terms,
    linearise,
    pivot_scale,
    pose_columns,
    whiten,
)
from fgreg.config import SolveConfig
from fgreg.frames import FloatArray, exp_so3, inverse, make_transform
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced import contributions, refine
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.shared_state import SharedState, make_state
from fgreg.measurements import EpochStart, Measurements, Pair
from fgreg.models import SessionModel
from fgreg.registration import pack_session
from fgreg.robust import pm_degrees_of_freedom
from fgreg.steadiness import default_scales
from tests.epoch_follower import EpochFollower, summarise_aims
from tests.forward import Truth, make_measurements, random_marker_T_laser, random_trus_T_camera

PLAIN = SolveConfig(window_shape=False)
SHAPED = SolveConfig()


def _session(
    seed: int, pairs: int, *, first_hit: bool = True, looks: int = 1, config: SolveConfig = PLAIN
) -> tuple[PackedProblem, SharedState, Truth]:
    """A packed session with its aims summed up, and the truth as a state."""
    model, measurements, truth = make_measurements(
        np.random.default_rng(seed), pairs=pairs, first_hit=first_hit, looks_per_pm=looks
    )
    return _packed(model, measurements, truth, config)


def _packed(
    model: SessionModel, measurements: Measurements, truth: Truth, config: SolveConfig
) -> tuple[PackedProblem, SharedState, Truth]:
    state = make_state(truth.trus_T_camera[0][None, None], truth.marker_T_laser, model.probe.radius_mm)
    return summarise_aims(pack_session(measurements, model, config), state), state, truth


def _moved_session(seed: int, motion: FloatArray, before: int, after: int) -> tuple[PackedProblem, SharedState, Truth]:
    """Pairs before and after a motion camera_new_T_camera_old that nobody told."""
    rng = np.random.default_rng(seed)
    old, beam = random_trus_T_camera(rng), random_marker_T_laser(rng)
    model, first, truth = make_measurements(
        np.random.default_rng([seed, 1]), pairs=before, trus_T_camera=old, marker_T_laser=beam
    )
    _, second, _ = make_measurements(
        np.random.default_rng([seed, 1]), aims=0, pairs=after, trus_T_camera=old @ inverse(motion), marker_T_laser=beam
    )
    late = [Pair(p.t + 100.0, p.pm + before, 0, replace(p.marker, id=p.marker.id + 1000), p.look) for p in second.pairs]
    return _packed(model, Measurements(first.aims, first.pairs + tuple(late), (EpochStart(0.0),)), truth, PLAIN)


@pytest.mark.parametrize("looks", [1, 2])
def test_whitened_pairs_have_the_reduced_problems_cost_gradient_and_hessian(looks: int) -> None:
    problem, state, _ = _session(3, 6, looks=looks)
    private = initial_private(problem, state)
    for _ in range(4):
        _, private = refine(problem, state, private)
    part = contributions(problem, state, private).pm
    scale = pivot_scale(problem.columns)
    terms = whiten(part, pm_degrees_of_freedom(problem), scale)
    jacobian, residual = terms.jacobian[0], terms.residual[0]
    hessian = np.swapaxes(jacobian, -1, -2) @ jacobian * scale * scale[:, None]
    np.testing.assert_allclose(hessian, part.hessian[0] * scale * scale[:, None], rtol=1e-6, atol=1e-8)
    gradient = np.einsum("nqd,nq->nd", jacobian, residual) * scale
    np.testing.assert_allclose(gradient, part.gradient[0] * scale, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(np.sum(residual**2, axis=-1) + terms.rest[0], part.cost[0], rtol=1e-9)
    if looks == 1:  # two equations in two rows: nothing is left that no step takes away
        np.testing.assert_allclose(terms.rest[0], 0.0, atol=1e-6)


def test_steps_are_counted_from_the_base_wherever_pairs_are_linearised() -> None:
    problem, base, _ = _session(4, 5)
    step = np.zeros((2, problem.columns.size))
    step[1, :6] = [0.002, -0.001, 0.003, 0.2, -0.1, 0.3]
    many = base.take(np.zeros(2, dtype=np.int64))
    terms = linearise(problem, many.retract(step, problem.columns), base)
    there = terms.residual[1] + terms.jacobian[1] @ step[1]
    from_base = terms.residual[0] + terms.jacobian[0] @ step[1]
    # The rows may be turned against each other: what counts is their square.
    np.testing.assert_allclose(np.sum(there**2, -1), np.sum(from_base**2, -1), rtol=0.1, atol=0.05)


def _alone(mean: float, sigma: float, half_width: float, soft: float) -> WhiteTerms:
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
    return WhiteTerms(np.zeros((1, 1, 1)), np.zeros((1, 1, 1, 7)), np.zeros((1, 1)), np.array([2]), rows)


@pytest.mark.parametrize("mean", [0.0, 0.08, 0.13, -0.2])
def test_a_window_counts_as_the_interval_it_is(mean: float) -> None:
    """Evidence of steady against moved with one window, by quadrature over the rotation."""
    half_width, soft, sigma, root = 0.105, 0.004, 0.01, 0.02
    before = Gaussian(np.zeros(7), np.diag([root**2] + [1.0] * 6))
    settings = MoveSettings(junk_probability=1e-12)
    test = check_for_move(before, _alone(mean, sigma, half_width, soft), settings, pose=slice(0, 6))

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
    tight = MoveSettings(replace(default_scales(), rotation_rad=np.full(5, 1e-9)), junk_probability=1e-12)
    test = check_for_move(before, _alone(mean, sigma, half_width, soft), tight, pose=slice(0, 6))
    x = np.linspace(-0.4, 0.4, 20001)
    edge = math.hypot(sigma, soft)
    weight = norm.pdf(x, 0.0, root) * (
        norm.cdf((half_width - mean - x) / edge) - norm.cdf((-half_width - mean - x) / edge)
    )
    weight /= weight.sum()
    expected = float(weight @ x)
    assert test.moved.mean[0] == pytest.approx(expected, abs=2e-4)
    assert test.moved.covariance[0, 0] == pytest.approx(float(weight @ (x - expected) ** 2), rel=0.01)


def test_window_only_pairs_are_told_from_moved_ones_by_their_windows_ends() -> None:
    """A rotation well outside the window speaks more against steady than the Gaussian stand-in has it."""
    problem, state, _ = _session(9, 12, first_hit=False, config=SHAPED)
    terms = linearise(problem, state)
    assert terms.windows is not None
    assert terms.windows.there.all()
    assert linearise(replace(problem, shapes=None), state).windows is None
    # At the truth the rotations are inside their windows, give or take their own noise.
    sigma = np.sqrt(terms.windows.variance[0] + terms.windows.soft**2)
    assert (terms.windows.mean[0] < terms.windows.high + 4.0 * sigma).all()
    assert (terms.windows.mean[0] > terms.windows.low - 4.0 * sigma).all()


def test_first_hits_keep_their_rows() -> None:
    problem, state, _ = _session(9, 6, first_hit=True, config=SHAPED)
    assert linearise(problem, state).windows is None


def test_the_quick_score_is_the_proper_one_where_all_is_gaussian() -> None:
    problem, state, _ = _session(10, 18)
    follower = EpochFollower(problem, state, 8)
    for count in range(9, 19):
        follower.advance(count)
    assert follower.kept.all()
    old = np.arange(18) < 8
    before = follower.posterior(old)
    assert before is not None
    terms = follower.here.terms.take(np.flatnonzero(~old))
    settings = MoveSettings(junk_probability=1e-9)
    proper = check_for_move(before, terms, settings, pose=pose_columns(0))
    quick = quick_score(add_terms(before, terms), terms, settings.scales, pose_columns(0))
    assert quick == pytest.approx(proper.score, abs=1e-3)


@pytest.mark.parametrize(
    ("turn_deg", "shift_mm"),
    [
        ((0.0, 12.0, 0.0), (0.0, 0.0, 0.0)),
        ((0.0, 0.0, 0.0), (20.0, -10.0, 0.0)),
        ((5.0, -6.0, 8.0), (10.0, 5.0, -15.0)),
    ],
)
def test_large_moves_are_found_with_the_pairs_they_begin_at(
    turn_deg: tuple[float, float, float], shift_mm: tuple[float, float, float]
) -> None:
    motion = make_transform(exp_so3(np.radians(turn_deg)), np.array(shift_mm))
    found = 0
    for seed in (21, 22, 23):
        problem, state, truth = _moved_session(seed, motion, 15, 8)
        follower = EpochFollower(problem, state, 8)
        for count in range(9, 24):
            follower.advance(count)
            test = follower.test(MoveSettings())
            if count <= 15:
                assert test is None or not test.alarm
        assert test is not None
        assert test.alarm
        since = 23 - len(test.log_bayes) + test.since
        assert abs(since - 15) <= 1
        moved = follower.state.retract(test.moved.mean[None], problem.columns).trus_T_camera()[0]
        true = truth.trus_T_camera[0] @ inverse(motion)
        camera_p = inverse(true) @ np.array([0.0, 0.0, 42.0, 1.0])
        found += bool(np.linalg.norm((moved @ camera_p)[:3] - [0.0, 0.0, 42.0]) < 4.0)
    assert found >= 2
