"""Work beside the engine: answers come back, defects and ends are told, an old verdict is not passed for a new one."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable

import numpy as np
import pytest

from fgreg.estimate import Verdict
from fgreg.online import OnlineRegistration
from fgreg.online import judge as judge_module
from fgreg.online.beside import Beside
from tests.forward import make_measurements
from tests.online_streams import events


def halved(number: float) -> float:
    if number < 0:
        raise ValueError("a number below 0")
    if number == 13:
        os.kill(os.getpid(), signal.SIGKILL)
    return number / 2


def wait_for(condition: Callable[[], object], seconds: float = 60.0) -> None:
    until = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > until:
            raise AssertionError("did not happen")
        time.sleep(0.01)


def fetched(beside: Beside[float, float]) -> float | None:
    until = time.monotonic() + 60.0
    while (found := beside.fetch()) is None:
        assert time.monotonic() < until
        time.sleep(0.01)
    return found[0]


def test_answers_come_back_and_a_case_that_fails_is_told_until_one_works() -> None:
    beside: Beside[float, float] = Beside(halved, "halving", "the halving process")
    try:
        assert beside.send(3.0)
        assert beside.busy
        assert fetched(beside) == 1.5
        assert not beside.busy
        assert beside.send(-1.0)
        assert fetched(beside) is None
        assert beside.failure == "ValueError: a number below 0"
        assert beside.send(8.0)
        assert fetched(beside) == 4.0
        assert beside.failure == ""
    finally:
        beside.close()


def test_a_process_that_ends_is_told_and_takes_no_more() -> None:
    beside: Beside[float, float] = Beside(halved, "halving", "the halving process")
    try:
        assert beside.send(13.0)
        wait_for(lambda: beside.fetch() is None and not beside.busy)
        assert beside.failure == "the halving process has ended"
        assert not beside.send(2.0)
        assert not beside.busy
    finally:
        beside.close()


def test_a_judge_that_fails_is_told_for_as_long_as_it_does(monkeypatch: pytest.MonkeyPatch) -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(4), aims=14, pairs=18)
    stream = list(events(measurements))
    engine = OnlineRegistration(model, watch=None)
    for event in stream[:-6]:
        before = engine.add(event)
    assert before.verdict is Verdict.OK

    def failing(*_: object) -> object:
        raise ArithmeticError("no posterior")

    with monkeypatch.context() as patch:
        patch.setattr(judge_module, "judge", failing)
        for event in stream[-6:]:
            after = engine.add(event)  # the fifteenth pair is due, the sixteenth not
    assert after.verdict is Verdict.WARNING
    assert any("the full solve failed: ArithmeticError: no posterior" in reason for reason in after.reasons)
    settled = engine.settle()
    assert settled.settled
    assert not any("full solve failed" in reason for reason in settled.reasons)
