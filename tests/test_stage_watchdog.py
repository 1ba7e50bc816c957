"""The watchdog process: the stage stops whatever happens to the main program; orders are recorded first."""

from __future__ import annotations

import json
import math
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from fgreg.session.event_writer import event_document
from fgreg.stage.client import Report, StageLink, StageRecord
from fgreg.stage.interface import StageError, StageLost
from fgreg.stage.limits import MotionKind
from tests.stage_ends import DEADLINE_S, is_gone, main_program, stopped_after, wait_until
from tests.stage_main import LIMITS, STAGE, beat_for
from tests.traced_stage import read_trace


def test_killed_main_program_stops_the_stage_within_the_deadline(tmp_path: Path) -> None:
    with main_program(tmp_path, "wait") as (process, watchdog, _):
        killed = time.monotonic()
        process.send_signal(signal.SIGKILL)
        assert stopped_after(tmp_path / "trace", killed) <= DEADLINE_S
        wait_until(lambda: is_gone(watchdog))
    log = [json.loads(line) for line in (tmp_path / "watchdog.log").read_text(encoding="utf-8").splitlines()]
    assert [line["command"] for line in log] == ["stop", "search", "stop"]
    assert log[1]["reason"] == "a long way"
    assert log[2]["reason"] == "the main program is gone"
    assert read_trace(tmp_path / "trace")[-1]["what"] == "close"


def test_killed_main_program_whose_child_lives_on_stops_the_stage_by_its_heartbeat(tmp_path: Path) -> None:
    with main_program(tmp_path, "fork and die") as (_, watchdog, began):
        took = stopped_after(tmp_path / "trace", began)
        assert took <= DEADLINE_S
        assert not is_gone(watchdog)
        log = (tmp_path / "watchdog.log").read_text(encoding="utf-8")
        assert json.loads(log.splitlines()[-1])["reason"] == "the main program's heartbeat is missing"


@pytest.mark.parametrize("end", ["stall", "crash", "exit", "thread crash", "emergency", "fall off the end"])
def test_stage_stops_however_the_main_program_ends(tmp_path: Path, end: str) -> None:
    with main_program(tmp_path, end) as (_, _watchdog, began):
        assert stopped_after(tmp_path / "trace", began) <= DEADLINE_S


def test_suspended_main_program_stops_the_stage_and_finds_it_stopped_when_it_goes_on(tmp_path: Path) -> None:
    with main_program(tmp_path, "wait") as (process, watchdog, _):
        process.send_signal(signal.SIGSTOP)
        assert stopped_after(tmp_path / "trace", time.monotonic()) <= DEADLINE_S
        process.send_signal(signal.SIGCONT)
        wait_until(lambda: "heartbeat is missing" in (tmp_path / "events.txt").read_text(encoding="utf-8"))
        assert not is_gone(watchdog)


def test_ctrl_c_stops_the_stage_and_does_not_reach_the_watchdog(tmp_path: Path) -> None:
    with main_program(tmp_path, "wait") as (process, watchdog, _):
        pressed = time.monotonic()
        os.killpg(process.pid, signal.SIGINT)
        assert stopped_after(tmp_path / "trace", pressed) <= DEADLINE_S
        assert process.wait(10.0) == -signal.SIGINT
        wait_until(lambda: is_gone(watchdog))
    log = (tmp_path / "watchdog.log").read_text(encoding="utf-8").splitlines()
    assert json.loads(log[2])["reason"] == "emergency stop"


@pytest.mark.parametrize("number", [signal.SIGUSR1, signal.SIGTERM])
def test_signal_to_the_watchdog_is_an_emergency_stop(tmp_path: Path, number: signal.Signals) -> None:
    with main_program(tmp_path, "wait") as (_, watchdog, _):
        sent = time.monotonic()
        os.kill(watchdog, number)
        assert stopped_after(tmp_path / "trace", sent) <= DEADLINE_S
        if number is signal.SIGTERM:
            wait_until(lambda: is_gone(watchdog))


class _Session:
    """A link in this process with a traced stage behind it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.log = folder, list[StageRecord]()
        self.reports = list[Report]()
        self.refuse_log = False
        options = {"trace": str(folder / "trace")}
        self.link = StageLink.open(
            "tests.traced_stage:open_stage", options, LIMITS, self._sink, folder / "watchdog.log"
        )
        self.run(0.3)

    def _sink(self, record: StageRecord) -> None:
        if self.refuse_log:
            raise OSError("disk full")
        self.log.append(record)

    def run(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self.link.beat(time.monotonic(), "ok")
            self.reports += self.link.poll()
            time.sleep(0.02)

    def until(self, condition: Callable[[], object], seconds: float = 10.0) -> None:
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, f"did not happen: {self.reports} {self.link.view}"
            self.run(0.05)

    def commands(self) -> list[str]:
        return [line["what"] for line in read_trace(self.folder / "trace") if line["what"] not in ("status", "close")]

    def trouble(self, text: str) -> None:
        path = self.folder / "trouble"
        path.with_suffix(".new").write_text(text, encoding="utf-8")
        path.with_suffix(".new").replace(path)


@pytest.fixture
def session(tmp_path: Path) -> Iterator[_Session]:
    session = _Session(tmp_path)
    with session.link:
        yield session


def test_orders_are_written_down_before_they_are_given_and_arrivals_come_back(session: _Session) -> None:
    session.link.request(MotionKind.SEARCH, "pedal")
    number = session.link.search_to(math.radians(3.0), "sweep, position 1")
    session.until(lambda: Report("arrived", "", number) in session.reports)
    assert [(record.command, record.reason) for record in session.log] == [
        ("request search", "pedal"),
        ("search", "sweep, position 1"),
    ]
    assert session.commands() == ["stop", "move"]
    moved = next(line["t"] for line in read_trace(session.folder / "trace") if line["what"] == "move")
    assert session.log[1].host_s < moved
    written = json.loads((session.folder / "watchdog.log").read_text(encoding="utf-8").splitlines()[1])
    assert written["t"] < moved
    event = session.log[1].event(12.0, STAGE)
    assert (event.t, event.command, event.reason) == (12.0, "search", "sweep, position 1")
    assert event.scan_deg == pytest.approx(3.0)
    assert event_document(event, session.folder)["type"] == "stage"

    def stands() -> float:
        view = session.link.view
        return math.inf if view is None or view.status is None else math.degrees(view.status.scan_rad)

    session.until(lambda: abs(stands() - 3.0) < 0.01)


def test_order_that_cannot_be_logged_is_not_given_but_a_stop_is(session: _Session) -> None:
    session.link.request(MotionKind.SEARCH, "pedal")
    session.refuse_log = True
    with pytest.raises(OSError, match="disk full"):
        session.link.search_to(math.radians(3.0), "sweep")
    session.run(0.2)
    assert session.commands() == ["stop"]
    with pytest.raises(OSError, match="disk full"):
        session.link.stop("enough")
    session.refuse_log = False
    session.until(lambda: session.commands() == ["stop", "stop"])
    session.until(lambda: any(report.what == "stopped" for report in session.reports))


def test_a_stop_does_not_wait_for_its_log(session: _Session, monkeypatch: pytest.MonkeyPatch) -> None:
    session.link.request(MotionKind.SEARCH, "pedal")
    session.link.search_to(math.radians(30.0), "far")
    session.until(lambda: "move" in session.commands())
    # A log that waits for the disk: no heartbeat comes meanwhile, which stops the stage, too, but later.
    monkeypatch.setattr(session.link, "_log", lambda _: wait_until(lambda: session.commands()[-1] == "stop"))
    session.link.stop("enough")
    written = (session.folder / "watchdog.log").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["reason"] for line in written[1:3]] == ["far", "enough"]


def test_refusals_and_stops_are_reported_and_stops_are_logged(session: _Session) -> None:
    number = session.link.track_to(0.1, 0.01, "beam")
    session.until(lambda: session.reports)
    assert session.reports.pop() == Report("refused", "track refused: the operator has not asked to track", number)
    session.link.emergency_stop("button")
    session.until(lambda: any(report.what == "stopped" and report.latched for report in session.reports))
    session.until(lambda: session.link.view is not None and session.link.view.latched == "emergency stop")
    assert [record.command for record in session.log if record.command != "track"] == ["emergency stop", "stop"]
    session.link.reset("nurse")
    session.until(lambda: session.link.view is not None and session.link.view.latched is None)


def test_unplugged_stage_is_reported_within_a_second_and_comes_back(session: _Session) -> None:
    session.trouble("unplugged")
    began = time.monotonic()
    session.until(lambda: any("unplugged" in report.reason for report in session.reports))
    assert time.monotonic() - began < 1.0
    session.until(lambda: session.link.view is not None and not session.link.view.connected)
    session.trouble("")
    session.until(lambda: session.link.view is not None and session.link.view.connected)
    assert session.commands()[-1] == "stop"
    session.link.request(MotionKind.SEARCH, "pedal")
    session.until(lambda: any("latched" in report.reason for report in session.reports))
    session.link.reset("nurse")
    session.link.request(MotionKind.SEARCH, "pedal")
    session.link.search_to(math.radians(2.0), "again")
    session.until(lambda: any(report.what == "arrived" for report in session.reports))


def test_stop_that_the_stage_does_not_take_is_tried_again(session: _Session) -> None:
    session.link.request(MotionKind.SEARCH, "pedal")
    session.link.search_to(math.radians(30.0), "far")
    session.until(lambda: "move" in session.commands())
    session.trouble("stop fails")
    session.link.stop("enough")
    session.until(lambda: session.commands().count("stop") >= 5)
    session.until(lambda: not read_trace(session.folder / "trace")[-1].get("moving", True))
    assert session.commands()[-1] == "stop"


def test_bug_in_the_driver_stops_the_stage_and_is_noticed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    session = _Session(tmp_path)
    session.link.request(MotionKind.SEARCH, "pedal")
    session.link.search_to(math.radians(30.0), "far")
    session.until(lambda: "move" in session.commands())
    session.trouble("broken driver")
    with pytest.raises(StageLost, match="watchdog"):
        session.run(10.0)
    assert session.commands()[-1] == "stop"
    with pytest.raises(StageLost):
        session.link.search_to(0.0, "no")
    with pytest.raises(StageLost):
        session.link.poll()
    session.link.close()
    session.link.close()
    assert "ZeroDivisionError" in capfd.readouterr().err


def test_garbage_on_the_line_latches(session: _Session) -> None:
    session.link._socket.sendall(b"hello\n")
    session.until(lambda: any("cannot be read" in report.reason and report.latched for report in session.reports))
    session.until(lambda: session.link.view is not None and session.link.view.latched is not None)
    assert "cannot be read" in str(session.link.view)


@pytest.mark.parametrize(
    ("driver", "options", "says"),
    [
        ("tests.traced_stage:nothing", {}, "AttributeError"),
        ("nowhere.at_all:open_stage", {}, "No module named"),
        ("tests.traced_stage", {}, "package.module:factory"),
        ("tests.traced_stage:open_stage", {"colour": 3}, "colour"),
    ],
)
def test_driver_that_does_not_start_is_one_line(driver: str, options: dict[str, Any], says: str) -> None:
    with pytest.raises(StageError, match="did not start") as caught:
        StageLink.open(driver, options, LIMITS, list[StageRecord]().append)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_leaving_by_an_exception_is_an_emergency_stop(tmp_path: Path) -> None:
    session = _Session(tmp_path)

    def work() -> None:
        with session.link:
            session.link.request(MotionKind.SEARCH, "pedal")
            session.link.search_to(math.radians(30.0), "far")
            beat_for(session.link, 0.5)
            raise KeyError

    with pytest.raises(KeyError):
        work()
    assert session.commands()[:3] == ["stop", "move", "stop"]
    log = (tmp_path / "watchdog.log").read_text(encoding="utf-8").splitlines()
    assert json.loads(log[2])["reason"] in ("emergency stop", "the main program is gone")
