"""Matches left and right pictures from two unsynchronised inputs."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

from fgreg.drivers.video_input import Grabbed


class StereoMatcher:
    """Pairs each left frame with the nearest right frame in time, if it is near enough; each is used once.

    A left frame is decided once a right frame of its time or later has come, or none is expected. Frames without a
    partner are dropped and counted; the number of waiting frames is bounded.

    Args:
        max_gap_s: longest time between left and right.
        time: gives a frame's time on a clock that both inputs share.
        room: largest number of waiting frames per side.
    """

    def __init__(self, max_gap_s: float, time: Callable[[Grabbed], float], room: int = 16) -> None:
        self.max_gap_s, self.dropped = max_gap_s, 0
        self._time, self._room = time, room
        self._left: deque[Grabbed] = deque()
        self._right: deque[Grabbed] = deque()

    def take(
        self, left: Iterable[Grabbed], right: Iterable[Grabbed], *, right_expected: bool = True
    ) -> list[tuple[Grabbed, Grabbed | None]]:
        """Add new frames; returns the decided pairs in time order.

        Args:
            left, right: in time order.
            right_expected: whether the right input delivers; if not, left frames without a partner are returned alone.
        """
        self._left.extend(left)
        self._right.extend(right)
        out: list[tuple[Grabbed, Grabbed | None]] = []
        while self._left:
            t = self._time(self._left[0])
            while len(self._right) > 1 and abs(self._time(self._right[1]) - t) <= abs(self._time(self._right[0]) - t):
                self._right.popleft()
                self.dropped += 1
            known = bool(self._right) and self._time(self._right[-1]) >= t
            near = bool(self._right) and abs(self._time(self._right[0]) - t) <= self.max_gap_s
            if near and (known or not right_expected):
                out.append((self._left.popleft(), self._right.popleft()))
            elif known:
                self._left.popleft()
                self.dropped += 1
            elif not right_expected:
                out.append((self._left.popleft(), None))
            else:
                break
        for side in (self._left, self._right):
            while len(side) > self._room:
                side.popleft()
                self.dropped += 1
        return out
