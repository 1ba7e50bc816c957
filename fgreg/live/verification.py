"""``verify`` in a live session: is the registration still valid, by new PMs that are not added to it?

Their looks are recorded as ``track`` events, which no estimate takes in, and the result as a note.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Protocol

from fgreg.camera_moves.validity import Validity, Verification, verify
from fgreg.detection.events_to_measurements import MeasurementExtractor
from fgreg.errors import FgregError
from fgreg.model.events import PairEvent
from fgreg.model.measurements import Pair
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.tracking.snapshot import Snapshot


class Worker(Protocol):
    """The part of :class:`fgreg.live.pa_worker.Locator` that is used."""

    def run(
        self,
        work: Callable[..., Verification],
        looks: Sequence[PairEvent],
        snapshot: Snapshot,
        model: SessionModel,
        config: SolveConfig,
        /,
    ) -> Future[Verification]: ...


def compared(looks: Sequence[PairEvent], snapshot: Snapshot, model: SessionModel, config: SolveConfig) -> Verification:
    """Compare new looks with the registration of the last camera epoch.

    Raises:
        FgregError: it has none.
    """
    epoch = snapshot.epochs[-1] if snapshot.epochs else None
    if epoch is None or not epoch.covariance.any():
        raise FgregError("there is no registration")
    extractor = MeasurementExtractor(model)
    found = [extractor.add(look, 0) for look in looks]
    return verify([pair for pair in found if isinstance(pair, Pair)], snapshot, epoch, model, config)


class LiveVerification:
    """Collects the looks of one verification, and has them compared in a worker process.

    Args:
        model: of the session.
        worker: does the comparison.
    """

    def __init__(self, model: SessionModel, worker: Worker) -> None:
        self._model, self._worker = model, worker
        self._looks: list[PairEvent] = []
        self._result: Future[Verification] | None = None

    def add(self, number: int, looks: Sequence[PairEvent]) -> None:
        """Add the looks at a PM; the first (``number`` 0) begins a new verification."""
        if number == 0:
            self.forget()
        self._looks += looks

    def forget(self) -> bool:
        """Give up the comparison, as the registration is no longer that one; whether one was under way."""
        under_way, self._looks, self._result = self._result is not None, [], None
        return under_way

    def compare(self, snapshot: Snapshot, config: SolveConfig) -> None:
        """Begin the comparison with a registration, with the settings that it was estimated with."""
        self._result = self._worker.run(compared, tuple(self._looks), snapshot, self._model, config)

    def result(self) -> tuple[str, Validity | None] | None:
        """A sentence with the result, once, when it is there; without a verdict where the comparison failed."""
        if self._result is None or not self._result.done():
            return None
        done, self._result = self._result, None
        try:
            found = done.result()
        except Exception as error:  # a fault of these looks; the session goes on
            return f"no verify: {error}", None
        return f"verify: {found.validity.value.upper()}: {found.reason}", found.validity
