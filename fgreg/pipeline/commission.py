"""Commissions a rig: the steps of ``fgreg commission`` on one page.

read the sessions -> the same probe, cameras and prints in all -> solve each -> all in one graph with common constants
-> each session against the others -> write rig.yaml. A new session is solved, and its evidence compared with a rig.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np

from fgreg.detection.events_to_measurements import extract_measurements
from fgreg.errors import EstimationError, InputError
from fgreg.model.commissioned_rig import CommissionedRig
from fgreg.model.estimate import SystematicEstimate, Verdict
from fgreg.model.measurements import Check
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.systematic import TEXTS
from fgreg.output.atomic_file import check_output
from fgreg.pipeline.solve import detection_conditions, hand_conditions
from fgreg.registration.checks import with_checks
from fgreg.registration.commissioning import (
    OBSERVED,
    Chart,
    Commissioned,
    commission,
    common_constants,
    control_chart,
    session_evidence,
)
from fgreg.registration.error_budget import conflicts
from fgreg.registration.register import Registration
from fgreg.registration.rig_at_checks import rig_at_checks
from fgreg.registration.solve import solve
from fgreg.session.input_hashes import read_with_hashes
from fgreg.session.rig_file import RIG_FILE, not_made_from, same_rig, section_hashes, write_rig
from fgreg.session.session_reader import EVENTS_FILE, SETUP_FILE, Session, read_session
from fgreg.workers.tasks import Executor, run_tasks

TOGETHER = 0.5
"""Correlation from which a constant is named that the sessions do not tell apart from another one."""

STEP = "solving sessions"
Progress = Callable[[str, int, int], None]
"""Called with (name of the step, items done, total items)."""


@dataclass(frozen=True, slots=True, eq=False)
class CommissionedSession:
    """A session and what became of it.

    Attributes:
        folder: as given. name: of the session.
        reason: why it was left out; empty where it is used.
        chart: against the rig of the others, or against the rig given; None where left out, or the only one.
        warnings: of its reader, and that shots were left out by hand.
    """

    folder: Path
    name: str
    reason: str
    chart: Chart | None
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ConstantReport:
    """One constant of the rig, in the unit of files.

    Attributes:
        observed: share of its prior variance that is gone; ``by_sessions``: at least half, so that the sessions alone
            know it better than its prior does. Otherwise its prior holds it.
        together: another constant that the sessions do not tell it apart from; empty where there is none.
    """

    name: str
    value: float
    sigma: float
    prior_sigma: float
    observed: float
    by_sessions: bool
    score: float
    together: str


@dataclass(frozen=True, slots=True, eq=False)
class CommissionReport:
    """Result of a commissioning.

    Attributes:
        rig: contents of the file ``out``. found: the graph's optimum.
        constants: one for each of the rig's. conditions: sentences on constants that contradict their priors.
        sessions: as given, used or left out.
    """

    rig: CommissionedRig
    found: Commissioned
    constants: tuple[ConstantReport, ...]
    conditions: tuple[str, ...]
    sessions: tuple[CommissionedSession, ...]
    out: Path


@dataclass(frozen=True, slots=True, eq=False)
class _Solved:
    session: Session
    registration: Registration | None
    reason: str
    checks: tuple[Check, ...]
    warnings: tuple[str, ...] = ()


def commission_sessions(
    folders: Sequence[Path],
    out: Path,
    *,
    use_checks: bool = False,
    jobs: int = 1,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> CommissionReport:
    """Commission a rig from sessions, and write it to ``out``. A rig that sessions take up already is not used.

    Args:
        folders: of the sessions; one that is refused is left out.
        use_checks: check points are data.
        jobs, executor: where each session is solved first, see `fgreg.workers.tasks.run_tasks`.

    Raises:
        InputError: a session is not valid, given twice, has another probe, camera, marker or other priors than the
            first; or none is left.
    """
    check_output(out, RIG_FILE)
    read = [read_with_hashes(folder) for folder in folders]
    sessions, hashes = [session for session, _ in read], [found for _, found in read]
    _check_alike(sessions, hashes)
    bare = [replace(session, model=replace(session.model, rig=None)) for session in sessions]
    step = None if progress is None else partial(progress, STEP)
    solved = list(run_tasks(partial(_solved, use_checks=use_checks), bare, jobs=jobs, executor=executor, progress=step))
    used = [i for i, one in enumerate(solved) if one.registration is not None]
    if not used:
        first = solved[0]
        raise InputError(str(first.session.folder), f"no registration: {first.reason}", "a session that is not refused")
    try:
        found = commission(
            [registration for one in solved if (registration := one.registration) is not None],
            [solved[i].checks for i in used],
        )
    except EstimationError as error:
        raise InputError(", ".join(map(str, folders)), str(error), "sessions of one rig") from error
    charts: dict[int, Chart] = {}
    if len(used) > 1:
        for place, i in enumerate(used):
            charts[i] = control_chart(found.evidence[place], *found.without(place), found.prior_sigma)
    rig = CommissionedRig.of(
        found.constants,
        found.value,
        found.covariance,
        found.prior_sigma,
        tuple({**hashes[i], **section_hashes(sessions[i].model)} for i in used),
        datetime.now(UTC).isoformat(timespec="seconds"),
    )
    write_rig(rig, out)
    constants = _constants(found)
    return CommissionReport(
        rig,
        found,
        constants,
        tuple(condition.text for condition in conflicts(_estimates(found))),
        tuple(_outcome(one, charts.get(i)) for i, one in enumerate(solved)),
        out,
    )


def check_session_against(rig: CommissionedRig, folder: Path, *, use_checks: bool = False) -> CommissionedSession:
    """Compare a session with a rig; without a chart, with the reason, where the session is refused.

    Raises:
        InputError: the session is not valid, has another probe, camera or marker than the rig, or is part of it.
    """
    session = read_session(folder)
    same_rig(session.model, rig.sessions, str(folder / SETUP_FILE))
    not_made_from(rig, folder / EVENTS_FILE, f"{folder}: --check")
    # With the priors from before the commissioning the session speaks for itself.
    solved = _solved(replace(session, model=replace(session.model, rig=rig.widened())), use_checks)
    if solved.registration is None:
        return _outcome(solved, None)
    evidence = session_evidence(solved.registration, rig.constants, solved.checks)
    return _outcome(solved, control_chart(evidence, rig.value, rig.covariance, rig.prior_sigma))


def _check_alike(sessions: Sequence[Session], hashes: Sequence[Mapping[str, str]]) -> None:
    first = sessions[0]
    own, sigmas = section_hashes(first.model), _prior_sigmas(first.model)
    for i, session in enumerate(sessions):
        label = str(session.folder / SETUP_FILE)
        for earlier, other in zip(sessions[:i], hashes[:i], strict=True):
            if other["events.jsonl"] == hashes[i]["events.jsonl"]:
                raise InputError(str(session.folder), f"the same events as in {earlier.folder}", "each session once")
        if not session.model.systematic.declared:
            raise InputError(f"{label}: systematic", "none", "how well the rig is known: its priors")
        same_rig(session.model, [own], label)
        if not np.array_equal(_prior_sigmas(session.model), sigmas):
            raise InputError(f"{label}: systematic", "other values", f"those of {first.folder / SETUP_FILE}")
    if not common_constants(replace(first.model, rig=None)):
        raise InputError(f"{first.folder / SETUP_FILE}: systematic", "0 for all", "constants that are not exact")


def _prior_sigmas(model: SessionModel) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.asarray(replace(model, rig=None).constant_sigmas)


def _solved(session: Session, use_checks: bool) -> _Solved:
    model = session.model
    extracted = extract_measurements(session.events, model)
    config = SolveConfig()
    solution = solve(extracted.measurements, (), model, config, detection_conditions(extracted))
    checks = tuple(extracted.checks.values()) if use_checks else ()
    estimate = with_checks(
        solution.as_session(session.model.name),
        [*extracted.checks.values()],
        config.limit_mm,
        model.targets_mm,
        rig_at_checks(model, solution.snapshot, [*extracted.checks.values()]),
    )
    if estimate.verdict is Verdict.REFUSED or solution.registration is None:
        return _Solved(session, None, "; ".join(estimate.reasons), checks)
    registration = solution.registration
    left_out = tuple(condition.text for condition in hand_conditions(extracted))
    return _Solved(session, registration, "", checks, left_out)


def _outcome(solved: _Solved, chart: Chart | None) -> CommissionedSession:
    session = solved.session
    return CommissionedSession(
        session.folder, session.model.name, solved.reason, chart, (*session.warnings, *solved.warnings)
    )


def _constants(found: Commissioned) -> tuple[ConstantReport, ...]:
    correlation = found.covariance / np.outer(found.sigma, found.sigma)
    np.fill_diagonal(correlation, 0.0)
    out = []
    for k, constant in enumerate(found.constants):
        text, other = TEXTS[constant], int(np.argmax(np.abs(correlation[k])))
        by_sessions = bool(found.observed[k] >= OBSERVED)
        alike = not by_sessions and abs(correlation[k, other]) >= TOGETHER
        out.append(
            ConstantReport(
                name=text.name,
                value=float(found.value[k]) * text.per_unit,
                sigma=float(found.sigma[k]) * text.per_unit,
                prior_sigma=float(found.prior_sigma[k]) * text.per_unit,
                observed=float(found.observed[k]),
                by_sessions=by_sessions,
                score=float(found.score[k]),
                together=TEXTS[found.constants[other]].name if alike else "",
            )
        )
    return tuple(out)


def _estimates(found: Commissioned) -> list[SystematicEstimate]:
    return [
        SystematicEstimate(c.name, c.prior_sigma, c.value, c.sigma, c.observed, c.score, 0.0) for c in _constants(found)
    ]
