"""Devices that come and go: which are lost and why, which are back, and what is told of it.

A device is lost where its driver says so, where it does not answer, and where it answers with nothing worth having: a
camera whose picture does not change or shows nothing. Everything is noticed well within a second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.drivers.base import DeviceLost, StereoFrame

START_S = 5.0
"""So long devices may take to send for the first time."""
SILENT_S = 0.7
"""A video without pictures for so long has stopped, whatever its driver says."""
VIDEO_S = 0.15
"""Longer between pictures is no video: then there is nothing to expect."""
NOTHING_NEW_S = 0.4
"""Pictures that repeat or show nothing for so long mean trouble."""
FLAT = 4.0
"""Standard deviation, in grey levels, below which a picture shows nothing but its sensor's noise."""
ROWS, COLUMNS = 16, 4
"""Every so many of a picture's are looked at: noise makes any of them change from exposure to exposure."""


class Health:
    """What is lost.

    Attributes:
        lost: reasons by role.
    """

    def __init__(self) -> None:
        self.lost: dict[str, str] = {}
        self._told: list[str] = []

    def found(self, role: str, trouble: str) -> None:
        """How a role is now: what is wrong with it, or nothing."""
        before = self.lost.get(role)
        if trouble:
            self.lost[role] = trouble
            if before is None:
                self._told.append(f"{role} lost: {trouble}")
        elif before is not None:
            del self.lost[role]
            self._told.append(f"{role} is back")

    def news(self) -> list[str]:
        """What has changed since the last call, to be told."""
        told, self._told = self._told, []
        return told


class Source:
    """A device that is polled or sent to, with what is wrong with it.

    Args:
        device: fits fgreg.drivers.base.Device.
        began_s: host time from which on it is waited for.
        sends: by itself, as long as it is there: then it is lost, too, where it never came.
    """

    def __init__(self, device: Any, began_s: float, *, sends: bool) -> None:
        self._device, self._began_s, self._sends = device, began_s, sends
        self._seen, self._lost = False, ""

    def poll(self) -> Sequence[Any]:
        """What came; nothing where the device is gone."""
        try:
            return self._device.poll()  # type: ignore[no-any-return]
        except DeviceLost as error:
            self.failed(str(error))
            return ()

    def failed(self, reason: str) -> None:
        """The driver has said that the device is gone."""
        self._lost = reason

    def trouble(self, now_s: float) -> str:
        """What is wrong; empty where nothing is. A loss is told even if the device is back at once."""
        lost, connected = self._lost, bool(self._device.connected)
        if connected:
            self._seen, self._lost = True, ""
        if lost:
            return lost
        if self._sends and not connected and (self._seen or now_s - self._began_s > START_S):
            return f"{self._device.name} does not answer"
        return ""


class Pictures:
    """Whether a camera's pictures are new ones, and show something."""

    def __init__(self) -> None:
        self._before: tuple[npt.NDArray[np.uint8], ...] = ()
        self._came_s = self._new_s = self._showed_s = math.nan
        self._interval_s = math.inf
        self._side = ""

    def is_new(self, frame: StereoFrame, now_s: float) -> bool:
        """Take in a frame; whether both its pictures differ from those before.

        The same picture again is no new look at anything, whatever time it is stamped with.
        """
        sides = [frame.left] if frame.right is None else [frame.left, frame.right]
        samples = tuple(side[::ROWS, ::COLUMNS].copy() for side in sides)
        repeated = self._changed_not(samples)
        flat = next((side for side, sample in zip(("left", "right"), samples, strict=False) if sample.std() < FLAT), "")
        if math.isnan(self._came_s):
            self._new_s = self._showed_s = now_s
        else:
            took = now_s - self._came_s
            self._interval_s = took if math.isinf(self._interval_s) else 0.9 * self._interval_s + 0.1 * took
        self._came_s, self._before = now_s, samples
        if not repeated:
            self._new_s = now_s
        if not flat:
            self._showed_s = now_s
        self._side = repeated or flat
        return not repeated

    def _changed_not(self, samples: tuple[npt.NDArray[np.uint8], ...]) -> str:
        if len(samples) != len(self._before):
            return ""
        both = zip(("left", "right"), samples, self._before, strict=False)
        return next((side for side, new, old in both if np.array_equal(new, old)), "")

    def trouble(self, now_s: float) -> str:
        """What is wrong; empty where nothing is."""
        if self._interval_s <= VIDEO_S and now_s - self._came_s > SILENT_S:
            return "it sends no pictures"
        if self._came_s - self._new_s > NOTHING_NEW_S:
            return f"its {self._side} picture is frozen: the same again and again"
        if self._came_s - self._showed_s > NOTHING_NEW_S:
            return f"its {self._side} picture shows nothing: is the light on, is the lens free?"
        return ""


__all__ = ["Health", "Pictures", "Source"]
