"""Junk among the shots: graduated truncated loss, and who is in or out by innovation.

A false PM or a flipped marker is not noise: one such shot moves a least squares estimate by centimetres. Three steps:

1. Consensus of minimal sets: where to start (fgreg.registration.minimal_set_consensus).
2. Graduated loss: the chi square of each PM (and aim) on the reduced graph under a Cauchy loss that narrows, then a
   truncated one, by iteratively reweighted least squares from all starts side by side.
3. Innovation: each shot against the estimate *without* it, in closed form. Chi square of known degrees of freedom
   under the stated noise, so the share of good shots lost is known; those wrongly left out come back in.

What is kept is then solved by plain least squares: a session without junk is answered as if none of this were there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import chdtri

from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced_blocks import PrivateState
from fgreg.graph.reduced_graph import (
    Contributions,
    Costs,
    Evaluation,
    Loss,
    Parts,
    Weights,
    contributions,
    evaluate,
    private_at,
)
from fgreg.graph.reduced_solver import distinct, optimize
from fgreg.graph.shared_state import SharedState

OUTLIER_P = 1e-3
"""A shot is junk where a good one would deviate as much this rarely."""
OUTLIER_DENSITY = 0.012
"""Density of junk, over that of good shots at their middle: false PMs are everywhere in the image."""
FEW = 0.05
"""So small a share of deviating PMs does not mislead a least squares optimum whose cost is plausible."""
TYPICAL_P = 3e-3
IMPLAUSIBLE_P = 1e-4
CAUCHY_SCALES = (100.0, 20.0, 4.0)
"""Squared scales of the narrowing Cauchy loss, in chi square."""
STEPS_PER_SCALE = 3
MAX_STEPS = 30
SETTLE_ROUNDS = 8
TOLERANCE = 1e-4
"""Newton decrement (chi square) at which a descent ends."""
DIVERGED_MM, DIVERGED_CHI2 = 1.0, 1e4
"""A PM that moves by more in one step, after several, has no place that fits; it counts as so far off."""
UNKNOWN = 1e-9
"""Correlation eigenvalue below which the rest of the shots leaves a direction open."""


def pm_degrees_of_freedom(problem: PackedProblem) -> IntArray:
    """(J,) equations that each PM leaves over: 2 per beam and 3 per look less its 3 coordinates."""
    pms = len(problem.pms)
    beams = np.bincount(problem.beam_pm, minlength=pms)
    return np.asarray(2 * beams + 3 * np.bincount(problem.look_pm, minlength=pms) - 3)


def pm_limits(problem: PackedProblem, p: float = OUTLIER_P) -> FloatArray:
    """(J,) chi square beyond which a PM is junk."""
    return np.asarray(chdtri(np.maximum(pm_degrees_of_freedom(problem), 1), p))


def limits_among(problem: PackedProblem, pm_inlier: BoolArray, kept: int, count: int) -> FloatArray:
    """(J,) chi square beyond which PMs, of which ``pm_inlier`` count, are junk, where ``kept`` of ``count`` PMs count.

    One that does not count is judged as if it did: one at the border is in, whether it was in before or not.
    """
    inside, outside = pm_limits(problem, outlier_p_of(kept, count)), pm_limits(problem, outlier_p_of(kept + 1, count))
    return np.where(pm_inlier, inside, outside)


AIM_LIMIT = float(chdtri(2, OUTLIER_P))


def outlier_p(pm_inlier: BoolArray) -> float:
    """How rare a good shot's deviation has to be for junk, given which PMs (J,) are kept.

    Of two degrees of freedom a good shot's density falls as exp(-d / 2), and so does the share p that deviates by more
    than d: junk and good are equally likely where p is junk's density times the odds of junk.
    """
    return outlier_p_of(int(pm_inlier.sum()), len(pm_inlier))


def outlier_p_of(kept: int, count: int) -> float:
    """:func:`outlier_p` where so many of ``count`` PMs are kept."""
    return max(OUTLIER_P, OUTLIER_DENSITY * min((count - kept) / max(kept, 1), 1.0))


def log_outlier(problem: PackedProblem, pm_inlier: BoolArray) -> FloatArray:
    """(J,) log density of junk over that of a good PM at its best, times the odds of junk; see :func:`log_posterior`.

    Windows in their own shape are densities of the rotation, one over their width inside: so is what they are beside.
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


def plausible_cost(problem: PackedProblem) -> float:
    """Chi square of all shots beyond which they do not fit, whatever their innovations say."""
    unknowns = problem.columns.size - int(np.sum(problem.prior_information > 0)) - 6 * len(problem.links)
    seen = unknowns if len(problem.pms) else 4  # aims alone see the beam only
    equations = int(pm_degrees_of_freedom(problem).sum()) + 2 * len(problem.aims.rotation)
    return float(chdtri(max(equations - seen, 1), IMPLAUSIBLE_P))


# --- 2. graduated loss ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class RobustOptimum:
    """Distinct hypotheses at local minima of the truncated cost, best first.

    Attributes:
        state: of each hypothesis.
        cost: (S,) truncated chi square. aim_cost: (S, A) chi square of each aim.
        pm_inlier (S, J), aim_inlier (S, A): which shots count in full.
    """

    state: SharedState
    cost: FloatArray
    aim_cost: FloatArray
    pm_inlier: BoolArray
    aim_inlier: BoolArray


def _hessian_of(parts: Parts, pm: BoolArray, aim: BoolArray) -> FloatArray:
    """Hessian (D, D) of the parts that are kept, one hypothesis."""
    return np.asarray(
        parts.prior.hessian[0, 0] + parts.pm.hessian[0, pm].sum(axis=0) + parts.aim.hessian[0, aim].sum(axis=0)
    )


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


def _settled(problem: PackedProblem, state: SharedState, loss: Loss) -> Evaluation:
    """The starts as they are, in which a PM that still wanders counts as far off, whatever it passes on its way."""

    def with_diverged(costs: Costs) -> Weights:
        far = np.where(costs.moved_mm > DIVERGED_MM, np.maximum(costs.pm, DIVERGED_CHI2), costs.pm)
        return loss(replace(costs, pm=far))

    return evaluate(problem, state, private_at(problem, state), with_diverged)


def _settled_parts(problem: PackedProblem, state: SharedState) -> Parts:
    """What each shot adds at shared variables (one hypothesis); a PM that wanders counts as far off."""
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
    """Local minima of the truncated cost from S starts, by way of narrowing Cauchy losses.

    Args:
        problem: the packed measurements.
        state: S starts.
        robust_aims: doubt the aims, too; else they count in full.
        keep_within, wanted: of the truncated cost, as of :func:`fgreg.graph.reduced_solver.optimize`.
    """
    start: Evaluation | None = None
    private: PrivateState | None = None
    for scale in CAUCHY_SCALES:
        loss = partial(_cauchy, scale=scale, aim_scale=scale if robust_aims else np.inf)
        start = _settled(problem, state, loss) if private is None else None
        found = optimize(
            problem, state, private, max_iterations=STEPS_PER_SCALE, tolerance=TOLERANCE, loss=loss, start=start
        )
        # Most starts have come together by then.
        index = distinct(problem, found.state, found.evaluation)
        state, private = found.state.take(index), found.evaluation.private.take(index)
    return _truncated_minima(problem, state, robust_aims=robust_aims, keep_within=keep_within, wanted=wanted)


def graduated_or_near(problem: PackedProblem, state: SharedState, *, robust_aims: bool = False) -> RobustOptimum:
    """The better of :func:`graduated` and of the descent on the truncated cost alone, from one start.

    The wide losses may lead away from a start that is good already, and into another minimum.
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
    loss = partial(_truncated, limit=limit, aim_limit=aim_limit)
    for _ in range(2):
        found = optimize(
            problem,
            state,
            max_iterations=MAX_STEPS,
            tolerance=TOLERANCE,
            keep_within=keep_within,
            wanted=wanted,
            loss=loss,
            start=_settled(problem, state, loss),
        )
        state = found.state
    at, index = found.evaluation, distinct(problem, state, found.evaluation)
    return RobustOptimum(
        state.take(index), at.cost[index], at.aim_cost[index], at.pm_weight[index] > 0.5, at.aim_weight[index] > 0.5
    )


# --- 3. innovation --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Innovations:
    """Squared deviation of each shot from what the *other* kept shots predict, over its predicted covariance.

    ``pm`` (J,) and ``aim`` (A,): chi square of the shot's degrees of freedom. Infinite where the rest leaves the
    prediction open.
    """

    pm: FloatArray
    aim: FloatArray


def innovations(parts: Parts, pm_inlier: BoolArray, aim_inlier: BoolArray) -> Innovations:
    """Innovations of all shots at an optimum of the kept ones (one hypothesis), in closed form.

    With total Hessian H, leaving a shot of cost c, gradient g, Hessian A out moves the optimum to where the rest costs
    g' (H - A)^-1 g less: the innovation is c + g' (H - A)^-1 g. For a shot that was not in it is c - g' (H + A)^-1 g.
    """
    hessian = _hessian_of(parts, pm_inlier, aim_inlier)
    return Innovations(_innovation(parts.pm, hessian, pm_inlier), _innovation(parts.aim, hessian, aim_inlier))


def _innovation(part: Contributions, hessian: FloatArray, kept: BoolArray) -> FloatArray:
    sign = np.where(kept, -1.0, 1.0)
    cost, gradient, own = part.cost[0], part.gradient[0], part.hessian[0]
    seen = np.diag(hessian + own.sum(axis=0)) > UNKNOWN  # what no shot sees (the pose, of aims alone) does not matter
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


def innovations_of(part: Contributions, hessian: FloatArray, kept: BoolArray) -> FloatArray:
    """Innovations (n,) of shots, one hypothesis, at an optimum whose Hessian (D, D) holds those kept (n,)."""
    return _innovation(part, hessian, kept)


def innovations_at(
    problem: PackedProblem,
    state: SharedState,
    pm_inlier: BoolArray,
    aim_inlier: BoolArray,
    private: PrivateState | None = None,
) -> Innovations:
    """:func:`innovations` at shared variables (one hypothesis) that are the optimum of the kept shots.

    ``private`` where its private variables are known, else they are found.
    """
    parts = _settled_parts(problem, state) if private is None else contributions(problem, state, private)
    return innovations(parts, pm_inlier, aim_inlier)


@dataclass(frozen=True, slots=True, eq=False)
class BeyondLimit:
    """Shots beyond their limits: PMs (J,), aims (A,)."""

    pm: BoolArray
    aim: BoolArray


def beyond_limit(problem: PackedProblem, found: Innovations, pm_inlier: BoolArray) -> BeyondLimit:
    """Shots that deviate more than a good one may, where these PMs (J,) count.

    Infinite innovations say nothing: the rest predicted nothing.
    """
    limits = limits_among(problem, pm_inlier, int(pm_inlier.sum()), len(pm_inlier))
    pm, aim = found.pm > limits, found.aim > AIM_LIMIT
    return BeyondLimit(pm & np.isfinite(found.pm), aim & np.isfinite(found.aim))


@dataclass(frozen=True, slots=True, eq=False)
class InlierSelection:
    """Which shots are kept, PMs (J,) and aims (A,), at the least squares optimum of those kept (one hypothesis).

    ``settled``: every shot kept, and none of the others, is within its limit; False with borderline shots kept.
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
    """Least squares on those kept and innovations of all, in turn, until who is kept no longer changes.

    Args:
        problem: the packed measurements.
        state: one hypothesis.
        pm_inlier (J,), aim_inlier (A,): where to begin.
        select_aims: False leaves ``aim_inlier`` as it is.
    """
    seen: set[bytes] = set()
    settled = False
    for _ in range(SETTLE_ROUNDS):
        loss = partial(_fixed, pm_inlier=pm_inlier, aim_inlier=aim_inlier)
        state = optimize(problem, state, max_iterations=MAX_STEPS, tolerance=TOLERANCE, loss=loss).state
        found = innovations(_settled_parts(problem, state), pm_inlier, aim_inlier)
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
    """Whether PMs that are not in ``problem``, over the same shared variables, fit what is kept of it (J,)."""
    hessian = _hessian_of(_settled_parts(problem, selection.state), selection.pm_inlier, selection.aim_inlier)
    none = np.zeros(len(others.pms), dtype=bool)
    innovation = _innovation(_settled_parts(others, selection.state).pm, hessian, none)
    limits = limits_among(others, none, int(selection.pm_inlier.sum()), len(selection.pm_inlier))
    return np.asarray(innovation <= limits)
