"""A wrong sound speed shows in the wavefront; range stays that of the arrival at the apex."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fgreg.detection.photoacoustic import locate_in_channels
from fgreg.detection.results import PaFind
from fgreg.geometry.transforms import as_float_array
from fgreg.model.probe_model import ChannelModel, ProbeModel, SensitivityModel
from fgreg.simulation.acoustics import Hearing, simulate_channels


def finds(ratio: float, snr_db: float, frames: int) -> list[tuple[PaFind, float, float]]:
    """Finds with the true x and range, where the tissue's speed is ``ratio`` times the assumed one."""
    sensitivity = SensitivityModel(as_float_array([30.0]), as_float_array([0.1]), 0.005)
    probe = ProbeModel(128, 0.43, False, 10.0, 1540.0, sensitivity, ChannelModel(40.0, 12.0, 0.0))
    out = []
    for seed in range(frames):
        rng = np.random.default_rng([seed, 17])
        x_mm, range_mm = rng.uniform(-15.0, 15.0), rng.uniform(22.0, 32.0)
        position = np.array([x_mm, 0.0, 10.0 + range_mm])
        frame = simulate_channels(probe, position, 0.0, rng, None, snr_db, 800, 1540.0 * ratio, Hearing(elevation=None))
        find = locate_in_channels(frame, probe)
        assert isinstance(find, PaFind)
        out.append((find, x_mm, range_mm))
    return out


@pytest.mark.parametrize("ratio", [0.98, 1.02])
@pytest.mark.parametrize("snr_db", [20.0, 5.0])
def test_two_percent_show_in_every_frame(ratio: float, snr_db: float) -> None:
    for find, x_mm, range_mm in finds(ratio, snr_db, 8):
        assert find.sound_speed_ratio is not None
        assert find.sound_speed_ratio_sigma is not None
        assert find.sound_speed_ratio == pytest.approx(ratio, abs=5.0 * find.sound_speed_ratio_sigma)
        assert abs(find.sound_speed_ratio - 1.0) > 3.0 * find.sound_speed_ratio_sigma
        # x is the true one, range the assumed speed's; ratio times that is the true range again.
        assert find.x_mm == pytest.approx(x_mm, abs=5.0 * math.sqrt(find.covariance[0, 0]))
        assert find.range_mm == pytest.approx(range_mm / ratio, abs=5.0 * math.sqrt(find.covariance[1, 1]))


def test_the_right_speed_raises_no_alarm() -> None:
    heard = [find.wavefront for find, _, _ in finds(1.0, 5.0, 10)]
    ratios = np.array([wavefront.ratio for wavefront in heard if wavefront is not None])
    assert len(ratios) == 10
    assert abs(ratios.mean() - 1.0) < 0.002
    assert max(wavefront.sigma for wavefront in heard if wavefront is not None) < 0.005


def test_water_instead_of_tissue_is_found_all_the_same() -> None:
    for find, x_mm, range_mm in finds(1480.0 / 1540.0, 0.0, 5):
        assert find.x_mm == pytest.approx(x_mm, abs=0.1)
        assert find.range_mm == pytest.approx(range_mm * 1540.0 / 1480.0, abs=0.1)


def test_delays_in_the_tissue_widen_the_covariance() -> None:
    """Layers that delay neighbouring elements together: no noise explains it, so the covariance has to allow for it."""
    sensitivity = SensitivityModel(as_float_array([30.0]), as_float_array([0.1]), 0.005)
    probe = ProbeModel(128, 0.43, False, 10.0, 1540.0, sensitivity, ChannelModel(40.0, 10.0, 0.0))
    rng = np.random.default_rng(3)
    position = np.array([3.0, 0.0, 35.0])
    frame = simulate_channels(probe, position, 0.0, rng, None, 20.0, 800, None, Hearing(elevation=None))
    delay_us = 0.02 * np.sin(np.arange(128) / 5.0)
    turn = np.exp(-2j * np.pi * np.fft.rfftfreq(800, 1 / 40.0) * delay_us[:, None])
    delayed = np.fft.irfft(np.fft.rfft(frame, axis=1) * turn, 800, axis=1)
    plain, widened = locate_in_channels(frame, probe), locate_in_channels(delayed, probe)
    assert isinstance(plain, PaFind)
    assert isinstance(widened, PaFind)
    assert widened.covariance[0, 0] > 9.0 * plain.covariance[0, 0]
    assert widened.x_mm == pytest.approx(3.0, abs=0.1)
