"""The certificate: its cost is the graph's, no registration is below its bounds, and only the best one is certified."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from typer.testing import CliRunner

from fgreg.certificate.bound import Intervals, first_intervals, lower_bounds, sharper_bounds
from fgreg.certificate.certify import Certificate, certify, cost_at
from fgreg.certificate.conditional import Conditional, Looks, conditional
from fgreg.certificate.linearised import linearised, middle, remainder
from fgreg.certificate.rotations import Cells, Reach
from fgreg.certificate.search import narrowed
from fgreg.cli.main import app
from fgreg.geometry.transforms import FloatArray, IntArray, exp_so3, log_so3
from fgreg.graph.contributions import contributions
from fgreg.graph.reduced_solver import optimize
from fgreg.graph.reduced_system import private_at, refine
from fgreg.model.estimate import Verdict
from fgreg.model.session_model import NoiseModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.systematic import Systematic
from fgreg.registration.multistart import targets_moved
from fgreg.registration.proof import prove, without_pairs
from fgreg.registration.register import Registration, register
from fgreg.registration.solve import solve
from fgreg.session.result_file import read_result
from tests.forward import make_measurements, make_session

BUDGET = 300_000


@cache
def _registered(seed: int, **arguments: Any) -> Registration:
    noise = arguments.pop("noise_model", None)
    tilt = arguments.pop("tilt_rad", 0.0035)
    session = make_session(noise_model=noise, systematic=Systematic(array_tilt_rad=(tilt,) * 3))
    model, measurements, _ = make_measurements(np.random.default_rng(seed), session=session, **arguments)
    return register(measurements, model, SolveConfig())


def _conditional(of: Registration) -> Conditional:
    return conditional(of.problem, of.optimum.state, of.optimum.evaluation.private)


def _certify(of: Registration, budget: int = BUDGET) -> Certificate:
    optimum = of.optimum
    apart = without_pairs(of, 0)
    found = certify(of.problem, optimum.state, optimum.evaluation.private, 0, apart, within_chi2=9.2, budget=budget)
    assert found is not None
    return found


def _rotation_offset(q: FloatArray, look: Looks, radius_mm: float) -> FloatArray:
    """Stage rotation that brings a point of the array's frame into the plane, at the range that was heard."""
    distance = np.hypot(q[1], q[2])
    return np.asarray(np.arctan2(look.heard_mm * q[1] / distance, radius_mm + look.heard_mm * q[2] / distance))


def _residuals(of: Conditional, rotation: FloatArray, shift: FloatArray, polar: FloatArray) -> FloatArray:
    """All residuals of a registration and PMs, in standard deviations."""

    def look_residuals(look: Looks, q: FloatArray) -> FloatArray:
        miss = [q[0] - look.x_mm, np.hypot(q[1], q[2]) - look.heard_mm]
        miss.append(_rotation_offset(q, look, of.radius_mm) - look.rotation_rad)
        root = np.linalg.cholesky(look.weight.transpose(2, 0, 1))
        return np.asarray(np.einsum("nji,jn->in", root, np.stack(miss)).ravel())

    q = np.stack([polar[0], polar[1] * np.sin(polar[2]), polar[1] * np.cos(polar[2])])
    camera_p = rotation.T @ (np.einsum("ijn,jn->in", of.from_array, q) + of.origin) - shift[:, None]
    there = np.einsum("ijn,jn->in", of.others.from_first, q[:, of.others.pm]) + of.others.origin
    beams = (np.einsum("min,in->mn", of.rows, camera_p) + of.offset).ravel()
    return np.concatenate([beams, look_residuals(of.first, q), look_residuals(of.others, there)])


def _best_fit(of: Conditional, rotation: FloatArray, shift: FloatArray | None) -> tuple[FloatArray, FloatArray, float]:
    """Shift, PMs and chi square of a rotation, from a local search by a generic solver; the shift given or not."""
    free = 3 if shift is None else 0

    def unpacked(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        return (x[:3] if shift is None else shift), x[free:].reshape(of.polar.shape)

    scale = np.concatenate([np.ones(free), np.ones(of.polar[:2].size), np.full(of.polar[2].size, 0.05)])
    start = np.concatenate([of.shift[:free], of.polar.ravel()])

    def residuals(x: FloatArray) -> FloatArray:
        return _residuals(of, rotation, *unpacked(x))

    found = least_squares(residuals, start, x_scale=scale)
    return *unpacked(found.x), float(2.0 * found.cost) + of.constant


SHARP = NoiseModel((0.001, 0.001, 0.002), (5e-5, 5e-5, 5e-5), 0.0, (0.3, 0.3, 0.1), 0.24, 0.16)
"""Of detected frames: lines sharper than looks."""
CASES: dict[str, dict[str, Any]] = {
    "first hit": {"pairs": 8},
    "window only, tilted array": {"pairs": 8, "first_hit": False, "tilt_rad": 0.03},
    "sharp lines": {"pairs": 8, "first_hit": False, "noise_model": SHARP},
    "three looks, one shot": {"pairs": 6, "looks_per_pm": 3, "share_marker": True, "tilt_rad": 0.03},
    "two looks, own shots": {"pairs": 6, "looks_per_pm": 2},
}
MORE = CASES | {"many sharp lines": {"pairs": 20, "first_hit": False, "noise_model": SHARP}}


@pytest.mark.parametrize("case", CASES)
def test_the_cost_is_that_of_the_reduced_graph(case: str) -> None:
    # A marker that is known to turn by nothing: the graph's weights do not depend on where along a beam the PM is.
    exact = NoiseModel(marker_rotation_rad=(1e-7, 1e-7, 1e-7))
    found = _registered(3, **(CASES[case] | {"noise_model": exact}))
    of, rng, state = _conditional(found), np.random.default_rng(0), found.optimum.state
    for size in (0.0, 0.01, 0.05):
        turned = state.rotation[0, 0] @ exp_so3(size * rng.normal(size=3))
        moved = state.translation_mm[0, 0] + 30.0 * size * rng.normal(size=3)
        there = replace(state, rotation=turned[None, None], translation_mm=moved[None, None])
        private = private_at(found.problem, there)
        for _ in range(20):
            private = refine(found.problem, there, private)
        expected = float(contributions(found.problem, there, private).pm.cost.sum())
        _, _, cost = _best_fit(of, turned, turned.T @ (moved - of.pivot))
        assert cost == pytest.approx(expected, rel=1e-3, abs=1e-6)


def _cells(count: int, rng: np.random.Generator) -> Reach:
    """Balls and boxes, some thin, as cells have them."""
    about = 10.0 ** rng.uniform(-3.0, 0.0, count) * 10.0 ** (
        rng.uniform(-1.5, 0.0, (3, count)) * rng.integers(0, 2, count)
    )
    corner = np.linalg.norm(about, axis=0)
    return Reach(about, np.where(rng.random(count) < 0.5, corner, np.maximum(0.6 * corner, about.max(axis=0))))


@pytest.mark.parametrize(("case", "seed"), [*((case, 5) for case in MORE), ("sharp lines", 37)])
def test_no_bound_of_a_cell_is_above_the_cost_of_a_registration_in_it(case: str, seed: int) -> None:
    of, rng, cells = _conditional(_registered(seed, **MORE[case])), np.random.default_rng(1), 150
    for away in (0.0, 0.02, 0.1, 1.0):
        rotation = of.rotation @ exp_so3(away * rng.normal(size=3))
        shift, polar, cost = _best_fit(of, rotation, None)
        within = _cells(cells, rng)
        turn = (
            within.about.T
            * rng.choice([-1.0, 1.0], (cells, 3))
            * rng.uniform(size=(cells, 3)) ** rng.choice([0.1, 1.0], (cells, 1))
        )
        turn *= np.minimum(within.angle / np.linalg.norm(turn, axis=1), 1.0)[:, None]
        centres = np.stack([exp_so3(-step) @ rotation for step in turn], axis=-1)
        for threshold in (cost + 1e-6, cost + 9.2):
            first = first_intervals(of, threshold)
            assert first is not None
            intervals = Intervals(*(np.repeat(values, cells, axis=-1) for values in (first.centre, first.half)))
            once = lower_bounds(of, centres, within, intervals, threshold)
            plain = narrowed(of, centres, within, intervals, threshold)
            sharper = [sharper_bounds(of, centres, within, bounds, threshold) for bounds in (once, plain)]
            for found in (once, plain, *sharper):
                assert found.possible.all()
                assert (found.cost <= cost * (1.0 + 1e-6) + 1e-6).all()
                outside = np.maximum(found.intervals.low - polar[..., None], polar[..., None] - found.intervals.high)
                assert outside.max() <= 1e-6
                off = np.concatenate([turn.T - found.turn, np.einsum("ijb,j->ib", centres, shift) - found.shift]).T
                ellipsoid = found.moved.transpose(2, 0, 1) + 1e-12 * np.eye(6)
                assert (np.einsum("bi,bi->b", off, np.linalg.solve(ellipsoid, off[..., None])[..., 0]) < 1.001).all()


def _point(of: Conditional, polar: FloatArray) -> FloatArray:
    """(3, J, B) TRUS points less the pivot, of polar coordinates (3, J, B)."""
    q = np.stack([polar[0], polar[1] * np.sin(polar[2]), polar[1] * np.cos(polar[2])])
    return np.asarray(np.einsum("ijn,jnb->inb", of.from_array, q) + of.origin[..., None])


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("part", [0.25, 0.5])
def test_what_the_linearisation_leaves_is_within_its_bounds(case: str, part: float) -> None:
    of, rng, cells = _conditional(_registered(5, **CASES[case])), np.random.default_rng(4), 400
    z = np.repeat(of.polar[..., None], cells, axis=-1)
    half = (
        np.abs(rng.normal(size=z.shape)) * np.array([0.5, 0.5, 0.2])[:, None, None] * 10.0 ** rng.uniform(-2, 0, cells)
    )
    centres = np.stack([of.rotation @ exp_so3(rng.normal(size=3)) for _ in range(cells)], axis=-1)
    for corner in (0.05, 1.0):  # near the corners of cells and intervals, and anywhere
        reach = _cells(cells, rng)
        turn = reach.about * rng.choice([-1.0, 1.0], (3, cells)) * rng.uniform(size=(3, cells)) ** corner
        turn *= np.minimum(reach.angle / np.linalg.norm(turn, axis=0), 1.0)
        off = half * rng.choice([-1.0, 1.0], (3, 1, cells)) * rng.uniform(size=z.shape) ** corner
        at = linearised(of, centres, z, half)
        first = linearised(
            replace(of, others=of.others.take(np.zeros(0, dtype=np.int64))), centres, z + off, half
        ).looks
        within = float(np.sqrt(first.chi2.sum(axis=0).max()))
        rest = remainder(of, at, z, half, reach, within, part)
        true = np.einsum("bij,jnb->inb", exp_so3(-turn.T), _point(of, z + off))
        linear = at.y + np.einsum("iknb,knb->inb", at.by_z, off) + np.cross(at.y, turn[:, None], axis=0)
        if part < 0.5:
            linear += middle(at, rest, reach)
        miss = np.einsum("minb,inb->mnb", at.rows, true - linear)
        gives = np.einsum("iknb,mknb,mnb->inb", at.spread, at.line[:, :3], miss)
        assert (np.abs(gives) <= rest.offset * (1.0 + 1e-9) + 1e-12).all()
        miss -= np.einsum("mknb,knb->mnb", at.line[:, :3], gives)
        chi2 = np.square(miss).sum(axis=0) + np.einsum("inb,iknb,knb->nb", gives, at.looks.hessian, gives)
        each = np.sqrt(chi2) + np.sqrt(at.looks.error2)
        assert (each <= rest.own * (1.0 + 1e-9) + 1e-9).all()
        left = np.sqrt(np.square(each).sum(axis=0))
        assert (left <= rest.error * (1.0 + 1e-9) + 1e-9).all()
        assert (left > 0.3 * rest.error).any()


def test_parallel_beams_bound_neither_the_cost_nor_the_shift() -> None:
    of = _conditional(_registered(5, pairs=8))
    along = np.array([0.6, 0.0, 0.8])
    rows = of.rows - np.einsum("min,i,k->mkn", of.rows, along, along)
    of, ball = replace(of, rows=rows), Reach.ball(np.array([0.01]))
    for threshold in (0.5, 1e4):
        first = first_intervals(of, threshold)
        assert first is not None
        assert first.low[1].min() > -1e-9  # no range is negative, whatever its noise
        plain = lower_bounds(of, of.rotation[..., None], ball, first, threshold)
        for found in (plain, sharper_bounds(of, of.rotation[..., None], ball, plain, threshold)):
            assert found.possible.all()
            assert found.cost[0] <= of.constant
            assert np.sqrt(found.moved[3, 3, 0]) > 1e6
        unknown = replace(of, offset=np.full_like(of.offset, np.nan))
        found = lower_bounds(unknown, of.rotation[..., None], ball, first, threshold)
        assert found.possible.all()
        assert found.cost[0] == 0.0
    assert not replace(_certify(_registered(11, pairs=10)), within_mm=1e6).is_alone


def test_bounds_of_small_cells_come_near_the_cost() -> None:
    of = _conditional(_registered(5, pairs=8))
    cost, reach = cost_at(of), Reach.ball(np.radians([1.0, 0.5]))
    first = first_intervals(of, cost)
    assert first is not None
    intervals = Intervals(*(np.repeat(values, 2, axis=-1) for values in (first.centre, first.half)))
    centres = np.repeat(of.rotation[..., None], 2, axis=-1)
    plain = narrowed(of, centres, reach, intervals, cost)
    sharper = sharper_bounds(of, centres, reach, plain, cost)
    assert (lower_bounds(of, centres, reach, intervals, cost).cost <= plain.cost).all()
    loss = cost - sharper.cost
    assert loss[1] < 0.2 * loss[0]  # of third order or better: an eighth of it or less
    assert loss[1] < 1e-3 * cost


def test_pm_by_pm_many_windows_exclude_more_cells() -> None:
    of, rng = _conditional(_registered(5, **MORE["many sharp lines"])), np.random.default_rng(2)
    cost, away = cost_at(of), rng.normal(size=(100, 3))
    away *= rng.uniform(0.02, 0.1, (100, 1)) / np.linalg.norm(away, axis=1, keepdims=True)
    centres = np.stack([of.rotation @ exp_so3(turn) for turn in away], axis=-1)
    first, reach = first_intervals(of, cost), Reach.ball(np.full(100, np.radians(1.0)))
    assert first is not None
    intervals = Intervals(*(np.repeat(values, 100, axis=-1) for values in (first.centre, first.half)))
    once = lower_bounds(of, centres, reach, intervals, cost)
    together, one_by_one = (
        lower_bounds(of, centres, reach, once.intervals, cost, pm_by_pm=way) for way in (False, True)
    )
    both = one_by_one.possible
    assert (one_by_one.cost[both] >= together.cost[both]).all()
    assert one_by_one.cost[both].mean() > 2.0 * together.cost[both].mean()
    thorough = narrowed(of, centres, reach, intervals, cost)
    assert once.possible[thorough.possible].all()
    assert thorough.possible.sum() < 0.7 * once.possible.sum()


def _holding(cells: Cells, rotation: FloatArray) -> IntArray:
    """Cells that may hold a rotation: it is as near to their centres as they say that they reach."""
    turn = log_so3(rotation @ cells.rotation.swapaxes(1, 2))
    near = (np.abs(turn) <= cells.about_rad).all(axis=1) & (np.linalg.norm(turn, axis=1) <= cells.reach_rad)
    return np.flatnonzero(near)


def test_cells_cover_all_rotations_and_so_do_their_halves() -> None:
    cells, rng = Cells.cover(3), np.random.default_rng(2)
    for _ in range(50):
        rotation = exp_so3(rng.normal(size=3) * 2.0)
        inside = cells.take(_holding(cells, rotation))
        for _ in range(3):
            assert len(inside)
            parts, index = inside.halved(rng.random((len(inside), 3)) < 0.5)
            assert (parts.half <= inside.half[index]).all()
            inside = parts.take(_holding(parts, rotation))
        assert len(inside)
    every, _ = cells.halved(np.ones((len(cells), 3), dtype=bool))
    assert len(every) == 8 * len(cells)
    assert every.reach_rad.max() < 0.75 * cells.reach_rad.max()


def test_the_best_registration_is_certified_and_nothing_is_below_the_bound() -> None:
    found = _registered(11, pairs=10)
    certificate, of, rng = _certify(found), _conditional(found), np.random.default_rng(3)
    assert certificate.is_least
    assert certificate.is_alone
    assert certificate.gap <= 1.0001e-3
    for _ in range(12):
        rotation = of.rotation @ exp_so3(rng.normal(size=3) * 10.0 ** rng.uniform(-3.0, 0.3))
        _, _, cost = _best_fit(of, rotation, None)
        assert cost >= certificate.least
        angle = 2.0 * math.asin(min(float(np.linalg.norm(rotation - of.rotation)) / math.sqrt(8.0), 1.0))
        assert cost > certificate.cost + 9.2 or angle <= certificate.within_rad


def test_windows_alone_prove_the_best_registration_of_sharp_lines() -> None:
    found = _registered(14, pairs=10, first_hit=False, noise_model=SHARP)
    certificate = _certify(found)
    assert certificate.is_least
    assert certificate.holds_without_pairs


def _at_another_minimum(found: Registration, which: int = 1) -> Registration:
    """The registration with one of its minima in place of the best."""
    second = found.searches[0].minima[which].state
    state = found.optimum.state
    moved = replace(state, rotation=second.rotation, translation_mm=second.translation_mm)
    return replace(found, optimum=optimize(found.problem, moved))


def test_a_worse_minimum_is_not_certified_and_the_better_one_is_handed_back() -> None:
    best = _registered(1018, pairs=6)
    worse = _at_another_minimum(best)
    here, there = (of.optimum.state.trus_T_camera()[0] for of in (worse, best))
    assert worse.optimum.evaluation.cost[0] > best.optimum.evaluation.cost[0] + 9.2
    proof = prove(worse, 0, SolveConfig(certificate_budget=20_000))
    assert proof is not None
    assert not proof.estimate.proved
    assert [condition.verdict for condition in proof.conditions] == [Verdict.REFUSED]
    assert "a better registration" in proof.conditions[0].text
    assert proof.estimate.other_trus_T_camera is not None
    assert targets_moved(there, proof.estimate.other_trus_T_camera, best.model.targets_mm) < 0.1
    assert targets_moved(there, here, best.model.targets_mm) > 1.5


@pytest.mark.parametrize(("seed", "which"), [(1009, 3), (1034, 2), (1019, 2)])
def test_without_the_pairs_pull_the_cost_hardly_depends_on_the_minimum(seed: int, which: int) -> None:
    best = _registered(seed, pairs=4)
    worse, rotation = _at_another_minimum(best, which), best.optimum.state.rotation[0, 0]
    costs = []
    for found in (best, worse):
        apart = without_pairs(found, 0)
        assert apart is not None
        of = conditional(found.problem, apart.state, apart.private, 0, apart.distance_mm)
        costs.append((cost_at(of), _best_fit(of, rotation, None)[2]))
    (_, of_best), (of_worse, seen_from_worse) = costs
    assert seen_from_worse == pytest.approx(of_best, rel=0.25, abs=0.5)
    assert of_worse > seen_from_worse + 9.2


def test_two_minima_are_recognised_by_the_bound() -> None:
    found = _registered(1002, pairs=4)
    assert found.ambiguous
    certificate = _certify(found)
    assert certificate.finished
    assert not certificate.is_alone
    # The search that knows of neither comes upon the other one.
    proof = prove(replace(found, ambiguous=(), searches=(replace(found.searches[0], minima=()),)), 0, _PROVING)
    assert proof is not None
    assert [condition.verdict for condition in proof.conditions] == [Verdict.REFUSED]
    assert "another registration" in proof.conditions[0].text


_PROVING = SolveConfig(certificate_budget=BUDGET)


def test_a_proof_that_stops_early_leaves_the_verdict() -> None:
    found = _registered(12, pairs=10)
    for budget, expected in ((2000, "not certified: "), (0, None)):
        proof = prove(found, 0, SolveConfig(certificate_budget=budget))
        assert (proof is None) == (expected is None)
        if proof is not None:
            assert proof.conditions[0].text.startswith("not certified: the search for a better one stopped with a gap")
            assert proof.conditions[0].verdict is Verdict.OK
            assert proof.estimate.reason == proof.conditions[0].text


def test_epochs_with_a_measured_motion_are_not_certified() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(1), pairs=12, epochs=2, known_motion=True)
    plain = solve(measurements, [], model, SolveConfig())
    proving = solve(measurements, [], model, _PROVING)
    assert proving.verdict is plain.verdict
    assert [epoch.certificate is None for epoch in plain.epochs] == [True, True]
    assert all(epoch.certificate is not None and not epoch.certificate.proved for epoch in proving.epochs)
    assert sum("not certified: it also rests on a measured" in reason for reason in proving.reasons) == 2


def test_the_command_says_what_is_proved(pose_session: Path) -> None:
    done = CliRunner().invoke(app, ["solve", str(pose_session), "--certify"])
    assert done.exit_code == 0
    assert "no other registration explains these pairs" in " ".join(done.output.split())
    certificate = read_result(pose_session / "result.yaml").epochs[0].certificate
    assert certificate is not None
    assert certificate.proved
    assert certificate.within_rad is not None
    assert certificate.within_rad < math.radians(15.0)


@pytest.mark.parametrize("more", [{"spot_sigma_mm": (0.3, 0.3, 1.0)}, {"points": 3}])
def test_what_the_bounds_do_not_cover_is_not_certified(more: dict[str, Any]) -> None:
    proof = prove(_registered(1, pairs=6, **more), 0, _PROVING)
    assert proof is not None
    assert not proof.estimate.proved
    assert "do not cover visible spots" in proof.conditions[0].text
