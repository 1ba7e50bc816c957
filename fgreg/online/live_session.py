"""A session while it runs: every event on disk first, then into the estimate; opened again, it goes on as it was."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from fgreg.detection.events_to_measurements import EventRecogniser
from fgreg.errors import EventRefused, InputError, JournalError
from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import TrackEstimate
from fgreg.model.events import (
    AimEvent,
    CameraMovedEvent,
    Event,
    NoteEvent,
    PairEvent,
    RefusedEvent,
    StageEvent,
    TrackEvent,
    refused_lines,
)
from fgreg.model.measurements import Aim, EpochStart, Measurements, Pair, Track
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine import OnlineRegistration
from fgreg.online.engine_process import GONE, EngineGone
from fgreg.online.estimate import OnlineEstimate
from fgreg.online.events import CameraMoved, DetectedLoopClosure, DetectedMove, OnlineEvent
from fgreg.registration.register import SoundSpeedPrior
from fgreg.session.event_writer import event_document, type_of, writable
from fgreg.session.journal import Journal

Estimating = AimEvent | PairEvent | CameraMovedEvent
"""Events that the estimate depends on."""


EARLIEST_S = 1e9
"""Times before minus this are nobody's clock."""
MOST_DEATHS = 3
"""An event at which an engine's process has ended so many times is refused: it may be the reason."""


class Engine(Protocol):
    """What :class:`fgreg.online.engine.OnlineRegistration` offers, as far as it is needed here."""

    def add(self, event: OnlineEvent) -> OnlineEstimate: ...
    def track(self, query: Track) -> TrackEstimate: ...
    def settle(self) -> OnlineEstimate: ...
    def refresh(self) -> OnlineEstimate: ...
    def measurements(self) -> Measurements: ...
    def marker_T_laser(self) -> FloatArray | None: ...
    def restoring(self) -> AbstractContextManager[None]: ...
    @property
    def estimate(self) -> OnlineEstimate | None: ...
    @property
    def moves(self) -> tuple[DetectedMove, ...]: ...
    @property
    def loop_closures(self) -> tuple[DetectedLoopClosure, ...]: ...


MakeEngine = Callable[[SessionModel, SolveConfig, SoundSpeedPrior | None], Engine]


class EpochFeed:
    """Measurements into an engine, in the epoch that the camera is in, which the engine may find out by itself.

    Attributes:
        epoch: number of the present camera epoch.
        noticed: epochs that the engine began by itself and that no ``camera_moved`` event has told of yet.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.epoch = 0
        self.noticed = 0

    def add(self, event: Aim | Pair | CameraMovedEvent) -> OnlineEstimate | None:
        """Take in one; None for a move that the engine knows of already.

        Raises:
            EventRefused: the engine could not; it is as it was.
        """
        if isinstance(event, CameraMovedEvent):
            if event.detected and self.noticed:
                self.noticed -= 1
                return None
            moved = CameraMoved(event.t, event.camera_new_T_camera_old, event.covariance, event.detected, event.since_t)
            estimate = self._engine.add(moved)
            self.epoch = estimate.epoch
            return estimate
        estimate = self._engine.add(replace(event, epoch=self.epoch) if isinstance(event, Pair) else event)
        self.notice(estimate)
        return estimate

    def notice(self, estimate: OnlineEstimate) -> None:
        """Epochs that the engine began by itself."""
        self.noticed += max(0, estimate.epoch - self.epoch)
        self.epoch = estimate.epoch

    def starts(self) -> tuple[EpochStart, ...]:
        """Where the epochs begin, as the engine has it."""
        return self._engine.measurements().epochs


class LiveSession:
    """A session that is recorded and estimated at once. Use as a context manager, or close it.

    Attributes:
        journal: what is on disk.
        estimate: after the last event that was taken in; None before the first.
        config: of the estimate.
        late: events may be handed over later than others that happened after them: they get the last one's time.
        engine: that has taken in what is recorded; a revived session has another one.
    """

    engine: Engine

    def __init__(self, journal: Journal, make_engine: MakeEngine, config: SolveConfig) -> None:
        self.journal, self.config = journal, config
        self.estimate: OnlineEstimate | None = None
        self.late = False
        self._make_engine = make_engine
        self._untaken: list[Event] = []  # on disk, not in the estimate yet: something came between
        self._unwritten: list[Event] = []  # to be recorded as soon as the disk allows
        self._gone = False  # the engine's process has ended: nothing goes into the estimate before a revival
        self._ended_at: Event | None = None  # the event that it ended at
        self._deaths: dict[int, int] = {}  # ends of the engine's process while it took an event in, by its line
        self._begin_with(make_engine(journal.model, config, None))

    def _begin_with(self, engine: Engine) -> None:
        """Nothing is taken in yet."""
        self._engine, self._feed = engine, EpochFeed(engine)
        self._recogniser = EventRecogniser(self.journal.model)

    @classmethod
    def open(
        cls,
        folder: str | Path,
        config: SolveConfig | None = None,
        make_engine: MakeEngine | None = None,
        *,
        late: bool = False,
    ) -> Self:
        """Open a session's folder (with its ``session.yaml``); what was recorded before is taken in again.

        Raises:
            InputError: the session's files, or frames that they name, are not as they should be.
            JournalError: another program records to it, or the disk refuses.
        """
        journal = Journal.open(Path(folder))
        try:
            found = cls(journal, make_engine or online_engine, config or SolveConfig())
            found.late = late
            found._take_up(journal.take_recorded())
        except BaseException:
            journal.close()
            raise
        return found

    def revive(self) -> OnlineEstimate | None:
        """Go on with a new engine where the old one's process has ended: from what is on disk.

        Nothing is lost, and the session stays open. An event at which that has happened :data:`MOST_DEATHS` times is
        recorded as refused.

        Raises:
            EngineGone: the new one has ended too; try again.
            FgregError: it did not start, or the disk refuses.
        """
        self._gone = True  # whatever goes wrong here: an engine that has taken in some of it is not gone on with
        event, self._ended_at = self._ended_at, None
        if event is not None:
            self._deaths[event.line] = self._deaths.get(event.line, 0) + 1
            if self._deaths[event.line] >= MOST_DEATHS:
                self._refuse(event, event.line, f"the registration's process has ended {MOST_DEATHS} times at it")
        self._write_waiting(patient=False)
        self._begin_with(self._make_engine(self.journal.model, self.config, None))
        self._take_up(self.journal.reread())
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
        """Take in what is recorded, estimated once at its end."""
        refused = refused_lines(events)
        with self._engine.restoring():
            for event in events:
                if event.line not in refused:
                    with contextlib.suppress(EventRefused):  # noted now: the time before did not get so far
                        self._take(event)
        if self.estimate is not None:
            self.estimate = self._engine.estimate
        self.engine = self._engine
        self._record_moves()
        self._write_waiting()

    def add(self, event: Estimating) -> OnlineEstimate | None:
        """Record an event, take it in, and say what is known now.

        A shot in whose frames the marker or the PM is not found is recorded and changes nothing.

        Raises:
            InputError: not an event that a session may hold; recorded as refused.
            EventRefused: it could not be taken into the estimate; recorded as refused, later ones work.
            JournalError: the disk refuses; neither recorded nor taken in. The estimate and :meth:`track` stay usable.
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
        try:
            self._take_in()
        finally:
            self._write_waiting()
        return self.estimate

    def track(self, query: TrackEvent, *, record: bool = True) -> TrackEstimate:
        """Answer where to turn the stage, recording the query first unless told not to (at camera rate, say).

        Raises:
            InputError: not a query that a session may hold.
            JournalError: the disk refuses the record.
            EngineGone: :meth:`revive` is due.
        """
        if record:
            self._catch_up()
            kept = self.journal.append(query).event
            if isinstance(kept, TrackEvent):
                query = kept
        found = self._recogniser.add(query, self._feed.epoch)
        if isinstance(found, Track):
            return replace(self._engine.track(found), causal=True)
        return TrackEstimate(query.t, None, None, None, causal=True, reason=str(found))

    def record(self, event: NoteEvent | StageEvent) -> None:
        """Record what the estimate does not depend on.

        Raises:
            InputError: not an event that a session may hold.
            JournalError: the disk refuses.
            EngineGone: it is recorded, and :meth:`revive` is due.
        """
        gone = self._catch_up_or_gone()
        self.journal.append(event, late=self.late)
        if gone is not None:
            raise gone

    def refresh(self) -> OnlineEstimate | None:
        """What the engine has found out since, without an event; a move of the camera that it found is recorded."""
        self._catch_up()
        before = self._feed.epoch
        try:
            estimate = self._engine.refresh()
        except EngineGone:
            self._gone = True
            raise
        if self.estimate is not None or estimate.epoch > before:
            self.estimate = estimate
        self._feed.notice(estimate)
        self._record_moves()
        self._write_waiting()
        return self.estimate

    def settle(self) -> OnlineEstimate:
        """The full judgement of all that was taken in, now."""
        self.estimate = self._engine.settle()
        return self.estimate

    def measurements(self) -> Measurements:
        """All that was taken in."""
        return self._engine.measurements()

    def marker_T_laser(self) -> FloatArray | None:
        """The beam, (4, 4), as the estimate has it; None where there is none yet."""
        return self._engine.marker_T_laser()

    def _catch_up_or_gone(self) -> EngineGone | None:
        """As :meth:`_catch_up`; where the engine is gone, that: what comes is recorded all the same."""
        try:
            self._catch_up()
        except EngineGone as gone:
            return gone
        return None

    def _catch_up(self) -> None:
        """What an interrupt or a full disk left undone comes before the next event.

        Raises:
            JournalError: the disk still refuses.
            EngineGone: :meth:`revive` is due.
        """
        if self._gone:
            raise EngineGone(GONE)
        while self._untaken:
            with contextlib.suppress(EventRefused):
                self._take_in()
        self._write_waiting(patient=False)

    def _take_in(self) -> None:
        """The oldest event that is on disk only into the estimate; raises as :meth:`_take`."""
        event = self._untaken[0]
        try:
            self._take(event)
        except EventRefused:
            self._untaken.remove(event)
            raise
        self._untaken.remove(event)
        self._record_moves()

    def _take(self, event: Event) -> None:
        """A recorded event into the estimate.

        Raises:
            EventRefused: it could not be; noted for the record.
        """
        estimate: OnlineEstimate | None = None
        try:
            if isinstance(event, AimEvent | PairEvent):
                found = self._recogniser.add(event, self._feed.epoch)
                if isinstance(found, Aim | Pair):
                    try:
                        estimate = self._feed.add(found)
                    except BaseException:  # its frames must not count either: opened again, the session lacks them
                        self._recogniser.take_back()
                        raise
            elif isinstance(event, CameraMovedEvent):
                estimate = self._feed.add(event)
        except (EventRefused, InputError) as error:
            reason = error.reason if isinstance(error, EventRefused) else str(error)
            self._refuse(event, event.line, reason)
            raise EventRefused(reason) from error
        except EngineGone:
            self._gone, self._ended_at = True, event
            raise
        if estimate is not None:
            self.estimate = estimate

    def _record_moves(self) -> None:
        """Moves that the engine found out by itself become events: the epochs are then the same for every reader."""
        count, self._feed.noticed = self._feed.noticed, 0
        t = self.journal.last_t
        if not count or t is None:
            return
        for start in self._feed.starts()[-count:]:
            moved = CameraMovedEvent(
                t, 0, start.camera_new_T_camera_old, start.covariance, detected=True, since_t=min(t, start.t)
            )
            self._unwritten.append(moved)

    def _refuse(self, event: Event, line: int | None, reason: str) -> None:
        """Note a refusal, with the event's line where it is on disk, else with all of it that can be written."""
        t = self.journal.last_t
        if t is None:  # the time of an event that is refused for what it is may be anything
            t = min(0.0, event.t) if math.isfinite(event.t) and event.t > -EARLIEST_S else 0.0
        document: object = {"type": type_of(event), "t": event.t, "line": line}
        if line is None:
            try:
                document = event_document(event, self.journal.folder)
            except InputError:  # a frame from elsewhere has no name here
                document = {"type": type_of(event), "t": event.t}
        self._unwritten.append(RefusedEvent(t, 0, writable(document), reason))

    def _write_waiting(self, *, patient: bool = True) -> None:
        """Record what waits for it; ``patient``: it waits on where the disk refuses."""
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
                # Too long a line: its beginning has to do.
                self._unwritten[0] = replace(event, event=repr(event.event)[:1000])
                continue
            self._unwritten.pop(0)


def online_engine(
    model: SessionModel,
    config: SolveConfig,
    sound_speed_prior: SoundSpeedPrior | None,
    *,
    find_moves: bool = True,
) -> Engine:
    """The incremental engine, its full solve in the same process: the same events always give the same estimates."""
    return OnlineRegistration(model, config, find_moves=find_moves, sound_speed_prior=sound_speed_prior)
