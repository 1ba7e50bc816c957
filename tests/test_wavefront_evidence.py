"""Wavefronts tell sound speed and range offset apart; pairs without channel data do not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fgreg.detection.photoacoustic import locate_in_channels
from fgreg.detection.results import PaFind
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, as_float_array
from fgreg.graph.columns import make_columns
from fgreg.graph.packing import evidence, tells_of_constants
from fgreg.model.estimate import Verdict
from fgreg.model.measurements import Look, Measurements, Wavefront
from fgreg.model.probe_model import ChannelModel, ProbeModel, SensitivityModel
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.systematic import EXACT
from fgreg.model.wavefront_evidence import (
    BY_OFFSET,
    COMMON_OFFSET_MM,
    COMMON_RATIO,
    SHOT_RATIO,
    wavefront_evidence,
)
from fgreg.registration.register import register
from fgreg.registration.solve import Solution, distance_to_explicit, solve
from fgreg.simulation.acoustics import Hearing, simulate_channels
from fgreg.simulation.array import TrueArray
from tests.forward import make_measurements, make_session

CHOSEN = [Constant.RANGE_OFFSET, Constant.SOUND_SPEED, Constant.PITCH]
TRIGGER_MM = 1.54
"""A trigger 1 us off."""


def look(range_mm: float, wavefront: Wavefront | None) -> Look:
    return Look(0.0, 1e-3, 0.0, range_mm, np.eye(2), wavefront=wavefront)


def wavefronts(
    ranges_mm: FloatArray, *, offset_mm: float = 0.0, speed: float = 0.0, sigma: float = 0.0005
) -> list[Look]:
    return [look(r, Wavefront(1.0 + speed + BY_OFFSET * offset_mm / r, sigma)) for r in ranges_mm.tolist()]


def test_one_wavefront_says_what_the_derivation_says() -> None:
    information, pull = wavefront_evidence([look(20.0, Wavefront(1.01, 0.002))])
    by = np.zeros(len(pull))
    by[CHOSEN] = BY_OFFSET / 20.0, 1.0, -1.0
    variance = SHOT_RATIO**2 + 0.002**2 + COMMON_RATIO**2 + (COMMON_OFFSET_MM * BY_OFFSET / 20.0) ** 2
    np.testing.assert_allclose(information, np.outer(by, by) / variance, atol=1e-6)
    np.testing.assert_allclose(pull, 0.01 * by / variance, atol=1e-8)
    nothing, none = wavefront_evidence([look(20.0, None)])
    assert not nothing.any()
    assert not none.any()


@pytest.mark.parametrize(("offset_mm", "speed"), [(TRIGGER_MM, 0.0), (0.0, 0.02), (-TRIGGER_MM, 0.02)])
def test_many_wavefronts_measure_both_but_never_better_than_what_they_share(offset_mm: float, speed: float) -> None:
    looks = wavefronts(np.linspace(15.0, 60.0, 5000), offset_mm=offset_mm, speed=speed)
    information, pull = wavefront_evidence(looks)
    both = [Constant.SOUND_SPEED, Constant.RANGE_OFFSET]
    covariance = np.linalg.inv(information[np.ix_(both, both)])
    np.testing.assert_allclose(covariance @ pull[both], [speed, offset_mm], atol=1e-6)
    # What scatters averages out, what is common does not.
    spread = np.sqrt(np.diag(covariance))
    assert COMMON_RATIO < spread[0] < 1.2 * COMMON_RATIO
    assert COMMON_OFFSET_MM * BY_OFFSET < spread[1] < 1.2 * COMMON_OFFSET_MM


def test_wavefronts_that_contradict_each_other_count_less() -> None:
    ranges = np.linspace(15.0, 60.0, 20)
    alike = wavefronts(ranges)
    scattered = [
        replace(of, wavefront=Wavefront(1.0 + 0.02 * (-1.0) ** i, 0.0005)) for i, of in enumerate(wavefronts(ranges))
    ]
    at = Constant.SOUND_SPEED
    assert wavefront_evidence(scattered)[0][at, at] < 0.2 * wavefront_evidence(alike)[0][at, at]


def heard(offset_mm: float, pitch: float, range_mm: float) -> PaFind:
    sensitivity = SensitivityModel(as_float_array([30.0]), as_float_array([0.1]), 0.005)
    probe = ProbeModel(128, 0.43, False, 10.0, 1540.0, sensitivity, ChannelModel(40.0, 5.0, 0.0))
    array = TrueArray.of(probe, {Constant.RANGE_OFFSET: offset_mm, Constant.PITCH: pitch})
    rng, source = np.random.default_rng(3), np.array([5.0, 0.0, 10.0 + range_mm])
    frame = simulate_channels(probe, source, 0.0, rng, None, 20.0, 1800, None, Hearing(elevation=None), array=array)
    find = locate_in_channels(frame, probe)
    assert isinstance(find, PaFind)
    return find


@pytest.mark.parametrize("range_mm", [15.0, 30.0, 50.0])
def test_rendered_wavefronts_move_as_derived(range_mm: float) -> None:
    """By an offset and by the pitch, in frames that know nothing of the derivation."""
    right = heard(0.0, 0.0, range_mm).wavefront
    late, wide = heard(-1.0, 0.0, range_mm), heard(0.0, 0.01, range_mm).wavefront
    assert right is not None
    assert late.wavefront is not None
    assert wide is not None
    assert late.range_mm == pytest.approx(range_mm + 1.0, abs=0.02)
    assert late.wavefront.ratio - right.ratio == pytest.approx(-BY_OFFSET / late.range_mm, rel=0.1)
    assert wide.ratio - right.ratio == pytest.approx(-0.01, abs=0.001)


def session(
    rng: np.random.Generator, *, offset_mm: float, speed: float, channels: bool
) -> tuple[SessionModel, Measurements]:
    """Pairs with a trigger and a sound speed that are not as declared, with wavefronts where there are ``channels``."""
    declared = make_session(systematic=replace(EXACT, sound_speed=0.01, range_offset_mm=0.1, pitch=0.002))
    model, measurements, _ = make_measurements(rng, pairs=30, session=declared)
    pairs = []
    for pair in measurements.pairs:
        range_mm = (pair.look.range_mm - offset_mm) / (1.0 + speed)
        ratio = 1.0 + speed + BY_OFFSET * offset_mm / range_mm
        wavefront = Wavefront(ratio + 0.002 * float(rng.standard_normal()), 0.001) if channels else None
        pairs.append(replace(pair, look=replace(pair.look, range_mm=range_mm, wavefront=wavefront)))
    return model, replace(measurements, pairs=tuple(pairs))


def solved(*, offset_mm: float = 0.0, speed: float = 0.0, channels: bool = True, seed: int = 5) -> Solution:
    rng = np.random.default_rng(seed)
    model, measurements = session(rng, offset_mm=offset_mm, speed=speed, channels=channels)
    return solve(measurements, [], model, SolveConfig())


def about(solution: Solution, name: str) -> list[str]:
    return [reason for reason in solution.reasons if name in reason]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_trigger_that_is_off_is_told_as_such(sign: float) -> None:
    solution = solved(offset_mm=sign * TRIGGER_MM)
    assert solution.verdict is not Verdict.OK
    (text,) = about(solution, "range offset")
    assert text.startswith("the shots contradict the range offset (")
    assert not about(solution, "sound speed")
    fits = float(text.split("(")[1].split(" mm")[0])
    assert fits == pytest.approx(sign * TRIGGER_MM, abs=0.8)


def test_a_sound_speed_that_is_off_is_taken_into_account_and_noted() -> None:
    solution = solved(speed=0.02)
    (speed,) = (constant for constant in solution.systematic if constant.name == "sound_speed")
    assert speed.value == pytest.approx(0.02, abs=3.0 * math.hypot(speed.sigma, 0.1 * 0.02))
    assert about(solution, "the shots measure the sound speed")
    assert not about(solution, "contradict")
    assert about(solved(speed=0.06), "the shots contradict the sound speed (")


def test_a_right_session_has_neither() -> None:
    assert not about(solved(), "sound speed") + about(solved(), "range offset")


@pytest.mark.parametrize(("offset_mm", "speed"), [(3.0, 0.0), (0.0, 0.08)])
def test_without_channel_data_they_are_named_as_one_direction(offset_mm: float, speed: float) -> None:
    (text,) = about(solved(offset_mm=offset_mm, speed=speed, channels=False, seed=1), "contradict")
    assert "the range offset (" in text
    assert "the sound speed (" in text
    assert " or the " in text
    assert "measure the trigger delay and the lens" in text
    assert "measure the medium's temperature or sound speed" in text


def test_the_explicit_graph_has_the_same_evidence() -> None:
    model, measurements = session(np.random.default_rng(5), offset_mm=0.0, speed=0.02, channels=True)
    assert tells_of_constants(measurements.pairs[0])
    registration = register(measurements, model, SolveConfig())
    assert registration.optimum.state.constant(Constant.SOUND_SPEED)[0] == pytest.approx(0.018, abs=0.004)
    assert distance_to_explicit(registration) < 0.01
    known = evidence(measurements, make_columns(1, EXACT.sigmas(0.01, 0.0)))
    assert not known.information.any()  # where they are no variables
