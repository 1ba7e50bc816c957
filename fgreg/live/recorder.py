"""Records events and passes them to the engine, on a thread of its own: the loop hands an event over and goes on.

No event that was handed over is dropped: waiting ones are counted, and a disk error is reported. Each event is on disk
before it counts as recorded (fgreg.session.journal). If the engine's process ends, a new one is started from the
recorded events. Until then the last estimate stays valid with a warning, since camera moves go undetected.
"""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from fgreg.errors import EventRefused, FgregError, InputError, JournalError
from fgreg.geometry.transforms import FloatArray
from fgreg.live.actions import RegistrationState
from fgreg.model.estimate import Verdict
from fgreg.model.events import (
    AimEvent,
    CameraMovedEvent,
    CheckEvent,
    HandChoice,
    NoteEvent,
    PairEvent,
    PointEvent,
    TrackEvent,
)
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine_process import EngineGone
from fgreg.online.estimate import OnlineEstimate
from fgreg.online.live_session import LiveSession

REFRESH_S = 0.2
"""Time between two fetches of the engine's newest estimate."""
AGAIN_S = 5.0
"""Time between two attempts to start a new process."""
RESTARTED = "the registration's process had ended; a new one has taken in the recorded events"
ENGINE_ENDED = "the registration's process has ended and is being restarted: later events are not in the estimate"

Recorded = AimEvent | PairEvent | PointEvent | CameraMovedEvent | CheckEvent | HandChoice | NoteEvent | TrackEvent


@dataclass(frozen=True, slots=True)
class RecorderState:
    """State of recording and estimate.

    Attributes:
        registration: summary of the estimate. estimate: the estimate itself.
        aims, pairs: counts on disk and taken in. refused: on disk, not taken in. waiting: handed over, not on disk yet.
        trouble: the last error; empty if there is none.
        camera_moving: a reported camera move is not in the estimate yet, so the registration is invalid.
        blocked: why nothing can be recorded now; waiting events are recorded later. Empty if recording works.
        pms, excluded: numbers of the PMs that count, and of those that are left out by hand.
        choosing: shots that were left out or taken back are not in the estimate yet, so the registration is invalid.
    """

    registration: RegistrationState
    estimate: OnlineEstimate | None = None
    aims: int = 0
    pairs: int = 0
    refused: int = 0
    waiting: int = 0
    trouble: str = ""
    camera_moving: bool = False
    blocked: str = ""
    pms: frozenset[int] = frozenset()
    excluded: frozenset[int] = frozenset()
    choosing: bool = False


OnTaken = Callable[[Recorded, OnlineEstimate | None, FloatArray | None], None]
"""Gets the event, the estimate after it, and the estimated beam (``marker_T_laser``)."""


class Recorder:
    """One session's recorder.

    Args:
        session: opened; only the recorder may add to it from now on.
        on_taken: called on the recorder's thread after each event that was taken in; not for the recorded events that
            a new engine process takes in when it starts.
    """

    def __init__(self, session: LiveSession, on_taken: OnTaken | None = None) -> None:
        self._session, self._on_taken = session, on_taken
        self._waiting: queue.Queue[Recorded | None] = queue.Queue()
        self._lock = threading.Lock()
        self._state = self._recorded()
        self._moves, self._move_lost = 0, False  # camera moves that wait; whether one was refused
        self._choices = 0  # choices by hand that wait
        self._ended, self._left, self._revived_s = False, 0, -math.inf
        self._thread = threading.Thread(target=self._run, name="recorder")
        self._thread.start()

    @property
    def config(self) -> SolveConfig:
        """Of the estimate."""
        return self._session.config

    @property
    def state(self) -> RecorderState:
        """Current state."""
        with self._lock:
            waits = self._left or self._waiting.qsize() + bool(self._state.blocked)
            return replace(self._state, waiting=waits)

    def hand_over(self, event: Recorded) -> None:
        """Queue an event for recording, and return at once.

        Raises:
            RuntimeError: after :meth:`close`.
        """
        if self._ended:
            raise RuntimeError("the recorder is closed")
        if isinstance(event, CameraMovedEvent):
            with self._lock:
                self._moves += 1
                self._state = replace(self._state, camera_moving=True)
        elif isinstance(event, HandChoice):
            with self._lock:
                self._choices += 1
                self._state = replace(self._state, choosing=True)
        self._waiting.put(event)

    def close(self) -> None:
        """Record the waiting events, then end. Events that the disk still refuses are lost, and counted as waiting."""
        if not self._ended:
            self._ended = True
            self._waiting.put(None)
        self._thread.join()

    def _run(self) -> None:
        while True:
            try:
                event = self._waiting.get(timeout=REFRESH_S)
            except queue.Empty:
                self._refresh()
                continue
            if event is None:
                return
            while not self._take(event):
                if self._ended:
                    self._left = self._waiting.qsize()  # the queue's end mark counts in place of this event
                    return
                self._refresh(holding=True)
                time.sleep(REFRESH_S)

    def _recorded(self) -> RecorderState:
        """State of the session as opened."""
        taken, estimate = self._session.measurements(), self._session.estimate
        excluded = frozenset(shot.pm for shot in self._session.excluded if shot.pm is not None)
        return RecorderState(
            registration_state(estimate),
            estimate,
            aims=len(taken.aims),
            pairs=len(taken.pairs),
            pms=frozenset(pair.pm for pair in taken.pairs),
            excluded=excluded,
        )

    def _revive(self) -> None:
        """Start a new engine, unless that was tried within ``AGAIN_S``."""
        with self._lock:
            standing = _without_engine(self._state.estimate)
            self._state = replace(
                self._state, registration=registration_state(standing), estimate=standing, trouble=ENGINE_ENDED
            )
        if time.monotonic() < self._revived_s + AGAIN_S:
            return
        self._revived_s = time.monotonic()
        try:
            self._session.revive()
            t = self._session.journal.last_t
            self._session.record(NoteEvent(0.0 if t is None else t, 0, RESTARTED))
            state = self._recorded()
        except FgregError as error:
            with self._lock:
                self._state = replace(self._state, trouble=f"{ENGINE_ENDED}: {error}")
            return
        self._began_again(state)

    def _began_again(self, state: RecorderState, choices: int = 0) -> None:
        """Take over the state of a session whose engine has begun again from the recorded events, ``choices`` of which
        had been handed over."""
        with self._lock:
            self._choices -= choices
            moving, choosing = self._moves > 0 or self._move_lost, self._choices > 0
            self._state = replace(state, refused=self._state.refused, camera_moving=moving, choosing=choosing)

    def _take(self, event: Recorded) -> bool:
        """Record one event; whether the disk took it."""
        if isinstance(event, HandChoice):
            return self._choose(event)
        aims = pairs = refused = 0
        trouble, estimate = "", self._session.estimate
        moved = isinstance(event, CameraMovedEvent)
        if isinstance(event, CameraMovedEvent) and self._move_lost:  # it follows a move that is not in the estimate
            event = replace(event, camera_new_T_camera_old=None, covariance=None)
        try:
            if isinstance(event, NoteEvent | TrackEvent):
                self._session.record(event)
            else:
                estimate = self._session.add(event)
                aims, pairs = int(isinstance(event, AimEvent)), int(isinstance(event, PairEvent))
        except JournalError as error:
            with self._lock:
                self._state = replace(self._state, trouble=str(error), blocked=str(error))
            return False
        except EngineGone:  # the event is on disk, and the next engine takes it in
            with self._lock:
                self._moves -= moved
            self._revive()
            return True
        except EventRefused as error:
            refused, trouble = 1, f"an event was refused: {error.reason}"
        except FgregError as error:
            refused, trouble = 1, str(error)
        with self._lock:
            before = self._state
            if moved:
                self._moves, self._move_lost = self._moves - 1, bool(refused)
            self._state = RecorderState(
                registration_state(estimate),
                estimate,
                before.aims + aims,
                before.pairs + pairs,
                before.refused + refused,
                trouble=trouble,
                camera_moving=self._moves > 0 or self._move_lost,
                pms=before.pms | {event.pm} if pairs and isinstance(event, PairEvent) else before.pms,
                excluded=before.excluded,
                choosing=self._choices > 0,
            )
        if self._on_taken is not None and not refused:
            try:
                beam = self._session.marker_T_laser()
            except EngineGone:
                self._revive()
                return True
            self._on_taken(event, estimate, beam)
        return True

    def _choose(self, event: HandChoice) -> bool:
        """Record a choice by hand: the engine begins again from the recorded events. Whether the disk took it."""
        try:
            self._session.add(event)
        except JournalError as error:
            with self._lock:
                self._state = replace(self._state, trouble=str(error), blocked=str(error))
            return False
        except EngineGone:
            with self._lock:
                self._choices -= 1
            self._revive()
            return True
        except FgregError as error:
            with self._lock:
                self._choices -= 1
                # What is on disk counts: the next refresh finds the engine gone and starts another.
                choosing = self._choices > 0 or not isinstance(error, InputError)
                self._state = replace(self._state, trouble=str(error), choosing=choosing)
            return True
        self._began_again(self._recorded(), 1)
        return True

    def _refresh(self, *, holding: bool = False) -> None:
        """Fetch the newest estimate. ``holding``: an event waits for the disk."""
        try:
            estimate = self._session.refresh()
        except EngineGone:
            self._revive()
            return
        except FgregError as error:
            blocked = str(error) if isinstance(error, JournalError) else self._state.blocked
            with self._lock:
                self._state = replace(self._state, trouble=str(error), blocked=blocked)
            return
        with self._lock:
            blocked = self._state.blocked if holding else ""
            registration = registration_state(estimate)
            self._state = replace(self._state, registration=registration, estimate=estimate, blocked=blocked)


def _without_engine(estimate: OnlineEstimate | None) -> OnlineEstimate | None:
    """The estimate with at least a warning, since its engine has ended."""
    if estimate is None or ENGINE_ENDED in estimate.reasons:
        return estimate
    verdict = max(estimate.verdict, Verdict.WARNING, key=lambda v: v.severity)
    return replace(estimate, verdict=verdict, reasons=(ENGINE_ENDED, *estimate.reasons))


def registration_state(estimate: OnlineEstimate | None) -> RegistrationState:
    """Summary of an estimate for the workflow."""
    if estimate is None:
        return RegistrationState(Verdict.REFUSED)
    return RegistrationState(
        estimate.verdict, estimate.reasons, estimate.epoch, estimate.pairs, estimate.trus_T_camera is not None
    )
