"""Replays a recorded session through the online engine, event by event: the steps of ``fgreg replay``.

read the session -> detect in its frames -> add each event to the engine in order, and answer tracking queries from the
estimate at their time -> full solve -> write the result with timings (and the recording).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fgreg.camera_moves.recorded_tags import with_tag_moves
from fgreg.detection.events_to_measurements import ExtractedMeasurements, extract_measurements
from fgreg.errors import EventRefused, InputError
from fgreg.model.estimate import ExcludedShot, Quantiles, Timing, TrackEstimate, Verdict
from fgreg.model.events import (
    AimEvent,
    CameraMovedEvent,
    CheckEvent,
    ExcludeEvent,
    HandChoice,
    IncludeEvent,
    PairEvent,
    PointEvent,
    TrackEvent,
    refused_lines,
)
from fgreg.model.excluded_shots import excluded_shots
from fgreg.model.measurements import Aim, Check, KnownPoint, LocatedPoint, Pair, Track
from fgreg.model.solve_config import SolveConfig
from fgreg.online.checks import CheckPoints
from fgreg.online.estimate import OnlineEstimate, with_conditions
from fgreg.online.live_session import EpochFeed, MakeEngine, online_engine
from fgreg.pipeline.solve import (
    Progress,
    SolveReport,
    errors_where_known,
    result_place,
    settings_used,
    show_frames,
    solve_extracted,
)
from fgreg.registration.checks import CHECKS_REFUSE
from fgreg.registration.verdict import Condition, by_hand, refused_shots
from fgreg.schema.limits import REPLAYED_PAIRS
from fgreg.session.input_hashes import read_with_hashes
from fgreg.session.result_file import write_result
from fgreg.session.session_reader import EVENTS_FILE, Session, read_ground_truth
from fgreg.version import __version__
from fgreg.viewer.null_viewer import NullViewer, open_viewer
from fgreg.viewer.spawn import spawn_viewer

if TYPE_CHECKING:
    from fgreg.viewer.recording import Viewer

Shown = AimEvent | PairEvent | TrackEvent | PointEvent | CameraMovedEvent | CheckEvent | HandChoice


@dataclass(frozen=True, slots=True)
class ReplayRequest:
    """Options of a replay.

    Attributes:
        folder: the session. out: result file; None: ``result.yaml`` in the session's folder.
        rrd: the recording to write, if any. live: show the replay in a new viewer.
        speed: session seconds per second; None: as fast as possible.
        redetect: detect in frames even where poses are recorded.
    """

    folder: Path
    out: Path | None = None
    rrd: Path | None = None
    live: bool = False
    speed: float | None = None
    redetect: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class ReplayStep:
    """One replayed event.

    Attributes:
        event: as recorded. done, total: its number among the replayed events, from 1, and their count.
        estimate: after it; None before the first one. answer: result of a track.
        refused: why it was not added; empty where it was.
        elapsed_ms: the engine's time for it; None where the engine did not receive it.
        noticed: whether the engine detected an unreported camera move here.
    """

    event: Shown
    done: int
    total: int
    estimate: OnlineEstimate | None
    answer: TrackEstimate | None
    refused: str
    elapsed_ms: float | None
    noticed: bool = False


OnStep = Callable[[ReplayStep], None]


@dataclass(frozen=True, slots=True, eq=False)
class ReplayReport:
    """Result of a replay: the report of the full solve, and the engine's last estimate."""

    solved: SolveReport
    settled: OnlineEstimate | None


def replay_session(
    request: ReplayRequest,
    config: SolveConfig | None = None,
    progress: Progress | None = None,
    on_step: OnStep | None = None,
    make_engine: MakeEngine | None = None,
) -> ReplayReport:
    """Replay a recorded session.

    Args:
        request: its options.
        config: of the estimate.
        progress: called after each frame.
        on_step: called after each event.
        make_engine: makes the online engine; None: the package's.

    Raises:
        InputError: bad input; an older result stays.
        ViewerError: the viewer cannot be started.
    """
    start = time.perf_counter()
    config = config or SolveConfig()
    if request.speed is not None and not 0 < request.speed < float("inf"):
        raise InputError("--speed", str(request.speed), "1, 10 or another number > 0, or max")
    result_path = result_place(request.folder, request.out, request.rrd)
    session, inputs = read_with_hashes(request.folder)
    session = with_tag_moves(session)
    if (pairs := sum(isinstance(event, PairEvent) for event in session.events)) > REPLAYED_PAIRS:
        raise InputError(
            EVENTS_FILE, f"{pairs} pairs", f"at most {REPLAYED_PAIRS} for a replay; fgreg solve takes more"
        )
    truth = read_ground_truth(request.folder)
    url = spawn_viewer() if request.live else None
    with open_viewer(request.rrd, session.model.name, url, inputs) as viewer:
        viewer.session(session.model, config.limit_mm)
        extracted = extract_measurements(
            session.events,
            session.model,
            redetect=request.redetect,
            progress=None if progress is None else lambda done, total: progress("looking at frames", done, total),
        )
        # Moves that were detected during recording are events: they are used as recorded, without a new search.
        recorded = any(isinstance(event, CameraMovedEvent) and event.detected for event in session.events)
        make_engine = make_engine or partial(online_engine, find_moves=not recorded)
        player = _Player(session, extracted, make_engine, viewer, request.speed, config)
        player.play(on_step)
        taken, found, solution, estimate = solve_extracted(session, player.taken(), config)
        settled = player.settle()
        used = settings_used(config, detect_moves=True, redetect=request.redetect)
        estimate = replace(
            estimate,
            inputs=inputs,
            settings=used,
            timing=player.timing(),
            tracks=player.answers(estimate.tracks),
        )
        errors = errors_where_known(estimate, truth, found.moves, session.model.targets_mm)
        viewer.result(session.model, taken.measurements, estimate, truth, extracted.tracks)
        write_result(estimate, session.model, result_path, __version__)
    elapsed = time.perf_counter() - start
    solved = SolveReport(session, taken, solution, estimate, truth, errors, result_path, request.rrd, elapsed)
    return ReplayReport(solved, settled)


class _Player:
    """Adds a session's events to an engine in order."""

    def __init__(
        self,
        session: Session,
        extracted: ExtractedMeasurements,
        make_engine: MakeEngine,
        viewer: Viewer | NullViewer,
        speed: float | None,
        config: SolveConfig,
    ) -> None:
        self._session, self._extracted = session, extracted
        self._make_engine, self._config = make_engine, config
        self._viewer, self._speed = viewer, speed
        self._measured: dict[int, Aim | Pair | KnownPoint | Track | Check] = {
            **extracted.checks,
            **extracted.set_aside,
            **dict(zip(extracted.aim_events, extracted.measurements.aims, strict=True)),
            **dict(zip(extracted.pair_events, extracted.measurements.pairs, strict=True)),
            **dict(zip(extracted.track_events, extracted.tracks, strict=True)),
            **dict(zip(extracted.point_events, extracted.measurements.points, strict=True)),
        }
        self._add_ms: list[float] = []
        self._track_ms: list[float] = []
        self._answers: dict[int, TrackEstimate] = {}
        self._excluded: dict[int, ExcludedShot] = {}  # by line, as the events up to now have it
        self._begin()

    def _begin(self) -> None:
        """Start with an engine that has taken in nothing yet."""
        self._engine = self._make_engine(self._session.model, self._config)
        self._checks = CheckPoints(self._session.model, self._config.limit_mm, self._engine.snapshot)
        self._feed = EpochFeed(self._engine, self._checks)
        self._unused = {i: why for i, why in self._extracted.unused.items() if i not in self._extracted.set_aside}
        self._estimate: OnlineEstimate | None = None  # without the checks
        self._shots = 0

    @property
    def estimate(self) -> OnlineEstimate | None:
        """After the last event, with the checks of its epoch and what is left out by hand; None before the first."""
        checked = self._checks.applied(self._estimate)
        return None if checked is None else with_conditions(checked, self._left_out())

    def _left_out(self) -> list[Condition]:
        return by_hand(tuple(self._excluded.values()), self._shots) + refused_shots(self._extracted.refused)

    def settle(self) -> OnlineEstimate | None:
        """The engine's estimate after a full solve; None where it has taken in nothing."""
        return None if self._estimate is None else self._engine.settle()

    def _choose(self, index: int) -> None:
        """Begin again with the shots that count from here on, as a recorder does."""
        events = self._session.events
        excluded = excluded_shots(events[: index + 1])
        if excluded.keys() == self._excluded.keys():
            return
        self._excluded = excluded
        self._begin()
        refused = refused_lines(events)
        for earlier, event in enumerate(events[:index]):
            counts = event.line not in refused and event.line not in excluded
            if counts and isinstance(event, AimEvent | PairEvent | PointEvent | CameraMovedEvent | CheckEvent):
                self._take(earlier, event)

    def play(self, on_step: OnStep | None) -> None:
        """Replay all events, each at its time where there is a speed."""
        refused = refused_lines(self._session.events)
        shown = [
            (index, event)
            for index, event in enumerate(self._session.events)
            if isinstance(event, Shown) and event.line not in refused
        ]
        began, shot = time.monotonic(), 0
        for done, (index, event) in enumerate(shown, 1):
            if self._speed is not None:
                wait = began + (event.t - shown[0][1].t) / self._speed - time.monotonic()
                time.sleep(max(0.0, wait))
            if isinstance(event, HandChoice) and not any(isinstance(e, HandChoice) for _, e in shown[done : done + 1]):
                self._choose(index)  # the last one of several
            step = replace(self._take(index, event), done=done, total=len(shown))
            if isinstance(event, AimEvent | PairEvent | TrackEvent):
                show_frames(self._viewer, self._session, self._extracted, index, event, shot)
            self._show(index, event, shot, step)
            shot += isinstance(event, AimEvent | PairEvent | TrackEvent)
            if on_step is not None:
                on_step(step)

    def _take(self, index: int, event: Shown) -> ReplayStep:
        measured = self._measured.get(index)
        refused, elapsed_ms, answer, noticed = self._unused.get(index, ""), None, None, False
        start = time.perf_counter()
        if isinstance(measured, Track):
            if self._checks.refuse(self._estimate):
                answer = TrackEstimate(event.t, None, None, None, causal=True, reason=CHECKS_REFUSE)
            else:
                answer = replace(self._engine.track(replace(measured, epoch=self._feed.epoch)), causal=True)
            elapsed_ms = 1e3 * (time.perf_counter() - start)
            self._track_ms.append(elapsed_ms)
            self._answers[index] = answer
        elif isinstance(measured, Check):
            self._checks.add(replace(measured, epoch=self._feed.epoch))
        elif measured is not None or isinstance(event, CameraMovedEvent):
            before = self._feed.noticed
            try:
                estimate = self._feed.add(event if isinstance(event, CameraMovedEvent) else _shot(measured))
                elapsed_ms = 1e3 * (time.perf_counter() - start)
                self._add_ms.append(elapsed_ms)
                self._estimate = estimate or self._estimate
                noticed = self._feed.noticed > before
                self._shots += isinstance(event, AimEvent | PairEvent | PointEvent)
            except EventRefused as error:
                refused = self._unused[index] = error.reason
        return ReplayStep(event, 0, 0, self.estimate, answer, refused, elapsed_ms, noticed)

    def _show(self, index: int, event: Shown, shot: int, step: ReplayStep) -> None:
        if isinstance(self._viewer, NullViewer):
            return
        from fgreg.viewer.live import ViewerUpdate  # loads Rerun

        known, measured = self.estimate, self._measured.get(index)
        self._viewer.update(
            ViewerUpdate(
                t=event.t,
                number=shot,
                shot=None if step.refused or isinstance(measured, LocatedPoint) else measured,
                note=describe(step),
                trus_T_camera=None if known is None else known.trus_T_camera,
                covariance=None if known is None else known.covariance,
                marker_T_laser=self._engine.marker_T_laser(),
                tre=None if known is None else known.predicted_tre,
                verdict=Verdict.REFUSED if known is None else known.verdict,
                reasons=() if known is None else known.reasons,
                pairs=0 if known is None else known.pairs,
                nis=known.nis if known is not None and isinstance(event, PairEvent) else None,
                used=known is not None and known.used,
                answer=step.answer,
            )
        )

    def taken(self) -> ExtractedMeasurements:
        """The session's measurements without the events that the engine refused, and without its queries."""
        extracted, measurements = self._extracted, self._extracted.measurements
        unused = {**self._unused, **{i: extracted.unused[i] for i in extracted.set_aside}}
        aims = [i for i, event in enumerate(extracted.aim_events) if event not in self._unused]
        pairs = [i for i, event in enumerate(extracted.pair_events) if event not in self._unused]
        points = [i for i, event in enumerate(extracted.point_events) if event not in self._unused]
        return replace(
            extracted,
            measurements=replace(
                measurements,
                aims=tuple(measurements.aims[i] for i in aims),
                pairs=tuple(measurements.pairs[i] for i in pairs),
                points=tuple(measurements.points[i] for i in points),
            ),
            aim_events=tuple(extracted.aim_events[i] for i in aims),
            pair_events=tuple(extracted.pair_events[i] for i in pairs),
            point_events=tuple(extracted.point_events[i] for i in points),
            tracks=(),
            track_events=(),
            unused=unused,
        )

    def answers(self, unanswered: Sequence[TrackEstimate]) -> tuple[TrackEstimate, ...]:
        """One result per track event, in order; ``unanswered`` has those that the engine did not receive."""
        places = [i for i, event in enumerate(self._session.events) if isinstance(event, TrackEvent)]
        return tuple(
            self._answers.get(place, replace(none, causal=True)) for place, none in zip(places, unanswered, strict=True)
        )

    def timing(self) -> Timing:
        return Timing(quantiles(self._add_ms), quantiles(self._track_ms))


def _shot(measured: Aim | Pair | KnownPoint | Track | Check | None) -> Aim | Pair | KnownPoint:
    if not isinstance(measured, Aim | Pair | KnownPoint):
        raise AssertionError("neither an aim nor a pair nor a known point")
    return measured


def quantiles(elapsed_ms: Sequence[float]) -> Quantiles | None:
    """Median, 99 % quantile and maximum; None where there are no values."""
    if not elapsed_ms:
        return None
    p50, p99 = (float(value) for value in np.quantile(elapsed_ms, (0.5, 0.99)))
    return Quantiles(p50, p99, max(elapsed_ms))


def left_out(known: OnlineEstimate | None) -> bool:
    """Whether the pair just added is an outlier; False before there is a registration."""
    return known is not None and known.trus_T_camera is not None and not known.used


def describe(step: ReplayStep) -> str:
    """A short description of a step, for the log."""
    event = step.event
    match event:
        case AimEvent():
            what = "aim"
        case PairEvent():
            what = f"pair, PM {event.pm}"
        case TrackEvent():
            what = "track"
        case CameraMovedEvent():
            what = "camera moved" + (" (found out)" if event.detected else "")
        case CheckEvent():
            what = "check"
        case PointEvent():
            what = "known point"
        case ExcludeEvent() | IncludeEvent():
            shot = f"PM {event.pm}" if event.pm is not None else f"line {event.shot_line}"
            what = f"{shot} " + ("left out by hand" if isinstance(event, ExcludeEvent) else "counts again")
    if step.refused:
        what += f", not used: {step.refused}"
    elif isinstance(event, PairEvent) and left_out(step.estimate):
        what += ", not used"
    if step.answer is not None and step.answer.stage_rad is None:
        what += f", no answer: {step.answer.reason}"
    return what
