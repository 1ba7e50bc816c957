"""Sound speed and probe radius as variables, and a wrong sound speed that is not estimated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from fgreg.cli.main import app
from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray, inverse, transform_points
from fgreg.model.estimate import Verdict
from fgreg.model.session_model import NoiseModel, SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.systematic import EXACT
from fgreg.online.engine import OnlineRegistration
from fgreg.registration.posterior_mean import (
    estimated_radius,
    estimated_sound_speed,
    posterior_mean,
)
from fgreg.registration.register import register
from fgreg.registration.solve import solve
from tests.forward import Truth, make_measurements, make_session
from tests.online_streams import first, restored

QUIET = NoiseModel(
    marker_translation_mm=(0.02, 0.02, 0.05),
    marker_rotation_rad=(0.001, 0.001, 0.001),
    aim_mm=(0.1, 0.1, 0.1),
    lateral_mm=0.1,
    range_mm=0.05,
)


def _tre(trus_T_camera: FloatArray, truth: Truth, model: SessionModel) -> float:
    camera_p = transform_points(inverse(truth.trus_T_camera[0]), model.targets_mm)
    return float(np.sqrt(np.mean(np.sum((transform_points(trus_T_camera, camera_p) - model.targets_mm) ** 2, axis=1))))


def test_a_wrong_sound_speed_is_found_where_the_noise_lets_it() -> None:
    declared = make_session(noise_model=QUIET, systematic=replace(EXACT, sound_speed=0.01))
    model, measurements, _ = make_measurements(
        np.random.default_rng(1), pairs=30, session=declared, sound_speed_ratio=1.05
    )
    solution = solve(measurements, [], model, SolveConfig())
    assert solution.verdict is not Verdict.OK
    assert any("contradict the sound speed" in reason for reason in solution.reasons)
    (speed,) = solution.systematic[1:]
    assert abs(speed.value / speed.observed - 0.05) < 3.5 * speed.sigma / speed.observed


def test_the_error_that_a_full_solve_names_stays_in_the_estimates_after_it() -> None:
    declared = make_session(noise_model=QUIET, systematic=replace(EXACT, sound_speed=0.01))
    model, measurements, _ = make_measurements(
        np.random.default_rng(1), pairs=32, session=declared, sound_speed_ratio=1.05
    )
    engine = restored(OnlineRegistration(model, find_moves=False), first(measurements, 30))
    solved, later = engine.settle(), engine.add(measurements.pairs[30])
    assert any("contradict the sound speed" in reason for reason in solved.reasons)
    assert solved.settled
    assert not later.settled
    assert solved.predicted_tre is not None
    assert later.predicted_tre is not None
    assert later.predicted_tre.worst_mm == pytest.approx(solved.predicted_tre.worst_mm, rel=0.2)


def test_estimating_the_sound_speed_takes_its_error_out() -> None:
    plain: list[float] = []
    estimated: list[float] = []
    right: list[float] = []
    config = SolveConfig(estimate_sound_speed=True, sound_speed_sigma=0.02)
    for seed in range(4):
        session = make_session(noise_model=QUIET)
        model, measurements, truth = make_measurements(
            np.random.default_rng(seed), pairs=20, session=session, sound_speed_ratio=1.02
        )
        for config_of, out in ((SolveConfig(), plain), (config, estimated)):
            found = posterior_mean(register(measurements, model, config_of), config_of)
            out.append(_tre(found.posterior.mean.trus_T_camera()[0], truth, model))
        speed = estimated_sound_speed(found.registration)
        assert speed is not None
        assert abs(speed.value - 1.02) < 4.0 * speed.sigma
        model, measurements, truth = make_measurements(np.random.default_rng(seed), pairs=20, session=session)
        found = posterior_mean(register(measurements, model, SolveConfig()), SolveConfig())
        right.append(_tre(found.posterior.mean.trus_T_camera()[0], truth, model))
    assert np.mean(estimated) < 0.6 * np.mean(plain)
    assert np.mean(estimated) < 2.0 * np.mean(right)


def test_the_radius_is_estimated_with_its_prior() -> None:
    model, measurements, _ = make_measurements(
        np.random.default_rng(2), pairs=25, session=make_session(noise_model=QUIET)
    )
    wrong = replace(model, probe=replace(model.probe, radius_mm=10.5))
    config = SolveConfig(estimate_radius=True)
    found = posterior_mean(register(measurements, wrong, config), config)
    radius = estimated_radius(found.registration)
    assert radius is not None
    assert estimated_sound_speed(found.registration) is None
    assert radius.sigma < 0.9 * config.radius_sigma_mm  # the pairs add to the prior
    assert radius.value < 10.4  # and pull the right way
    assert abs(radius.value - 10.0) < 3.0 * radius.sigma
    solution = solve(measurements, [], wrong, config)
    assert any("estimated radius" in reason for reason in solution.reasons)


def test_with_default_noise_a_right_sound_speed_is_not_suspected() -> None:
    for seed in range(6):
        session = make_session(systematic=replace(EXACT, sound_speed=0.03))
        model, measurements, _ = make_measurements(np.random.default_rng(seed), pairs=15, session=session)
        solution = solve(measurements, [], model, SolveConfig())
        assert not [reason for reason in solution.reasons if "sound speed" in reason]


def test_the_command_refuses_names_it_does_not_know() -> None:
    result = CliRunner().invoke(app, ["solve", "nowhere", "--estimate", "sound_speed,colour"])
    assert isinstance(result.exception, InputError)
    assert "sound_speed, probe_radius" in str(result.exception)


@pytest.mark.parametrize("field", ["amplitude_sigma", "sound_speed_sigma", "radius_sigma_mm", "posterior_effective"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_settings_that_cannot_be_are_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=field):
        SolveConfig(**{field: value})  # type: ignore[arg-type]
