"""How wrong a registration could be if the camera moved unreported: among its inliers, or where outliers begin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.errors import EstimationError
from fgreg.geometry.target_error import target_jacobians
from fgreg.geometry.transforms import BoolArray, FloatArray
from fgreg.graph.contributions import contributions, pm_columns
from fgreg.graph.scaled_inverse import scaled_inverse, without_others
from fgreg.graph.split_points import ALARM, MovedRegistrations, logsumexp, moved_registrations
from fgreg.model.measurements import EpochStart, Measurements, Pair
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.outliers import plausible_cost, pm_limits
from fgreg.registration.register import Registration, register

MOVE_PRIOR = 0.5
"""Probability of an unreported camera move, equally likely before each PM but the first: even odds, since of steady
sessions hardly any is refused for it."""
NEGLIGIBLE = 1e-4
"""Share of the hypotheses' weight that is left out."""
MOSTLY = 0.75
"""Share of outliers among pairs that count as outliers in a row."""
LEAST_IN_A_ROW = 2
UNTESTED = 12
"""Up to this number of PMs some split point has too few inliers on both sides for the full test."""
TELLING = 7
"""PMs that show whether they have one registration: one more than determine it."""

_NORMAL = np.random.default_rng(0).standard_normal((256, 6))


@dataclass(frozen=True, slots=True)
class MoveDoubt:
    """Possible unreported camera moves of an epoch.

    Attributes:
        log_odds: log of the sum of the Bayes factors of a move before each of ``pms`` PMs but the first.
        before, after: PMs between which it is likeliest.
        wrong: probability that the registration's error at some target is beyond twice the limit, since it moved.
    """

    log_odds: float
    before: int
    after: int
    pms: int
    wrong: float


def move_doubt(registration: Registration, place: int, limit_mm: float) -> MoveDoubt | None:
    """Doubt of one of the registration's epochs; None where it has one PM.

    Outliers count where a move would be certain with them, or where PMs are too few for the full test, which weighs
    false PMs against a move.
    """
    pms, moved = moves_in_epoch(registration, place, outliers=True)
    if len(pms) > UNTESTED and logsumexp(moved.log) <= ALARM:
        pms, moved = moves_in_epoch(registration, place, outliers=False)
    if len(pms) < 2:
        return None
    by_split = logsumexp(moved.log, axis=1)
    best = int(np.argmax(by_split))
    trus_T_camera = registration.optimum.state.trus_T_camera(place)[0]
    jacobian = target_jacobians(trus_T_camera, registration.model.targets_mm)
    wrong = _probability_beyond(moved, jacobian, 2.0 * limit_mm)
    return MoveDoubt(float(logsumexp(by_split)), pms[best], pms[best + 1], len(pms), wrong)


def moves_in_epoch(
    registration: Registration, place: int, *, outliers: bool
) -> tuple[tuple[int, ...], MovedRegistrations]:
    """Possible moves within an epoch: its n PMs in the order of time, and the registration after a move before each.

    ``outliers``: they take part, with the weight that reduces them to their limit (Huber's): PMs after a move look like
    outliers.
    """
    shots, optimum = registration.shots, registration.optimum
    problem = shots.problem
    mine = np.unique(problem.beam_pm[problem.beam_epoch == place])
    mine = mine if outliers else mine[shots.pm_inlier[mine]]
    parts = contributions(problem, optimum.state, shots.evaluation.private).pm
    columns = pm_columns(problem, mine, place)
    out = ~shots.pm_inlier[mine]
    cost = parts.cost[0, mine]
    weight = np.where(out, np.minimum(pm_limits(problem)[mine] / np.maximum(cost, 1e-12), 1.0), 1.0)
    gradient = weight[:, None] * parts.gradient[0, mine][:, columns]
    hessian = weight[:, None, None] * parts.hessian(mine, columns)[0]
    covariance = registration.covariance[np.ix_(columns, columns)]
    step = np.zeros(len(columns))  # from the registration, that of the inliers, to that of all
    if out.any():
        rest = without_others(optimum.evaluation.hessian[0], columns)
        covariance = scaled_inverse(rest + hessian[out].sum(axis=0))
        step = -covariance @ gradient[out].sum(axis=0)
    first = int(np.searchsorted(columns, 6 * place))
    pose = slice(first, first + 6)
    moved = moved_registrations(gradient + hessian @ step, hessian, covariance, pose)
    return tuple(problem.pms[pm] for pm in mine), replace(moved, mean=moved.mean + step[pose])


def _probability_beyond(moved: MovedRegistrations, jacobian: FloatArray, limit_mm: float) -> float:
    """Probability of a move after which some target, of Jacobian (n, 3, 6), is off by more than a limit."""
    odds = MOVE_PRIOR / (1.0 - MOVE_PRIOR) / len(moved.log) * np.exp(np.minimum(moved.log, 100.0))
    weight = (odds / (1.0 + odds.sum())).reshape(-1)
    mean, covariance = moved.mean.reshape(-1, 6), moved.covariance.reshape(-1, 6, 6)
    heavy = weight > NEGLIGIBLE
    beyond = np.zeros(len(weight))
    value, vector = np.linalg.eigh(covariance[heavy])
    root = vector * np.sqrt(np.maximum(value, 0.0))[:, None]
    step = mean[heavy][:, None] + _NORMAL @ np.swapaxes(root, 1, 2)
    error = (step @ jacobian.reshape(-1, 6).T).reshape(*step.shape[:2], -1, 3)
    error2 = np.square(error[..., 0]) + np.square(error[..., 1]) + np.square(error[..., 2])
    beyond[heavy] = np.mean(error2.max(axis=-1) > limit_mm**2, axis=-1)
    return float(weight @ beyond)


def outliers_in_a_row(inlier: BoolArray) -> slice | None:
    """The PMs, among those of an epoch in the order of time, that are nearly all outliers, and most of the outliers.

    They may be one side of a camera move. None where the outliers are scattered, or a single one.
    """
    where = np.flatnonzero(~inlier)
    best: slice | None = None
    for i, first in enumerate(where):
        for count, last in enumerate(where[i:], 1):
            size = last + 1 - first
            most = 2 * count > len(where) and count >= LEAST_IN_A_ROW and count >= MOSTLY * size
            if most and (best is None or size > best.stop - best.start):
                best = slice(int(first), int(last) + 1)
    return best


def may_share_a_registration(
    measurements: Measurements, pairs: Sequence[Pair], model: SessionModel, config: SolveConfig
) -> bool:
    """Whether some pairs may have a registration of their own: too few to tell, or one that fits nearly all of them."""
    if len({pair.pm for pair in pairs}) < TELLING:
        return True
    alone = tuple(replace(pair, epoch=0) for pair in pairs)
    try:
        found = register(Measurements(measurements.aims, alone, (EpochStart(0.0),)), model, config)
    except EstimationError:
        return False
    shots, cost = found.shots, float(found.optimum.evaluation.cost[0])
    return bool(np.mean(shots.pm_inlier) >= MOSTLY and cost <= plausible_cost(found.problem))
