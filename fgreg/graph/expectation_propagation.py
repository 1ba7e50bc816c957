"""Gaussian sites for the sensitivity windows: expectation propagation (Minka, 2001) on the reduced problem.

A Gaussian as wide as the window is a poor approximation for a PM near the window's edge. Here each look has a Gaussian
site. Together with all the rest of the session (its *cavity*) it has the mean and variance that the interval itself
would give. The optimum with such sites is close to the posterior mean, and its inverse Hessian to the posterior's
covariance. The optimum of the intervals themselves would be undetermined, anywhere on a plateau.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.graph.packing import PackedProblem, RotationShapes, edge_sigma_rad
from fgreg.graph.reduced_blocks import look_block, times
from fgreg.graph.reduced_graph import Evaluation, evaluate
from fgreg.graph.reduced_solver import Optimum, optimize
from fgreg.graph.scaled_inverse import inverse_hessian
from fgreg.graph.shared_state import SharedState
from fgreg.graph.window_likelihood import LEAST_PRECISION
from fgreg.model.sensitivity import interval_moments, log_interval

ROUNDS, FEW_ROUNDS = 30, 12
"""Rounds after which sites that have not converged are dropped; usually they converge in about six."""
SETTLED = 0.02
"""Sites have converged when no rotation, nor its standard deviation, changes by more than this share of the latter."""
DAMPING = 0.8
"""Share of a site's change that is applied in one round."""
FARTHEST_SIGMA = 100.0
"""Longest Gauss-Newton step, in sigmas, after which sites are fitted; where they converge it is a few."""
UPHILL = 1.0
"""Largest rise of the cost (half a chi square) by a step: the step follows the last round's sites and linearisation.
If it were shortened for less, the sites would seem to have converged while the steps are only short."""
HALVINGS = 6
"""Number of times that a step is halved before the sites are dropped."""
LEAST_SITE = 1e-3
"""Precision of a site without information, rad^-2."""


def with_sites(problem: PackedProblem, centre_rad: FloatArray, precision: FloatArray) -> PackedProblem:
    """The problem with other Gaussian sites of its looks' rotations: centres (L,) rad, precisions (L,) rad^-2."""
    weight = problem.looks.weight.copy()
    weight[:, 2, 2] = precision
    return replace(problem, looks=replace(problem.looks, weight=weight, centre_rad=centre_rad))


def propagate(problem: PackedProblem, optimum: Optimum) -> tuple[PackedProblem, Optimum] | None:
    """Sites for the windows' shapes, and the optimum with them; None where they do not converge.

    Args:
        problem: with shapes, and the Gaussian priors as first sites.
        optimum: of that problem, one hypothesis.
    """
    if problem.shapes is None:
        return None
    settled = settle(problem, optimum.state, optimum.evaluation, rounds=FEW_ROUNDS)
    if settled is None:
        return None
    problem, state, at = settled
    return problem, optimize(problem, state, at.private)


def settle(
    problem: PackedProblem,
    state: SharedState,
    at: Evaluation,
    *,
    settled: float = SETTLED,
    damping: float = DAMPING,
    rounds: int = ROUNDS,
) -> tuple[PackedProblem, SharedState, Evaluation] | None:
    """Sites for the windows' shapes, and the state where they converged, near their optimum; None where they do not.

    Args:
        problem: with the Gaussian priors as first sites, which stay where it has no shapes.
        state: start, one hypothesis. at: the problem evaluated there.
        settled, damping, rounds: in place of ``SETTLED``, ``DAMPING`` and ``ROUNDS``.
    """
    if not len(problem.look_pm):
        return None
    precision = problem.looks.weight[:, 2, 2].copy()
    centre = problem.looks.centre_rad.copy()
    before, sigma_before = np.full((2, len(precision)), np.inf)
    for _ in range(rounds):
        covariance = inverse_hessian(at.hessian[0])
        if covariance is None:
            return None
        mean, variance = _look_marginals(problem, state, at, covariance)
        sigma = np.sqrt(variance)
        if (np.maximum(np.abs(mean - before), np.abs(sigma - sigma_before)) < settled * sigma).all():
            return problem, state, at
        before, sigma_before = mean, sigma
        if problem.shapes is not None:
            new_centre, new_precision = _new_sites(problem, problem.shapes, mean, variance, centre, precision)
            pull = (1.0 - damping) * precision * centre + damping * new_precision * new_centre
            precision = (1.0 - damping) * precision + damping * new_precision
            centre = pull / precision
            problem = with_sites(problem, centre, precision)
            at = evaluate(problem, state, at.private)
        # One Gauss-Newton step with the current sites; they are fitted again before the next step.
        stepped = _step(problem, state, at)
        if stepped is None:
            return None
        state, at = stepped
    return None


def _step(problem: PackedProblem, state: SharedState, at: Evaluation) -> tuple[SharedState, Evaluation] | None:
    """One Gauss-Newton step, halved until the cost does not rise; None where it always rises or is not finite.

    Among few pairs the full step can end far off, and sites that are fitted there diverge.
    """
    step = -np.linalg.solve(at.hessian[0], at.gradient[0])
    if not -(step @ at.gradient[0]) <= FARTHEST_SIGMA**2:
        return None
    for _ in range(HALVINGS):
        moved = state.retract(step[None], problem.columns)
        points = at.private.trus_p_pm + (at.point_gain @ step[None, None, :, None])[..., 0]
        there = evaluate(problem, moved, replace(at.private, trus_p_pm=points))
        if there.cost[0] <= at.cost[0] + UPHILL:
            return moved, there
        step = 0.5 * step
    return None


def _look_marginals(
    problem: PackedProblem, state: SharedState, at: Evaluation, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean and variance (L,) of ``rotation - edge_gain * window_edge``, all other variables marginalised."""
    look = look_block(problem, state, at.private.trus_p_pm[:, problem.look_pm])
    by_point = look.by_point[0, :, 2]
    by_shared = look.by_shared[0, :, 2] + np.einsum("lp,lpd->ld", by_point, at.point_gain[0][problem.look_pm])
    given_shared = np.sum(by_point * times(at.point_covariance[0][problem.look_pm], by_point), axis=-1)
    variance = given_shared + np.sum((by_shared @ covariance) * by_shared, axis=-1)
    return look.residual[0, :, 2] + problem.looks.centre_rad, variance


def _new_sites(
    problem: PackedProblem,
    shapes: RotationShapes,
    mean: FloatArray,
    variance: FloatArray,
    centre: FloatArray,
    precision: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Sites (centre, precision) with which each look has the moments of its interval."""
    q = np.maximum(1.0 / variance - precision, LEAST_PRECISION)
    cavity = (mean / variance - precision * centre) / q
    windows = shapes.windows
    # The half width's error shifts a first hit's interval, which the site follows by its gain. In the window-only case
    # it moves the two ends apart, which is added to the softness here.
    edge_variance = edge_sigma_rad(problem) ** 2
    soft = np.sqrt(windows.soft_rad**2 + np.where(problem.looks.edge_gain == 0.0, edge_variance, 0.0))
    low, high = windows.low_rad - cavity, windows.high_rad - cavity
    slope, curvature = interval_moments(low, high, np.sqrt(soft**2 + 1.0 / q))
    for pm, look in enumerate(shapes.amplitude_look):
        if look >= 0:
            d = shapes.plane_rad[pm] - problem.looks.scan_rad[look] - cavity[look]
            log = log_interval(low[look] - d, high[look] - d, soft[look]) - 0.5 * q[look] * d * d
            log = log + shapes.amplitude_log[pm]
            weight = np.exp(log - log.max())
            weight = weight / weight.sum()
            first = float(weight @ d)
            second = float(weight @ (d - first) ** 2)
            slope[look], curvature[look] = q[look] * first, q[look] - q[look] ** 2 * second
    left = np.maximum(1.0 - curvature / q, 1e-6)  # share of the cavity's variance that remains
    site = np.maximum(curvature / left, LEAST_SITE)
    # site * centre = (slope + cavity * curvature) / left
    return np.where(site > LEAST_SITE, (slope + cavity * curvature) / left / site, cavity + slope / site), site
