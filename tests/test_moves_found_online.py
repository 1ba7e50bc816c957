"""Moves that nobody tells: the engine finds them, and never passes an old transform for the present one."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from fgreg.config import SolveConfig
from fgreg.errors import EventRefused
from fgreg.estimate import Verdict
from fgreg.frames import FloatArray, exp_so3, make_transform
from fgreg.measurements import Measurements, Track
from fgreg.models import SessionModel
from fgreg.online import CameraMoved, OnlineEstimate, OnlineRegistration, StaticTags
from fgreg.online import engine as engine_module
from fgreg.online import guard as guard_module
from fgreg.online import watch as watch_module
from fgreg.online.detect import events_in_order, find_moves, split_epochs
from fgreg.online.numbers import Sink, Source
from fgreg.targets import tre_mm
from tests.forward import Truth, make_measurements
from tests.online_streams import untold_move

BEFORE = 12
SHIFT = make_transform(np.eye(3), 8.0 * np.array([0.6, -0.8, 0.0]))
TAG_SIGMA = np.array([0.002, 0.002, 0.002, 0.1, 0.1, 0.3])


@cache
def _ran(seed: int) -> tuple[SessionModel, Measurements, tuple[Truth, Truth], OnlineRegistration]:
    """A session with an untold move, and the engine that went through it: to look at only."""
    model, measurements, truths = untold_move(seed, SHIFT, 8, BEFORE)
    engine = OnlineRegistration(model, judge=None)
    for _, event in events_in_order(measurements):
        engine.add(event)
    return model, measurements, truths, engine


def _query(measurements: Measurements) -> Track:
    pair = measurements.pairs[-1]
    return Track(pair.t, 0, pair.marker, looks=(pair.look,))


def _until_alarm(engine: OnlineRegistration, measurements: Measurements) -> tuple[OnlineEstimate, int]:
    """The estimate after the event at which the move was found, and how many pairs came up to then."""
    pairs = 0
    for index, event in events_in_order(measurements):
        estimate = engine.add(event)
        pairs += index is not None
        if engine.moves:
            return estimate, pairs
    raise AssertionError("no move was found")


def test_the_engine_finds_an_untold_move_and_gives_the_pairs_since_to_a_new_epoch() -> None:
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


@pytest.mark.parametrize("seed", [3, 7])
def test_online_and_batch_find_the_same_moves_and_epochs(seed: int) -> None:
    model, measurements, _, engine = _ran(seed)
    moves = find_moves(measurements, model, SolveConfig())
    assert len(moves) == 1
    for batch, here in zip(moves, engine.moves, strict=True):  # but for rounding, which arrays' places in memory decide
        assert batch.log_bayes == pytest.approx(here.log_bayes, abs=1e-6)
        assert replace(batch, log_bayes=None) == replace(here, log_bayes=None)
    split, online = split_epochs(measurements, moves), engine.measurements()
    assert [pair.epoch for pair in split.pairs] == [pair.epoch for pair in online.pairs]
    assert [epoch.t for epoch in split.epochs] == [epoch.t for epoch in online.epochs]


def test_switched_off_nothing_is_found() -> None:
    model, measurements, _ = untold_move(3, SHIFT, 4, BEFORE)
    engine = OnlineRegistration(model, judge=None, watch=None)
    for _, event in events_in_order(measurements):
        assert engine.add(event).epoch == 0
    assert engine.moves == ()


def test_another_kind_of_watch_is_refused() -> None:
    model, _, _ = make_measurements(np.random.default_rng(1), pairs=1)
    with pytest.raises(ValueError, match="expected 'inline', 'process' or None"):
        OnlineRegistration(model, watch="often")  # type: ignore[arg-type]


def test_pairs_set_aside_as_junk_before_the_alarm_come_back_with_it() -> None:
    model, measurements, _ = untold_move(4, make_transform(np.eye(3), np.array([0.0, 14.0, 0.0])), 10, BEFORE)
    engine = OnlineRegistration(model, judge=None)
    odd = []
    for index, event in events_in_order(measurements):
        estimate = engine.add(event)
        if index is not None and index >= BEFORE and not engine.moves:
            odd.append((index, estimate.used))
    assert (BEFORE, False) in odd
    assert all(engine.kept[BEFORE:])


def test_one_gross_outlier_is_no_move() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(5), pairs=24)
    odd = measurements.pairs[15]
    pairs = list(measurements.pairs)
    pairs[15] = replace(odd, look=replace(odd.look, x_mm=odd.look.x_mm + 12.0))
    engine = OnlineRegistration(model, judge=None)
    for _, event in events_in_order(replace(measurements, pairs=tuple(pairs))):
        engine.add(event)
    assert engine.moves == ()
    assert not engine.kept[15]


def test_until_the_new_epoch_is_good_enough_the_verdict_says_so_and_queries_are_not_answered() -> None:
    model, measurements, _ = untold_move(3, SHIFT, 10, BEFORE)
    engine = OnlineRegistration(model)
    events = [event for _, event in events_in_order(measurements)]
    steady = len(measurements.aims) + BEFORE
    with engine.catching_up():
        for event in events[:steady]:
            engine.add(event)
    before = engine.track(_query(measurements))
    for event in events[steady:]:
        estimate = engine.add(event)
        if engine.moves and estimate.pairs < 5:
            assert estimate.verdict is Verdict.REFUSED
            answer = engine.track(replace(_query(measurements), epoch=1))
            assert answer.stage_rad is None
            assert "the camera moved between" in answer.reason
    assert before.stage_rad is not None
    assert len(engine.moves) == 1


def test_where_the_pairs_cannot_be_reassigned_the_old_registration_is_not_trusted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, measurements, _ = untold_move(3, SHIFT, 4, BEFORE)
    engine = OnlineRegistration(model, judge=None)

    def fails(*_: object) -> None:
        raise ArithmeticError("it is not finite")

    monkeypatch.setattr(engine_module, "with_move", fails)
    verdicts = [engine.add(event).verdict for _, event in events_in_order(measurements)]
    assert verdicts[-1] is Verdict.REFUSED
    assert any("cannot be given to a new epoch: it is not finite" in reason for reason in engine.estimate.reasons)
    assert engine.track(_query(measurements)).stage_rad is None
    assert engine.moves == ()


def test_a_test_that_fails_is_told_and_the_estimate_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    model, measurements, _ = untold_move(3, SHIFT, 4, BEFORE)

    def fails(*_: object) -> None:
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr(watch_module, "find_camera_move", fails)
    engine = OnlineRegistration(model, judge=None)
    for _, event in events_in_order(measurements):
        engine.add(event)
    assert engine.estimate.trus_T_camera is not None
    assert any("camera moves are not looked for: ZeroDivisionError" in reason for reason in engine.estimate.reasons)


def test_a_look_that_fails_does_not_undo_the_pair(monkeypatch: pytest.MonkeyPatch) -> None:
    model, measurements, _ = untold_move(3, SHIFT, 1, BEFORE)

    def fails(*_: object) -> None:
        raise np.linalg.LinAlgError("singular")

    monkeypatch.setattr(guard_module, "move_case", fails)
    engine = OnlineRegistration(model, judge=None)
    for _, event in events_in_order(measurements):
        estimate = engine.add(event)
    assert len(engine.measurements().pairs) == BEFORE + 1
    assert any("camera moves are not looked for: LinAlgError: singular" in reason for reason in estimate.reasons)


def test_a_watch_in_a_process_finds_the_same_move() -> None:
    model, measurements, _ = untold_move(3, SHIFT, 10, BEFORE)
    with OnlineRegistration(model, judge=None, watch="process") as engine:
        for index, event in events_in_order(measurements):
            engine.add(event)
            if index is not None and index > BEFORE:
                until = time.monotonic() + 20.0
                while index < BEFORE + 4 and not engine.moves and time.monotonic() < until:
                    time.sleep(0.02)
                    engine.refresh()
        (move,) = engine.moves
    assert abs(move.since - BEFORE) <= 1
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
    model, measurements, truth = untold_move(seed, SHIFT, pairs, BEFORE)
    engine, tags = OnlineRegistration(model, judge=None), _Tags(seed)
    t = 0.0
    for index, event in events_in_order(measurements):
        if index == BEFORE:
            break
        engine.add(event)
        t = event.t
    for n in range(20):
        t += 0.02
        assert engine.add(tags.frame(t)).epoch == 0, n
    return engine, measurements, tags, truth, t


def test_an_alarm_from_tags_alone_stops_answers_at_once_and_then_ties_the_new_epoch() -> None:
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


def test_a_motion_told_after_the_move_was_found_out_is_not_applied_to_it_again() -> None:
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
    engine = OnlineRegistration(model, judge=None)
    with pytest.raises(EventRefused, match="tag 3 has no covariance"):
        engine.add(StaticTags(1.0, {3: np.eye(4)}, {}))


# --- opened again ---------------------------------------------------------------------------------------------------


def test_moves_found_before_are_taken_from_the_record_when_catching_up() -> None:
    model, measurements, _, first = _ran(3)
    (move,), record = first.moves, []
    for _, event in events_in_order(measurements):
        record.append(event)
        if event.t == move.alarm_t:
            record.append(CameraMoved(event.t, detected=True, since_t=move.since_t))
    again = OnlineRegistration(model, judge=None)
    with again.catching_up():
        for event in record:
            again.add(event)
    assert again.estimate.epoch == first.estimate.epoch == 1
    assert again.estimate.reasons == first.estimate.reasons
    assert again.estimate.verdict is first.estimate.verdict
    assert again.estimate.trus_T_camera is not None
    assert first.estimate.trus_T_camera is not None
    np.testing.assert_allclose(again.estimate.trus_T_camera, first.estimate.trus_T_camera, atol=1e-6)
    assert [e.t for e in again.measurements().epochs] == [e.t for e in first.measurements().epochs]


def test_what_was_found_out_is_taken_up_again_with_the_engine() -> None:
    model, measurements, _ = untold_move(3, SHIFT, 14, BEFORE)
    unbroken, engine = OnlineRegistration(model, judge=None), OnlineRegistration(model, judge=None)
    resumed = 0
    for _, event in events_in_order(measurements):
        expected, found = unbroken.add(event), engine.add(event)
        assert (found.epoch, found.verdict, found.reasons) == (expected.epoch, expected.verdict, expected.reasons)
        if (write := engine.rest()) is not None:
            resumed, moves = resumed + bool(engine.moves), engine.moves
            sink = Sink()
            write(sink)
            engine = OnlineRegistration(model, judge=None)
            estimate = engine.resume(Source(sink.numbers()))
            assert estimate.reasons == expected.reasons
            assert engine.moves == moves
    assert resumed
    assert len(engine.moves) == 1
