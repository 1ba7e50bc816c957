"""The watchdog process owns the stage: only it calls the driver, and it stops the stage if the main program fails.

:mod:`fgreg.stage.client` starts it in a session of its own, so that Ctrl-C reaches the main program only. It watches
lines on a socket (messages.py), an emergency pipe (any byte, or its end, stops the stage), the stage's status, and the
clock. It ends when the main program closes the socket for any reason, and stops the stage before. Signals: SIGUSR1 is
an emergency stop; SIGTERM and SIGHUP stop the stage and end the process.

    python -m fgreg.stage.watchdog SOCKET_FD EMERGENCY_FD
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType
from typing import Any, TextIO, cast

from fgreg.errors import FgregError, one_line
from fgreg.schema.limits import STAGE_LINE_BYTES
from fgreg.stage.interface import RotationStage, StageError, StageLost, StageStatus
from fgreg.stage.limits import MotionLimits
from fgreg.stage.messages import Action, Arrived, Drive, Halt, MessageError, Refusal, decode
from fgreg.stage.safety_gate import Gate

TICK_S = 0.02
RETRY_S = 0.5
"""Time between attempts to reach a lost stage."""
REST_S = 2.0
"""Longest wait for the stage to come to rest before the process ends."""
STATUS_EVERY_S = 0.05
_OUTBOX_BYTES = 1 << 20

OpenStage = Callable[..., RotationStage]


@dataclass(frozen=True, slots=True)
class WatchdogSetup:
    """Set-up from the main program, as one line of JSON.

    Attributes:
        driver: ``package.module:factory``, called with the stage's model and ``options``.
        log: file to which every order to the stage is appended before it is given; None: no file.
    """

    driver: str
    options: dict[str, Any]
    limits: MotionLimits
    log: str | None = None

    def line(self) -> bytes:
        """As a line of JSON."""
        document = {"driver": self.driver, "options": self.options, "limits": self.limits.document(), "log": self.log}
        return json.dumps(document, allow_nan=False).encode() + b"\n"

    @staticmethod
    def read(line: bytes) -> WatchdogSetup:
        """Inverse of :meth:`line`."""
        document = json.loads(line)
        limits = MotionLimits.from_document(document["limits"])
        return WatchdogSetup(document["driver"], document["options"], limits, document["log"])


def load(dotted: str) -> OpenStage:
    """The factory that ``package.module:name`` names. Raises ImportError, AttributeError, ValueError."""
    module, _, name = dotted.partition(":")
    if not name:
        raise ValueError(f"driver {dotted!r}, expected package.module:factory")
    return cast(OpenStage, getattr(importlib.import_module(module), name))


class Watchdog:
    """The loop around the safety gate. ``clock`` and ``open_stage`` are arguments, so that tests can replace them."""

    def __init__(
        self,
        limits: MotionLimits,
        open_stage: Callable[[], RotationStage],
        main: socket.socket,
        emergency_fd: int,
        log: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._gate, self._open, self._clock = Gate(limits), open_stage, clock
        self._main, self._emergency_fd, self._log = main, emergency_fd, log
        self._stage: RotationStage | None = None
        self._retry_s = self._said_s = -1e9
        self._in, self._out = b"", bytearray()
        self._ended: str | None = None
        self._signal: int | None = None
        self._asleep_s = _asleep()
        self._last_halt = ""
        self._stop_owed = False
        main.setblocking(False)

    def on_signal(self, number: int, _frame: FrameType | None) -> None:
        """Signal handler; takes effect at the next step of the loop, after a tick at the latest."""
        self._signal = number

    def run(self) -> None:
        """Report ready, then run until the main program ends or a signal comes.

        On return the stage is at rest, if it obeys.
        """
        self._tell({"report": "ready"})
        try:
            while self._ended is None:
                self.turn()
        finally:
            self._rest(self._ended or "the watchdog failed")

    def turn(self) -> None:
        """One step of the loop: at most a tick, and one or two calls of the driver."""
        main_fd = self._main.fileno()
        ready, _, _ = select.select([main_fd, self._emergency_fd], [main_fd] if self._out else [], [], TICK_S)
        if self._emergency_fd in ready:
            self._on_emergency()
        if main_fd in ready:
            self._on_main()
        if self._signal is not None:
            number, self._signal = self._signal, None
            name = signal.Signals(number).name
            self._do(self._gate.fault(f"emergency stop: signal {name}", self._clock()))
            if number != signal.SIGUSR1:
                self._ended = f"signal {name}"
        asleep = _asleep()
        if asleep - self._asleep_s > self._gate.limits.clock_gap_s:
            self._do(self._gate.fault("the machine was asleep", self._clock()))
        self._asleep_s = asleep
        if self._stop_owed:  # the stage did not take the last one
            self._stop_owed = False
            self._order("stop", None, self._last_halt, lambda stage: stage.stop(), said=True)
        status = self._status()  # before the clock is read: a status must not be younger than the time of its check
        self._do(self._gate.tick(self._clock(), status))
        self._tell_status(status)
        self._flush()

    # -- the main program

    def _on_emergency(self) -> None:
        if os.read(self._emergency_fd, 64):
            self._do(self._gate.fault("emergency stop", self._clock()))
        else:
            self._end("the main program is gone")

    def _on_main(self) -> None:
        try:
            data = self._main.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._end("the main program is gone")
            return
        *lines, self._in = (self._in + data).split(b"\n")
        if len(self._in) > STAGE_LINE_BYTES:
            lines, self._in = [*lines, self._in], b""
        for line in lines:
            try:
                if len(line) > STAGE_LINE_BYTES:
                    raise MessageError(f"a message of {len(line)} bytes, at most {STAGE_LINE_BYTES} allowed")
                actions = self._gate.handle(decode(line), self._clock())
            except MessageError as error:
                actions = self._gate.fault(str(error), self._clock())
            self._do(actions)

    def _end(self, reason: str) -> None:
        self._ended = reason
        self._do(self._gate.fault(reason, self._clock()))

    def _tell(self, document: dict[str, Any]) -> None:
        """Queue a report to the main program; a stalled one must never block the watchdog."""
        line = json.dumps(document).encode() + b"\n"
        if len(self._out) + len(line) <= _OUTBOX_BYTES:
            self._out += line

    def _flush(self) -> None:
        if self._out:
            try:
                sent = self._main.send(self._out)
                del self._out[:sent]
            except BlockingIOError:
                pass
            except OSError:
                self._out.clear()

    def _tell_status(self, status: StageStatus | None) -> None:
        now = self._clock()
        if now - self._said_s < STATUS_EVERY_S and now >= self._said_s:
            return
        self._said_s = now
        if self._out:  # unread reports come first; a later status will do
            return
        gate = self._gate
        self._tell(
            {
                "report": "status",
                "at_s": now,
                "connected": self._stage is not None,
                "stage": None if status is None else asdict(status),
                "moving": gate.moving,
                "requested": gate.requested,
                "latched": gate.latched,
            }
        )

    # -- the stage

    def _status(self) -> StageStatus | None:
        if self._stage is None:
            self.connect()
        if self._stage is None:
            return None
        try:
            return self._stage.status()
        except StageLost as error:
            self._lost(str(error))
        except StageError as error:
            self._do(self._gate.fault(str(error), self._clock()))
        return None

    def connect(self) -> None:
        """Connect to the stage unless that was tried within ``RETRY_S``, and stop it first.

        Raises whatever the driver's factory raises except StageError, after which the stage may connect later.
        """
        now = self._clock()
        if 0.0 <= now - self._retry_s < RETRY_S:
            return
        self._retry_s = now
        try:
            self._stage = self._open()
        except StageError as error:
            self._do(self._gate.fault(str(error), now))
            return
        self._order("stop", None, "connected: whatever it was doing", lambda stage: stage.stop())

    def _lost(self, reason: str) -> None:
        stage, self._stage = self._stage, None
        if stage is not None:
            stage.close()
        self._do(self._gate.fault(reason, self._clock()))

    def _do(self, actions: list[Action]) -> None:
        """Carry out the gate's actions; each is logged first."""
        for action in actions:
            match action:
                case Drive():
                    self._drive(action)
                case Halt(reason=reason, latched=latched):
                    self._order("stop", None, reason, lambda stage: stage.stop(), said=reason == self._last_halt)
                    if reason != self._last_halt:
                        self._tell({"report": "stopped", "reason": reason, "latched": latched})
                    self._last_halt = reason
                case Refusal(reason=reason, number=number):
                    self._tell({"report": "refused", "reason": reason, "number": number})
                case Arrived(number=number):
                    self._tell({"report": "arrived", "number": number})

    def _drive(self, action: Drive) -> None:
        def call(stage: RotationStage) -> None:
            if action.scan_rad is None:
                stage.home(action.speed_rad_s)
            else:
                stage.move_to(action.scan_rad, action.speed_rad_s)

        self._last_halt, self._stop_owed = "", False
        if not self._order(str(action.kind), action.scan_rad, action.reason, call):
            self._do(self._gate.fault("the order could not be given", self._clock()))

    def _order(
        self,
        command: str,
        scan_rad: float | None,
        reason: str,
        call: Callable[[RotationStage], None],
        said: bool = False,
    ) -> bool:
        """Log an order, then give it. If it cannot be logged, only a stop is given."""
        if not said and not self._write_down(command, scan_rad, reason) and command != "stop":
            return False
        if self._stage is None:
            return command == "stop"
        try:
            call(self._stage)
        except StageLost as error:
            self._lost(str(error))
            return command == "stop"
        except StageError as error:
            self._stop_owed = True
            self._tell({"report": "trouble", "reason": str(error)})
            return False
        return True

    def _write_down(self, command: str, scan_rad: float | None, reason: str) -> bool:
        if self._log is None:
            return True
        record = {"t": self._clock(), "command": command, "scan_rad": scan_rad, "reason": one_line(reason, 300)}
        try:
            self._log.write(json.dumps(record) + "\n")
            self._log.flush()
        except (OSError, ValueError) as error:
            self._tell({"report": "trouble", "reason": f"the watchdog's log cannot be written: {error}"})
            return False
        return True

    def _rest(self, reason: str) -> None:
        """Repeat stops until the stage is at rest, then release it."""
        until = time.monotonic() + REST_S
        while self._stage is not None and time.monotonic() < until:
            with contextlib.suppress(Exception):  # try again after any error of a driver
                self._order("stop", None, reason, lambda stage: stage.stop(), said=reason == self._last_halt)
                self._last_halt = reason
                if self._stage is None or not self._stage.status().moving:
                    break
            time.sleep(TICK_S)
        if self._stage is not None:
            self._stage.close()


def _asleep() -> float:
    """Seconds that the machine has slept since it was started; 0 if unknown."""
    clock = getattr(time, "CLOCK_BOOTTIME", None)
    return 0.0 if clock is None else time.clock_gettime(clock) - time.monotonic()


def _first_line(main: socket.socket) -> bytes:
    line = b""
    while not line.endswith(b"\n"):
        part = main.recv(1)
        if not part:
            raise EOFError("the main program is gone")
        line += part
    return line


def main(arguments: list[str]) -> int:
    """Entry of the process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    link, emergency_fd = socket.socket(fileno=int(arguments[0])), int(arguments[1])
    try:
        setup = WatchdogSetup.read(_first_line(link))
        factory = load(setup.driver)
        model = setup.limits.stage
        log = None if setup.log is None else Path(setup.log).open("a", encoding="utf-8")  # noqa: SIM115
        watchdog = Watchdog(setup.limits, lambda: factory(model, **setup.options), link, emergency_fd, log)
        watchdog.connect()
    except EOFError:
        return 0
    except Exception as error:  # the driver's import and set-up may raise anything: report it to the main program
        reason = one_line(str(error) if isinstance(error, FgregError) else f"{type(error).__name__}: {error}", 500)
        link.setblocking(True)
        link.sendall(json.dumps({"report": "failed", "reason": reason}).encode() + b"\n")
        return 2
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1):
        signal.signal(number, watchdog.on_signal)
    watchdog.run()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
