"""A session that is recorded and estimated at once: nothing acknowledged is lost, and reopened it goes on as it was."""

from __future__ import annotations

import errno
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgreg.detection.events_to_measurements import extract_measurements
from fgreg.errors import EventRefused, InputError, JournalError
from fgreg.model.events import (
    AimEvent,
    CameraMovedEvent,
    Event,
    MarkerRecord,
    NoteEvent,
    PairEvent,
    RefusedEvent,
    TrackEvent,
)
from fgreg.model.solve_config import SolveConfig
from fgreg.online.estimate import OnlineEstimate
from fgreg.online.live_session import LiveSession
from fgreg.registration.solve import solve
from fgreg.session import append_only_file
from fgreg.session.session_reader import read_session
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session
from tests.batch_engine import BatchEngine
from tests.test_journal import failing


def empty_copy(session: Path) -> tuple[Path, list[Event]]:
    """The session's folder without its events, and those."""
    events = list(read_session(session).events)
    (session / "events.jsonl").unlink()
    return session, events


def same(a: OnlineEstimate | None, b: OnlineEstimate | None) -> None:
    assert a is not None
    assert b is not None
    assert (a.epoch, a.pairs, a.verdict) == (b.epoch, b.pairs, b.verdict)
    for x, y in ((a.trus_T_camera, b.trus_T_camera), (a.covariance, b.covariance)):
        assert x is not None
        assert y is not None
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-6)


def feed(live: LiveSession, events: Sequence[Event]) -> None:
    for event in events:
        if isinstance(event, TrackEvent):
            live.track(event)
        elif isinstance(event, AimEvent | PairEvent | CameraMovedEvent):
            live.add(event)


def test_reopened_at_any_moment_it_goes_on_with_the_estimate_of_before(pose_session: Path) -> None:
    folder, events = empty_copy(pose_session)
    estimate = None
    for start in range(0, len(events), 9):
        with LiveSession.open(folder, make_engine=BatchEngine) as live:
            if estimate is not None and estimate.trus_T_camera is not None:
                same(live.estimate, estimate)
            feed(live, events[start : start + 9])
            estimate = live.estimate
    again = read_session(folder).events
    assert [(type(e), e.t) for e in again] == [(type(e), e.t) for e in events]
    whole = extract_measurements(again, read_session(folder).model)
    with LiveSession.open(folder, make_engine=BatchEngine) as live:
        settled = live.settle()
        model = live.journal.model
    batch = solve(whole.measurements, (), model, SolveConfig()).epochs[-1]
    assert batch.trus_T_camera is not None
    assert settled.trus_T_camera is not None
    np.testing.assert_allclose(settled.trus_T_camera, batch.trus_T_camera, atol=1e-9)


def test_raw_frames_are_processed_as_they_come_and_with_the_same_result_when_reopened(raw_session: Path) -> None:
    folder, events = empty_copy(raw_session)
    with LiveSession.open(folder, make_engine=BatchEngine) as live:
        feed(live, events)
        first, found = live.estimate, live.measurements()
    with LiveSession.open(folder, make_engine=BatchEngine) as live:
        same(live.estimate, first)
        for a, b in zip(found.pairs, live.measurements().pairs, strict=True):
            assert a.marker.covariance.tobytes() == b.marker.covariance.tobytes()
    assert (len(found.aims), len(found.pairs)) == (6, 8)


@pytest.mark.parametrize("between", ["query", "query not recorded", "refused pair"])
def test_frames_of_queries_and_refused_events_leave_no_trace_in_the_estimate(raw_session: Path, between: str) -> None:
    folder, events = empty_copy(raw_session)
    queries = [event for event in events if isinstance(event, TrackEvent)]
    shots = [event for event in events if isinstance(event, AimEvent | PairEvent)]
    pairs = [event for event in shots if isinstance(event, PairEvent)]
    place = shots.index(pairs[1])
    with LiveSession.open(folder, make_engine=BatchEngine) as live:
        assert isinstance(live._engine, BatchEngine)
        feed(live, shots[:place])
        if between == "refused pair":
            live._engine.refuse_t = {shots[place].t}
            with pytest.raises(EventRefused):
                feed(live, shots[place : place + 1])
            place += 1
        else:
            for query in queries:
                live.track(replace(query, t=shots[place - 1].t), record=between == "query")
        feed(live, shots[place:])
        first, found = live.estimate, live.measurements()
    with LiveSession.open(folder, make_engine=BatchEngine) as live:
        same(live.estimate, first)
        for a, b in zip(found.pairs, live.measurements().pairs, strict=True):
            assert a.marker.covariance.tobytes() == b.marker.covariance.tobytes()


def test_an_event_that_the_engine_refuses_is_recorded_as_refused_and_never_taken_in_again(pose_session: Path) -> None:
    folder, events = empty_copy(pose_session)
    pairs = [event for event in events if isinstance(event, PairEvent)]
    with LiveSession.open(folder, make_engine=BatchEngine) as live:
        feed(live, events[: events.index(pairs[9])])
        before = live.estimate
        assert isinstance(live._engine, BatchEngine)
        live._engine.refuse_t = {pairs[9].t}
        with pytest.raises(EventRefused, match="indeterminate"):
            live.add(pairs[9])
        assert before is not None
        assert live.estimate is not None
        assert live.estimate.trus_T_camera is before.trus_T_camera
        assert "(1; the first: an indeterminate system): no test has seen them" in live.estimate.reasons[0]
        live.add(pairs[10])
        after = live.estimate
    recorded = read_session(folder)
    refused = [event for event in recorded.events if isinstance(event, RefusedEvent)]
    assert [(event.reason, event.refused_line) for event in refused] == [
        ("an indeterminate system", refused[0].line - 1)
    ]
    with LiveSession.open(folder, make_engine=BatchEngine) as live:
        same(live.estimate, after)
    # A solve of the recorded session leaves it out too, and says why.
    solved = extract_measurements(recorded.events, recorded.model)
    assert [pair.t for pair in solved.measurements.pairs] == [pair.t for pair in [*pairs[:9], pairs[10]]]
    assert any("indeterminate" in reason for reason in solved.unused.values())


def test_an_event_that_no_session_may_hold_is_recorded_as_refused(pose_session: Path) -> None:
    folder, events = empty_copy(pose_session)
    pair = next(event for event in events if isinstance(event, PairEvent))
    aim = next(event for event in events if isinstance(event, AimEvent))
    bad = [
        replace(pair, trus=replace(pair.trus, x_mm=math.nan)),
        replace(pair, t=math.inf),
        replace(pair, t=-1e11),
        replace(pair, pm=-1, t=1e11),  # must not advance the session's clock
        replace(pair, marker=MarkerRecord(left=Path("/etc/passwd"))),
        replace(pair, marker=MarkerRecord(np.eye(4), np.zeros((300, 300)))),
    ]
    with LiveSession.open(folder, make_engine=BatchEngine) as live:
        live.add(aim)
        for event in bad:
            with pytest.raises(InputError):
                live.add(event)
        live.add(pair)
        assert len(live.measurements().pairs) == 1
    refused = [event for event in read_session(folder).events if isinstance(event, RefusedEvent)]
    assert len(refused) == len(bad)
    assert [event.refused_line for event in refused] == [None] * len(bad)
    assert isinstance(refused[0].event, dict)
    assert refused[0].event["trus"]["x_mm"] == "nan"


def test_with_a_full_disk_the_estimate_and_tracking_stay_usable(
    pose_session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, events = empty_copy(pose_session)
    last = max(i for i, event in enumerate(events) if isinstance(event, PairEvent))
    query = next(event for event in events if isinstance(event, TrackEvent) and event.looks)
    with LiveSession.open(folder, make_engine=BatchEngine) as live:
        feed(live, events[:last])
        before, count = live.estimate, live.journal.lines
        event = events[last]
        assert isinstance(event, PairEvent)
        with monkeypatch.context() as broken:
            failing("_write", errno.ENOSPC, broken)
            with pytest.raises(JournalError, match="No space left"):
                live.add(event)
            with pytest.raises(JournalError, match="No space left"):
                live.track(replace(query, t=event.t))
            assert live.track(query, record=False).stage_rad is not None
            assert live.estimate is before
        assert live.journal.lines == count
        live.add(event)
        after = live.estimate
    with LiveSession.open(folder, make_engine=BatchEngine) as live:
        same(live.estimate, after)


def test_a_refusal_that_finds_the_disk_full_is_recorded_when_there_is_room(
    pose_session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, events = empty_copy(pose_session)
    with LiveSession.open(folder, make_engine=BatchEngine) as live:
        assert isinstance(live._engine, BatchEngine)
        live._engine.refuse_t = {events[0].t}
        real, calls = append_only_file._write, 0

        def once(handle: int, data: bytes) -> int:
            nonlocal calls
            calls += 1
            if calls > 1:
                raise OSError(errno.ENOSPC, "No space left on device")
            return real(handle, data)

        with monkeypatch.context() as broken:
            broken.setattr(append_only_file, "_write", once)
            with pytest.raises(EventRefused):
                feed(live, events[:1])
        assert live.journal.lines == 1
        live.record(NoteEvent(events[0].t, 0, "room again"))
    kinds = [type(event) for event in read_session(folder).events]
    assert kinds == [type(events[0]), RefusedEvent, NoteEvent]


def test_an_interrupt_between_disk_and_estimate_loses_nothing(
    pose_session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, events = empty_copy(pose_session)

    def interrupt(_event: object) -> None:
        raise KeyboardInterrupt

    with LiveSession.open(folder, make_engine=BatchEngine) as live:
        feed(live, events[:3])
        with monkeypatch.context() as broken:
            broken.setattr(live._feed, "add", interrupt)
            with pytest.raises(KeyboardInterrupt):
                feed(live, events[3:4])
        feed(live, events[4:6])
        assert [aim.t for aim in live.measurements().aims] == [event.t for event in events[:6]]
    assert [event.t for event in read_session(folder).events] == [event.t for event in events[:6]]


def test_reported_and_detected_moves_of_the_camera_are_epochs_for_every_reader(tmp_path: Path) -> None:
    config = replace(PRESETS["camera-move"], aims=8, pairs=14)
    write_session(simulate(config, 3), tmp_path / "s")
    folder, events = empty_copy(tmp_path / "s")
    reported = next(i for i, event in enumerate(events) if isinstance(event, CameraMovedEvent))
    silent = [event for event in events if not isinstance(event, CameraMovedEvent)]
    after = [event for event in events[reported:] if isinstance(event, PairEvent)]

    def noticing(*arguments: object) -> BatchEngine:
        engine = BatchEngine(*arguments)  # type: ignore[arg-type]
        engine.notice = {after[2].t: after[0].t}
        return engine

    with LiveSession.open(folder, make_engine=noticing) as live:
        feed(live, silent)
        estimate, epochs = live.estimate, [pair.epoch for pair in live.measurements().pairs]
    recorded = read_session(folder)
    moves = [event for event in recorded.events if isinstance(event, CameraMovedEvent)]
    assert [(move.detected, move.since_t) for move in moves] == [(True, after[0].t)]
    # Reopened with an engine that detects again, and with one that needs the report.
    for engine in (noticing, BatchEngine):
        with LiveSession.open(folder, make_engine=engine) as live:
            same(live.estimate, estimate)
            assert [pair.epoch for pair in live.measurements().pairs] == epochs
            assert len(read_session(folder).events) == len(recorded.events)
    solved = extract_measurements(recorded.events, recorded.model).measurements
    assert [pair.epoch for pair in solved.pairs] == epochs
    # A reported move starts an epoch as well.
    (folder / "events.jsonl").unlink()
    with LiveSession.open(folder, make_engine=BatchEngine) as live:
        feed(live, events)
        same(live.estimate, estimate)
