"""The 95 % region of highest density of a registration's posterior.

With few pairs the posterior has tails that no ellipsoid covers. So a pose is tested by its profile density (the other
shared variables, such as beam and window edge, at their conditional optimum) against that of the posterior's samples.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.graph.reduced_graph import evaluate, log_posterior
from fgreg.graph.reduced_system import refine
from fgreg.graph.shared_state import SharedState, step_between
from fgreg.registration.posterior import (
    QUANTILE,
    Mode,
    Posterior,
    light,
    moved_private,
    pose_tangent,
    step_of_tangent,
    weighted_quantile,
)

SAMPLES = 400
ROUNDS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """The region: modes to measure densities from, the estimate, and the least log density inside."""

    modes: tuple[Mode, ...]
    mean: SharedState
    least: float

    def contains(self, trus_T_camera: FloatArray) -> bool:
        """Whether registrations (E, 4, 4), one per solved epoch, lie inside."""
        tangent = [pose_tangent(self.mean.trus_T_camera(k)[0], pose) for k, pose in enumerate(trus_T_camera)]
        columns = self.modes[0].problem.columns
        step = np.zeros((1, columns.size))
        step[0, : 6 * columns.epochs] = np.concatenate(tangent)
        state = self.mean.retract(step_of_tangent(step, columns), columns)
        return bool(pose_log_density(self.modes, state)[0] >= self.least)


def credible_region(modes: tuple[Mode, ...], posterior: Posterior, probability: float = 0.95) -> Region:
    """The region that holds ``probability`` of the posterior sampled from these modes."""
    lighter = tuple(light(mode) for mode in modes)
    # Systematic resampling: equal steps through the cumulated weights.
    at = (np.arange(SAMPLES) + 0.5) / SAMPLES
    pick = np.minimum(np.searchsorted(np.cumsum(posterior.weight), at), len(posterior.weight) - 1)
    state = posterior.mean.take(np.zeros(SAMPLES, dtype=np.int64)).retract(posterior.step[pick], posterior.columns)
    log = pose_log_density(lighter, state)
    least = weighted_quantile(log[:, None], np.full(SAMPLES, 1.0 / SAMPLES), 1.0 - probability)[0]
    return Region(lighter, posterior.mean, float(least))


def ellipsoid_contains(posterior: Posterior, trus_T_camera: FloatArray, epoch: int = 0) -> bool:
    """Whether a registration (4, 4) lies in the posterior's 95 % ellipsoid of that epoch.

    It has the axes of the posterior's covariance in GTSAM's tangent about the estimate, and a size such that it
    contains 95 % of the posterior (which is not Gaussian with few pairs).
    """
    at = slice(6 * epoch, 6 * epoch + 6)
    information = np.linalg.inv(posterior.covariance[at, at])
    tangent = pose_tangent(posterior.mean.trus_T_camera(epoch)[0], trus_T_camera)
    square = np.einsum("si,ij,sj->s", posterior.tangent[:, at], information, posterior.tangent[:, at])
    limit = weighted_quantile(square[:, None], posterior.weight, QUANTILE)[0]
    return bool(tangent @ information @ tangent <= limit)


def pose_log_density(modes: tuple[Mode, ...], state: SharedState) -> FloatArray:
    """(S,) log density of the registrations of states, the other shared variables at their best for each."""
    return np.asarray(np.max([_from_mode(mode, state) for mode in modes], axis=0))


def _from_mode(mode: Mode, state: SharedState) -> FloatArray:
    problem, at = mode.problem, mode.optimum.evaluation
    columns, count = problem.columns, state.count
    step = step_between(mode.optimum.state, state, columns)
    poses = 6 * columns.epochs
    # The others start at their conditional mean under the mode's Gaussian.
    inverse = np.linalg.inv(at.hessian[0][poses:, poses:])
    step[:, poses:] = -step[:, :poses] @ at.hessian[0][:poses, poses:] @ inverse
    start = mode.optimum.state.take(np.zeros(count, dtype=np.int64))
    private = at.private.take(np.zeros(count, dtype=np.int64))
    private = replace(private, trus_p_pm=private.trus_p_pm + (at.point_gain @ step[:, None, :, None])[..., 0])
    moved = start.retract(step, columns)
    # Gauss-Newton steps are limited to the mode's spread: far from the mode they are unreliable.
    hold = 0.01 * np.diag(np.diag(at.hessian[0]))[poses:, poses:]
    with np.errstate(all="ignore"):
        for _ in range(ROUNDS):
            there = evaluate(problem, moved, private)
            change = np.zeros_like(step)
            hessian = np.nan_to_num(there.hessian[:, poses:, poses:]) + hold
            change[:, poses:] = -np.linalg.solve(hessian, np.nan_to_num(there.gradient[:, poses:, None]))[..., 0]
            moved, private = moved.retract(change, columns), there.private
        if mode.mixture is not None:
            problem, private = (
                mode.mixture.problem,
                moved_private(mode, step_between(mode.optimum.state, moved, columns)),
            )
            private = refine(problem, moved, private)
        private = refine(problem, moved, private)
        log = log_posterior(problem, moved, private)
    return np.where(np.isfinite(log), log, -np.inf)
