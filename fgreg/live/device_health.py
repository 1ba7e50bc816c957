"""Monitors the devices: which are lost and why, which are back, and the messages about it.

A device is lost if its driver says so, if it does not answer, or if its data are useless: a camera whose picture is
frozen, blank, or of another size than calibrated. Every loss is detected well within a second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.drivers.base import DeviceLost, StereoFrame
from fgreg.model.camera_model import StereoRig

START_S = 5.0
"""Longest time until a device's first data."""
SILENT_S = 0.7
"""A video without pictures for this long has stopped, whatever its driver says."""
LEFT_OUT_S = 10.0
"""Shortest time between two accounts of messages that a driver has left out."""
VIDEO_S = 0.15
"""A source with a longer interval between pictures is no video, and no interval is expected of it."""
NOTHING_NEW_S = 0.4
"""A camera whose pictures repeat or are blank for this long is lost."""
FLAT = 4.0
"""A picture is blank if its standard deviation in grey levels is smaller: that is the sensor's noise."""
ROWS, COLUMNS = 16, 4
"""Steps between the rows and columns that are compared; sensor noise changes every pixel from exposure to exposure."""


class Health:
    """The lost devices.

    Attributes:
        lost: reason of each loss, by role.
    """

    def __init__(self) -> None:
        self.lost: dict[str, str] = {}
        self._news: list[str] = []

    def found(self, role: str, trouble: str) -> None:
        """Take in a role's state: ``trouble`` says what is wrong; empty if nothing is."""
        before = self.lost.get(role)
        if trouble:
            self.lost[role] = trouble
            if before is None:
                self._news.append(f"{role} lost: {trouble}")
        elif before is not None:
            del self.lost[role]
            self._news.append(f"{role} is back")

    def news(self) -> list[str]:
        """Messages about the changes since the last call."""
        news, self._news = self._news, []
        return news


class Source:
    """A device that is polled or sent to, with its state.

    Args:
        device: fits fgreg.drivers.base.Device.
        began_s: host time at which waiting for it began.
        sends: whether it sends without being asked; then it is lost also if it never connects.
    """

    def __init__(self, device: Any, began_s: float, *, sends: bool) -> None:
        self._device, self._began_s, self._sends = device, began_s, sends
        self._seen, self._lost = False, ""
        self._left_out, self._told_s = 0, -math.inf

    def poll(self) -> Sequence[Any]:
        """New data; empty if the device is lost."""
        try:
            return self._device.poll()  # type: ignore[no-any-return]
        except DeviceLost as error:
            self.failed(str(error))
            return ()

    def failed(self, reason: str) -> None:
        """Take in that the driver has reported a loss."""
        self._lost = reason

    def trouble(self, now_s: float) -> str:
        """What is wrong; empty if nothing is. A loss is reported even if the device is back at once."""
        lost, connected = self._lost, bool(self._device.connected)
        if connected:
            self._seen, self._lost = True, ""
        if lost:
            return lost
        if self._sends and not connected and (self._seen or now_s - self._began_s > START_S):
            return f"{self._device.name} does not answer"
        return ""

    def left_out(self, now_s: float) -> str:
        """How many messages its driver has left out since the last account, and why the last one; empty if none."""
        count = int(getattr(self._device, "rejected", 0))
        new = count - self._left_out
        if new == 0 or now_s - self._told_s < LEFT_OUT_S:
            return ""
        self._left_out, self._told_s = count, now_s
        why = getattr(self._device, "last_rejection", self._device.name)
        return f"{new} message{'s' if new > 1 else ''} left out, the last one from {why}"


class Pictures:
    """Detects pictures of a camera that are frozen, blank, or of another size than it was calibrated with.

    Args:
        rig: the calibration; None: any size will do.
    """

    def __init__(self, rig: StereoRig | None = None) -> None:
        cameras = [] if rig is None else [rig.left, rig.left if rig.right is None else rig.right]
        self._sizes = [camera.image_size for camera in cameras]
        self._misfit = ""
        self._before: tuple[npt.NDArray[Any], ...] = ()
        self._came_s = self._new_s = self._showed_s = math.nan
        self._interval_s = math.inf
        self._side = ""

    def is_new(self, frame: StereoFrame, now_s: float) -> bool:
        """Take in a frame; whether it can be used: all its pictures differ from those before, and their size fits.

        A repeated picture carries no new measurement, whatever its time stamp. In one of another size the calibration
        gives a wrong pose.
        """
        sides = [frame.left] if frame.right is None else [frame.left, frame.right]
        self._misfit = self._other_size([(side.shape[1], side.shape[0]) for side in sides])
        samples = tuple(side[::ROWS, ::COLUMNS].copy() for side in sides)
        repeated = self._repeated_side(samples)
        both = zip(("left", "right"), samples, strict=False)
        flat = next((side for side, sample in both if sample.std() < FLAT * max(1.0, float(sample.max()) / 255.0)), "")
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
        return not (repeated or self._misfit)

    def _other_size(self, found: Sequence[tuple[int, int]]) -> str:
        for (width, height), (wide, high) in zip(found, self._sizes, strict=False):
            if (width, height) != (wide, high):
                return f"its pictures have {width} x {height} px, the calibration is for {wide} x {high}"
        return ""

    def _repeated_side(self, samples: tuple[npt.NDArray[Any], ...]) -> str:
        if len(samples) != len(self._before):
            return ""
        both = zip(("left", "right"), samples, self._before, strict=False)
        return next((side for side, new, old in both if np.array_equal(new, old)), "")

    def trouble(self, now_s: float) -> str:
        """What is wrong; empty if nothing is."""
        if self._interval_s <= VIDEO_S and now_s - self._came_s > SILENT_S:
            return "it sends no pictures"
        if self._misfit:
            return self._misfit
        if self._came_s - self._new_s > NOTHING_NEW_S:
            return f"its {self._side} picture is frozen: the same again and again"
        if self._came_s - self._showed_s > NOTHING_NEW_S:
            return f"its {self._side} picture shows nothing: is the light on, is the lens free?"
        return ""
