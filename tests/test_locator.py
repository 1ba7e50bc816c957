"""The process that locates sources: one that ends or hangs is replaced, and no frame counts as silence for it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from fgreg.drivers.base import PaFrame
from fgreg.models import SessionModel
from fgreg.operation import senses
from fgreg.operation.senses import GIVE_UP_S, Ears
from fgreg.operation.view import Heard
from fgreg.pairing import PoseHistory, Stamp
from fgreg.session.setup import read_setup
from fgreg.simulation.documents import session_document
from fgreg.simulation.room import room_config


@pytest.fixture
def ears() -> Iterator[Ears]:
    problems: list[object] = []
    document = session_document(room_config(1, 320).scene)
    model = read_setup(document, "session.yaml", "room", problems).model  # type: ignore[arg-type]
    assert isinstance(model, SessionModel), problems
    ears = Ears(model)
    try:
        turn(ears, lambda: ears.locator.ready)
        yield ears
    finally:
        ears.close()


def turn(ears: Ears, until: Callable[[], object]) -> list[Heard]:
    """Turns of a loop whose stage stands at 0.1 rad, until something is so."""
    heard: list[Heard] = []
    end = time.monotonic() + 60.0
    while not until():
        assert time.monotonic() < end, ears.trouble
        ears.plane(time.monotonic(), 0.1, False)
        heard += ears.heard(time.monotonic(), PoseHistory())
        time.sleep(0.01)
    return heard


def pulse(ears: Ears, data: np.ndarray | None = None) -> None:
    """One pulse, heard by nobody but the noise, some time after the last."""
    turn(ears, _after(0.02))
    now = time.monotonic()
    data = np.random.default_rng(1).integers(-20, 20, (128, 2000), dtype=np.int16) if data is None else data
    ears.hear([PaFrame(Stamp(now, now), data, 0)])


def _after(seconds: float) -> Callable[[], bool]:
    end = time.monotonic() + seconds
    return lambda: time.monotonic() > end


def test_pulses_under_way_when_it_is_killed_are_located_by_the_next(
    ears: Ears, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(senses, "LOCATE_S", 60.0)  # a busy machine takes its time to start another
    pid = ears.locator.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    for _ in range(3):
        pulse(ears)
    heard = turn(ears, _after(GIVE_UP_S + 0.2))
    assert heard == []  # they wait for it
    assert ears.waiting == 3
    os.kill(pid, signal.SIGKILL)
    heard = turn(ears, lambda: not ears.waiting)
    assert len(heard) == 3
    assert [one.scan_rad for one in heard] == [0.1, None, None]  # one at a time is looked into: nothing heard
    turn(ears, lambda: not ears.trouble)
    assert ears.locator.pid not in (None, pid)


def test_one_that_ended_while_idle_is_noticed_and_replaced(ears: Ears) -> None:
    pid = ears.locator.pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    turn(ears, lambda: ears.trouble)
    assert ears.trouble == "it has ended"
    turn(ears, lambda: not ears.trouble)
    assert ears.locator.pid not in (None, pid)


def test_one_that_hangs_is_told_and_trouble_ends_when_it_goes_on(ears: Ears) -> None:
    pid = ears.locator.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    turn(ears, lambda: ears.trouble)
    assert "has not answered" in ears.trouble
    os.kill(pid, signal.SIGCONT)
    turn(ears, lambda: not ears.trouble)
    assert ears.locator.pid == pid


def test_a_frame_that_cannot_be_looked_into_is_no_silence(ears: Ears) -> None:
    pulse(ears, np.zeros((3, 5, 7), dtype=np.int16))
    (heard,) = turn(ears, lambda: not ears.waiting)
    assert heard.scan_rad is None  # as a pulse of which nobody knows anything
    assert "could not be looked into" in ears.trouble
