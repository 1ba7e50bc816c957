"""Photoacoustic frames as pictures: a source is where it is, whatever the sampling."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgreg.geometry.transforms import FloatArray
from fgreg.model.probe_model import ChannelModel, ImageModel, ProbeModel
from fgreg.viewer.pa_frame import PaPicture, pa_picture, texture
from tests.forward import make_session


def probe_with(**changes: object) -> ProbeModel:
    return replace(make_session().probe, **changes)  # type: ignore[arg-type]


def channel_frame(probe: ProbeModel, x_mm: float, range_mm: float, samples: int = 1600) -> FloatArray:
    """One spike per element where a wave from (x, range) arrives, on a constant."""
    assert probe.channels is not None
    frame = np.full((probe.elements, samples), 3.0)
    for i in range(probe.elements):
        element_x = (i - 63.5) * 0.43 * (-1.0 if probe.flip else 1.0)
        time_us = ((element_x - x_mm) ** 2 + range_mm**2) ** 0.5 / 1.54
        sample = round((time_us + probe.channels.pulse_delay_us - probe.channels.t0_us) * probe.channels.sampling_mhz)
        if 0 <= sample < samples:
            frame[i, sample] += 100.0
    return frame


def brightest(picture: PaPicture) -> FloatArray:
    """(x, range) of the topmost of the brightest pixels."""
    row, column = np.argwhere(picture.image == picture.image.max())[0]
    return np.array([picture.x_mm + column * picture.pixel_mm, picture.range_mm + row * picture.pixel_mm])


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("channels", [ChannelModel(40.0), ChannelModel(62.5, t0_us=3.0, pulse_delay_us=0.4)])
def test_channel_data_peak_at_the_source_and_along_its_wavefront(flip: bool, channels: ChannelModel) -> None:
    probe = probe_with(channels=channels, flip=flip)
    picture = pa_picture(channel_frame(probe, -8.0, 31.0), probe)
    assert picture is not None
    assert picture.wavefront
    apex = brightest(picture)
    assert apex[1] == pytest.approx(31.0, abs=picture.pixel_mm)
    # Far from the apex the wave tells left from right: 31 mm away across, it has come sqrt(2) times as far.
    x, r = 15.0, np.hypot(23.0, 31.0)
    column, row = picture.pixels(x, r).astype(int)
    window = picture.image[row - 3 : row + 4, column - 3 : column + 4]
    assert window.max() == 255
    column, row = picture.pixels(-x, r).astype(int)
    assert picture.image[row - 3 : row + 4, column - 3 : column + 4].max() == 0


def test_envelope_images_peak_at_the_source_with_unequal_pixels() -> None:
    probe = probe_with(image=ImageModel((0.05, 0.3), (4.0, -25.0)))
    frame = np.zeros((800, 160), dtype=np.float32)
    frame[round((27.3 - 4.0) / 0.05), round((10.1 + 25.0) / 0.3)] = 50.0
    picture = pa_picture(frame, probe)
    assert picture is not None
    assert not picture.wavefront
    bright = np.argwhere(picture.image == 255)
    middle = bright.mean(axis=0)
    assert picture.x_mm + middle[1] * picture.pixel_mm == pytest.approx(10.1, abs=0.2)
    assert picture.range_mm + middle[0] * picture.pixel_mm == pytest.approx(27.3, abs=0.2)
    assert picture.pixels(picture.x_mm, picture.range_mm).tolist() == [0.5, 0.5]
    assert picture.extent_mm[1] - picture.extent_mm[0] == pytest.approx(160 * 0.3, abs=0.5)


def test_a_single_loud_sample_is_never_lost_between_pixels() -> None:
    probe = probe_with(channels=ChannelModel(40.0))
    for sample in range(500, 540):
        frame = np.zeros((128, 4000))
        frame[60, sample] = 1.0
        picture = pa_picture(frame, probe, largest_side=200)
        assert picture is not None
        assert picture.image.max() == 255
        assert texture(picture).max() > 200


@pytest.mark.parametrize(
    ("frame", "changes"),
    [
        (np.zeros((128, 100)), {}),
        (np.zeros((64, 100)), {"channels": ChannelModel(40.0)}),
        (np.zeros(100), {"channels": ChannelModel(40.0)}),
        (np.zeros((128, 10)), {"channels": ChannelModel(40.0, t0_us=-50.0)}),
    ],
)
def test_a_frame_that_cannot_be_placed_has_no_picture(frame: FloatArray, changes: dict[str, object]) -> None:
    assert pa_picture(frame, probe_with(**changes)) is None


def test_a_silent_frame_is_black() -> None:
    picture = pa_picture(np.zeros((128, 800), dtype=np.int16), probe_with(channels=ChannelModel(40.0)))
    assert picture is not None
    assert picture.image.max() == 0
