"""Queries at camera rate: the answers of the session's own machinery, whatever was heard."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import fgreg.graph.sites
from fgreg.config import SolveConfig
from fgreg.estimate import TrackEstimate, Verdict
from fgreg.measurements import Track
from fgreg.sensitivity import interval_moments, sensitivity_priors, window_shapes
from fgreg.tracking import track
from fgreg.tracking.windows import interpolated, interval_derivatives, look_window
from tests import tracking_reference
from tests.forward import make_measurements, make_session
from tests.track_cases import Solved, held_out, query_of, solved

ANGLE_SIGMAS, SIGMA_SHARE = 0.02, 0.02


def _agree(query: Track, session: Solved) -> TrackEstimate:
    """Both answers, which have to agree; the fast one."""
    slow, fast = tracking_reference.track(query, session), track(query, session.snapshot)
    assert slow.stage_rad is not None
    assert slow.sigma_rad is not None
    assert slow.lambda_mm is not None
    assert fast.stage_rad is not None
    assert fast.sigma_rad is not None
    assert fast.lambda_mm is not None
    assert abs(fast.stage_rad - slow.stage_rad) < ANGLE_SIGMAS * slow.sigma_rad
    assert fast.sigma_rad == pytest.approx(slow.sigma_rad, rel=SIGMA_SHARE)
    assert fast.lambda_mm == pytest.approx(slow.lambda_mm, abs=0.1)
    return fast


@pytest.fixture(autouse=True)
def _settled_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reference stops refining its sites at 2 % of a sigma, as far off as the answers may differ here."""
    monkeypatch.setattr(fgreg.graph.sites, "SETTLED", 1e-4)
    monkeypatch.setattr(fgreg.graph.sites, "ROUNDS", 100)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("sweeps", [True, False])
def test_one_look(seed: int, sweeps: bool) -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(seed), pairs=29)
    used, out = held_out(measurements, 4)
    session = solved(used, model)
    for pairs in out:
        fast = _agree(query_of(pairs, looks=1, sweeps=sweeps), session)
        assert fast.reason == ""


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("own_markers", [True, False])
def test_several_looks_with_amplitudes(seed: int, own_markers: bool) -> None:
    rng = np.random.default_rng(seed)
    model = make_session(curve=True)
    options: dict[str, Any] = {"looks_per_pm": 3, "look_spacing_deg": 2.0, "amplitude_noise": 0.05}
    model, measurements, _ = make_measurements(rng, session=model, pairs=15, share_marker=not own_markers, **options)
    used, out = held_out(measurements, 3)
    session = solved(used, model)
    for pairs in out:
        assert len({pair.marker.id for pair in pairs}) == (3 if own_markers else 1)
        one, three = (_agree(query_of(pairs, looks=looks), session) for looks in (1, 3))
        assert one.sigma_rad is not None
        assert three.sigma_rad is not None
        assert three.sigma_rad < one.sigma_rad


@pytest.mark.parametrize("seed", range(2))
def test_several_looks_without_amplitudes(seed: int) -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(seed), pairs=15, looks_per_pm=2)
    used, out = held_out(measurements, 3)
    session = solved(used, model)
    for pairs in out:
        assert _agree(query_of(pairs, looks=2), session).reason == ""


def test_sound_speed_radius_and_bias_as_variables() -> None:
    model = make_session()
    model = replace(model, noise=replace(model.noise, marker_bias_mm=0.5))
    model, measurements, _ = make_measurements(np.random.default_rng(1), session=model, pairs=23)
    used, out = held_out(measurements, 3)
    session = solved(used, model, SolveConfig(estimate_sound_speed=True, estimate_radius=True))
    assert session.posterior.columns.bias is not None
    assert session.posterior.columns.radius is not None
    for pairs in out:
        assert _agree(query_of(pairs, looks=1), session).reason == ""


def test_windows_as_gaussians() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(2), pairs=23)
    used, out = held_out(measurements, 3)
    session = solved(used, model, SolveConfig(window_shape=False))
    for pairs in out:
        assert _agree(query_of(pairs, looks=1), session).reason == ""


def test_each_epoch_by_its_own_registration() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(3), pairs=40, epochs=2)
    first = [pair for pair in measurements.pairs if pair.epoch == 0][-1]
    used, out = held_out(measurements, 1)
    used = replace(used, pairs=tuple(pair for pair in used.pairs if pair.pm != first.pm))
    session = solved(used, model)
    for pairs in ([first], out[0]):
        assert _agree(query_of(pairs, looks=1), session).reason == ""


def test_a_look_off_the_beam_by_much_is_still_answered() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(4), pairs=26)
    used, out = held_out(measurements, 1)
    snapshot = solved(used, model).snapshot
    query = query_of(out[0], looks=1)
    for offset in (-15.0, -5.0, 5.0, 15.0, 40.0):
        look = replace(query.looks[0], range_mm=query.looks[0].range_mm + offset)
        answer = track(replace(query, looks=(look,)), snapshot)
        assert answer.stage_rad is not None
        assert answer.sigma_rad is not None
        assert 0.0 < answer.sigma_rad < 0.2


def test_a_refused_epoch_is_not_answered_and_says_why() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(5), pairs=20)
    used, out = held_out(measurements, 1)
    whole, query = solved(used, model).snapshot, query_of(out[0], looks=1)
    (epoch,) = whole.epochs
    reasons = ("predicted error 9.1 mm", "")
    epochs = tuple(replace(epoch, number=k, verdict=Verdict.REFUSED, reason=why) for k, why in enumerate(reasons))
    snapshot = replace(whole, epochs=epochs)
    answer = track(query, snapshot)
    assert answer.stage_rad is None
    assert answer.reason == "the registration of camera epoch 0 is refused: predicted error 9.1 mm"
    other = track(replace(query, epoch=1), snapshot)
    assert other.reason == "the registration of camera epoch 1 is refused"
    assert track(replace(query, epoch=7), snapshot).reason == "camera epoch 7 has no registration"


def test_a_wider_registration_widens_the_answer() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(6), pairs=26)
    used, out = held_out(measurements, 1)
    snapshot, query = solved(used, model).snapshot, query_of(out[0], looks=1, sweeps=False)
    epoch = snapshot.epochs[0]
    wide = replace(snapshot, epochs=(replace(epoch, covariance=9.0 * epoch.covariance),), prepared={})
    narrow_sigma, wide_sigma = track(query, snapshot).sigma_rad, track(query, wide).sigma_rad
    assert narrow_sigma is not None
    assert wide_sigma is not None
    assert wide_sigma > 1.2 * narrow_sigma


def test_windows_in_floats_are_those_of_arrays() -> None:
    rng = np.random.default_rng(7)
    model, measurements, _ = make_measurements(rng, pairs=30)
    looks = [replace(pair.look, sweep=int(rng.integers(-1, 2))) for pair in measurements.pairs]
    sensitivity = model.probe.sensitivity
    for step in (math.radians(2.0), math.radians(13.0)):
        priors, shapes = sensitivity_priors(looks, model.probe, step), window_shapes(looks, model.probe, step)
        for i, look in enumerate(looks):
            half_width = interpolated(look.range_mm, sensitivity.depth_mm.tolist(), sensitivity.half_width_rad.tolist())
            window = look_window(look, half_width, step, 0.0)
            assert window.centre == pytest.approx(priors.centre_rad[i])
            assert window.gain == priors.edge_gain[i]
            assert window.sigma == pytest.approx(priors.sigma_rad[i])
            assert (window.low, window.high) == pytest.approx((shapes.low_rad[i], shapes.high_rad[i]))
            assert window.soft == pytest.approx(shapes.soft_rad[i])


@pytest.mark.parametrize("scale", [1e-3, 1.0, 30.0])
def test_interval_derivatives_in_floats_are_those_of_arrays(scale: float) -> None:
    rng = np.random.default_rng(8)
    for _ in range(300):
        low = float(rng.normal()) * scale
        high, sigma = low + float(10 ** rng.uniform(-2, 1)), float(10 ** rng.uniform(-1.5, 1))
        slope, curvature = interval_moments(low, high, sigma)
        fast = interval_derivatives(low, high, sigma)
        size = 1.0 + abs(float(slope)) * sigma
        assert fast[0] * sigma == pytest.approx(float(slope) * sigma, abs=1e-7 * size)
        assert fast[1] * sigma**2 == pytest.approx(float(curvature) * sigma**2, abs=1e-7 * size**2)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_interval_derivatives_far_out_stay_finite(sign: float) -> None:
    low, high = sorted((sign * 500.0, sign * 501.0))
    slope, curvature = interval_derivatives(low, high, 1.0)
    # Nearly all of what is left sits at the nearer end: the mean is pulled there.
    assert slope == pytest.approx(sign * 500.0, rel=1e-4)
    assert 0.0 <= curvature <= 1.0 + 1e-6
