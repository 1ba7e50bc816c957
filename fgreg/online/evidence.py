"""Evidence of an untold move in the engine's own state: a cheap look after every pair, the proper test where it asks.

The window holds the last pairs one by one, and beside them the summary of everything older. The pairs before the last
:data:`LAST` and the summary are the Gaussian that a move is tested against, linearised where the estimate is now; so
nothing has to be followed twice. The cheap look uses the rows that every pair came with (fgreg.online.window.Prepared):
:func:`fgreg.camera_moves.bayes_filter.quick_score`, exact where nothing is odd and the windows are Gaussian.

A registration takes :data:`MIN_BEFORE` PMs: a move before that many of an epoch are in, or before the window, is for
the test from the other end (fgreg.online.early).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.camera_moves.bayes_filter import (
    JUNK_MEMORY,
    MoveSettings,
    MoveTest,
    check_for_move,
    quick_score,
    relinearisation,
)
from fgreg.camera_moves.whitened import (
    PRIVATE_ROUNDS,
    Gaussian,
    WhiteTerms,
    gaussian_of,
    pivot_scale,
    pose_columns,
    white_terms,
    whiten,
    window_pms,
)
from fgreg.config import SolveConfig
from fgreg.frames import BoolArray, FloatArray, exp_so3
from fgreg.graph.columns import Columns
from fgreg.graph.pm_selection import private_of, select_pms
from fgreg.graph.reduced import contributions, refine
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.shared_state import SharedState
from fgreg.measurements import EpochStart, Measurements
from fgreg.models import SessionModel
from fgreg.online.shared import Quadratic
from fgreg.online.state import Setting, State, summary
from fgreg.online.window import Bundle, Group, Window
from fgreg.registration import SoundSpeedPrior, pack_session
from fgreg.robust import pm_degrees_of_freedom
from fgreg.steadiness import logsumexp

LAST = 15
"""Last PMs among which a move is looked for."""
MIN_BEFORE = 6
"""PMs that a registration takes; before so many there is nothing that could have moved."""
GATE = 2.5
"""Log score by the cheap look from which the proper test is made: none that raises an alarm has less."""


@dataclass(frozen=True, slots=True, eq=False)
class MoveCase:
    """What the proper test needs.

    Attributes:
        serial: of the last event. epoch: that lasts.
        bundles: PMs of the window, oldest first; the last ``size`` of them are looked at.
        known: what everything else says, priors included, about ``state``.
        state: the estimate.
        history: (n,) which of the PMs before those looked at count, the last :data:`JUNK_MEMORY` of them.
    """

    serial: int
    epoch: int
    bundles: tuple[Bundle, ...]
    size: int
    known: Quadratic
    state: SharedState
    history: BoolArray


@dataclass(frozen=True, slots=True)
class MoveFound:
    """An alarm.

    Attributes:
        epoch: in which it was found. first: place of the first pair after the move.
        log_bayes: of the move there against none. score: of a move anywhere among the last pairs.
    """

    epoch: int
    first: int
    log_bayes: float
    score: float


def size_of(state: State, window: Window) -> int:
    """How many of the window's last PMs can be looked at; 0 where there is no sound registration before them."""
    older = state.now.shelf.counts[1]
    return max(0, min(LAST, len(window.groups), older + len(window.groups) - MIN_BEFORE))


def move_case(
    state: State, serial: int, setting: Setting, settings: MoveSettings, gate: float = GATE
) -> tuple[MoveCase | None, float | None]:
    """The case for the proper test, None where there is nothing to it; and the score by the cheap look, if it tells."""
    window = state.window
    if window is None or state.is_open:
        return None, None
    size = size_of(state, window)
    if not size:
        return None, None
    score = cheap_score(window, size, setting.columns, settings)
    if score is not None and score < gate:
        return None, score
    bundles = tuple(group.bundle for group in window.groups)
    known = summary(state, window.state, setting)
    case = MoveCase(serial, state.epoch, bundles, size, known, window.state, _history(state, bundles[:-size]))
    return case, score


def _history(state: State, before: tuple[Bundle, ...]) -> BoolArray:
    kept = [bundle.kept for bundle in before]
    for chunk in reversed(state.now.shelf.chunks):
        if len(kept) >= JUNK_MEMORY:
            break
        kept = [*chunk.kept.tolist(), *kept]
    return np.array(kept[-JUNK_MEMORY:], dtype=bool)


def cheap_score(window: Window, size: int, columns: Columns, settings: MoveSettings) -> float | None:
    """:func:`quick_score` of the last ``size`` PMs; None where one of them does not count."""
    groups = window.groups[-size:]
    if not all(group.kept and not group.prepared.far for group in groups):
        return None
    terms = _terms(groups, window.state, columns)
    known = Gaussian(np.zeros(columns.size), window.covariance)
    return quick_score(known, terms, settings.scales, pose_columns(0))


def _terms(groups: tuple[Group, ...], state: SharedState, columns: Columns) -> WhiteTerms:
    """The PMs' rows about a state near those where they were made."""
    n, most = len(groups), max(len(group.prepared.rows) for group in groups)
    residual, jacobian = np.zeros((1, n, most)), np.zeros((1, n, most, columns.size))
    steps = small_steps([group.prepared.state for group in groups], state, columns)
    for j, group in enumerate(groups):
        rows = group.prepared.rows
        jacobian[0, j, : len(rows)] = rows
        residual[0, j, : len(rows)] = group.prepared.residual
    residual[0] += np.einsum("nqd,nd->nq", jacobian[0], steps)
    # Rows are about the registration where they were made; the turn between is small, the lever it acts on is not.
    turn = exp_so3(steps[:, :3])
    jacobian[0, :, :, 3:6] = jacobian[0, :, :, 3:6] @ turn
    equations = np.array([len(group.prepared.rows) for group in groups])
    return WhiteTerms(residual, jacobian, np.zeros((1, n)), equations)


def small_steps(first: list[SharedState], second: SharedState, columns: Columns) -> FloatArray:
    """(n, D) of :func:`fgreg.online.shared.small_step` from several states to one."""
    out = np.zeros((len(first), columns.size))
    back = np.concatenate([state.rotation[0] for state in first]).swapaxes(1, 2)
    turn = back @ second.rotation[0, 0]
    out[:, 0] = 0.5 * (turn[:, 2, 1] - turn[:, 1, 2])
    out[:, 1] = 0.5 * (turn[:, 0, 2] - turn[:, 2, 0])
    out[:, 2] = 0.5 * (turn[:, 1, 0] - turn[:, 0, 1])
    shift = second.translation_mm[0, 0] - np.concatenate([state.translation_mm[0] for state in first])
    out[:, 3:6] = (back @ shift[:, :, None])[..., 0]
    out[:, columns.beam : columns.beam + 4] = second.beam[0] - np.concatenate([state.beam for state in first])
    out[:, columns.edge] = second.edge_rad[0] - np.concatenate([state.edge_rad for state in first])
    if columns.bias is not None:
        out[:, columns.bias : columns.bias + 3] = second.bias_mm[0] - np.stack([state.bias_mm[0] for state in first])
    if columns.sound_speed is not None:
        ratio = np.array([state.sound_speed_ratio[0] for state in first])
        out[:, columns.sound_speed] = second.sound_speed_ratio[0] - ratio
    return out


# --- the proper test ------------------------------------------------------------------------------------------------


def proper_test(
    case: MoveCase, model: SessionModel, config: SolveConfig, prior: SoundSpeedPrior | None, settings: MoveSettings
) -> MoveTest | None:
    """Whether the camera moved among the last PMs; None where those before them leave the registration open."""
    pairs = tuple(replace(pair, pm=number, epoch=0) for number, b in enumerate(case.bundles) for pair in b.pairs)
    problem = pack_session(Measurements((), pairs, (EpochStart(0.0),)), model, config, prior)
    state, scale = case.state, pivot_scale(problem.columns)
    private = initial_private(problem, state)
    for _ in range(PRIVATE_ROUNDS):
        _, private = refine(problem, state, private)
    parts = contributions(problem, state, private)
    every = whiten(parts.pm, pm_degrees_of_freedom(problem), scale)
    count = len(case.bundles)
    last = np.arange(count - case.size, count)
    # Who counts among those before is as the estimate has it; where that leaves too few, junk is not what is odd.
    counts = np.array([bundle.kept for bundle in case.bundles[: -case.size]], dtype=bool)
    older = case.history[: max(len(case.history) - len(counts), 0)]
    if counts.sum() + older.sum() < MIN_BEFORE:
        counts[:] = True
    old = every.take(np.flatnonzero(counts))
    jacobian = old.jacobian[0].reshape(-1, problem.columns.size)
    hessian = case.known.hessian + jacobian.T @ jacobian
    gradient = case.known.gradient + jacobian.T @ old.residual[0].reshape(-1)
    before = gaussian_of(hessian, gradient, scale)
    if before is None:
        return None
    tail = select_pms(problem, last)
    terms = every.take(last)
    if window_pms(tail) is not None:
        terms = white_terms(tail, state, private_of(problem, private, last))
    return check_for_move(
        before,
        terms,
        settings.learned(case.history),
        pose=pose_columns(0),
        relinearise=relinearisation(tail, state),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Tested:
    """A test's outcome, and the place of the first pair after each of the moves that it looked for."""

    test: MoveTest
    places: tuple[int, ...]


def tested_last(case: MoveCase, test: MoveTest | None) -> Tested | None:
    """The proper test's outcome with its pairs."""
    if test is None:
        return None
    return Tested(test, tuple(min(bundle.places) for bundle in case.bundles[-case.size :]))


def found_by(epoch: int, tests: Sequence[Tested], threshold: float) -> MoveFound | None:
    """The alarm that tests for different moves of an epoch raise together, if they do."""
    score = float(logsumexp(np.array([-np.inf, *(tested.test.score for tested in tests)])))
    if score <= threshold:
        return None
    best = max(tests, key=lambda tested: tested.test.log_bayes[tested.test.since])
    return MoveFound(epoch, best.places[best.test.since], float(best.test.log_bayes[best.test.since]), score)
