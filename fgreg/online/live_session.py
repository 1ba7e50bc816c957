"""A live session: every event goes to disk first, then into the estimate. A session opened again goes on as it was."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from fgreg.camera_moves.found import DetectedLoopClosure, DetectedMove
from fgreg.detection.check_points import check_measurement, known_point
from fgreg.detection.events_to_measurements import MeasurementExtractor
from fgreg.errors import EventRefused, InputError, JournalError
from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import ExcludedShot, TrackEstimate
from fgreg.model.events import (
    EVIDENCE,
    AimEvent,
    CameraMovedEvent,
    CheckEvent,
    Event,
    HandChoice,
    NoteEvent,
    PairEvent,
    PointEvent,
    RefusedEvent,
    StageEvent,
    TrackEvent,
    refused_evidence,
    refused_lines,
)
from fgreg.model.excluded_shots import excluded_shots
from fgreg.model.measurements import Aim, Check, EpochStart, KnownPoint, Measurements, Pair, Track
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.checks import CheckPoints
from fgreg.online.engine import OnlineRegistration
from fgreg.online.engine_process import GONE, EngineGone, EngineProcess, OneRefused
from fgreg.online.estimate import OnlineEstimate, with_conditions
from fgreg.online.events import CameraMoved, LoopClosed, OnlineEvent
from fgreg.registration.checks import CHECKS_REFUSE
from fgreg.registration.verdict import by_hand, refused_shots
from fgreg.session.event_writer import event_document, type_of, writable
from fgreg.session.journal import Journal
from fgreg.tracking.snapshot import Snapshot

Estimating = AimEvent | PairEvent | PointEvent | CameraMovedEvent | CheckEvent | HandChoice
"""Events that the estimate or its verdict depends on."""


EARLIEST_S = 1e9
"""No clock gives a time before minus this."""
MOST_DEATHS = 3
"""An event is refused after an engine's process has ended this many times at it: the event may be the cause."""


class Engine(Protocol):
    """The part of :class:`fgreg.online.engine.OnlineRegistration` that a live session uses."""

    def add(self, event: OnlineEvent) -> OnlineEstimate: ...
    def track(self, query: Track) -> TrackEstimate: ...
    def settle(self) -> OnlineEstimate: ...
    def refresh(self) -> OnlineEstimate: ...
    def measurements(self) -> Measurements: ...
    def starts(self) -> tuple[EpochStart, ...]: ...
    def marker_T_laser(self) -> FloatArray | None: ...
    def restoring(self) -> AbstractContextManager[None]: ...
    def snapshot(self) -> Snapshot | None: ...
    @property
    def estimate(self) -> OnlineEstimate | None: ...
    @property
    def moves(self) -> tuple[DetectedMove, ...]: ...
    @property
    def loop_closures(self) -> tuple[DetectedLoopClosure, ...]: ...


MakeEngine = Callable[[SessionModel, SolveConfig], Engine]


class EpochFeed:
    """Hands measurements to an engine in the current epoch; the engine may detect camera moves, too.

    Args:
        checks: get the times at which epochs begin.

    Attributes:
        epoch: number of the current epoch.
        noticed: detected camera moves for which there is no ``camera_moved`` event yet.
    """

    def __init__(self, engine: Engine, checks: CheckPoints) -> None:
        self._engine, self._checks = engine, checks
        self.epoch = 0
        self.noticed = 0

    def add(self, event: Aim | Pair | KnownPoint | CameraMovedEvent) -> OnlineEstimate | None:
        """Take in one measurement or move; None for a move that the engine has detected already.

        Raises:
            EventRefused: the engine refused it; it is as it was.
        """
        if isinstance(event, CameraMovedEvent):
            if event.detected and self.noticed:
                self.noticed -= 1
                return None
            moved = CameraMoved(event.t, event.camera_new_T_camera_old, event.covariance, event.detected, event.since_t)
            estimate = self._engine.add(moved)
            self.epoch = estimate.epoch
            self._checks.moved(event.t if event.since_t is None else event.since_t, self.epoch)
            return estimate
        estimate = self._engine.add(event if isinstance(event, Aim) else replace(event, epoch=self.epoch))
        if isinstance(event, KnownPoint):
            self._checks.leave_out(event)
        self.notice(estimate)
        return estimate

    def notice(self, estimate: OnlineEstimate) -> None:
        """Count the epochs that the engine began because it detected a move."""
        began = max(0, estimate.epoch - self.epoch)
        self.noticed += began
        if began:
            for number, start in enumerate(self._engine.starts()[self.epoch + 1 :], self.epoch + 1):
                self._checks.moved(start.t, number)
        self.epoch = estimate.epoch


class LiveSession:
    """A session that is recorded and estimated at the same time. Use as a context manager, or close it.

    Attributes:
        journal: the recorded events.
        config: of the estimate.
        late: whether events may come after others that happened later; they then get the time of the last event.
        engine: the one that took in the recorded events; a revived session has another one.
    """

    engine: Engine

    def __init__(self, journal: Journal, make_engine: MakeEngine, config: SolveConfig) -> None:
        self.journal, self.config = journal, config
        self._estimate: OnlineEstimate | None = None  # without the checks
        self.late = False
        self._make_engine = make_engine
        self._untaken: list[Event] = []  # on disk, not in the estimate yet, because of an interruption
        self._unwritten: list[Event] = []  # to be recorded as soon as the disk allows
        self._gone = False  # the engine's process has ended: no event goes into the estimate before a revival
        self._ended_at: Event | None = None  # the event that it ended at
        self._deaths: dict[int, int] = {}  # ends of the engine's process while it took an event in, by its line
        self._together = True  # whether recorded events are taken in together: one by one, it is known which one fails
        self._begin_with(make_engine(journal.model, config))

    def _begin_with(self, engine: Engine) -> None:
        """Start with an engine that has taken in nothing yet."""
        self._checks = CheckPoints(self.journal.model, self.config.limit_mm, engine.snapshot)
        self._engine, self._feed = engine, EpochFeed(engine, self._checks)
        self._closures = 0  # loop closures that are recorded
        self._excluded: tuple[ExcludedShot, ...] = ()  # left out by hand
        self._refused: list[str] = []  # why recorded shots, checks and moves were refused
        self._shots = 0  # aims, pairs and known points in the estimate
        self._extractor = MeasurementExtractor(self.journal.model)

    @property
    def estimate(self) -> OnlineEstimate | None:
        """After the last event that was taken in, with the checks of its epoch; None before the first."""
        return self._with_all(self._estimate)

    @property
    def excluded(self) -> tuple[ExcludedShot, ...]:
        """The shots that are left out by hand."""
        return self._excluded

    def _with_all(self, estimate: OnlineEstimate | None) -> OnlineEstimate | None:
        """The engine's estimate with the checks, and with what was left out by hand."""
        checked = self._checks.applied(estimate)
        left_out = by_hand(self._excluded, self._shots) + refused_shots(self._refused)
        return None if checked is None else with_conditions(checked, left_out)

    @classmethod
    def open(
        cls,
        folder: str | Path,
        config: SolveConfig | None = None,
        make_engine: MakeEngine | None = None,
        *,
        late: bool = False,
    ) -> Self:
        """Open a session's folder (with its ``session.yaml``); recorded events are taken in again.

        Raises:
            InputError: the session's files, or frames that they name, are invalid.
            JournalError: another program records to it, or a write failed.
        """
        journal = Journal.open(Path(folder))
        try:
            found = cls(journal, make_engine or online_engine, config or SolveConfig())
            found.late = late
            found._take_up(journal.events)
        except BaseException:
            journal.close()
            raise
        return found

    def revive(self) -> OnlineEstimate | None:
        """Replace the engine (its process has ended, or shots were left out by hand) by a new one, from the journal.

        Nothing is lost, and the session stays open. An event at which that has happened :data:`MOST_DEATHS` times is
        recorded as refused.

        Raises:
            EngineGone: the new one has ended too; try again.
            FgregError: it did not start, or a write failed.
        """
        self._gone = True  # if something fails here, an engine that has taken in only some events is not used
        event, self._ended_at = self._ended_at, None
        if event is not None:
            self._deaths[event.line] = self._deaths.get(event.line, 0) + 1
            if self._deaths[event.line] >= MOST_DEATHS:
                self._refuse(event, event.line, f"the registration's process has ended {MOST_DEATHS} times at it")
        self._write_waiting(patient=False)
        self._begin_with(self._make_engine(self.journal.model, self.config))
        self._take_up(self.journal.events)
        self._untaken.clear()
        self._gone = False
        self._write_waiting()
        return self.estimate

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Unlock the session."""
        self.journal.close()

    def _take_up(self, events: Sequence[Event]) -> None:
        """Take in recorded events, with one estimate at the end."""
        waiting, before = list(self._unwritten), self._estimate
        try:
            self._restore(events)
        except OneRefused:
            self._together, self._unwritten, self._estimate = False, waiting, before
            self._begin_with(self._make_engine(self.journal.model, self.config))
            self._restore(events)
        except EngineGone:
            if self._together:
                self._ended_at = None  # any of them may be the cause
            self._together = False
            raise
        self._together = True
        if self._estimate is not None:
            self._estimate = self._engine.estimate
        self.engine = self._engine
        self._record_moves()
        self._write_waiting()

    def _restore(self, events: Sequence[Event]) -> None:
        """Have the engine take in recorded events."""
        refused, excluded = refused_lines(events), excluded_shots(events)
        self._excluded, self._refused = tuple(excluded.values()), list(refused_evidence(events))
        with self._restoring():
            for event in events:
                if event.line not in refused and event.line not in excluded:
                    with contextlib.suppress(EventRefused):  # the refusal is noted now: it was not recorded before
                        self._take(event)

    def _restoring(self) -> AbstractContextManager[None]:
        if self._together and isinstance(self._engine, EngineProcess):
            return self._engine.restoring_together()
        return self._engine.restoring()

    def add(self, event: Estimating) -> OnlineEstimate | None:
        """Record an event, take it in, and return the estimate.

        A shot in whose frames the marker or the PM is not found is recorded and changes nothing. An ``exclude`` or
        ``include`` event begins the estimate again from the journal.

        Raises:
            InputError: not an event that a session may hold; recorded as refused.
            EventRefused: it could not be taken into the estimate; recorded as refused, later ones work.
            JournalError: a write failed; neither recorded nor taken in. The estimate and :meth:`track` stay usable.
            EngineGone: it is recorded, and will be taken in by :meth:`revive`, or when the session is opened again.
        """
        gone = self._catch_up_or_gone()
        try:
            kept = self.journal.append(event, late=self.late).event
        except InputError as error:
            self._refuse(event, None, str(error))
            self._write_waiting()
            raise
        self._untaken.append(kept)
        if gone is not None:
            raise gone
        if isinstance(kept, HandChoice):
            return self.revive()
        try:
            self._take_in()
        finally:
            self._write_waiting()
        return self.estimate

    def track(self, query: TrackEvent, *, record: bool = True) -> TrackEstimate:
        """Answer where to turn the stage.

        ``record``: whether the query is recorded first; False for queries at camera rate, for example.

        Raises:
            InputError: not a query that a session may hold.
            JournalError: a write failed.
            EngineGone: :meth:`revive` is due.
        """
        if record:
            self._catch_up()
            kept = self.journal.append(query).event
            if isinstance(kept, TrackEvent):
                query = kept
        if self._checks.refuse(self._estimate):
            return TrackEstimate(query.t, None, None, None, causal=True, reason=CHECKS_REFUSE)
        found = self._extractor.add(query, self._feed.epoch)
        if isinstance(found, Track):
            return replace(self._engine.track(found), causal=True)
        return TrackEstimate(query.t, None, None, None, causal=True, reason=str(found))

    def record(self, event: NoteEvent | StageEvent | TrackEvent) -> None:
        """Record an event that the estimate does not depend on; a query is not answered.

        Raises:
            InputError: not an event that a session may hold.
            JournalError: a write failed.
            EngineGone: it is recorded, and :meth:`revive` is due.
        """
        gone = self._catch_up_or_gone()
        self.journal.append(event, late=self.late)
        if gone is not None:
            raise gone

    def refresh(self) -> OnlineEstimate | None:
        """Take over the engine's results, without an event; a detected camera move is recorded."""
        self._catch_up()
        before = self._feed.epoch
        try:
            estimate = self._engine.refresh()
        except EngineGone:
            self._gone = True
            raise
        if self._estimate is not None or estimate.epoch > before:
            self._estimate = estimate
        self._feed.notice(estimate)
        self._record_moves()
        self._write_waiting()
        return self.estimate

    def settle(self) -> OnlineEstimate:
        """Run the full solve of everything now."""
        self._estimate = settled = self._engine.settle()
        return self._with_all(settled) or settled

    def measurements(self) -> Measurements:
        """All measurements that were taken in."""
        return self._engine.measurements()

    def marker_T_laser(self) -> FloatArray | None:
        """The estimated beam, (4, 4); None where there is none yet."""
        return self._engine.marker_T_laser()

    def _catch_up_or_gone(self) -> EngineGone | None:
        """As :meth:`_catch_up`; returns EngineGone instead of raising it, since events are recorded all the same."""
        try:
            self._catch_up()
        except EngineGone as gone:
            return gone
        return None

    def _catch_up(self) -> None:
        """Finish what an interrupt or a full disk left undone, before the next event.

        Raises:
            JournalError: writes still fail.
            EngineGone: :meth:`revive` is due.
        """
        if self._gone:
            raise EngineGone(GONE)
        while self._untaken:
            with contextlib.suppress(EventRefused):
                self._take_in()
        self._write_waiting(patient=False)

    def _take_in(self) -> None:
        """Take in the oldest event that is on disk but not in the estimate; raises as :meth:`_take`."""
        event = self._untaken[0]
        try:
            self._take(event)
        except EventRefused:
            self._untaken.remove(event)
            raise
        except EngineGone:
            self._together = False
            raise
        self._untaken.remove(event)
        self._record_moves()

    def _take(self, event: Event) -> None:
        """Take a recorded event into the estimate.

        Raises:
            EventRefused: the engine refused it; the refusal is noted for the record.
        """
        estimate: OnlineEstimate | None = None
        try:
            if isinstance(event, AimEvent | PairEvent):
                found = self._extractor.add(event, self._feed.epoch)
                if isinstance(found, Aim | Pair):
                    try:
                        estimate = self._feed.add(found)
                        self._shots += 1
                    except BaseException:  # nor may its frames count: the session opened again would lack them
                        self._extractor.take_back()
                        raise
            elif isinstance(event, CameraMovedEvent):
                estimate = self._feed.add(event)
            elif isinstance(event, PointEvent):
                point = known_point(event, self._feed.epoch, self.journal.model)
                if isinstance(point, KnownPoint):
                    estimate = self._feed.add(point)
                    self._shots += 1
            elif isinstance(event, CheckEvent):
                check = check_measurement(event, self._feed.epoch, self.journal.model)
                if isinstance(check, Check):
                    self._checks.add(check)
            elif isinstance(event, NoteEvent) and (closed := LoopClosed.of_note(event.t, event.text)) is not None:
                with contextlib.suppress(EventRefused):  # a note that only looks like one
                    self._engine.add(closed)
                    self._closures += 1
        except (EventRefused, InputError) as error:
            reason = error.reason if isinstance(error, EventRefused) else str(error)
            self._refuse(event, event.line, reason)
            raise EventRefused(reason) from error
        except EngineGone:
            self._gone, self._ended_at = True, event
            raise
        if estimate is not None:
            self._estimate = estimate

    def _record_moves(self) -> None:
        """Moves that the engine found out by itself become events: the epochs are then the same for every reader.

        Its loop closures become notes, which it takes in when the session is opened again.
        """
        count, self._feed.noticed = self._feed.noticed, 0
        closures, before = self._engine.loop_closures, self._closures
        t = self.journal.last_t
        if t is None:
            return
        self._closures = len(closures)
        self._unwritten.extend(NoteEvent(t, 0, closure.text) for closure in closures[before:])
        for start in self._engine.starts()[-count:] if count else ():
            moved = CameraMovedEvent(
                t, 0, start.camera_new_T_camera_old, start.covariance, detected=True, since_t=min(t, start.t)
            )
            self._unwritten.append(moved)

    def _refuse(self, event: Event, line: int | None, reason: str) -> None:
        """Note a refusal, with the event's line if it is on disk, else with the event itself as far as possible."""
        if line is not None and isinstance(event, EVIDENCE):
            self._refused.append(reason)
        t = self.journal.last_t
        if t is None:  # the time of a refused event may be any number
            t = min(0.0, event.t) if math.isfinite(event.t) and event.t > -EARLIEST_S else 0.0
        document: object = {"type": type_of(event), "t": event.t, "line": line}
        if line is None:
            try:
                document = event_document(event, self.journal.folder)
            except InputError:  # a frame outside the session's folder has no name in it
                document = {"type": type_of(event), "t": event.t}
        self._unwritten.append(RefusedEvent(t, 0, writable(document), reason))

    def _write_waiting(self, *, patient: bool = True) -> None:
        """Record the waiting events; ``patient``: where a write fails they go on waiting, else it raises."""
        while self._unwritten:
            event = self._unwritten[0]
            try:
                self.journal.append(event, late=self.late)
            except JournalError:
                if patient:
                    return
                raise
            except InputError:
                if not isinstance(event, RefusedEvent) or isinstance(event.event, str):
                    raise
                # The line is too long: only its beginning is recorded.
                self._unwritten[0] = replace(event, event=repr(event.event)[:1000])
                continue
            self._unwritten.pop(0)


def online_engine(
    model: SessionModel,
    config: SolveConfig,
    *,
    find_moves: bool = True,
) -> Engine:
    """The engine with its full solve in the same process: the same events always give the same estimates."""
    return OnlineRegistration(model, config, find_moves=find_moves)
