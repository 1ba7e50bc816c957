"""The search for one PM while the fibre is held still: the planner's positions, and a pulse at each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.live.actions import LocatedPulse, StageView
from fgreg.model.session_model import SessionModel
from fgreg.search.planner import Found, NotFound, SearchPlanner, Turn

ARRIVED_RAD = 0.004
"""The stage has arrived when it is this close to its goal."""
QUIET_S = 0.03
"""A pulse counts once the stage has stood still for this long."""
PATIENCE_S = 3.0
"""The search ends if the stage does not arrive, or no laser pulse comes, within this time."""
MOST_LOOKS = 4
"""Largest number of looks recorded for one PM."""


@dataclass(slots=True, eq=False)
class PmSearch:
    """One PM search.

    Attributes:
        planner: plans the positions; holds the belief about the PM's angle.
        held: ``camera_T_marker`` (4, 4) at the beginning.
        cold: whether the search covers the whole field, without a prediction.
        threshold: least amplitude of a detection.
        looks: pulses with a detection.
        wants_pulses: whether the next pulse counts, because the stage stands at its goal.
    """

    planner: SearchPlanner
    held: FloatArray
    cold: bool
    threshold: float
    looks: list[LocatedPulse]
    wants_pulses: bool = False
    _goal: Turn | None = None
    _waits_s: float = 0.0
    _stood_s: float | None = None

    def step(self, now_s: float, stage: StageView, pulses: tuple[LocatedPulse, ...]) -> Turn | Found | NotFound | None:
        """The next position to turn to, or how the search has ended; None to wait."""
        if self._goal is not None:
            there = not stage.moving and abs(stage.scan_rad - self._goal.scan_rad) < ARRIVED_RAD
            if stage.moving or (there and self._stood_s is None):
                self._waits_s = now_s
            self._stood_s = (self._stood_s or stage.at_s) if there else None
            self.wants_pulses = self._stood_s is not None and now_s > self._stood_s + QUIET_S
            pulse = None if self._stood_s is None else _first_after(self._stood_s + QUIET_S, pulses)
            if pulse is None or pulse.scan_rad is None:
                if now_s - self._waits_s < PATIENCE_S:
                    return None
                what = "no laser pulse" if there else "the stage has not arrived"
                return NotFound(f"{what} within {PATIENCE_S:.0f} s", len(self.looks))
            loud = pulse.amplitude is not None and pulse.amplitude >= self.threshold
            self.planner.add_look(pulse.scan_rad, pulse.amplitude if loud else None)
            if loud:
                self.looks.append(pulse)
            self._goal = None
        step = self.planner.next()
        if isinstance(step, Turn):
            self._goal, self._waits_s, self._stood_s, self.wants_pulses = step, now_s, None, False
        return step

    def best_looks(self, found: Found, model: SessionModel) -> tuple[LocatedPulse, ...]:
        """At most ``MOST_LOOKS`` looks, all surely inside the sensitivity window and most informative on the angle."""
        table = model.probe.sensitivity
        inside = []
        for look in self.looks:
            if look.scan_rad is None or look.range_mm is None:
                continue
            width = float(np.interp(look.range_mm, table.depth_mm, table.half_width_rad))
            if abs(look.scan_rad - found.scan_rad) < width - 2.0 * found.sigma_rad:
                inside.append(look)
        if len(inside) <= MOST_LOOKS:
            return tuple(inside)
        # The outermost look on either side determines the angle; the loudest ones determine position and range.
        by_side = sorted(inside, key=lambda look: look.scan_rad or 0.0)
        chosen = [by_side[0], by_side[-1]]
        rest = sorted(by_side[1:-1], key=lambda look: -(look.amplitude or 0.0))
        chosen += rest[: MOST_LOOKS - 2]
        return tuple(sorted(chosen, key=lambda look: look.pulse_s))


def _first_after(t_s: float, pulses: tuple[LocatedPulse, ...]) -> LocatedPulse | None:
    return next((pulse for pulse in pulses if pulse.scan_rad is not None and pulse.pulse_s > t_s), None)
