"""Checkpoints of a session that is recorded: written beside it while it goes on, taken up when it is opened again.

A checkpoint is written in a thread of its own, the latest only: neither an event nor a query waits for it. One that
does not fit the session to the last byte is left aside.
"""

from __future__ import annotations

import hashlib
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from threading import Lock, Thread
from typing import Protocol, runtime_checkable

import numpy as np

from fgreg.config import SolveConfig
from fgreg.detection.noise import Misfit
from fgreg.errors import FgregError
from fgreg.events import AimEvent, Event, MarkerRecord, PairEvent, refused_lines
from fgreg.measurements import Measurements
from fgreg.models import SessionModel
from fgreg.online.numbers import Numbers, Sink, Source
from fgreg.online.rest import CONSTANTS
from fgreg.recognition import EventRecogniser, Recollection
from fgreg.session.checkpoint_file import (
    CHECKPOINT_FILE,
    Checkpoint,
    NoCheckpointError,
    read_checkpoint,
    stands_for,
    sweep_up,
    write_checkpoint,
)
from fgreg.session.reading import EVENTS_FILE, SETUP_FILE
from fgreg.version import __version__

INT64 = 2**63


@runtime_checkable
class Resumable(Protocol):
    """An engine that can be taken up again."""

    def rest(self) -> Callable[[Sink], None] | None:
        """What writes down the engine as it is now, at any later time; None where it cannot be taken up from here."""

    def resume(self, source: Source) -> object:
        """Go on from what was written, all that is left in the source; raises where it cannot."""

    def measurements(self) -> Measurements:
        """All that was taken in."""


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """A session after an event, as far as it goes into a checkpoint.

    Attributes:
        engine: writes it down.
        line: of the event. epoch, noticed: of the feed.
        recollection: of the recogniser.
        taken: lines of the events that are measurements in the engine; the first ``count`` of them.
    """

    engine: Callable[[Sink], None]
    line: int
    epoch: int
    noticed: int
    recollection: Recollection
    taken: array[int]
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class Resumed:
    """Where a session goes on: as in :class:`Moment`."""

    line: int
    epoch: int
    noticed: int
    recogniser: EventRecogniser
    taken: array[int]


class Checkpoints:
    """A session's checkpoints.

    Attributes:
        note: why none was taken up when the session was opened; empty where one was.
        trouble: why the last one was not written; empty where it was.
        spent: whether the engine that :meth:`resume` was given has tried in vain, and another one is needed.
    """

    def __init__(self, folder: Path, config: SolveConfig) -> None:
        self._folder, self._path = folder, folder / CHECKPOINT_FILE
        # Whatever the numbers depend on: others make them useless, and nobody would see it.
        made_by = (__version__, np.__version__, version("gtsam"), CONSTANTS, config)
        self._made_by = hashlib.sha256(repr(made_by).encode()).hexdigest()
        self.note = self.trouble = ""
        self.spent = False
        self._next: Moment | None = None
        self._thread: Thread | None = None
        self._lock = Lock()

    # --- writing ----------------------------------------------------------------------------------------------------

    def offer(self, moment: Moment) -> None:
        """Write a checkpoint of this moment, unless a later one comes before its turn."""
        with self._lock:
            self._next = moment
            if self._thread is None:
                self._thread = Thread(target=self._write_all, name="fgreg-checkpoint", daemon=True)
                self._thread.start()

    def close(self) -> None:
        """Wait until the last one is written."""
        thread = self._thread
        if thread is not None:
            thread.join()

    def _write_all(self) -> None:
        while True:
            with self._lock:
                moment, self._next = self._next, None
                if moment is None:
                    self._thread = None
                    return
            try:
                self._write(moment)
                self.trouble = ""
            except Exception as error:  # the session does without
                self.trouble = f"no checkpoint was written: {error}"

    def _write(self, moment: Moment) -> None:
        sink = Sink()
        sink.integers(moment.epoch, moment.noticed, moment.recollection.next_id, moment.count)
        sink.integer_array(np.array(moment.taken[: moment.count], dtype=np.int64))
        for misfits in (moment.recollection.markers, moment.recollection.boards):
            sink.integers(len(misfits))
            sink.integer_array(np.array([misfit.dof for misfit in misfits], dtype=np.int64))
            sink.array(np.array([misfit.cost for misfit in misfits]))
        moment.engine(sink)
        numbers = sink.numbers()
        events, setup = self._folder / EVENTS_FILE, self._folder / SETUP_FILE
        of = stands_for(events, setup, moment.line, self._made_by)
        write_checkpoint(self._path, Checkpoint(of, numbers.integers, numbers.floats, numbers.texts))

    # --- reading ----------------------------------------------------------------------------------------------------

    def resume(self, events: Sequence[Event], model: SessionModel, engine: Resumable) -> Resumed | None:
        """Take up the engine where the checkpoint has it; None where there is none to use.

        Args:
            events: all that are recorded.
            model: the session's set-up.
            engine: that has taken in nothing yet.
        """
        sweep_up(self._path)
        self.spent, self.note = False, ""
        try:
            found = read_checkpoint(self._path, len(events))
            of = found.of
            if of.lines > len(events):
                raise NoCheckpointError("it is of more events than there are")
            if of != stands_for(self._folder / EVENTS_FILE, self._folder / SETUP_FILE, of.lines, self._made_by):
                raise NoCheckpointError("it is of other events, another session.yaml or another program")
            if any(line <= of.lines < event.line for event in events for line in refused_lines([event])):
                raise NoCheckpointError("an event that it holds was refused since")
            self.spent = True  # as long as it has not succeeded
            resumed = _resumed(found, events, model, engine)
            self.spent = False
            return resumed
        except (
            NoCheckpointError,
            FgregError,
            ValueError,
            ArithmeticError,
            LookupError,
            RuntimeError,
            OSError,
            MemoryError,
        ) as error:
            self.note = f"the checkpoint was not used: {error}"
            return None


def _resumed(found: Checkpoint, events: Sequence[Event], model: SessionModel, engine: Resumable) -> Resumed:
    source = Source(Numbers(found.integers, found.floats, found.texts))
    most = found.of.lines
    epoch, noticed = source.integer(0, most), source.integer(0, most)
    next_id, count = source.integer(0, INT64 - 1), source.integer(0, most)
    taken = source.integer_array(count)
    if count and (taken[0] < 1 or taken[-1] > most or (np.diff(taken) <= 0).any()):
        raise ValueError("lines that are not there")
    recollection = Recollection(_misfits(source, most), _misfits(source, most), next_id)
    aims: list[MarkerRecord] = []
    pairs: list[MarkerRecord] = []
    for line in taken.tolist():
        event = events[line - 1]
        if not isinstance(event, AimEvent | PairEvent) or event.line != line:
            raise ValueError("lines of other events")
        (aims if isinstance(event, AimEvent) else pairs).append(event.marker)
    engine.resume(source)
    measurements = engine.measurements()
    if len(measurements.aims) != len(aims):
        raise ValueError("not as many aims as their events")
    ids = [aim.marker.id for aim in measurements.aims] + [pair.marker.id for pair in measurements.pairs]
    recogniser = EventRecogniser(model)
    recogniser.recollect(zip([*aims, *pairs], ids, strict=True), recollection)
    return Resumed(most, epoch, noticed, recogniser, array("q", taken.tolist()))


def _misfits(source: Source, most: int) -> tuple[Misfit, ...]:
    count = source.integer(0, most)
    dof, cost = source.integer_array(count), source.array(count)
    if (dof < 0).any() or (cost < 0.0).any():
        raise ValueError("a misfit below zero")
    return tuple(Misfit(c, d) for c, d in zip(cost.tolist(), dof.tolist(), strict=True))
