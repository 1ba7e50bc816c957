"""Faults of cube and line under the watchdog: what is reported, and what the stage does. The table in docs/stage.md."""

from __future__ import annotations

import json
import math
import os
import re
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from fgreg.drivers.thorlabs_stage import open_stage
from fgreg.model.session_model import StageModel
from fgreg.stage.limits import MotionKind, MotionLimits
from fgreg.stage.messages import Beat, Command, Message, Request, Reset, encode
from fgreg.stage.watchdog import Watchdog
from tests.cube_emulator import CubeEmulator

MODEL = StageModel(math.radians(2.0), (math.radians(-60.0), math.radians(60.0)))
LIMITS = MotionLimits.of_session(MODEL, heartbeat_s=1.0)
PAUSED = ("the clock jumped", "the stage is silent", "the main program's heartbeat is missing")
"""What stops a stage when this machine pauses for a quarter of a second: right, and no fault of what is tested."""
OVERLOAD = b"\x81\x00\x44\x00\x81\x50" + struct.pack("<HH64s", 0x0453, 7, b"Motor overload")


class _Watched:
    """A watchdog turned in this process, and the main program's end of its link."""

    def __init__(self, port: Path | str) -> None:
        self._main, self._theirs = socket.socketpair()
        self._main.setblocking(False)
        self._emergency = os.pipe()
        self.watchdog = Watchdog(LIMITS, lambda: open_stage(MODEL, port=str(port)), self._theirs, self._emergency[0])
        self.reports: list[dict[str, Any]] = []
        self.state: dict[str, Any] = {"connected": False, "latched": None}
        self._in, self._number = b"", 0

    def send(self, *messages: Message) -> None:
        self._main.send(b"".join(map(encode, messages)))

    def turn(self) -> None:
        self.send(Beat(time.monotonic(), None, None))
        self.watchdog.turn()
        try:
            *lines, self._in = (self._in + self._main.recv(1 << 20)).split(b"\n")
        except BlockingIOError:
            return
        for report in map(json.loads, lines):
            if report["report"] == "status":
                self.state = report
            else:
                self.reports.append(report)

    def until(self, condition: Callable[[], object]) -> None:
        end = time.monotonic() + 8.0
        while not condition():
            assert time.monotonic() < end, (self.reports, self.state)
            self.turn()

    def go(self, deg: float, speed_deg_s: float = 10.0) -> None:
        now, self._number = time.monotonic(), self._number + 1
        angle, speed = math.radians(deg), math.radians(speed_deg_s)
        search = Command(now, self._number, MotionKind.SEARCH, angle, speed, None, "test")
        self.send(Request(now, MotionKind.SEARCH, "test"), search)

    def said(self, text: str) -> bool:
        return any(text in report.get("reason", "") for report in self.reports)

    def arrive(self, deg: float) -> None:
        """Go there, and again where a pause of this machine stopped the stage on its way."""
        at, paused = len(self.reports), True

        def ended() -> bool:
            nonlocal paused
            paused = str(self.state["latched"]).startswith(PAUSED)
            return paused or any(report["report"] == "arrived" for report in self.reports[at:])

        while paused:
            if self.state["latched"]:
                self.reset()
            self.go(deg)
            self.until(ended)

    def reset(self, until: Callable[[], object] | None = None) -> None:
        """The operator's, who says it again until it has been done, or until a condition holds."""
        self.until(lambda: self.state["latched"])
        done = until or (lambda: self.state["latched"] is None)
        while not done():
            self.send(Reset(time.monotonic(), "nurse"))
            self.turn()

    def close(self) -> None:
        if self.watchdog._stage is not None:
            self.watchdog._stage.close()
        self._main.close()
        self._theirs.close()
        for fd in self._emergency:
            os.close(fd)


@contextmanager
def _watched(port: Path | str) -> Iterator[_Watched]:
    watched = _Watched(port)
    try:
        watched.until(lambda: watched.state["connected"] or watched.state["latched"])
        yield watched
    finally:
        watched.close()


@pytest.fixture
def cubes() -> Iterator[Callable[..., CubeEmulator]]:
    made: list[CubeEmulator] = []

    def make(**options: Any) -> CubeEmulator:
        made.append(CubeEmulator(**options))
        return made[-1]

    yield make
    for cube in made:
        if cube._slave is not None:
            cube.close()


@pytest.fixture
def cube(cubes: Callable[..., CubeEmulator]) -> CubeEmulator:
    cube = cubes()
    cube.homed = True
    return cube


@pytest.mark.parametrize(("what", "value"), [("drop", 2), ("garbage", b"\x91\x04\x0e\x00\x81")])
def test_lost_replies_and_garbage_cost_no_motion(cube: CubeEmulator, what: str, value: object) -> None:
    with _watched(cube.port) as watched:
        setattr(cube, what, value)
        watched.until(lambda: watched.state["stage"])
        watched.arrive(1.5)
        assert watched.state["latched"] is None
        assert cube.device_deg == pytest.approx(1.5, abs=0.01)


def test_cube_that_falls_silent_in_a_motion_is_stopped_and_latched(cube: CubeEmulator) -> None:
    with _watched(cube.port) as watched:
        watched.go(40.0)
        watched.until(lambda: cube.device_deg > 0.5)
        cube.drop = 1
        watched.until(lambda: watched.said("the stage is silent"))
        assert watched.reports[-1]["latched"]
        watched.until(lambda: cube.orders[-1][0] == "stop")  # which it hears
        assert cube.device_deg < 10.0
        cube.drop = 0
        watched.until(lambda: watched.state["stage"])
        watched.reset()
        watched.arrive(cube.device_deg + 1.0)


def test_cube_that_is_plugged_in_again_is_stopped_first_and_stays_latched(
    cube: CubeEmulator, cubes: Callable[..., CubeEmulator], tmp_path: Path
) -> None:
    port = tmp_path / "ttyUSB0"
    port.symlink_to(cube.port)
    with _watched(port) as watched:
        watched.go(40.0)
        watched.until(lambda: cube.device_deg > 0.2)
        cube.close()
        port.unlink()
        watched.until(lambda: watched.said("ttyUSB0 is gone") or watched.said("ttyUSB0 takes nothing in"))
        watched.until(lambda: not watched.state["connected"] and watched.state["latched"])
        again = cubes(device_deg=3.0)
        port.symlink_to(again.port)
        watched.until(lambda: watched.state["connected"] and watched.state["stage"] and again.orders)
        assert again.orders[0][0] == "stop"
        assert watched.state["latched"]
        watched.go(3.0)
        watched.until(lambda: watched.said("search refused: latched"))
        watched.reset()
        watched.go(3.0)
        watched.until(lambda: watched.said("search refused: the stage is not homed"))  # its power was off
        assert [name for name, _ in again.orders if name != "stop"] == []


def test_second_link_to_a_cube_is_refused_and_the_first_goes_on(cube: CubeEmulator) -> None:
    with _watched(cube.port) as first:
        first.until(lambda: first.state["stage"])
        first.go(3.0)
        with _watched(cube.port) as second:
            assert "is in use by another program" in second.state["latched"]
            first.arrive(3.0)
            assert first.state["latched"] is None
            first.watchdog._rest("test")  # as at its end: it stops the stage and lets go of the line
            orders = len(cube.orders)
            second.until(lambda: second.state["stage"] and len(cube.orders) > orders)
            assert {name for name, _ in cube.orders[orders:]} == {"stop"}
            second.reset()
            second.arrive(2.0)


def test_cube_that_turns_and_says_it_stands_is_stopped_and_latched(cube: CubeEmulator) -> None:
    with _watched(cube.port) as watched:
        watched.until(lambda: watched.state["stage"] and cube.orders)  # the stop at its start
        cube.claims_rest, cube._rate, cube._target = True, 10.0, 40.0  # not by an order of the watchdog's
        watched.until(lambda: watched.said("the stage says that it stands, and turned by 1."))
        watched.until(lambda: cube._target is None)
        assert cube.device_deg < 3.0
        watched.reset(lambda: watched.said("reset refused: the stage still moves"))


def test_error_that_the_cube_reports_stops_and_latches_with_its_text(cube: CubeEmulator) -> None:
    with _watched(cube.port) as watched:
        watched.go(40.0)
        watched.until(lambda: cube.device_deg > 0.2)
        cube.behind = OVERLOAD
        watched.until(lambda: watched.said("reports an error: code 7, Motor overload, about message 0x0453"))
        assert watched.reports[-1]["latched"]
        watched.until(lambda: cube._target is None)
        assert cube.device_deg < 3.0
        watched.reset(lambda: watched.said("reset refused: stage at"))


def test_tests_that_the_table_of_faults_names_are_there() -> None:
    root = Path(__file__).parents[1]
    table = (root / "docs" / "stage.md").read_text(encoding="utf-8").split("## Faults")[1].split("##")[0]
    named = re.findall(r"`(test_\w+)`", table)
    paths = [*root.glob("tests/test_*stage*.py"), root / "tests" / "test_ros2.py"]
    sources = "".join(path.read_text(encoding="utf-8") for path in paths)
    assert len(named) >= 15
    assert [name for name in named if f"def {name}(" not in sources] == []
