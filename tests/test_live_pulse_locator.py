"""Pulses in the pulse locator: none is lost or piles up, and none that was not processed counts as without a signal."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future
from typing import Any

import numpy as np
import pytest

from fgreg.detection.results import NoSignal
from fgreg.drivers.base import PaFrame
from fgreg.live.actions import LocatedPulse
from fgreg.live.pulse_locator import LOCATE_S, PulseLocator
from fgreg.model.time_sync import PoseHistory, Stamp, TimedPose
from tests.forward import make_session

PERIOD_S = 0.1


class SlowLocator:
    """A process of a given duration."""

    trouble = ""

    def __init__(self) -> None:
        self.under_way: list[Future[Any]] = []

    def submit(self, _data: Any) -> Future[Any]:
        self.under_way.append(Future())
        self.under_way[-1].set_running_or_notify_cancel()
        return self.under_way[-1]

    def finish(self) -> None:
        for future in self.under_way:
            if not future.done():
                future.set_result(NoSignal("nothing"))

    @property
    def busy(self) -> bool:
        return any(not future.done() for future in self.under_way)

    def check(self) -> None:
        """It runs."""

    def close(self) -> None:
        """Nothing to end."""


@pytest.fixture
def pulse_locator() -> Iterator[tuple[PulseLocator, SlowLocator]]:
    found, locator = PulseLocator(make_session()), SlowLocator()
    found.close()
    found.locator = locator  # type: ignore[assignment]
    yield found, locator
    found.close()


def pulses(pulse_locator: PulseLocator, first: int, count: int) -> tuple[LocatedPulse, ...]:
    """Pulses at the laser's pace, with the plane standing and the marker seen all the time; what was handed on."""
    poses = PoseHistory()
    out: list[LocatedPulse] = []
    for k in range(first, first + count):
        t = 100.0 + k * PERIOD_S
        pulse_locator.add_frames([PaFrame(Stamp(t, t), np.zeros((2, 2), dtype=np.int16), k)])
        for at in (t - 0.02, t + 0.02):
            pulse_locator.plane(at, 0.1, moving=False)
            poses.add(TimedPose(at, np.eye(4), np.eye(6)))
        out += pulse_locator.complete_pulses(t + 0.03, poses)
    return tuple(out)


def test_pulses_that_the_locating_process_cannot_process_are_handed_on_as_unknown_and_counted(
    pulse_locator: tuple[PulseLocator, SlowLocator],
) -> None:
    found, locator = pulse_locator
    handed = pulses(found, 0, 200)
    most = round(LOCATE_S / PERIOD_S) + 2
    assert len(locator.under_way) == 1, "it gets no more while it does nothing"
    assert found.waiting <= most
    assert len(handed) == 200 - found.waiting, "none is lost"
    assert [heard.scan_rad for heard in handed] == [None] * len(handed), "nobody knows whether anything was heard"
    assert found.passed_over > 3
    locator.finish()
    later = pulses(found, 200, 5)
    locator.finish()
    later += pulses(found, 205, 1)
    assert any(heard.scan_rad == pytest.approx(0.1) for heard in later), "it goes on where it can"


def test_a_process_that_keeps_up_passes_nothing_over(pulse_locator: tuple[PulseLocator, SlowLocator]) -> None:
    found, locator = pulse_locator
    handed: list[LocatedPulse] = []
    for k in range(50):
        handed += pulses(found, k, 1)
        locator.finish()
    assert found.passed_over == 0
    assert len(handed) == 49
    assert [heard.scan_rad for heard in handed] == pytest.approx([0.1] * 49)


def test_pulses_not_wanted_are_not_processed_and_carry_no_information(
    pulse_locator: tuple[PulseLocator, SlowLocator],
) -> None:
    found, locator = pulse_locator
    found.wanted = False
    handed = pulses(found, 0, 20)
    assert len(handed) == 20
    assert not locator.under_way
    assert {heard.scan_rad for heard in handed} == {None}
