"""The test for unreported camera moves: over all split points of the current epoch, and for a loop closure.

A split point is the first PM after a move. There are three steps; usually only the first is needed:

1. Screening, in closed form, over all split points (fgreg.graph.split_points). Outliers take part, since PMs after a
   move look like outliers. Where the sum of the Bayes factors is below its gate there is no move.
2. The full test, by a Gaussian sum filter (fgreg.camera_moves.bayes_filter), over the split points that screening
   selects. For each of them the filter starts from the side with more inliers and adds the PMs of the other side one by
   one: forward in time for late moves, backward for early ones. The prior of a move is symmetric, with zero mean.
3. Loop closure: the same filter about an earlier epoch's registration (fgreg.camera_moves.loop_closure).

The score is the log of the sum of the Bayes factors over all split points (Shiryaev, 1963; Roberts, 1966). Without a
move that sum, less the number of PMs, is a martingale. So if the model holds, a threshold A on it is exceeded at most
once in A PMs on average.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from fgreg.camera_moves.bayes_filter import MoveSettings, move_evidence, relinearisation
from fgreg.camera_moves.loop_closure import (
    CANDIDATES,
    MIN_LOOKS,
    MOST_LOOKS,
    LoopClosureSettings,
    log_bayes_of_same_place,
)
from fgreg.camera_moves.whitened import POSE, gaussian_of, linearise, settled_private
from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray
from fgreg.graph.contributions import Contributions, contributions
from fgreg.graph.packing import PackedProblem
from fgreg.graph.shared_state import Quadratic
from fgreg.graph.split_points import GATE, log_move_odds, logsumexp
from fgreg.model.measurements import EpochStart, Measurements, Pair
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.outliers import pm_limits
from fgreg.registration.register import pack_session

MIN_KNOWN = 6
"""Inliers needed for a registration: with fewer on both sides of a split point a move cannot be tested there."""
MOST_OUTLIERS = 0.5
"""Largest share of outliers among the PMs that the filter starts from: more of them have no sound registration."""
MARGIN, MOST_SPLITS = 6.0, 24
"""The full test uses split points whose log Bayes factor is this close to the best one's; largest number of them."""


@dataclass(frozen=True, slots=True, eq=False)
class MoveCase:
    """What the test needs; picklable.

    Attributes:
        epoch: the current epoch.
        pms: looks at each PM of the epoch, in the order of first looks; a look split off as an outlier is a PM of its
            own.
        places: of each PM's first look in the session's order of pairs.
        inlier: (n,) which PMs are inliers.
        known: prior of the shared variables from everything but this epoch's pairs, about the epoch's optimum (one
            hypothesis). None where there is no optimum, or an ambiguous one; then only a loop may be closed.
        earlier: for each epoch that a loop may be closed to, the prior of the shared variables when it ended, about its
            optimum. Empty where the motion since is known.
    """

    epoch: int
    pms: tuple[tuple[Pair, ...], ...]
    places: tuple[int, ...]
    inlier: BoolArray
    known: Quadratic | None
    earlier: dict[int, Quadratic] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class CameraMove:
    """An unreported camera move.

    Attributes:
        epoch: in which the camera moved.
        first: place of the first pair after the move, in the session's order of pairs.
        log_bayes: of a move there against none. score: of a move at any split point.
    """

    epoch: int
    first: int
    log_bayes: float
    score: float


@dataclass(frozen=True, slots=True)
class LoopClosure:
    """A loop closure: in ``epoch`` the camera is back where ``to`` had it. log_bayes: of the same place, against
    elsewhere."""

    epoch: int
    to: int
    log_bayes: float


Pms = Sequence[tuple[Pair, ...]]


class Pack(Protocol):
    """Packs PMs as an epoch of their own, numbered in order; ``shapes``: with the windows' own shapes."""

    def __call__(self, pms: Pms, *, shapes: bool) -> PackedProblem: ...


def find_camera_move(
    case: MoveCase,
    model: SessionModel,
    config: SolveConfig,
    settings: MoveSettings | None = None,
    closure: LoopClosureSettings | None = None,
) -> CameraMove | LoopClosure | None:
    """Whether the camera has moved in the current epoch, or is back where an earlier epoch had it.

    Args:
        case: the current epoch.
        model, config: of the session.
        settings: priors and threshold of a move. closure: of a loop closure.
    """
    settings = settings or MoveSettings()
    gaussian = replace(config, window_shape=False)

    def packed(pms: Pms, *, shapes: bool) -> PackedProblem:
        pairs = tuple(replace(pair, pm=number, epoch=0) for number, looks in enumerate(pms) for pair in looks)
        alone = Measurements((), pairs, (EpochStart(0.0),))
        return pack_session(alone, model, config if shapes else gaussian)

    move = _camera_move(case, packed, settings)
    return move or _loop_closure(case, packed, closure or LoopClosureSettings())


def _camera_move(case: MoveCase, packed: Pack, settings: MoveSettings) -> CameraMove | None:
    """Screening, and the full test where the screening exceeds its gate."""
    count, known = len(case.pms), case.known
    if known is None or count <= MIN_KNOWN:
        return None
    problem = packed(case.pms, shapes=False)
    parts = contributions(problem, known.state, settled_private(problem, known.state)).pm
    screened = screening(parts, case.inlier, known, pm_limits(problem))
    if logsumexp(screened) < GATE:
        return None
    before = np.arange(1, count)
    inliers = np.cumsum(case.inlier)[:-1]
    testable = np.maximum(inliers, case.inlier.sum() - inliers) >= MIN_KNOWN
    if not testable[np.argmax(screened)]:
        return None  # evidence for that split point would be attributed to another one
    likeliest = np.argsort(-screened)[:MOST_SPLITS]
    splits = np.sort(before[likeliest[testable[likeliest] & (screened[likeliest] > screened.max() - MARGIN)]])
    late = 2 * inliers[splits - 1] >= case.inlier.sum()
    forward = _full_test(case, known, parts, splits[late], packed, settings)
    backward = _full_test(case, known, parts, splits[~late], packed, settings, backward=True)
    log_bayes = np.concatenate([backward, forward])
    score, best = float(logsumexp(log_bayes)), int(np.argmax(log_bayes))
    if score <= settings.threshold:
        return None
    return CameraMove(case.epoch, case.places[splits[best]], float(log_bayes[best]), score)


def screening(parts: Contributions, inlier: BoolArray, known: Quadratic, limit: FloatArray) -> FloatArray:
    """(n - 1,) log Bayes factor of a move before each PM but the first, in closed form.

    Outliers take part with the weight that reduces them to their limit (Huber's).

    Args:
        parts: contributions of the n PMs, one hypothesis, at the estimate.
        inlier: (n,) which PMs are inliers of it.
        known: prior from all else, about the estimate.
        limit: (n,) chi square beyond which a PM is an outlier.
    """
    weight = np.where(inlier, 1.0, np.minimum(limit / np.maximum(parts.cost[0], 1e-12), 1.0))
    gradient, hessian = weight[:, None] * parts.gradient[0], weight[:, None, None] * parts.hessian()[0]
    total = known.hessian + hessian.sum(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(total), 1e-30))
    covariance = np.linalg.inv(total * scale * scale[:, None] + 1e-12 * np.eye(len(scale))) * scale * scale[:, None]
    step = -covariance @ (known.gradient + gradient.sum(axis=0))
    return log_move_odds(gradient + hessian @ step, hessian, np.asarray(covariance), POSE)


def _full_test(
    case: MoveCase,
    known: Quadratic,
    parts: Contributions,
    splits: IntArray,
    packed: Pack,
    settings: MoveSettings,
    *,
    backward: bool = False,
) -> FloatArray:
    """(C,) log Bayes factors of moves at split points (C,), increasing, by the filter.

    The filter starts from the PMs before all split points, or (``backward``) from those after. They are linearised
    about the estimate of all PMs. Where they do not determine the registration there is no evidence for a move.
    """
    if not len(splits):
        return np.zeros(0)
    count = len(case.pms)
    order = np.arange(count)[::-1] if backward else np.arange(count)
    at = count - splits[::-1] if backward else splits
    first, following = order[: at[0]], order[at[0] :]
    inlier = case.inlier[first]
    if inlier.sum() < MIN_KNOWN or np.mean(~inlier) > MOST_OUTLIERS:
        return np.full(len(splits), -np.inf)  # the estimate is not theirs
    counting = first[inlier]
    known = _without_pose(known) if backward else known
    stream = packed([case.pms[i] for i in following], shapes=True)
    before = gaussian_of(
        known.hessian + parts.hessian(counting)[0].sum(axis=0),
        known.gradient + parts.gradient[0, counting].sum(axis=0),
        stream.columns,
    )
    if before is None:
        return np.full(len(splits), -np.inf)
    terms, again = linearise(stream, known.state), relinearisation(stream, known.state)
    log_bayes = move_evidence(before, terms, at - at[0], settings.learned(inlier), again).log_bayes
    return log_bayes[::-1] if backward else log_bayes


def _without_pose(known: Quadratic) -> Quadratic:
    """The prior without the registration, which is eliminated: that prior is valid before the move only."""
    size = len(known.gradient)
    rest = np.r_[0 : POSE.start, POSE.stop : size]
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    gain = known.hessian[rest, POSE] @ np.linalg.pinv(known.hessian[POSE, POSE], hermitian=True)
    hessian[np.ix_(rest, rest)] = known.hessian[np.ix_(rest, rest)] - gain @ known.hessian[POSE, rest]
    gradient[rest] = known.gradient[rest] - gain @ known.gradient[POSE]
    return replace(known, hessian=hessian, gradient=gradient)


def _loop_closure(case: MoveCase, packed: Pack, settings: LoopClosureSettings) -> LoopClosure | None:
    """The earlier epoch whose registration fits the current epoch's PMs best, if one does."""
    if not case.earlier or not MIN_LOOKS <= sum(map(len, case.pms)) <= MOST_LOOKS:
        return None
    problem = packed(case.pms, shapes=True)
    best: LoopClosure | None = None
    for epoch in sorted(case.earlier)[-CANDIDATES:]:
        known = case.earlier[epoch]
        earlier = gaussian_of(known.hessian, known.gradient, problem.columns)
        if earlier is None:
            continue
        log_bayes = log_bayes_of_same_place(
            earlier, linearise(problem, known.state), settings, relinearisation(problem, known.state)
        )
        if log_bayes >= settings.accept and (best is None or log_bayes > best.log_bayes):
            best = LoopClosure(case.epoch, epoch, log_bayes)
    return best
