"""What the time of a session goes into."""

from __future__ import annotations

import math

CALIBRATING, WAITING, GOING = "calibrating", "waiting for the stage", "going to the next spot"
SEARCHING, BOTH_SIDES, FOLLOWING = "searching", "looks from both sides", "following"


class TimeSpent:
    """Seconds by purpose, in the order in which they first came.

    Attributes:
        seconds: of each purpose.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last_s = math.nan

    def add(self, now_s: float, purpose: str) -> None:
        """The time since the last call went into this."""
        if not math.isnan(self._last_s):
            self.seconds[purpose] = self.seconds.get(purpose, 0.0) + max(0.0, now_s - self._last_s)
        self._last_s = now_s

    def text(self) -> str:
        """As text: the total, then each purpose."""
        parts = ", ".join(f"{seconds:.0f} s {purpose}" for purpose, seconds in self.seconds.items() if seconds >= 1.0)
        return f"{sum(self.seconds.values()):.0f} s: {parts}"
