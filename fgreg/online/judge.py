"""The judge: the full solve, run beside the incremental estimate, and what it says in terms that carry over.

The incremental estimate is the optimum and its Gaussian. The posterior's mean is off the optimum, its covariance wider
at few pairs, and whether two minima can be told apart, or something is suspicious, takes the whole search. All that is
the full solve's (fgreg.batch.solve), some tenths of a second; its answer is adopted when it is there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from fgreg.batch import Solution, solve
from fgreg.config import SolveConfig
from fgreg.estimate import PredictedTre, Verdict
from fgreg.frames import FloatArray
from fgreg.measurements import Measurements
from fgreg.models import SessionModel
from fgreg.posterior import pose_tangent
from fgreg.registration import SoundSpeedPrior
from fgreg.surface import TissueSurface
from fgreg.workers.worker_process import Work, WorkerProcess

JUDGED_AT = (*range(1, 9), 10, 12, 15, 20, 25, 30, 40, 60, 80)
"""Pairs of an epoch at which it is judged; from there on whenever they have doubled."""


def is_due(pairs: int) -> bool:
    """Whether an epoch of so many pairs is to be judged."""
    if pairs <= JUDGED_AT[-1]:
        return pairs in JUDGED_AT
    return bool(pairs % JUDGED_AT[-1] == 0 and (pairs // JUDGED_AT[-1]).bit_count() == 1)


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """What the full solve said of the epoch that lasts.

    Attributes:
        serial: number of events that had been taken in. epoch: that was judged. pairs: looks it counted.
        verdict, reasons: of the solve.
        trus_T_camera, covariance, predicted_tre: as the solve reports them; None where it has no registration.
        shift: (6,) from the optimum to the reported registration, in units of the optimum's Gaussian (its Cholesky
            factor). inflation: (6, 6) that takes that factor to the reported covariance's.
        surface: the tissue that the PMs trace, where they trace any.
    """

    serial: int
    epoch: int
    pairs: int
    verdict: Verdict
    reasons: tuple[str, ...]
    trus_T_camera: FloatArray | None
    covariance: FloatArray | None
    predicted_tre: PredictedTre | None
    shift: FloatArray | None
    root: FloatArray | None
    optimum_root: FloatArray | None
    surface: TissueSurface | None = None

    def applied(self, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The posterior's covariance, and the tangent from optimum to mean, for an optimum of this covariance (6, 6).

        With L_P, L_C the Cholesky factors of the judged posterior's and optimum's covariances: A C A', A = L_P / L_C.
        """
        if self.shift is None or self.root is None or self.optimum_root is None:
            return covariance, np.zeros(6)
        widen = np.linalg.solve(self.optimum_root.T, self.root.T).T
        wide = widen @ covariance @ widen.T
        return 0.5 * (wide + wide.T), np.linalg.cholesky(covariance) @ self.shift


def _plain(values: FloatArray | None) -> FloatArray | None:
    """A copy laid out row by row: the last digits of what is made of it hang on that."""
    return None if values is None else np.array(values, dtype=np.float64, order="C")


def judgement_of(solution: Solution, serial: int, epoch: int) -> Judgement:
    """What carries over of a solve of all measurements up to an event."""
    data = solution.epochs[epoch]
    pose, covariance, registration = _plain(data.trus_T_camera), _plain(data.covariance), solution.registration
    shift = root = optimum_root = None
    if pose is not None and covariance is not None and registration is not None and epoch in registration.epochs:
        place = registration.epochs.index(epoch)
        block = slice(6 * place, 6 * place + 6)
        optimum_root = np.asarray(np.linalg.cholesky(registration.covariance[block, block]))
        root = np.asarray(np.linalg.cholesky(covariance))
        optimum = registration.optimum.state.trus_T_camera(place)[0]
        shift = np.asarray(np.linalg.solve(optimum_root, pose_tangent(optimum, pose)))
    return Judgement(
        serial,
        epoch,
        data.pairs,
        max(data.verdict, solution.verdict, key=lambda v: v.severity),
        solution.reasons,
        pose,
        covariance,
        data.predicted_tre,
        shift,
        root,
        optimum_root,
        None if solution.snapshot is None else solution.snapshot.surface,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """What is to be judged: all measurements up to an event, and which epoch lasts."""

    serial: int
    epoch: int
    measurements: Measurements


def judge(
    case: Case, model: SessionModel, config: SolveConfig, sound_speed: SoundSpeedPrior | None
) -> tuple[Judgement, Solution]:
    """The full solve of a case."""
    solution = solve(case.measurements, [], model, config, sound_speed_prior=sound_speed)
    return judgement_of(solution, case.serial, case.epoch), solution


class Judge(Protocol):
    """Where judgements come from.

    ``failure``: why the last case could not be judged; empty where it could. What was judged before then stands alone.
    """

    @property
    def failure(self) -> str: ...

    def forgive(self) -> None:
        """All was judged elsewhere: what failed before does not matter any more."""

    def ask(self, case: Callable[[], Case], pairs: int) -> None:
        """There is something new; ``case`` makes what is to be judged where that is wanted."""

    def answer(self) -> Judgement | None:
        """The latest judgement that has not been fetched yet."""

    def close(self) -> None:
        """Stop."""


class InlineJudge:
    """Judges at once, on a fixed schedule of pair counts: the same events give the same reports."""

    def __init__(self, model: SessionModel, config: SolveConfig, sound_speed: SoundSpeedPrior | None) -> None:
        self._of = (model, config, sound_speed)
        self._found: Judgement | None = None
        self.failure = ""

    def ask(self, case: Callable[[], Case], pairs: int) -> None:
        """Judge now where the count of pairs is one of the schedule's."""
        if not is_due(pairs):
            return
        try:
            self._found, self.failure = judge(case(), *self._of)[0], ""
        except Exception as error:  # the estimate stands without the judge
            self.failure = f"{type(error).__name__}: {error}"

    def answer(self) -> Judgement | None:
        """What :meth:`ask` found."""
        found, self._found = self._found, None
        return found

    def forgive(self) -> None:
        """The failure is of the past."""
        self.failure = ""

    def close(self) -> None:
        """Nothing to stop."""


class DeferredJudge:
    """Keeps the last case that the schedule of :class:`InlineJudge` asks for, and judges none: for catching up."""

    def __init__(self) -> None:
        self.case: Case | None = None
        self.failure = ""

    def ask(self, case: Callable[[], Case], pairs: int) -> None:
        """Keep it where it is due."""
        if is_due(pairs):
            self.case = case()

    def answer(self) -> Judgement | None:
        """Nothing yet."""
        return None

    def forgive(self) -> None:
        """The failure is of the past."""
        self.failure = ""

    def close(self) -> None:
        """Nothing to stop."""


def _judged(case: Case, model: SessionModel, config: SolveConfig, sound_speed: SoundSpeedPrior | None) -> Judgement:
    return judge(case, model, config, sound_speed)[0]


def _judging(model: SessionModel, config: SolveConfig, sound_speed: SoundSpeedPrior | None) -> Work[Case, Judgement]:
    return partial(_judged, model=model, config=config, sound_speed=sound_speed)


class ProcessJudge:
    """Judges in a worker process: when it is idle and the epoch has grown by a quarter since, or by few pairs."""

    def __init__(self, model: SessionModel, config: SolveConfig, sound_speed: SoundSpeedPrior | None) -> None:
        of = (model, config, sound_speed)
        self._worker: WorkerProcess[Case, Judgement] = WorkerProcess(
            _judging, *of, name="fgreg-judge", what="the judging process"
        )
        self._asked: tuple[int, int] = (-1, 0)

    @property
    def failure(self) -> str:
        """What went wrong with the last case."""
        return self._worker.failure

    def ask(self, case: Callable[[], Case], pairs: int) -> None:
        """Send the case where the process is idle and enough is new."""
        _, before = self._asked
        if self._worker.busy or before <= pairs < before + max(1, before // 4):
            return
        made = case()
        self._worker.send(made)
        self._asked = (made.epoch, pairs)

    def answer(self) -> Judgement | None:
        """What has come back since."""
        found = self._worker.fetch()
        return None if found is None else found[0]

    def forgive(self) -> None:
        """The failure is of the past."""
        self._worker.failure = ""

    def close(self) -> None:
        """End the process."""
        self._worker.close()
