"""Check points of a running session: their effect on the verdict of each estimate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from fgreg.model.estimate import Verdict, worst_verdict
from fgreg.model.known_points import data_at
from fgreg.model.measurements import Check, KnownPoint
from fgreg.model.session_model import SessionModel
from fgreg.online.estimate import OnlineEstimate
from fgreg.registration.checks import check_registration
from fgreg.registration.rig_at_checks import rig_at_checks
from fgreg.registration.verdict import verdict_of
from fgreg.tracking.snapshot import Snapshot


class CheckPoints:
    """The checks up to now. They never enter the estimate.

    Args:
        model: the session's set-up.
        limit_mm: of the error.
        snapshot: gives the engine's latest one, None where there is none.
    """

    def __init__(self, model: SessionModel, limit_mm: float, snapshot: Callable[[], Snapshot | None]) -> None:
        self._model, self._limit_mm, self._snapshot = model, limit_mm, snapshot
        self._checks: list[Check] = []
        self._data: list[KnownPoint] = []
        self._last: tuple[OnlineEstimate, OnlineEstimate] | None = None

    def add(self, check: Check) -> None:
        """One more check."""
        self._checks.append(check)
        self._last = None

    def leave_out(self, point: KnownPoint) -> None:
        """A point is data of the registration: checks of it, earlier or later ones, do not count."""
        self._data.append(point)
        self._last = None

    def moved(self, since_s: float, epoch: int) -> None:
        """Camera epoch ``epoch`` has begun at ``since_s``: later checks belong to it."""
        self._checks = [
            replace(check, epoch=max(check.epoch, epoch)) if check.t >= since_s else check for check in self._checks
        ]
        self._last = None

    def applied(self, estimate: OnlineEstimate | None) -> OnlineEstimate | None:
        """The estimate with the checks of its camera epoch, and their effect on its verdict."""
        mine = [] if estimate is None else [check for check in self._checks if check.epoch == estimate.epoch]
        mine = [check for check in mine if data_at(check, self._data) is None]
        if not mine or estimate is None or estimate.trus_T_camera is None or estimate.covariance is None:
            return estimate
        if self._last is None or self._last[0] is not estimate:
            rig = rig_at_checks(self._model, self._snapshot(), mine).get(estimate.epoch)
            found = check_registration(mine, estimate.trus_T_camera, estimate.covariance, self._limit_mm, rig)
            checked = replace(
                estimate,
                verdict=worst_verdict(estimate.verdict, verdict_of(found.conditions)),
                reasons=(*estimate.reasons, *(condition.text for condition in found.conditions)),
                checks=found.checks,
            )
            self._last = (estimate, checked)
        return self._last[1]

    def refuse(self, estimate: OnlineEstimate | None) -> bool:
        """Whether the checks refuse an estimate that is not refused without them."""
        if estimate is None or estimate.verdict is Verdict.REFUSED:
            return False
        checked = self.applied(estimate)
        return checked is not None and checked.verdict is Verdict.REFUSED
