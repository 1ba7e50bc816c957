"""Kills a recording process again and again, and checks the files on disk.

A parent process has everything imported and forks a recorder for each run: it opens the session, continues at the end
of the file, and acknowledges an event directly after ``add`` (or ``append``) has returned.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from fgreg.detection.events_to_measurements import MeasurementExtractor
from fgreg.model.events import AimEvent, PairEvent
from fgreg.model.measurements import Aim, Pair
from fgreg.online.checks import CheckPoints
from fgreg.online.live_session import EpochFeed, LiveSession, online_engine
from fgreg.session.event_writer import event_document, event_line
from fgreg.session.journal import Journal
from fgreg.session.session_reader import read_session
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session

AIMS, PAIRS = 8, 60


@lru_cache(maxsize=1)
def template(folder: Path) -> tuple[tuple[AimEvent, ...], tuple[PairEvent, ...]]:
    """Aims and pairs of a simulated session."""
    events = read_session(folder).events
    aims = tuple(event for event in events if isinstance(event, AimEvent))
    return aims, tuple(event for event in events if isinstance(event, PairEvent))


def make_template(folder: Path, seed: int) -> Path:
    """The simulated session that events are taken from."""
    config = replace(PRESETS["first-hit"], aims=AIMS, pairs=PAIRS, tracks_heard=0, tracks_silent=0)
    write_session(simulate(config, seed), folder)
    return folder


def event_at(folder: Path, index: int) -> AimEvent | PairEvent:
    """Event number ``index`` of an endless session: the aims, then the pairs over and over, no two of them equal."""
    aims, pairs = template(folder)
    if index < len(aims):
        return replace(aims[index], t=float(index))
    number = index - len(aims)
    pair = pairs[number % len(pairs)]
    pose = pair.marker.camera_T_marker
    if pose is None:
        raise AssertionError("poses only")
    moved = pose.copy()
    moved[0, 3] += 1e-6 * (number // len(pairs))
    return replace(pair, t=float(index), pm=number, marker=replace(pair.marker, camera_T_marker=moved))


def record(folder: Path, source: Path, *, estimate: bool) -> None:
    """One run: takes in events until it is killed."""
    if estimate:
        with LiveSession.open(folder) as live:
            live_on(live.add, live.journal.lines, source)
    else:
        with Journal.open(folder) as journal:
            live_on(journal.append, journal.lines, source)


def live_on(add: Callable[[AimEvent | PairEvent], object], index: int, source: Path) -> None:
    while True:
        add(event_at(source, index))
        os.write(1, f"taken {index}\n".encode())
        index += 1


def mother() -> None:
    """Forks a recorder for each line on standard input; prints its process id, and when it has ended."""
    source = Path(sys.argv[1])
    template(source)
    for line in sys.stdin:
        kind, folder = line.rstrip("\n").split(" ", 1)
        told, tell = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(tell)
            os.read(told, 1)  # its first event comes after its process id
            try:
                record(Path(folder), source, estimate=kind == "estimate")
            except BaseException as error:  # printed, not raised: the forked copy must not continue
                os.write(1, f"failed {error!r}\n".encode())
            os._exit(1)
        os.write(1, f"born {child}\n".encode())
        os.close(told)
        os.close(tell)
        os.waitpid(child, 0)
        os.write(1, f"dead {child}\n".encode())


@dataclass(slots=True)
class Toll:
    """Counts over all runs.

    Attributes:
        lives: number of runs. taken: events acknowledged.
        missing: acknowledged events that are not on disk. damaged: lines (but an unfinished last one) that are not,
            byte by byte, the given ones; events that were never given count, too.
        unasked: complete events on disk that were killed before the acknowledgement. torn: last lines cut short.
        sessions: the folders.
    """

    lives: int = 0
    taken: int = 0
    missing: int = 0
    damaged: int = 0
    unasked: int = 0
    torn: int = 0
    sessions: list[Path] = field(default_factory=list)


def expected(source: Path, folder: Path, index: int) -> bytes:
    return event_line(event_document(event_at(source, index), folder), "")


def check(folder: Path, source: Path, acknowledged: int, toll: Toll) -> None:
    """Compare what is on disk with what was given and acknowledged."""
    path = folder / "events.jsonl"
    *lines, tail = (path.read_bytes() if path.exists() else b"").split(b"\n")
    toll.damaged += sum(line + b"\n" != expected(source, folder, index) for index, line in enumerate(lines))
    toll.damaged += max(0, len(lines) - acknowledged - 1)  # at most one event was not acknowledged yet
    toll.damaged += bool(tail) and not expected(source, folder, len(lines)).startswith(tail)
    toll.missing += max(0, acknowledged - len(lines))
    toll.torn += bool(tail)
    toll.unasked += max(0, len(lines) - acknowledged)


def run_kills(scratch: Path, *, kills: int, seed: int, estimate: bool, longest: int, most_s: float) -> Toll:
    """Kill a recorder ``kills`` times.

    Args:
        scratch: an empty folder. seed: of the moments and the session.
        estimate: record with the estimate (:class:`LiveSession`) rather than the journal alone.
        longest: events after which a new session begins, so that opening stays short.
        most_s: latest time of a kill, from the start or from the first event of that run.

    Raises:
        AssertionError: a recorder failed by itself.
    """
    source = make_template(scratch / "template", seed)
    rng, toll, acknowledged = random.Random(seed), Toll(), 0
    root = Path(__file__).resolve().parent.parent
    environment = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", "from tests.kill import mother; mother()", str(source)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, text=True) as child:
        if child.stdin is None or child.stdout is None:
            raise AssertionError("no pipes")
        for _ in range(kills):
            if not toll.sessions or acknowledged >= longest:
                toll.sessions.append(_new_session(scratch / f"session-{len(toll.sessions)}", source))
                acknowledged = 0
            folder = toll.sessions[-1]
            child.stdin.write(f"{'estimate' if estimate else 'journal'} {folder}\n")
            child.stdin.flush()
            word, number = child.stdout.readline().split()
            if word != "born":
                raise AssertionError(f"{word} {number}")
            # Every other run counts from its first event: on a busy machine it would not get that far otherwise.
            heard = child.stdout.readline().strip() if toll.lives % 2 else ""
            time.sleep(rng.uniform(0.0, most_s))
            os.kill(int(number), signal.SIGKILL)
            while (said := heard or child.stdout.readline().strip()) != f"dead {number}":
                if not said.startswith("taken "):
                    raise AssertionError(said or "the mother is dead")
                acknowledged, heard = int(said.split()[1]) + 1, ""
                toll.taken += 1
            toll.lives += 1
            check(folder, source, acknowledged, toll)
            acknowledged = _whole_lines(folder)  # the next run continues after these
        child.stdin.close()
    return toll


def _whole_lines(folder: Path) -> int:
    path = folder / "events.jsonl"
    return path.read_bytes().count(b"\n") if path.exists() else 0


def _new_session(folder: Path, source: Path) -> Path:
    folder.mkdir()
    (folder / "session.yaml").write_bytes((source / "session.yaml").read_bytes())
    return folder.resolve()


def count_events(folder: Path) -> int:
    """Events as read from disk."""
    return len([json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()])


def difference_from_uninterrupted(folder: Path, source: Path) -> float:
    """Largest difference of registration and covariance: reopened, against the same events without an interruption."""
    with LiveSession.open(folder) as live:
        reopened, model, config = live.estimate, live.journal.model, live.config
    engine = online_engine(model, config)
    feed = EpochFeed(engine, CheckPoints(model, config.limit_mm, engine.snapshot))
    extractor = MeasurementExtractor(model)
    unbroken = None
    for event in read_session(folder).events:
        if isinstance(event, AimEvent | PairEvent):
            shot = extractor.add(event, feed.epoch)
            if isinstance(shot, Aim | Pair):
                unbroken = feed.add(shot) or unbroken
    if reopened is None or unbroken is None:
        return 0.0 if reopened is unbroken else float("inf")
    worst = 0.0
    for a, b in (
        (reopened.trus_T_camera, unbroken.trus_T_camera),
        (reopened.covariance, unbroken.covariance),
    ):
        if a is None or b is None:
            worst = max(worst, 0.0 if a is b else float("inf"))
        else:
            worst = max(worst, float(np.abs(a - b).max()))
    return worst
