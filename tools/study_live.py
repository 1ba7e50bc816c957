"""Reports of `fgreg live`, against a replay and a solve of its recording, and against the truth.

    python tools/study_live.py --seeds 1 2 --seconds 200            # rooms in real time, one after another
    python tools/study_live.py --made-up --seeds 1 2 3 4 5          # in simulated time: observations without pictures
    python tools/study_live.py --recorded FOLDER ...                # sessions of earlier runs: replay and solve only
    python tools/study_live.py --quick --first-ok --made-up --bump-every inf --seeds $(seq 20) --seconds 400
    python tools/study_live.py --quick --made-up --seeds $(seq 100) --seconds 300 [--reported]
    python tools/study_live.py --quick --first-ok --load 1.5 --bump-every inf --seeds $(seq 10) --seconds 600

Each room is run as by `fgreg live`, without the viewer. For every event: the estimate reported right after it, and that
of replay: verdict, epoch, pairs, and the difference of the registrations in sigma of the live one, in degrees and in
mm. By design, live runs its full solves in worker processes, whose results come some events later than in replay. So
both are settled at the end; then epochs, verdict and rejected pairs have to be the same and the registrations within
0.05 sigma. A solve is compared as well, and for each the true error at the targets with the
predicted one. Every figure with a target is printed beside it.

``--quick`` leaves replay and solve out, and prints what a user sees (tools/live_figures.py): the time to the first ok,
each ok against the truth of the moment, each order to the stage against the true beam, stops of the stage. ``--load``
keeps processors busy beside it, with loops of a niceness of their own.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, os.fspath(Path(__file__).resolve().parent.parent))

import numpy as np

from fgreg.errors import EventRefused
from fgreg.geometry.transforms import FloatArray, log_so3
from fgreg.live.launch import EngineProcesses, NewestSnapshots, make_folder, running, setup_text
from fgreg.live.recorder import Recorded
from fgreg.live.room_truth import write_room_truth
from fgreg.live.simulated_room import simulated_room
from fgreg.model.estimate import EpochEstimate, TrackEstimate, Verdict
from fgreg.model.events import AimEvent, CameraMovedEvent, MarkerRecord, PairEvent, TrusRecord
from fgreg.model.measurements import Aim, Measurements, Pair, Track
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine import OnlineRegistration
from fgreg.online.estimate import OnlineEstimate
from fgreg.online.live_session import LiveSession
from fgreg.pipeline.replay import ReplayRequest, ReplayStep, replay_session
from fgreg.pipeline.solve import SolveRequest, solve_session
from fgreg.registration.posterior import pose_tangent
from fgreg.session.session_reader import read_session
from fgreg.session.yaml_loader import load_yaml
from fgreg.simulation.documents import session_document
from fgreg.simulation.room import Room, room_config
from fgreg.tracking.query import track
from live_figures import busy, conducted, rehearsed, totals
from tests.rehearsal import Rehearsal

SAME_SIGMA = 0.05
REFRESH_EVERY = 6
"""Frames of a room in simulated time between two checks for results of the worker processes."""
SETTLE_S = 3.0
"""Longest time of the worker processes after the last event."""


@dataclass
class Told:
    """Reports of a session: after each event that was taken in, and at the end, settled."""

    events: list[Recorded] = field(default_factory=list)
    estimates: list[OnlineEstimate | None] = field(default_factory=list)
    settled: OnlineEstimate | None = None
    measurements: Measurements | None = None

    def take(self, event: Recorded, estimate: OnlineEstimate | None, _beam: FloatArray | None) -> None:
        """Take in an event and its estimate; called on the recorder's thread."""
        if not isinstance(event, AimEvent | PairEvent | CameraMovedEvent):
            return
        self.events.append(event)
        self.estimates.append(estimate)


def conduct(folder: Path, seed: int, width_px: int, aims: int, bump_every_s: float, seconds: float) -> Told:
    """A session in a simulated room, in real time."""
    told = Told()
    with ExitStack() as stack:
        setup = simulated_room(stack, seed, aims, bump_every_s, width_px)
        with running(setup, folder, SolveConfig(), told.take) as session:
            until = time.monotonic() + seconds
            session.loop.run(lambda: time.monotonic() < until)
            session.recorder.close()
            settle(session.session, told)
            figures = session.loop.figures
    print(f"  {figures.frames} frames, marker in {figures.found}, {figures.pulses} pulses")
    return told


class Recording:
    """A live session in place of a rehearsal's engine."""

    def __init__(self, session: LiveSession, told: Told) -> None:
        self._session, self._told = session, told
        self._snapshots = NewestSnapshots(session)
        self._queries = 0

    @property
    def estimate(self) -> OnlineEstimate:
        """The last reported estimate."""
        self._queries += 1
        if self._queries % REFRESH_EVERY == 0:
            self._session.refresh()
        return self._session.estimate or self._session.engine.refresh()

    def track(self, query: Track) -> TrackEstimate:
        """As the live loop does it."""
        return track(query, self._snapshots.read().snapshot)

    def add(self, event: Aim | Pair) -> None:
        """As the live loop records it."""
        marker = MarkerRecord(event.marker.camera_T_marker, event.marker.covariance)
        recorded: AimEvent | PairEvent
        if isinstance(event, Aim):
            recorded = AimEvent(event.t, 0, marker, event.camera_p_spot_mm, event.covariance)
        else:
            look, stage = event.look, self._session.journal.model.stage
            device = math.degrees(stage.device_from_scan(look.scan_rad))
            trus = TrusRecord(
                device,
                look.x_mm,
                look.range_mm,
                covariance=look.covariance,
                amplitude=look.amplitude,
                sweep=stage.direction * look.sweep,
            )
            recorded = PairEvent(event.t, 0, event.pm, marker, trus)
        with suppress(EventRefused):
            self._told.take(recorded, self._session.add(recorded), None)


def rehearse(folder: Path, seed: int, aims: int, bump_every_s: float, seconds: float) -> Told:
    """A session in a simulated room, in simulated time."""
    told = Told()
    room = Room(room_config(seed, aims=aims, bump_every_s=bump_every_s))
    rehearsal = Rehearsal(room)
    make_folder(folder, setup_text(session_document(room.config.scene)))
    with ExitStack() as stack:
        make_engine = EngineProcesses()
        stack.callback(make_engine.close)
        session = stack.enter_context(LiveSession.open(folder, SolveConfig(), make_engine, late=True))
        rehearsal.engine = Recording(session, told)  # type: ignore[assignment]
        rehearsal.run(seconds)
        settle(session, told)
    write_room_truth(room.truth_at, folder, 0.0, -1.0)
    return told


def settle(session: LiveSession, told: Told) -> None:
    """The end of a session."""
    until = time.monotonic() + SETTLE_S
    while time.monotonic() < until:
        session.refresh()
        time.sleep(0.2)
    if session.estimate is not None:
        told.settled = session.settle()
        told.measurements = session.measurements()


def apart(a: OnlineEstimate | None, b: OnlineEstimate | EpochEstimate | None) -> tuple[float, float, float] | None:
    """How far b's registration is from a's: in a's sigma, degrees, mm; None where there is none."""
    if a is None or b is None or a.trus_T_camera is None or a.covariance is None or b.trus_T_camera is None:
        return None
    tangent = pose_tangent(a.trus_T_camera, b.trus_T_camera)
    sigma = float(np.sqrt(tangent @ np.linalg.solve(a.covariance, tangent)))
    turn = float(np.degrees(np.linalg.norm(log_so3(a.trus_T_camera[:3, :3].T @ b.trus_T_camera[:3, :3]))))
    return sigma, turn, float(np.linalg.norm(a.trus_T_camera[:3, 3] - b.trus_T_camera[:3, 3]))


class Stood:
    """True poses of the camera, by the session's ground truth."""

    def __init__(self, folder: Path) -> None:
        raw = load_yaml(folder / "ground_truth.yaml", "ground_truth.yaml")
        self.moved_s = [float(str(t)) for t in raw["x_moved_s"]]  # type: ignore[attr-defined]
        self.poses = np.array(raw["x_stood"], dtype=np.float64)
        self.targets_mm = read_session(folder).model.targets_mm

    def errors_mm(self, trus_T_camera: FloatArray, t: float) -> FloatArray:
        """(n,) errors at the targets of a registration reported at a time."""
        true = self.poses[sum(moved <= t for moved in self.moved_s)]
        off = trus_T_camera @ np.linalg.inv(true)
        return np.asarray(np.linalg.norm(self.targets_mm @ off[:3, :3].T + off[:3, 3] - self.targets_mm, axis=1))

    def claim(self, known: OnlineEstimate | EpochEstimate | None, t: float) -> str:
        """Error and prediction at the worst target; WRONG where the verdict is ok and the error is too large."""
        if known is None or known.trus_T_camera is None or known.predicted_tre is None:
            return ""
        error, predicted = float(self.errors_mm(known.trus_T_camera, t).max()), known.predicted_tre.worst_mm
        wrong = "  WRONG" if known.verdict is Verdict.OK and error > 2.0 * predicted else ""
        return f"{error:7.2f} {predicted:7.2f}{wrong}"


def text(estimate: OnlineEstimate | None) -> str:
    """Verdict, epoch, pairs."""
    return "-" if estimate is None else f"{estimate.verdict.value} {estimate.epoch} {estimate.pairs}"


def compare(folder: Path, told: Told | None, *, every: bool) -> bool:
    """Replay, solve and truth of one session; whether they agree where they have to."""
    steps: list[ReplayStep] = []
    engines: list[OnlineRegistration] = []

    def make_engine(*arguments: object) -> OnlineRegistration:
        model, config = arguments
        engines.append(OnlineRegistration(model, config))  # type: ignore[arg-type]
        return engines[-1]

    request = ReplayRequest(folder, folder / "replay.yaml")
    replayed = replay_session(request, on_step=steps.append, make_engine=make_engine)
    solved = solve_session(SolveRequest(folder, folder / "moves.yaml"))
    met = True
    if told is not None:
        # Moves that live detected are events of the recording, not of its input.
        found = [s for s in steps if not s.refused and not (isinstance(s.event, CameraMovedEvent) and s.event.detected)]
        print(f"  events taken in: live {len(told.events)}, replay {len(found)}    target the same")
        met = len(told.events) == len(found)
        if every:
            print(f"  {'t, s':>7}  {'event':<6} {'live':<16} {'replay':<16}   sigma     deg      mm     off, predicted")
        worst: list[float] = []
        wrong = 0
        stood = Stood(folder)
        for event, estimate, step in zip(told.events, told.estimates, found, strict=False):
            gap = apart(estimate, step.estimate)
            same_epoch = estimate is not None and step.estimate is not None and estimate.epoch == step.estimate.epoch
            claim = stood.claim(estimate, step.event.t)
            wrong += "WRONG" in claim
            if gap is not None and same_epoch:
                worst.append(gap[0])
            if every:
                kind = {AimEvent: "aim", PairEvent: "pair", CameraMovedEvent: "moved"}[type(event)]
                gaps = 24 * " " if gap is None else f"{gap[0]:8.3f} {gap[1]:7.3f} {gap[2]:7.3f}"
                print(f"  {step.event.t:7.1f}  {kind:<6} {text(estimate):<16} {text(step.estimate):<16} {gaps} {claim}")
        if worst:
            p50, p90 = np.quantile(worst, (0.5, 0.9))
            print(f"  apart as reported, sigma: median {p50:.3f}, 90 % {p90:.3f}, most {max(worst):.3f} ({len(worst)})")
        print(f"  reported ok where the worst target was off by more than twice the prediction: {wrong}    target 0")
        met &= settled_same(told, replayed.settled, engines[-1])
    report_truth(folder, told, replayed.settled, solved.estimate.epochs)
    return met


def settled_same(told: Told, replayed: OnlineEstimate | None, engine: OnlineRegistration) -> bool:
    """Print the comparison of the two ends; whether they agree."""
    live = told.settled
    if live is None or replayed is None or told.measurements is None:
        print(f"  settled: live {text(live)}, replay {text(replayed)}    target the same")
        return live is None and replayed is None
    epochs = [[pair.epoch for pair in m.pairs] for m in (told.measurements, engine.measurements())]
    gap = apart(live, replayed)
    print(f"  settled: live {text(live)}, replay {text(replayed)}    target the same")
    print(f"  epochs of pairs the same: {epochs[0] == epochs[1]}    target True")
    print(f"  reasons the same: {live.reasons == replayed.reasons}")
    if live.reasons != replayed.reasons:
        print(f"    live   {live.reasons}\n    replay {replayed.reasons}")
    sigma = float("nan") if gap is None else gap[0]
    print(f"  settled apart {sigma:.4f} sigma    target {SAME_SIGMA}")
    same = (live.verdict, live.epoch, live.pairs) == (replayed.verdict, replayed.epoch, replayed.pairs)
    return same and epochs[0] == epochs[1] and (gap is None) == (live.trus_T_camera is None) and not sigma > SAME_SIGMA


def report_truth(
    folder: Path, told: Told | None, replayed: OnlineEstimate | None, epochs: tuple[EpochEstimate, ...]
) -> None:
    """Errors of the current epoch at its last pair, beside the predicted ones; true moves beside the detected ones."""
    stood, events = Stood(folder), read_session(folder).events
    last = max((event.t for event in events if isinstance(event, PairEvent)), default=0.0)
    began = [round(e.t if e.since_t is None else e.since_t, 1) for e in events if isinstance(e, CameraMovedEvent)]
    print(f"  true moves at {stood.moved_s} s, the last pair at {last:.1f} s; epochs begin at {began} s")
    ends: list[tuple[str, OnlineEstimate | EpochEstimate | None]] = []
    if told is not None:
        ends += [("live, as reported last", told.estimates[-1] if told.estimates else None), ("live", told.settled)]
    ends += [("replay", replayed), ("solve", epochs[-1])]
    for name, known in ends:
        claim = stood.claim(known, last)
        if known is None or not claim:
            print(f"  {name:<22} no registration")
        else:
            print(
                f"  {name:<22} {known.verdict.value:<8} {known.pairs:3d} pairs, worst target off, predicted: {claim} mm"
            )


def main() -> int:
    """Print each room; 1 where a target of the comparison is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--seconds", type=float, default=200.0)
    parser.add_argument("--made-up", action="store_true", help="in simulated time, without pictures")
    parser.add_argument("--width", type=int, default=640, help="of the camera's images, px")
    parser.add_argument("--aims", type=int, default=6)
    parser.add_argument("--bump-every", type=float, default=90.0, help="mean time between camera moves, s")
    parser.add_argument("--tags", type=int, default=3, choices=range(4), help="--quick: static tags beside the tissue")
    parser.add_argument("--out", type=Path, default=Path("study-live"), help="folder of the sessions")
    parser.add_argument("--recorded", type=Path, nargs="+", help="sessions to compare instead")
    parser.add_argument("--every", action="store_true", help="print every event")
    parser.add_argument("--quick", action="store_true", help="only what a user sees, without replay and solve")
    parser.add_argument("--first-ok", action="store_true", help="with --quick: a room ends at its first ok")
    parser.add_argument("--reported", action="store_true", help="with --quick --made-up: each bump is reported")
    parser.add_argument("--load", type=float, default=0.0, help="processors kept busy beside it")
    parser.add_argument("--load-nice", type=int, default=0, help="niceness of that load; below 0 needs root")
    options = parser.parse_args()
    with busy(options.load, options.load_nice):
        return quick(options) if options.quick else thorough(options)


def quick(options: argparse.Namespace) -> int:
    """Figures of each room and of all."""
    rooms = []
    for seed in options.seeds:
        before = os.getloadavg()[0]
        if options.made_up:
            room = rehearsed(
                seed,
                options.aims,
                options.bump_every,
                options.seconds,
                options.tags,
                first=options.first_ok,
                reports=options.reported,
            )
        else:
            folder = options.out / f"seed-{seed}"
            room = conducted(
                folder,
                seed,
                options.width,
                options.aims,
                options.bump_every,
                options.seconds,
                options.tags,
                first=options.first_ok,
            )
        rooms.append(room)
        print(f"{room.line()}; load average {before:.1f} to {os.getloadavg()[0]:.1f}", flush=True)
    print(totals(rooms))
    return 0


def thorough(options: argparse.Namespace) -> int:
    """Replay, solve and truth of each room; 1 where a target is missed."""
    met = True
    for folder in options.recorded or ():
        print(folder)
        met &= compare(folder, None, every=False)
    for seed in () if options.recorded else options.seeds:
        folder = options.out / f"seed-{seed}"
        print(f"seed {seed}", flush=True)
        if options.made_up:
            told = rehearse(folder, seed, options.aims, options.bump_every, options.seconds)
        else:
            told = conduct(folder, seed, options.width, options.aims, options.bump_every, options.seconds)
        met &= compare(folder, told, every=options.every)
        sys.stdout.flush()
    return 0 if met else 1


if __name__ == "__main__":
    raise SystemExit(main())
