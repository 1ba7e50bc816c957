"""Common constants of several sessions: the optimum of one graph, its error bar, and control charts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgreg.geometry.rig import CAMERA, Constant
from fgreg.geometry.transforms import FloatArray
from fgreg.graph.packing import ConstantsPrior
from fgreg.graph.reduced_solver import optimize
from fgreg.model.session_model import NoiseModel
from fgreg.registration.commissioning import (
    OWN,
    ChartVerdict,
    Evidence,
    commission,
    common_constants,
    control_chart,
    noise_slope,
    session_evidence,
)
from fgreg.registration.register import Registration
from tests import rigs


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("rigs")


def places(registration: Registration, constants: tuple[Constant, ...]) -> list[int]:
    return [registration.problem.columns.constants.index(constant) for constant in constants]


def test_one_session_alone_is_its_registration(root: Path) -> None:
    ((registration, _),) = rigs.registrations(root, (1,))
    found = commission([registration])
    columns = [registration.problem.columns.first_constant + k for k in places(registration, found.constants)]
    sigma = np.sqrt(np.diag(registration.covariance))[columns]
    value = registration.optimum.state.constants[0, list(found.constants)]
    # ... but for how noise scales with the constants.
    value = value + registration.covariance[columns, registration.problem.columns.rig] @ noise_slope(registration)
    assert found.value == pytest.approx(value, abs=1e-3 * float(sigma.min()))
    assert found.sigma == pytest.approx(sigma, rel=1e-4)


def test_the_optimum_is_that_of_one_graph(root: Path) -> None:
    """Each session, solved with all others and the prior as a Gaussian of the common constants, stays where it is."""
    sessions = [registration for registration, _ in rigs.registrations(root)]
    found = commission(sessions)
    for place, registration in enumerate(sessions):
        mean, covariance = found.without(place)
        at, prior = places(registration, found.constants), registration.problem.prior
        information, means = prior.information.copy(), prior.mean.copy()
        information[np.ix_(at, at)] = np.linalg.inv(covariance)
        means[at] = mean
        means = means + np.linalg.solve(information, noise_slope(registration))
        problem = replace(registration.problem, prior=ConstantsPrior(means, information))
        optimum = optimize(problem, registration.optimum.state, tolerance=1e-9)
        again = optimum.state.constants[0, list(found.constants)]
        assert np.abs((again - found.value) / found.sigma).max() < 5e-3


def test_noise_slopes_are_those_of_the_fitted_residuals(root: Path) -> None:
    """Half the chi square with the noise of x, range and spots multiplied by (1 + c), by differences."""
    ((registration, _),) = rigs.registrations(root, (1,))
    problem, at = registration.problem, registration.optimum.evaluation
    residual = at.look_residual[0, :, :2]
    by_constants = problem.aim_spot_by_constants @ registration.optimum.state.constants[0, CAMERA]
    shift = at.private.aim_shift[0] - by_constants
    slope = dict(zip(problem.columns.constants, noise_slope(registration), strict=True))
    for constant, column in ((Constant.PITCH, 0), (Constant.SOUND_SPEED, 1)):
        scale = np.ones(2)
        scale[column] = 1.0 + 1e-6
        weight = problem.looks.weight[:, :2, :2]
        chi_square = [np.einsum("ni,nij,nj->", r, weight, r) for r in (residual, residual / scale)]
        assert slope[constant] == pytest.approx(0.5 * (chi_square[0] - chi_square[1]) / 1e-6, rel=1e-4)
        assert 0.0 < slope[constant] < len(residual)
    # Without a camera section a spot moves by itself times the scale: its error is multiplied as a range's is.
    spots = np.einsum("ni,nij,nj->", shift, np.linalg.inv(problem.aim_spot_covariance), shift)
    assert slope[Constant.CAMERA_SCALE] == pytest.approx(spots, rel=1e-3)


def test_the_sessions_agree_with_the_truth_and_sharpen_it(root: Path) -> None:
    one = commission([rigs.registrations(root)[0][0]])
    found = commission([registration for registration, _ in rigs.registrations(root)])
    error = found.value - rigs.truth(found.constants)
    assert error @ np.linalg.solve(found.covariance, error) < 2.0 * len(error)
    assert (found.sigma <= one.sigma * (1.0 + 1e-6)).all()
    tag = found.constants.index(Constant.TAG_SIZE)
    assert found.sigma[tag] < 0.75 * one.sigma[tag]
    assert found.observed[tag] > 0.5
    assert found.observed[found.constants.index(Constant.RADIUS)] < 0.5


def test_the_markers_bias_stays_each_sessions_own(tmp_path: Path) -> None:
    noise: NoiseModel = replace(rigs.RIG.noise, marker_bias_mm=0.2)
    folder = rigs.write(tmp_path / "s", 4, replace(rigs.RIG, noise=noise))
    registration, _ = rigs.solved(folder)
    assert set(OWN) <= set(registration.problem.columns.constants)
    assert not set(OWN) & set(common_constants(registration.model))
    assert not set(OWN) & set(commission([registration, registration]).constants)


def test_check_points_are_data(root: Path) -> None:
    """Points that both devices know measure what differs between their maps: with some, no constant is less certain."""
    ((registration, checks),) = rigs.registrations(root, (5,), checks=6)
    assert len(checks) == 6
    without, found = commission([registration]), commission([registration], [checks])
    assert (found.sigma <= without.sigma * (1.0 + 1e-6)).all()
    assert (found.sigma < 0.99 * without.sigma).any()
    error = found.value - rigs.truth(found.constants)
    assert error @ np.linalg.solve(found.covariance, error) < 2.0 * len(error)


def test_a_session_of_the_rig_passes_and_one_with_another_print_alarms(root: Path, tmp_path: Path) -> None:
    found = commission([registration for registration, _ in rigs.registrations(root)])
    off = {**rigs.OFF, Constant.TAG_SIZE: rigs.OFF[Constant.TAG_SIZE] - 0.015}
    for seed, deviations, expected in ((7, rigs.OFF, ChartVerdict.PASS), (8, off, ChartVerdict.ALARM)):
        folder = rigs.write(tmp_path / str(seed), seed, replace(rigs.RIG, deviations=deviations))
        evidence = session_evidence(rigs.solved(folder)[0], found.constants)
        chart = control_chart(evidence, found.value, found.covariance, found.prior_sigma)
        assert chart.verdict is expected
    tag = found.constants.index(Constant.TAG_SIZE)
    assert chart.z[tag] < -3.0
    assert abs(chart.change[tag] + 0.015) < 3.0 * chart.change_sigma[tag]


def drawn_evidence(
    rng: np.random.Generator, mean: FloatArray, covariance: FloatArray, by: FloatArray, off: FloatArray
) -> Evidence:
    """Of a session that measures ``by @ c`` (m, K) with unit noise, c drawn from a rig and changed by ``off``."""
    c = rng.multivariate_normal(mean, covariance) + off
    return Evidence(by.T @ by, by.T @ (by @ c + rng.standard_normal(len(by))))


def test_notes_and_alarms_are_as_rare_as_stated() -> None:
    rng = np.random.default_rng(3)
    root = rng.standard_normal((6, 6))
    mean, covariance, scale = rng.standard_normal(6), 0.1 * root @ root.T, np.full(6, 1.0)
    by = np.vstack([rng.standard_normal((3, 6)), 0.02 * rng.standard_normal((2, 6))])  # two that are next to nothing
    verdicts, squares = [], []
    for _ in range(4000):
        chart = control_chart(drawn_evidence(rng, mean, covariance, by, np.zeros(6)), mean, covariance, scale)
        verdicts.append(chart.verdict)
        squares.append(np.mean(chart.z**2))
        assert chart.degrees_of_freedom == 3
    assert np.mean(squares) == pytest.approx(1.0, abs=0.05)
    assert np.mean([verdict is not ChartVerdict.PASS for verdict in verdicts]) < 0.024
    assert np.mean([verdict is ChartVerdict.ALARM for verdict in verdicts]) < 0.004


def test_a_change_is_measured() -> None:
    rng = np.random.default_rng(4)
    covariance, by = 0.04 * np.eye(4), np.diag([3.0, 3.0, 3.0, 0.0])
    off = np.array([0.0, 2.0, 0.0, 5.0])  # nothing tells of the last one
    charts = [
        control_chart(drawn_evidence(rng, np.zeros(4), covariance, by, off), np.zeros(4), covariance, np.ones(4))
        for _ in range(300)
    ]
    assert np.mean([chart.change[1] for chart in charts]) == pytest.approx(2.0, abs=0.08)
    assert charts[0].change_sigma[1] == pytest.approx(np.sqrt(1.0 / 9.0 + 0.04))
    assert np.isinf(charts[0].change_sigma[3])
    assert {chart.z[3] for chart in charts} == {0.0}
    assert np.mean([chart.verdict is ChartVerdict.ALARM for chart in charts]) > 0.9
