"""The search for one PM while the fibre is held still: the planner's positions, and a pulse at each.

Once the PM is found, it is looked at from both sides: the first detections of a sweep towards larger angles and of one
towards smaller angles. They and the looks of the search are recorded as looks at one PM.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.live.actions import LocatedPulse, StageView
from fgreg.model.session_model import SessionModel
from fgreg.search.detection_model import DetectionModel
from fgreg.search.planner import Found, NotFound, SearchPlanner, Turn
from fgreg.search.window_edges import WindowEdges

ARRIVED_RAD = 0.004
"""The stage has arrived when it is this close to its goal."""
QUIET_S = 0.03
"""A pulse counts once the stage has stood still for this long."""
PATIENCE_S = 8.0
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
        model: session model. detection: detection model of the session. field_rad: plane angles that may be searched.
        both_sides: whether a found PM is looked at from both sides.
        looks: the planner's pulses with a detection. first_hits: the first detections from either side.
        found: the planner's result, from which on the window's edges are looked for.
        wants_pulses: whether the next pulse counts, because the stage stands at its goal.
    """

    planner: SearchPlanner
    held: FloatArray
    cold: bool
    threshold: float
    model: SessionModel
    detection: DetectionModel
    field_rad: tuple[float, float]
    both_sides: bool = True
    looks: list[LocatedPulse] = field(default_factory=list)
    first_hits: list[LocatedPulse] = field(default_factory=list)
    found: Found | None = None
    wants_pulses: bool = False
    _edges: WindowEdges | None = None
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
                if self.found is not None:
                    return self.found
                what = "no laser pulse" if there else "the stage has not arrived"
                return NotFound(f"{what} within {PATIENCE_S:.0f} s", len(self.looks))
            loud = pulse.amplitude is not None and pulse.amplitude >= self.threshold
            amplitude = pulse.amplitude if loud else None
            if self._edges is not None:
                if sweep := self._edges.add_look(amplitude):
                    self.first_hits.append(replace(pulse, sweep=sweep))
            else:
                self.planner.add_look(pulse.scan_rad, amplitude)
                if loud:
                    self.looks.append(pulse)
            self._goal, self.wants_pulses = None, False
        step = self._next(stage.scan_rad)
        if isinstance(step, Turn):
            self._goal, self._waits_s, self._stood_s, self.wants_pulses = step, now_s, None, False
        return step

    def _next(self, stands_rad: float) -> Turn | Found | NotFound | None:
        if self.found is None:
            step = self.planner.advance()
            if not isinstance(step, Found):
                return step
            self.found = step
            self._edges = self._window_edges(step, stands_rad) if self.both_sides else None
        turn = None if self._edges is None else self._edges.next()
        return self.found if turn is None else turn

    def _window_edges(self, found: Found, stands_rad: float) -> WindowEdges | None:
        """The sweeps from both sides; None where the PM is too weak to be detected at its window's edge."""
        near = [look for look in self.looks if look.scan_rad is not None and look.range_mm is not None]
        if not near:
            return None
        table = self.model.probe.sensitivity
        width = float(table.half_width_at(float(np.median([look.range_mm for look in near if look.range_mm]))))
        rotation = np.array([found.scan_rad - look.scan_rad for look in near if look.scan_rad is not None])
        log_peak = np.log([look.amplitude or self.threshold for look in near]) - self.detection.gain_log(rotation)
        at_edge = float(np.median(log_peak) + np.mean(self.detection.gain_log([-width, width])))
        if np.exp(at_edge) < self.threshold:
            return None
        spread = float(np.hypot(table.edge_sigma_rad, self.model.noise_per_pm.window_rad))
        step = self.model.stage.step_rad
        return WindowEdges(
            found.scan_rad, found.sigma_rad, width, spread, step, float(np.exp(at_edge)), *self.field_rad, stands_rad
        )

    def best_looks(self, found: Found) -> tuple[LocatedPulse, ...]:
        """At most ``MOST_LOOKS`` looks: the first detections, and looks surely inside the sensitivity window.

        Of those the ones that are most informative on the angle.
        """
        table = self.model.probe.sensitivity
        inside = []
        for look in self.looks:
            if look.scan_rad is None or look.range_mm is None:
                continue
            width = float(np.interp(look.range_mm, table.depth_mm, table.half_width_rad))
            if abs(look.scan_rad - found.scan_rad) < width - 2.0 * found.sigma_rad:
                inside.append(look)
        # The outermost look on either side determines the angle; the loudest ones determine position and range.
        chosen = list(self.first_hits)
        by_side = sorted(inside, key=lambda look: look.scan_rad or 0.0)
        if len(chosen) + len(by_side) > MOST_LOOKS and not chosen:
            chosen, by_side = [by_side[0], by_side[-1]], by_side[1:-1]
        chosen += sorted(by_side, key=lambda look: -(look.amplitude or 0.0))[: MOST_LOOKS - len(chosen)]
        return tuple(sorted(chosen, key=lambda look: look.pulse_s))


def _first_after(t_s: float, pulses: tuple[LocatedPulse, ...]) -> LocatedPulse | None:
    return next((pulse for pulse in pulses if pulse.scan_rad is not None and pulse.pulse_s > t_s), None)
