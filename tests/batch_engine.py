"""An engine that registers from scratch at every fifth pair of an epoch; it can refuse events and detect moves."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

from fgreg.camera_moves.found import DetectedLoopClosure, DetectedMove
from fgreg.errors import EstimationError, EventRefused
from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import TrackEstimate, Verdict
from fgreg.model.measurements import Aim, EpochStart, Measurements, Pair, Track
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.estimate import OnlineEstimate
from fgreg.online.events import CameraMoved, OnlineEvent
from fgreg.registration.register import register
from fgreg.registration.solve import Solution, solve


class BatchEngine:
    """Attributes:
    refuse_t: times of events that it refuses once. notice: by the time of a pair at which it detects a camera move,
    the time of that move.
    """

    def __init__(self, model: SessionModel, config: SolveConfig) -> None:
        self.model, self.config = model, config
        self.all = Measurements((), (), (EpochStart(0.0),))
        self.estimate: OnlineEstimate | None = None
        self.refuse_t: set[float] = set()
        self.notice: dict[float, float] = {}

    @property
    def moves(self) -> tuple[DetectedMove, ...]:
        return ()  # its detected moves appear as epochs only

    @property
    def loop_closures(self) -> tuple[DetectedLoopClosure, ...]:
        return ()

    def add(self, event: OnlineEvent) -> OnlineEstimate:
        if event.t in self.refuse_t:
            self.refuse_t.remove(event.t)
            raise EventRefused("an indeterminate system")
        before = self.all
        match event:
            case Aim():
                self.all = replace(before, aims=(*before.aims, event))
            case Pair():
                if event.epoch != len(before.epochs) - 1:
                    raise AssertionError("a pair in another epoch than the present one")
                self.all = replace(before, pairs=(*before.pairs, event))
                if event.t in self.notice:
                    self._move(CameraMoved(event.t, detected=True, since_t=self.notice[event.t]))
            case CameraMoved():
                self._move(event)
            case _:
                raise AssertionError("not an event of a session")
        self.estimate = found = self._estimate(event)
        return found

    def snapshot(self) -> None:
        """None: constants as declared."""

    def refresh(self) -> OnlineEstimate:
        if self.estimate is None:
            raise AssertionError("nothing is known yet")
        return self.estimate

    def _move(self, moved: CameraMoved) -> None:
        since, epoch = moved.t if moved.since_t is None else moved.since_t, len(self.all.epochs)
        pairs = tuple(replace(p, epoch=epoch) if moved.detected and p.t >= since else p for p in self.all.pairs)
        start = EpochStart(since, moved.camera_new_T_camera_old, moved.covariance)
        self.all = replace(self.all, pairs=pairs, epochs=(*self.all.epochs, start))

    def _estimate(self, event: OnlineEvent) -> OnlineEstimate:
        epoch = len(self.all.epochs) - 1
        count = sum(pair.epoch == epoch for pair in self.all.pairs)
        before = self.estimate
        lasts = before is not None and before.epoch == epoch
        transform = before.trus_T_camera if before is not None and lasts else None
        covariance = before.covariance if before is not None and lasts else None
        if isinstance(event, Pair) and count % 5 == 0:
            try:
                found = register(self.all, self.model, self.config)
                if epoch in found.epochs:
                    place = found.epochs.index(epoch)
                    transform = found.optimum.state.trus_T_camera(place)[0]
                    covariance = found.covariance[6 * place : 6 * place + 6, 6 * place : 6 * place + 6]
            except EstimationError:
                pass
        verdict = Verdict.REFUSED if transform is None else Verdict.WARNING
        used = isinstance(event, Pair)
        return OnlineEstimate(
            event.t, epoch, transform, covariance, None, None, used, verdict, (), count, transform, False
        )

    def track(self, query: Track) -> TrackEstimate:
        return replace(solve(self.all, (query,), self.model, self.config).tracks[0], causal=True)

    def settle(self) -> OnlineEstimate:
        epoch = self.solution().epochs[-1]
        return OnlineEstimate(
            self.all.pairs[-1].t if self.all.pairs else 0.0,
            epoch.index,
            epoch.trus_T_camera,
            epoch.covariance,
            epoch.predicted_tre,
            None,
            True,
            epoch.verdict,
            (),
            epoch.pairs,
            None,
            True,
        )

    def restoring(self) -> AbstractContextManager[None]:
        return nullcontext()

    def marker_T_laser(self) -> FloatArray | None:
        laser = self.solution().laser
        return None if laser is None else laser.marker_T_laser

    def solution(self) -> Solution:
        return solve(self.all, (), self.model, self.config)

    def starts(self) -> tuple[EpochStart, ...]:
        return self.measurements().epochs

    def measurements(self) -> Measurements:
        return self.all
