"""Records events and has them estimated, on a thread of its own: the loop hands over and goes on.

Nothing that was handed over is dropped: what waits is counted, and what the disk refuses is said. Each event is on disk
before it is counted as recorded (fgreg.session.journal). Where the registration's process ends, a new one goes on from
what is on disk; the last estimate stands until then, as a warning at most, since nobody notices if the camera moves.
"""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from fgreg.errors import EventRefused, FgregError, JournalError
from fgreg.geometry.transforms import FloatArray
from fgreg.live.actions import RegistrationState
from fgreg.model.estimate import Verdict
from fgreg.model.events import AimEvent, CameraMovedEvent, NoteEvent, PairEvent
from fgreg.online.engine_process import EngineGone
from fgreg.online.estimate import OnlineEstimate
from fgreg.online.live_session import LiveSession

REFRESH_S = 0.2
"""Between looks at what was found out meanwhile."""
AGAIN_S = 5.0
"""Between attempts to go on with a new process."""
REVIVED = "the registration's process had ended; another one has taken in what is recorded"
UNWATCHED = "the registration's process has ended, and another one is being started: what came since is not in here"

Recorded = AimEvent | PairEvent | CameraMovedEvent | NoteEvent


@dataclass(frozen=True, slots=True)
class RecorderState:
    """What has become of the events.

    Attributes:
        known: of the estimate. estimate: itself.
        aims, pairs: on disk and taken in. refused: on disk, and not taken in. waiting: handed over, not on disk yet.
        trouble: the last thing that went wrong; empty where nothing is.
        camera_moving: a move of the camera was handed over and is not in the estimate: its registration holds no more.
        blocked: why nothing can be recorded now; what waits is recorded when it can be. Empty where it can.
    """

    known: RegistrationState
    estimate: OnlineEstimate | None = None
    aims: int = 0
    pairs: int = 0
    refused: int = 0
    waiting: int = 0
    trouble: str = ""
    camera_moving: bool = False
    blocked: str = ""


OnTaken = Callable[[Recorded, OnlineEstimate | None, FloatArray | None], None]
"""Gets the event, the estimate after it, and the beam (``marker_T_laser``) as that has it."""


class Recorder:
    """One session's recorder.

    Args:
        session: opened; the recorder is the only one that adds to it from now on.
        on_taken: called on the recorder's thread after each event that was taken in, but for those that a new process
            of the registration took in when it began.
    """

    def __init__(self, session: LiveSession, on_taken: OnTaken | None = None) -> None:
        self._session, self._on_taken = session, on_taken
        self._waiting: queue.Queue[Recorded | None] = queue.Queue()
        self._lock = threading.Lock()
        self._state = self._recorded()
        self._moves, self._move_lost = 0, False  # of the camera: handed over and waiting; one that was not taken in
        self._ended, self._left, self._revived_s = False, 0, -math.inf
        self._thread = threading.Thread(target=self._run, name="recorder")
        self._thread.start()

    @property
    def state(self) -> RecorderState:
        """As it is now."""
        with self._lock:
            waits = self._left or self._waiting.qsize() + bool(self._state.blocked)
            return replace(self._state, waiting=waits)

    def hand_over(self, event: Recorded) -> None:
        """Have an event recorded, and return at once.

        Raises:
            RuntimeError: after :meth:`close`.
        """
        if self._ended:
            raise RuntimeError("the recorder is closed")
        if isinstance(event, CameraMovedEvent):
            with self._lock:
                self._moves += 1
                self._state = replace(self._state, camera_moving=True)
        self._waiting.put(event)

    def close(self) -> None:
        """Record what still waits, then end; what the disk still refuses then is lost, and counted as waiting."""
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
                    self._left = self._waiting.qsize()  # the mark of the end stands for this event
                    return
                self._refresh(holding=True)
                time.sleep(REFRESH_S)

    def _recorded(self) -> RecorderState:
        """What the session has."""
        taken, estimate = self._session.measurements(), self._session.estimate
        return RecorderState(registration_state(estimate), estimate, aims=len(taken.aims), pairs=len(taken.pairs))

    def _revive(self) -> None:
        """Go on with a new engine, unless that has just been tried."""
        with self._lock:
            standing = _unwatched(self._state.estimate)
            self._state = replace(self._state, known=registration_state(standing), estimate=standing, trouble=UNWATCHED)
        if time.monotonic() < self._revived_s + AGAIN_S:
            return
        self._revived_s = time.monotonic()
        try:
            self._session.revive()
            t = self._session.journal.last_t
            self._session.record(NoteEvent(0.0 if t is None else t, 0, REVIVED))
            state = self._recorded()
        except FgregError as error:
            with self._lock:
                self._state = replace(self._state, trouble=f"{UNWATCHED}: {error}")
            return
        with self._lock:
            self._state = replace(state, refused=self._state.refused, camera_moving=self._moves > 0 or self._move_lost)

    def _take(self, event: Recorded) -> bool:
        """Record one; whether that was possible."""
        aims = pairs = refused = 0
        trouble, estimate = "", self._session.estimate
        moved = isinstance(event, CameraMovedEvent)
        if isinstance(event, CameraMovedEvent) and self._move_lost:  # it begins where a move nobody knows of has ended
            event = replace(event, camera_new_T_camera_old=None, covariance=None)
        try:
            if isinstance(event, NoteEvent):
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
            )
        if self._on_taken is not None and not refused:
            try:
                beam = self._session.marker_T_laser()
            except EngineGone:
                self._revive()
                return True
            self._on_taken(event, estimate, beam)
        return True

    def _refresh(self, *, holding: bool = False) -> None:
        """``holding``: an event waits for the disk."""
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
            self._state = replace(self._state, known=registration_state(estimate), estimate=estimate, blocked=blocked)


def _unwatched(estimate: OnlineEstimate | None) -> OnlineEstimate | None:
    """An estimate that nothing is added to, and that nobody looks after."""
    if estimate is None or UNWATCHED in estimate.reasons:
        return estimate
    verdict = max(estimate.verdict, Verdict.WARNING, key=lambda v: v.severity)
    return replace(estimate, verdict=verdict, reasons=(UNWATCHED, *estimate.reasons))


def registration_state(estimate: OnlineEstimate | None) -> RegistrationState:
    """What the workflow wants to know of an estimate."""
    if estimate is None:
        return RegistrationState(Verdict.REFUSED)
    return RegistrationState(
        estimate.verdict, estimate.reasons, estimate.epoch, estimate.pairs, estimate.trus_T_camera is not None
    )
