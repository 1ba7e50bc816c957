"""Geometry that breaks registration is refused or warned of, with the figure and what to do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgreg.geometry.transforms import as_float_array, inverse, make_transform, rotation_to_direction, transform_points
from fgreg.model.estimate import Verdict
from fgreg.model.measurements import Measurements
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.solve import Solution, solve
from tests.forward import Truth, make_measurements


def _solve(seed: int = 0, config: SolveConfig | None = None, **scene: object) -> tuple[Solution, SessionModel, Truth]:
    model, measurements, truth = make_measurements(np.random.default_rng(seed), **scene)  # type: ignore[arg-type]
    return solve(measurements, [], model, config or SolveConfig()), model, truth


def test_a_good_session_is_ok() -> None:
    solution, _, _ = _solve(pairs=30)
    assert solution.reasons == ()
    assert solution.verdict is Verdict.OK
    assert solution.epochs[0].verdict is Verdict.OK


@pytest.mark.parametrize("pairs", [3, 4, 5])
def test_fewer_than_six_pairs_are_refused(pairs: int) -> None:
    solution, _, _ = _solve(pairs=pairs)
    assert solution.verdict is Verdict.REFUSED
    assert any("pairs leave the registration open" in reason for reason in solution.reasons)


def test_two_pairs_have_no_registration_at_all() -> None:
    solution, _, _ = _solve(pairs=2)
    assert solution.verdict is Verdict.REFUSED
    assert solution.epochs[0].trus_T_camera is None
    assert not any(pair.used for pair in solution.pairs)


def test_an_initial_registration_settles_few_pairs() -> None:
    model, measurements, truth = make_measurements(np.random.default_rng(0), pairs=5)
    known = replace(model, initial_trus_T_camera=as_float_array(truth.trus_T_camera[0], 4, 4))
    reasons = solve(measurements, [], known, SolveConfig(limit_mm=30.0)).reasons
    assert not any("leave the registration open" in reason or "two registrations" in reason for reason in reasons)


def test_two_minima_that_cannot_be_distinguished_are_refused_and_initial_resolves_them() -> None:
    for seed in range(40):
        model, measurements, truth = make_measurements(np.random.default_rng(seed), pairs=4, first_hit=False)
        solution = solve(measurements, [], model, SolveConfig())
        if any("two registrations explain" in reason for reason in solution.reasons):
            break
    else:
        pytest.fail("no ambiguous scene in 40 seeds")
    assert solution.verdict is Verdict.REFUSED
    assert any("apart, 9.2 needed" in reason for reason in solution.reasons)
    known = replace(model, initial_trus_T_camera=as_float_array(truth.trus_T_camera[0], 4, 4))
    resolved = solve(measurements, [], known, SolveConfig())
    assert not any("two registrations explain" in reason for reason in resolved.reasons)


def _parallel(seed: int, tilt_rad: float) -> tuple[SessionModel, Measurements]:
    """All beams turned about their spots to within ``tilt_rad`` of one direction."""
    model, measurements, truth = make_measurements(np.random.default_rng(seed), pairs=15)
    rng = np.random.default_rng(seed)
    camera_T_trus = inverse(truth.trus_T_camera[0])
    pairs = []
    for pair, camera_T_marker in zip(measurements.pairs, truth.pair_camera_T_marker, strict=True):
        spot = transform_points(camera_T_trus, truth.trus_p_pm_mm[pair.pm])
        direction = camera_T_marker[:3, :3] @ truth.marker_T_laser[:3, 2]
        wanted = np.array([*(tilt_rad * rng.normal(size=2)), 1.0])
        to_wanted = rotation_to_direction(wanted / np.linalg.norm(wanted)) @ rotation_to_direction(direction).T
        turn = make_transform(to_wanted, spot - to_wanted @ spot)
        observed = as_float_array(turn @ pair.marker.camera_T_marker, 4, 4)
        pairs.append(replace(pair, marker=replace(pair.marker, camera_T_marker=observed)))
    return model, replace(measurements, pairs=tuple(pairs))


@pytest.mark.parametrize(("tilt_deg", "verdict"), [(0.2, Verdict.REFUSED), (2.3, Verdict.WARNING)])
def test_parallel_beams_are_refused_and_nearly_parallel_ones_reported(tilt_deg: float, verdict: Verdict) -> None:
    model, measurements = _parallel(0, np.radians(tilt_deg))
    solution = solve(measurements, [], model, SolveConfig(limit_mm=1000.0))
    assert any("parallel" in reason and "fibre tilted" in reason for reason in solution.reasons)
    assert solution.verdict is verdict


def _collinear(seed: int) -> tuple[SessionModel, Measurements, Truth]:
    """Pairs whose PMs lie within half a millimetre of one line, picked from a dense session."""
    model, measurements, truth = make_measurements(np.random.default_rng(seed), pairs=1500)
    points = truth.trus_p_pm_mm
    anchor, direction = np.array([0.0, 0.0, 40.0]), np.array([0.9, 0.3, 0.3])
    direction = direction / np.linalg.norm(direction)
    near = [pair for pair in measurements.pairs if np.linalg.norm(np.cross(points[pair.pm] - anchor, direction)) < 1.2]
    return model, replace(measurements, pairs=tuple(near[:12])), truth


def test_collinear_spots_are_refused() -> None:
    model, measurements, _ = _collinear(3)
    assert len(measurements.pairs) >= 7
    solution = solve(measurements, [], model, SolveConfig(limit_mm=1000.0))
    assert solution.verdict is Verdict.REFUSED
    assert any("on one line" in reason or "two registrations" in reason for reason in solution.reasons)


def test_sweeps_from_one_side_are_at_most_a_warning() -> None:
    solution, _, _ = _solve(pairs=30, one_way=True)
    assert solution.verdict is Verdict.WARNING
    assert any("look at the next PMs from both sides (at least 3)" in reason for reason in solution.reasons)


@pytest.mark.parametrize("how", ["stage", "elements"])
def test_a_mirrored_session_is_refused_and_named(how: str) -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(1), pairs=15)
    pairs = []
    for pair in measurements.pairs:
        if how == "stage":
            look = replace(pair.look, scan_rad=-pair.look.scan_rad, sweep=-pair.look.sweep)
        else:
            look = replace(pair.look, x_mm=-pair.look.x_mm)
        pairs.append(replace(pair, look=look))
    solution = solve(replace(measurements, pairs=tuple(pairs)), [], model, SolveConfig())
    assert solution.verdict is Verdict.REFUSED
    assert any("mirrored hypothesis fits better" in reason for reason in solution.reasons)


def test_residuals_beyond_the_stated_noise_are_reported() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(1), pairs=15)
    pairs = [
        replace(pair, look=replace(pair.look, covariance=as_float_array(pair.look.covariance / 400.0, 2, 2)))
        for pair in measurements.pairs
    ]
    aims = [replace(aim, covariance=as_float_array(aim.covariance / 400.0, 3, 3)) for aim in measurements.aims]
    strict = replace(measurements, pairs=tuple(pairs), aims=tuple(aims))
    solution = solve(strict, [], model, SolveConfig())
    assert solution.verdict is not Verdict.OK
    assert any("larger than the stated noise explains" in reason for reason in solution.reasons)


def test_a_predicted_error_beyond_the_limit_lowers_the_verdict() -> None:
    # In session 0 a move of some millimetres cannot be excluded: a limit as small as these refuses that.
    ok, _, _ = _solve(seed=1, pairs=30)
    tre = ok.epochs[0].predicted_tre
    assert tre is not None
    warned, _, _ = _solve(seed=1, pairs=30, config=SolveConfig(limit_mm=0.8 * tre.worst_mm))
    refused, _, _ = _solve(seed=1, pairs=30, config=SolveConfig(limit_mm=0.4 * tre.worst_mm))
    assert warned.verdict is Verdict.WARNING
    assert refused.verdict is Verdict.REFUSED
    assert any("predicted error at the worst target" in reason for reason in warned.reasons)
