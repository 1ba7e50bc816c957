"""A source in channel data is found where it is, with an honest covariance."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest

from fgreg.detection.photoacoustic import locate_in_channels, locate_in_frame
from fgreg.detection.results import PaFind
from fgreg.detection.wavefront_fit import path_jacobian, path_mm
from fgreg.geometry.transforms import as_float_array
from fgreg.model.probe_model import ChannelModel, ProbeModel, SensitivityModel
from fgreg.simulation.acoustics import Hearing, Pulse, quantised, simulate_channels

IN_PLANE = Hearing(elevation=None)


def probe_with(t0_us: float = 10.0, pulse_delay_us: float = 0.0, flip: bool = False, elements: int = 128) -> ProbeModel:
    sensitivity = SensitivityModel(as_float_array([30.0]), as_float_array([0.1]), 0.005)
    return ProbeModel(elements, 0.43, flip, 10.0, 1540.0, sensitivity, ChannelModel(40.0, t0_us, pulse_delay_us), None)


def heard(
    probe: ProbeModel,
    x_mm: float,
    range_mm: float,
    snr_db: float,
    seed: int,
    pulse: Pulse | None = None,
    samples: int = 800,
) -> npt.NDArray[np.float32]:
    source = np.array([x_mm, 0.0, probe.radius_mm + range_mm])
    rng = np.random.default_rng(seed)
    return simulate_channels(probe, source, 0.0, rng, pulse, snr_db, samples, None, IN_PLANE)


def found(frame: npt.NDArray[np.generic], probe: ProbeModel) -> PaFind:
    answer = locate_in_channels(frame, probe)
    assert isinstance(answer, PaFind), answer
    return answer


def many(snr_db: float, frames: int, seed: int) -> tuple[npt.NDArray[np.float64], list[float]]:
    """Errors (frames, 2) in x and range and squared Mahalanobis distances of random sources, all found."""
    errors, distances = [], []
    rng = np.random.default_rng(seed)
    for number in range(frames):
        x_mm, range_mm = rng.uniform(-20.0, 20.0), rng.uniform(15.0, 40.0)
        pulse = Pulse(rng.uniform(3.0, 7.0), rng.uniform(0.5, 0.8), 0.0, rng.uniform(0.0, 2 * math.pi))
        probe = probe_with(8.0 if range_mm < 25.0 else 15.0)
        find = found(heard(probe, x_mm, range_mm, snr_db, seed + number, pulse), probe)
        error = np.array([find.x_mm - x_mm, find.range_mm - range_mm])
        errors.append(error)
        distances.append(float(error @ np.linalg.solve(find.covariance, error)))
    return np.array(errors), distances


def test_path_of_a_3_4_5_triangle() -> None:
    assert path_mm(3.0, 4.0, 1.0, np.array([0.0, 3.0, 6.0])) == pytest.approx([5.0, 4.0, 5.0])
    # Tissue with twice the sound speed halves the lateral distance computed with the assumed one.
    assert path_mm(6.0, 4.0, 2.0, np.array([0.0])) == pytest.approx([5.0])


def test_path_jacobian_agrees_with_differences() -> None:
    elements = np.linspace(-20.0, 20.0, 9)
    rng = np.random.default_rng(3)
    for _ in range(5):
        state = np.array([rng.uniform(-20, 20), rng.uniform(10, 60), rng.uniform(0.95, 1.05)])
        columns = []
        for k in range(3):
            step = 1e-6 * np.eye(3)[k]
            ahead, behind = state + step, state - step
            difference = path_mm(ahead[0], ahead[1], ahead[2], elements) - path_mm(
                behind[0], behind[1], behind[2], elements
            )
            columns.append(difference / 2e-6)
        assert path_jacobian(state[0], state[1], state[2], elements) == pytest.approx(
            np.column_stack(columns), abs=1e-6
        )


def test_without_noise_the_source_is_where_it_is_to_a_micrometre() -> None:
    probe = probe_with()
    for x_mm, range_mm in ((0.0, 20.0), (-7.31, 25.17), (13.0, 31.9)):
        find = found(heard(probe, x_mm, range_mm, 120.0, 1), probe)
        assert find.x_mm == pytest.approx(x_mm, abs=1e-3)
        assert find.range_mm == pytest.approx(range_mm, abs=1e-3)


def test_accuracy_at_20_db() -> None:
    errors, _ = many(20.0, 25, 100)
    rms = np.sqrt((errors**2).mean(axis=0))
    assert rms[0] < 0.03
    assert rms[1] < 0.02


def test_accuracy_and_honest_covariance_at_0_db() -> None:
    errors, distances = many(0.0, 60, 200)
    rms = np.sqrt((errors**2).mean(axis=0))
    assert rms[0] < 0.1
    assert rms[1] < 0.05
    # Mean of 60 chi-square variables of 2 degrees of freedom: 2 +- 0.26.
    assert 1.2 < float(np.mean(distances)) < 3.0


def test_pulse_delay_is_taken_off_the_range() -> None:
    # A wave that is late by 1 us is not 1.54 mm farther away.
    probe = probe_with(pulse_delay_us=1.0)
    find = found(heard(probe, 4.0, 22.0, 30.0, 5), probe)
    assert find.range_mm == pytest.approx(22.0, abs=0.02)
    ignoring = found(heard(probe, 4.0, 22.0, 30.0, 5), probe_with(pulse_delay_us=0.0))
    assert ignoring.range_mm == pytest.approx(22.0 + 1.54, abs=0.05)


def test_arrival_is_the_maximum_of_the_envelope_of_a_pulse_that_is_not_symmetric() -> None:
    probe = probe_with()
    errors = [
        found(heard(probe, 4.0, 22.0, 20.0, seed, Pulse(centre, 0.6, 0.5)), probe).range_mm - 22.0
        for seed, centre in enumerate((3.0, 4.0, 5.0, 6.0, 7.0))
    ]
    assert float(np.sqrt(np.mean(np.square(errors)))) < 0.02


def test_a_flipped_probe_locates_the_source_on_the_same_side() -> None:
    straight, flipped = probe_with(), probe_with(flip=True)
    frame = heard(straight, -7.0, 25.0, 20.0, 6)
    assert found(frame, straight).x_mm == pytest.approx(-7.0, abs=0.03)
    assert found(frame[::-1], flipped).x_mm == pytest.approx(-7.0, abs=0.03)
    assert found(frame, flipped).x_mm == pytest.approx(7.0, abs=0.03)


def test_integer_samples_are_as_good_as_floating_point() -> None:
    probe = probe_with()
    frame = heard(probe, 3.0, 25.0, 15.0, 7)
    real, whole = found(frame, probe), found(quantised(frame), probe)
    assert whole.x_mm == pytest.approx(real.x_mm, abs=0.005)
    assert whole.range_mm == pytest.approx(real.range_mm, abs=0.005)
    # 12 counts per noise sigma: the amplitude is in the frame's units.
    assert whole.amplitude == pytest.approx(12.0 * real.amplitude, rel=0.02)


@pytest.mark.parametrize("snr_db", [20.0, 10.0, 0.0])
def test_signal_to_noise_ratio_is_reported(snr_db: float) -> None:
    probe = probe_with()
    reported = [found(heard(probe, 2.0, 25.0, snr_db, seed), probe).snr_db for seed in range(8)]
    assert float(np.mean(reported)) == pytest.approx(snr_db, abs=1.5)


def test_a_source_at_the_end_of_the_array() -> None:
    probe = probe_with()
    find = found(heard(probe, 27.0, 25.0, 10.0, 8), probe)
    assert find.x_mm == pytest.approx(27.0, abs=5.0 * math.sqrt(find.covariance[0, 0]))
    assert find.range_mm == pytest.approx(25.0, abs=5.0 * math.sqrt(find.covariance[1, 1]))
    middle = found(heard(probe, 0.0, 25.0, 10.0, 8), probe)
    assert find.covariance[0, 0] > middle.covariance[0, 0]


def test_dead_channels_offsets_and_a_screaming_channel_do_no_harm() -> None:
    probe = probe_with()
    rng = np.random.default_rng(9)
    frame = heard(probe, 5.0, 25.0, 10.0, 9)
    clean = found(frame, probe)
    frame[rng.choice(128, 20, replace=False)] = 0.0
    frame[[40, 90]] *= 40.0
    frame += rng.normal(0.0, 50.0, (128, 1)).astype(np.float32)
    find = found(frame, probe)
    assert find.x_mm == pytest.approx(5.0, abs=0.03)
    assert find.range_mm == pytest.approx(25.0, abs=0.04)
    assert find.elements_used is not None
    assert clean.elements_used is not None
    assert find.elements_used < clean.elements_used


@pytest.mark.parametrize(("sampling_mhz", "samples"), [(20.0, 400), (62.5, 1250), (100.0, 2000)])
def test_other_sampling_rates(sampling_mhz: float, samples: int) -> None:
    base = probe_with()
    probe = ProbeModel(64, 0.43, False, 10.0, 1540.0, base.sensitivity, ChannelModel(sampling_mhz, 10.0, 0.0), None)
    find = found(heard(probe, 3.0, 25.0, 15.0, 10, samples=samples), probe)
    assert find.x_mm == pytest.approx(3.0, abs=0.03)
    assert find.range_mm == pytest.approx(25.0, abs=0.03)


def test_frame_that_is_no_frame_of_this_probe() -> None:
    probe = probe_with()
    frame = np.ones((128, 800), dtype=np.float32)
    with pytest.raises(ValueError, match="transposed"):
        locate_in_channels(frame.T, probe)
    with pytest.raises(ValueError, match=r"\(100, 800\).*128 elements"):
        locate_in_frame(frame[:100], probe)
    frame[3, 5] = np.nan
    with pytest.raises(ValueError, match="1 entries that are not finite"):
        locate_in_channels(frame, probe)
    with pytest.raises(ValueError, match="two dimensions"):
        locate_in_frame(np.ones(5), probe)
    bare = ProbeModel(128, 0.43, False, 10.0, 1540.0, probe.sensitivity)
    with pytest.raises(ValueError, match=r"probe\.channels"):
        locate_in_channels(np.ones((128, 800)), bare)
    with pytest.raises(ValueError, match=r"neither.*probe\.image"):
        locate_in_frame(np.ones((128, 800)), bare)
