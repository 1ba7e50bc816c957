"""The online registration in a process of its own."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from fgreg.errors import EventRefused, FgregError
from fgreg.live.launch import EngineProcesses
from fgreg.model.measurements import Measurements, Track
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online import engine_process
from fgreg.online.engine import OnlineRegistration
from fgreg.online.engine_process import EngineGone, EngineProcess
from fgreg.online.events import OnlineEvent
from fgreg.tracking.query import track
from tests.forward import make_measurements
from tests.online_streams import restored

Case = tuple[SessionModel, Measurements]
PATIENCE_S = 60.0


def events(measurements: Measurements) -> tuple[OnlineEvent, ...]:
    return (*measurements.aims, *measurements.pairs)


@pytest.fixture(scope="module")
def case() -> Case:
    model, measurements, _ = make_measurements(np.random.default_rng(5), aims=10, pairs=9)
    return model, measurements


@pytest.fixture(scope="module")
def started(case: Case) -> Iterator[EngineProcess]:
    """After all events of the case, and the full solve of them."""
    with EngineProcess(case[0], SolveConfig()) as engine:
        for event in events(case[1]):
            engine.add(event)
        end = time.monotonic() + PATIENCE_S
        while not engine.refresh().settled:
            assert time.monotonic() < end
            time.sleep(0.02)
        yield engine


def test_it_reports_what_the_engine_reports(case: Case, started: EngineProcess) -> None:
    model, measurements = case
    here = restored(OnlineRegistration(model, find_moves=False), measurements)
    there, known = started.refresh(), here.estimate
    assert (there.verdict, there.reasons, there.pairs) == (known.verdict, known.reasons, known.pairs)
    assert there.trus_T_camera is not None
    assert known.trus_T_camera is not None
    np.testing.assert_allclose(there.trus_T_camera, known.trus_T_camera, atol=1e-6)
    taken = started.measurements()
    assert len(taken.pairs) == len(measurements.pairs)
    beam, wanted = started.marker_T_laser(), here.marker_T_laser()
    assert beam is not None
    assert wanted is not None
    np.testing.assert_allclose(beam, wanted, atol=0.01)


def test_queries_are_answered_from_its_snapshot(case: Case, started: EngineProcess) -> None:
    settled = started.settle()
    assert settled.settled
    pair = case[1].pairs[3]
    query = Track(pair.t, 0, pair.marker, (pair.look,))
    reader = started.reader()
    answer = track(query, reader.snapshot())
    assert answer.stage_rad is not None
    assert answer.stage_rad == started.track(query).stage_rad
    reader.close()


def test_a_refused_event_is_refused_here_and_later_ones_work(case: Case, started: EngineProcess) -> None:
    pair = case[1].pairs[-1]
    late = started.refresh().t
    with pytest.raises(EventRefused, match="before the last event"):
        started.add(replace(pair, t=late - 50.0))
    wrong = replace(pair, t=late + 1.0, look=replace(pair.look, range_mm=float("nan")))
    with pytest.raises(EventRefused, match="range_mm"):
        started.add(wrong)
    assert started.add(replace(pair, t=late + 2.0, pm=77)).pairs >= 9


def test_a_killed_process_is_said_and_ends_without_a_wait(case: Case) -> None:
    engine = EngineProcess(case[0], SolveConfig())
    engine.add(case[1].aims[0])
    assert engine.pid is not None
    os.kill(engine.pid, signal.SIGKILL)
    with pytest.raises(EngineGone, match="open the session again"):
        engine.add(case[1].aims[1])
    began = time.monotonic()
    engine.close()
    assert not engine.alive
    assert time.monotonic() - began < 3.0
    with pytest.raises(FileNotFoundError):  # its memory is gone with it
        engine.reader()


def test_it_ends_when_it_is_closed_and_its_memory_with_it(case: Case) -> None:
    engine = EngineProcess(case[0], SolveConfig())
    reader = engine.reader()
    (process,) = [child for child in multiprocessing.active_children() if child.pid == engine.pid]
    engine.close()
    assert process.exitcode == 0
    assert not engine.alive
    assert reader.read().closed
    reader.close()
    with pytest.raises(FileNotFoundError):
        engine.reader()


def test_one_that_hangs_is_killed(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine_process, "ANSWER_S", 1.0)
    with EngineProcess(case[0], SolveConfig()) as engine:
        assert engine.pid is not None
        os.kill(engine.pid, signal.SIGSTOP)
        with pytest.raises(EngineGone):
            engine.refresh()
        assert not engine.alive


def test_a_model_that_no_engine_takes_is_said() -> None:
    with pytest.raises(FgregError, match="AttributeError"):
        EngineProcess(None, SolveConfig())  # type: ignore[arg-type]


def engine_pids() -> set[int | None]:
    return {child.pid for child in multiprocessing.active_children() if child.name == "fgreg-engine"}


@pytest.fixture
def engines() -> Iterator[EngineProcesses]:
    others, found = engine_pids(), EngineProcesses()
    yield found
    found.close()
    assert engine_pids() <= others


def started_spare(engines: EngineProcesses, model: SessionModel) -> int:
    """Process id of the spare process that is started now."""
    before = engine_pids()
    for _ in range(2):
        engines.keep_spare(model, SolveConfig())
    (found,) = engine_pids() - before
    assert found is not None
    return found


def kill(pid: int) -> None:
    os.kill(pid, signal.SIGKILL)
    os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)


def test_the_next_engine_is_in_the_spare_process(case: Case, engines: EngineProcesses) -> None:
    model, config = case[0], SolveConfig()
    first = engines(model, config)
    spare = started_spare(engines, model)
    assert first.pid is not None
    kill(first.pid)
    second = engines(model, config)
    assert second.pid == spare
    second.add(case[1].aims[0])
    assert len(second.measurements().aims) == 1


def test_a_spare_process_that_has_ended_or_is_of_other_settings_is_not_used(
    case: Case, engines: EngineProcesses
) -> None:
    model, config = case[0], SolveConfig()
    engines(model, config)
    kill(started_spare(engines, model))
    spare = started_spare(engines, model)
    kill(spare)
    engine = engines(model, config)
    engine.add(case[1].aims[0])
    spare = started_spare(engines, model)
    engine = engines(model, replace(config, limit_mm=2.0))
    assert engine.pid != spare
    assert spare not in engine_pids()


def test_a_spare_process_that_hangs_is_not_used_nor_waited_for(case: Case, engines: EngineProcesses) -> None:
    model, config = case[0], SolveConfig()
    engines(model, config)
    spare = started_spare(engines, model)
    assert engines._spare is not None
    assert engines._spare[2].answers(PATIENCE_S)
    os.kill(spare, signal.SIGSTOP)
    assert engines(model, config).pid != spare
    assert spare not in engine_pids()
    spare = started_spare(engines, model)
    os.kill(spare, signal.SIGKILL)  # it may end between the check and its use
    assert engines(model, config).alive


def test_closed_engines_leave_no_spare_process_and_start_none(
    case: Case, engines: EngineProcesses, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = engines(case[0], SolveConfig())
    started_spare(engines, case[0])
    with monkeypatch.context() as broken:
        broken.setattr(EngineProcess, "close", lambda _self: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            engines.close()
    others = engine_pids() - {engine.pid}
    engines.keep_spare(case[0], SolveConfig())
    assert engine_pids() - {engine.pid} == others
    assert engines._spare is None
