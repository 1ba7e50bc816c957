"""A watchdog that has ended is replaced; its stage is stopped first, and moves at the operator's request."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fgreg.stage.client import Report, StageLink, StageRecord
from fgreg.stage.interface import StageError, StageLost
from fgreg.stage.limits import MotionKind
from fgreg.stage.reconnect import ReconnectingStage
from tests.stage_main import LIMITS
from tests.traced_stage import read_trace


class _Kept:
    """A stage with a traced stage behind it, turned as a main loop would."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.log = folder, list[StageRecord]()
        self.reports, self.lost = list[Report](), list[str]()
        self.refuse = ""
        self.stage = ReconnectingStage(self._open)

    def _open(self) -> StageLink:
        if self.refuse:
            raise StageError(self.refuse)
        options = {"trace": str(self.folder / "trace")}
        return StageLink.open("tests.traced_stage:open_stage", options, LIMITS, self.log.append)

    def turn(self) -> None:
        try:
            self.reports += self.stage.poll()
        except StageLost as error:
            if not self.lost or self.lost[-1] != str(error):
                self.lost.append(str(error))
        if self.stage.link is not None:
            self.stage.link.beat(time.monotonic(), "ok")
        time.sleep(0.01)

    def until(self, condition: Callable[[], object], seconds: float = 30.0) -> float:
        """Steps until a condition holds; duration of the longest, s."""
        end, longest = time.monotonic() + seconds, 0.0
        while not condition():
            began = time.monotonic()
            assert began < end, f"did not happen: {self.lost} {self.reports} {self.stage.view}"
            self.turn()
            longest = max(longest, time.monotonic() - began)
        return longest

    @property
    def there(self) -> bool:
        view = self.stage.view
        return view is not None and view.connected and view.status is not None

    @property
    def latched(self) -> str:
        view = self.stage.view
        return "" if view is None else view.latched or ""

    def begin_to_turn(self) -> int:
        """A long motion; id of the watchdog."""
        self.until(lambda: self.there)
        link = self.stage.link
        assert link is not None
        link.request(MotionKind.SEARCH, "pedal")
        link.search_to(math.radians(55.0), "a long way")
        self.until(lambda: self.stage.view is not None and self.stage.view.moving)
        return link.pid


@pytest.fixture
def kept(tmp_path: Path) -> Iterator[_Kept]:
    kept = _Kept(tmp_path)
    with kept.stage:
        yield kept


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_watchdog_that_is_gone_is_replaced_latched_and_its_stage_stopped_first(kept: _Kept, number: int) -> None:
    gone = kept.begin_to_turn()
    os.kill(gone, number)
    kept.until(lambda: kept.lost)
    assert "watchdog" in kept.lost[0]
    assert kept.stage.link is None
    waited = kept.until(lambda: kept.there and kept.latched)
    assert waited < 5.0  # the loop goes on; a start of a process takes longer than any turn
    link = kept.stage.link
    assert link is not None
    assert link.pid != gone
    assert kept.lost[0] in kept.latched
    orders = [line for line in read_trace(kept.folder / "trace") if line["what"] in ("stop", "move", "home")]
    first = next(line for line in orders if line["pid"] == link.pid)
    assert first["what"] == "stop"
    # Nothing moves without the operator's request, and everything with it.
    link.request(MotionKind.SEARCH, "pedal")
    link.search_to(math.radians(3.0), "on")
    kept.until(lambda: any("latched" in report.reason for report in kept.reports))
    link.reset("nurse")
    kept.until(lambda: not kept.latched)
    link.search_to(math.radians(3.0), "on")
    kept.until(lambda: any("has not asked" in report.reason for report in kept.reports))
    link.request(MotionKind.SEARCH, "pedal")
    link.search_to(math.radians(3.0), "on")
    kept.until(lambda: any(report.what == "arrived" for report in kept.reports))


def test_a_driver_that_cannot_be_started_again_is_tried_until_it_can(kept: _Kept) -> None:
    gone = kept.begin_to_turn()
    kept.refuse = "the driver is broken"
    os.kill(gone, signal.SIGKILL)
    kept.until(lambda: "the driver is broken" in kept.lost)
    with pytest.raises(StageLost, match="the driver is broken"):
        kept.stage.poll()
    kept.refuse = ""
    kept.until(lambda: kept.there)
    assert kept.latched


def test_closed_while_a_new_watchdog_starts_nothing_is_left(kept: _Kept) -> None:
    gone = kept.begin_to_turn()
    os.kill(gone, signal.SIGKILL)
    kept.until(lambda: kept.lost)
    kept.stage.close()
    kept.stage.close()
    assert kept.stage.link is None
    pids = {line["pid"] for line in read_trace(kept.folder / "trace")} - {gone}
    end = time.monotonic() + 10.0
    while pids and time.monotonic() < end:
        pids = {pid for pid in pids if Path(f"/proc/{pid}").exists()}
        time.sleep(0.05)
    assert not pids
