"""The graph with the private variables eliminated in closed form, for many hypotheses at once.

Private to a PM are its point, lambda and theta' of each look, and the marker pose of each beam. Given the shared
variables (registration, beam, window edge, ...) they enter through small blocks:

- point on line, lambda free: two residuals across the beam, ``N' (trus_p_pm - beam)``. The marker pose's error
  (w, n) has a Gaussian prior and enters linearly around its current estimate. Eliminating it leaves the same residual,
  shifted, with covariance ``J Sigma J'`` (the update of an iterated Kalman filter). The estimate is updated at every
  evaluation, so the fixed point is the optimum of the explicit graph, not of a linearised one.
- visible spot: three residuals in the point, seen from the camera.
- point on arc, theta' free, and the sensitivity prior: three residuals (x, range, rotation offset) in the point.
- the point itself: a 3 x 3 Schur complement.

The result is a small dense normal system on the shared variables, built by vectorised numpy. Its time is linear in the
number of pairs, and a leading dimension S lets all starts (or posterior samples) be evaluated in one call. Costs are
chi squares (twice the negative log of the density). The optimum is that of the reference, fgreg.graph.gtsam_graph.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced_blocks import PrivateState, along_beam, inner, look_columns, outer
from fgreg.graph.reduced_priors import prior_cost, prior_terms
from fgreg.graph.reduced_system import DIVERGED_MM, System, shared_derivatives, stacked, system_at
from fgreg.graph.shared_state import SharedState
from fgreg.graph.window_likelihood import log_shape_ratios


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """The reduced problem at a state.

    Attributes:
        cost: (S,) chi square, private variables at their (linearised) optimum.
        gradient: (S, D), hessian: (S, D, D): of half the cost.
        private: private variables after this evaluation's refinement, at the *same* shared variables.
        point_gain: (S, J, 3, D): derivative of the PMs by the shared variables.
        point_covariance: (S, J, 3, 3): of the PMs given the shared variables.
        pm_weight: (S, J), aim_weight: (S, A): weights of the loss. aim_cost: (S, A) chi square of each aim.
        lambda_mm: (S, B). aim_lambda_mm: (S, A). look_residual: (S, L, 3) over (x mm, range mm, rotation rad).
        aim_residual: (S, A, 2) mm, along x and y of the beam chart's nominal frame.
    """

    cost: FloatArray
    gradient: FloatArray
    hessian: FloatArray
    private: PrivateState
    point_gain: FloatArray
    point_covariance: FloatArray
    pm_weight: FloatArray
    aim_weight: FloatArray
    aim_cost: FloatArray
    lambda_mm: FloatArray
    look_residual: FloatArray
    aim_residual: FloatArray
    aim_lambda_mm: FloatArray

    def take(self, index: Any) -> Evaluation:
        """The hypotheses at ``index`` (anything that indexes an array's first dimension)."""
        arrays = {name: getattr(self, name)[index] for name in self.__slots__ if name != "private"}
        return Evaluation(private=self.private.take(index), **arrays)


def log_posterior(problem: PackedProblem, state: SharedState, private: PrivateState) -> FloatArray:
    """Log density (S,) of the shared variables, up to a constant.

    The private variables are at their optimum: ``-cost / 2``. They are not integrated out with flat priors. That would
    multiply the density by the volume of the private variables, which depends on the angle between beams and arcs. As
    in straight line fits with errors in both coordinates such an estimate is inconsistent (Neyman and Scott, 1948;
    Kendall and Stuart, vol. 2, ch. 29); the one with the private variables at their optimum is not.

    Where the problem keeps the windows' own shapes, the PMs' rotations are integrated over them
    (fgreg.graph.window_likelihood). Where it has outlier densities, each PM is a mixture of inlier and outlier.
    """
    system = system_at(problem, state, private)
    pms = _log_shapes(problem, state, system) - 0.5 * system.pm_cost.T
    if problem.log_outlier is not None:
        # The chi square of a PM that does not converge is anything, also next to nothing.
        pms = np.logaddexp(np.where(system.moved_mm.T > DIVERGED_MM, -np.inf, pms), problem.log_outlier)
    return np.asarray(pms.sum(axis=1) - 0.5 * (system.aim_cost.sum(axis=0) + prior_cost(problem, state)))


def _log_shapes(problem: PackedProblem, state: SharedState, system: System) -> FloatArray:
    """(S, J) log ratio of each PM's density with the windows' own shapes to that with the Gaussian sites."""
    if problem.shapes is None:
        return np.zeros((state.count, len(problem.pms)))
    by_point = system.look_raw[:, 2, 1:4]
    offset = system.look_raw[:, 2, 0] + np.einsum("nis,nis->ns", by_point, system.looks.spread(system.point_step))
    spread = np.einsum("nijs,njs->nis", system.looks.spread(system.point_covariance), by_point)
    variance = np.einsum("nis,nis->ns", by_point, spread)
    return log_shape_ratios(problem, state.constant(Constant.WINDOW_EDGE), offset.T, variance.T)


@dataclass(frozen=True, slots=True, eq=False)
class Costs:
    """Chi squares of S hypotheses: of each PM (S, J), each aim (S, A), the priors (S,).

    ``moved_mm`` (S, J): how far each PM moved when the private variables were refined.
    """

    pm: FloatArray
    aim: FloatArray
    prior: FloatArray
    moved_mm: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Weights:
    """Result of a loss: weights of the PMs (S, J) and aims (S, A), and the cost (S,) under it."""

    pm: FloatArray
    aim: FloatArray
    cost: FloatArray


Loss = Callable[[Costs], Weights]


def least_squares(costs: Costs) -> Weights:
    """The least squares loss: all weights are one."""
    total = costs.pm.sum(axis=1) + costs.aim.sum(axis=1) + costs.prior
    return Weights(np.ones_like(costs.pm), np.ones_like(costs.aim), total)


def evaluate(
    problem: PackedProblem, state: SharedState, private: PrivateState, loss: Loss = least_squares
) -> Evaluation:
    """Cost, gradient and Gauss-Newton Hessian on the shared variables, private ones eliminated.

    Args:
        problem: the packed measurements.
        state: S hypotheses.
        private: linearisation point of the private variables; refined once here (returned in ``private``).
        loss: of each PM's and aim's chi square.
    """
    system = system_at(problem, state, private, derivatives=True)
    by = shared_derivatives(problem, state, system)
    cost, prior_gradient, prior_hessian = prior_terms(problem, state)
    weights = loss(Costs(outer(system.pm_cost), outer(system.aim_cost), cost, outer(system.moved_mm)))
    look, rig, pms = system.look, look_columns(problem.columns), len(problem.beam_pm)
    line, spot, h_ps, look_t = by.line, by.spot, by.h_ps, look[:, :, 4:]
    if loss is not least_squares:
        line = line * np.concatenate([weights.pm[:, problem.beam_pm], weights.aim], axis=1)[..., None, None]
        spot = spot * weights.pm[:, problem.beam_pm[problem.spots.beam], None, None]
        h_ps = h_ps * weights.pm[..., None, None]
        look_t = look_t * inner(weights.pm)[problem.look_pm, None, None]
    hessian = stacked(line, by.line) + stacked(h_ps, by.point_gain)
    hessian[:, rig, rig] += np.einsum("nkis,nkjs->sij", look_t, look[:, :, 4:])
    gradient = stacked(line, outer(system.line[:, 0])[..., None])
    if spot.shape[1]:
        hessian += stacked(spot, by.spot)
        gradient = gradient + stacked(spot, outer(system.spot)[..., None])
    gradient = (gradient + stacked(h_ps, outer(system.point_step)[..., None]))[..., 0]
    gradient[:, rig] += np.einsum("nkis,nks->si", look_t, look[:, :, 0])
    gradient += prior_gradient
    hessian += prior_hessian
    lambda_mm = outer(along_beam(state, system.laser_p))
    return Evaluation(
        cost=weights.cost,
        gradient=gradient,
        hessian=hessian,
        private=system.private,
        point_gain=by.point_gain,
        point_covariance=outer(system.point_covariance),
        pm_weight=weights.pm,
        aim_weight=weights.aim,
        aim_cost=outer(system.aim_cost),
        lambda_mm=lambda_mm[:, :pms],
        look_residual=outer(system.look_raw[:, :, 0]),
        aim_residual=outer(system.aim_residual_mm),
        aim_lambda_mm=lambda_mm[:, pms:],
    )
