"""The main program's end of the stage: what it wants goes to the watchdog, what happened comes back.

    with StageLink.open("fgreg.drivers.simulated_stage:open_stage", {}, limits, log=sink) as stage:
        while running:
            stage.beat(marker_s, "ok")               # once in every turn of the main loop, from that loop
            for report in stage.poll(): ...
            stage.request(MotionKind.TRACK, "foot pedal")    # the operator's doing
            stage.track_to(scan_rad, sigma_rad, "the beam moved")

The heartbeat has to come from the loop whose stalling matters: a thread of its own would go on beating. Every order is
handed to ``log`` before it is sent; if that raises, it is not sent, but for stops. Leaving the ``with`` block by an
exception, Ctrl-C, an uncaught exception in any thread, the end of the interpreter and ``guard.emergency_stop_all`` all
stop the stage; so does a main program that is killed or stalls, by the watchdog.
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
from collections import deque
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
"""How long the watchdog may take to start."""
SEND_S = 0.5
"""How long a message may wait for the watchdog to take it."""
CLOSE_S = 5.0
"""How long the watchdog may take to bring the stage to rest when it is let go."""
READINGS = 100
"""Stage angles that are kept, one every 50 ms."""
SILENT_S = 0.7
"""A watchdog that says nothing for this long is gone: it tells of the stage every 50 ms."""


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
    """Something that happened at the watchdog.

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
    """The newest that the watchdog told: is the stage there, what does it say, what is going on.

    ``status`` None: not heard. ``moving``, ``requested``: kind of motion under way, and allowed by the operator.
    ``latched``: why nothing may move until a reset.
    """

    at_s: float
    connected: bool
    status: StageStatus | None
    moving: MotionKind | None
    requested: MotionKind | None
    latched: str | None


class StageLink:
    """See the module. Made by :meth:`open`; may be used from several threads.

    Attributes:
        view: the newest status, as of the last :meth:`poll`.
        readings: (host time s, plane angle rad) of the last statuses of a homed stage, oldest first: for
            ``fgreg.model.time_sync.scan_at``.
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
        self.readings: deque[tuple[float, float]] = deque(maxlen=READINGS)
        self._process, self._socket, self._emergency_fd, self._log = process, link, emergency_fd, log
        self._turn = threading.Lock()
        self._in = b""
        self._number = 0
        self._heard_s = time.monotonic()
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
        """Start the watchdog and wait until it watches. The stage need not be there yet.

        Args:
            driver: ``package.module:factory`` of the stage's driver.
            options: keyword arguments of the factory, as JSON holds them.
            log: gets every order before it is sent, and stops that the watchdog decided on as they become known.
            watchdog_log: a file of the watchdog's own, in which stops stand, too, that nobody was left to hear of.

        Raises:
            StageError: the watchdog or the driver did not start; says why.
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

    # -- what the main program says

    def beat(self, marker_s: float | None = None, registration: str | None = None) -> None:
        """The main loop lives. What tracking rests on: when the marker was last seen (host time of the exposure), and
        the verdict of the registration that holds for where the camera is now; None for none."""
        self._send(Beat(time.monotonic(), marker_s, registration))

    def request(self, kind: MotionKind, by: str) -> None:
        """The operator asks for motion of a kind; call it for nothing but an operator's action."""
        self._log(StageRecord(time.monotonic(), f"request {kind}", None, by))
        self._send(Request(time.monotonic(), kind, by))

    def home(self, reason: str, speed_rad_s: float | None = None) -> int:
        """To the zero position. Returns the command's number, which reports name."""
        return self._command(MotionKind.HOME, None, speed_rad_s, None, reason)

    def search_to(self, scan_rad: float, reason: str, speed_rad_s: float | None = None) -> int:
        """To the next position of a search."""
        return self._command(MotionKind.SEARCH, scan_rad, speed_rad_s, None, reason)

    def track_to(self, scan_rad: float, sigma_rad: float, reason: str, speed_rad_s: float | None = None) -> int:
        """After the beam: to a tracking answer of this standard deviation."""
        return self._command(MotionKind.TRACK, scan_rad, speed_rad_s, sigma_rad, reason)

    def stop(self, reason: str) -> None:
        """Stop; the operator has to request again."""
        try:
            self._log(StageRecord(time.monotonic(), "stop", None, reason))
        finally:
            self._send(Stop(time.monotonic(), False, reason))

    def emergency_stop(self, reason: str) -> None:
        """Stop now, and let nothing move until :meth:`reset`. From any thread, and where the socket is stuck."""
        self.press()
        self._log(StageRecord(time.monotonic(), "emergency stop", None, reason))

    def latch(self, reason: str) -> None:
        """Let nothing move until :meth:`reset`, for a reason that is told; the stage is stopped, too."""
        self._send(Stop(time.monotonic(), True, reason))

    def reset(self, by: str) -> None:
        """The operator has looked: motion may be requested again. Refused while the stage moves or is silent."""
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
                        raise TimeoutError("it takes nothing in")
                    line = line[self._socket.send(line) :]
        except (OSError, ValueError) as error:  # a line cut short is unreadable: the watchdog stops the stage for it
            raise self._give_up(f"the stage's watchdog does not listen: {error}") from error

    def press(self) -> None:
        """Emergency stop by the pipe: one byte, no lock, safe in a signal handler."""
        with contextlib.suppress(OSError):
            os.write(self._emergency_fd, b"!")

    def _give_up(self, reason: str) -> StageLost:
        self._lost = reason
        self.press()
        return StageLost(reason)

    # -- what comes back

    def poll(self) -> list[Report]:
        """What happened since the last call, at once; :attr:`view` is the newest status after it.

        Raises:
            StageLost: the watchdog is gone or says nothing any more. It stopped the stage if it could. The link stays
                lost: close it and open a new one, whose watchdog stops the stage first of all.
        """
        if self._lost is not None:
            raise StageLost(self._lost)
        with self._turn:
            received = self._receive()
            self._unlogged += [report for report in received if report.what == "stopped"]
            self._reports += received
        while self._unlogged:  # where the log refuses, nothing is lost: the next call goes on here
            self._log(StageRecord(time.monotonic(), "stop", None, self._unlogged[0].reason))
            self._unlogged.pop(0)
        reports, self._reports = self._reports, []
        if time.monotonic() - self._heard_s > SILENT_S and not reports:
            raise self._give_up(f"the stage's watchdog has said nothing for {SILENT_S} s")
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
            self._heard_s = time.monotonic()
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
            if status is not None and status.homed:
                if not self.readings or status.stamp.host_s > self.readings[-1][0]:
                    self.readings.append((status.stamp.host_s, status.scan_rad))
            else:
                self.readings.clear()
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
        self._heard_s = time.monotonic()

    # -- the end

    def close(self) -> None:
        """Let go: the watchdog brings the stage to rest and ends. May be called twice."""
        if self._closed:
            return
        self._let_go()
        try:
            self._process.wait(CLOSE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def abandon(self, grace_s: float = 0.0) -> None:
        """Let go of a watchdog that is gone, or may hang: it is ended, after a moment in which it can still stop."""
        if not self._closed:
            self._let_go()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(grace_s)
            return
        self._process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):  # one that the system holds in a call to the device
            self._process.wait(CLOSE_S)

    def _let_go(self) -> None:
        self._closed = True
        stop_on_exit.release(self)
        emergency_fd, self._emergency_fd = self._emergency_fd, -1  # the number may soon be somebody else's
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
