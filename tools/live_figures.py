"""Figures of live rooms for tools/study_live.py --quick: time to the first ok, wrong oks, orders that were off, stops.

A room runs in real time with all processes (:func:`conducted`), or in made-up time with the engine in this process
(:func:`rehearsed`): the same seed then gives the same figures on any machine. The load of other programs is made by
:func:`busy`.
"""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import os
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.drivers.base import CommandKind, OperatorCommand
from fgreg.drivers.simulated import RoomProcess, ask_truth
from fgreg.errors import EventRefused
from fgreg.geometry.transforms import FloatArray
from fgreg.live.actions import Action, Follow
from fgreg.live.launch import running
from fgreg.live.simulated_room import room_setup
from fgreg.live.stage_commands import AGAIN_RAD, AGAIN_S
from fgreg.model.estimate import Verdict
from fgreg.model.events import NoteEvent, StageEvent
from fgreg.model.hindrances import TOO_SLOW
from fgreg.model.session_model import StageModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.estimate import OnlineEstimate
from fgreg.online.full_solve import FullSolveCase, FullSolveResult
from fgreg.online.solver import InProcessSolver
from fgreg.session.session_reader import read_session
from fgreg.simulation.room import Room, room_config
from fgreg.stage.limits import MotionLimits
from tests.rehearsal import Rehearsal

SAMPLE_S = 1.0
"""Time between two looks at what is reported."""
BOUND = 1.96
"""Sigmas of a 95 % bound."""
FIRST_OK_S, MOST_FIRST_OK_S = 200.0, 400.0
WRONG_SHARE, OFF_SHARE, ORDERS = 0.005, 0.001, 3000
SIGMA_RAD = MotionLimits.of_session(StageModel(math.radians(2.0), (-1.0, 1.0))).track_sigma_rad
"""An order that is less certain is refused by the stage's safety gate."""
SOLVE_S = 1.0
"""Time of a full solve in made-up time, on a machine that is busy."""
BEAT = "the main program's heartbeat is missing"


@dataclass
class Figures:
    """What one room showed.

    Attributes:
        first_ok_s: time of the first ok. spots: PMs taken by then, or at the end.
        oks: (error, stated bound) in mm at the worst target, of each change of the estimate that was said to be ok.
        seconds_ok, seconds_wrong: seconds in which ok was shown, and in which it was off by more than twice its bound.
        orders_sigma: error of each order to follow that the stage's safety gate lets through, in the sigmas that were
            said, by the beam at its marker's exposure.
        stops: reasons of the stage's stops, but for the operator's and those for lost tracking.
        spent: what the time went into. slow: what was said of the machine. lost: messages about lost parts.
        refused: why pairs were refused, in made-up time.
    """

    seed: int
    first_ok_s: float = math.nan
    spots: int = 0
    oks: list[tuple[float, float]] = field(default_factory=list)
    seconds_ok: int = 0
    seconds_wrong: int = 0
    orders_sigma: list[float] = field(default_factory=list)
    stops: list[str] = field(default_factory=list)
    slow: str = ""
    lost: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    homed: bool = True
    spent: str = ""

    def line(self) -> str:
        """As text."""
        wrong = sum(error > 2.0 * bound for error, bound in self.oks)
        off = sum(abs(sigmas) > 2.0 * BOUND for sigmas in self.orders_sigma)
        beats = sum(reason == BEAT for reason in self.stops)
        return (
            f"seed {self.seed}: first ok {self.first_ok_s:.0f} s, {self.spots} PMs; oks said {len(self.oks)}, wrong "
            f"{wrong}; ok for {self.seconds_ok} s, wrong for {self.seconds_wrong} s; orders {len(self.orders_sigma)}, "
            f"off {off}; stops {len(self.stops)}, for want of a heartbeat {beats}; lost {len(self.lost)}, pairs "
            f"refused {len(self.refused)}"
            + ("" if self.homed else "; not homed: the machine is too slow")
            + f"; {self.spent}"
        )


def totals(rooms: list[Figures]) -> str:
    """All rooms, beside the targets."""
    first = [room.first_ok_s for room in rooms]
    known = [t for t in first if math.isfinite(t)]
    oks = [ok for room in rooms for ok in room.oks]
    wrong = sum(error > 2.0 * bound for error, bound in oks)
    orders = np.abs([sigmas for room in rooms for sigmas in room.orders_sigma])
    off = int(np.sum(orders > 2.0 * BOUND))
    shown, false = sum(r.seconds_ok for r in rooms), sum(r.seconds_wrong for r in rooms)
    beats = sum(reason == BEAT for room in rooms for reason in room.stops)
    quiet = sum(not room.homed for room in rooms)
    return "\n".join(
        (
            f"{len(rooms)} rooms: ok in {len(known)}, not homed and said why in {quiet}",
            f"first ok: median {np.median(known) if known else math.nan:.0f} s, longest "
            f"{max(known, default=math.nan):.0f} s    target {FIRST_OK_S:.0f}, {MOST_FIRST_OK_S:.0f}",
            f"oks said {len(oks)}, off by more than twice the bound {wrong} ({wrong / max(len(oks), 1):.2%})    target "
            f"at most {WRONG_SHARE:.1%}",
            f"ok shown for {shown} s, wrong for {false} s ({false / max(shown, 1):.2%})",
            f"orders to follow {len(orders)}, off by more than twice the 95 % bound {off} "
            f"({off / max(len(orders), 1):.2%}), than the bound {np.mean(orders > BOUND) if len(orders) else 0.0:.1%}"
            f"    target at most {OFF_SHARE:.1%} of at least {ORDERS}",
            f"stops for want of a heartbeat {beats}    target 0",
        )
    )


def error_mm(estimate: OnlineEstimate, trus_T_camera: FloatArray, targets_mm: FloatArray) -> float:
    """Error at the worst target."""
    assert estimate.trus_T_camera is not None
    off = estimate.trus_T_camera @ np.linalg.inv(trus_T_camera)
    return float(np.linalg.norm(targets_mm @ off[:3, :3].T + off[:3, 3] - targets_mm, axis=1).max())


# --- made-up time --------------------------------------------------------------------------------------------------


class _LateSolver(InProcessSolver):
    """Full solves whose results come ``SOLVE_S`` of the room's time later, as those of a worker process do."""

    def __init__(self, watched: _Watched) -> None:
        super().__init__(watched.model, SolveConfig(), verdicts=True)
        self._watched, self._until_s = watched, -math.inf

    def submit(self, case: FullSolveCase) -> None:
        super().submit(case)
        self.busy, self._until_s = True, self._watched.now_s + SOLVE_S

    def fetch(self) -> FullSolveResult | None:
        if not self.busy or self._watched.now_s < self._until_s:
            return None
        self.busy = False
        return super().fetch()


class _Watched(Rehearsal):
    """A rehearsal that keeps its figures. ``reports``: the operator says each bump."""

    figures: Figures
    reports: bool = False
    _sampled_s: float = 0.0
    _said: Any = None
    _estimate: OnlineEstimate | None = None
    _order: tuple[float, float] = (math.nan, -math.inf)
    _bumps: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.engine._solver = _LateSolver(self)

    def _frame(self) -> None:
        super()._frame()
        self.engine.refresh()
        estimate, figures = self.engine.estimate, self.figures
        if self.reports and len(self.room.moved_s) > self._bumps:
            self._bumps = len(self.room.moved_s)
            self._said.append(OperatorCommand(CommandKind.MOVED))
        moving = self._tags is not None and self._tags.moving_since_s is not None
        ok = estimate.verdict is Verdict.OK and estimate.predicted_tre is not None and not moving
        if ok and math.isnan(figures.first_ok_s):
            figures.first_ok_s = self.now_s
        sample = self.now_s - self._sampled_s > SAMPLE_S
        if not ok or not (sample or estimate is not self._estimate):
            return
        assert estimate.predicted_tre is not None
        found = error_mm(estimate, self.room.trus_T_camera(self.now_s), self.model.targets_mm)
        bound = estimate.predicted_tre.worst_mm
        if estimate is not self._estimate:
            figures.oks.append((found, bound))
            self._estimate = estimate
        if sample:
            self._sampled_s = self.now_s
            figures.seconds_ok += 1
            figures.seconds_wrong += found > 2.0 * bound

    def _pair(self, *arguments: Any) -> None:
        try:
            super()._pair(*arguments)
        except EventRefused as error:  # recorded as refused, as in a live session
            self.figures.refused.append(str(error))

    def _do(self, action: Action) -> None:
        if isinstance(action, Follow) and action.sigma_rad <= SIGMA_RAD:
            goal, at_s = self._order
            if not (abs(action.scan_rad - goal) < AGAIN_RAD and self.now_s - at_s < AGAIN_S):
                self._order = (action.scan_rad, self.now_s)
                off = action.scan_rad - self.room.plane_rad(action.marker_s)
                self.figures.orders_sigma.append(off / action.sigma_rad)
        super()._do(action)


def rehearsed(
    seed: int, aims: int, bump_every_s: float, seconds: float, tags: int, *, first: bool, reports: bool
) -> Figures:
    """A room in made-up time, with this number of static tags. ``first``: it ends at the first ok."""
    watched = _Watched(Room(room_config(seed, aims=aims, bump_every_s=bump_every_s, static_tags=tags)))
    watched.figures, watched.reports = Figures(seed), reports
    while watched.now_s < seconds and not (first and math.isfinite(watched.figures.first_ok_s)):
        watched.run(1.0)
    watched.figures.spots = watched.workflow._next_pm
    watched.figures.spent = watched.workflow.spent.text()
    return watched.figures


# --- real time -----------------------------------------------------------------------------------------------------


def conducted(
    folder: Path, seed: int, width_px: int, aims: int, bump_every_s: float, seconds: float, tags: int, *, first: bool
) -> Figures:
    """A room in real time, as by ``fgreg live --no-viewer``."""
    figures = Figures(seed)
    samples: list[
        tuple[float, OnlineEstimate, bool, bool]
    ] = []  # of its time: whether it is new, whether a second passed
    orders: list[tuple[float, float, float]] = []
    config = room_config(seed, width_px, aims=aims, bump_every_s=bump_every_s, static_tags=tags)
    with ExitStack() as stack:
        room = stack.enter_context(RoomProcess(seed, width_px, aims, bump_every_s, static_tags=tags))
        with running(room_setup(room.path, config), folder, SolveConfig()) as session:
            began, sampled = time.monotonic(), -math.inf
            last: tuple[float, ...] = ()
            loop, give = session.loop, session.loop._steering.order

            def order(action: Any) -> bool:
                given = give(action)
                if given and isinstance(action, Follow):
                    orders.append((action.marker_s, action.scan_rad, action.sigma_rad))
                return given

            loop._steering.order = order  # type: ignore[assignment, method-assign]

            def going() -> bool:
                nonlocal sampled, last
                now, status = time.monotonic(), loop.status()
                estimate = status.recorder.estimate
                if estimate is not None and status.verdict is Verdict.OK and estimate.predicted_tre is not None:
                    if math.isnan(figures.first_ok_s):
                        figures.first_ok_s, figures.spots = now - began, session_pms()
                    said = estimate.t, estimate.epoch, estimate.pairs, estimate.predicted_tre.worst_mm
                    sample = now - sampled > SAMPLE_S
                    if said != last or sample:
                        samples.append((now, estimate, said != last, sample))
                        sampled, last = now if sample else sampled, said
                return now - began < seconds and not (first and math.isfinite(figures.first_ok_s))

            def session_pms() -> int:
                return loop._workflow._next_pm

            loop.run(going)
            figures.spots = figures.spots or session_pms()
            figures.slow, figures.spent = loop.status().slow, loop._workflow.spent.text()
            used = loop.figures
            p50, p99 = np.percentile(np.array(used.latency_ms or [math.nan]), (50, 99))
            print(f"  {used.frames} frames, {used.skipped} skipped; latency p50 {p50:.0f}, p99 {p99:.0f} ms")
        truth = ask_truth(room.path, [t for t, *_ in samples], [t for t, _, _ in orders])
    targets = read_session(folder).model.targets_mm
    for (t, estimate, new, sample), true in zip(samples, truth["trus_T_camera"], strict=True):
        assert estimate.predicted_tre is not None
        found, bound = error_mm(estimate, np.array(true), targets), estimate.predicted_tre.worst_mm
        if found > 2.0 * bound:
            print(
                f"  wrong ok after {t - began:.1f} s: {found:.1f} mm, bound {bound:.1f} mm, epoch {estimate.epoch}, "
                f"{estimate.pairs} pairs, event of {estimate.t:.1f} s"
            )
        if new:
            figures.oks.append((found, bound))
        figures.seconds_ok += sample
        figures.seconds_wrong += sample and found > 2.0 * bound
    for (_, scan, sigma), spot in zip(orders, truth["spots_mm"], strict=True):
        figures.orders_sigma.append((scan - float(config.scene.array.plane_angle_rad(np.array(spot)))) / sigma)
    commands = set()
    for event in read_session(folder).events:
        if isinstance(event, StageEvent):
            commands.add(event.command)
            if event.command == "stop" and not event.reason.startswith(("the operator", "tracking held", "connected")):
                figures.stops.append(event.reason)
        elif isinstance(event, NoteEvent) and " lost: " in event.text:
            figures.lost.append(event.text)
        elif isinstance(event, NoteEvent) and event.text.startswith(TOO_SLOW):
            figures.slow = event.text
    figures.homed = "home" in commands
    for text in [*figures.stops, *figures.lost, *filter(None, [figures.slow])]:
        print(f"  {text}")
    return figures


# --- the load ------------------------------------------------------------------------------------------------------


def _burn(core: int, share: float, niceness: int) -> None:
    with contextlib.suppress(AttributeError, OSError):
        os.sched_setaffinity(0, {core})
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, niceness)
    period = 0.02
    while True:
        end = time.monotonic() + share * period
        while time.monotonic() < end:
            pass
        if share < 1.0:
            time.sleep((1.0 - share) * period)


@contextlib.contextmanager
def busy(cores: float, niceness: int) -> Iterator[None]:
    """Keep this many processors busy: a loop for each whole one, one that rests in between for the remaining share.

    Each is bound to a processor of its own. At niceness 0 a loop shares its processor with the session; below 0 (root
    only) it takes it, and the session has what is left.
    """
    shares = [1.0] * int(cores) + ([cores % 1.0] if cores % 1.0 else [])
    context = multiprocessing.get_context("spawn")
    loops = [
        context.Process(target=_burn, args=(core % (os.cpu_count() or 1), share, niceness), daemon=True)
        for core, share in enumerate(shares)
    ]
    for loop in loops:
        loop.start()
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.join()
