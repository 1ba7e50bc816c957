"""The direct wave is the first one: reflections come later, pick-up and sound of the probe's face earlier."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest

from fgreg.detection.photoacoustic import locate_in_channels
from fgreg.detection.results import NoSignal, PaFind
from fgreg.geometry.transforms import as_float_array
from fgreg.model.probe_model import ChannelModel, ProbeModel, SensitivityModel
from fgreg.simulation.acoustics import Artefact, FaceSound, Hearing, PickUp, Pulse, Reflection, simulate_channels

X_MM, RANGE_MM = 5.0, 25.0


@pytest.fixture
def probe() -> ProbeModel:
    sensitivity = SensitivityModel(as_float_array([30.0]), as_float_array([0.1]), 0.005)
    return ProbeModel(128, 0.43, False, 10.0, 1540.0, sensitivity, ChannelModel(40.0, 0.0, 0.0))


def frame_of(
    probe: ProbeModel, snr_db: float, artefacts: Sequence[Artefact], seed: int = 1, pulse: Pulse | None = None
) -> npt.NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    source = np.array([X_MM, 0.0, probe.radius_mm + RANGE_MM])
    hearing = Hearing(elevation=None)
    return simulate_channels(probe, source, 0.0, rng, pulse, snr_db, 1300, None, hearing, artefacts=artefacts)


def found(answer: PaFind | NoSignal) -> PaFind:
    assert isinstance(answer, PaFind), answer
    assert answer.x_mm == pytest.approx(X_MM, abs=0.1)
    assert answer.range_mm == pytest.approx(RANGE_MM, abs=0.1)
    return answer


@pytest.mark.parametrize("snr_db", [20.0, 10.0, 0.0])
@pytest.mark.parametrize("behind_mm", [3.0, 7.0, 15.0])
@pytest.mark.parametrize("gain_db", [0.0, 6.0])
def test_a_louder_reflection_is_another_wave(
    probe: ProbeModel, snr_db: float, behind_mm: float, gain_db: float
) -> None:
    for seed, phase in enumerate((0.0, math.pi)):
        answer = locate_in_channels(frame_of(probe, snr_db, [Reflection(behind_mm, -1.5, gain_db, phase)], seed), probe)
        other = found(answer).others[0]
        error = np.array([other.x_mm - (X_MM - 1.5), other.range_mm - (RANGE_MM + behind_mm)])
        assert error @ np.linalg.solve(other.covariance, error) < 14.0


def test_a_long_pulse_is_told_from_its_reflection_3_mm_behind(probe: ProbeModel) -> None:
    pulse = Pulse(3.0, 0.5, 0.5)
    for seed in range(4):
        find = found(locate_in_channels(frame_of(probe, 10.0, [Reflection(3.0, 0.0, 6.0)], seed, pulse), probe))
        assert find.others


def test_of_several_waves_the_first_is_the_direct_one(probe: ProbeModel) -> None:
    copies = [Reflection(4.0, 1.0, 4.0), Reflection(10.0, -2.0, 9.0)]
    find = found(locate_in_channels(frame_of(probe, 10.0, copies), probe))
    assert [round(other.range_mm - RANGE_MM) for other in find.others] == [10, 4]


def test_a_softer_reflection_is_reported_too(probe: ProbeModel) -> None:
    find = found(locate_in_channels(frame_of(probe, 10.0, [Reflection(6.0, 0.0, -6.0)]), probe))
    assert [round(other.range_mm - RANGE_MM) for other in find.others] == [6]


@pytest.mark.parametrize("snr_db", [30.0, 0.0])
def test_a_clean_frame_shows_no_other_wave(probe: ProbeModel, snr_db: float) -> None:
    for seed in range(10):
        assert not found(locate_in_channels(frame_of(probe, snr_db, [], seed), probe)).others


EARLY: dict[str, Artefact] = {
    "pick-up": PickUp(4.0),
    "pick-up in a quarter of the channels": PickUp(6.0, unequal=0.0, elements=(0.5, 0.75)),
    "pick-up, another quarter, off the eighths": PickUp(9.0, elements=(0.2, 0.45), pulse=Pulse(3.0, 0.3)),
    "pick-up that rings": PickUp(5.0, pulse=Pulse(2.0, 0.3)),
    "light on the face": FaceSound(range_mm=0.8, x_mm=3.0, width_mm=15.0),
    "a spot of light on the face": FaceSound(range_mm=0.8, x_mm=3.0),
    "a spot farther off": FaceSound(range_mm=1.9, x_mm=-12.0),
}


@pytest.mark.parametrize("kind", EARLY)
@pytest.mark.parametrize("louder_db", [0.0, 20.0])
def test_what_comes_before_the_direct_wave_is_not_taken_for_it(probe: ProbeModel, kind: str, louder_db: float) -> None:
    early = EARLY[kind]
    assert not isinstance(early, Reflection)
    for snr_db, later in ((10.0, []), (0.0, [Reflection(5.0, 1.0, 3.0)])):
        loud = type(early)(**{name: getattr(early, name) for name in early.__slots__} | {"snr_db": snr_db + louder_db})
        found(locate_in_channels(frame_of(probe, snr_db, [loud, *later]), probe))
        assert isinstance(locate_in_channels(frame_of(probe, -300.0, [loud]), probe), NoSignal)
