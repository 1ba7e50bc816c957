"""The test for unreported camera moves: over all split points of the current epoch, and for a loop closure.

1. Screening: the closed form of :mod:`fgreg.steadiness` over all split points, outliers included. Where their sum stays
   below :data:`GATE` the epoch is steady, and that is nearly always.
2. Full test: the Gaussian-sum filter of :mod:`fgreg.camera_moves.bayes_filter` over the split points that screening
   leaves. Of each split point the side with more PMs is known first, and those of the other side come one by one:
   forward in time where it is late, backward where it is early. A move is as likely either way round, its prior has
   zero mean.
3. Loop closure: the same filter, about an earlier epoch's registration, with the one split point before the first PM.

The score is the log of the sum of the Bayes factors of all split points (Shiryaev, 1963; Roberts, 1966).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from fgreg.camera_moves.bayes_filter import MoveSettings, check_for_move, relinearisation
from fgreg.camera_moves.loop_closure import default_return_settings, fits_again, which_epoch
from fgreg.camera_moves.whitened import (
    PRIVATE_ROUNDS,
    Gaussian,
    gaussian_of,
    linearise,
    pivot_scale,
    pose_columns,
)
from fgreg.config import SolveConfig
from fgreg.errors import EstimationError
from fgreg.frames import BoolArray, FloatArray, IntArray
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced import Contributions, contributions, refine
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.shared_state import SharedState
from fgreg.measurements import Aim, EpochStart, Measurements, Pair
from fgreg.models import SessionModel
from fgreg.registration import SoundSpeedPrior, pack_session, register
from fgreg.robust import pm_limits
from fgreg.steadiness import default_scales, log_move_odds, logsumexp

if TYPE_CHECKING:
    from fgreg.online.shared import Quadratic

MIN_BASE = 6
"""PMs that a registration takes: fewer on both sides of a split point leave nothing that could have moved."""
GATE = 2.5
"""Log score by the screening from which the full test is made."""
MOST_LOOKS = 30
"""Pairs of an epoch up to which a loop may be closed: by then it knows its registration as well by itself."""
MARGIN, MOST_SPLITS = 6.0, 24
"""Split points go to the full test within so much of the best one's log Bayes factor, at most so many."""


@dataclass(frozen=True, slots=True, eq=False)
class MoveCase:
    """What the test needs; picklable.

    Attributes:
        epoch: the current epoch.
        pms: looks at each PM of the epoch, in the order of first looks; one that was split off as an outlier is a PM of
            its own.
        places: of each PM's first look in the session's order of pairs.
        inlier: (n,) which PMs count in the estimate.
        state: the epoch's optimum, one hypothesis of one epoch; None where there is none, or two that cannot be told
            apart.
        known: what everything but this epoch's pairs says of the shared variables, priors included, about ``state``;
            None where that is None.
        aims: calibration shots.
        earlier: earlier epochs that a loop may be closed to: registration when each ended, and what was known of it.
    """

    epoch: int
    pms: tuple[tuple[Pair, ...], ...]
    places: tuple[int, ...]
    inlier: BoolArray
    state: SharedState | None
    known: Quadratic | None
    aims: tuple[Aim, ...] = ()
    earlier: dict[int, tuple[SharedState, Quadratic]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class CameraMove:
    """The camera has moved.

    Attributes:
        epoch: in which it did.
        first: place of the first pair after the move, in the session's order of pairs.
        log_bayes: of a move there, against none. score: of a move at any split point.
    """

    epoch: int
    first: int
    log_bayes: float
    score: float


@dataclass(frozen=True, slots=True)
class LoopClosure:
    """The camera is back: in ``epoch`` it is where ``to`` had it. log_bayes: of that, against elsewhere."""

    epoch: int
    to: int
    log_bayes: float


def find_camera_move(
    case: MoveCase,
    model: SessionModel,
    config: SolveConfig,
    sound_speed_prior: SoundSpeedPrior | None = None,
    settings: MoveSettings | None = None,
) -> CameraMove | LoopClosure | None:
    """Whether the camera has moved in the current epoch, or is back where an earlier epoch had it.

    Args:
        case: the current epoch.
        model, config, sound_speed_prior: of the session.
        settings: priors and threshold of a move.
    """
    of = (model, config, sound_speed_prior)
    settings = settings or MoveSettings()
    if case.state is None or case.known is None:
        move = _without_estimate(case, *of, settings)
    else:
        move = _among_all(case, case.state, case.known, *of, settings)
    return move or _loop_closure(case, *of)


@dataclass(frozen=True, slots=True, eq=False)
class _Evidence:
    """Log Bayes factors (C,) of moves at split points (C,), each the index of the first PM after."""

    split: IntArray
    log_bayes: FloatArray


def _found(case: MoveCase, parts: list[_Evidence], settings: MoveSettings) -> CameraMove | None:
    split = np.concatenate([np.zeros(0, dtype=np.int64), *(part.split for part in parts)])
    log_bayes = np.concatenate([np.zeros(0), *(part.log_bayes for part in parts)])
    if not len(split):
        return None
    score, best = float(logsumexp(log_bayes)), int(np.argmax(log_bayes))
    if score <= settings.threshold:
        return None
    return CameraMove(case.epoch, case.places[split[best]], float(log_bayes[best]), score)


def _packed(
    pms: tuple[tuple[Pair, ...], ...], model: SessionModel, config: SolveConfig, prior: SoundSpeedPrior | None
) -> PackedProblem:
    pairs = tuple(replace(pair, pm=number, epoch=0) for number, looks in enumerate(pms) for pair in looks)
    return pack_session(Measurements((), pairs, (EpochStart(0.0),)), model, config, prior)


# --- where there is an estimate of all PMs ----------------------------------------------------------------------------


def _among_all(
    case: MoveCase,
    state: SharedState,
    known: Quadratic,
    model: SessionModel,
    config: SolveConfig,
    prior: SoundSpeedPrior | None,
    settings: MoveSettings,
) -> CameraMove | None:
    if len(case.pms) <= MIN_BASE:
        return None
    problem = _packed(case.pms, model, config, prior)
    private = initial_private(problem, state)
    for _ in range(PRIVATE_ROUNDS):
        _, private = refine(problem, state, private)
    parts = contributions(problem, state, private).pm
    screened = screening(parts, case.inlier, known, pm_limits(problem))
    if logsumexp(screened) < GATE:
        return None
    count = len(case.pms)
    split = 1 + np.argsort(-screened)[:MOST_SPLITS]
    split = np.sort(split[screened[split - 1] > screened.max() - MARGIN])
    late = split >= count - split
    found = []
    for chosen, backward in ((split[late], False), (split[~late], True)):
        chosen = chosen[(count - chosen if backward else chosen) >= MIN_BASE]
        if len(chosen):
            evidence = _full_test(case, problem, state, known, parts, chosen, settings, backward=backward)
            if evidence is not None:
                found.append(evidence)
    return _found(case, found, settings)


def screening(parts: Contributions, inlier: BoolArray, known: Quadratic, limit: FloatArray) -> FloatArray:
    """(n - 1,) log Bayes factor of a move before each PM but the first, in closed form.

    Outliers count as well, with the weight that leaves them at their limit (Huber): what has happened since a move
    looks like them.

    Args:
        parts: of one hypothesis, about the estimate.
        inlier: (n,). known: what all else says there. limit: (n,) chi square beyond which a PM is an outlier.
    """
    cost, gradient, hessian = parts.cost[0], parts.gradient[0], parts.hessian[0]
    weight = np.where(inlier, 1.0, np.minimum(limit / np.maximum(cost, 1e-12), 1.0))
    gradient, hessian = weight[:, None] * gradient, weight[:, None, None] * hessian
    size = gradient.shape[1]
    total = known.hessian + hessian.sum(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(total), 1e-30))
    covariance = np.linalg.inv(total * scale * scale[:, None] + 1e-12 * np.eye(size)) * scale * scale[:, None]
    step = -covariance @ (known.gradient + gradient.sum(axis=0))
    pull = -(gradient + hessian @ step)
    return log_move_odds(hessian, pull, np.asarray(covariance), default_scales(), pose_columns(0))[1:]


def _full_test(
    case: MoveCase,
    problem: PackedProblem,
    state: SharedState,
    known: Quadratic,
    parts: Contributions,
    split: IntArray,
    settings: MoveSettings,
    *,
    backward: bool,
) -> _Evidence | None:
    """The filter over split points (C,), the PMs of one side known first."""
    count = len(case.pms)
    order = np.arange(count)[::-1] if backward else np.arange(count)
    at = np.sort(count - split if backward else split)
    base, stream = order[: at[0]], order[at[0] :]
    counts = case.inlier[base]
    if counts.sum() < MIN_BASE:
        counts = np.ones(len(base), dtype=bool)
    hessian, gradient = (known.hessian, known.gradient) if not backward else _without_pose(known)
    hessian = hessian + parts.hessian[0, base[counts]].sum(axis=0)
    gradient = gradient + parts.gradient[0, base[counts]].sum(axis=0)
    before = gaussian_of(hessian, gradient, pivot_scale(problem.columns))
    if before is None:
        return None
    terms = linearise(problem, state).take(stream)
    again = relinearisation(problem, state)
    test = check_for_move(
        before,
        terms,
        settings.learned(case.inlier[base]),
        pose=pose_columns(0),
        relinearise=lambda steps: again(steps).take(stream),
    )
    log_bayes = test.log_bayes[at - at[0]]
    return _Evidence(order[at] + 1, log_bayes) if backward else _Evidence(order[at], log_bayes)


def _without_pose(known: Quadratic) -> tuple[FloatArray, FloatArray]:
    """Hessian and gradient with the registration eliminated: a prior of it holds for the first PMs only."""
    pose, size = pose_columns(0), len(known.gradient)
    rest = np.r_[0 : pose.start, pose.stop : size]
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    own = np.linalg.pinv(known.hessian[pose, pose], hermitian=True)
    across = known.hessian[rest, pose] @ own
    hessian[np.ix_(rest, rest)] = known.hessian[np.ix_(rest, rest)] - across @ known.hessian[pose, rest]
    gradient[rest] = known.gradient[rest] - across @ known.gradient[pose]
    return hessian, gradient


# --- where there is none ----------------------------------------------------------------------------------------------


def _without_estimate(
    case: MoveCase, model: SessionModel, config: SolveConfig, prior: SoundSpeedPrior | None, settings: MoveSettings
) -> CameraMove | None:
    """The first PMs judged by a registration of the last ones, from no guess."""
    count = len(case.pms)
    early = min(count - MIN_BASE - 1, MIN_BASE)
    if early < 1:
        return None
    base = tuple(replace(pair, pm=n, epoch=0) for n, pm in enumerate(case.pms[early:]) for pair in pm)
    try:
        found = register(Measurements(case.aims, base, (EpochStart(0.0),)), model, config, prior)
    except EstimationError:
        return None
    if found.ambiguous:
        return None
    problem, state = _packed(case.pms[:early][::-1], model, config, prior), found.optimum.state
    test = check_for_move(
        Gaussian(np.zeros(problem.columns.size), found.covariance),
        linearise(problem, state),
        settings.learned(found.shots.pm_kept),
        pose=pose_columns(0),
        relinearise=relinearisation(problem, state),
    )
    return _found(case, [_Evidence(np.arange(early, 0, -1), test.log_bayes)], settings)


# --- loop closure -----------------------------------------------------------------------------------------------------


def _loop_closure(
    case: MoveCase, model: SessionModel, config: SolveConfig, prior: SoundSpeedPrior | None
) -> LoopClosure | None:
    """The earlier epoch whose registration fits the current epoch's PMs best, if one does."""
    settings = default_return_settings()
    if not (case.earlier and settings.least_pairs <= sum(map(len, case.pms)) <= MOST_LOOKS):
        return None
    problem = _packed(case.pms, model, config, prior)
    scale, pose = pivot_scale(problem.columns), pose_columns(0)
    tests = {}
    for epoch, (state, known) in case.earlier.items():
        earlier = gaussian_of(known.hessian, known.gradient, scale)
        if earlier is None:
            continue
        covariance = earlier.covariance.copy()
        covariance[pose, pose] += np.diag(np.repeat(settings.tolerance, 3) ** 2)
        tests[epoch] = fits_again(
            Gaussian(earlier.mean, covariance),
            linearise(problem, state),
            settings,
            pose=pose,
            relinearise=relinearisation(problem, state),
        )
    to = which_epoch(tests)
    return None if to is None else LoopClosure(case.epoch, to, tests[to].log_bayes)
