"""First detections of a found PM from both sides of its sensitivity window.

The stage goes beyond the window and steps back by the session's ``step_deg`` until the PM is detected: once towards
larger angles, once towards smaller ones. The middle of the two is free of the window's width and of the backlash.

The PM counts as detected from the amplitude that it has at the edge of the session's window (peak times gain): a bright
PM is heard far beyond, and one that falls below the detection threshold within its window has no such edge.
"""

from __future__ import annotations

import math

from fgreg.search.planner import Phase, Turn

BEYOND_SIGMAS = 2.0
"""The first stop is beyond the window by this many sigmas of angle and width, so that nothing is detected there."""
STARTS = 2
"""Times that a sweep is started, each time two steps farther out: where it detects the PM at its first stop, the edge
lies farther out still."""


class WindowEdges:
    """Sweeps towards a PM from either side: turn to :meth:`next` and pass the look to :meth:`add_look`, until None.

    A side whose start is out of the field, or whose edge does not show, is left out.

    Args:
        found_rad, sigma_rad: plane angle of the PM.
        half_width_rad, width_sigma_rad: of its window.
        step_rad: the sweeps' increment.
        edge_amplitude: at the edge of the window.
        low_rad, high_rad: the field.
        stands_rad: current plane angle of the stage; the nearer side comes first.
    """

    def __init__(
        self,
        found_rad: float,
        sigma_rad: float,
        half_width_rad: float,
        width_sigma_rad: float,
        step_rad: float,
        edge_amplitude: float,
        low_rad: float,
        high_rad: float,
        stands_rad: float,
    ) -> None:
        self._found, self._step, self._edge_amplitude = found_rad, step_rad, edge_amplitude
        self._low, self._high = low_rad, high_rad
        self._reach = half_width_rad + BEYOND_SIGMAS * math.hypot(sigma_rad, width_sigma_rad)
        self._sides = [1, -1] if stands_rad <= found_rad else [-1, 1]
        self._starts = 0
        self._at: float | None = None
        self._first = True
        self._begin()

    def next(self) -> Turn | None:
        """The next position; None where both sides are done."""
        if self._at is None:
            return None
        side = "smaller" if self._sides[0] > 0 else "larger"
        return Turn(self._at, Phase.EDGES, f"first detection from {side} angles")

    def add_look(self, amplitude: float | None) -> int:
        """Take in the look at the position of :meth:`next`: its sweep (+1 or -1) where it is a first detection, else 0.

        Args:
            amplitude: None if nothing was detected.
        """
        if self._at is None:
            raise ValueError("both sides are done")
        sweep, detected = self._sides[0], amplitude is not None and amplitude >= self._edge_amplitude
        if not detected:
            self._at, self._first = self._at + sweep * self._step, False
            if sweep * (self._at - self._found) > 0.0:  # nothing up to the middle: the side is given up
                self._next_side()
            return 0
        if self._first and self._starts < STARTS:
            self._begin()
            return 0
        first_hit = not self._first
        self._next_side()
        return sweep if first_hit else 0

    def _next_side(self) -> None:
        self._sides, self._starts = self._sides[1:], 0
        self._begin()

    def _begin(self) -> None:
        """Start the sweep of the first side that is left, two steps farther out at each start."""
        self._at, self._first = None, True
        while self._sides:
            at = self._found - self._sides[0] * (self._reach + 2.0 * self._starts * self._step)
            self._starts += 1
            if self._low <= at <= self._high:
                self._at = at
                return
            self._sides, self._starts = self._sides[1:], 0
