"""Stage orders out and reports in, for the live loop; tells the operator if the stage is missing."""

from __future__ import annotations

import math
from collections.abc import Callable

from fgreg.drivers.base import host_now
from fgreg.errors import FgregError
from fgreg.live.actions import Ask, Follow, Halt, Release, StageView, Sweep
from fgreg.live.device_health import START_S, Health
from fgreg.stage.client import Report
from fgreg.stage.interface import StageError
from fgreg.stage.limits import MotionKind
from fgreg.stage.reconnect import ReconnectingStage

AGAIN_RAD, AGAIN_S = math.radians(0.1), 0.5
"""A track order is repeated once its goal has moved by ``AGAIN_RAD``, or after ``AGAIN_S``."""
NOT_THERE = "the stage is not connected"

Order = Ask | Sweep | Follow | Halt | Release


class Steering:
    """Sends orders to the stage, if there is one.

    Args:
        stage: None if the session has no stage; then orders are ignored.
        health: gets whether the stage is lost.
        say: shows a line to the operator.
        began_s: host time at which waiting for the stage began.

    Attributes:
        unwritten: why the last order or stop could not be recorded; empty if it was.
    """

    def __init__(
        self, stage: ReconnectingStage | None, health: Health, say: Callable[[str], None], began_s: float
    ) -> None:
        self._stage, self._health, self._say, self._began_s = stage, health, say, began_s
        self._seen, self.unwritten = False, ""
        self._followed: tuple[float, float] = (math.nan, -math.inf)

    @property
    def view(self) -> StageView | None:
        """Newest status; None if there is no stage or it is not connected."""
        view = None if self._stage is None else self._stage.view
        if view is None or view.status is None or not view.connected:
            return None
        status, latched = view.status, view.latched or ""
        return StageView(status.scan_rad, status.moving, status.homed, status.stamp.host_s, view.requested, latched)

    @property
    def latched(self) -> str:
        """Why nothing may move until a reset, whether the stage is connected or not; empty if it may move."""
        view = None if self._stage is None else self._stage.view
        return "" if view is None else view.latched or ""

    def poll(self) -> StageView | None:
        """Take in the stage's reports; returns the newest status."""
        if self._stage is None:
            return None
        try:
            for report in self._stage.poll():
                self._reported(report)
        except StageError as error:
            self._health.found("stage", str(error))
            return None
        except FgregError as error:  # a stop that cannot be recorded now is recorded later
            self.unwritten = str(error)
        view = self.view
        if view is not None:
            self._seen = True
        if view is not None or self._seen or host_now() - self._began_s > START_S:
            self._health.found("stage", "" if view is not None else self.latched or NOT_THERE)
        return view

    def _reported(self, report: Report) -> None:
        if report.what in ("stopped", "trouble", "refused"):
            self._say(f"stage {report.what}: {report.reason}")

    def beat(self, marker_s: float | None, verdict: str | None) -> None:
        """Send the heartbeat; arguments as those of :meth:`fgreg.stage.client.StageLink.beat`."""
        if self._stage is None or self._stage.link is None:
            return
        try:
            self._stage.link.beat(marker_s, verdict)
        except StageError as error:
            self._health.found("stage", str(error))

    def order(self, order: Order) -> bool:
        """Send an order to the stage; whether it was sent."""
        if self._stage is None:
            return False
        link = self._stage.link
        if link is None:
            if not isinstance(order, Sweep | Follow):
                self._say(f"no order can be given: {NOT_THERE}")
            return False
        try:
            match order:
                case Ask(kind, by):
                    link.request(kind, f"operator ({by})" if by else "operator")
                    if kind is MotionKind.HOME:
                        link.home("asked for by the operator")
                case Sweep(scan_rad, reason):
                    link.search_to(scan_rad, reason)
                case Follow(scan_rad, sigma_rad, _, reason):
                    goal, at_s = self._followed
                    now = host_now()
                    if abs(scan_rad - goal) < AGAIN_RAD and now - at_s < AGAIN_S:
                        return False
                    self._followed = (scan_rad, now)
                    link.track_to(scan_rad, sigma_rad, reason)
                case Halt(reason):
                    link.stop(reason)
                case Release():
                    link.reset("operator")
        except StageError as error:
            self._health.found("stage", str(error))
            return False
        except FgregError as error:  # a stop was sent all the same, other orders were not
            self.unwritten = str(error)
            return False
        return True
