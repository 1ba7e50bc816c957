"""Measurements of tools/load_live.py during a session: latencies, queues, counts, and the processes' memory."""

from __future__ import annotations

import math
import os
import resource
import time
from array import array
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fgreg.drivers.base import StereoCamera, StereoFrame
from fgreg.geometry.transforms import FloatArray
from fgreg.live.launch import Running
from fgreg.live.status import Status
from fgreg.model.events import PairEvent

PERCENTILES = (50.0, 90.0, 99.0, 99.9, 100.0)
BUSY_S = 1.0
"""Time after an event in which the engine is at work on it."""
GROWS_FROM_MIN = 4
"""By then the stage follows, and everything that a session uses has been loaded."""
TINY_S = 1e-4
TRACKER = "resource tracker"


def percentiles(values: list[float]) -> dict[str, float]:
    """Percentiles of latencies, rounded, and their number."""
    out: dict[str, float] = {"count": len(values)}
    if values:
        names = ("p50", "p90", "p99", "p99.9", "max")
        out |= {
            name: round(float(np.percentile(values, share)), 1) for name, share in zip(names, PERCENTILES, strict=True)
        }
    return out


class _Answered(NamedTuple):
    """One frame: when it was processed, its latency, the device's time of its exposure, stage and load meanwhile."""

    done_s: float
    latency_ms: float
    device_s: float
    stage: str
    busy: bool


class _Answers:
    """Frames in few bytes each, since the memory of this very process is measured."""

    def __init__(self) -> None:
        self._numbers, self._stages = array("d"), [""]

    def append(self, done_s: float, latency_ms: float, device_s: float, stage: str, *, busy: bool) -> None:
        if stage not in self._stages:
            self._stages.append(stage)
        self._numbers.extend((done_s, latency_ms, device_s, self._stages.index(stage), busy))

    def all(self) -> list[_Answered]:
        rows = np.array(self._numbers).reshape(-1, 5).tolist()
        return [_Answered(a, b, c, self._stages[int(k)], bool(busy)) for a, b, c, k, busy in rows]

    def last_device_s(self) -> float:
        return self._numbers[-3]


@dataclass(frozen=True, slots=True, eq=False)
class Made:
    """Data sent by the devices: times by their own clocks, and the host's time at 0 of the camera's."""

    frames_s: FloatArray
    pulses_s: FloatArray
    camera_zero_s: float


class Spent:
    """Wall time of calls on one thread, split into work, waiting for a processor, and other waiting."""

    def __init__(self) -> None:
        self._rows = array("d")

    @staticmethod
    def now() -> tuple[float, float, float]:
        """Wall, at work, waiting for a processor (s; Linux's own account)."""
        fields = Path("/proc/thread-self/schedstat").read_text(encoding="ascii").split()
        return time.perf_counter(), time.thread_time(), 1e-9 * int(fields[1])

    def add(self, before: tuple[float, float, float]) -> None:
        """A call that began at ``before`` has ended."""
        self._rows.extend(1e3 * (b - a) for a, b in zip(before, self.now(), strict=True))

    def figures(self) -> dict[str, Any]:
        """Percentiles, ms; means of the slowest hundredth."""
        rows = np.array(self._rows).reshape(-1, 3)
        rows = np.column_stack([rows, rows[:, 0] - rows[:, 1] - rows[:, 2]])
        names = ("wall", "at work", "waits for a processor", "waits for locks and disk")
        out: dict[str, Any] = {name: percentiles(list(rows[:, k])) for k, name in enumerate(names)}
        if len(rows):
            slow = rows[rows[:, 0] >= np.percentile(rows[:, 0], 99)].mean(axis=0)
            out["slowest 1 %, mean"] = {name: round(float(slow[k]), 1) for k, name in enumerate(names)}
        return out


def _until(times_s: FloatArray, last_s: float) -> tuple[int, int]:
    """Number sent up to ``last_s``, and number that a slow player left out in between."""
    sent = times_s[times_s <= last_s + TINY_S]
    rate = round(1.0 / float(np.diff(times_s).min()))
    return len(sent), round(float(np.ptp(sent)) * rate) + 1 - len(sent)


def _counted(call: Callable[..., Any], note: Callable[[Any, Any], None]) -> Callable[..., Any]:
    def counting(*arguments: Any) -> Any:
        found = call(*arguments)
        note(arguments, found)
        return found

    return counting


def _rest(camera: StereoCamera) -> tuple[list[StereoFrame], int]:
    """Frames that wait at the driver, and the number dropped before, both at one time."""
    left: list[StereoFrame] = []
    until = time.monotonic() + 1.0
    while True:
        dropped, came = camera.dropped, camera.poll()
        left += came
        if (not came and camera.dropped == dropped) or time.monotonic() > until:
            return left, dropped


class Watch:
    """Measures a session after each step of its loop."""

    def __init__(self, session: Running) -> None:
        self._session = session
        self._began_s = time.monotonic()
        self._answered = _Answers()
        self._spent = {name: Spent() for name in ("turn", "look", "order")}
        self._queues: dict[int, dict[str, int]] = defaultdict(lambda: defaultdict(int))
        self._last_queues: dict[str, int] = {}
        self._pairs = self._handed_on = self._frames = self._in_poll = 0
        self._event_s = -1e9
        self._last_frame_s = self._last_pulse_s = -math.inf
        self._last: Status | None = None
        self._end: dict[str, int] = {}
        loop, recorder = session.loop, session.recorder
        locator = loop.pulse_locator
        locator.complete_pulses = _counted(locator.complete_pulses, self._heard)  # type: ignore[method-assign]
        locator.add_frames = _counted(locator.add_frames, self._hear)  # type: ignore[method-assign]
        recorder.hand_over = _counted(recorder.hand_over, self._handed_over)  # type: ignore[method-assign]
        loop.marker_tracker.poll = self._timed(loop.marker_tracker.poll, "look")  # type: ignore[method-assign]
        loop.turn = self._timed(loop.turn, "turn")  # type: ignore[method-assign]
        loop._steering.order = self._timed(loop._steering.order, "order")  # type: ignore[method-assign]

    def _timed(self, call: Callable[..., Any], name: str) -> Callable[..., Any]:
        spent, figures = self._spent[name], self._session.loop.figures

        def timed(*arguments: Any) -> Any:
            before, frames, found = Spent.now(), figures.frames, None
            try:
                found = call(*arguments)
                return found
            finally:
                if figures.frames > frames or (name == "look" and found) or name == "order":
                    spent.add(before)

        return timed

    def _hear(self, arguments: Any, _found: Any) -> None:
        for pulse in arguments[0]:
            self._last_pulse_s = pulse.stamp.device_s

    def _heard(self, _arguments: Any, found: Any) -> None:
        self._handed_on += len(found)

    def _handed_over(self, arguments: Any, _found: Any) -> None:
        self._event_s = time.monotonic()
        self._pairs += isinstance(arguments[0], PairEvent)

    def see(self, status: Status) -> None:
        """Take in the status after a step."""
        self._last = status
        figures = self._session.loop.figures
        if figures.frames > self._frames and status.frame is not None and figures.latency_ms:
            self._frames = figures.frames
            stamp, latency = status.frame.stamp, figures.latency_ms[-1]
            busy = status.now_s - self._event_s < BUSY_S or status.recorder.waiting > 0
            self._answered.append(stamp.host_s + 1e-3 * latency, latency, stamp.device_s, str(status.stage), busy=busy)
        devices = self._session.loop._devices
        self._last_queues = {
            "recorder": status.recorder.waiting,
            "pulses": self._session.loop.pulse_locator.waiting,
            "camera": len(devices.camera._waiting),  # type: ignore[attr-defined]
            "probe": len(devices.probe._waiting),  # type: ignore[attr-defined]
        }
        minute = self._queues[self._minute(status.now_s)]
        for name, length in self._last_queues.items():
            minute[name] = max(minute[name], length)

    def _minute(self, at_s: float) -> int:
        return int((at_s - self._began_s) / 60.0) + 1

    def end(self) -> None:
        """Read the counts before the devices are closed."""
        loop = self._session.loop
        devices, figures = loop._devices, loop.figures
        left, dropped = _rest(devices.camera)
        self._last_frame_s = max((frame.stamp.device_s for frame in left), default=self._answered.last_device_s())
        self._end = {
            "frames_dropped_driver": dropped,
            "frames_waiting": len(left),
            "frames_dropped_loop": figures.skipped,
            "frames_looked_into": figures.frames,
            "frames_with_marker": figures.found,
            "pulses_received": figures.pulses,
            "pulses_dropped": devices.probe.dropped,
            "pulses_handed_on": self._handed_on,
            "pulses_passed_over": loop.pulse_locator.passed_over,
            "pulses_waiting": loop.pulse_locator.waiting,
            "pairs_handed_over": self._pairs,
            "orders": figures.orders,
        }

    def figures(self, made: Made) -> dict[str, Any]:
        """Received against sent, up to the last item received: more was on its way at the end."""
        answered, counts, last = self._answered.all(), self._end, self._last
        assert last is not None
        kinds: dict[str, list[float]] = {"all": [a.latency_ms for a in answered]}
        for a in answered:
            kinds.setdefault(a.stage, []).append(a.latency_ms)
            kinds.setdefault("while events come in" if a.busy else "while none comes in", []).append(a.latency_ms)
        minutes: dict[str, list[float]] = {}
        for a in answered:
            minutes.setdefault(f"minute {self._minute(a.done_s)}", []).append(a.latency_ms)
        exposed = [1e3 * (a.done_s - a.device_s - made.camera_zero_s) for a in answered]
        frames_sent, frames_skipped = _until(made.frames_s, self._last_frame_s)
        pulses_sent, pulses_skipped = _until(made.pulses_s, self._last_pulse_s)
        frames = sum(counts[f"frames_{name}"] for name in ("looked_into", "dropped_loop", "dropped_driver", "waiting"))
        pulses = counts["pulses_handed_on"] + counts["pulses_waiting"] + counts["pulses_dropped"]
        known, estimate = last.recorder.registration, last.recorder.estimate
        return {
            "counts": {
                "frames_sent": frames_sent,
                "frames_skipped_by_player": frames_skipped,
                "pulses_sent": pulses_sent,
                "pulses_skipped_by_player": pulses_skipped,
                **counts,
                "frames_unaccounted": frames_sent + frames_skipped - frames,
                "pulses_unaccounted": pulses_sent + pulses_skipped - pulses,
            },
            "latency_ms": {name: percentiles(values) for name, values in kinds.items()},
            "from_exposure_ms": percentiles(exposed),
            **{f"{name}_ms": spent.figures() for name, spent in self._spent.items()},
            "minutes": {name: percentiles(values) for name, values in minutes.items()},
            "queues": {**{f"minute {k}, most": dict(v) for k, v in self._queues.items()}, "end": self._last_queues},
            "estimate": {
                "stage": str(last.stage),
                "verdict": known.verdict.value,
                "epoch": known.epoch,
                "pairs_of_epoch": known.pairs,
                "reasons": list(known.reasons),
                "worst_mm": None
                if estimate is None or estimate.predicted_tre is None
                else estimate.predicted_tre.worst_mm,
                "aims": last.recorder.aims,
                "pairs": last.recorder.pairs,
                "refused": last.recorder.refused,
                "trouble": last.recorder.trouble,
                "lost": list(last.lost),
            },
        }


# --- processes -----------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Process:
    name: str
    started: str
    rss_mb: list[float] = field(default_factory=list)
    used_s: list[float] = field(default_factory=list)


class Processes:
    """This process and all its children, sampled once a minute."""

    def __init__(self) -> None:
        self._began_s = time.monotonic()
        self._found: dict[int, _Process] = {}
        self._next_s = self._began_s + 60.0
        self._first_used: dict[int, float] = {}
        self._look()
        for pid in self._found:
            self._first_used[pid] = _used_s(pid)

    def see(self, now_s: float) -> None:
        """Sample if a minute has passed."""
        if now_s >= self._next_s:
            self._next_s += 60.0
            self.sample(now_s)

    def sample(self, _now_s: float) -> None:
        """Sample all processes."""
        self._look()
        for pid, process in self._found.items():
            if _started(pid) == process.started:
                process.rss_mb.append(round(_rss_mb(pid), 1))
                process.used_s.append(_used_s(pid) - self._first_used.get(pid, 0.0))

    def _look(self) -> None:
        own, parents = os.getpid(), _parents()
        below = [own]
        for pid in below:
            below += [child for child, parent in sorted(parents.items()) if parent == pid]
        for pid in below:
            name = "main" if pid == own else _name(pid)
            self._found.setdefault(pid, _Process(name, _started(pid))).name = name

    def figures(self) -> dict[str, Any]:
        """By process: memory at each minute and at the end, its growth after start-up, share of a processor."""
        lasted = time.monotonic() - self._began_s
        out: dict[str, Any] = {}
        for pid, process in self._found.items():
            figures: dict[str, Any] = {"rss_mb": process.rss_mb}
            if process.used_s:
                figures["processor_share"] = round(process.used_s[-1] / lasted, 3)
            if len(process.rss_mb) > GROWS_FROM_MIN:
                figures["growth_mb"] = round(process.rss_mb[-1] - process.rss_mb[GROWS_FROM_MIN - 1], 1)
            out[f"{process.name} ({pid})"] = figures
        return out

    def left(self) -> list[str]:
        """Processes that still run, without this one and Python's resource tracker."""
        own = os.getpid()
        mine = {pid for pid, parent in _parents().items() if parent == own}
        return [
            process.name
            for pid, process in self._found.items()
            if pid != own and _started(pid) == process.started and not (process.name == TRACKER and pid in mine)
        ]


def _stat(pid: int) -> list[str]:
    """Fields after the name, from the state on; none where the process has ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    except OSError:
        return []


def _parents() -> dict[int, int]:
    found = {int(path.name): _stat(int(path.name)) for path in Path("/proc").glob("[0-9]*")}
    return {pid: int(fields[1]) for pid, fields in found.items() if fields}


def _started(pid: int) -> str:
    """Start time in the kernel's ticks; empty where the process has ended (or is a zombie)."""
    fields = _stat(pid)
    return fields[19] if fields and fields[0] != "Z" else ""


def _used_s(pid: int) -> float:
    fields = _stat(pid)
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK") if fields else 0.0


def _rss_mb(pid: int) -> float:
    fields = _stat(pid)
    return int(fields[21]) * resource.getpagesize() / 1e6 if fields else 0.0


def _name(pid: int) -> str:
    """Name of a worker process, or of the module that a process runs."""
    try:
        words = Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8")
        shown = Path(f"/proc/{pid}/comm").read_text(encoding="utf-8").strip()
    except OSError:
        return "ended"
    for part, name in (("fgreg.stage.watchdog", "watchdog"), ("resource_tracker", TRACKER)):
        if part in words:
            return name
    return shown.removeprefix("fgreg-")
