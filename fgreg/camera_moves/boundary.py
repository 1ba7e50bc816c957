"""Where an epoch begins: the boundary of two registered epochs that the PMs on both sides make likeliest."""

from __future__ import annotations

import math

import numpy as np

from fgreg.camera_moves.bayes_filter import OUTLIER_PRIOR
from fgreg.camera_moves.whitened import linearise
from fgreg.geometry.transforms import BoolArray, FloatArray
from fgreg.graph.packing import PackedProblem
from fgreg.graph.shared_state import SharedState
from fgreg.registration.outliers import OUTLIER_DENSITY

LEAST_GAIN = 1.0
"""Log likelihood by which another boundary has to be better than the present one."""
LEAST_SIDE = 3
"""PMs that stay on either side: fewer have no registration."""
LEAST_PRECISION = 1e-6


def likeliest_boundary(
    problem: PackedProblem,
    states: tuple[SharedState, SharedState],
    covariances: tuple[FloatArray, FloatArray],
    inlier: BoolArray,
    boundary: int,
) -> int:
    """Index of the first PM of the later epoch.

    Each PM has a likelihood under both registrations, from all PMs but itself, and may be an outlier under either.
    The present boundary stays where no other one is clearly better.

    Args:
        problem: PMs of both epochs in the order of time, as one epoch.
        states, covariances: shared variables of the earlier and the later epoch (one hypothesis each), (D, D) each.
        inlier: (n,) which PMs the registrations rest on.
        boundary: the present one.
    """
    later = np.arange(len(problem.pms)) >= boundary
    earlier_log = _log_likelihood(problem, states[0], covariances[0], inlier & ~later)
    later_log = _log_likelihood(problem, states[1], covariances[1], inlier & later)
    gain = np.concatenate([[0.0], np.cumsum(earlier_log - later_log)])
    gain[:LEAST_SIDE] = gain[len(gain) - LEAST_SIDE :] = -np.inf
    best = int(np.argmax(gain))
    return best if gain[best] > gain[boundary] + LEAST_GAIN else boundary


def _log_likelihood(problem: PackedProblem, state: SharedState, covariance: FloatArray, used: BoolArray) -> FloatArray:
    """(n,) log likelihood of each PM under a registration; it rests on those ``used``, whose own part is taken off."""
    terms = linearise(problem, state)
    jacobian, residual = terms.jacobian[0], terms.residual[0]
    spread = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
    one = np.eye(spread.shape[1])
    # Without a PM that was used, its predicted covariance is (1 - J C J')^-1.
    value, vector = np.linalg.eigh(np.where(used[:, None, None], one - spread, one + spread))
    value = np.maximum(value, LEAST_PRECISION)
    along = np.einsum("nab,na->nb", vector, residual) ** 2 / value
    log_det = np.where(used, -1.0, 1.0) * np.log(value).sum(axis=1)
    inlier = math.log1p(-OUTLIER_PRIOR) - 0.5 * (along.sum(axis=1) + log_det + terms.rest[0])
    outlier = math.log(OUTLIER_PRIOR) + 0.5 * terms.equations * math.log(OUTLIER_DENSITY)
    return np.asarray(np.logaddexp(inlier, outlier))
