"""The online registration in a process of its own: events go there, estimates come back, queries go to its snapshot.

What registers holds its interpreter's lock for up to some tenths of a second at the first pairs of an epoch. A camera
loop cannot wait for that: it reads the shared snapshot (:meth:`EngineProcess.reader`), while a thread of its own hands
over the events and waits for what comes of them.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any

from fgreg.errors import EventRefused, FgregError
from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import TrackEstimate
from fgreg.model.measurements import Measurements, Track
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine import OnlineRegistration
from fgreg.online.estimate import OnlineEstimate
from fgreg.online.events import DetectedMove, DetectedReturn, OnlineEvent
from fgreg.online.shared_snapshot import NoSnapshotError, SharedSnapshot, SnapshotReader
from fgreg.online.snapshot_record import Layout
from fgreg.registration.register import SoundSpeedPrior
from fgreg.tracking import track
from fgreg.workers.worker_process import NICENESS

START_S = 60.0
IDLE_S = 0.1
"""Between looks at what the full solve has found, while no event comes."""


GONE = "the registration's process has ended: open the session again"


class EngineGone(FgregError):  # noqa: N818
    """The registration's process has ended; what is on disk is all there."""


class EngineProcess:
    """The engine as :class:`fgreg.online.live_session.LiveSession` takes it. Use it as a context manager, or close it.

    Calls wait for the process; they may come from several threads, one after another.

    Raises:
        EngineGone: the process did not start.
    """

    def __init__(self, model: SessionModel, config: SolveConfig, sound_speed_prior: SoundSpeedPrior | None) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        # Not a daemon: it has children of its own. It ends when this end of the pipe is closed, by whatever.
        self._process = context.Process(
            target=_serve,
            args=(theirs, model, config, sound_speed_prior),
            name="fgreg-engine",
            daemon=False,
        )
        self._turn = threading.Lock()
        self._estimate: OnlineEstimate | None = None
        self._moves: tuple[DetectedMove, ...] = ()
        self._returns: tuple[DetectedReturn, ...] = ()
        self._process.start()
        theirs.close()
        try:
            if not self._connection.poll(START_S):
                raise EngineGone(f"the registration's process did not start within {START_S:.0f} s")
            self._name = str(self._connection.recv())
        except (EOFError, OSError):
            raise EngineGone("the registration's process did not start") from None
        finally:
            if not hasattr(self, "_name"):
                self.close()

    def __enter__(self) -> EngineProcess:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def reader(self) -> SnapshotReader:
        """A reader of the estimate as queries need it, for one thread of this or another process."""
        return SnapshotReader(self._name)

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.is_alive()

    def _call(self, name: str, *arguments: Any) -> Any:
        with self._turn:
            try:
                self._connection.send((name, arguments))
                how, value, self._estimate, self._moves, self._returns = self._connection.recv()
            except (EOFError, OSError):
                raise EngineGone(GONE) from None
        if how == "refused":
            raise EventRefused(value)
        if how == "failed":
            raise FgregError(value)
        return value

    def add(self, event: OnlineEvent) -> OnlineEstimate:
        """As :meth:`fgreg.online.engine.OnlineRegistration.add`. Raises EventRefused, EngineGone."""
        return self._known(self._call("add", event))

    def settle(self) -> OnlineEstimate:
        """As :meth:`fgreg.online.engine.OnlineRegistration.settle`. Raises EngineGone."""
        return self._known(self._call("settle"))

    def refresh(self) -> OnlineEstimate:
        """What was found since, without an event. Raises EngineGone."""
        return self._known(self._call("refresh"))

    @staticmethod
    def _known(estimate: Any) -> OnlineEstimate:
        if not isinstance(estimate, OnlineEstimate):
            raise TypeError(f"the process answered with a {type(estimate).__name__}")
        return estimate

    def measurements(self) -> Measurements:
        """All that was taken in. Raises EngineGone."""
        found = self._call("measurements")
        if not isinstance(found, Measurements):
            raise TypeError(f"the process answered with a {type(found).__name__}")
        return found

    def marker_T_laser(self) -> FloatArray | None:
        """The beam, (4, 4). Raises EngineGone."""
        return self._call("marker_T_laser")  # type: ignore[no-any-return]

    def track(self, query: Track) -> TrackEstimate:
        """Answered here, from the snapshot."""
        reader = self.reader()
        try:
            return track(query, reader.snapshot())
        except NoSnapshotError:
            return TrackEstimate(query.t, None, None, None, causal=True, reason="nothing is known yet")
        finally:
            reader.close()

    @contextmanager
    def restoring(self) -> Iterator[None]:
        """As of the engine: judged once at the end. Raises EngineGone."""
        self._call("restore")
        try:
            yield
        finally:
            self._call("restored")

    @property
    def estimate(self) -> OnlineEstimate | None:
        """After the last call."""
        return self._estimate

    @property
    def moves(self) -> tuple[DetectedMove, ...]:
        """Camera moves that were found out, as of the last call."""
        return self._moves

    @property
    def returns(self) -> tuple[DetectedReturn, ...]:
        """Epochs in which the camera is back where it was, as of the last call."""
        return self._returns

    def close(self) -> None:
        """End the process."""
        with suppress(OSError):
            self._connection.close()
        self._process.join(5.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _serve(
    connection: Connection[Any, Any],
    model: SessionModel,
    config: SolveConfig,
    prior: SoundSpeedPrior | None,
) -> None:
    """The process."""
    os.nice(NICENESS)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main program ends it, in its own time
    with (
        OnlineRegistration(model, config, full_solve="worker", sound_speed_prior=prior) as engine,
        SharedSnapshot(Layout.of(model)) as shared,
        suppress(EOFError, OSError),
    ):
        connection.send(shared.name)
        _Server(connection, engine, shared).run()
    os._exit(0)  # there is nothing to save, and nobody to wait for


class _Server:
    def __init__(self, connection: Connection[Any, Any], engine: OnlineRegistration, shared: SharedSnapshot) -> None:
        self._connection, self._engine, self._shared = connection, engine, shared
        self._published: OnlineEstimate | None = None
        self._restoring: Any = None

    def run(self) -> None:
        """Until the other end closes."""
        self._publish()
        while True:
            if not self._connection.poll(IDLE_S):
                if self._restoring is None:
                    self._engine.refresh()
                self._publish()
                continue
            name, arguments = self._connection.recv()
            try:
                answer = ("done", self._do(name, arguments))
            except EventRefused as error:
                answer = ("refused", error.reason)
            except Exception as error:  # a defect: the estimate stands, and the caller is told
                answer = ("failed", f"{type(error).__name__}: {error}")
            self._publish()
            self._connection.send((*answer, self._engine.estimate, self._engine.moves, self._engine.returns))

    def _do(self, name: str, arguments: tuple[Any, ...]) -> Any:
        engine = self._engine
        match name:
            case "add":
                return engine.add(*arguments)
            case "settle":
                return engine.settle()
            case "refresh":
                return engine.refresh()
            case "measurements":
                return engine.measurements()
            case "marker_T_laser":
                return engine.marker_T_laser()
            case "restore":
                self._restoring = engine.restoring()
                self._restoring.__enter__()
                return None
            case "restored":
                ending, self._restoring = self._restoring, None
                ending.__exit__(None, None, None)
                return None
        raise ValueError(f"{name} is nothing that the engine does")

    def _publish(self) -> None:
        estimate = self._engine.estimate
        if estimate is self._published:
            self._shared.touch()
            return
        with suppress(ValueError):  # numbers that no reader could use: the snapshot before stays
            self._shared.publish(self._engine.snapshot())
        self._published = estimate
