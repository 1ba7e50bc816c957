"""Samples of the posterior of the shared variables, and what they say about the error at the targets.

The Gaussian at the optimum is overconfident at few pairs, where the problem is visibly nonlinear. So the density with
the private variables integrated out (fgreg.reduced.log_marginal) is sampled: importance sampling from a Student
density around the optimum, whose centre and spread are refitted to the weighted samples once (adaptive importance
sampling, Cappe et al., 2004). Deterministic by seed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.estimate import PredictedTre
from fgreg.frames import FloatArray, exp_so3, inverse, log_so3, transform_points
from fgreg.packing import PackedProblem
from fgreg.reduced import log_marginal, refine
from fgreg.reduced_blocks import PrivateState
from fgreg.reduced_solver import Optimum
from fgreg.shared_state import SharedState, pose_difference

DEGREES_OF_FREEDOM = 6.0
"""Of the Student proposal: heavier tails than the posterior's, or rare samples would carry all the weight."""
QUANTILE = 0.95


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """Weighted samples of the shared variables.

    Attributes:
        mean: the estimate they are centred on (one hypothesis).
        step: (S, D) right-tangent deviations of the samples from it.
        weight: (S,) sums to 1.
        effective: number of independent samples they are worth.
        covariance: (D, D) second moment about the estimate.
    """

    mean: SharedState
    step: FloatArray
    weight: FloatArray
    effective: float
    covariance: FloatArray


def _repeat(state: SharedState, count: int) -> SharedState:
    return state.take(np.zeros(count, dtype=np.int64))


def _log_density(problem: PackedProblem, optimum: Optimum, step: FloatArray) -> FloatArray:
    """(S,) log marginal density at right-tangent deviations (S, D) from the optimum."""
    state = _repeat(optimum.state, len(step)).retract(step, problem.columns)
    at = optimum.evaluation
    points = at.private.trus_p_pm + (at.point_gain @ step[:, None, :, None])[..., 0]
    private = PrivateState(
        points,
        np.broadcast_to(at.private.beam_error, (len(step), *at.private.beam_error.shape[1:])),
        np.broadcast_to(at.private.aim_error, (len(step), *at.private.aim_error.shape[1:])),
    )
    _, private = refine(problem, state, private)
    log_density = log_marginal(problem, state, private)
    return np.where(np.isfinite(log_density), log_density, -np.inf)


def _student(
    rng: np.random.Generator, mean: FloatArray, root: FloatArray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Samples (S, D) of a multivariate Student density, and their log density up to a constant."""
    size = len(mean)
    normal = rng.standard_normal((count, size))
    stretch = np.sqrt(DEGREES_OF_FREEDOM / rng.chisquare(DEGREES_OF_FREEDOM, count))
    standard = normal * stretch[:, None]
    square = np.sum(standard**2, axis=1)
    log_density = -0.5 * (DEGREES_OF_FREEDOM + size) * np.log1p(square / DEGREES_OF_FREEDOM)
    return mean + standard @ root.T, log_density - np.log(np.diag(root)).sum()


def sample_posterior(problem: PackedProblem, optimum: Optimum, covariance: FloatArray, count: int, seed: int) -> Posterior:
    """Weighted samples of the posterior around an optimum of one hypothesis.

    Args:
        problem: the packed measurements.
        optimum: of :func:`fgreg.reduced_solver.optimize`.
        covariance: (D, D) of the shared variables at the optimum (inverse Hessian).
        count: samples of the second round; the first takes half as many.
        seed: of the random numbers.
    """
    rng = np.random.default_rng(seed)
    mean = np.zeros(len(covariance))
    root = np.linalg.cholesky(covariance)
    for draws in (count // 2, count):
        step, log_proposal = _student(rng, mean, root, draws)
        log_weight = _log_density(problem, optimum, step) - log_proposal
        weight = np.exp(log_weight - log_weight.max())
        weight /= weight.sum()
        centre = weight @ step
        spread = step - centre
        # Shrink towards the Gaussian at the optimum by what few effective samples cannot tell.
        effective = 1.0 / float(np.sum(weight**2))
        trust = effective / (effective + 2.0 * len(mean))
        mean = trust * centre
        moment = trust * (spread * weight[:, None]).T @ spread + (1.0 - trust) * covariance
        root = np.linalg.cholesky(moment)
    return Posterior(
        mean=optimum.state,
        step=step,
        weight=weight,
        effective=effective,
        covariance=np.asarray((step * weight[:, None]).T @ step),
    )
