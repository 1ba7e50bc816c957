"""Camera moves that no one reports: the engine finds them, and never reports an old transform as the current one."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from fgreg.camera_moves import detector as detector_module
from fgreg.camera_moves.bayes_filter import move_evidence
from fgreg.camera_moves.recorded_session import find_moves, split_epochs
from fgreg.errors import EventRefused
from fgreg.geometry.target_error import tre_mm
from fgreg.geometry.transforms import FloatArray, exp_so3, make_transform
from fgreg.model.estimate import Verdict
from fgreg.model.measurements import Measurements, Track
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online import full_solve as full_solve_module
from fgreg.online.engine import OnlineRegistration
from fgreg.online.events import CameraMoved, StaticTags, events_in_order
from tests.forward import Truth, make_measurements
from tests.online_streams import first, restored, sigmas_between, unreported_move

BEFORE = 12
SHIFT = make_transform(np.eye(3), 8.0 * np.array([0.6, -0.8, 0.0]))
TAG_SIGMA = np.array([0.002, 0.002, 0.002, 0.1, 0.1, 0.3])


@cache
def _ran(seed: int) -> tuple[SessionModel, Measurements, tuple[Truth, Truth], OnlineRegistration]:
    """A session with an unreported move, and the engine that took it in: read only."""
    model, measurements, truths = unreported_move(seed, SHIFT, 8, BEFORE)
    engine = OnlineRegistration(model, verdicts=False)
    for _, event in events_in_order(measurements):
        engine.add(event)
    return model, measurements, truths, engine


def _query(measurements: Measurements) -> Track:
    pair = measurements.pairs[-1]
    return Track(pair.t, 0, pair.marker, looks=(pair.look,))


def _steady(engine: OnlineRegistration, measurements: Measurements, pairs: int = BEFORE) -> OnlineRegistration:
    """The engine with the pairs before the move taken in."""
    return restored(engine, first(measurements, pairs))


def test_the_engine_finds_an_unreported_move_and_gives_the_pairs_since_to_a_new_epoch() -> None:
    model, measurements, truth, engine = _ran(3)
    (move,) = engine.moves
    taken = engine.measurements()
    assert abs(move.since - BEFORE) <= 1
    assert [pair.epoch for pair in taken.pairs] == [0] * move.since + [1] * (BEFORE + 8 - move.since)
    assert taken.epochs[1].t == move.since_t == measurements.pairs[move.since].t
    assert move.last_t < move.since_t < move.alarm_t
    estimate = engine.estimate
    assert estimate.trus_T_camera is not None
    assert tre_mm(estimate.trus_T_camera, truth[1].trus_T_camera[0], model.targets_mm).mean() < 3.0
    assert move.text in estimate.reasons
    assert estimate.verdict is not Verdict.OK


def test_online_and_batch_find_the_same_moves_and_epochs() -> None:
    model, measurements, _, engine = _ran(3)
    moves = find_moves(measurements, model, SolveConfig())
    assert len(moves) == 1
    assert [(m.epoch, m.since, m.since_t) for m in moves] == [(m.epoch, m.since, m.since_t) for m in engine.moves]
    split, online = split_epochs(measurements, moves), engine.measurements()
    assert [pair.epoch for pair in split.pairs] == [pair.epoch for pair in online.pairs]
    assert [epoch.t for epoch in split.epochs] == [epoch.t for epoch in online.epochs]


def test_switched_off_nothing_is_found() -> None:
    model, measurements, _, found = _ran(3)
    assert found.moves
    engine = _steady(OnlineRegistration(model, verdicts=False, find_moves=False), measurements)
    for pair in measurements.pairs[BEFORE : BEFORE + 4]:
        assert engine.add(pair).epoch == 0
    assert engine.moves == ()


def test_a_steady_stream_raises_no_alarm_and_mostly_needs_no_full_test(monkeypatch: pytest.MonkeyPatch) -> None:
    tests = 0
    full_test = move_evidence

    def counted(*arguments: Any, **options: Any) -> Any:
        nonlocal tests
        tests += 1
        return full_test(*arguments, **options)

    monkeypatch.setattr(detector_module, "move_evidence", counted)
    model, measurements, _ = make_measurements(np.random.default_rng(31), pairs=45)
    engine = _steady(OnlineRegistration(model, verdicts=False), measurements, 8)
    for pair in measurements.pairs[8:]:
        engine.add(pair)
    assert engine.moves == ()
    assert tests < 12


def test_pairs_that_were_outliers_before_the_alarm_are_inliers_after_it() -> None:
    model, measurements, _ = unreported_move(4, make_transform(np.eye(3), np.array([0.0, 14.0, 0.0])), 10, BEFORE)
    engine = _steady(OnlineRegistration(model, verdicts=False), measurements)
    odd = []
    for index, pair in enumerate(measurements.pairs[BEFORE:], BEFORE):
        estimate = engine.add(pair)
        if not engine.moves:
            odd.append((index, estimate.used))
    assert (BEFORE, False) in odd
    assert all(engine.inliers[BEFORE:])


def test_one_gross_outlier_is_no_move() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(5), pairs=24)
    odd = measurements.pairs[15]
    pairs = list(measurements.pairs)
    pairs[15] = replace(odd, look=replace(odd.look, x_mm=odd.look.x_mm + 12.0))
    engine = _steady(OnlineRegistration(model, verdicts=False), measurements)
    for pair in pairs[BEFORE:]:
        engine.add(pair)
    assert engine.moves == ()
    assert not engine.inliers[15]


def test_until_the_new_epoch_is_good_enough_the_verdict_is_refused_and_queries_are_not_answered() -> None:
    model, measurements, _ = unreported_move(3, SHIFT, 10, BEFORE)
    engine = _steady(OnlineRegistration(model), measurements)
    before = engine.track(_query(measurements))
    for pair in measurements.pairs[BEFORE:]:
        estimate = engine.add(pair)
        if engine.moves and estimate.pairs < 5:
            assert estimate.verdict is Verdict.REFUSED
            answer = engine.track(replace(_query(measurements), epoch=1))
            assert answer.stage_rad is None
            assert "the camera moved between" in answer.reason
    assert before.stage_rad is not None
    assert len(engine.moves) == 1


@pytest.mark.parametrize("where", ["in the test", "on the way to it"])
def test_a_camera_move_test_that_fails_is_reported_and_the_estimate_goes_on(
    where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, measurements, _ = unreported_move(3, SHIFT, 3, BEFORE)

    def fails(*_: object) -> None:
        raise ZeroDivisionError("a defect")

    engine = _steady(OnlineRegistration(model, verdicts=False), measurements)
    if where == "in the test":
        monkeypatch.setattr(full_solve_module, "find_camera_move", fails)
    else:
        monkeypatch.setattr("fgreg.online.engine.move_case", fails)
    for pair in measurements.pairs[BEFORE:]:
        estimate = engine.add(pair)
        assert any("camera moves are not looked for: ZeroDivisionError" in reason for reason in estimate.reasons)
    assert estimate.trus_T_camera is not None
    assert estimate.verdict is not Verdict.OK
    assert len(engine.measurements().pairs) == BEFORE + 3
    monkeypatch.undo()
    again = replace(measurements.pairs[-1], t=estimate.t + 1.0)
    assert not any("not looked for" in reason for reason in engine.add(again).reasons)


def test_a_worker_process_finds_the_same_move() -> None:
    model, measurements, _, here = _ran(3)
    with OnlineRegistration(model, verdicts=False, full_solve="worker") as engine:
        _steady(engine, measurements)
        until = time.monotonic() + 60.0
        for pair in measurements.pairs[BEFORE:]:
            engine.add(pair)
            while not engine.moves and engine._solver.busy:
                assert time.monotonic() < until
                time.sleep(0.01)
                engine.refresh()
        (move,), (expected,) = engine.moves, here.moves
    assert (move.epoch, move.since, move.since_t, move.last_t) == (
        expected.epoch, expected.since, expected.since_t, expected.last_t,
    )  # fmt: skip
    assert engine.estimate.epoch == 1


# --- tags -----------------------------------------------------------------------------------------------------------


class _Tags:
    """Two tags before the camera, seen with noise."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.tags = {
            1: make_transform(exp_so3(np.array([0.2, 0.1, 0.0])), np.array([-30.0, 10.0, 110.0])),
            2: make_transform(exp_so3(np.array([-0.1, 0.3, 0.2])), np.array([25.0, -15.0, 95.0])),
        }

    def move(self, motion: FloatArray) -> None:
        self.tags = {tag: motion @ pose for tag, pose in self.tags.items()}

    def frame(self, t: float) -> StaticTags:
        seen = {}
        for tag, pose in self.tags.items():
            noise = self.rng.normal(size=6) * TAG_SIGMA
            seen[tag] = pose @ make_transform(exp_so3(noise[:3]), noise[3:])
        return StaticTags(t, seen, {tag: np.diag(TAG_SIGMA**2) for tag in seen})


def _with_tags(seed: int, pairs: int) -> tuple[OnlineRegistration, Measurements, _Tags, tuple[Truth, Truth], float]:
    """An engine after a steady epoch in which tags were seen."""
    model, measurements, truth = unreported_move(seed, SHIFT, pairs, BEFORE)
    engine, tags = _steady(OnlineRegistration(model, verdicts=False), measurements), _Tags(seed)
    t = engine.estimate.t
    for n in range(20):
        t += 0.02
        assert engine.add(tags.frame(t)).epoch == 0, n
    return engine, measurements, tags, truth, t


def test_an_alarm_from_tags_alone_stops_results_at_once_and_then_gives_the_motion_prior() -> None:
    engine, measurements, tags, truth, t = _with_tags(6, 1)
    steady = engine.track(_query(measurements))
    assert steady.sigma_rad is not None
    tags.move(SHIFT)
    seen = []
    for n in range(30):
        estimate = engine.add(tags.frame(t + 0.02 * (n + 1)))
        seen.append((estimate.epoch, estimate.trus_T_camera is not None))
        if estimate.epoch == 1 and estimate.trus_T_camera is None:
            assert estimate.verdict is Verdict.REFUSED
            assert engine.track(_query(measurements)).stage_rad is None
    alarm, tied = seen.index((1, False)), seen.index((1, True))
    assert alarm < 5
    assert tied < 15
    assert seen[tied:] == [(1, True)] * (30 - tied)
    estimate = engine.estimate
    assert estimate.trus_T_camera is not None
    assert estimate.verdict is not Verdict.OK
    after = engine.track(replace(_query(measurements), epoch=1))
    assert after.sigma_rad is None or after.sigma_rad > steady.sigma_rad
    targets = make_measurements(np.random.default_rng(0), pairs=1)[0].targets_mm
    assert tre_mm(estimate.trus_T_camera, truth[1].trus_T_camera[0], targets).mean() < 4.0
    (move,) = engine.moves
    assert move.since == BEFORE
    assert move.log_bayes is None
    assert t <= move.since_t <= t + 0.02 * (alarm + 1)


def test_a_camera_on_its_way_has_no_registration_until_it_rests() -> None:
    engine, _, tags, _, t = _with_tags(6, 1)
    step = make_transform(np.eye(3), np.array([1.5, 0.0, 0.0]))
    epochs = []
    for n in range(25):
        tags.move(step)
        epochs.append(engine.add(tags.frame(t + 0.02 * (n + 1))).epoch)
    assert epochs[-1] == 1  # one epoch for one way, however long
    assert engine.estimate.trus_T_camera is None


def test_pairs_taken_after_the_tags_moved_are_of_the_new_epoch() -> None:
    engine, measurements, tags, _, t = _with_tags(6, 3)
    tags.move(SHIFT)
    engine.add(tags.frame(t + 0.02))
    engine.add(replace(measurements.pairs[BEFORE], t=t + 0.03))
    for n in range(6):
        engine.add(tags.frame(t + 0.04 + 0.02 * n))
    epochs = [pair.epoch for pair in engine.measurements().pairs]
    assert epochs[:BEFORE] == [0] * BEFORE
    assert epochs[-1] == engine.estimate.epoch == 1


def test_a_motion_reported_after_the_move_was_detected_is_not_applied_to_it_again() -> None:
    engine, _, tags, _, t = _with_tags(6, 1)
    tags.move(SHIFT)
    for n in range(4):
        engine.add(tags.frame(t + 0.02 * (n + 1)))
    assert engine.estimate.epoch == 1
    estimate = engine.add(CameraMoved(t + 1.0, SHIFT, np.diag([1e-4] * 3 + [0.25] * 3)))
    assert estimate.epoch == 2
    assert estimate.verdict is Verdict.REFUSED
    assert estimate.trus_T_camera is None
    assert not engine.measurements().epochs[2].motion_known


def test_tags_without_a_covariance_are_refused() -> None:
    model, _, _ = make_measurements(np.random.default_rng(1), pairs=1)
    engine = OnlineRegistration(model, verdicts=False)
    with pytest.raises(EventRefused, match="tag 3 has no covariance"):
        engine.add(StaticTags(1.0, {3: np.eye(4)}, {}))


# --- opened again ---------------------------------------------------------------------------------------------------


def test_moves_that_were_detected_are_taken_from_the_record_when_restoring() -> None:
    model, measurements, _, first = _ran(3)
    (move,), record = first.moves, []
    for _, event in events_in_order(measurements):
        record.append(event)
        if event.t == move.alarm_t:
            record.append(CameraMoved(event.t, detected=True, since_t=move.since_t))
    again = OnlineRegistration(model, verdicts=False)
    with again.restoring():
        for event in record:
            again.add(event)
    assert again.estimate.epoch == first.estimate.epoch == 1
    assert again.estimate.reasons == first.estimate.reasons
    assert again.estimate.verdict is first.estimate.verdict
    assert again.inliers == first.inliers
    assert sigmas_between(again.estimate, first.estimate) < 0.05
    assert [e.t for e in again.measurements().epochs] == [e.t for e in first.measurements().epochs]


@pytest.mark.parametrize("late", [-1, 2])
def test_a_move_that_was_placed_at_another_pair_is_placed_again_when_later_pairs_show_it(late: int) -> None:
    model, measurements, _ = unreported_move(3, SHIFT, 14, BEFORE)
    pairs = measurements.pairs
    engine = _steady(OnlineRegistration(model, verdicts=False), measurements)
    with engine.restoring():
        for pair in pairs[BEFORE : BEFORE + 4]:
            engine.add(pair)
        engine.add(CameraMoved(pair.t, detected=True, since_t=pairs[BEFORE + late].t))
    for pair in pairs[BEFORE + 4 :]:
        estimate = engine.add(pair)
    assert [pair.epoch for pair in engine.measurements().pairs] == [0] * BEFORE + [1] * 14
    assert any(f"between pair {BEFORE} and {BEFORE + 1}" in reason for reason in estimate.reasons)
