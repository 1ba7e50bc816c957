"""The online registration in a worker process: it takes events and returns estimates; queries read its snapshot.

At the first pairs of an epoch the registration holds its interpreter's lock for up to some tenths of a second. A camera
loop cannot wait for that. It reads the shared snapshot (:meth:`EngineProcess.reader`), while another thread hands over
the events and waits for the estimates.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from types import TracebackType
from typing import Any

from fgreg.camera_moves.found import DetectedLoopClosure, DetectedMove
from fgreg.errors import EventRefused, FgregError
from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import TrackEstimate
from fgreg.model.measurements import EpochStart, Measurements, Track
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine import OnlineRegistration
from fgreg.online.estimate import OnlineEstimate
from fgreg.online.events import CameraMoved, LoopClosed, OnlineEvent
from fgreg.online.shared_snapshot import NoSnapshotError, SharedSnapshot, SnapshotReader, remove_memory
from fgreg.online.snapshot_record import Layout
from fgreg.tracking.query import track
from fgreg.tracking.snapshot import Snapshot
from fgreg.workers.worker_process import Work, WorkerProcess

ANSWER_S, END_S = 60.0, 5.0
"""A process that takes longer for a call, or to end, is killed; the longest call restores a session in some seconds."""

Call = tuple[str, tuple[Any, ...]]
"""Name of the engine's method, and the arguments."""
After = tuple[str | None, Any, OnlineEstimate | None, tuple[DetectedMove, ...], tuple[DetectedLoopClosure, ...]]
"""Why an event was refused, what the call returned, and the engine's estimate, moves and loop closures."""

AFTER_EACH = (CameraMoved, LoopClosed)
"""Recorded events after which the epoch may be another one."""

REMEDY = "open the session again"
GONE = f"the registration's process has ended: {REMEDY}"


class EngineGone(FgregError):  # noqa: N818
    """The registration's process has ended; every recorded event is on disk."""


class OneRefused(FgregError):  # noqa: N818
    """Of recorded events that were taken in together, one was refused; take them in one by one, in a new engine."""


def start_process(model: SessionModel, config: SolveConfig) -> WorkerProcess[Call, After]:
    """A process for an :class:`EngineProcess`. It loads its modules, and makes the engine at the first call."""
    return WorkerProcess(
        _registering,
        model,
        config,
        name="fgreg-engine",
        what="the registration's process",
        answer_s=ANSWER_S,
        end_s=END_S,
        restart=False,  # a new process would have no events: the caller makes another engine from the journal
        daemon=False,
    )


class EngineProcess:
    """The engine as :class:`fgreg.online.live_session.LiveSession` takes it. Use it as a context manager, or close it.

    Calls wait for the process; they may come from several threads and then run one after another.

    Args:
        model: the session's set-up.
        config: settings of estimate and verdict.
        process: of :func:`start_process` with the same model and configuration; None starts one.

    Raises:
        EngineGone: the process did not start, or has ended.
        FgregError: it cannot make an engine of this model.
    """

    def __init__(
        self, model: SessionModel, config: SolveConfig, process: WorkerProcess[Call, After] | None = None
    ) -> None:
        self._turn = threading.Lock()
        self._together: list[OnlineEvent] | None = None  # events that wait, while a session is restored
        self._name = ""  # of the shared memory
        self._estimate: OnlineEstimate | None = None
        self._moves: tuple[DetectedMove, ...] = ()
        self._loop_closures: tuple[DetectedLoopClosure, ...] = ()
        self._worker = process or start_process(model, config)
        try:
            self._name = str(self._call("name"))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> EngineProcess:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def reader(self) -> SnapshotReader:
        """A reader of the shared snapshot, for one thread of this or another process."""
        return SnapshotReader(self._name)

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._worker.alive

    @property
    def pid(self) -> int | None:
        """Process id; None where the process has ended."""
        return self._worker.pid

    def _call(self, name: str, *arguments: Any) -> Any:
        with self._turn:
            self._worker.fetch(math.inf)  # the answer to a call that was interrupted
            self._worker.send((name, arguments))
            (after,) = self._worker.fetch(math.inf) or (None,)
            if after is None:
                failure = self._worker.failure
                raise EngineGone(f"{failure}: {REMEDY}") if self._worker.lost else FgregError(failure)
            refused, value, self._estimate, self._moves, self._loop_closures = after
        if refused is not None:
            raise EventRefused(refused)
        return value

    def add(self, event: OnlineEvent) -> OnlineEstimate:
        """As :meth:`fgreg.online.engine.OnlineRegistration.add`. Raises EventRefused, EngineGone, OneRefused."""
        if self._together is None:
            return self._known(self._call("add", event))
        if isinstance(event, AFTER_EACH):
            self._send_together()
            return self._known(self._call("add", event))
        self._together.append(event)
        return self._known(self._estimate)

    def _send_together(self) -> None:
        """Take in the events that wait while a session is restored: a call for each would wait for other threads."""
        events, self._together = self._together, []
        try:
            self._call("add_all", events)
        except EventRefused as error:
            raise OneRefused(error.reason) from error

    def settle(self) -> OnlineEstimate:
        """As :meth:`fgreg.online.engine.OnlineRegistration.settle`. Raises EngineGone."""
        return self._known(self._call("settle"))

    def refresh(self) -> OnlineEstimate:
        """As :meth:`fgreg.online.engine.OnlineRegistration.refresh`. Raises EngineGone."""
        return self._known(self._call("refresh"))

    @staticmethod
    def _known(estimate: Any) -> OnlineEstimate:
        if not isinstance(estimate, OnlineEstimate):
            raise TypeError(f"the process answered with a {type(estimate).__name__}")
        return estimate

    def measurements(self) -> Measurements:
        """All measurements. Raises EngineGone."""
        found = self._call("measurements")
        if not isinstance(found, Measurements):
            raise TypeError(f"the process answered with a {type(found).__name__}")
        return found

    def starts(self) -> tuple[EpochStart, ...]:
        """Starts of the camera epochs. Raises EngineGone."""
        return tuple(self._call("starts"))

    def marker_T_laser(self) -> FloatArray | None:
        """The beam, (4, 4); None where there is no estimate yet. Raises EngineGone."""
        return self._call("marker_T_laser")  # type: ignore[no-any-return]

    def track(self, query: Track) -> TrackEstimate:
        """Answer a query in this process, from the snapshot."""
        snapshot = self.snapshot()
        if snapshot is None:
            return TrackEstimate(query.t, None, None, None, causal=True, reason="there is no estimate yet")
        return track(query, snapshot)

    def snapshot(self) -> Snapshot | None:
        """The snapshot that was published last; None where there is none yet, or the process has ended."""
        try:
            reader = self.reader()
        except FileNotFoundError:
            return None
        try:
            return reader.snapshot()
        except NoSnapshotError:
            return None
        finally:
            reader.close()

    @contextmanager
    def restoring(self) -> Iterator[None]:
        """As :meth:`fgreg.online.engine.OnlineRegistration.restoring`. Raises EngineGone."""
        self._call("restore")
        try:
            yield
        finally:
            self._call("restored")

    @contextmanager
    def restoring_together(self) -> Iterator[None]:
        """The same with few calls: each one waits for other threads. Raises EngineGone, OneRefused.

        Where that fails, this engine is of no more use.
        """
        self._call("restore")
        self._together = []
        try:
            yield
            self._send_together()
        finally:
            self._together = None
        self._call("restored")

    @property
    def estimate(self) -> OnlineEstimate | None:
        """The estimate after the last call; None before the first."""
        return self._estimate

    @property
    def moves(self) -> tuple[DetectedMove, ...]:
        """Detected camera moves, as of the last call."""
        return self._moves

    @property
    def loop_closures(self) -> tuple[DetectedLoopClosure, ...]:
        """Loop closures, as of the last call."""
        return self._loop_closures

    def close(self) -> None:
        """End the process, and remove its shared memory if it was killed."""
        self._worker.close()
        remove_memory(self._name)


@contextmanager
def _registering(model: SessionModel, config: SolveConfig) -> Iterator[Work[Call, After]]:
    """In the process."""
    with ExitStack() as stack:
        yield _FromFirstCall(model, config, stack)


class _FromFirstCall:
    """Makes the engine at the first call: until then there is no worker process of its own, and nothing to publish."""

    def __init__(self, model: SessionModel, config: SolveConfig, stack: ExitStack) -> None:
        self._model, self._config, self._stack = model, config, stack
        self._work: _Registering | None = None

    def __call__(self, call: Call) -> After:
        if self._work is None:
            engine = self._stack.enter_context(OnlineRegistration(self._model, self._config, full_solve="worker"))
            shared = self._stack.enter_context(SharedSnapshot(Layout.of(self._model)))
            self._work = _Registering(engine, shared)
        return self._work(call)

    def idle(self) -> None:
        if self._work is not None:
            self._work.idle()


class _Registering:
    def __init__(self, engine: OnlineRegistration, shared: SharedSnapshot) -> None:
        self._engine, self._shared = engine, shared
        self._published: OnlineEstimate | None = None
        self._restoring: Any = None
        self._publish()

    def __call__(self, call: Call) -> After:
        refused, value = None, None
        try:
            value = self._do(*call)
        except EventRefused as error:
            refused = error.reason
        finally:
            if self._restoring is None:  # until then the snapshot of the process before is better
                self._publish()
        return refused, value, self._engine.estimate, self._engine.moves, self._engine.loop_closures

    def idle(self) -> None:
        """Take over the full solve's result while no event comes."""
        if self._restoring is None:
            self._engine.refresh()
            self._publish()

    def _do(self, name: str, arguments: tuple[Any, ...]) -> Any:
        match name:
            case "name":
                return self._shared.name
            case "add_all":
                for event in arguments[0]:
                    self._engine.add(event)
                return None
            case "restore":
                self._restoring = self._engine.restoring()
                return self._restoring.__enter__()
            case "restored":
                ending, self._restoring = self._restoring, None
                return ending.__exit__(None, None, None)
        return getattr(self._engine, name)(*arguments)

    def _publish(self) -> None:
        estimate = self._engine.estimate
        if estimate is self._published:
            self._shared.touch()
            return
        with suppress(ValueError):  # a number is not finite: the snapshot before stays
            self._shared.publish(self._engine.snapshot())
        self._published = estimate
