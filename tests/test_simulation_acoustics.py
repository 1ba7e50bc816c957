"""Simulated channel data against arrival times, ratios and levels computed by hand."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import hilbert

from fgreg.geometry.transforms import FloatArray
from fgreg.model.probe_model import ChannelModel, ImageModel, ProbeModel, SensitivityModel
from fgreg.simulation.acoustics import (
    ElementHeight,
    Elevation,
    FaceSound,
    Hearing,
    PickUp,
    Pulse,
    Reflection,
    element_positions,
    noise_channels,
    quantised,
    rotation_offset_rad,
    simulate_channels,
    simulate_envelope_image,
)

IN_PLANE = Hearing(elevation=None)


def probe(elements: int = 65, flip: bool = False, **channels: float) -> ProbeModel:
    sensitivity = SensitivityModel(np.array([20.0, 45.0]), np.radians([6.0, 6.0]), math.radians(0.3))
    image = ImageModel((0.05, 0.2), (10.0, -20.0))
    return ProbeModel(elements, 0.4, flip, 10.0, 1500.0, sensitivity, ChannelModel(40.0, **channels), image)


def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def arrival_us(row: FloatArray, sampling_mhz: float = 40.0, up: int = 16) -> float:
    """Time of the envelope's maximum after sample 0, band-limited interpolation."""
    n = row.size
    spectrum = np.fft.rfft(row)
    fine = np.fft.irfft(spectrum, n * up)
    return float(np.argmax(np.abs(hilbert(fine))) / (sampling_mhz * up))


@pytest.mark.parametrize("scan_deg", [0.0, 25.0, -40.0])
def test_source_above_the_middle_element_arrives_after_its_distance(scan_deg: float) -> None:
    # 30 mm from the middle element at 1.5 mm/us: 20 us. 32 elements of 0.4 mm away: hypot(30, 12.8) / 1.5 us.
    a = math.radians(scan_deg)
    source = np.array([0.0, 40.0 * math.sin(a), 40.0 * math.cos(a)])
    data = simulate_channels(probe(), source, a, rng(), snr_db=70.0, hearing=IN_PLANE)
    assert data.shape == (65, 1600)
    assert data.dtype == np.float32
    assert arrival_us(data[32]) == pytest.approx(20.0, abs=0.003)
    for end in (0, 64):
        assert arrival_us(data[end]) == pytest.approx(math.hypot(30.0, 12.8) / 1.5, abs=0.003)


def test_off_plane_source_is_as_late_as_it_is_far_in_space() -> None:
    # Stage at 0, source on (3, 30 sin 20, 10 + 30 cos 20): 30 mm across the axis from the elements, 3 mm along it.
    b = math.radians(20.0)
    source = np.array([3.0, 30.0 * math.sin(b), 10.0 + 30.0 * math.cos(b)])
    data = simulate_channels(probe(), source, 0.0, rng(), snr_db=70.0, hearing=IN_PLANE)
    for i in (0, 20, 40, 64):
        x = (i - 32) * 0.4
        assert arrival_us(data[i]) == pytest.approx(math.sqrt((3.0 - x) ** 2 + 900.0) / 1.5, abs=0.003)
    # And the turn of the stage that finds it is r sin(b) against R + r cos(b).
    expected = math.atan2(30.0 * math.sin(b), 10.0 + 30.0 * math.cos(b))
    assert float(rotation_offset_rad(source, 0.0)) == pytest.approx(expected, abs=1e-12)


def test_crop_pulse_delay_flip_and_sound_speed() -> None:
    source = np.array([4.0, 0.0, 40.0])
    base = simulate_channels(probe(), source, 0.0, rng(), snr_db=70.0, hearing=IN_PLANE)
    shifted = simulate_channels(
        probe(t0_us=12.0, pulse_delay_us=0.7), source, 0.0, rng(), snr_db=70.0, hearing=IN_PLANE, samples=1000
    )
    flipped = simulate_channels(probe(flip=True), source, 0.0, rng(), snr_db=70.0, hearing=IN_PLANE)
    fast = simulate_channels(probe(), source, 0.0, rng(), snr_db=70.0, hearing=IN_PLANE, sound_speed_true_m_s=1600.0)
    for i in (5, 32, 60):
        assert arrival_us(shifted[i]) == pytest.approx(arrival_us(base[i]) - 12.0 + 0.7, abs=0.004)
        assert arrival_us(flipped[64 - i]) == pytest.approx(arrival_us(base[i]), abs=0.004)
        assert arrival_us(fast[i]) == pytest.approx(arrival_us(base[i]) * 1500 / 1600, abs=0.004)


def test_signal_to_noise_ratio_is_of_the_loudest_element() -> None:
    source = np.array([0.4, 0.0, 40.0])
    loud = simulate_channels(probe(), source, 0.0, rng(), snr_db=40.0, hearing=IN_PLANE)
    signal = loud - noise_channels(probe(), rng())  # the same generator: the same noise
    envelope = np.abs(hilbert(signal, axis=1)).max(axis=1)
    assert np.argmax(envelope) == 33
    assert 20 * math.log10(envelope.max() / math.sqrt(2.0)) == pytest.approx(40.0, abs=0.3)
    quiet = simulate_channels(probe(), source, 0.0, rng(), snr_db=0.0, hearing=IN_PLANE)
    assert (quiet[:, :600]).std() == pytest.approx(1.0, abs=0.02)
    # Elements hear less to the side.
    assert envelope[0] < 0.75 * envelope[33]


def test_a_reflection_is_a_later_copy_from_the_mirror_image() -> None:
    # 6 mm behind the source and 1.6 mm (4 elements) aside, half as loud; hypot(36, 3.2 or 4.8) from two elements.
    a = math.radians(20.0)
    source = np.array([0.0, 40.0 * math.sin(a), 40.0 * math.cos(a)])
    copy = Reflection(6.0, 1.6, -6.02)
    direct = simulate_channels(probe(), source, a, rng(), snr_db=60.0, hearing=IN_PLANE)
    both = simulate_channels(probe(), source, a, rng(), snr_db=60.0, hearing=IN_PLANE, artefacts=(copy,))
    alone = both - direct
    for i in (28, 36, 48):
        assert arrival_us(alone[i]) == pytest.approx(math.hypot(36.0, (i - 36) * 0.4) / 1.5, abs=0.003)
    envelope = np.abs(hilbert(alone, axis=1)).max()
    assert envelope == pytest.approx(0.5 * np.abs(hilbert(direct, axis=1)).max(), rel=0.01)


def test_pick_up_reaches_a_part_of_the_channels_at_one_time() -> None:
    source = np.array([0.0, 0.0, 40.0])
    direct = simulate_channels(probe(), source, 0.0, rng(), snr_db=10.0, hearing=IN_PLANE)
    signal = PickUp(7.3, 40.0, 0.0, (0.25, 0.5))
    both = simulate_channels(probe(t0_us=2.0), source, 0.0, rng(), snr_db=10.0, hearing=IN_PLANE, artefacts=(signal,))
    assert arrival_us(both[20]) == pytest.approx(5.3, abs=0.01)
    direct = simulate_channels(probe(t0_us=2.0), source, 0.0, rng(), snr_db=10.0, hearing=IN_PLANE)
    reached = np.flatnonzero(np.abs(both - direct).max(axis=1) > 0.0)
    assert reached.tolist() == list(range(16, 32))
    assert np.abs(hilbert(both[20])).max() == pytest.approx(math.sqrt(2.0) * 100.0, rel=0.05)


@pytest.mark.parametrize(("width_mm", "aside"), [(20.0, 0.0), (0.0, 1.0)])
def test_sound_of_the_face_is_flat_where_light_is_wide_and_runs_along_where_it_is_a_spot(
    width_mm: float, aside: float
) -> None:
    source = np.array([0.0, 0.0, 40.0])
    sound = FaceSound(70.0, 1.5, 0.8, width_mm)
    both = simulate_channels(probe(), source, 0.0, rng(), snr_db=0.0, hearing=IN_PLANE, artefacts=(sound,))
    for i in (32, 34, 37):
        distance = math.hypot(1.5, aside * ((i - 32) * 0.4 - 0.8))
        assert arrival_us(both[i]) == pytest.approx(distance / 1.5, abs=0.01)


def test_source_off_the_plane_is_softer_down_to_the_threshold() -> None:
    a = math.radians(6.0)  # the half width, as stage rotation
    source = np.array([0.0, 40.0 * math.sin(a), 40.0 * math.cos(a)])
    hearing = Hearing(elevation=Elevation(threshold=0.5))

    def level(scan_rad: float) -> float:
        data = simulate_channels(probe(), source, scan_rad, rng(), snr_db=60.0, hearing=hearing)
        return float(np.abs(hilbert(data - noise_channels(probe(), rng()), axis=1)).max())

    assert level(0.0) / level(a) == pytest.approx(0.5, abs=0.01)
    assert level(a / 2) / level(a) == pytest.approx(0.5**0.25, abs=0.01)
    assert level(2 * a) / level(a) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("asymmetry", [0.0, 0.6, 1.5, -0.4])
@pytest.mark.parametrize("phase_rad", [0.0, 0.6, math.pi / 2, 3.0])
def test_pulse_peaks_at_time_zero_whatever_its_shape(asymmetry: float, phase_rad: float) -> None:
    pulse = Pulse(asymmetry=asymmetry, phase_rad=phase_rad)
    time = np.linspace(-3.0, 3.0, 12001)
    envelope = np.abs(hilbert(pulse.waveform(time)))
    assert abs(time[np.argmax(envelope)]) <= 5.1e-4
    assert envelope.max() == pytest.approx(1.0, abs=0.03)
    assert np.abs(pulse.waveform(np.array([-pulse.support_us, pulse.support_us]))).max() < 1e-5


def test_pulse_has_the_bandwidth_it_says() -> None:
    time = np.linspace(-20.48, 20.475, 8192)
    spectrum = np.abs(np.fft.rfft(Pulse(centre_mhz=5.0, fractional_bandwidth=0.7, phase_rad=0.3).waveform(time)))
    frequency = np.fft.rfftfreq(time.size, 5e-3)
    above = frequency[spectrum > 0.5 * spectrum.max()]
    assert above.min() == pytest.approx(5.0 - 1.75, abs=0.03)
    assert above.max() == pytest.approx(5.0 + 1.75, abs=0.03)


def test_late_arrivals_are_cut_off_without_wrapping_round() -> None:
    source = np.array([0.0, 0.0, 40.0])
    data = simulate_channels(probe(), source, 0.0, rng(), snr_db=60.0, hearing=IN_PLANE, samples=795)
    noise = noise_channels(probe(), rng(), samples=795)
    assert np.abs((data - noise)[:, :700]).max() == 0.0
    assert np.abs((data - noise)[32, 785:]).max() > 10.0


def test_element_positions_turn_with_the_stage() -> None:
    positions = element_positions(probe(), math.radians(30.0))
    np.testing.assert_allclose(positions[0], [-12.8, 5.0, 10.0 * math.cos(math.radians(30.0))], atol=1e-12)
    np.testing.assert_allclose(element_positions(probe(flip=True), 0.3)[:, 0], -positions[:, 0], atol=1e-12)


def test_quantised_is_twelve_counts_a_unit_and_saturates() -> None:
    counts = quantised(np.array([[0.0, 1.0, -2.55, 1e6]], dtype=np.float32))
    assert counts.dtype == np.int16
    assert counts.tolist() == [[0, 12, -31, 32767]]


@pytest.mark.parametrize("true_speed", [1500.0, 1530.0])
def test_envelope_image_peaks_at_the_apparent_range(true_speed: float) -> None:
    b = math.radians(4.0)
    source = np.array([6.0, 28.0 * math.sin(b), 10.0 + 28.0 * math.cos(b)])
    image = simulate_envelope_image(
        probe(), source, 0.0, rng(), shape=(700, 200), snr_db=40.0, sound_speed_true_m_s=true_speed, hearing=IN_PLANE
    )
    depth, lateral = np.unravel_index(int(np.argmax(image)), image.shape)
    assert 10.0 + 0.05 * depth == pytest.approx(28.0 * 1500.0 / true_speed, abs=0.06)
    assert -20.0 + 0.2 * lateral == pytest.approx(6.0, abs=0.11)
    assert image.min() >= 0.0


def test_probes_without_sampling_are_refused() -> None:
    bare = ProbeModel(65, 0.4, False, 10.0, 1500.0, probe().sensitivity)
    with pytest.raises(ValueError, match=r"probe\.channels"):
        simulate_channels(bare, np.array([0.0, 0.0, 40.0]), 0.0, rng())
    with pytest.raises(ValueError, match=r"probe\.image"):
        simulate_envelope_image(bare, np.array([0.0, 0.0, 40.0]), 0.0, rng())


def spectrum_off_the_plane(angle_deg: float, element: ElementHeight | None) -> npt.NDArray[np.complex128]:
    """Of the middle element, without noise, of a source 60 mm away at an angle off the plane."""
    a = math.radians(angle_deg)
    source = np.array([0.0, 60.0 * math.sin(a), 10.0 + 60.0 * math.cos(a)])
    hearing = Hearing(elevation=None, element=element)
    heard = simulate_channels(probe(), source, 0.0, rng(), snr_db=40.0, samples=2400, hearing=hearing)
    return np.fft.rfft(heard[32].astype(np.float64) - noise_channels(probe(), rng(), 2400)[32])


@pytest.mark.parametrize("angle_deg", [0.0, 4.0, -8.0])
def test_an_element_with_a_height_averages_the_wave_over_it(angle_deg: float) -> None:
    # Far away, or where its lens focuses, it is the mean over H sin(angle) / c: a sinc of the frequency.
    frequency = np.fft.rfftfreq(2400, 1.0 / 40.0)
    band = (frequency > 3.0) & (frequency < 7.0)
    tall = spectrum_off_the_plane(angle_deg, ElementHeight(4.0, focus_mm=60.0))[band]
    point = spectrum_off_the_plane(angle_deg, None)[band]
    expected = np.sinc(frequency[band] * 4.0 * math.sin(math.radians(angle_deg)) / 1.5)
    np.testing.assert_allclose(np.abs(tall / point), np.abs(expected), atol=0.02)


def test_a_lens_brings_a_source_in_the_plane_together() -> None:
    # 10 mm high, 5 MHz at 20 mm: the edges are 0.6 mm farther than the middle, two wavelengths.
    a_source = np.array([0.0, 0.0, 30.0])
    levels = []
    for element in (None, ElementHeight(10.0, 20.0), ElementHeight(10.0)):
        hearing = Hearing(elevation=None, element=element)
        heard = simulate_channels(probe(), a_source, 0.0, rng(), snr_db=40.0, hearing=hearing)
        levels.append(float(np.abs(heard[32]).max()))
    assert levels[1] == pytest.approx(levels[0], rel=0.02)
    assert levels[2] < 0.7 * levels[0]


def test_an_element_with_a_height_has_no_other_loss_off_the_plane() -> None:
    with pytest.raises(ValueError, match="elevation has to be None"):
        Hearing(element=ElementHeight(5.0))
