"""Queries with the PM detected: the results of the session's own solve, for any looks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fgreg.geometry.rig import Constant
from fgreg.model.estimate import TrackEstimate, Verdict
from fgreg.model.measurements import Track
from fgreg.model.solve_config import SolveConfig
from fgreg.tracking.query import track
from fgreg.tracking.snapshot import make_snapshot
from tests import tracking_reference
from tests.forward import make_measurements, make_session
from tests.track_cases import Solved, held_out, query_of, solved

ANGLE_SIGMAS, SIGMA_SHARE = 0.02, 0.02


def _agree(query: Track, session: Solved) -> TrackEstimate:
    """The result of a query, which has to agree with the reference."""
    expected, answer = tracking_reference.track(query, session), track(query, session.snapshot)
    assert expected.stage_rad is not None
    assert expected.sigma_rad is not None
    assert expected.lambda_mm is not None
    assert answer.stage_rad is not None
    assert answer.sigma_rad is not None
    assert answer.lambda_mm is not None
    assert abs(answer.stage_rad - expected.stage_rad) < ANGLE_SIGMAS * expected.sigma_rad
    assert answer.sigma_rad == pytest.approx(expected.sigma_rad, rel=SIGMA_SHARE)
    assert answer.lambda_mm == pytest.approx(expected.lambda_mm, abs=0.1)
    return answer


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("sweeps", [True, False])
def test_one_look(seed: int, sweeps: bool) -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(seed), pairs=29)
    used, out = held_out(measurements, 4)
    session = solved(used, model)
    for pairs in out:
        answer = _agree(query_of(pairs, looks=1, sweeps=sweeps), session)
        assert answer.reason == ""


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
    estimated = {Constant.MARKER_BIAS_X, Constant.SOUND_SPEED, Constant.RADIUS}
    assert estimated <= set(session.posterior.columns.constants)
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


KINDS: dict[str, dict[str, Any]] = {
    "first hits": {},
    "window only": {"first_hit": False},
    "ladders": {"looks_per_pm": 3, "look_spacing_deg": 2.0},
    "two epochs": {"epochs": 2},
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_result_is_that_of_a_solve_with_the_pm_in_it(kind: str) -> None:
    for seed in range(2):
        model, measurements, truth = make_measurements(np.random.default_rng(seed), pairs=24, **KINDS[kind])
        used, out = held_out(measurements, 2)
        before = tracking_reference.optimum_of(used, model, truth)
        epochs = tuple(range(len(measurements.epochs)))
        snapshot = make_snapshot(
            model, SolveConfig(), before.state, before.covariance, before.problem.columns, epochs,
            origin_shift_mm=0.0, surface=None, causal=False,
        )  # fmt: skip
        for pairs in out:
            answer = track(query_of(pairs, looks=len(pairs)), snapshot)
            after = tracking_reference.optimum_of(replace(used, pairs=(*used.pairs, *pairs)), model, truth)
            angle, sigma = after.plane_angle(pairs[0].pm)
            assert answer.stage_rad is not None
            # Apart only by where the session is linearised.
            assert abs(model.stage.scan_from_device(answer.stage_rad) - angle) < 0.03 * sigma
            assert answer.sigma_rad == pytest.approx(sigma, rel=0.02)


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
    wide = replace(snapshot, epochs=(replace(epoch, covariance=9.0 * epoch.covariance),))
    narrow_sigma, wide_sigma = track(query, snapshot).sigma_rad, track(query, wide).sigma_rad
    assert narrow_sigma is not None
    assert wide_sigma is not None
    assert wide_sigma > 1.2 * narrow_sigma
