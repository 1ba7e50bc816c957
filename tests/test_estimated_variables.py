"""Sound speed and probe radius as variables, and a wrong sound speed that is not estimated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from fgreg.cli.main import app
from fgreg.errors import InputError
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, inverse, transform_points
from fgreg.model.estimate import Verdict
from fgreg.model.session_model import NoiseModel, SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.posterior_mean import (
    estimated_radius,
    estimated_sound_speed,
    posterior_mean,
    sound_speed_from_residuals,
)
from fgreg.registration.register import SoundSpeedPrior, register
from fgreg.registration.solve import distance_to_explicit, solve
from tests.forward import Truth, make_measurements, make_session

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
    model, measurements, _ = make_measurements(
        np.random.default_rng(1), pairs=30, session=make_session(noise_model=QUIET), sound_speed_ratio=1.05
    )
    config = SolveConfig()
    asked = sound_speed_from_residuals(register(measurements, model, config))
    assert asked.value == pytest.approx(1.05, abs=3.5 * asked.sigma)
    assert asked.sigma < 0.012
    solution = solve(measurements, [], model, config)
    assert solution.verdict is not Verdict.OK
    assert any(
        "pairs fit better with sound at 1.0" in reason and "--estimate sound_speed" in reason
        for reason in solution.reasons
    )


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


def test_the_ratio_from_frames_is_the_prior() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(3), pairs=8)
    config = SolveConfig(estimate_sound_speed=True)
    prior = SoundSpeedPrior(1.03, 0.0005)
    registration = register(measurements, model, config, prior)
    assert 1.0 + registration.optimum.state.constant(Constant.SOUND_SPEED)[0] == pytest.approx(1.03, abs=0.002)
    # The explicit graph has the same prior, and so the same optimum.
    assert distance_to_explicit(registration) < 0.01


def test_with_default_noise_a_right_sound_speed_is_not_suspected() -> None:
    for seed in range(6):
        model, measurements, _ = make_measurements(np.random.default_rng(seed), pairs=15)
        asked = sound_speed_from_residuals(register(measurements, model, SolveConfig()))
        assert abs(asked.value - 1.0) < 3.0 * asked.sigma


def test_the_command_refuses_names_it_does_not_know() -> None:
    result = CliRunner().invoke(app, ["solve", "nowhere", "--estimate", "sound_speed,colour"])
    assert isinstance(result.exception, InputError)
    assert "sound_speed, probe_radius" in str(result.exception)


@pytest.mark.parametrize("field", ["amplitude_sigma", "sound_speed_sigma", "radius_sigma_mm", "posterior_effective"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_settings_that_cannot_be_are_refused(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=field):
        SolveConfig(**{field: value})  # type: ignore[arg-type]
