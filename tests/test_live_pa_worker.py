"""The process that locates sources is replaced where it ends or hangs; its frames do not count as without a signal."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from fgreg.drivers.base import PaFrame
from fgreg.live import pulse_locator as pulse_locator_module
from fgreg.live.actions import LocatedPulse
from fgreg.live.pulse_locator import GIVE_UP_S, PulseLocator
from fgreg.model.session_model import SessionModel
from fgreg.model.time_sync import PoseHistory, Stamp
from fgreg.session.setup_reader import read_setup
from fgreg.simulation.documents import session_document
from fgreg.simulation.room import room_config


@pytest.fixture
def pulse_locator() -> Iterator[PulseLocator]:
    problems: list[object] = []
    document = session_document(room_config(1, 320).scene)
    model = read_setup(document, "session.yaml", "room", problems).model  # type: ignore[arg-type]
    assert isinstance(model, SessionModel), problems
    pulse_locator = PulseLocator(model)
    try:
        turn(pulse_locator, lambda: pulse_locator.locator.ready)
        yield pulse_locator
    finally:
        pulse_locator.close()


def turn(pulse_locator: PulseLocator, until: Callable[[], object]) -> list[LocatedPulse]:
    """Turns of a loop whose stage stands at 0.1 rad, until something is so."""
    heard: list[LocatedPulse] = []
    end = time.monotonic() + 60.0
    while not until():
        assert time.monotonic() < end, pulse_locator.trouble
        pulse_locator.plane(time.monotonic(), 0.1, False)
        heard += pulse_locator.complete_pulses(time.monotonic(), PoseHistory())
        time.sleep(0.01)
    return heard


def pulse(pulse_locator: PulseLocator, data: np.ndarray | None = None) -> None:
    """One pulse of noise only, some time after the last."""
    turn(pulse_locator, _after(0.02))
    now = time.monotonic()
    data = np.random.default_rng(1).integers(-20, 20, (128, 2000), dtype=np.int16) if data is None else data
    pulse_locator.add_frames([PaFrame(Stamp(now, now), data, 0)])


def _after(seconds: float) -> Callable[[], bool]:
    end = time.monotonic() + seconds
    return lambda: time.monotonic() > end


def test_pulses_under_way_when_it_is_killed_are_located_by_the_next(
    pulse_locator: PulseLocator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pulse_locator_module, "LOCATE_S", 60.0)  # a busy machine takes its time to start another
    pid = pulse_locator.locator.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    for _ in range(3):
        pulse(pulse_locator)
    heard = turn(pulse_locator, _after(GIVE_UP_S + 0.2))
    assert heard == []  # they wait for it
    assert pulse_locator.waiting == 3
    os.kill(pid, signal.SIGKILL)
    heard = turn(pulse_locator, lambda: not pulse_locator.waiting)
    assert len(heard) == 3
    assert [one.scan_rad for one in heard] == [0.1, None, None]  # one is processed at a time: no signal
    turn(pulse_locator, lambda: not pulse_locator.trouble)
    assert pulse_locator.locator.pid not in (None, pid)


def test_one_that_ended_while_idle_is_noticed_and_replaced(pulse_locator: PulseLocator) -> None:
    pid = pulse_locator.locator.pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    turn(pulse_locator, lambda: pulse_locator.trouble)
    assert pulse_locator.trouble == "it has ended"
    turn(pulse_locator, lambda: not pulse_locator.trouble)
    assert pulse_locator.locator.pid not in (None, pid)


def test_a_hung_worker_is_reported_until_it_works_again(pulse_locator: PulseLocator) -> None:
    pid = pulse_locator.locator.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    turn(pulse_locator, lambda: pulse_locator.trouble)
    assert "has not answered" in pulse_locator.trouble
    os.kill(pid, signal.SIGCONT)
    turn(pulse_locator, lambda: not pulse_locator.trouble)
    assert pulse_locator.locator.pid == pid


def test_a_frame_that_cannot_be_processed_is_not_a_pulse_without_signal(pulse_locator: PulseLocator) -> None:
    pulse(pulse_locator, np.zeros((3, 5, 7), dtype=np.int16))
    (heard,) = turn(pulse_locator, lambda: not pulse_locator.waiting)
    assert heard.scan_rad is None  # as a pulse without information
    assert "could not be processed" in pulse_locator.trouble
