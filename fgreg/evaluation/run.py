"""Evaluate sessions: all solves, on any executor, in a fixed order.

The results do not depend on where they are computed: tasks are listed first, with subsets drawn by seed, and results
are returned in that order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

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
from fgreg.workers.tasks import Executor, run_tasks

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


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    """One solve from the PMs ``kept``, or from all measurements where None; ``held``: PMs to predict."""

    case: Case
    conditions: Sequence[Condition]
    kept: tuple[int, ...] | None
    held: tuple[int, ...] = ()


def _run(task: _Task, config: EvaluationConfig) -> WholeSolve | Resolved:
    if task.kept is None:
        return solve_whole(task.case, config, task.conditions)
    return resolve(task.case, task.kept, config, task.held)


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


def _tasks(case: Case, config: EvaluationConfig, conditions: Sequence[Condition]) -> list[tuple[str, int, _Task]]:
    """(kind, size, task) of all solves for one case, in order."""
    pms = case.pms
    out: list[tuple[str, int, _Task]] = [("whole", 0, _Task(case, conditions, None))]

    def without(held: tuple[int, ...]) -> _Task:
        return _Task(case, conditions, tuple(pm for pm in pms if pm not in held), held)

    if config.leave_one_out and len(pms) > 3:
        out += [("one", 0, without(held)) for held in left_out_one_by_one(case, config.most_left_out)]
    if config.folds and len(pms) > config.folds:
        out += [("fold", 0, without(held)) for held in folds_of(case, config.folds, config.seed)]
    if config.curve:
        mine = case.pms_of_epoch(case.largest_epoch)
        for size in curve_sizes(len(mine), config):
            for kept in subsets_of(mine, size, config.subsets, config.seed):
                others = tuple(pm for pm in mine if pm not in kept)
                out.append(("curve", size, _Task(case, conditions, kept, others)))
    return out


def evaluate(
    cases: Sequence[Case],
    config: EvaluationConfig | None = None,
    *,
    jobs: int = 1,
    executor: Executor | None = None,
    progress: Progress | None = None,
    conditions: Sequence[Sequence[Condition]] = (),
) -> tuple[SessionEvaluation, ...]:
    """Evaluate sessions.

    Args:
        cases: the sessions.
        config: what to compute.
        jobs, executor: where the solves run, see `fgreg.workers.tasks.run_tasks`.
        progress: called as solves are done.
        conditions: conditions of each case's verdict from its detection.
    """
    config = config or EvaluationConfig()
    given = conditions or [()] * len(cases)
    listed = [_tasks(case, config, mine) for case, mine in zip(cases, given, strict=True)]
    tasks = [task for of_case in listed for _, _, task in of_case]
    step = None if progress is None else partial(progress, STEP)
    results = list(run_tasks(partial(_run, config=config), tasks, jobs=jobs, executor=executor, progress=step))
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
