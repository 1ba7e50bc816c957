"""The full solve: other minima, inliers, posterior, verdict, and unreported camera moves.

The incremental estimate (fgreg.smoother) is one optimum and its Gaussian. At few pairs the posterior mean differs from
the optimum, and its covariance is wider. Ambiguous minima and other conditions show only in a search without an initial
guess. All that is done by the batch solve. It runs within the engine's calls, where everything has to be deterministic
(replay, tests), or in a worker process, where no event waits for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fgreg.camera_moves.detector import CameraMove, LoopClosure, MoveCase, find_camera_move
from fgreg.camera_moves.recorded_session import likeliest_first
from fgreg.errors import EstimationError
from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import PredictedTre, Verdict
from fgreg.model.measurements import Measurements
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.tissue_surface import TissueSurface
from fgreg.registration.epoch_verdicts import EpochReport
from fgreg.registration.epochs import FinishedEpochs
from fgreg.registration.multistart import EpochSearch
from fgreg.registration.posterior import pose_tangent
from fgreg.registration.register import Registration, register
from fgreg.registration.solve import Solution, solve
from fgreg.registration.verdict import worst_first
from fgreg.smoother.initialise import Initial, initial_of
from fgreg.smoother.marginal_prior import has_moved


@dataclass(frozen=True, slots=True, eq=False)
class FullSolveCase:
    """Input of the full solve.

    Attributes:
        serial: number of this version of the measurements. epoch: the current one.
        measurements: everything that was taken in; with ``finished`` the last epoch's pairs only. None where only a
            camera move is looked for.
        known: minima of earlier epochs, which are not searched for again.
        finished: earlier epochs as a prior: only the current epoch is solved. before: what was reported of them.
        first: place of the first of the pairs in the session's order.
        move: for the camera-move test; None where none is looked for.
        detected: whether the current epoch began with a move that was detected: it may have begun at another pair.
        draft: whether to leave posterior and verdict out where the registration moved away from where ``finished`` was
            linearised: that is linearised and the case solved again.
        searched: minima of the current epoch from a draft on the same measurements; they do not depend on ``finished``.
        certify: whether to prove the registration as well, where the configuration asks for proofs.
    """

    serial: int
    epoch: int
    measurements: Measurements | None
    known: Mapping[int, EpochSearch] | None = None
    finished: FinishedEpochs | None = None
    before: tuple[EpochReport, ...] = ()
    first: int = 0
    move: MoveCase | None = None
    detected: bool = False
    draft: bool = False
    searched: EpochSearch | None = None
    certify: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """The full solve's result for the current epoch, in a form that can be applied to the estimate of later pairs.

    Attributes:
        serial: of the case. epoch: the current one then. pairs: inlier looks.
        verdict, reasons: of this epoch, and of what all epochs share.
        trus_T_camera, covariance, predicted_tre: as the solve reports them; None where it has no registration.
        shift: (6,) from the optimum to the reported registration, in units of the optimum's Gaussian (its Cholesky
            factor). root, optimum_root: (6, 6) Cholesky factors of the reported covariance and of the optimum's.
        surface: tissue surface that the PMs trace; None where they trace none, or are of the current epoch only.
        epochs: reports of all epochs.
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
    epochs: tuple[EpochReport, ...] = ()

    def applied(self, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The posterior's covariance, and the tangent from optimum to mean, for an optimum of this covariance (6, 6).

        With L_P, L_C the Cholesky factors of the reported posterior's and optimum's covariances: A C A', A = L_P / L_C.
        """
        if self.shift is None or self.root is None or self.optimum_root is None:
            return covariance, np.zeros(6)
        widen = np.linalg.solve(self.optimum_root.T, self.root.T).T
        wide = widen @ covariance @ widen.T
        return 0.5 * (wide + wide.T), np.linalg.cholesky(covariance) @ self.shift


@dataclass(frozen=True, slots=True, eq=False)
class FullSolveResult:
    """Result of a case.

    Attributes:
        serial, epoch: of the case.
        move: an unreported camera move, or a loop closure; nothing else was computed then.
        begins: place of the pair with which the current epoch begins, where it is another one; likewise.
        initial: the registration; None where there is none, for the reason ``why_none``, or none was wanted.
        report: None where none was wanted, or the case has to be solved again.
        draft: minima of the current epoch, where the case has to be solved again with ``finished`` linearised again.
        move_failure: why the camera-move test failed, empty where it did not; None where no test was wanted.
    """

    serial: int
    epoch: int
    move: CameraMove | LoopClosure | None = None
    begins: int | None = None
    initial: Initial | None = None
    why_none: str = ""
    report: Report | None = None
    draft: EpochSearch | None = None
    move_failure: str | None = None


def full_solve(
    case: FullSolveCase,
    model: SessionModel,
    config: SolveConfig,
    *,
    verdicts: bool = True,
) -> FullSolveResult:
    """Test for a camera move; where there is none, register, and compute posterior and verdict.

    ``verdicts``: False leaves posterior and verdict out.
    """
    failure = None
    if not case.certify:
        config = replace(config, certificate_budget=0)
    if case.move is not None:
        failure = ""
        try:
            move = find_camera_move(case.move, model, config)
        except Exception as error:  # the registration does not depend on it
            failure = f"{type(error).__name__}: {error}"
        else:
            if move is not None:
                return FullSolveResult(case.serial, case.epoch, move, move_failure="")
    return replace(_solved(case, model, config, verdicts=verdicts), move_failure=failure)


def _solved(
    case: FullSolveCase,
    model: SessionModel,
    config: SolveConfig,
    *,
    verdicts: bool,
) -> FullSolveResult:
    if case.measurements is None:
        return FullSolveResult(case.serial, case.epoch)
    found: Registration | None = None
    known = case.known if case.searched is None else {case.epoch: case.searched}
    try:
        found = register(case.measurements, model, config, known, case.finished)
    except EstimationError as error:
        if not verdicts:
            return FullSolveResult(case.serial, case.epoch, why_none=str(error))
    if found is not None:
        begins = other_start(case, case.measurements, found, config)
        if begins is not None:
            return FullSolveResult(case.serial, case.epoch, begins=begins)
        if not verdicts:
            return _registered(case, case.measurements, found, None)
        again = _to_be_solved_again(case, case.measurements, found)
        if again is not None:
            return again
    solution = solve(
        case.measurements,
        [],
        model,
        config,
        known=known,
        finished=case.finished,
        before=case.before,
        registration=found,
    )
    return result_of(case, case.measurements, solution)


def _to_be_solved_again(case: FullSolveCase, measurements: Measurements, found: Registration) -> FullSolveResult | None:
    """The registration alone where posterior and verdict would be of no use, because the case is solved again."""
    if case.finished is None:
        return None
    result = _registered(case, measurements, found, None)
    if result.initial is not None and result.initial.first and not result.initial.fits:
        return result
    if case.draft and has_moved(case.finished.prior, found.optimum.state, found.problem):
        return replace(result, draft=found.searches[case.epoch])
    return None


def other_start(
    case: FullSolveCase, measurements: Measurements, found: Registration, config: SolveConfig
) -> int | None:
    """The pair with which the current epoch begins, if the registrations on both sides of its start have another."""
    if not case.detected or case.finished is not None or case.epoch in found.ambiguous:
        return None
    now = min((index for index, pair in enumerate(measurements.pairs) if pair.epoch == case.epoch), default=None)
    first = likeliest_first(measurements, case.epoch, found, config)
    return None if first == now else first


def result_of(case: FullSolveCase, measurements: Measurements, solution: Solution) -> FullSolveResult:
    """The result of a case, from its batch solve."""
    report = _report(solution, case)
    if solution.registration is None:
        return FullSolveResult(case.serial, case.epoch, why_none=solution.reasons[0], report=report)
    return _registered(case, measurements, solution.registration, report)


def _registered(
    case: FullSolveCase, measurements: Measurements, found: Registration, report: Report | None
) -> FullSolveResult:
    initial = initial_of(found, measurements, case.first)
    return FullSolveResult(case.serial, case.epoch, initial=initial, report=report)


def _plain(values: FloatArray | None) -> FloatArray | None:
    """A copy in row-major order: the last digits of results depend on the memory layout."""
    return None if values is None else np.array(values, dtype=np.float64, order="C")


def _report(solution: Solution, case: FullSolveCase) -> Report:
    epoch, alone = case.epoch, case.finished is not None
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
    reasons = solution.reasons
    if solution.reports:  # what an earlier epoch lacks can no longer be mended, and is not of this registration
        here = solution.reports[epoch]
        reasons = worst_first((condition, condition.text) for condition in (*here.common, *here.conditions, *here.tied))
    return Report(
        case.serial,
        epoch,
        data.pairs,
        data.verdict,
        reasons,
        pose,
        covariance,
        data.predicted_tre,
        shift,
        root,
        optimum_root,
        None if solution.snapshot is None or alone else solution.snapshot.surface,
        solution.reports,
    )
