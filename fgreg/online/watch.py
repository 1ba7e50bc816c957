"""The watch for untold moves: the proper test, made beside the estimate.

``inline`` makes it at once: the same events give the same epochs (tests, replay, recorded sessions). ``process`` makes
it in a process of its own, some 10 ms later; its alarm is adopted with the next event. That loses nothing, since the
pairs from the move on are given to the new epoch anyhow.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

from fgreg.camera_moves.bayes_filter import MoveSettings
from fgreg.camera_moves.loop_closure import ReturnSettings, default_return_settings
from fgreg.config import SolveConfig
from fgreg.models import SessionModel
from fgreg.online.back import ReturnCase, ReturnFound, return_tests, returned_by
from fgreg.online.early import EarlyCase, early_test
from fgreg.online.evidence import MoveCase, MoveFound, found_by, proper_test, tested_last
from fgreg.registration import SoundSpeedPrior
from fgreg.workers.worker_process import Work, WorkerProcess

Found = MoveFound | ReturnFound


@dataclass(frozen=True, slots=True)
class WatchSettings:
    """How to test: for moves, and for the camera being back where it was."""

    moves: MoveSettings = field(default_factory=MoveSettings)
    returns: ReturnSettings = field(default_factory=default_return_settings)


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """What is to be tested after a pair of an epoch; a return is not asked about where the camera has just moved."""

    epoch: int
    move: MoveCase | None
    early: EarlyCase | None
    back: ReturnCase | None


def tested(
    case: Case, model: SessionModel, config: SolveConfig, prior: SoundSpeedPrior | None, settings: WatchSettings
) -> Found | None:
    """What the tests of a case find."""
    of = (model, config, prior, settings.moves)
    last = None if case.move is None else tested_last(case.move, proper_test(case.move, *of))
    first = None if case.early is None else early_test(case.early, *of)
    found = found_by(case.epoch, [test for test in (first, last) if test is not None], settings.moves.threshold)
    if found is not None:
        return found
    if case.back is None:
        return None
    return returned_by(case.back, return_tests(case.back, model, config, prior, settings.returns))


class Watch(Protocol):
    """Where alarms come from.

    ``failure``: why the last case could not be tested; empty where it could.
    """

    @property
    def failure(self) -> str: ...

    def ask(self, case: Case) -> None:
        """Here is something to be tested."""

    def answer(self) -> Found | None:
        """The latest alarm that has not been fetched yet."""

    def forget(self) -> None:
        """Another epoch has begun: nothing that was asked before counts any more."""

    def close(self) -> None:
        """Stop."""


class InlineWatch:
    """Tests at once."""

    def __init__(
        self, model: SessionModel, config: SolveConfig, sound_speed: SoundSpeedPrior | None, settings: WatchSettings
    ) -> None:
        self._of = (model, config, sound_speed, settings)
        self._found: Found | None = None
        self.failure = ""

    def ask(self, case: Case) -> None:
        """Test now."""
        try:
            self._found, self.failure = tested(case, *self._of), ""
        except Exception as error:  # the estimate stands without the test
            self.failure = f"{type(error).__name__}: {error}"

    def answer(self) -> Found | None:
        """What :meth:`ask` found."""
        found, self._found = self._found, None
        return found

    def forget(self) -> None:
        """Nothing waits."""
        self._found = None

    def close(self) -> None:
        """Nothing to stop."""


def _testing(
    model: SessionModel, config: SolveConfig, prior: SoundSpeedPrior | None, settings: WatchSettings
) -> Work[Case, Found | None]:
    return partial(tested, model=model, config=config, prior=prior, settings=settings)


class ProcessWatch:
    """Tests in a worker process; what comes while it is busy waits, and only the latest of that is tested."""

    def __init__(
        self, model: SessionModel, config: SolveConfig, sound_speed: SoundSpeedPrior | None, settings: WatchSettings
    ) -> None:
        of = (model, config, sound_speed, settings)
        self._worker: WorkerProcess[Case, Found | None] = WorkerProcess(
            _testing, *of, name="fgreg-watch", what="the watching process"
        )
        self._waiting: Case | None = None
        self._stale = False

    @property
    def failure(self) -> str:
        """Why the last case could not be tested."""
        return self._worker.failure

    def ask(self, case: Case) -> None:
        """Send the case, as soon as the process is idle."""
        self._waiting = case
        if not self._worker.busy:
            self._send()

    def _send(self) -> None:
        case, self._waiting = self._waiting, None
        if case is not None:
            self._worker.send(case)
            self._stale = False

    def answer(self) -> Found | None:
        """What has come back since."""
        found, stale = self._worker.fetch(), self._stale
        if found is None:
            return None
        self._send()
        return None if stale else found[0]

    def forget(self) -> None:
        """What waits goes; an answer that is under way will not count."""
        self._waiting, self._stale = None, self._worker.busy

    def close(self) -> None:
        """End the process."""
        self._worker.close()
