"""The camera-move test as a whole: moves are found with the pair they begin at, and outliers are no moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgreg.camera_moves.bayes_filter import move_evidence
from fgreg.camera_moves.detector import CameraMove, find_camera_move
from fgreg.geometry.transforms import exp_so3, make_transform
from fgreg.model.measurements import Measurements
from fgreg.model.solve_config import SolveConfig
from tests.camera_move_cases import move_case, moved_session
from tests.forward import make_measurements

CONFIG = SolveConfig()
STEADY, SHIFT = np.eye(4), make_transform(np.eye(3), np.array([5.0, -5.0, 3.0]))


def _off(measurements: Measurements, place: int, x_mm: float) -> Measurements:
    """With one look's lateral position off."""
    pairs = list(measurements.pairs)
    pairs[place] = replace(pairs[place], look=replace(pairs[place].look, x_mm=pairs[place].look.x_mm + x_mm))
    return replace(measurements, pairs=tuple(pairs))


@pytest.mark.parametrize("first_hit", [True, False], ids=["first-hit", "window only"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_shift_is_found_with_the_pair_it_begins_at(seed: int, *, first_hit: bool) -> None:
    model, measurements, _ = moved_session(seed, SHIFT, 15, 8, first_hit=first_hit)
    found = find_camera_move(move_case(measurements, model), model, CONFIG)
    assert isinstance(found, CameraMove)
    assert abs(found.first - 15) <= 1
    assert found.epoch == 0


@pytest.mark.parametrize(
    ("turn_deg", "shift_mm"),
    [
        ((0.0, 12.0, 0.0), (0.0, 0.0, 0.0)),
        ((0.0, 0.0, 0.0), (20.0, -10.0, 0.0)),
        ((15.0, -6.0, 18.0), (25.0, 5.0, -15.0)),
    ],
)
@pytest.mark.parametrize(("before", "after"), [(15, 6), (6, 15)])
def test_large_moves_are_found_late_and_early(
    turn_deg: tuple[float, float, float], shift_mm: tuple[float, float, float], before: int, after: int
) -> None:
    motion = make_transform(exp_so3(np.radians(turn_deg)), np.array(shift_mm))
    model, measurements, _ = moved_session(21, motion, before, after)
    found = find_camera_move(move_case(measurements, model), model, CONFIG)
    assert isinstance(found, CameraMove)
    assert abs(found.first - before) <= 1


def test_a_move_long_ago_is_found_as_well() -> None:
    model, measurements, _ = moved_session(2, make_transform(np.eye(3), np.array([0.0, 2.0, 1.0])), 30, 40)
    found = find_camera_move(move_case(measurements, model), model, CONFIG)
    assert isinstance(found, CameraMove)
    assert abs(found.first - 30) <= 2


def test_looks_at_one_pm_are_one_pm_and_the_move_is_before_its_first() -> None:
    model, measurements, _ = moved_session(3, SHIFT, 12, 5)
    twice = [
        replace(pair, t=pair.t + dt, marker=replace(pair.marker, id=pair.marker.id + 5000 * dt))
        for pair in measurements.pairs
        for dt in (0, 1)
    ]
    case = move_case(replace(measurements, pairs=tuple(twice)), model)
    assert case.places[:3] == (0, 2, 4)
    found = find_camera_move(case, model, CONFIG)
    assert isinstance(found, CameraMove)
    assert found.first == 24


def test_outliers_since_the_move_raise_its_odds() -> None:
    model, measurements, _ = moved_session(4, make_transform(np.eye(3), np.array([0.0, 14.0, 0.0])), 15, 4)
    case = move_case(measurements, model)
    assert not case.inlier[15:].any()
    found = find_camera_move(case, model, CONFIG)
    assert isinstance(found, CameraMove)
    assert found.first == 15


@pytest.mark.parametrize("place", [3, 10, 19])
def test_one_gross_outlier_is_no_move(place: int) -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(5), pairs=20)
    case = move_case(_off(measurements, place, 15.0), model)
    assert not case.inlier[place]
    assert find_camera_move(case, model, CONFIG) is None


def test_an_outlier_before_the_move_does_not_hide_it() -> None:
    model, measurements, _ = moved_session(1, SHIFT, 15, 6)
    found = find_camera_move(move_case(_off(measurements, 9, -12.0), model), model, CONFIG)
    assert isinstance(found, CameraMove)
    assert abs(found.first - 15) <= 1


def test_steady_data_need_no_full_test(monkeypatch: pytest.MonkeyPatch) -> None:
    tested = []

    def counted(*of: object, **more: object) -> object:
        tested.append(of)
        return move_evidence(*of, **more)  # type: ignore[arg-type]

    monkeypatch.setattr("fgreg.camera_moves.detector.move_evidence", counted)
    for seed in range(8):
        model, measurements, _ = make_measurements(np.random.default_rng([seed, 31]), pairs=25)
        assert find_camera_move(move_case(measurements, model), model, CONFIG) is None
    assert len(tested) <= 2


def test_six_pairs_are_too_few_for_a_test() -> None:
    model, measurements, _ = moved_session(1, SHIFT, 3, 3)
    assert find_camera_move(move_case(measurements, model), model, CONFIG) is None


def test_the_prior_of_the_registration_applies_to_the_first_pms_only() -> None:
    """A motion prior on the epoch's registration must not hide an early move: it is about the first side."""
    model, measurements, truth = moved_session(3, SHIFT, 5, 13)
    case = move_case(measurements, model)
    assert case.known is not None
    state = case.known.state
    information = np.diag([1.0 / 0.002**2] * 3 + [1.0 / 0.3**2] * 3)
    prior = replace(state, rotation=truth[0].trus_T_camera[0][None, None, :3, :3])
    prior = replace(prior, translation_mm=truth[0].trus_T_camera[0][None, None, :3, 3])
    hessian, gradient = case.known.hessian.copy(), case.known.gradient.copy()
    back = state.rotation[0, 0].T
    turn = back @ prior.rotation[0, 0]
    step = np.r_[
        0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]),
        back @ (prior.translation_mm[0, 0] - state.translation_mm[0, 0]),
    ]
    hessian[:6, :6] += information
    gradient[:6] -= information @ step
    tied = replace(case, known=replace(case.known, hessian=hessian, gradient=gradient))
    found = find_camera_move(tied, model, CONFIG)
    assert isinstance(found, CameraMove)
    assert abs(found.first - 5) <= 1
