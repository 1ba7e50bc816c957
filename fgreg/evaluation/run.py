"""Evaluate sessions: all solves, over all cores, in a fixed order.

The results do not depend on the number of processes: tasks are listed first, with subsets drawn by seed, and results
are returned in that order.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from fgreg.evaluation.case import Case, EvaluationConfig, curve_sizes, folds_of, left_out_one_by_one, subsets_of
from fgreg.evaluation.resolve import Resolved, resolve
from fgreg.geometry.target_error import beam_error, tre_mm
from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import PredictedTre, Verdict
from fgreg.model.sensitivity import wrap_angle
from fgreg.registration.influence import Influence, influences
from fgreg.registration.solve import solve
from fgreg.registration.verdict import Condition
from fgreg.workers.parent import end_with_parent
from fgreg.workers.threads import one_thread_each

Progress = Callable[[str, int, int], None]
"""Called with (name of the step, items done, total items)."""
STEP = "evaluating"


@dataclass(frozen=True, slots=True, eq=False)
class WholeSolve:
    """The solve of all measurements, and its errors where the truth is known.

    Attributes:
        verdict, reasons: of the session.
        trus_T_camera: (4, 4) of each epoch, None where not solved.
        epoch_pms: number of PMs of each epoch.
        predicted: TRE predicted by the posterior, per epoch.
        tre_mm: errors (n,) at the targets, per epoch. bound_mm: their predicted 95 % bounds (n,), per epoch.
        beam_angle_rad, beam_offset_mm: of the laser line.
        track_error_rad, track_sigma_rad: result less truth, and its predicted sigma, per track; None where unknown.
        influence: of every PM used.
    """

    verdict: Verdict
    reasons: tuple[str, ...]
    trus_T_camera: tuple[FloatArray | None, ...]
    epoch_pms: tuple[int, ...]
    predicted: tuple[PredictedTre | None, ...]
    tre_mm: tuple[FloatArray | None, ...]
    bound_mm: tuple[FloatArray | None, ...]
    beam_angle_rad: float | None
    beam_offset_mm: float | None
    track_error_rad: tuple[float | None, ...]
    track_sigma_rad: tuple[float | None, ...]
    influence: tuple[Influence, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SizedSolves:
    """The solves of the curve from ``pairs`` pairs."""

    pairs: int
    solves: tuple[Resolved, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SessionEvaluation:
    """The evaluation of one session.

    Attributes:
        name: of the session. whole: the solve of all measurements.
        leave_one_out, k_fold: solves without one PM, and without one fold of them.
        curve: solves from fewer PMs of ``curve_epoch``, by size.
    """

    name: str
    whole: WholeSolve
    leave_one_out: tuple[Resolved, ...]
    k_fold: tuple[Resolved, ...]
    curve: tuple[SizedSolves, ...]
    curve_epoch: int


@dataclass(frozen=True, slots=True)
class _Task:
    """One solve from the PMs ``kept``, or from all measurements where None; ``held``: PMs to predict."""

    case: int
    kept: tuple[int, ...] | None
    held: tuple[int, ...] = ()


@dataclass(slots=True, eq=False)
class _Work:
    """Shared input of the tasks, set once when a worker process starts."""

    cases: Sequence[Case] = ()
    conditions: Sequence[Sequence[Condition]] = ()
    config: EvaluationConfig = field(default_factory=EvaluationConfig)


_work = _Work()


def _load(cases: Sequence[Case], conditions: Sequence[Sequence[Condition]], config: EvaluationConfig) -> None:
    _work.cases, _work.conditions, _work.config = cases, conditions, config


def _begin(cases: Sequence[Case], conditions: Sequence[Sequence[Condition]], config: EvaluationConfig) -> None:
    """Start of a worker process."""
    end_with_parent()
    _load(cases, conditions, config)


def _run(task: _Task) -> WholeSolve | Resolved:
    case = _work.cases[task.case]
    if task.kept is None:
        return solve_whole(case, _work.config, _work.conditions[task.case] if _work.conditions else ())
    return resolve(case, task.kept, _work.config, task.held)


def solve_whole(case: Case, config: EvaluationConfig, conditions: Sequence[Condition] = ()) -> WholeSolve:
    """Solve a session from all its measurements and compare with the truth where there is one."""
    model, truth = case.model, case.truth
    solution = solve(case.measurements, case.tracks, model, config.solve, conditions)
    errors: list[FloatArray | None] = []
    for epoch in solution.epochs:
        known = truth is not None and epoch.index < len(truth.trus_T_camera)
        errors.append(
            tre_mm(epoch.trus_T_camera, truth.trus_T_camera[epoch.index], model.targets_mm)
            if truth is not None and known and epoch.trus_T_camera is not None
            else None
        )
    angle = offset = None
    if truth is not None and truth.marker_T_laser is not None and solution.laser is not None:
        angle, offset = beam_error(solution.laser.marker_T_laser, truth.marker_T_laser)
    stages = truth.track_stage_rad if truth is not None else ()
    track_error: list[float | None] = []
    for index, answer in enumerate(solution.tracks):
        right = stages[index] if index < len(stages) else None
        found = answer.stage_rad
        track_error.append(None if right is None or found is None else float(wrap_angle(found - right)))
    means = {epoch.index: tre.mean_mm for epoch in solution.epochs if (tre := epoch.predicted_tre) is not None}
    return WholeSolve(
        verdict=solution.verdict,
        reasons=solution.reasons,
        trus_T_camera=tuple(epoch.trus_T_camera for epoch in solution.epochs),
        epoch_pms=tuple(len(case.pms_of_epoch(epoch.index)) for epoch in solution.epochs),
        predicted=tuple(epoch.predicted_tre for epoch in solution.epochs),
        tre_mm=tuple(errors),
        bound_mm=tuple(np.array([t.p95_mm for t in e.targets]) if e.targets else None for e in solution.epochs),
        beam_angle_rad=angle,
        beam_offset_mm=offset,
        track_error_rad=tuple(track_error),
        track_sigma_rad=tuple(answer.sigma_rad for answer in solution.tracks),
        influence=() if solution.registration is None else influences(solution.registration, model.targets_mm, means),
    )


def _tasks(index: int, case: Case, config: EvaluationConfig) -> list[tuple[str, int, _Task]]:
    """(kind, size, task) of all solves for one case, in order."""
    pms = case.pms
    out: list[tuple[str, int, _Task]] = [("whole", 0, _Task(index, None))]

    def without(held: tuple[int, ...]) -> _Task:
        return _Task(index, tuple(pm for pm in pms if pm not in held), held)

    if config.leave_one_out and len(pms) > 3:
        out += [("one", 0, without(held)) for held in left_out_one_by_one(case, config.most_left_out)]
    if config.folds and len(pms) > config.folds:
        out += [("fold", 0, without(held)) for held in folds_of(case, config.folds, config.seed)]
    if config.curve:
        mine = case.pms_of_epoch(case.largest_epoch)
        for size in curve_sizes(len(mine), config):
            for kept in subsets_of(mine, size, config.subsets, config.seed):
                out.append(("curve", size, _Task(index, kept, tuple(pm for pm in mine if pm not in kept))))
    return out


def evaluate(
    cases: Sequence[Case],
    config: EvaluationConfig | None = None,
    *,
    jobs: int = 1,
    progress: Progress | None = None,
    conditions: Sequence[Sequence[Condition]] = (),
) -> tuple[SessionEvaluation, ...]:
    """Evaluate sessions.

    Args:
        cases: the sessions.
        config: what to compute.
        jobs: number of processes; 1 uses this one. More require an importable main script (guard its main).
        progress: called after each solve.
        conditions: conditions of each case's verdict from its detection.
    """
    config = config or EvaluationConfig()
    listed = [_tasks(index, case, config) for index, case in enumerate(cases)]
    tasks = [task for of_case in listed for _, _, task in of_case]
    results: list[WholeSolve | Resolved] = []
    for result in _results(tasks, cases, conditions, config, jobs):
        results.append(result)
        if progress is not None:
            progress(STEP, len(results), len(tasks))
    out = []
    place = 0
    for case, of_case in zip(cases, listed, strict=True):
        mine = list(zip(of_case, results[place : place + len(of_case)], strict=True))
        place += len(of_case)
        out.append(_gather(case, mine))
    return tuple(out)


def _gather(case: Case, results: list[tuple[tuple[str, int, _Task], WholeSolve | Resolved]]) -> SessionEvaluation:
    whole = next(result for _, result in results if isinstance(result, WholeSolve))
    resolved = [(kind, size, result) for (kind, size, _), result in results if isinstance(result, Resolved)]
    sizes = dict.fromkeys(size for kind, size, _ in resolved if kind == "curve")
    return SessionEvaluation(
        name=case.name,
        whole=whole,
        leave_one_out=tuple(result for kind, _, result in resolved if kind == "one"),
        k_fold=tuple(result for kind, _, result in resolved if kind == "fold"),
        curve=tuple(
            SizedSolves(size, tuple(result for kind, of, result in resolved if kind == "curve" and of == size))
            for size in sizes
        ),
        curve_epoch=case.largest_epoch,
    )


def _results(
    tasks: Sequence[_Task],
    cases: Sequence[Case],
    conditions: Sequence[Sequence[Condition]],
    config: EvaluationConfig,
    jobs: int,
) -> Iterator[WholeSolve | Resolved]:
    """Results in the order of the tasks."""
    jobs = min(jobs, len(tasks))
    if jobs <= 1:
        _load(cases, conditions, config)
        try:
            yield from map(_run, tasks)
        finally:
            _load((), (), EvaluationConfig())
        return
    # spawn: a fork would inherit the threads of the linear algebra libraries in an undefined state.
    context = multiprocessing.get_context("spawn")
    with one_thread_each(), ProcessPoolExecutor(jobs, context, _begin, (cases, conditions, config)) as pool:
        try:
            yield from pool.map(_run, tasks, chunksize=max(1, min(8, len(tasks) // (4 * jobs))))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
