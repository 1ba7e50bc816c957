"""The main program's link to the stage: orders go to the watchdog, reports and status come back.

    with StageLink.open("fgreg.drivers.simulated_stage:open_stage", {}, limits, log=sink) as stage:
        while running:
            stage.beat(marker_s, "ok")               # once in every step of the main loop, from that loop
            for report in stage.poll(): ...
            stage.request(MotionKind.TRACK, "foot pedal")    # only on an operator's action
            stage.track_to(scan_rad, sigma_rad, "the beam moved")

The heartbeat has to come from the loop whose stalling matters; a separate thread would go on beating. Every order is
passed to ``log`` before it is sent, and is not sent if that raises; a stop is sent first. Leaving the ``with`` block by
an exception, Ctrl-C, an uncaught exception in any thread, the end of the interpreter and
``stop_on_exit.emergency_stop_all`` all stop the stage. If the main program is killed or stalls, the watchdog stops it.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from fgreg.model.events import StageEvent
from fgreg.model.session_model import StageModel
from fgreg.model.time_sync import Stamp
from fgreg.stage import stop_on_exit
from fgreg.stage.interface import StageError, StageLost, StageStatus
from fgreg.stage.limits import MotionKind, MotionLimits
from fgreg.stage.messages import Beat, Command, Message, Request, Reset, Stop, encode
from fgreg.stage.watchdog import WatchdogSetup

START_S = 20.0
"""Longest start of the watchdog."""
SEND_S = 0.5
"""Longest time until the watchdog takes a message."""
CLOSE_S = 5.0
"""Longest time that the watchdog may take to stop the stage when the link is closed."""
SILENT_S = 0.7
"""A watchdog that is silent for this long is lost: it sends the stage's status every 50 ms."""


@dataclass(frozen=True, slots=True)
class StageRecord:
    """An order for the session's log: ``scan_rad`` is the plane's angle."""

    host_s: float
    command: str
    scan_rad: float | None
    reason: str

    def event(self, t: float, model: StageModel) -> StageEvent:
        """As a ``stage`` event at session time ``t``; angles of events are the device's, in degrees."""
        device = None if self.scan_rad is None else math.degrees(model.device_from_scan(self.scan_rad))
        return StageEvent(t, 0, self.command, device, self.reason)


LogSink = Callable[[StageRecord], None]


@dataclass(frozen=True, slots=True)
class Report:
    """An event at the watchdog.

    Attributes:
        what: ``refused`` (a command or request, ``number`` of the command), ``stopped``, ``arrived`` (``number``),
            ``trouble`` (with the device or the watchdog's log).
        latched: of ``stopped``: nothing moves until :meth:`StageLink.reset`.
    """

    what: str
    reason: str = ""
    number: int | None = None
    latched: bool = False


@dataclass(frozen=True, slots=True)
class StageView:
    """The newest state that the watchdog reported.

    Attributes:
        at_s: host time of the report.
        connected: whether the stage is connected.
        status: of the stage; None if unknown.
        moving, requested: kind of motion under way, and kind requested by the operator.
        latched: why nothing may move until a reset; None if the stage may move.
    """

    at_s: float
    connected: bool
    status: StageStatus | None
    moving: MotionKind | None
    requested: MotionKind | None
    latched: str | None


class StageLink:
    """Link to the watchdog, made by :meth:`open`; may be used from several threads.

    Attributes:
        view: the newest status, as of the last :meth:`poll`.
    """

    def __init__(
        self,
        process: subprocess.Popen[bytes],
        link: socket.socket,
        emergency_fd: int,
        log: LogSink,
        limits: MotionLimits,
    ) -> None:
        self.limits = limits
        self.view: StageView | None = None
        self._process, self._socket, self._emergency_fd, self._log = process, link, emergency_fd, log
        self._turn = threading.Lock()
        self._in = b""
        self._number = 0
        self._received_s = time.monotonic()
        self._closed = False
        self._lost: str | None = None
        self._reports: list[Report] = []
        self._unlogged: list[Report] = []

    @classmethod
    def open(
        cls,
        driver: str,
        options: Mapping[str, Any],
        limits: MotionLimits,
        log: LogSink,
        watchdog_log: Path | None = None,
        start_s: float = START_S,
    ) -> Self:
        """Start the watchdog and wait until it is ready. The stage may connect later.

        Args:
            driver: ``package.module:factory`` of the stage's driver.
            options: keyword arguments of the factory, as JSON holds them.
            log: gets every order before it is sent, a stop after that, and each stop of the watchdog's own once it is
                reported.
            watchdog_log: the watchdog's own log file, which also has stops after the main program has ended.

        Raises:
            StageError: the watchdog or the driver did not start, with the reason.
        """
        ours, theirs = socket.socketpair()
        emergency_read, emergency_write = os.pipe()
        root = str(Path(__file__).resolve().parents[2])
        path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
        try:
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", "fgreg.stage.watchdog", str(theirs.fileno()), str(emergency_read)],
                pass_fds=(theirs.fileno(), emergency_read),
                stdin=subprocess.DEVNULL,
                start_new_session=True,
                env={**os.environ, "PYTHONPATH": path},
            )
        except OSError as error:
            ours.close()
            os.close(emergency_write)
            raise StageError(f"the stage's watchdog could not be started: {error}") from error
        finally:
            theirs.close()
            os.close(emergency_read)
        link = cls(process, ours, emergency_write, log, limits)
        try:
            setup = WatchdogSetup(
                driver, dict(options), limits, None if watchdog_log is None else os.fspath(watchdog_log)
            )
            ours.settimeout(start_s)
            ours.sendall(setup.line())
            link._await_ready(start_s)
        except BaseException:
            link.abandon()
            raise
        ours.setblocking(False)
        stop_on_exit.add(link)
        return link

    @property
    def pid(self) -> int:
        """Process id of the watchdog: ``kill -USR1`` is an emergency stop from outside of the program."""
        return self._process.pid

    # -- messages to the watchdog

    def beat(self, marker_s: float | None = None, registration: str | None = None) -> None:
        """Send the main loop's heartbeat, with what tracking depends on: the host time of the exposure in which the
        marker was last detected, and the verdict of the current registration; None for none."""
        self._send(Beat(time.monotonic(), marker_s, registration))

    def request(self, kind: MotionKind, by: str) -> None:
        """Request motion of a kind for the operator; call it only on an operator's action."""
        self._log(StageRecord(time.monotonic(), f"request {kind}", None, by))
        self._send(Request(time.monotonic(), kind, by))

    def home(self, reason: str, speed_rad_s: float | None = None) -> int:
        """Turn to the zero position. Returns the command's number, which reports refer to."""
        return self._command(MotionKind.HOME, None, speed_rad_s, None, reason)

    def search_to(self, scan_rad: float, reason: str, speed_rad_s: float | None = None) -> int:
        """Turn to the next position of a search."""
        return self._command(MotionKind.SEARCH, scan_rad, speed_rad_s, None, reason)

    def track_to(self, scan_rad: float, sigma_rad: float, reason: str, speed_rad_s: float | None = None) -> int:
        """Follow the beam: turn to a tracking result with this standard deviation."""
        return self._command(MotionKind.TRACK, scan_rad, speed_rad_s, sigma_rad, reason)

    def stop(self, reason: str) -> None:
        """Stop; the operator has to request again. It is logged once it is sent: a log may wait for the disk."""
        now = time.monotonic()
        try:
            self._send(Stop(now, False, reason))
        finally:
            self._log(StageRecord(now, "stop", None, reason))

    def emergency_stop(self, reason: str) -> None:
        """Stop now, and latch until :meth:`reset`. Works from any thread, and if the socket is blocked."""
        self.press()
        self._log(StageRecord(time.monotonic(), "emergency stop", None, reason))

    def latch(self, reason: str) -> None:
        """Stop the stage, and latch it until :meth:`reset`, with a reason."""
        self._send(Stop(time.monotonic(), True, reason))

    def reset(self, by: str) -> None:
        """Reset the latch after the operator's inspection. Refused while the stage moves or is silent."""
        self._log(StageRecord(time.monotonic(), "reset", None, by))
        self._send(Reset(time.monotonic(), by))

    def _command(
        self, kind: MotionKind, scan_rad: float | None, speed: float | None, sigma: float | None, reason: str
    ) -> int:
        with self._turn:
            self._number += 1
            number = self._number
        self._log(StageRecord(time.monotonic(), str(kind), scan_rad, reason))
        scan_rad, sigma = (None if value is None else float(value) for value in (scan_rad, sigma))
        speed = self.limits.speed(kind) if speed is None else float(speed)
        self._send(Command(time.monotonic(), number, kind, scan_rad, speed, sigma, reason))
        return number

    def _send(self, message: Message) -> None:
        try:
            line = encode(message)
        except ValueError as error:
            raise StageError(f"{message} cannot be sent: {error}") from error
        if self._lost is not None:
            raise StageLost(self._lost)
        try:
            with self._turn:
                until = time.monotonic() + SEND_S
                while line:
                    wait = max(0.0, until - time.monotonic())
                    if not select.select([], [self._socket], [], wait)[1]:
                        raise TimeoutError("it takes no message")
                    line = line[self._socket.send(line) :]
        except (OSError, ValueError) as error:  # a line cut short is unreadable: the watchdog stops the stage for it
            raise self._give_up(f"the stage's watchdog takes no orders: {error}") from error

    def press(self) -> None:
        """Emergency stop by the pipe: one byte, no lock, safe in a signal handler."""
        with contextlib.suppress(OSError):
            os.write(self._emergency_fd, b"!")

    def _give_up(self, reason: str) -> StageLost:
        self._lost = reason
        self.press()
        return StageLost(reason)

    # -- messages from the watchdog

    def poll(self) -> list[Report]:
        """Reports since the last call, without waiting; updates :attr:`view`.

        Raises:
            StageLost: the watchdog has ended or is silent. It stopped the stage if it could. The link stays lost: close
                it and open a new one, whose watchdog stops the stage first.
        """
        if self._lost is not None:
            raise StageLost(self._lost)
        with self._turn:
            received = self._receive()
            self._unlogged += [report for report in received if report.what == "stopped"]
            self._reports += received
        while self._unlogged:  # if the log raises, the next call continues here
            self._log(StageRecord(time.monotonic(), "stop", None, self._unlogged[0].reason))
            self._unlogged.pop(0)
        reports, self._reports = self._reports, []
        if time.monotonic() - self._received_s > SILENT_S and not reports:
            raise self._give_up(f"the stage's watchdog has been silent for {SILENT_S} s")
        return reports

    def _receive(self) -> list[Report]:
        reports: list[Report] = []
        while True:
            try:
                data = self._socket.recv(65536)
            except BlockingIOError:
                return reports
            except (OSError, ValueError) as error:
                raise self._give_up(f"the stage's watchdog is gone: {error}") from error
            if not data:
                raise self._give_up("the stage's watchdog is gone")
            self._received_s = time.monotonic()
            *lines, self._in = (self._in + data).split(b"\n")
            reports += [report for line in lines if (report := self._report(json.loads(line))) is not None]

    def _report(self, document: dict[str, Any]) -> Report | None:
        what = document["report"]
        if what == "status":
            stage = document["stage"]
            status = None if stage is None else StageStatus(stamp=Stamp(**stage.pop("stamp")), **stage)
            moving, requested = (
                None if document[name] is None else MotionKind(document[name]) for name in ("moving", "requested")
            )
            latched = document["latched"]
            self.view = StageView(document["at_s"], document["connected"], status, moving, requested, latched)
            return None
        if what == "ready":
            return None
        return Report(what, document.get("reason", ""), document.get("number"), document.get("latched", False))

    def _await_ready(self, start_s: float) -> None:
        until = time.monotonic() + start_s
        try:
            while b"\n" not in self._in:
                self._socket.settimeout(max(0.01, until - time.monotonic()))
                data = self._socket.recv(65536)
                if not data:
                    raise StageError("the stage's watchdog ended before it was ready")
                self._in += data
        except OSError as error:
            raise StageError(f"the stage's watchdog is not ready after {start_s:.0f} s") from error
        line, _, self._in = self._in.partition(b"\n")
        first = json.loads(line)
        if first["report"] == "failed":
            raise StageError(f"the stage's driver did not start: {first['reason']}")
        self._received_s = time.monotonic()

    # -- the end

    def close(self) -> None:
        """Close the link: the watchdog stops the stage and ends. May be called twice."""
        if self._closed:
            return
        self._let_go()
        try:
            self._process.wait(CLOSE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def abandon(self, grace_s: float = 0.0) -> None:
        """End a watchdog that is lost or may hang, after ``grace_s`` in which it can still stop the stage."""
        if not self._closed:
            self._let_go()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(grace_s)
            return
        self._process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):  # it may be blocked in a system call to the device
            self._process.wait(CLOSE_S)

    def _let_go(self) -> None:
        self._closed = True
        stop_on_exit.release(self)
        emergency_fd, self._emergency_fd = self._emergency_fd, -1  # the number may be reused
        self._socket.close()
        os.close(emergency_fd)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        if error is not None and not self._closed:
            self.press()
        self.close()
