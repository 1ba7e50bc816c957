"""The watch for untold moves: the proper test, made beside the estimate.

``inline`` makes it at once: the same events give the same epochs (tests, replay, recorded sessions). ``process`` makes
it in a process of its own, some 10 ms later; its alarm is adopted with the next event. That loses nothing, since the
pairs from the move on are given to the new epoch anyhow.
"""

from __future__ import annotations

import multiprocessing
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Protocol

from fgreg.config import SolveConfig
from fgreg.models import SessionModel
from fgreg.online.back import ReturnCase, ReturnFound, return_tests, returned_by
from fgreg.online.evidence import MoveCase, MoveFound, found_by, proper_test
from fgreg.online.moves import MoveSettings
from fgreg.online.returns import ReturnSettings, default_return_settings
from fgreg.registration import SoundSpeedPrior

Found = MoveFound | ReturnFound


@dataclass(frozen=True, slots=True)
class WatchSettings:
    """How to test: for moves, and for the camera being back where it was."""

    moves: MoveSettings = field(default_factory=MoveSettings)
    returns: ReturnSettings = field(default_factory=default_return_settings)


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """What is to be tested after a pair; a return is not asked about where the camera has just moved."""

    move: MoveCase | None
    back: ReturnCase | None


def tested(
    case: Case, model: SessionModel, config: SolveConfig, prior: SoundSpeedPrior | None, settings: WatchSettings
) -> Found | None:
    """What the tests of a case find."""
    if case.move is not None:
        found = found_by(case.move, proper_test(case.move, model, config, prior, settings.moves))
        if found is not None:
            return found
    if case.back is None:
        return None
    return returned_by(case.back, return_tests(case.back, model, config, prior, settings.returns))


class Watch(Protocol):
    """Where alarms come from.

    Attributes:
        failure: why the last case could not be tested; empty where it could.
    """

    failure: str

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


def _serve(
    connection: Connection,
    model: SessionModel,
    config: SolveConfig,
    sound_speed: SoundSpeedPrior | None,
    settings: WatchSettings,
) -> None:
    """Test what comes until the other end closes."""
    while True:
        try:
            case = connection.recv()
        except EOFError:
            return
        if case is None:
            return
        try:
            found: Found | str | None = tested(case, model, config, sound_speed, settings)
        except Exception as error:  # the test's defects must not end the watch
            found = f"{type(error).__name__}: {error}"
        try:
            connection.send(found)
        except (BrokenPipeError, OSError):
            return


class ProcessWatch:
    """Tests in a process of its own; what comes while it is busy waits, and only the latest of that is tested."""

    def __init__(
        self, model: SessionModel, config: SolveConfig, sound_speed: SoundSpeedPrior | None, settings: WatchSettings
    ) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, model, config, sound_speed, settings), name="fgreg-watch", daemon=True
        )
        self._process.start()
        theirs.close()
        self._busy = False
        self._waiting: Case | None = None
        self._stale = False
        self.failure = ""

    def ask(self, case: Case) -> None:
        """Send the case, as soon as the process is idle."""
        self._waiting = case
        if not self._busy:
            self._send()

    def _send(self) -> None:
        case, self._waiting = self._waiting, None
        if case is None:
            return
        if not self._process.is_alive():
            self.failure = "the watching process ended"
            return
        try:
            self._connection.send(case)
        except (BrokenPipeError, OSError) as error:
            self.failure = f"the watching process ended: {error}"
            return
        self._busy, self._stale = True, False

    def answer(self) -> Found | None:
        """What has come back since."""
        try:
            if not (self._busy and self._connection.poll()):
                return None
            found = self._connection.recv()
        except (EOFError, OSError) as error:
            self._busy, self.failure = False, f"the watching process ended: {error}"
            return None
        stale, self._busy = self._stale, False
        self._send()
        self.failure = found if isinstance(found, str) else ""
        return found if isinstance(found, Found) and not stale else None

    def forget(self) -> None:
        """What waits goes; an answer that is under way will not count."""
        self._waiting, self._stale = None, self._busy

    def close(self) -> None:
        """End the process."""
        with suppress(OSError):
            self._connection.send(None)
        self._connection.close()
        self._process.join(timeout=0.5)
        if self._process.is_alive():
            self._process.terminate()
            self._process.join()
