"""Hours of a live session: memory of all processes, files and processes left behind, and processes killed in turn.

    python tools/study_hours.py made-up --hours 4       # time made up, observations without pictures, real processes of
                                                        # the registration: some 20 minutes on a free machine
    python tools/study_hours.py real --minutes 20       # all processes in the simulated room, with a recording; each of
                                                        # them is killed (SIGKILL) in turn, and has to be back in 2 s
    python tools/study_hours.py real --cache /var/tmp/fgreg --width 1280   # the same with the pictures of
                                                        # tools/load_live.py: rendering takes most of a processor

Memory is that of this process and of each of its children by name; growth counts from minute 10 on, and is at most 20
MB. A killed process's successor counts on from it. At the end no child, none of their shared memory in /dev/shm and no
temporary file is left. The exit status is 1 where one of these is missed. The machine's load is printed: other work
beside it makes everything slower.
"""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

sys.path.insert(0, os.fspath(Path(__file__).resolve().parent.parent))

from fgreg.drivers.simulated import RoomProcess
from fgreg.live.launch import EngineProcesses, LiveSetup, Running, make_folder, running, setup_text
from fgreg.live.loop import IDLE_S
from fgreg.live.simulated_room import room_setup, simulated_room
from fgreg.live.viewer_feed import viewer_feed
from fgreg.model.events import PairEvent
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine_process import EngineProcess
from fgreg.online.live_session import LiveSession
from fgreg.simulation.documents import session_document
from fgreg.simulation.room import Room, room_config
from load_live import STAY_S
from load_player import playing
from load_watch import Processes
from played_room import FRAME_RATE, Making, make_pictures
from study_live import Recording, Told
from tests.rehearsal import Rehearsal

GROWS_FROM_MIN, GROWTH_MB = 10.0, 20.0
RESUMED_S, PATIENCE_S = 2.0, 30.0
KILLED = ("engine", "solve", "locator", "leftview", "rightview", "watchdog")
"""Processes that are killed in turn; the room is the simulated hospital, not ours."""
CLEANED_S = 600.0
"""Time made up between two times at which what a rehearsal notes for tests is dropped."""


class Memory:
    """Memory by name of process and minute of the session."""

    def __init__(self) -> None:
        self.by_name: dict[str, list[tuple[float, float]]] = defaultdict(list)
        self.pids: set[str] = set()

    def sample(self, minute: float) -> None:
        processes = Processes()
        processes.sample(0.0)
        for name, figures in processes.figures().items():
            process, _, pid = name.partition(" (")
            self.pids.add(pid[:-1])
            if figures["rss_mb"]:
                self.by_name[process].append((minute, figures["rss_mb"][-1]))

    def report(self) -> bool:
        """Print it; whether nothing grows, and something was there to see it of."""
        good, judged = True, 0
        for name, samples in sorted(self.by_name.items()):
            early = [mb for minute, mb in samples if minute <= GROWS_FROM_MIN]
            late = [mb for minute, mb in samples if minute > GROWS_FROM_MIN]
            growth = max(late) - max(early) if early and late else math.nan  # it was there for a part of the time only
            judged += not math.isnan(growth)
            shown = " ".join(f"{mb:.0f}" for _, mb in samples[:: max(1, len(samples) // 16)])
            print(f"  {name:<18} growth {growth:6.1f} MB    target {GROWTH_MB:g}    (MB: {shown})")
            good &= not growth > GROWTH_MB or name == "room"
        if not judged:
            print(f"  no process was there before and after minute {GROWS_FROM_MIN:.0f}: growth is not judged")
        return good and judged > 0


def left_over(memory: Memory, folder: Path) -> list[str]:
    """Shared memory of the session's processes, by their numbers in its name, and temporary files."""
    shared = [path for path in Path("/dev/shm").glob("fgreg-*") if memory.pids & set(path.name.split("-"))]
    temporary = [path for path in folder.rglob("*") if path.name.startswith((".", "fgreg-")) or ".part" in path.name]
    return [os.fspath(path) for path in shared + temporary]


def made_up(hours: float, folder: Path, seed: int, memory: Memory) -> bool:
    """A session in made-up time."""
    room = Room(room_config(seed, aims=6))
    rehearsal, told = Rehearsal(room), Told()
    make_folder(folder, setup_text(session_document(room.config.scene)))
    began = time.monotonic()
    with ExitStack() as stack:
        make_engine = EngineProcesses()
        stack.callback(make_engine.close)
        session = stack.enter_context(LiveSession.open(folder, SolveConfig(), make_engine, late=True))
        rehearsal.engine = Recording(session, told)  # type: ignore[assignment]
        while rehearsal.now_s < 3600.0 * hours:
            rehearsal.run(60.0)
            minute = rehearsal.now_s / 60.0
            memory.sample(minute)
            if rehearsal.now_s % CLEANED_S < 60.0:
                said = rehearsal.messages[-1][1].text if rehearsal.messages else "nothing"
                for notes in (rehearsal.messages, rehearsal.actions, rehearsal.errors_deg, told.events, told.estimates):
                    notes.clear()
                looks = sum(isinstance(event, PairEvent) for event in session.journal.events)
                epochs = len(session.engine.starts())
                size_mb, took = (folder / "events.jsonl").stat().st_size / 1e6, time.monotonic() - began
                print(
                    f"  minute {minute:.0f}: {looks} looks, {epochs} epochs, events.jsonl {size_mb:.1f} MB, "
                    f"{took:.0f} s of work; said last: {said}",
                    flush=True,
                )
    opening = time.monotonic()
    with ExitStack() as stack:
        make_engine = EngineProcesses()
        stack.callback(make_engine.close)
        stack.enter_context(LiveSession.open(folder, SolveConfig(), make_engine, late=True))
        print(f"  opened again in {time.monotonic() - opening:.1f} s, with all processes")
    return memory.report()


def played_room(stack: ExitStack, cache: Path, folder: Path, seed: int, width_px: int) -> LiveSetup:
    """A room whose pictures were made beforehand, so that it leaves the processors to the session."""
    config = room_config(seed, width_px, aims=8)
    making = Making(config, 10, 2, cache / f"room-{seed}-{width_px}-8-10-2.raw")
    make_pictures(making, 2)
    play = partial(playing, making=making, frame_rate=FRAME_RATE, stay_s=STAY_S, figures=folder / "player.json")
    return room_setup(stack.enter_context(RoomProcess(run=play)).path, config)


def real(minutes: float, folder: Path, options: argparse.Namespace, kills: tuple[str, ...], memory: Memory) -> bool:
    """A session in real time, with kills."""
    good = True
    with ExitStack() as stack:
        if options.cache is None:
            setup = simulated_room(stack, options.seed, 4, width_px=options.width, static_tags=2)
        else:
            setup = played_room(stack, options.cache, folder, options.seed, options.width)
        feed = stack.enter_context(viewer_feed(folder / "live.rrd", "hours", live=False, say=print))
        session = stack.enter_context(running(setup, folder / "session", SolveConfig(), feed.taken, print))
        feed.session(session.model, SolveConfig().limit_mm)
        began, sampled, killed = time.monotonic(), -math.inf, 0

        def run(seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
            nonlocal sampled
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                if not session.loop.turn():
                    time.sleep(IDLE_S)
                feed.status(session.loop.status())
                minute = (time.monotonic() - began) / 60.0
                if minute - sampled >= 0.5:
                    sampled = minute
                    memory.sample(minute)
                if until():
                    return True
            return False

        every = max(20.0, 60.0 * minutes / (len(kills) * max(1.0, minutes / 5.0) + 1.0))
        while time.monotonic() - began < 60.0 * minutes:
            run(min(every, max(0.0, 60.0 * minutes - (time.monotonic() - began))))
            if kills and time.monotonic() - began < 60.0 * minutes - 5.0:
                good &= _kill(session, kills[killed % len(kills)], run)
                killed += 1
        figures = session.loop.figures
        print(f"  {figures.frames} frames, {figures.pulses} pulses, {session.recorder.state.pairs} looks recorded")
    size_mb = (folder / "live.rrd").stat().st_size / 1e6
    print(f"  recording {size_mb:.0f} MB, {size_mb / minutes:.1f} MB a minute")
    return memory.report() and good


def _kill(session: Running, name: str, run: Callable[..., bool]) -> bool:
    """Kill one process; whether another one is at work in time."""
    before = _pids(name)
    if not before:
        print(f"  {name}: not there, nothing killed    target: it is there")
        return False
    engine = session.session.engine
    pid = (engine.pid if name == "engine" and isinstance(engine, EngineProcess) else None) or before[-1]  # no spare
    frames, began = session.loop.figures.frames, time.monotonic()
    os.kill(pid, signal.SIGKILL)

    def back() -> bool:
        others = [found for found in _pids(name) if found != pid]
        return bool(others) and not session.loop.lost and session.loop.figures.frames > frames + 1

    run(0.3)
    found = run(PATIENCE_S, back)
    took = time.monotonic() - began
    load = os.getloadavg()[0]
    print(f"  {name} killed: {'at work again' if found else 'NOT at work'} after {took:.1f} s    target {RESUMED_S:g}"
          f"    (load {load:.1f}; lost: {dict(session.loop.lost)})", flush=True)  # fmt: skip
    return found and took <= RESUMED_S


def _pids(name: str) -> list[int]:
    """Processes below this one of that name."""
    processes = Processes()
    return [int(key.partition(" (")[2][:-1]) for key in processes.figures() if key.partition(" (")[0] == name]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mode", choices=["made-up", "real"])
    parser.add_argument("--hours", type=float, default=4.0, help="made-up: of the session")
    parser.add_argument("--minutes", type=float, default=20.0, help="real: of the session")
    parser.add_argument("--kill", nargs="*", choices=KILLED, default=KILLED, help="real: processes killed in turn")
    parser.add_argument("--width", type=int, default=640, help="real: of the pictures, px")
    parser.add_argument("--cache", type=Path, help="real: folder of pictures made beforehand, by tools/load_live.py")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    memory = Memory()
    with tempfile.TemporaryDirectory(prefix="hours-") as place:
        folder = Path(place)
        os.environ["TMPDIR"] = tempfile.tempdir = place  # what is left there is ours
        if options.mode == "made-up":
            good = made_up(options.hours, folder / "session", options.seed, memory)
        else:
            good = real(options.minutes, folder, options, tuple(options.kill), memory)
        behind = left_over(memory, folder)
        tempfile.tempdir = None
    processes = Processes().left()
    print(f"  processes left: {processes}; files left: {behind}    target none of either")
    print(f"  load average of the machine {' '.join(f'{load:.1f}' for load in os.getloadavg())}")
    return 0 if good and not processes and not behind else 1


if __name__ == "__main__":
    raise SystemExit(main())
