"""Innovations: squared deviation of a shot from what the others predict, over the predicted covariance."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.linalg.lapack import dposv
from scipy.special import chdtri

from fgreg.geometry.transforms import FloatArray
from fgreg.graph.columns import Columns
from fgreg.graph.contributions import Parts, contributions
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.reduced_system import DIVERGED_MM, refine
from fgreg.graph.shared_state import Quadratic, SharedState
from fgreg.model.measurements import Aim, EpochStart, Measurements
from fgreg.registration.outliers import (
    AIM_LIMIT,
    DIVERGED_CHI2,
    innovations_of,
    limits_among,
    outlier_p,
)
from fgreg.smoother.isam_window import ActiveWindow, Prepared
from fgreg.smoother.shared_variables import small_step
from fgreg.smoother.state import Setting, State, pairs_of_epoch

PRIVATE_ROUNDS = 3


def sigma_distance(first: SharedState, second: SharedState, covariance: FloatArray, columns: Columns) -> float:
    """Mahalanobis distance of two states near each other."""
    scale = np.sqrt(covariance.diagonal())
    step = small_step(first, second, columns) / scale
    correlation = covariance / scale / scale[:, None]
    _, along, failed = dposv(correlation, step, lower=1)
    square = float(step @ (along if failed == 0 else np.linalg.solve(correlation, step)))
    return math.sqrt(max(square, 0.0))


def limit_of(degrees_of_freedom: int, inliers: int, count: int) -> float:
    """Chi square beyond which a PM is an outlier; ``inliers`` of ``count`` PMs, including this one, are inliers."""
    return float(chdtri(max(degrees_of_freedom, 1), outlier_p(inliers, count)))


def innovation(prepared: Prepared, covariance: FloatArray, before: Quadratic | None = None) -> float:
    """Squared deviation of a PM from what the others predict, over its predicted covariance.

    Args:
        prepared: at the present estimate, which is the optimum of the others and, where given, of ``before``.
        covariance: (D, D) of the present estimate.
        before: contribution of the same PM to the present estimate, about the same state.
    """
    if prepared.far:
        return prepared.quadratic.cost
    rows, residual = prepared.rows, prepared.residual
    if before is None:
        spread = np.eye(len(rows)) + rows @ covariance @ rows.T
        return float(residual @ np.linalg.solve(spread, residual))
    rest = np.linalg.inv(covariance) - before.hessian
    own = prepared.quadratic
    both = own.gradient - before.gradient
    joint = own.cost - float(both @ np.linalg.solve(rest + own.hessian, both))
    return joint + float(before.gradient @ np.linalg.solve(rest, before.gradient))


def misplaced_pms(state: State, setting: Setting) -> frozenset[int]:
    """Labels of the current epoch's PMs that are inliers beyond their limit, or outliers within it."""
    active = state.active_window
    if active is None or not state.current:
        return frozenset()
    measurements = Measurements((), pairs_of_epoch(state.current), (EpochStart(0.0),))
    parts, problem = _parts(measurements, active.state, setting)
    is_inlier = {shot.label: shot.inlier for shot in state.current}
    inlier = np.array([is_inlier[label] for label in problem.pms])
    found = innovations_of(*parts.pm.single(), _information(active), inlier)
    limits = limits_among(problem, inlier, *state.counts())
    misplaced = np.isfinite(found) & (inlier == (found > limits))
    return frozenset(label for label, wrong in zip(problem.pms, misplaced, strict=True) if wrong)


def aim_fits(aim: Aim, active: ActiveWindow, setting: Setting) -> bool:
    """Whether a calibration shot agrees with the estimate."""
    parts, _ = _parts(Measurements((aim,), (), (EpochStart(0.0),)), active.state, setting)
    found = innovations_of(*parts.aim.single(), _information(active), np.zeros(1, dtype=bool))
    return bool(found[0] <= AIM_LIMIT)


def _information(active: ActiveWindow) -> FloatArray:
    return np.asarray(np.linalg.inv(active.covariance), dtype=np.float64)


def _parts(measurements: Measurements, state: SharedState, setting: Setting) -> tuple[Parts, PackedProblem]:
    """Contributions of the shots of one epoch at a state; a PM that does not converge gets a large cost."""
    problem = setting.pack(measurements)
    private = initial_private(problem, state)
    with np.errstate(all="ignore"):  # numbers of an outlier may overflow
        for _ in range(PRIVATE_ROUNDS):
            private = refine(problem, state, private)
        parts = contributions(problem, state, private)
    diverged = np.linalg.norm(parts.private.trus_p_pm - private.trus_p_pm, axis=-1) > DIVERGED_MM
    cost = np.where(diverged, np.maximum(parts.pm.cost, DIVERGED_CHI2), parts.pm.cost)
    return replace(parts, pm=replace(parts.pm, cost=cost)), problem
