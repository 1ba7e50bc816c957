"""Samples of the posterior of the shared variables, and what they say about the error at the targets.

The Gaussian at the optimum is overconfident at few pairs, where the problem is visibly nonlinear. So the density with
the private variables integrated out (fgreg.graph.reduced.log_marginal) is sampled: importance sampling from a Student
density around the optimum, whose centre and spread are refitted to the weighted samples once (adaptive importance
sampling, Cappe et al., 2004). Deterministic by seed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgreg.estimate import PredictedTre
from fgreg.frames import FloatArray, exp_so3, inverse, transform_points
from fgreg.graph.packing import Columns, PackedProblem
from fgreg.graph.reduced import log_marginal, refine
from fgreg.graph.reduced_solver import Optimum
from fgreg.graph.shared_state import SharedState

DEGREES_OF_FREEDOM = 6.0
"""Of the Student proposal: heavier tails than the posterior's, or rare samples would carry all the weight."""
QUANTILE = 0.95


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """Weighted samples of the shared variables.

    Attributes:
        columns: where each shared variable sits in ``step``.
        mean: the estimate they are centred on (one hypothesis).
        step: (S, D) right-tangent deviations of the samples from it.
        weight: (S,) sums to 1.
        effective: number of independent samples they are worth.
        covariance: (D, D) second moment about the estimate.
    """

    columns: Columns
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
    private = replace(at.private.take(np.zeros(len(step), dtype=np.int64)), trus_p_pm=points)
    _, private = refine(problem, state, private)
    log_density = log_marginal(problem, state, private)
    return np.where(np.isfinite(log_density), log_density, -np.inf)


def _student(rng: np.random.Generator, mean: FloatArray, root: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Samples (S, D) of a multivariate Student density, and their log density up to a constant."""
    size = len(mean)
    normal = rng.standard_normal((count, size))
    stretch = np.sqrt(DEGREES_OF_FREEDOM / rng.chisquare(DEGREES_OF_FREEDOM, count))
    standard = normal * stretch[:, None]
    square = np.sum(standard**2, axis=1)
    log_density = -0.5 * (DEGREES_OF_FREEDOM + size) * np.log1p(square / DEGREES_OF_FREEDOM)
    return mean + standard @ root.T, log_density - np.log(np.diag(root)).sum()


def sample_posterior(
    problem: PackedProblem, optimum: Optimum, covariance: FloatArray, count: int, seed: int
) -> Posterior:
    """Weighted samples of the posterior around an optimum of one hypothesis.

    Args:
        problem: the packed measurements.
        optimum: of :func:`fgreg.graph.reduced_solver.optimize`.
        covariance: (D, D) of the shared variables at the optimum (inverse Hessian).
        count: samples of the second round; the first takes half as many.
        seed: of the random numbers.
    """
    rng = np.random.default_rng(seed)
    mean = np.zeros(len(covariance))
    root = np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)
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
        root = np.asarray(np.linalg.cholesky(moment), dtype=np.float64)
    return Posterior(
        columns=problem.columns,
        mean=optimum.state,
        step=step,
        weight=weight,
        effective=effective,
        covariance=np.asarray((step * weight[:, None]).T @ step),
    )


def weighted_quantile(values: FloatArray, weight: FloatArray, quantile: float) -> FloatArray:
    """Quantile along the first axis of (S, n) values with weights (S,): (n,)."""
    order = np.argsort(values, axis=0)
    cumulative = np.cumsum(weight[order], axis=0)
    row = np.minimum((cumulative < quantile).sum(axis=0), len(values) - 1)
    return np.asarray(np.take_along_axis(np.take_along_axis(values, order, axis=0), row[None], axis=0)[0])


def target_errors(posterior: Posterior, epoch: int, targets_mm: FloatArray) -> FloatArray:
    """(S, n) distances (mm) by which each sample moves the camera points that the estimate puts at the targets."""
    estimate = posterior.mean.trus_T_camera(epoch)[0]
    camera_p = transform_points(inverse(estimate), targets_mm)
    twist = posterior.step[:, 6 * epoch : 6 * epoch + 6]
    # A sample is estimate * (Exp(omega), v): in camera axes it moves p to Exp(omega) p + v.
    moved = np.einsum("sij,nj->sni", exp_so3(twist[:, :3]), camera_p) + twist[:, None, 3:] - camera_p
    return np.asarray(np.linalg.norm(moved, axis=-1))


def predicted_tre(posterior: Posterior, epoch: int, targets_mm: FloatArray) -> PredictedTre:
    """Predicted target registration error of one epoch (definitions: :class:`fgreg.estimate.PredictedTre`)."""
    error = target_errors(posterior, epoch, targets_mm)
    quantiles = weighted_quantile(error, posterior.weight, QUANTILE)
    return PredictedTre(
        mean_mm=float(np.sqrt(posterior.weight @ error**2).mean()),
        p95_mm=float(quantiles.mean()),
        worst_mm=float(quantiles.max()),
    )
