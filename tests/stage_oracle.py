"""A second definition of legal motion: from the history of events, in degrees, without state.

Shares no code with fgreg.stage.safety_gate. It refuses wherever a necessary condition is missing; that the gate may
refuse more is tested elsewhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

LIMITS_DEG, SWEEP_DEG = (-60.0, 40.0), (-35.0, 30.0)  # plane angles
SPEED_DEG_S = {"home": 8.0, "search": 12.0, "track": 10.0}
TOLERANCE_DEG = 0.5
REST_S = 1.5
"""By then a stopped stage stands; none of these speeds needs longer."""


@dataclass
class Oracle:
    """History of (time, what, details), oldest first; times as given to the gate."""

    history: list[tuple[float, str, dict[str, Any]]] = field(default_factory=list)

    def note(self, now: float, what: str, **details: Any) -> None:
        self.history.append((now, what, details))

    def _since(self, *what: str) -> int:
        """Index after the last of these; 0 where there was none."""
        return max((i + 1 for i, (_, name, _) in enumerate(self.history) if name in what), default=0)

    def _newest(self, what: str, after: int = 0) -> dict[str, Any] | None:
        found = [details for _, name, details in self.history[after:] if name == what]
        return found[-1] if found else None

    def _last_beat(self) -> dict[str, Any] | None:
        """The last one sent since the clock was last in doubt."""
        beats = [d for _, name, d in self.history[self._since("clock jump") :] if name == "beat"]
        return max(beats, key=lambda beat: beat["sent"], default=None)

    def alive(self, now: float, kind: str | None = None) -> bool:
        """For a motion of a kind; without one, for what was asked for last."""
        kind = kind or (self._newest("request") or {}).get("kind")
        beat = self._last_beat()
        return beat is not None and now - (0.25 if kind == "track" else 1.0) - 1e-9 <= beat["sent"]

    def trackable(self, now: float) -> bool:
        beat = self._last_beat()
        return (
            beat is not None
            and beat["marker"] is not None
            and -1e-3 <= now - beat["marker"] <= 0.2 + 1e-9
            and beat["registration"] in ("ok", "warning")
        )

    def heard_of_stage(self, now: float) -> dict[str, Any] | None:
        status = self._newest("status", self._since("clock jump"))
        return status if status is not None and now - status["at"] <= 0.3 + 1e-9 else None

    def _strayed(self) -> int:
        """Index after the last status in which a stage that should stand, and says so, is not where it stood; 0: none.

        Where it stood: in an earlier status of the same rest, read after its brakes' time, with the same zero. Compared
        only until the first such move, which a status after the reset may begin again.
        """
        strayed, stood, rest_s = 0, None, -math.inf
        previous_s: float | None = None
        for i, (now, what, details) in enumerate(self.history):
            if what.startswith("drive") or what in ("rest", "clock jump"):
                stood, previous_s, rest_s = None, None, now
            elif what == "status" and (details["moving"] or (stood is not None and stood["homed"] != details["homed"])):
                stood, previous_s = None, None
            elif what == "status":
                if stood is not None and abs(details["angle"] - stood["angle"]) > 2.0 * TOLERANCE_DEG + 1e-6:
                    strayed, stood = i + 1, details
                elif stood is None and previous_s is not None and previous_s > rest_s + REST_S + 1e-6:
                    stood = details
                previous_s = now
        return strayed

    def drive_is_legal(self, now: float, kind: str, target: float | None, speed: float, sent: float, sigma: Any) -> str:
        """Why not; empty where it is legal."""
        trouble = max(self._since("clock jump", "emergency", "fault"), self._strayed())
        if trouble and self._newest("reset", trouble) is None:
            return "no reset since the trouble"
        begin = self._since("clock jump", "emergency", "fault", "stop", "silence", "reset")
        requests = [d["kind"] for _, name, d in self.history[begin:] if name == "request"]
        if not requests or requests[-1] != kind:
            return "the last request since then is for something else, if there is one"
        if kind == "home" and self._newest("drive home", self._since("request")) is not None:
            return "homed already on this request"
        if not self.alive(now, kind):
            return "no heartbeat"
        if not -1e-3 <= now - sent <= 0.2 + 1e-9:
            return "command too old"
        if not 0.0 < speed <= SPEED_DEG_S[kind] + 1e-6:
            return "speed"
        status = self.heard_of_stage(now)
        if status is None:
            return "stage silent"
        if kind == "home":
            return "home with a target" if target is not None else ""
        if not status["homed"]:
            return "not homed"
        if target is None or not math.isfinite(target):
            return "no target"
        low, high = SWEEP_DEG if kind == "search" else LIMITS_DEG
        if not low - 1e-6 <= target <= high + 1e-6:
            return "target out of range"
        if not low - TOLERANCE_DEG - 1e-6 <= status["angle"] <= high + TOLERANCE_DEG + 1e-6:
            return "stands out of range"
        if kind == "track" and not (sigma is not None and 0.0 <= sigma <= 2.0 + 1e-6):
            return "sigma"
        return "" if kind != "track" or self.trackable(now) else "nothing to track by"

    def may_go_on(self, now: float, kind: str) -> str:
        """Why a motion under way has to be stopped by now; empty where it may go on."""
        started = self._since(f"drive {kind}")
        for what in ("clock jump", "emergency", "fault", "stop"):
            if self._newest(what, started) is not None:
                return what
        if not self.alive(now, kind):
            return "no heartbeat"
        status = self.heard_of_stage(now)
        if status is None:
            return "stage silent"
        inside = LIMITS_DEG[0] - TOLERANCE_DEG - 1e-6 <= status["angle"] <= LIMITS_DEG[1] + TOLERANCE_DEG + 1e-6
        if kind != "home" and not (status["homed"] and inside):
            return "left its limits or lost its zero"
        return "" if kind != "track" or self.trackable(now) else "nothing to track by"
