"""Sessions with the registration in a process: opened again, and going on where the process ends."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgreg.errors import EventRefused, FgregError
from fgreg.live import recorder as recorder_module
from fgreg.live.launch import NewestSnapshots
from fgreg.live.recorder import ENGINE_ENDED, Recorder
from fgreg.model.estimate import Verdict
from fgreg.model.events import AimEvent, CameraMovedEvent, NoteEvent, PairEvent, RefusedEvent
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine_process import EngineGone, EngineProcess
from fgreg.online.estimate import OnlineEstimate
from fgreg.online.events import OnlineEvent
from fgreg.online.live_session import MOST_DEATHS, LiveSession
from fgreg.session.journal import Journal
from fgreg.session.session_reader import read_session
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session

Shots = list[AimEvent | PairEvent | CameraMovedEvent]
PATIENCE_S = 120.0


@pytest.fixture
def session(tmp_path: Path) -> tuple[Path, Shots]:
    """An empty session, and the events of 8 aims and 18 pairs in two epochs for it."""
    config = replace(PRESETS["camera-move"], aims=8, pairs=18)
    write_session(simulate(config, 3), tmp_path / "s")
    events = read_session(tmp_path / "s").events
    (tmp_path / "s" / "events.jsonl").unlink()
    return tmp_path / "s", [e for e in events if isinstance(e, AimEvent | PairEvent | CameraMovedEvent)]


class Processes:
    """Makes engines that are processes."""

    def __init__(self) -> None:
        self.made: list[EngineProcess] = []

    def __call__(self, model: SessionModel, config: SolveConfig) -> EngineProcess:
        self.made.append(EngineProcess(model, config))
        return self.made[-1]

    def kill(self) -> None:
        """End the last one at once, from outside."""
        pid = self.made[-1].pid
        assert pid is not None
        os.kill(pid, signal.SIGKILL)


@contextmanager
def processes() -> Iterator[Processes]:
    """Ends them all."""
    found = Processes()
    try:
        yield found
    finally:
        for engine in found.made:
            engine.close()


def same(a: OnlineEstimate | None, b: OnlineEstimate | None, atol: float = 1e-9) -> None:
    assert a is not None
    assert b is not None
    assert (a.epoch, a.pairs, a.verdict, a.settled, a.reasons) == (b.epoch, b.pairs, b.verdict, b.settled, b.reasons)
    for x, y in ((a.trus_T_camera, b.trus_T_camera), (a.covariance, b.covariance)):
        assert x is not None
        assert y is not None
        np.testing.assert_allclose(x, y, rtol=0, atol=atol)


def test_what_a_process_recorded_is_opened_by_another_and_by_this_one_and_the_reverse(
    session: tuple[Path, Shots],
) -> None:
    folder, events = session
    with processes() as engines:
        with LiveSession.open(folder, make_engine=engines) as live:
            for event in events[:-5]:
                live.add(event)
            unbroken = live.settle()
        assert len(engines.made) == 1
        with LiveSession.open(folder, make_engine=engines) as live:
            opened = live.estimate  # at once, without asking for a full solve
            assert opened is not None
            assert opened.settled
            same(opened, unbroken, 1e-6)
        with LiveSession.open(folder) as live:
            same(live.estimate, opened)
            for event in events[-5:-2]:
                live.add(event)
        with LiveSession.open(folder, make_engine=engines) as live:
            for event in events[-2:]:
                live.add(event)
            end = live.settle()
        assert end.pairs == unbroken.pairs + 5


def test_a_process_that_ends_while_a_session_is_opened_is_reported(
    session: tuple[Path, Shots], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, events = session
    with LiveSession.open(folder) as live:
        for event in events[:12]:
            live.add(event)
        expected = live.settle()
    with processes() as engines:
        with monkeypatch.context() as patch:
            real = EngineProcess.add

            def dying(self: EngineProcess, event: OnlineEvent) -> OnlineEstimate:
                engines.kill()
                return real(self, event)

            patch.setattr(EngineProcess, "add", dying)
            with pytest.raises(EngineGone):
                LiveSession.open(folder, make_engine=engines)
        with LiveSession.open(folder, make_engine=engines) as live:  # nothing is lost, and the session is not locked
            same(live.settle(), expected, 1e-6)


def test_a_killed_registration_is_revived_without_the_session_being_closed(session: tuple[Path, Shots]) -> None:
    folder, events = session
    with processes() as engines, LiveSession.open(folder, make_engine=engines) as live:
        for number, event in enumerate(events):
            if number in (3, 17, 18):
                engines.kill()
                with pytest.raises(EngineGone):
                    live.add(event)
                note = NoteEvent(event.t, 0, "meanwhile")
                with pytest.raises(EngineGone):
                    live.record(note)
                live.revive()
            else:
                live.add(event)
        found = live.settle()
    recorded = read_session(folder)
    assert [e for e in recorded.events if isinstance(e, RefusedEvent)] == []
    shots = [(type(e), e.t) for e in recorded.events if isinstance(e, AimEvent | PairEvent | CameraMovedEvent)]
    assert shots == [(type(e), e.t) for e in events]
    assert sum(isinstance(e, NoteEvent) for e in recorded.events) == 3
    with LiveSession.open(folder) as live:
        same(live.settle(), found, 1e-6)


def test_a_restart_that_fails_half_way_counts_nothing_twice_and_blames_no_event(
    session: tuple[Path, Shots], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, events = session
    with processes() as engines, LiveSession.open(folder, make_engine=engines) as live:
        for event in events[:14]:
            live.add(event)
        engines.kill()
        with pytest.raises(EngineGone):
            live.add(events[14])
        with monkeypatch.context() as broken:

            def no_memory(_journal: Journal) -> object:
                raise FgregError("out of memory")

            broken.setattr(Journal, "events", property(no_memory))
            for _ in range(MOST_DEATHS + 1):
                with pytest.raises(FgregError, match="out of memory"):
                    live.revive()
        assert engines.made[-1].alive
        with pytest.raises(EngineGone):  # one that has not taken in everything is not gone on with
            live.add(events[15])
        with pytest.raises(EngineGone):
            live.refresh()
        live.revive()
        found = live.settle()
        assert len(live.measurements().pairs) == sum(isinstance(event, PairEvent) for event in events[:16])
    assert not [event for event in read_session(folder).events if isinstance(event, RefusedEvent)]
    with LiveSession.open(folder) as live:
        same(live.settle(), found, 1e-6)


@pytest.mark.parametrize("what", ["one is refused", "it ends"])
def test_recorded_events_that_cannot_be_taken_in_together_are_taken_in_one_by_one(
    session: tuple[Path, Shots], monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    folder, events = session
    with processes() as engines, LiveSession.open(folder, make_engine=engines) as live:
        for event in events[:14]:
            live.add(event)
        expected, real = live.settle(), EngineProcess._call
        calls: list[str] = []

        def call(self: EngineProcess, name: str, *arguments: object) -> object:
            calls.append(name)
            if name == "add_all" and what == "it ends":
                engines.kill()
            elif name == "add_all":
                raise EventRefused("for a reason")
            return real(self, name, *arguments)

        monkeypatch.setattr(EngineProcess, "_call", call)
        if what == "it ends":
            with pytest.raises(EngineGone):
                live.revive()
        same(live.revive(), expected, 1e-6)
        assert calls.count("add_all") == 1
        assert calls.count("add") == 14
        monkeypatch.undo()
        calls.clear()
        same(live.revive(), expected, 1e-6)
        assert len(engines.made) == 4
    assert not [event for event in read_session(folder).events if isinstance(event, RefusedEvent)]


class Deadly(EngineProcess):
    """Ends at the pair of one PM, each time it comes."""

    def add(self, event: OnlineEvent) -> OnlineEstimate:
        if getattr(event, "pm", None) == 4:
            pid = self.pid
            assert pid is not None
            os.kill(pid, signal.SIGKILL)
        return super().add(event)


def test_an_event_that_ends_the_registration_again_and_again_is_refused(session: tuple[Path, Shots]) -> None:
    folder, events = session
    made: list[Deadly] = []

    def make(model: SessionModel, config: SolveConfig) -> Deadly:
        made.append(Deadly(model, config))
        return made[-1]

    try:
        with LiveSession.open(folder, make_engine=make) as live:
            deaths = 0
            for event in events[:16]:
                try:
                    live.add(event)
                except EngineGone:
                    while True:
                        deaths += 1
                        try:
                            live.revive()
                        except EngineGone:
                            continue
                        break
            assert deaths == MOST_DEATHS
            kept = {pair.pm for pair in live.measurements().pairs}
    finally:
        for engine in made:
            engine.close()
    fed = {event.pm for event in events[:16] if isinstance(event, PairEvent)}
    assert 4 in fed
    assert kept == fed - {4}
    refused = [event for event in read_session(folder).events if isinstance(event, RefusedEvent)]
    assert len(refused) == 1
    assert "has ended" in refused[0].reason


def test_a_recorder_goes_on_by_itself_and_nothing_waits_for_it(
    session: tuple[Path, Shots], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "AGAIN_S", 0.5)
    folder, events = session
    verdicts: list[Verdict] = []
    with processes() as engines, LiveSession.open(folder, make_engine=engines, late=True) as live:
        snapshots = NewestSnapshots(live)
        recorder = Recorder(live)
        longest = 0.0

        def until(done: int, made: int) -> None:
            """Queries go on while the recorder works; the longest of them is kept."""
            nonlocal longest
            end = time.monotonic() + PATIENCE_S
            while time.monotonic() < end:
                start = time.perf_counter()
                state = recorder.state
                if state.pairs and state.estimate is not None:
                    assert snapshots.read().snapshot.epochs
                longest = max(longest, time.perf_counter() - start)
                if ENGINE_ENDED in state.registration.reasons:
                    verdicts.append(state.registration.verdict)
                taken_in = not state.waiting and state.aims + state.pairs >= done
                if taken_in and not state.trouble and len(engines.made) >= made:
                    return
                time.sleep(0.005)
            raise AssertionError(recorder.state)

        shots = [event for event in events if not isinstance(event, CameraMovedEvent)]
        try:
            for event in shots[:12]:
                recorder.hand_over(event)
            until(12, 1)
            for made, start in enumerate((12, 19), 2):
                killer = threading.Timer(0.05, engines.kill)
                killer.start()
                for event in shots[start : start + 7]:
                    recorder.hand_over(event)
                killer.join()
                until(start + 7, made)
                recorder.hand_over(NoteEvent(shots[start + 6].t, 0, "after"))
        finally:
            recorder.close()
        assert recorder.state.refused == 0
        taken = live.measurements()
    assert len(engines.made) == 3
    assert verdicts
    assert all(verdict.severity >= Verdict.WARNING.severity for verdict in verdicts)
    assert longest < 2.0
    fed = [event.t for event in shots if isinstance(event, PairEvent)]
    assert [pair.t for pair in taken.pairs] == fed
    assert not [event for event in read_session(folder).events if isinstance(event, RefusedEvent)]
