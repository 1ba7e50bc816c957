"""A live session in the simulated room with faults of its devices caused on purpose, for tests and measurements."""

from __future__ import annotations

import errno
import math
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from fgreg.drivers.base import CommandKind
from fgreg.drivers.simulated import RoomProcess, SimulatedMotion
from fgreg.drivers.simulated_room import FAULTS
from fgreg.geometry.transforms import FloatArray
from fgreg.live import pace
from fgreg.live.launch import LiveSetup, Running, running
from fgreg.live.loop import IDLE_S
from fgreg.live.simulated_room import room_setup
from fgreg.live.status import Devices
from fgreg.model.events import NoteEvent
from fgreg.model.session_model import SessionModel
from fgreg.online.engine_process import EngineProcess
from fgreg.session import append_only_file
from fgreg.simulation.room import room_config

PATIENCE_S = 90.0
SEED, AIMS, BUMP_EVERY_S, WIDTH_PX = 1, 0, math.inf, 320


class Listening:
    """The session's operator, with the messages and their times."""

    def __init__(self, operator: Any) -> None:
        self._operator = operator
        self.messages: list[tuple[float, str]] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._operator, name)

    def tell(self, text: str, *, done: bool = False, wants: CommandKind | None = None) -> None:
        self.messages.append((time.monotonic(), text))
        self._operator.tell(text, done=done, wants=wants)


@dataclass(eq=False)
class Rig:
    """A running session, stepped by the test."""

    room: RoomProcess
    session: Running
    operator: Listening
    devices: Devices

    def run(self, seconds: float, until: Callable[[], object] = lambda: False) -> bool:
        """Step the loop for some seconds, or until a condition holds; whether it does."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if not self.session.loop.turn():
                time.sleep(IDLE_S)
            if until():
                return True
        return False

    def told_after(self, since_s: float, text: str) -> float | None:
        """Seconds from a time until a message with this beginning."""
        times = (at_s - since_s for at_s, said in self.operator.messages if at_s >= since_s and said.startswith(text))
        return next(times, None)

    def counts(self) -> FloatArray:
        """Frames processed, pulses taken in, orders given."""
        figures = self.session.loop.figures
        return np.array([figures.frames, figures.pulses, figures.orders], dtype=float)


@contextmanager
def rig(folder: Path) -> Iterator[Rig]:
    """A session that searches PMs."""
    with ExitStack() as stack:
        room = stack.enter_context(RoomProcess(SEED, WIDTH_PX, AIMS, BUMP_EVERY_S))
        setup = room_setup(room.path, room_config(SEED, WIDTH_PX, aims=AIMS, bump_every_s=BUMP_EVERY_S))
        found: list[Devices] = []

        def open_devices(devices: ExitStack, model: SessionModel) -> Devices:
            opened = setup.open_devices(devices, model)
            opened.operator = Listening(opened.operator)
            opened.motion = SimulatedMotion(room.path)
            devices.callback(opened.motion.close)
            found.append(opened)
            return opened

        listening = LiveSetup(setup.setup, open_devices, setup.stage, setup.settings)
        # The machine may have other tests to run: that it is too slow to home is tested elsewhere.
        stack.enter_context(mock.patch.multiple(pace, BEGIN_HZ=0.0, BEGIN_GAP_S=math.inf))
        session = stack.enter_context(running(listening, folder))
        operator = found[0].operator
        assert isinstance(operator, Listening)
        ready = Rig(room, session, operator, found[0])
        if not ready.run(PATIENCE_S, lambda: session.loop.figures.orders > 3):
            raise AssertionError(f"the session did not begin: {operator.messages[-3:]}")
        yield ready


# --- faults: each function starts one and returns how to end it ---------------------------------------------------

Mend = Callable[[], None]


def _pid_of(case: Rig, what: str) -> int:
    if what == "watchdog":
        link = None if case.devices.stage is None else case.devices.stage.link
        assert link is not None
        return link.pid
    if what == "locator":
        pid = case.session.loop.pulse_locator.locator.pid
        assert pid is not None
        return pid
    engine = case.session.session.engine
    assert isinstance(engine, EngineProcess)
    assert engine.pid is not None
    return engine.pid


def _kill(case: Rig, what: str) -> Mend:
    os.kill(_pid_of(case, what), signal.SIGKILL)
    return lambda: None


def _hang(case: Rig, what: str) -> Mend:
    pid = _pid_of(case, what)
    os.kill(pid, signal.SIGSTOP)

    def mend() -> None:
        if what == "engine":  # the others are replaced
            os.kill(pid, signal.SIGCONT)

    return mend


def _fill_disk(case: Rig, _what: str) -> Mend:
    def full(_handle: int, _data: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    patch = mock.patch.object(append_only_file, "_write", full)
    patch.start()
    case.session.recorder.hand_over(NoteEvent(0.0, 0, "written when there is room"))
    return patch.stop


def _break(case: Rig, name: str) -> Mend:
    device, _, what = name.partition("-")
    case.room.fault(device, what)
    return lambda: case.room.fault(device, "")


@dataclass(frozen=True)
class Fault:
    """How a fault is caused, and the role that is reported lost."""

    role: str
    begin: Callable[[Rig, str], Mend]
    what: str


STUDIED = {
    f"{device}-{what}": Fault(device, _break, f"{device}-{what}")
    for device in ("camera", "probe", "motion", "stage", "operator")
    for what in FAULTS[device]
    if what
} | {
    "watchdog-killed": Fault("stage", _kill, "watchdog"),
    "watchdog-hangs": Fault("stage", _hang, "watchdog"),
    "locator-killed": Fault("locator", _kill, "locator"),
    "locator-hangs": Fault("locator", _hang, "locator"),
    "engine-hangs": Fault("registration", _hang, "engine"),
    "engine-killed": Fault("registration", _kill, "engine"),
    "disk-full": Fault("recording", _fill_disk, ""),
}


@dataclass
class Trial:
    """One fault: seconds until the loss is reported, until the return is, until the next order; counts per second."""

    reported_s: float = math.nan
    back_s: float = math.nan
    order_s: float = math.nan
    rates: Sequence[float] = (math.nan,) * 3


def trial(case: Rig, fault: Fault, lasts_s: float, *, orders: bool = True, rest_s: float = 2.0) -> Trial:
    """Cause a fault in a working session, end it, and let the session go on until some time after the next order."""
    found, pulse_locator = Trial(), case.session.loop.pulse_locator
    case.run(PATIENCE_S, lambda: not case.session.loop.lost and pulse_locator.locator.ready)
    before, began = case.counts(), time.monotonic()
    mend = fault.begin(case, fault.what)
    lost, back = f"{fault.role} lost", f"{fault.role} is back"
    if case.run(PATIENCE_S, lambda: case.told_after(began, lost) is not None):
        found.reported_s = case.told_after(began, lost) or 0.0
    case.run(max(0.0, began + lasts_s - time.monotonic()))
    found.rates = ((case.counts() - before) / (time.monotonic() - began)).tolist()
    mended = time.monotonic()
    mend()
    if case.run(PATIENCE_S, lambda: case.told_after(began, back) is not None):
        found.back_s = max(0.0, (case.told_after(began, back) or 0.0) + began - mended)
    before = case.counts()
    if orders and case.run(PATIENCE_S, lambda: case.counts()[2] > before[2] and not case.session.loop.status().latched):
        found.order_s = time.monotonic() - mended
    case.run(rest_s)
    return found
