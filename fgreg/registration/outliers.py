"""Outlier rejection: graduated truncated loss, then inlier selection by innovation.

A false PM or a flipped marker is not noise: one such shot moves a least squares estimate by centimetres. Three steps:

1. Consensus of minimal sets gives starts (fgreg.registration.minimal_set_consensus).
2. Graduated loss: the chi square of each PM (and aim) on the reduced graph under a narrowing Cauchy loss, then under a
   truncated one, by iteratively reweighted least squares from all starts in parallel.
3. Innovation: each shot is tested against the estimate *without* it, in closed form. Under the stated noise this is a
   chi square of known degrees of freedom, so the share of inliers lost is known. Inliers that were wrongly left out
   are selected again.

The inliers are then solved by plain least squares. A session without outliers has the result of plain least squares.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import chdtri

from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray
from fgreg.graph.contributions import Contributions, Parts, contributions, pms_by_epochs
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced_blocks import PrivateState
from fgreg.graph.reduced_graph import Costs, Loss, Weights, evaluate
from fgreg.graph.reduced_solver import distinct, optimize
from fgreg.graph.reduced_system import DIVERGED_MM, private_at
from fgreg.graph.scaled_inverse import UNKNOWN, without_others
from fgreg.graph.shared_state import SharedState

OUTLIER_P = 1e-3
"""A shot is an outlier where an inlier would deviate as much with at most this probability."""
OUTLIER_DENSITY = 0.012
"""Density of outliers over the peak density of inliers: false PMs are anywhere in the image."""
FEW = 0.05
"""Share of outlier PMs up to which a least squares optimum of plausible cost is not misled."""
TYPICAL_P = 3e-3
IMPLAUSIBLE_P = 1e-4
CAUCHY_SCALES = (100.0, 20.0, 4.0)
"""Squared scales of the narrowing Cauchy loss, in chi square."""
STEPS_PER_SCALE = 3
MAX_STEPS = 30
SETTLE_ROUNDS = 8
TOLERANCE = 1e-4
"""Newton decrement (chi square) at which a descent ends."""
DIVERGED_CHI2 = 1e4
"""Least chi square of a PM that does not converge."""


def pm_degrees_of_freedom(problem: PackedProblem) -> IntArray:
    """(J,) degrees of freedom of each PM: 2 equations per beam, 3 per look and per spot, less its 3 coordinates."""
    pms = len(problem.pms)
    beams = np.bincount(problem.beam_pm, minlength=pms)
    spots = np.bincount(problem.beam_pm[problem.spots.beam], minlength=pms)
    return np.asarray(2 * beams + 3 * (np.bincount(problem.look_pm, minlength=pms) + spots) - 3)


def pm_limits(problem: PackedProblem, p: float = OUTLIER_P) -> FloatArray:
    """(J,) chi square beyond which a PM is an outlier."""
    return np.asarray(chdtri(np.maximum(pm_degrees_of_freedom(problem), 1), p))


def limits_among(problem: PackedProblem, pm_inlier: BoolArray, kept: int, count: int) -> FloatArray:
    """(J,) chi square beyond which PMs are outliers, where ``kept`` of ``count`` PMs are inliers.

    A PM that is not in ``pm_inlier`` has the limit that it would have as an inlier. So a borderline PM is an inlier,
    whether it was one before or not.
    """
    inside, outside = pm_limits(problem, outlier_p(kept, count)), pm_limits(problem, outlier_p(kept + 1, count))
    return np.where(pm_inlier, inside, outside)


AIM_LIMIT = float(chdtri(2, OUTLIER_P))


def outlier_p(inliers: int, count: int) -> float:
    """Tail probability p of an inlier's deviation below which a shot is an outlier, for ``inliers`` of ``count`` PMs.

    With two degrees of freedom an inlier's density falls as exp(-d / 2), and so does the share p that deviates by more
    than d. Inlier and outlier are equally likely where p is the outlier density times the odds of an outlier.
    """
    return max(OUTLIER_P, OUTLIER_DENSITY * min((count - inliers) / max(inliers, 1), 1.0))


def log_outlier(problem: PackedProblem, pm_inlier: BoolArray) -> FloatArray:
    """(J,) log of the outlier density over an inlier's peak density, times the odds; see :func:`log_posterior`.

    A window in its own shape is a density of the rotation, one over its width inside; the outlier density then has the
    same factor.
    """
    kept = int(pm_inlier.sum())
    odds = (len(pm_inlier) - kept + 0.5) / (kept + 0.5)
    log = 0.5 * pm_degrees_of_freedom(problem) * np.log(OUTLIER_DENSITY) + np.log(odds)
    if problem.shapes is None:
        return np.asarray(log)
    windows = problem.shapes.windows
    first = np.zeros(len(problem.pms), dtype=np.int64)
    first[problem.look_pm[::-1]] = np.arange(len(problem.look_pm))[::-1]
    return np.asarray(log - np.log(windows.high_rad - windows.low_rad)[first])


def free_variables(problem: PackedProblem) -> int:
    """Number of the shared variables, less the number of equations that are their priors."""
    known = len(problem.columns.constants) + 6 * len(problem.links)
    if problem.anchor is not None:
        hessian = problem.anchor.hessian
        scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-30))
        known += int(np.linalg.matrix_rank(hessian * scale * scale[:, None], tol=UNKNOWN, hermitian=True))
    return problem.columns.size - known


def plausible_cost(problem: PackedProblem) -> float:
    """Chi square of all shots beyond which they do not fit together, whatever their innovations."""
    unknowns = free_variables(problem)
    seen = unknowns if len(problem.pms) else 4  # aims alone determine the beam only
    equations = int(pm_degrees_of_freedom(problem).sum()) + 2 * len(problem.aims.rotation) + 3 * len(problem.points)
    return float(chdtri(max(equations - seen, 1), IMPLAUSIBLE_P))


# --- 2. graduated loss ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class RobustOptimum:
    """Distinct hypotheses at local minima of the truncated cost, best first.

    Attributes:
        state: of each hypothesis.
        cost: (S,) truncated chi square. aim_cost: (S, A) chi square of each aim.
        pm_inlier (S, J), aim_inlier (S, A): which shots have full weight.
    """

    state: SharedState
    cost: FloatArray
    aim_cost: FloatArray
    pm_inlier: BoolArray
    aim_inlier: BoolArray


def _hessian_of(parts: Parts, pm: BoolArray, aim: BoolArray) -> FloatArray:
    """Hessian (D, D) of the prior and the inliers, one hypothesis."""
    weights = pm.astype(np.float64), aim.astype(np.float64)
    return np.asarray((parts.prior_hessian + parts.pm.total(weights[0]) + parts.aim.total(weights[1]))[0])


def _cauchy(costs: Costs, scale: float, aim_scale: float) -> Weights:
    """Cauchy loss: cost k log(1 + c / k), weight 1 / (1 + c / k). An infinite scale is least squares."""
    total = costs.prior
    weights = []
    for cost, k in ((costs.pm, scale), (costs.aim, aim_scale)):
        c = np.maximum(cost, 0.0)
        weights.append(1.0 / (1.0 + c / k))
        total = total + np.sum(c if np.isinf(k) else k * np.log1p(c / k), axis=1)
    return Weights(weights[0], weights[1], total)


def _truncated(costs: Costs, limit: FloatArray, aim_limit: float) -> Weights:
    total = costs.prior + np.minimum(costs.pm, limit).sum(axis=1) + np.minimum(costs.aim, aim_limit).sum(axis=1)
    return Weights((costs.pm <= limit).astype(float), (costs.aim <= aim_limit).astype(float), total)


def _fixed(costs: Costs, pm_inlier: BoolArray, aim_inlier: BoolArray) -> Weights:
    pm, aim = pm_inlier + np.zeros_like(costs.pm), aim_inlier + np.zeros_like(costs.aim)
    return Weights(pm, aim, costs.prior + (pm * costs.pm).sum(axis=1) + (aim * costs.aim).sum(axis=1))


def _converged_pms(loss: Loss) -> Loss:
    """The loss, in which a PM that does not converge gets a large cost, whatever its residual is."""

    def of(costs: Costs) -> Weights:
        far = np.where(costs.moved_mm > DIVERGED_MM, np.maximum(costs.pm, DIVERGED_CHI2), costs.pm)
        return loss(replace(costs, pm=far))

    return of


def _settled_parts(problem: PackedProblem, state: SharedState) -> Parts:
    """Contributions of the shots at a state (one hypothesis); a PM that does not converge gets a large cost."""
    before = private_at(problem, state)
    parts = contributions(problem, state, before)
    diverged = np.linalg.norm(parts.private.trus_p_pm - before.trus_p_pm, axis=-1) > DIVERGED_MM
    cost = np.where(diverged, np.maximum(parts.pm.cost, DIVERGED_CHI2), parts.pm.cost)
    return replace(parts, pm=replace(parts.pm, cost=cost))


def graduated(
    problem: PackedProblem,
    state: SharedState,
    *,
    robust_aims: bool = False,
    keep_within: float | None = None,
    wanted: float = np.inf,
) -> RobustOptimum:
    """Local minima of the truncated cost from S starts, after a series of narrowing Cauchy losses.

    Args:
        problem: the packed measurements.
        state: S starts.
        robust_aims: aims may be outliers, too; else they have full weight.
        keep_within, wanted: of the truncated cost, as of :func:`fgreg.graph.reduced_solver.optimize`.
    """
    private: PrivateState | None = None
    for scale in CAUCHY_SCALES:
        loss = partial(_cauchy, scale=scale, aim_scale=scale if robust_aims else np.inf)
        start = None
        if private is None:
            start = evaluate(problem, state, private_at(problem, state), _converged_pms(loss))
        found = optimize(
            problem, state, private, max_iterations=STEPS_PER_SCALE, tolerance=TOLERANCE, loss=loss, start=start
        )
        # Most starts have reached the same optima by then.
        index = distinct(problem, found.state, found.evaluation)
        state, private = found.state.take(index), found.evaluation.private.take(index)
    return _truncated_minima(problem, state, robust_aims=robust_aims, keep_within=keep_within, wanted=wanted)


def graduated_or_near(problem: PackedProblem, state: SharedState, *, robust_aims: bool = False) -> RobustOptimum:
    """The better of :func:`graduated` and a descent on the truncated cost alone, from S starts.

    From a good start the wide losses may lead into another minimum.
    """
    far = graduated(problem, state, robust_aims=robust_aims)
    near = _truncated_minima(problem, state, robust_aims=robust_aims)
    return near if near.cost[0] < far.cost[0] else far


def _truncated_minima(
    problem: PackedProblem,
    state: SharedState,
    *,
    robust_aims: bool,
    keep_within: float | None = None,
    wanted: float = np.inf,
) -> RobustOptimum:
    limit, aim_limit = pm_limits(problem, TYPICAL_P), AIM_LIMIT if robust_aims else np.inf
    loss = _converged_pms(partial(_truncated, limit=limit, aim_limit=aim_limit))
    for _ in range(2):
        found = optimize(
            problem,
            state,
            max_iterations=MAX_STEPS,
            tolerance=TOLERANCE,
            keep_within=keep_within,
            wanted=wanted,
            loss=loss,
        )
        state = found.state
    at, index = found.evaluation, distinct(problem, state, found.evaluation)
    return RobustOptimum(
        state.take(index), at.cost[index], at.aim_cost[index], at.pm_weight[index] > 0.5, at.aim_weight[index] > 0.5
    )


# --- 3. innovation --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Innovations:
    """Squared deviation of each shot from what the *other* inliers predict, over its predicted covariance.

    ``pm`` (J,) and ``aim`` (A,): chi square with the shot's degrees of freedom. Infinite where the other inliers do not
    determine the prediction.
    """

    pm: FloatArray
    aim: FloatArray


def innovations(problem: PackedProblem, parts: Parts, pm_inlier: BoolArray, aim_inlier: BoolArray) -> Innovations:
    """Innovations of all shots at the optimum of the inliers (one hypothesis), in closed form.

    Let H be the total Hessian. Without an inlier of cost c, gradient g, Hessian A the cost of the rest has its optimum
    g' (H - A)^-1 g lower, so the innovation is c + g' (H - A)^-1 g. That of an outlier is c - g' (H + A)^-1 g.
    """
    hessian = _hessian_of(parts, pm_inlier, aim_inlier)
    return Innovations(
        pm_innovations(problem, parts.pm, hessian, pm_inlier),
        innovations_of(*parts.aim.single(), hessian, aim_inlier),
    )


def pm_innovations(problem: PackedProblem, part: Contributions, hessian: FloatArray, kept: BoolArray) -> FloatArray:
    """:func:`innovations_of` PMs (J,) of a problem. The registrations of epochs that PMs do not observe are eliminated
    from the Hessian once for each epoch, so that each PM has a small system."""
    out = np.empty(len(kept))
    for group in pms_by_epochs(problem):
        stay = group.columns
        own = part.single(group.pms, stay)
        out[group.pms] = innovations_of(*own, without_others(hessian, stay), kept[group.pms])
    return out


def innovations_of(
    cost: FloatArray, gradient: FloatArray, own: FloatArray, hessian: FloatArray, kept: BoolArray
) -> FloatArray:
    """Innovations (n,) of shots at the optimum of the inliers, one hypothesis.

    Args:
        cost, gradient, own: (n,), (n, D), (n, D, D) contributions of the shots.
        hessian: (D, D) of the inliers and priors together.
        kept: (n,) which shots are inliers.
    """
    sign = np.where(kept, -1.0, 1.0)
    # Variables that no shot observes (the pose, of aims) do not matter.
    seen = np.diag(hessian + own.sum(axis=0)) > UNKNOWN
    if not seen.any():
        return np.full(len(cost), np.inf)
    gradient = gradient[:, seen]
    rest = (hessian + sign[:, None, None] * own)[:, seen][:, :, seen]
    scale = np.sqrt(np.maximum(np.diagonal(rest, axis1=1, axis2=2), 0.0))
    out = np.full(len(cost), np.inf)
    good = (scale > UNKNOWN).all(axis=1)
    scale = scale[good]
    eigenvalue, vector = np.linalg.eigh(rest[good] / scale[:, :, None] / scale[:, None, :])
    along = np.einsum("nab,na->nb", vector, gradient[good] / scale)
    moved = np.sum(along**2 / np.maximum(eigenvalue, 1e-12), axis=1)
    out[good] = np.where(eigenvalue[:, 0] > UNKNOWN, cost[good] - sign[good] * moved, np.inf)
    return out


def innovations_at(
    problem: PackedProblem,
    state: SharedState,
    pm_inlier: BoolArray,
    aim_inlier: BoolArray,
    private: PrivateState | None = None,
) -> Innovations:
    """:func:`innovations` at shared variables (one hypothesis) that are the optimum of the inliers.

    ``private``: the private variables there; they are optimised where None.
    """
    parts = _settled_parts(problem, state) if private is None else contributions(problem, state, private)
    return innovations(problem, parts, pm_inlier, aim_inlier)


@dataclass(frozen=True, slots=True, eq=False)
class BeyondLimit:
    """Shots beyond their limits: PMs (J,), aims (A,)."""

    pm: BoolArray
    aim: BoolArray


def beyond_limit(problem: PackedProblem, found: Innovations, pm_inlier: BoolArray) -> BeyondLimit:
    """Shots whose innovation is beyond their limit, given the inlier PMs (J,).

    A shot of infinite innovation is not beyond its limit: the others predict nothing for it.
    """
    limits = limits_among(problem, pm_inlier, int(pm_inlier.sum()), len(pm_inlier))
    pm, aim = found.pm > limits, found.aim > AIM_LIMIT
    return BeyondLimit(pm & np.isfinite(found.pm), aim & np.isfinite(found.aim))


@dataclass(frozen=True, slots=True, eq=False)
class InlierSelection:
    """Inlier PMs (J,) and aims (A,), and their least squares optimum (one hypothesis).

    ``settled``: all inliers are within their limits, and no outlier is; False where borderline shots are inliers.
    """

    state: SharedState
    pm_inlier: BoolArray
    aim_inlier: BoolArray
    settled: bool


def select_inliers(
    problem: PackedProblem,
    state: SharedState,
    pm_inlier: BoolArray,
    aim_inlier: BoolArray,
    *,
    select_aims: bool = True,
) -> InlierSelection:
    """Alternate least squares of the inliers and innovations of all shots until the inliers no longer change.

    Args:
        problem: the packed measurements.
        state: one hypothesis.
        pm_inlier (J,), aim_inlier (A,): first inliers.
        select_aims: False leaves ``aim_inlier`` as it is.
    """
    seen: set[bytes] = set()
    settled = False
    for _ in range(SETTLE_ROUNDS):
        loss = partial(_fixed, pm_inlier=pm_inlier, aim_inlier=aim_inlier)
        state = optimize(problem, state, max_iterations=MAX_STEPS, tolerance=TOLERANCE, loss=loss).state
        found = innovations(problem, _settled_parts(problem, state), pm_inlier, aim_inlier)
        beyond = beyond_limit(problem, found, pm_inlier)
        pm_next = ~beyond.pm & (pm_inlier | np.isfinite(found.pm))
        aim_next = ~beyond.aim & (aim_inlier | np.isfinite(found.aim)) if select_aims else aim_inlier
        settled = bool((pm_next == pm_inlier).all() and (aim_next == aim_inlier).all())
        if settled:
            break
        seen.add(pm_inlier.tobytes() + aim_inlier.tobytes())
        if pm_next.tobytes() + aim_next.tobytes() in seen:  # a borderline shot: in when out, out when in
            pm_inlier, aim_inlier = pm_inlier | pm_next, aim_inlier | aim_next
            break
        pm_inlier, aim_inlier = pm_next, aim_next
    return InlierSelection(state, pm_inlier, aim_inlier, settled)


def predicted_pms(others: PackedProblem, problem: PackedProblem, selection: InlierSelection) -> BoolArray:
    """(J,) whether PMs that are not in ``problem``, over the same shared variables, fit its inliers."""
    hessian = _hessian_of(_settled_parts(problem, selection.state), selection.pm_inlier, selection.aim_inlier)
    none = np.zeros(len(others.pms), dtype=bool)
    innovation = pm_innovations(others, _settled_parts(others, selection.state).pm, hessian, none)
    limits = limits_among(others, none, int(selection.pm_inlier.sum()), len(selection.pm_inlier))
    return np.asarray(innovation <= limits)
