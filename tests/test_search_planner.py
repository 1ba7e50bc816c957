"""The search for a PM: steps that skip no window, few positions, an honest sigma, and an end where there is no PM."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fgreg.search.belief import Belief
from fgreg.search.detection_model import DetectionModel
from fgreg.search.planner import (
    Found,
    NotFound,
    Phase,
    Prediction,
    SearchPlanner,
    SearchSettings,
    Step,
    Turn,
    best_position,
    sweep_positions,
)
from tests.forward import make_session

LOW, HIGH = math.radians(-35.0), math.radians(35.0)
THRESHOLD = 1.0


def _model() -> DetectionModel:
    return DetectionModel.of_session(make_session(curve=True).probe.sensitivity, THRESHOLD)


def _amplitude(pm_deg: float, peak: float, scan_rad: float, rng: np.random.Generator | None = None) -> float | None:
    """Amplitude of a probe with a window of +-6 deg, independent of the planner's model."""
    off = pm_deg - math.degrees(scan_rad)
    received = peak * 2.0 ** (-((off / 6.0) ** 2)) * (1.0 + (0.05 * rng.standard_normal() if rng else 0.0))
    return received if received >= THRESHOLD else None


def _search(
    pm_deg: float,
    peak: float,
    rng: np.random.Generator,
    prediction: Prediction | None = None,
    settings: SearchSettings | None = None,
    model: DetectionModel | None = None,
) -> tuple[Step, list[Turn]]:
    planner = SearchPlanner(model or _model(), LOW, HIGH, 0.0, prediction, settings)
    turns = []
    while isinstance(step := planner.next(), Turn):
        turns.append(step)
        planner.add_look(step.scan_rad, _amplitude(pm_deg, peak, step.scan_rad, rng))
    return step, turns


def test_no_pm_fits_between_the_steps_of_a_sweep() -> None:
    reach = math.radians(5.7)
    for low, high in ((-35.0, 35.0), (-3.0, 3.0), (-10.0, 47.3)):
        positions = sweep_positions(math.radians(low), math.radians(high), reach, 0.0)
        angles = np.radians(np.linspace(low, high, 5000))
        assert np.abs(angles[:, None] - np.array(positions)).min(axis=1).max() <= reach + 1e-12
        assert np.abs(np.diff(positions)).max(initial=0.0) <= 2.0 * reach + 1e-12


@pytest.mark.parametrize(("stands_deg", "first_deg"), [(-20.0, -30.0), (20.0, 30.0)])
def test_sweep_begins_at_the_nearer_end_and_comes_back_half_a_step_aside(stands_deg: float, first_deg: float) -> None:
    positions = np.degrees(sweep_positions(LOW, HIGH, math.radians(5.7), math.radians(stands_deg), passes=2))
    assert positions[0] == pytest.approx(first_deg)
    assert positions[6] == pytest.approx(-first_deg)
    assert positions[7] == pytest.approx(-1.0 * first_deg / 30.0 * 35.0)
    np.testing.assert_allclose(np.abs(np.diff(positions[7:])), 10.0)


def test_weakest_pm_within_the_stated_window_is_detected_in_the_first_sweep() -> None:
    positions = sweep_positions(LOW, HIGH, _model().reach_rad, 0.0)
    assert len(positions) == 7
    for pm_deg in np.linspace(-35.0, 35.0, 1401):
        assert any(_amplitude(float(pm_deg), 2.0, position) for position in positions), pm_deg


def test_cold_and_registered_searches_are_short_and_right() -> None:
    rng = np.random.default_rng(5)
    model = _model()
    cold, registered, errors = [], [], []
    for _ in range(30):
        pm, peak = float(rng.uniform(-35, 35)), float(np.exp(rng.uniform(math.log(2.0), math.log(8.0))))
        step, _ = _search(pm, peak, rng, model=model)
        assert isinstance(step, Found)
        cold.append(step.positions)
        errors.append((math.degrees(step.scan_rad) - pm) / math.degrees(step.sigma_rad))
        guess = Prediction(math.radians(float(np.clip(pm + rng.normal(), -35, 35))), math.radians(1.0))
        step, turns = _search(pm, peak, rng, guess, model=model)
        assert isinstance(step, Found)
        assert turns[0] == Turn(guess.scan_rad, Phase.PREDICTED, turns[0].reason)
        registered.append(step.positions)
        errors.append((math.degrees(step.scan_rad) - pm) / math.degrees(step.sigma_rad))
    assert np.mean(cold) <= 7.0
    assert np.mean(registered) <= 3.1
    assert np.abs(errors).max() < 3.0
    assert 0.3 < np.sqrt(np.mean(np.square(errors))) < 1.2


def test_planning_uses_silence_too() -> None:
    belief = Belief.flat(_model(), LOW, HIGH)
    after = belief.after(0.0, None)
    near = np.abs(after.angle_rad) < math.radians(2.0)
    far = np.abs(after.angle_rad) > math.radians(20.0)
    assert after.angle_weight()[near].max() < 0.5 * after.angle_weight()[far].min()


def test_two_looks_give_the_angle_computed_by_hand() -> None:
    # log(a1 / a2) = -ln 2 ((p - s1)^2 - (p - s2)^2) / 36 is linear in p: 0.1155 per deg for looks 6 deg apart
    model = replace(_model(), width_sigma=0.0)
    belief = Belief.flat(model, LOW, HIGH)
    for scan_deg in (-2.0, 4.0):
        scan = math.radians(scan_deg)
        belief = belief.after(scan, _amplitude(2.5, 6.0, scan))
    expected_sigma = 0.05 * math.sqrt(2.0) / (2.0 * math.log(2.0) * 6.0 / 36.0)
    assert math.degrees(belief.best_rad()) == pytest.approx(2.5, abs=0.02)
    assert math.degrees(belief.sigma_rad()) == pytest.approx(expected_sigma, rel=0.15)


def test_expected_sigma_is_the_average_after_a_look() -> None:
    rng = np.random.default_rng(11)
    model = _model()
    belief = Belief.flat(model, LOW, HIGH).after(0.0, 3.0).after(math.radians(6.0), 2.0)
    candidates = np.radians([-6.0, 0.0, 9.0])
    expected = belief.expected_sigma(candidates)
    near = np.abs(belief.angle_rad - belief.best_rad()) < 3.0 * belief.sigma_rad()  # lapses left out
    weight = np.where(near, belief.angle_weight(), 0.0)
    angle_at = rng.choice(belief.angle_rad.size, size=300, p=weight / weight.sum())
    for candidate, sigma in zip(candidates, expected, strict=True):
        squares = []
        for j in angle_at:
            row = belief.weight[j] / belief.weight[j].sum()
            log_peak = rng.choice(belief.log_peak, p=row)
            rotation = belief.angle_rad[j] - candidate
            heard = (
                log_peak + float(model.gain_log(rotation)) + float(model.noise_log(rotation)) * rng.standard_normal()
            )
            after = belief.after(float(candidate), math.exp(heard) if heard >= 0.0 else None)
            squares.append((after.best_rad() - belief.angle_rad[j]) ** 2)
        assert sigma == pytest.approx(math.sqrt(np.mean(squares)), rel=0.25)


def test_of_positions_about_as_good_the_nearest_is_taken() -> None:
    candidates = np.array([-1.0, 0.0, 1.0, 2.0])
    assert best_position(candidates, np.array([1.0, 1.5, 1.05, 1.0]), stands_rad=1.4) == 1.0
    assert best_position(candidates, np.array([1.0, 1.5, 1.30, 1.2]), stands_rad=1.4) == -1.0


def test_field_without_a_pm_is_given_up_after_two_sweeps() -> None:
    step, turns = _search(0.0, 0.1, np.random.default_rng(0))
    assert isinstance(step, NotFound)
    assert step.positions == len(turns) == 7 + 8
    assert {turn.phase for turn in turns} == {Phase.SWEEP}
    assert "nothing detected between -35.0 and 35.0 deg in 2 sweeps" in step.reason


def test_weaker_pm_than_the_session_promises_is_found_by_the_second_sweep() -> None:
    step, turns = _search(-25.0, 1.3, np.random.default_rng(2))
    assert isinstance(step, Found)
    assert math.degrees(step.scan_rad) == pytest.approx(-25.0, abs=1.0)
    assert len(turns) > 7


def test_wrong_prediction_never_becomes_a_sweep_of_the_field() -> None:
    guess = Prediction(math.radians(-20.0), math.radians(1.0))
    step, turns = _search(25.0, 4.0, np.random.default_rng(1), guess)
    assert isinstance(step, NotFound)
    assert "search the field" in step.reason
    assert max(abs(math.degrees(turn.scan_rad) + 20.0) for turn in turns) <= 3.5 + 5.7 + 1e-9


def test_pm_detected_from_outside_the_predicted_range_is_not_forced_into_it() -> None:
    for seed in range(6):
        guess = Prediction(0.0, math.radians(1.0))
        step, _ = _search(6.0 + seed, 6.0, np.random.default_rng(seed), guess)
        if isinstance(step, Found):
            assert math.degrees(step.scan_rad) == pytest.approx(6.0 + seed, abs=3.0 * math.degrees(step.sigma_rad))
        else:
            assert "search the field" in step.reason


def test_single_false_detection_does_not_end_the_search_there() -> None:
    rng = np.random.default_rng(4)
    planner = SearchPlanner(_model(), LOW, HIGH, LOW)
    turns = 0
    while isinstance(step := planner.next(), Turn):
        amplitude = 1.8 if turns == 0 else _amplitude(15.0, 4.0, step.scan_rad, rng)
        planner.add_look(step.scan_rad, amplitude)
        turns += 1
    assert isinstance(step, Found)
    assert math.degrees(step.scan_rad) == pytest.approx(15.0, abs=1.0)


def test_asking_twice_changes_nothing() -> None:
    planner = SearchPlanner(_model(), LOW, HIGH, 0.0)
    assert planner.next() == planner.next()
    planner.add_look(math.radians(-30.0), 2.0)
    assert planner.next() == planner.next()


def test_stage_that_stops_elsewhere_is_taken_where_it_stopped() -> None:
    rng = np.random.default_rng(8)
    planner = SearchPlanner(_model(), LOW, HIGH, 0.0)
    while isinstance(step := planner.next(), Turn):
        stopped = step.scan_rad + math.radians(float(rng.uniform(-1.0, 1.0)))
        planner.add_look(stopped, _amplitude(8.0, 4.0, stopped, rng))
    assert isinstance(step, Found)
    assert math.degrees(step.scan_rad) == pytest.approx(8.0, abs=1.0)


def test_session_without_a_curve_is_searched_with_a_bell_and_more_noise() -> None:
    model = DetectionModel.of_session(make_session().probe.sensitivity, THRESHOLD)
    assert model.amplitude_sigma > _model().amplitude_sigma
    step, _ = _search(3.0, 4.0, np.random.default_rng(3), model=model)
    assert isinstance(step, Found)
    assert math.degrees(step.scan_rad) == pytest.approx(3.0, abs=1.2)


def test_gain_goes_on_falling_beyond_the_curve() -> None:
    gain = _model().gain_log(np.radians([0.0, 6.0, 9.0, 12.0, 20.0]))
    assert gain[0] == pytest.approx(0.0)
    assert gain[1] == pytest.approx(math.log(0.5), abs=0.01)
    assert (np.diff(gain) < 0.0).all()


@pytest.mark.parametrize("amplitude", [0.0, -1.0, math.nan, math.inf])
def test_amplitude_that_is_none_is_refused(amplitude: float) -> None:
    planner = SearchPlanner(_model(), LOW, HIGH, 0.0)
    with pytest.raises(ValueError, match="amplitude"):
        planner.add_look(0.0, amplitude)


def test_searches_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match="increasing range"):
        SearchPlanner(_model(), HIGH, LOW, 0.0)
    with pytest.raises(ValueError, match="outside the field"):
        SearchPlanner(_model(), LOW, HIGH, 0.0, Prediction(1.0, 0.01))
    with pytest.raises(ValueError, match="sigma > 0"):
        Prediction(0.0, 0.0)
    with pytest.raises(ValueError, match="threshold"):
        DetectionModel.of_session(make_session().probe.sensitivity, 0.0)
    with pytest.raises(ValueError, match="most_positions"):
        SearchSettings(most_positions=0)
    with pytest.raises(ValueError, match="angle"):
        SearchPlanner(_model(), LOW, HIGH, 0.0).add_look(math.nan, None)
