"""Opened again a session is what it was: every acknowledged event, epochs and inliers, and the registration."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fgreg.smoother.updates as updates_module
from fgreg.camera_moves.detector import LoopClosure
from fgreg.camera_moves.found import DetectedLoopClosure
from fgreg.errors import EventRefused, JournalError
from fgreg.geometry.transforms import make_transform
from fgreg.model.events import AimEvent, CameraMovedEvent, NoteEvent, PairEvent, RefusedEvent
from fgreg.model.measurements import Measurements
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine import OnlineRegistration
from fgreg.online.estimate import OnlineEstimate
from fgreg.online.events import CameraMoved, LoopClosed, OnlineEvent
from fgreg.online.live_session import LiveSession
from fgreg.session.session_reader import check_session, read_session
from tests.forward import make_measurements
from tests.online_streams import events, first, restored, sigmas_between, unreported_move
from tests.test_motion_prior_between_epochs import there_and_back

SIGMAS = 0.05
"""Between the registration before and after."""


def _spoiled(measurements: Measurements, every: int) -> Measurements:
    """With another source at every n-th pair."""
    pairs = list(measurements.pairs)
    for place in range(every // 2, len(pairs), every):
        look = pairs[place].look
        pairs[place] = replace(pairs[place], look=replace(look, range_mm=look.range_mm + 9.0, x_mm=-look.x_mm - 8.0))
    return replace(measurements, pairs=tuple(pairs))


Stream = tuple[SessionModel, list[OnlineEvent]]


def _plain() -> Stream:
    model, measurements, _ = make_measurements(np.random.default_rng(3), pairs=42)
    return model, list(events(measurements))


def _with_outliers() -> Stream:
    model, measurements, _ = make_measurements(np.random.default_rng(5), pairs=16)
    return model, list(events(_spoiled(measurements, 5)))


def _looked_at_twice() -> Stream:
    model, measurements, _ = make_measurements(np.random.default_rng(6), pairs=8, looks_per_pm=2)
    return model, list(events(_spoiled(measurements, 12)))


def _in_two_epochs(*, known_motion: bool, after: int) -> Stream:
    model, measurements, _ = make_measurements(np.random.default_rng(7), pairs=24, epochs=2, known_motion=known_motion)
    return model, list(events(first(measurements, 12 + after)))


def _just_moved() -> Stream:
    model, stream = _in_two_epochs(known_motion=True, after=1)
    return model, stream[:-1]


def _too_few() -> Stream:
    model, measurements, _ = make_measurements(np.random.default_rng(3), pairs=2)
    return model, list(events(measurements))


def _put_back() -> Stream:
    model, measurements, _ = there_and_back(7, (25, 4, 14))
    return model, list(events(measurements))


def _moved() -> Stream:
    model, measurements, _ = unreported_move(3, make_transform(np.eye(3), np.array([5.0, -6.0, 0.0])), 8, 12)
    return model, list(events(measurements))


STREAMS = {
    "long enough for a marginal prior": _plain,
    "a fifth outliers": _with_outliers,
    "looks at one PM, one of them an outlier": _looked_at_twice,
    "two epochs, motion measured": lambda: _in_two_epochs(known_motion=True, after=12),
    "a motion just measured": _just_moved,
    "one pair after a measured motion": lambda: _in_two_epochs(known_motion=True, after=1),
    "two epochs, motion unknown": lambda: _in_two_epochs(known_motion=False, after=10),
    "one pair after a move": lambda: _in_two_epochs(known_motion=False, after=1),
    "too few pairs": _too_few,
    "a loop closed": _put_back,
    "a move detected": _moved,
}


def _lived(model: SessionModel, stream: list[OnlineEvent]) -> tuple[OnlineRegistration, list[OnlineEvent]]:
    """An engine that took in one event after the other, and what a session that it records has then."""
    engine, record, closed = OnlineRegistration(model, verdicts=False), list[OnlineEvent](), 0
    for event in stream:
        epoch, estimate = engine.estimate.epoch, engine.add(event)
        record.append(event)
        record.extend(LoopClosed(event.t, back.epoch, back.to) for back in engine.loop_closures[closed:])
        closed = len(engine.loop_closures)
        if estimate.epoch > epoch and not isinstance(event, CameraMoved):
            record.append(CameraMoved(event.t, detected=True, since_t=engine.moves[-1].since_t))
    return engine, record


@pytest.mark.parametrize("name", STREAMS)
def test_events_taken_in_at_once_give_what_they_give_one_by_one(name: str) -> None:
    model, stream = STREAMS[name]()
    lived, record = _lived(model, stream)
    again = OnlineRegistration(model, verdicts=False)
    with again.restoring():
        for event in record:
            again.add(event)
    found, expected = again.estimate, lived.estimate
    assert (found.epoch, found.pairs, found.verdict) == (expected.epoch, expected.pairs, expected.verdict)
    assert again.inliers == lived.inliers
    assert [start.after for start in again.measurements().epochs] == [s.after for s in lived.measurements().epochs]
    assert [(back.epoch, back.to) for back in again.loop_closures] == [
        (back.epoch, back.to) for back in lived.loop_closures
    ]
    assert sigmas_between(found, expected) < SIGMAS
    if expected.covariance is not None and found.covariance is not None:
        np.testing.assert_allclose(np.diag(found.covariance), np.diag(expected.covariance), rtol=0.05)
    assert bool(lived.loop_closures) == (name == "a loop closed")
    assert bool(lived.moves) == (name == "a move detected")
    assert [pair.epoch for pair in again.measurements().pairs] == [pair.epoch for pair in lived.measurements().pairs]


def test_a_thousand_pairs_in_seven_epochs_are_opened_again() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(1), pairs=1000, epochs=7, known_motion=True)
    spoiled = _spoiled(first(measurements, 100), 10).pairs
    whole = replace(measurements, pairs=spoiled + measurements.pairs[100:])
    engine = restored(OnlineRegistration(model, verdicts=False), whole)
    assert (engine.estimate.epoch, len(engine.inliers)) == (6, 1000)
    assert not any(engine.inliers[5:100:10])
    assert sum(engine.inliers) > 980
    assert engine.add(replace(measurements.pairs[-1], t=engine.estimate.t + 1.0, pm=2000)).used


def test_a_note_that_only_looks_like_a_loop_closure_changes_nothing() -> None:
    text = DetectedLoopClosure(1, 0, 5.0, 9.0).text
    assert LoopClosed.of_note(5.0, text) == LoopClosed(5.0, 1, 0)
    assert LoopClosed.of_note(5.0, text + "!") is None
    model, stream = _plain()
    engine = OnlineRegistration(model, verdicts=False)
    engine.add(stream[0])
    with pytest.raises(EventRefused, match="closes a loop"):
        engine.add(LoopClosed(stream[0].t, 1, 0))


# --- sessions ---------------------------------------------------------------------------------------------------------

Shots = list[AimEvent | PairEvent | CameraMovedEvent]


def _engine(model: SessionModel, config: SolveConfig) -> OnlineRegistration:
    return OnlineRegistration(model, config, verdicts=False)


def _emptied(session: Path) -> tuple[Path, Shots]:
    found = read_session(session).events
    (session / "events.jsonl").unlink()
    return session, [e for e in found if isinstance(e, AimEvent | PairEvent | CameraMovedEvent)]


def _recorded(folder: Path, events: Shots) -> tuple[OnlineEstimate, tuple[bool, ...]]:
    """The estimate, and which pairs are inliers, of a session recorded at one go."""
    with LiveSession.open(folder, make_engine=_engine) as live:
        for event in events:
            live.add(event)
        assert live.estimate is not None
        return live.estimate, _kept(live)


def _kept(live: LiveSession) -> tuple[bool, ...]:
    assert isinstance(live.engine, OnlineRegistration)
    return live.engine.inliers


def _is(live: LiveSession, expected: tuple[OnlineEstimate, tuple[bool, ...]]) -> None:
    estimate, kept = expected
    assert live.estimate is not None
    assert (live.estimate.epoch, live.estimate.pairs, live.estimate.verdict) == (
        estimate.epoch, estimate.pairs, estimate.verdict,
    )  # fmt: skip
    assert _kept(live) == kept
    assert sigmas_between(live.estimate, estimate) < SIGMAS


def test_a_session_closed_again_and_again_is_as_one_that_was_never_closed(pose_session: Path, tmp_path: Path) -> None:
    unbroken = Path(shutil.copytree(pose_session, tmp_path / "unbroken"))
    expected = _recorded(*_emptied(unbroken))
    folder, events = _emptied(pose_session)
    for start in range(0, len(events), 9):
        with LiveSession.open(folder, make_engine=_engine) as live:
            for event in events[start : start + 9]:
                live.add(event)
    with LiveSession.open(folder, make_engine=_engine) as live:
        _is(live, expected)
    assert check_session(folder) == ([], [])
    assert (folder / "events.jsonl").read_bytes() == (unbroken / "events.jsonl").read_bytes()


def test_events_that_were_refused_stay_out_and_all_others_are_there(
    pose_session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, events = _emptied(pose_session)
    with LiveSession.open(folder, make_engine=_engine) as live:
        for number, event in enumerate(events):
            if number != 26:
                live.add(event)
                continue
            with monkeypatch.context() as patch:
                patch.setattr(updates_module, "innovation", _singular)
                with pytest.raises(EventRefused, match="singular"):
                    live.add(event)
        assert live.estimate is not None
        expected = live.estimate, _kept(live)
        taken = live.measurements()
    refused = [event for event in read_session(folder).events if isinstance(event, RefusedEvent)]
    assert [event.reason for event in refused] == ["the update failed: LinAlgError: singular"]
    with LiveSession.open(folder, make_engine=_engine) as live:
        _is(live, expected)
        again = live.measurements()
    assert [aim.t for aim in again.aims] == [aim.t for aim in taken.aims]
    assert [(pair.t, pair.epoch) for pair in again.pairs] == [(pair.t, pair.epoch) for pair in taken.pairs]
    for here, there in zip(again.pairs, taken.pairs, strict=True):
        assert here.marker.camera_T_marker.tobytes() == there.marker.camera_T_marker.tobytes()
        assert (here.pm, here.look.x_mm, here.look.scan_rad) == (there.pm, there.look.x_mm, there.look.scan_rad)


def _singular(*_: object) -> float:
    raise np.linalg.LinAlgError("singular")


def test_with_its_verdict_it_is_what_it_was(pose_session: Path) -> None:
    folder, events = _emptied(pose_session)
    with LiveSession.open(folder) as live:
        for event in events:
            live.add(event)
        expected = live.settle()
    with LiveSession.open(folder) as live:
        found = live.estimate
    assert found is not None
    assert found.settled
    assert (found.verdict, found.reasons, found.pairs) == (expected.verdict, expected.reasons, expected.pairs)
    assert sigmas_between(found, expected) < SIGMAS
    with LiveSession.open(folder), pytest.raises(JournalError, match="another program is recording"):
        LiveSession.open(folder)


def test_a_loop_closure_is_noted_and_there_when_the_session_is_opened_again(pose_session: Path) -> None:
    folder, events = _emptied(pose_session)
    pairs = [event for event in events if isinstance(event, PairEvent)]
    moved = CameraMovedEvent(pairs[8].t, 0)
    with LiveSession.open(folder, make_engine=_engine) as live:
        for event in events:
            if event is pairs[8]:
                live.add(moved)
            live.add(event)
            if event is pairs[10]:
                break
        assert isinstance(live.engine, OnlineRegistration)
        live.engine._close_loop(LoopClosure(1, 0, 9.0), event.t)
        expected = live.refresh()
    assert expected is not None
    notes = [event.text for event in read_session(folder).events if isinstance(event, NoteEvent)]
    assert notes == [DetectedLoopClosure(1, 0, 0.0, None).text]
    for _ in range(2):  # opened again and again: noted once
        with LiveSession.open(folder, make_engine=_engine) as live:
            assert isinstance(live.engine, OnlineRegistration)
            assert [(back.epoch, back.to) for back in live.engine.loop_closures] == [(1, 0)]
            assert live.engine.measurements().epochs[1].after == 0
            assert live.estimate is not None
            assert sigmas_between(live.estimate, expected) < SIGMAS
    assert sum(isinstance(event, NoteEvent) for event in read_session(folder).events) == 1
