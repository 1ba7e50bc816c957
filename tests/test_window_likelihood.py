"""Windows as intervals: their likelihood in the reduced problem, and the Gaussian sites that stand for them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import integrate, stats

from fgreg.geometry.transforms import FloatArray, inverse, transform_points
from fgreg.graph.expectation_propagation import propagate, with_sites
from fgreg.graph.packing import PackedProblem, pack
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.reduced_graph import log_posterior
from fgreg.graph.reduced_solver import Optimum, optimize
from fgreg.graph.reduced_system import refine
from fgreg.graph.shared_state import SharedState, make_state
from fgreg.graph.window_likelihood import log_shape_ratios
from tests.forward import make_measurements, make_session

CASES: dict[str, dict[str, Any]] = {
    "first hit": {},
    "window": {"first_hit": False},
    "ladder": {"looks_per_pm": 3, "look_spacing_deg": 2.0, "share_marker": True},
    "ladder, amplitudes": {"looks_per_pm": 3, "look_spacing_deg": 2.0, "amplitude_noise": 0.05},
    "looks anywhere": {"looks_per_pm": 2, "first_hit": False},
}


def _case(name: str, pairs: int = 6, seed: int = 3) -> tuple[PackedProblem, Optimum]:
    session = make_session(curve=True)
    model, measurements, truth = make_measurements(
        np.random.default_rng(seed), pairs=pairs, session=session, **CASES[name]
    )
    problem = pack(measurements, model, shapes=True)
    start = make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser)
    return problem, optimize(problem, start)


def _log(problem: PackedProblem, state: SharedState) -> float:
    private = initial_private(problem, state)
    for _ in range(12):
        private = refine(problem, state, private)
    return float(log_posterior(problem, state, private)[0])


@pytest.mark.parametrize("name", CASES)
def test_the_density_does_not_depend_on_the_sites(name: str) -> None:
    problem, found = _case(name)
    rng = np.random.default_rng(0)
    count = len(problem.look_pm)
    centre = problem.looks.centre_rad + rng.normal(size=count) * 0.01
    other = with_sites(problem, centre, problem.looks.weight[:, 2, 2] * rng.uniform(0.5, 1.5, count))
    spread = np.linalg.cholesky(np.linalg.inv(found.evaluation.hessian[0]))
    gaps = []
    for _ in range(6):
        state = found.state.retract(0.5 * (spread @ rng.normal(size=len(spread)))[None], problem.columns)
        gaps.append(_log(other, state) - _log(problem, state))
    # The sites' own normalisers are left out of the density: a constant apart, and the bend of the arcs.
    assert np.ptp(gaps) < 0.15


def _by_hand(problem: PackedProblem, edge: float, offset: FloatArray, variance: FloatArray) -> float:
    """The ratio by numerical integration of its definition."""
    shapes = problem.shapes
    assert shapes is not None
    windows, looks, total = shapes.windows, problem.looks, 0.0
    low = windows.low_rad + windows.low_gain * edge
    high = windows.high_rad + windows.high_gain * edge
    rotation = offset + looks.centre_rad + looks.edge_gain * edge
    for pm in range(len(problem.pms)):
        mine = np.flatnonzero(problem.look_pm == pm)
        site = looks.weight[mine, 2, 2]
        q = 1.0 / variance[mine[0]] - site.sum()
        centre = float(np.sum(site * offset[mine]) / q)
        d = np.linspace(centre - 8.0 * q**-0.5, centre + 8.0 * q**-0.5, 20001)[:, None]
        cavity = stats.norm.pdf(d[:, 0], centre, q**-0.5)
        soft = windows.soft_rad[mine]
        upper, lower = (high[mine] - rotation[mine] - d) / soft, (low[mine] - rotation[mine] - d) / soft
        inside = np.prod(stats.norm.cdf(upper) - stats.norm.cdf(lower), axis=1)
        plane = looks.scan_rad[mine[0]] + rotation[mine[0]] + d[:, 0]
        inside *= np.exp(np.interp(plane, shapes.plane_rad[pm], shapes.amplitude_log[pm]))
        sites = np.exp(-0.5 * np.sum(site * (offset[mine] + d) ** 2, axis=1))
        above = integrate.trapezoid(cavity * inside, d[:, 0]) / (high[mine[0]] - low[mine[0]])
        total += float(np.log(above / integrate.trapezoid(cavity * sites, d[:, 0])))
    return total


@pytest.mark.parametrize("name", ["first hit", "window", "ladder, amplitudes"])
def test_the_ratio_is_the_integral_it_stands_for(name: str) -> None:
    problem, _ = _case(name, pairs=2)
    rng = np.random.default_rng(1)
    pms = rng.normal(size=len(problem.pms)) * 0.01
    offset = pms[problem.look_pm] + rng.normal(size=len(problem.look_pm)) * 1e-3
    precision = np.bincount(problem.look_pm, problem.looks.weight[:, 2, 2]) + 4000.0
    variance = np.asarray(1.0 / precision[problem.look_pm], dtype=np.float64)
    got = log_shape_ratios(problem, np.array([0.004]), offset[None], variance[None])[0]
    assert got.sum() == pytest.approx(_by_hand(problem, 0.004, offset, variance), abs=2e-3)


def test_far_outside_all_windows_the_density_is_tiny_and_finite() -> None:
    problem, found = _case("ladder, amplitudes")
    away = np.zeros((1, problem.columns.size))
    away[0, 1] = 0.5
    log = _log(problem, found.state.retract(away, problem.columns))
    assert np.isfinite(log)
    assert log < _log(problem, found.state) - 100.0


@pytest.mark.parametrize("name", CASES)
def test_sites_settle_near_the_truth_and_keep_the_residuals(name: str) -> None:
    problem, found = _case(name, pairs=12)
    settled = propagate(problem, found)
    assert settled is not None
    sites, there = settled
    assert (sites.looks.weight[:, 2, 2] > 0).all()
    assert there.converged.all()
    step = there.state.trus_T_camera()[0] - found.state.trus_T_camera()[0]
    assert np.abs(step[:3, 3]).max() < 10.0


def test_without_noise_the_sites_leave_the_optimum_alone() -> None:
    for first_hit in (True, False):
        model, measurements, truth = make_measurements(
            np.random.default_rng(8), pairs=9, first_hit=first_hit, noise=False
        )
        problem = pack(measurements, model, shapes=True)
        start = make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser)
        settled = propagate(problem, optimize(problem, start))
        assert settled is not None
        np.testing.assert_allclose(settled[1].state.trus_T_camera()[0], truth.trus_T_camera[0], atol=0.02)


def test_windows_as_intervals_tell_the_roll_better_than_gaussians() -> None:
    # Exact geometry, so that the window alone decides: the middle of 25 intervals against the mean of 25 offsets.
    gaussian: list[float] = []
    interval: list[float] = []
    noise = replace(make_session().noise, marker_rotation_rad=(5e-4,) * 3, marker_translation_mm=(0.02,) * 3)
    session = replace(make_session(), noise=noise)
    for seed in range(14):
        model, measurements, truth = make_measurements(
            np.random.default_rng(50 + seed), pairs=25, first_hit=False, session=session
        )
        problem = pack(measurements, model, shapes=True)
        start = make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser)
        found = optimize(problem, start)
        settled = propagate(problem, found)
        assert settled is not None
        for optimum, out in ((found, gaussian), (settled[1], interval)):
            camera_p = transform_points(inverse(truth.trus_T_camera[0]), model.targets_mm)
            moved = transform_points(optimum.state.trus_T_camera()[0], camera_p)
            turn = np.arctan2(moved[:, 1], moved[:, 2]) - np.arctan2(model.targets_mm[:, 1], model.targets_mm[:, 2])
            out.append(float(np.mean(turn)))
    assert np.sqrt(np.mean(np.square(interval))) < 0.8 * np.sqrt(np.mean(np.square(gaussian)))
