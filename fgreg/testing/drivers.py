"""A conformance test kit for drivers: what fgreg.drivers.base and fgreg.stage.interface ask, tried on a driver.

    from fgreg.testing.drivers import Bench, check_driver

    def test_my_camera():
        device = MyEmulator()
        bench = Bench(lambda: MyCamera(device.port), send=device.send, lose=device.unplug, restore=device.plug_in)
        check_driver("camera", bench)

The bench is the driver and the other end of its device, which the test plays. The first rule that is broken raises
:class:`NotConforming`. Rules of all roles: no call waits; a loss is raised once, within ``lost_s``; the driver comes
back by itself; wrong data never raise; ``close`` may be called twice. Besides, of those that are polled: items of the
role's class, host times that never run back, device times that never do between two losses, numbers that increase,
arrays that later items do not change. Of sinks: a refused registration is sent to no one. Of the stage, whose driver
raises at every call once it is lost, and which the watchdog opens again: opening moves nothing.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fgreg.drivers.base import (
    BmodeFrame,
    DeviceLost,
    MotionSample,
    OverlayPicture,
    PaFrame,
    Registration,
    StereoFrame,
    host_now,
)
from fgreg.drivers.plugin_device import ITEMS, is_item
from fgreg.drivers.registry import Role
from fgreg.geometry.transforms import as_float_array, is_rigid
from fgreg.model.time_sync import Stamp
from fgreg.stage.interface import MAX_CALL_S, StageLost, StageStatus

CALL_S = MAX_CALL_S
"""No call takes longer; one may, since the machine may have delayed it."""
USUAL_CALL_S = 0.01
"""Half of the calls take no longer than this."""
QUIET_S = 0.05
"""For this long nothing more is raised after a loss, or sent after a refused registration."""
ITEMS_LEAST = 3
SPEED_RAD_S = math.radians(5.0)
OPEN_S, CLOSE_S = 2.0, 3.0
_PAUSE_S = 0.002


class NotConforming(AssertionError):  # noqa: N818
    """A rule that the driver breaks, and how."""


@dataclass(frozen=True, slots=True)
class Bench:
    """A driver, and the other end of its device.

    Attributes:
        open: makes the driver.
        send: of what is polled: the device sends an item; called until one arrives. None where it sends by itself.
        lose: the device is unplugged, falls silent, or ends.
        restore: it is there again. None: it never is, as a recording that was played to its end.
        bad: each makes the device send something wrong. The connection may end by it, if the next ``send`` works.
        received: of sinks: how many transforms the receiver has got; of overlays: how many pictures.
        lost_s: longest time until a loss is raised. back_s: longest time until data come, at first and again.
    """

    open: Callable[[], Any]
    send: Callable[[], object] | None = None
    lose: Callable[[], object] = lambda: None
    restore: Callable[[], object] | None = None
    bad: Sequence[Callable[[], object]] = ()
    received: Callable[[], int] = lambda: 0
    lost_s: float = 1.0
    back_s: float = 5.0


def check_driver(role: str, bench: Bench) -> None:
    """Try a driver of a role (as CONFIG.yaml calls it) on its bench. Raises NotConforming."""
    kind = Role(role)
    tried = _Tried(kind, bench)
    try:
        if kind is Role.STAGE:
            _check_stage(tried)
        elif kind in (Role.SINKS, Role.OVERLAY):
            _check_sink(tried)
        else:
            _check_source(tried)
    finally:
        for _ in range(2):
            tried.timed(tried.device.close, CLOSE_S)
    tried.check_times()


def _rule(holds: object, broken: str) -> None:
    if not holds:
        raise NotConforming(broken)


class _Tried:
    """The driver on its bench: what it gave, how long its calls took."""

    def __init__(self, role: Role, bench: Bench) -> None:
        self.role, self.bench = role, bench
        self.losses: list[str] = []
        self.items: list[Any] = []
        self._kept: list[tuple[Any, list[Any]]] = []
        self._took: list[float] = []
        self._began_s = host_now()
        self._since_loss = 0
        self.device = self.timed(bench.open, OPEN_S)

    def timed(self, call: Callable[[], Any], most_s: float | None = None) -> Any:
        """What a call returns. It may raise DeviceLost and StageLost only."""
        began = time.perf_counter()
        try:
            return call()
        except (DeviceLost, StageLost, NotConforming):
            raise
        except Exception as error:
            raise NotConforming(f"raised {type(error).__name__}: {error}") from error
        finally:
            took = time.perf_counter() - began
            if most_s is None:
                self._took.append(took)
            elif took > most_s:
                raise NotConforming(f"took {took:.1f} s to open or close, at most {most_s:g} s allowed")

    def check_times(self) -> None:
        """No call waited."""
        took = sorted(self._took)
        second, middle = took[-2:][0], took[len(took) // 2]
        _rule(second <= CALL_S, f"a call waited: {second:.3f} s, at most {CALL_S} s allowed")
        _rule(middle <= USUAL_CALL_S, f"calls wait: {middle:.3f} s is usual, at most {USUAL_CALL_S} s allowed")

    def poll(self) -> int:
        """Poll once, if it can be; the number of items."""
        if self.role in (Role.SINKS, Role.OVERLAY):
            return 0
        try:
            found = self.timed(self.device.poll)
        except DeviceLost as error:
            self.losses.append(str(error))
            self._since_loss = len(self.items)
            return 0
        for item in found:
            self._take(item)
        return len(found)

    def run(self, seconds: float, until: Callable[[], object], send: bool = False) -> bool:
        """Poll for some seconds, or until a condition holds; whether it does."""
        end = time.monotonic() + seconds
        while not until():
            if time.monotonic() > end:
                return False
            if send and self.bench.send is not None:
                self.bench.send()
            self.poll()
            time.sleep(_PAUSE_S)
        return True

    def until_items(self, least: int, why: str) -> None:
        """Poll until there are some more items."""
        enough = len(self.items) + least
        came = self.run(self.bench.back_s, lambda: len(self.items) >= enough, send=True)
        _rule(came, f"{why}: {len(self.items) + least - enough} items within {self.bench.back_s:g} s")

    def check_device(self, connected: bool, when: str) -> None:
        """What a device says of itself."""
        name, dropped = self.device.name, self.device.dropped
        _rule(isinstance(name, str) and name, f"name is {name!r}, expected a text")
        _rule(type(dropped) is int and dropped >= 0, f"dropped is {dropped!r}, expected a number")
        if hasattr(self.device, "rejected"):
            last = getattr(self.device, "last_rejection", None)
            _rule(isinstance(last, str), f"rejected without why: last_rejection is {last!r}, expected a text")
        self.run(QUIET_S, lambda: self.device.connected is connected, send=connected)
        found = self.device.connected
        _rule(found is connected, f"connected is {found!r} {when}")

    def _take(self, item: Any) -> None:
        expected = ITEMS[self.role]
        _rule(is_item(self.role, item), f"gave a {type(item).__name__}, expected {expected.__name__}")
        if self.role is not Role.OPERATOR:
            self._check_stamp(item)
            arrays = _arrays(item)
            if len(self._kept) < ITEMS_LEAST:
                self._kept.append((item, [array.copy() for array in arrays]))
        self.items.append(item)

    def _check_stamp(self, item: Any) -> None:
        stamp, now = item.stamp, host_now()
        _rule(isinstance(stamp, Stamp), f"stamp is {stamp!r}, expected a Stamp")
        _rule(math.isfinite(stamp.device_s), f"a device time of {stamp.device_s}")
        age = now - stamp.host_s
        _rule(
            0.0 <= age <= now - self._began_s + 1.0, f"a host time {age:.3f} s ago, expected host_now() at its arrival"
        )
        if not self.items:
            return
        before = self.items[-1]
        _rule(stamp.host_s >= before.stamp.host_s, "host times run back")
        if len(self.items) > self._since_loss:
            _rule(stamp.device_s >= before.stamp.device_s, "device times run back")
        if hasattr(item, "index"):
            _rule(item.index > before.index, f"index {item.index} after {before.index}")

    def check_kept(self) -> None:
        """The first items are as they were."""
        for item, copies in self._kept:
            same = all(np.array_equal(a, b, equal_nan=True) for a, b in zip(_arrays(item), copies, strict=True))
            _rule(same, "an item's array changed after it was given: each item needs an array of its own")


def _arrays(item: Any) -> list[Any]:
    """An item's arrays; each fits its role."""
    match item:
        case StereoFrame(left=left, right=right):
            sides = [left] if right is None else [left, right]
            for side in sides:
                fits = isinstance(side, np.ndarray) and side.dtype in (np.uint8, np.uint16)
                _rule(fits and side.shape[2:] in ((), (3,)), f"a picture of {_form(side)}")
            return sides
        case PaFrame(data=data):
            _rule(isinstance(data, np.ndarray) and data.ndim == 2 and data.size, f"a pulse of {_form(data)}")
            return [data]
        case BmodeFrame(image=image):
            fits = isinstance(image, np.ndarray) and image.dtype == np.uint8 and image.shape[2:] in ((), (3,))
            _rule(fits, f"a picture of {_form(image)}")
            return [image]
        case MotionSample(base_T_camera=pose):
            _rule(isinstance(pose, np.ndarray) and pose.shape == (4, 4) and is_rigid(pose), f"a pose of {_form(pose)}")
            return [pose]
    return []


def _form(value: Any) -> str:
    shape = getattr(value, "shape", None)
    return f"{shape} {value.dtype}" if isinstance(shape, tuple) else type(value).__name__


def _check_source(tried: _Tried) -> None:
    """A device that is polled."""
    bench = tried.bench
    tried.until_items(ITEMS_LEAST, "no data at the start")
    _rule(len(tried.losses) <= 1, f"several losses before the first data: {tried.losses}")
    tried.check_device(True, "while data come")
    _talk(tried)
    tried.run(QUIET_S, lambda: False)
    before = len(tried.losses)
    for number, send_bad in enumerate(bench.bad):
        send_bad()
        tried.run(QUIET_S / 5, lambda: False)
        tried.until_items(1, f"no data after bad[{number}]")
        # Counted from the first: on a slow machine a loss may come after the next one was sent.
        losses = tried.losses[before:]
        _rule(len(losses) <= number + 1, f"more losses than wrong data up to bad[{number}]: {losses}")
    tried.run(QUIET_S, lambda: False)
    if bench.bad:  # a loss by the last of it is over
        tried.until_items(1, "no data after wrong data")
    if bench.restore is not None:  # else it may have ended by now
        tried.losses.clear()
    bench.lose()
    _rule(tried.run(bench.lost_s, lambda: tried.losses), f"no loss was raised within {bench.lost_s:g} s")
    _rule(all(tried.losses), "a loss without a text")
    count = len(tried.items)
    tried.run(QUIET_S, lambda: False)
    _rule(len(tried.losses) == 1, f"a loss was raised {len(tried.losses)} times")
    _rule(len(tried.items) == count, "items came from a lost device")
    tried.check_device(False, "after a loss")
    _talk(tried)
    if bench.restore is not None:
        bench.restore()
        tried.until_items(1, "no data after the device was there again")
        _rule(len(tried.losses) == 1, f"raised while it came back: {tried.losses[-1]}")
        tried.check_device(True, "after it came back")
    tried.check_kept()


def _talk(tried: _Tried) -> None:
    if tried.role is Role.OPERATOR:
        tried.timed(lambda: tried.device.tell("a message of the conformance test"))


def _check_sink(tried: _Tried) -> None:
    """A device that is sent to."""
    bench = tried.bench

    def send(verdict: str = "ok") -> None:
        now = host_now()
        what: Registration | OverlayPicture = OverlayPicture(Stamp(now, now), np.zeros((4, 6, 3), np.uint8), 0)
        if tried.role is Role.SINKS:
            pose = None if verdict == "refused" else as_float_array(np.eye(4))
            what = Registration(Stamp(now, now), verdict, pose, None, 0.1, 0.01, ("conformance test",), 0.1)
        try:
            tried.timed(lambda: tried.device.send(what))
        except DeviceLost as error:
            tried.losses.append(str(error))

    def until(condition: Callable[[], object], seconds: float, verdict: str = "ok") -> bool:
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                return False
            send(verdict)
            time.sleep(_PAUSE_S)
        return True

    _rule(until(bench.received, bench.back_s), f"no registration was received within {bench.back_s:g} s")
    _rule(not tried.losses, f"raised at the start: {tried.losses}")
    tried.check_device(True, "while its receiver listens")
    if tried.role is Role.SINKS:
        until(lambda: False, QUIET_S, "refused")
        count = bench.received()
        until(lambda: False, QUIET_S, "refused")
        _rule(bench.received() == count, "a refused registration was sent as a transform")
    bench.lose()
    _rule(until(lambda: tried.losses, bench.lost_s), f"no loss was raised within {bench.lost_s:g} s")
    until(lambda: False, QUIET_S)
    _rule(len(tried.losses) == 1, f"a loss was raised {len(tried.losses)} times")
    tried.check_device(False, "after a loss")
    if bench.restore is not None:
        count = bench.received()
        bench.restore()
        again = until(lambda: bench.received() > count, bench.back_s)
        _rule(again, f"no registration was received within {bench.back_s:g} s after the receiver was there again")
        _rule(len(tried.losses) == 1, f"raised while it came back: {tried.losses[-1]}")


def _check_stage(tried: _Tried) -> None:
    """The stage; its calls come as from the watchdog."""
    bench, last = tried.bench, 0.0

    def status() -> StageStatus:
        nonlocal last
        found = tried.timed(tried.device.status)
        _rule(isinstance(found, StageStatus), f"status gave a {type(found).__name__}")
        _rule(last <= found.stamp.host_s <= host_now(), "times of statuses run back, or are not host_now()")
        last = found.stamp.host_s
        return found  # type: ignore[no-any-return]

    def until(condition: Callable[[StageStatus], bool], what: str) -> StageStatus:
        end = time.monotonic() + bench.back_s
        while not condition(found := status()):
            _rule(time.monotonic() < end, f"{what} within {bench.back_s:g} s")
            time.sleep(_PAUSE_S)
        return found

    first = status()
    time.sleep(QUIET_S)
    _rule(not (now := status()).moving and now.scan_rad == first.scan_rad, "opening it moves it")
    starts = {
        "home": lambda: tried.device.home(SPEED_RAD_S),
        "move_to": lambda: tried.device.move_to(first.scan_rad + 0.5, SPEED_RAD_S),
    }
    for name, start in starts.items():
        tried.timed(start)
        until(lambda found: found.moving or found.homing, f"{name} did not start")
        tried.timed(tried.device.stop)
        until(lambda found: not (found.moving or found.homing), f"stop did not end {name}")
    for send_bad in bench.bad:
        send_bad()
        for _ in range(10):
            status()
            time.sleep(_PAUSE_S)
    bench.lose()
    end = time.monotonic() + bench.lost_s
    while not _lost(tried, status):
        _rule(time.monotonic() < end, f"no StageLost within {bench.lost_s:g} s")
        time.sleep(_PAUSE_S)
    calls: dict[str, Callable[[], object]] = {"status": status, "stop": tried.device.stop, **starts}
    for name, call in calls.items():
        _rule(_lost(tried, call), f"{name} of a lost stage did not raise StageLost")
    if bench.restore is not None:
        tried.timed(tried.device.close)
        bench.restore()
        tried.device, last = tried.timed(bench.open, OPEN_S), 0.0
        status()


def _lost(tried: _Tried, call: Callable[[], object]) -> bool:
    try:
        tried.timed(call)
    except StageLost:
        return True
    return False
