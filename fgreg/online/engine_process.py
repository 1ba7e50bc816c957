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
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any

from fgreg.config import SolveConfig
from fgreg.errors import EventRefused, FgregError
from fgreg.estimate import TrackEstimate
from fgreg.frames import FloatArray
from fgreg.measurements import Measurements, Track
from fgreg.models import SessionModel
from fgreg.online.engine import OnlineRegistration
from fgreg.online.estimate import OnlineEstimate
from fgreg.online.events import DetectedMove, DetectedReturn, OnlineEvent
from fgreg.online.numbers import Numbers, Sink, Source
from fgreg.online.queries import Layout
from fgreg.online.shared_snapshot import NoSnapshotError, SharedSnapshot, SnapshotReader
from fgreg.registration import SoundSpeedPrior
from fgreg.tracking import track
from fgreg.workers.worker_process import NICENESS

START_S = 60.0
IDLE_S = 0.1
"""Between looks at what the judge has found, while no event comes."""


GONE = "the registration's process has ended: open the session again"


class EngineGone(FgregError):  # noqa: N818
    """The registration's process has ended; what is on disk is all there."""


class EngineProcess:
    """The engine as :class:`fgreg.live.LiveSession` takes it. Use it as a context manager, or close it.

    Calls wait for the process; they may come from several threads, one after another.

    Raises:
        EngineGone: the process did not start.
    """

    def __init__(self, model: SessionModel, config: SolveConfig, sound_speed_prior: SoundSpeedPrior | None) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._writing, their_writing = context.Pipe()
        # Not a daemon: it has children of its own. It ends when this end of the pipe is closed, by whatever.
        self._process = context.Process(
            target=_serve,
            args=(theirs, their_writing, model, config, sound_speed_prior),
            name="fgreg-engine",
            daemon=False,
        )
        self._turn, self._writing_turn = threading.Lock(), threading.Lock()
        self._rest: int | None = None
        self._estimate: OnlineEstimate | None = None
        self._moves: tuple[DetectedMove, ...] = ()
        self._returns: tuple[DetectedReturn, ...] = ()
        self._process.start()
        theirs.close()
        their_writing.close()
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
                how, value, self._estimate, self._moves, self._returns, self._rest = self._connection.recv()
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
    def catching_up(self) -> Iterator[None]:
        """As of the engine: judged once at the end. Raises EngineGone."""
        self._call("catch up")
        try:
            yield
        finally:
            self._call("caught up")

    def rest(self) -> Callable[[Sink], None] | None:
        """As :meth:`fgreg.online.engine.OnlineRegistration.rest`, where the last call was an event that ended with one.

        It is written down beside the events, by a thread of the process; what writes it raises EngineGone, and
        RuntimeError where a later rest has taken its place.
        """
        return None if self._rest is None else partial(self._write, self._rest)

    def _write(self, number: int, sink: Sink) -> None:
        with self._writing_turn:
            try:
                self._writing.send(number)
                found = self._writing.recv()
            except (EOFError, OSError):
                raise EngineGone(GONE) from None
        if not isinstance(found, Numbers):
            raise RuntimeError(found)
        sink.append(found)

    def resume(self, source: Source) -> OnlineEstimate:
        """As :meth:`fgreg.online.engine.OnlineRegistration.resume`. Raises ValueError, EngineGone."""
        try:
            return self._known(self._call("resume", source.rest()))
        except EngineGone:
            raise
        except FgregError as error:
            raise ValueError(str(error)) from None

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
        for connection in (self._connection, self._writing):
            with suppress(OSError):
                connection.close()
        self._process.join(5.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _serve(
    connection: Connection[Any, Any],
    writing: Connection[Any, Any],
    model: SessionModel,
    config: SolveConfig,
    prior: SoundSpeedPrior | None,
) -> None:
    """The process."""
    os.nice(NICENESS)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main program ends it, in its own time
    with (
        OnlineRegistration(model, config, judge="process", watch="process", sound_speed_prior=prior) as engine,
        SharedSnapshot(Layout.of(model)) as shared,
        suppress(EOFError, OSError),
    ):
        rests = _Rests(writing)
        connection.send(shared.name)
        _Server(connection, engine, shared, rests).run()
    os._exit(0)  # there is nothing to save, and nobody to wait for


class _Rests:
    """Writes rests down in a thread of its own, the latest only: events do not wait for it."""

    def __init__(self, connection: Connection[Any, Any]) -> None:
        self._connection = connection
        self._latest: tuple[int, Callable[[Sink], None] | None] = (0, None)
        threading.Thread(target=self._run, name="rests", daemon=True).start()

    def keep(self, write: Callable[[Sink], None]) -> int:
        """Keep a rest; its number."""
        self._latest = (self._latest[0] + 1, write)
        return self._latest[0]

    def _run(self) -> None:
        with suppress(EOFError, OSError):
            while True:
                wanted = self._connection.recv()
                self._connection.send(self._written(wanted))

    def _written(self, wanted: int) -> Numbers | str:
        number, write = self._latest
        if number != wanted or write is None:
            return "a later rest has taken its place"
        sink = Sink()
        try:
            write(sink)
        except Exception as error:  # the session does without
            return f"{type(error).__name__}: {error}"
        return sink.numbers()


class _Server:
    def __init__(
        self, connection: Connection[Any, Any], engine: OnlineRegistration, shared: SharedSnapshot, rests: _Rests
    ) -> None:
        self._connection, self._engine, self._shared, self._rests = connection, engine, shared, rests
        self._published: OnlineEstimate | None = None
        self._catching_up: Any = None

    def run(self) -> None:
        """Until the other end closes."""
        self._publish()
        while True:
            if not self._connection.poll(IDLE_S):
                if self._catching_up is None:
                    self._engine.refresh()
                self._publish()
                continue
            name, arguments = self._connection.recv()
            rest = None
            try:
                answer = ("done", self._do(name, arguments))
                if name == "add" and (write := self._engine.rest()) is not None:
                    rest = self._rests.keep(write)
            except EventRefused as error:
                answer = ("refused", error.reason)
            except Exception as error:  # a defect: the estimate stands, and the caller is told
                answer = ("failed", f"{type(error).__name__}: {error}")
            self._publish()
            self._connection.send((*answer, self._engine.estimate, self._engine.moves, self._engine.returns, rest))

    def _do(self, name: str, arguments: tuple[Any, ...]) -> Any:
        engine = self._engine
        match name:
            case "add":
                return engine.add(*arguments)
            case "settle":
                return engine.settle()
            case "refresh":
                return engine.refresh()
            case "resume":
                return engine.resume(Source(*arguments))
            case "measurements":
                return engine.measurements()
            case "marker_T_laser":
                return engine.marker_T_laser()
            case "catch up":
                self._catching_up = engine.catching_up()
                self._catching_up.__enter__()
                return None
            case "caught up":
                ending, self._catching_up = self._catching_up, None
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
