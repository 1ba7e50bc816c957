"""The recorder loses nothing that was handed over: what a full disk refuses waits, and is reported."""

from __future__ import annotations

import errno
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from fgreg.live.recorder import Recorder
from fgreg.model.events import AimEvent, NoteEvent, PairEvent
from fgreg.online.live_session import LiveSession
from fgreg.session.session_reader import read_session
from tests.batch_engine import BatchEngine
from tests.test_journal import failing


def wait_for(condition: Callable[[], object]) -> None:
    end = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end, "did not happen"
        time.sleep(0.01)


def fed(session: Path) -> list[AimEvent | PairEvent]:
    """The session's shots; its folder is left without events."""
    events = [event for event in read_session(session).events if isinstance(event, AimEvent | PairEvent)]
    (session / "events.jsonl").unlink()
    return events


def test_with_a_full_disk_events_wait_and_are_recorded_when_there_is_room(
    pose_session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    events = fed(pose_session)[:9]
    with LiveSession.open(pose_session, make_engine=BatchEngine, late=True) as live:
        recorder = Recorder(live)
        for event in events[:3]:
            recorder.hand_over(event)
        wait_for(lambda: recorder.state.aims == 3)
        with monkeypatch.context() as broken:
            failing("_write", errno.ENOSPC, broken)
            for event in events[3:]:
                recorder.hand_over(event)
            recorder.hand_over(NoteEvent(events[-1].t, 0, "recording lost"))
            wait_for(lambda: recorder.state.blocked)
            time.sleep(0.5)
            assert "No space left" in recorder.state.blocked
            assert recorder.state.waiting == len(events) - 3 + 1
            assert recorder.state.aims == 3
        wait_for(lambda: not recorder.state.waiting)
        recorder.close()
        assert recorder.state.blocked == ""
        assert len(live.measurements().aims) == len(events)
    assert [event.t for event in read_session(pose_session).events] == [*(e.t for e in events), events[-1].t]


def test_a_recorder_ends_although_the_disk_stays_full_and_says_what_it_could_not_record(
    pose_session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    events = fed(pose_session)[:3]
    with LiveSession.open(pose_session, make_engine=BatchEngine, late=True) as live:
        recorder = Recorder(live)
        failing("_write", errno.ENOSPC, monkeypatch)
        for event in events:
            recorder.hand_over(event)
        began = time.monotonic()
        recorder.close()
        assert time.monotonic() - began < 30.0
        assert recorder.state.waiting == 3
        assert "No space left" in recorder.state.blocked
