"""No source in the frame is an answer, not a wrong point."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from fgreg.detection.photoacoustic import locate_in_channels
from fgreg.detection.results import NoSignal, PaFind
from fgreg.geometry.transforms import as_float_array
from fgreg.model.probe_model import ChannelModel, ProbeModel, SensitivityModel
from fgreg.simulation.acoustics import Hearing, noise_channels, simulate_channels


@pytest.fixture
def probe() -> ProbeModel:
    sensitivity = SensitivityModel(as_float_array([30.0]), as_float_array([0.1]), 0.005)
    return ProbeModel(128, 0.43, False, 10.0, 1540.0, sensitivity, ChannelModel(40.0, 8.0, 0.0))


def source(probe: ProbeModel, snr_db: float, seed: int) -> npt.NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    position = np.array([5.0, 0.0, 35.0])
    return simulate_channels(probe, position, 0.0, rng, None, snr_db, 800, None, Hearing(elevation=None))


def common_flash(amplitude: float, at_us: float, unequal: float, seed: int) -> npt.NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    time_us = np.arange(800) / 40.0
    wave = np.exp(-0.5 * ((time_us - at_us) / 0.2) ** 2) * np.cos(2 * np.pi * 4.0 * time_us)
    gain = amplitude * (1.0 + unequal * rng.standard_normal((128, 1)))
    return np.asarray(gain * wave, dtype=np.float32)


def test_noise_is_no_source(probe: ProbeModel) -> None:
    rng = np.random.default_rng(1)
    answers = [locate_in_channels(noise_channels(probe, rng, 800), probe) for _ in range(60)]
    assert all(isinstance(answer, NoSignal) for answer in answers)
    assert isinstance(answers[0], NoSignal)
    assert "statistic" in answers[0].reason
    assert "threshold" in answers[0].reason


def test_dead_frames_are_no_source(probe: ProbeModel) -> None:
    for frame in (np.zeros((128, 800), dtype=np.float32), np.full((128, 800), 7, dtype=np.int16)):
        answer = locate_in_channels(frame, probe)
        assert isinstance(answer, NoSignal)
        assert "constant" in answer.reason


@pytest.mark.parametrize("amplitude", [2.0, 20.0, 300.0])
@pytest.mark.parametrize("unequal", [0.0, 0.3])
def test_a_flash_on_all_channels_is_no_source_and_hides_none(
    probe: ProbeModel, amplitude: float, unequal: float
) -> None:
    rng = np.random.default_rng(2)
    for at_us in (0.4, 9.0):
        flash = common_flash(amplitude, at_us, unequal, 3)
        assert isinstance(locate_in_channels(noise_channels(probe, rng, 800) + flash, probe), NoSignal)
        find = locate_in_channels(source(probe, 5.0, 4) + flash, probe)
        assert isinstance(find, PaFind)
        assert find.x_mm == pytest.approx(5.0, abs=0.05)
        assert find.range_mm == pytest.approx(25.0, abs=0.06)


@pytest.mark.parametrize("amplitude", [3.0, 20.0, 100.0])
def test_a_flat_wave_that_few_channels_share_is_no_source(probe: ProbeModel, amplitude: float) -> None:
    # A quarter of the channels: the median does not see it, so it is not subtracted; its shape has to show it.
    rng = np.random.default_rng(5)
    for at_us in (2.0, 9.0, 15.0):
        for first, last in ((48, 80), (0, 40)):
            flash = common_flash(amplitude, at_us, 0.0, 6)
            flash[:first] = 0.0
            flash[last:] = 0.0
            assert isinstance(locate_in_channels(noise_channels(probe, rng, 800) + flash, probe), NoSignal)


def test_sources_at_0_db_are_found_and_far_below_the_noise_they_are_not(probe: ProbeModel) -> None:
    assert all(isinstance(locate_in_channels(source(probe, 0.0, seed), probe), PaFind) for seed in range(20))
    faint = [locate_in_channels(source(probe, -20.0, seed), probe) for seed in range(20)]
    assert all(isinstance(answer, NoSignal) for answer in faint)


def test_a_source_outside_the_record_is_no_source() -> None:
    sensitivity = SensitivityModel(as_float_array([30.0]), as_float_array([0.1]), 0.005)
    late = ProbeModel(128, 0.43, False, 10.0, 1540.0, sensitivity, ChannelModel(40.0, 60.0, 0.0))
    assert isinstance(locate_in_channels(source(late, 10.0, 7), late), NoSignal)
    beyond = ProbeModel(128, 0.43, False, 10.0, 1540.0, sensitivity, ChannelModel(40.0, 250.0, 0.0))
    answer = locate_in_channels(source(beyond, 10.0, 7), beyond)
    assert isinstance(answer, NoSignal)
