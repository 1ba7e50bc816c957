"""The camera-move detector beside the estimate.

``inline`` makes it at once: the same events give the same epochs (tests, replay, recorded sessions). ``process`` makes
it in a process of its own, some 10 ms later; its alarm is adopted with the next event. That loses nothing, since the
pairs from the move on are given to the new epoch anyhow.
"""

from __future__ import annotations

from functools import partial
from typing import Protocol

from fgreg.camera_moves.detector import CameraMove, LoopClosure, MoveCase, find_camera_move
from fgreg.config import SolveConfig
from fgreg.models import SessionModel
from fgreg.registration import SoundSpeedPrior
from fgreg.workers.worker_process import Work, WorkerProcess

Found = CameraMove | LoopClosure


class Watch(Protocol):
    """Where alarms come from.

    ``failure``: why the last case could not be tested; empty where it could.
    """

    @property
    def failure(self) -> str: ...

    def ask(self, case: MoveCase) -> None:
        """Here is something to be tested."""

    def answer(self) -> Found | None:
        """The latest alarm that has not been fetched yet."""

    def forget(self) -> None:
        """Another epoch has begun: nothing that was asked before counts any more."""

    def close(self) -> None:
        """Stop."""


class InlineWatch:
    """Tests at once."""

    def __init__(self, model: SessionModel, config: SolveConfig, sound_speed: SoundSpeedPrior | None) -> None:
        self._of = (model, config, sound_speed)
        self._found: Found | None = None
        self.failure = ""

    def ask(self, case: MoveCase) -> None:
        """Test now."""
        try:
            self._found, self.failure = find_camera_move(case, *self._of), ""
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


def _testing(model: SessionModel, config: SolveConfig, prior: SoundSpeedPrior | None) -> Work[MoveCase, Found | None]:
    return partial(find_camera_move, model=model, config=config, sound_speed_prior=prior)


class ProcessWatch:
    """Tests in a worker process; what comes while it is busy waits, and only the latest of that is tested."""

    def __init__(self, model: SessionModel, config: SolveConfig, sound_speed: SoundSpeedPrior | None) -> None:
        of = (model, config, sound_speed)
        self._worker: WorkerProcess[MoveCase, Found | None] = WorkerProcess(
            _testing, *of, name="fgreg-watch", what="the watching process"
        )
        self._waiting: MoveCase | None = None
        self._stale = False

    @property
    def failure(self) -> str:
        """Why the last case could not be tested."""
        return self._worker.failure

    def ask(self, case: MoveCase) -> None:
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
