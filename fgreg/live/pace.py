"""What this machine can do, measured while nothing moves and from then on: frames a second, latency, the loop's gaps.

A session works with few frames a second: the marker is then held still for longer before it counts as held. Below a
limit it does not, and the stage is not homed. Each message names the cause and what to lower.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from fgreg.model.hindrances import MACHINE, TOO_FEW, TOO_SLOW

MEASURE_S, OVER_S = 3.0, 5.0
"""Time from the first processed frame until the first message; what is measured later is over the last ``OVER_S``."""
SAY_S = 30.0
"""Time between two messages about a change."""
MOST = 1000
"""Entries kept of each figure."""
NO_CAMERA_S = 20.0
"""Without a frame for this long the stage may be homed: that the camera is lost is another message."""
LEAST_HZ, GOOD_HZ = 2.0, 8.0
"""Least number of frames processed a second, with which a fibre that is held still shows; and a fair one."""
MOST_GAP_S = 0.8
"""Longest time between two steps of the loop: after a second without a heartbeat the stage stops."""
BEGIN_HZ, BEGIN_GAP_S = 3.0, 0.4
"""The same before the stage is homed, and after the machine was too slow: with some room for what comes."""
MOST_LATENCY_S = 0.2
"""A marker that is older is not followed."""
ALL_OF_THEM = 0.8
"""With this share of the frames used, few of them are the camera's doing."""
RAISE = "raise the camera's frame rate"
LOWER = "lower the camera's picture size or frame rate, end other programs, or use --no-viewer"


class Pace:
    """Measures one session; times are the host's.

    Args:
        began_s: when the session began.

    Attributes:
        slow: what is too slow now, and what to lower; empty if nothing is.
        enough: whether the machine is fast enough to register; False until it is measured.
    """

    def __init__(self, began_s: float) -> None:
        self._began_s, self._first_s = began_s, math.inf
        self._arrived: deque[tuple[float, int]] = deque(maxlen=MOST)
        self._frames: deque[tuple[float, float]] = deque(maxlen=MOST)
        self._gaps: deque[tuple[float, float]] = deque(maxlen=MOST)
        self._stepped_s = math.nan
        self._judged_s = self._said_s = -math.inf
        self._said: str | None = None
        self.slow, self.enough = "", False

    def arrived(self, now_s: float, frames: int) -> None:
        """Take in that frames have come."""
        self._arrived.append((now_s, frames))

    def frame(self, now_s: float, latency_s: float) -> None:
        """Take in that a frame was processed, and the time from its arrival to the decision."""
        self._first_s = min(self._first_s, now_s)
        self._frames.append((now_s, latency_s))

    def step(self, now_s: float) -> None:
        """Take in a step of the loop."""
        if not math.isnan(self._stepped_s):
            self._gaps.append((now_s, now_s - self._stepped_s))
        self._stepped_s = now_s

    def not_yet(self, now_s: float) -> str:
        """Why the stage may not be homed yet; empty if it may."""
        if self._said is None:
            no_camera = not self._arrived and now_s - self._began_s > NO_CAMERA_S
            return "" if no_camera else "what this machine can do is being measured"
        return "" if self.enough else self.slow

    def news(self, now_s: float) -> list[str]:
        """Messages: what the machine can do, and when it becomes too slow or fast enough. Call it in every step."""
        if now_s - self._first_s < MEASURE_S or now_s - self._judged_s < 1.0:
            return []
        self._judged_s = now_s
        for figures in (self._arrived, self._frames, self._gaps):
            while figures and figures[0][0] < max(now_s - OVER_S, self._first_s):
                figures.popleft()
        text, first = self._measured(now_s), self._said is None
        kind = self.slow.partition(":")[0]
        out = [text] if first and not self.slow else []
        if kind != (self._said or "") and (first or now_s - self._said_s > SAY_S):
            out.append(self.slow or f"{text}: fast enough again")
            self._said, self._said_s = kind, now_s
        self._said = self._said or ""
        return out

    def _measured(self, now_s: float) -> str:
        """Judge what was measured; returns it as text."""
        over_s = min(OVER_S, now_s - self._first_s)
        came, used = sum(count for _, count in self._arrived) / over_s, len(self._frames) / over_s
        latency = np.array([latency for _, latency in self._frames])
        gap_s = max((gap for _, gap in self._gaps), default=0.0)
        if came < 0.5:  # no camera: reported elsewhere
            self.enough = True
            self.slow = ""
            return "this machine: no frames"
        text, p50 = f"{used:.0f} of {came:.0f} frames/s used", math.inf
        if latency.size:
            p50, p99 = np.quantile(latency, (0.5, 0.99))
            text += f", {1e3 * p50:.0f} ms from frame to angle (99 %: {1e3 * p99:.0f} ms)"
        text += f", longest step {1e3 * gap_s:.0f} ms"
        least_hz, most_s = (LEAST_HZ, MOST_GAP_S) if self.enough else (BEGIN_HZ, BEGIN_GAP_S)
        self.enough = used >= least_hz and gap_s <= most_s
        by_camera = came < GOOD_HZ and used >= ALL_OF_THEM * came and gap_s <= most_s
        if not self.enough:
            self.slow = f"{TOO_FEW if by_camera else TOO_SLOW}: {text}: {RAISE if by_camera else LOWER}"
        elif p50 > MOST_LATENCY_S:
            self.slow = f"{MACHINE} is too slow to follow the beam, but registers: {text}: {LOWER}"
        elif by_camera:
            self.slow = f"the camera sends few frames, and pairs take longer: {text}: {RAISE}"
        elif used < GOOD_HZ:
            self.slow = f"{MACHINE} is slow, and registers with few frames: {text}: {LOWER}"
        else:
            self.slow = ""
        return f"{MACHINE}: {text}"
