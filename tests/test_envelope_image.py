"""A source in an envelope image: sub-pixel, with an honest covariance, and none where there is none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from fgreg.detection.channels import baseband, prepare_channels
from fgreg.detection.envelope import locate_in_image
from fgreg.detection.photoacoustic import locate_in_frame
from fgreg.detection.results import NoSignal, PaFind
from fgreg.detection.wavefront_search import SEARCH_BANDS
from fgreg.geometry.transforms import as_float_array
from fgreg.model.probe_model import ChannelModel, ImageModel, ProbeModel, SensitivityModel
from fgreg.simulation.acoustics import Hearing, Pulse, log_compressed, simulate_channels, simulate_envelope_image
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate

SHAPE = (300, 256)


def probe_with(flip: bool = False, channels: bool = False) -> ProbeModel:
    sensitivity = SensitivityModel(as_float_array([30.0]), as_float_array([0.1]), 0.005)
    return ProbeModel(
        128,
        0.43,
        flip,
        10.0,
        1540.0,
        sensitivity,
        ChannelModel(40.0, 10.0, 0.0) if channels else None,
        ImageModel((0.1, 0.2), (8.0, -25.6)),
    )


def image_of(
    x_mm: float, range_mm: float, snr_db: float, seed: int, pulse: Pulse | None = None
) -> npt.NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    position = np.array([x_mm, 0.0, 10.0 + range_mm])
    return simulate_envelope_image(
        probe_with(), position, 0.0, rng, SHAPE, pulse, snr_db, None, Hearing(elevation=None)
    )


def found(image: npt.NDArray[np.generic], probe: ProbeModel) -> PaFind:
    answer = locate_in_image(image, probe)
    assert isinstance(answer, PaFind), answer
    return answer


def test_peak_is_found_between_pixels_with_an_honest_covariance() -> None:
    probe = probe_with()
    rng = np.random.default_rng(1)
    errors, distances = [], []
    for seed in range(40):
        x_mm, range_mm = rng.uniform(-20.0, 20.0), rng.uniform(12.0, 35.0)
        find = found(image_of(x_mm, range_mm, 22.0, seed, Pulse(rng.uniform(3.5, 6.0), 0.7)), probe)
        errors.append([find.x_mm - x_mm, find.range_mm - range_mm])
        distances.append(float(np.array(errors[-1]) @ np.linalg.solve(find.covariance, errors[-1])))
        assert find.sound_speed_ratio is None
        assert find.elements_used is None
        assert find.snr_db == pytest.approx(22.0, abs=4.0)
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    # A tenth of a pixel across and a quarter along, where a skewed pulse has to be allowed for.
    assert rms[0] < 0.02
    assert rms[1] < 0.025
    assert 0.7 < float(np.mean(distances)) < 3.0


def test_columns_are_trus_x_whatever_the_channels_order() -> None:
    image = image_of(6.0, 20.0, 25.0, 2)
    assert found(image, probe_with(flip=True)).x_mm == pytest.approx(6.0, abs=0.05)
    assert found(image, probe_with(flip=False)).x_mm == pytest.approx(6.0, abs=0.05)


@pytest.mark.parametrize("grain", [0.0, 1.5, 3.0])
def test_speckle_is_no_source(grain: float) -> None:
    rng = np.random.default_rng(3)
    f = np.hypot(np.fft.fftfreq(SHAPE[0])[:, None], np.fft.rfftfreq(SHAPE[1])[None, :])
    for _ in range(40):
        noise = rng.standard_normal((2, *SHAPE))
        noise = np.fft.irfft2(np.fft.rfft2(noise) * np.exp(-2.0 * (math.pi * grain * f) ** 2), SHAPE)
        answer = locate_in_image(np.hypot(noise[0], noise[1]), probe_with())
        assert isinstance(answer, NoSignal)
        assert "threshold" in answer.reason


def test_background_that_grows_with_depth_and_a_bright_band_hide_no_source() -> None:
    rng = np.random.default_rng(4)
    grows = np.linspace(0.2, 5.0, SHAPE[0])[:, None]
    noise = np.hypot(*rng.standard_normal((2, *SHAPE))) * grows
    noise[:6] *= 50.0
    assert isinstance(locate_in_image(noise, probe_with()), NoSignal)
    z = 8.0 + 0.1 * np.arange(SHAPE[0])[:, None]
    x = -25.6 + 0.2 * np.arange(SHAPE[1])[None, :]
    spot = 12.0 * np.exp(-0.5 * ((z - 16.04) / 0.15) ** 2 - 0.5 * ((x - 3.3) / 0.3) ** 2)
    find = found(noise + spot, probe_with())
    assert find.x_mm == pytest.approx(3.3, abs=0.1)
    assert find.range_mm == pytest.approx(16.04, abs=0.06)


def test_an_image_beamformed_from_channels_gives_the_channels_source() -> None:
    """Delay and sum written out here, pixel by pixel, sidelobes and all."""
    probe = probe_with(channels=True)
    rng = np.random.default_rng(5)
    position = np.array([4.0, 0.0, 33.0])
    frame = simulate_channels(probe, position, 0.0, rng, None, 10.0, 800, None, Hearing(elevation=None))
    assert probe.channels is not None
    signal = baseband(prepare_channels(frame, probe.channels), SEARCH_BANDS[1])
    z = 8.0 + 0.1 * np.arange(200)
    x = -25.6 + 0.2 * np.arange(256)
    sums = np.zeros((z.size, x.size), dtype=np.complex128)
    for i, element in enumerate(probe.element_x_mm):
        elapsed = np.hypot(z[:, None], x[None, :] - element) / 1.54 - signal.start_us
        row = np.clip(np.rint(elapsed * signal.rate_mhz).astype(int), 0, signal.data.shape[0] - 1)
        sums += signal.data[row, i] * np.exp(2j * math.pi * signal.carrier_mhz * elapsed)
    find = found(np.abs(sums).astype(np.float32), probe)
    assert find.x_mm == pytest.approx(4.0, abs=0.05)
    assert find.range_mm == pytest.approx(23.0, abs=0.05)
    both = locate_in_frame(frame, probe)
    assert isinstance(both, PaFind)
    assert both.sound_speed_ratio is not None
    assert find.x_mm == pytest.approx(both.x_mm, abs=0.05)


def test_frames_that_are_no_images() -> None:
    probe = probe_with()
    answer = locate_in_image(np.zeros(SHAPE, dtype=np.int16), probe)
    assert isinstance(answer, NoSignal)
    with pytest.raises(ValueError, match="negative"):
        locate_in_image(np.full(SHAPE, -1.0), probe)
    with pytest.raises(ValueError, match="8 x 8"):
        locate_in_image(np.ones((4, 100)), probe)
    with pytest.raises(ValueError, match="not finite"):
        locate_in_frame(np.full(SHAPE, np.inf), probe)
    bare = ProbeModel(128, 0.43, False, 10.0, 1540.0, probe.sensitivity)
    with pytest.raises(ValueError, match=r"probe\.image"):
        locate_in_image(np.ones(SHAPE), bare)


def test_a_frame_with_other_rows_than_elements_is_an_image() -> None:
    find = locate_in_frame(image_of(6.0, 20.0, 25.0, 6), probe_with(channels=True))
    assert isinstance(find, PaFind)
    assert find.sound_speed_ratio is None
    assert find.x_mm == pytest.approx(6.0, abs=0.05)


@pytest.mark.parametrize("gain_db", [0.0, 6.0])
@pytest.mark.parametrize("behind_mm", [3.0, 9.0])
def test_a_brighter_copy_behind_is_another_wave(gain_db: float, behind_mm: float) -> None:
    for seed in range(3):
        both = np.maximum(image_of(6.0, 20.0, 20.0, seed), image_of(7.0, 20.0 + behind_mm, 20.0 + gain_db, seed + 50))
        find = found(both, probe_with())
        assert find.x_mm == pytest.approx(6.0, abs=0.2)
        assert find.range_mm == pytest.approx(20.0, abs=0.2)
        if gain_db:
            assert find.others[0].x_mm == pytest.approx(7.0, abs=0.5)
            assert find.others[0].range_mm == pytest.approx(20.0 + behind_mm, abs=0.4)


def test_a_bright_line_before_the_source_is_not_taken_for_it() -> None:
    image = image_of(6.0, 25.0, 20.0, 1).astype(np.float64)
    image[60:64] += 20.0
    find = found(image, probe_with())
    assert find.x_mm == pytest.approx(6.0, abs=0.2)
    assert find.range_mm == pytest.approx(25.0, abs=0.2)
    # In a part of the columns it hides the source, but is none.
    image = image_of(6.0, 25.0, 20.0, 1).astype(np.float64)
    image[60:64, 60:160] += 20.0
    assert isinstance(locate_in_image(image, probe_with()), NoSignal)


@pytest.mark.parametrize("stored", ["8 bits", "12 bits in 16", "dB", "share"])
def test_log_compressed_pictures_are_made_linear_and_give_the_same_position(stored: str) -> None:
    probe = probe_with()
    assert probe.image is not None
    log_probe = replace(probe, image=replace(probe.image, log_db=60.0))
    for seed in range(2):
        image = image_of(9.0 * seed - 4.4, 14.03 + 18.3 * seed, 25.0, seed)
        level_db = 20.0 * np.log10(image / image.max())
        picture: npt.NDArray[np.generic] = {
            "8 bits": log_compressed(image, 60.0),
            "12 bits in 16": np.rint(4095 * np.clip(1 + level_db / 60, 0, 1)).astype(np.uint16),
            "dB": level_db.astype(np.float32),
            "share": np.clip(1 + level_db / 60, 0, 1).astype(np.float32),
        }[stored]
        was, now = found(image, probe), found(picture, log_probe)
        # 8 bits of 60 dB are steps of 0.24 dB; the peak's own standard deviation is 0.008 mm and more.
        assert now.range_mm == pytest.approx(was.range_mm, abs=0.002)
        assert now.x_mm == pytest.approx(was.x_mm, abs=0.003)
        np.testing.assert_allclose(now.covariance, was.covariance, rtol=0.1, atol=1e-6)
        # Taken as linear it is found elsewhere, or not known how well, or not at all.
        wrong = locate_in_image(np.abs(np.asarray(picture, dtype=np.float64)), probe)
        assert not (isinstance(wrong, PaFind) and np.allclose(wrong.covariance, was.covariance, rtol=0.3))


def test_the_simulators_log_compressed_pictures_have_the_ranges_of_its_linear_ones() -> None:
    log = PRESETS["log-images"]
    assert log.probe.image is not None
    linear = replace(log, probe=replace(log.probe, image=replace(log.probe.image, log_db=None)))
    finds = []
    for config in (log, linear):
        frames = simulate(config, 3).frames
        picture = frames[next(name for name in frames if name.endswith(".npy"))]()
        assert picture.dtype == (np.float32 if config is linear else np.uint8)
        finds.append(found(picture, config.probe))
    assert finds[0].range_mm == pytest.approx(finds[1].range_mm, abs=0.002)
    assert finds[0].x_mm == pytest.approx(finds[1].x_mm, abs=0.003)
