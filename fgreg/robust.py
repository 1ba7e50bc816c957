"""Junk among the shots: graduated truncated loss, and who is in or out by innovation.

A false PM or a flipped marker is not noise: one such shot moves a least squares estimate by centimetres. Three steps:

1. Consensus of minimal sets: where to start (fgreg.consensus).
2. Graduated loss: the chi square of each PM (and aim) on the reduced graph under a Cauchy loss that narrows, then a
   truncated one, by iteratively reweighted least squares from all starts side by side.
3. Innovation: each shot against the estimate *without* it, in closed form. Chi square of known degrees of freedom
   under the stated noise, so the share of good shots lost is known; those wrongly left out come back in.

What is kept is then solved by plain least squares: a session without junk is answered as if none of this were there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.special import chdtri

from fgreg.frames import BoolArray, FloatArray, IntArray
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced import Contributions, Parts, contributions, refine
from fgreg.graph.reduced_blocks import PrivateState, initial_private
from fgreg.graph.shared_state import SharedState

JUNK_P = 1e-3
"""A shot is junk where a good one would deviate as much this rarely."""
JUNK_DENSITY = 0.012
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
WEIGHT_FLOOR = 1e-12
WANDERS_MM, WANDERING_CHI2 = 1.0, 1e4
"""A PM that moves by more in one step, after several, has no place that fits; it counts as so far off."""
UNKNOWN = 1e-9
"""Correlation eigenvalue below which the rest of the shots leaves a direction open."""


def pm_degrees_of_freedom(problem: PackedProblem) -> IntArray:
    """(J,) equations that each PM leaves over: 2 per beam and 3 per look less its 3 coordinates."""
    pms = len(problem.pms)
    beams = np.bincount(problem.beam_pm, minlength=pms)
    return np.asarray(2 * beams + 3 * np.bincount(problem.look_pm, minlength=pms) - 3)


def pm_limits(problem: PackedProblem, p: float = JUNK_P) -> FloatArray:
    """(J,) chi square beyond which a PM is junk."""
    return np.asarray(chdtri(np.maximum(pm_degrees_of_freedom(problem), 1), p))


def limits_among(problem: PackedProblem, pm_kept: BoolArray, kept: int, count: int) -> FloatArray:
    """(J,) chi square beyond which PMs, of which ``pm_kept`` count, are junk, where ``kept`` of ``count`` PMs count.

    One that does not count is judged as if it did: one at the border is in, whether it was in before or not.
    """
    inside, outside = pm_limits(problem, junk_p_of(kept, count)), pm_limits(problem, junk_p_of(kept + 1, count))
    return np.where(pm_kept, inside, outside)


AIM_LIMIT = float(chdtri(2, JUNK_P))


def junk_p(pm_kept: BoolArray) -> float:
    """How rare a good shot's deviation has to be for junk, given which PMs (J,) are kept.

    Of two degrees of freedom a good shot's density falls as exp(-d / 2), and so does the share p that deviates by more
    than d: junk and good are equally likely where p is junk's density times the odds of junk.
    """
    return junk_p_of(int(pm_kept.sum()), len(pm_kept))


def junk_p_of(kept: int, count: int) -> float:
    """:func:`junk_p` where so many of ``count`` PMs are kept."""
    return max(JUNK_P, JUNK_DENSITY * min((count - kept) / max(kept, 1), 1.0))


def log_junk(problem: PackedProblem, pm_kept: BoolArray) -> FloatArray:
    """(J,) log density of junk over that of a good PM at its best, times the odds of junk; see :func:`log_posterior`.

    Windows in their own shape are densities of the rotation, one over their width inside: so is what they are beside.
    """
    kept = int(pm_kept.sum())
    odds = (len(pm_kept) - kept + 0.5) / (kept + 0.5)
    log = 0.5 * pm_degrees_of_freedom(problem) * np.log(JUNK_DENSITY) + np.log(odds)
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
    """S hypotheses at local minima of the truncated cost.

    Attributes:
        state, private: of each hypothesis.
        parts: the reduced problem there.
        cost: (S,) truncated chi square.
        pm_kept (S, J), aim_kept (S, A): which shots count in full.
    """

    state: SharedState
    private: PrivateState
    parts: Parts
    cost: FloatArray
    pm_kept: BoolArray
    aim_kept: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class _Weights:
    pm: FloatArray
    aim: FloatArray
    cost: FloatArray


def _weighted(parts: Parts, pm: FloatArray, aim: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gradient (S, D) and Hessian (S, D, D) of the weighted sum of all parts."""
    gradient, hessian = parts.prior.gradient[:, 0].copy(), parts.prior.hessian[:, 0].copy()
    for weight, part in ((pm, parts.pm), (aim, parts.aim)):
        gradient += np.einsum("sn,sna->sa", weight, part.gradient)
        hessian += np.einsum("sn,snab->sab", weight, part.hessian)
    return gradient, hessian


def _cauchy(parts: Parts, scale: float, aim_scale: float) -> _Weights:
    """Cauchy loss: cost k log(1 + c / k), weight 1 / (1 + c / k). An infinite scale is least squares."""
    cost = parts.prior.cost[:, 0].copy()
    weights = []
    for part, k in ((parts.pm, scale), (parts.aim, aim_scale)):
        c = np.maximum(part.cost, 0.0)
        weights.append(1.0 / (1.0 + c / k))
        cost += np.sum(c if np.isinf(k) else k * np.log1p(c / k), axis=1)
    return _Weights(weights[0], weights[1], cost)


def _truncated(parts: Parts, limit: FloatArray, aim_limit: float) -> _Weights:
    cost = parts.prior.cost[:, 0] + np.sum(np.minimum(parts.pm.cost, limit), axis=1)
    cost += np.sum(np.minimum(parts.aim.cost, aim_limit), axis=1)
    return _Weights((parts.pm.cost <= limit).astype(float), (parts.aim.cost <= aim_limit).astype(float), cost)


def _fixed(parts: Parts, pm_kept: BoolArray, aim_kept: BoolArray) -> _Weights:
    cost = parts.prior.cost[:, 0] + np.sum(pm_kept * parts.pm.cost, axis=1) + np.sum(aim_kept * parts.aim.cost, axis=1)
    return _Weights(_repeated(pm_kept, parts.pm), _repeated(aim_kept, parts.aim), cost)


def _repeated(kept: BoolArray, part: Contributions) -> FloatArray:
    """Weights (S, n) of 0 and 1 for every hypothesis."""
    return np.array(np.broadcast_to(kept, part.cost.shape), dtype=np.float64)


Loss = Callable[[Parts], _Weights]


def _select(good: BoolArray, new: Any, old: Any) -> Any:
    """``new`` where good (S,), else ``old``: arrays that lead with S, or dataclasses of such."""
    if isinstance(new, np.ndarray):
        return np.where(good.reshape(-1, *(1,) * (new.ndim - 1)), new, old)
    return type(new)(*(_select(good, getattr(new, name), getattr(old, name)) for name in new.__slots__))


def _honest(parts: Parts, before: PrivateState) -> Parts:
    """Parts in which a PM that still wanders counts as far off, whatever it passes on its way."""
    wanders = np.linalg.norm(parts.private.trus_p_pm - before.trus_p_pm, axis=-1) > WANDERS_MM
    if not wanders.any():
        return parts
    cost = np.where(wanders, np.maximum(parts.pm.cost, WANDERING_CHI2), parts.pm.cost)
    return replace(parts, pm=replace(parts.pm, cost=cost))


class _Descent:
    """Levenberg-Marquardt with weights that follow the costs (iteratively reweighted least squares)."""

    def __init__(self, problem: PackedProblem, state: SharedState, private: PrivateState | None = None) -> None:
        self.problem, self.state = problem, state
        self.settle(initial_private(problem, state) if private is None else private)

    def settle(self, private: PrivateState | None = None) -> None:
        """Find the private variables at the present state, from the arcs where none are given.

        On the way from a far start a PM may end up on the far side of its arc, where it seems to fit.
        """
        private = initial_private(self.problem, self.state) if private is None else private
        for _ in range(3):
            _, private = refine(self.problem, self.state, private)
        self.parts = _honest(contributions(self.problem, self.state, private), private)

    def run(self, loss: Loss, steps: int, tolerance: float = 1e-4) -> _Weights:
        """At most so many steps under one loss; until the Newton decrement (chi square) is below the tolerance."""
        here = loss(self.parts)
        damping = np.full(self.state.count, 1e-4)
        done = np.zeros(self.state.count, dtype=bool)
        for _ in range(steps):
            gradient, hessian = _weighted(self.parts, here.pm, here.aim)
            diagonal = np.arange(hessian.shape[1])
            hessian[:, diagonal, diagonal] *= 1.0 + damping[:, None]
            hessian[:, diagonal, diagonal] += WEIGHT_FLOOR
            step = np.asarray(-np.linalg.solve(hessian, gradient[..., None])[..., 0], dtype=np.float64)
            moved = self.state.retract(step, self.problem.columns)
            before = self.parts.private
            points = before.trus_p_pm + (self.parts.point_gain @ step[:, None, :, None])[..., 0]
            _, ahead = refine(self.problem, moved, replace(before, trus_p_pm=points))
            trial = contributions(self.problem, moved, ahead)
            there = loss(trial)
            good = np.isfinite(there.cost) & (there.cost <= here.cost + 1e-9 * (1.0 + np.abs(here.cost)))
            self.state = _select(good, moved, self.state)
            self.parts = _select(good, trial, self.parts)
            here = _select(good, there, here)
            damping = np.clip(np.where(good, damping * 0.1, damping * 8.0), 1e-9, 1e12)
            done |= (good & (-np.sum(step * gradient, axis=1) < tolerance)) | (damping > 1e9)
            if done.all():
                break
        return here


def graduated(problem: PackedProblem, state: SharedState, *, robust_aims: bool = False) -> RobustOptimum:
    """Local minima of the truncated cost from S starts, by way of narrowing Cauchy losses.

    Args:
        problem: the packed measurements.
        state: S starts.
        robust_aims: doubt the aims, too; else they count in full.
    """
    descent = _Descent(problem, state)
    for scale in CAUCHY_SCALES:
        descent.run(partial(_cauchy, scale=scale, aim_scale=scale if robust_aims else np.inf), STEPS_PER_SCALE)
    return _truncated_minima(descent, robust_aims=robust_aims)


def graduated_or_near(problem: PackedProblem, state: SharedState, *, robust_aims: bool = False) -> RobustOptimum:
    """The better of :func:`graduated` and of the descent on the truncated cost alone, from one start.

    The wide losses may lead away from a start that is good already, and into another minimum.
    """
    far = graduated(problem, state, robust_aims=robust_aims)
    near = _truncated_minima(_Descent(problem, state), robust_aims=robust_aims)
    return near if near.cost[0] < far.cost[0] else far


def _truncated_minima(descent: _Descent, *, robust_aims: bool) -> RobustOptimum:
    limit, aim_limit = pm_limits(descent.problem, TYPICAL_P), AIM_LIMIT if robust_aims else np.inf
    for _ in range(2):
        descent.settle()
        weights = descent.run(partial(_truncated, limit=limit, aim_limit=aim_limit), MAX_STEPS)
    return RobustOptimum(
        descent.state, descent.parts.private, descent.parts, weights.cost, weights.pm > 0.5, weights.aim > 0.5
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


def innovations(parts: Parts, pm_kept: BoolArray, aim_kept: BoolArray) -> Innovations:
    """Innovations of all shots at an optimum of the kept ones (one hypothesis), in closed form.

    With total Hessian H, leaving a shot of cost c, gradient g, Hessian A out moves the optimum to where the rest costs
    g' (H - A)^-1 g less: the innovation is c + g' (H - A)^-1 g. For a shot that was not in it is c - g' (H + A)^-1 g.
    """
    _, hessian = _weighted(parts, _repeated(pm_kept, parts.pm), _repeated(aim_kept, parts.aim))
    return Innovations(_innovation(parts.pm, hessian[0], pm_kept), _innovation(parts.aim, hessian[0], aim_kept))


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
    pm_kept: BoolArray,
    aim_kept: BoolArray,
    private: PrivateState | None = None,
) -> Innovations:
    """:func:`innovations` at shared variables (one hypothesis) that are the optimum of the kept shots.

    ``private`` where its private variables are known, else they are found.
    """
    parts = _Descent(problem, state, private).parts
    return innovations(parts, pm_kept, aim_kept)


@dataclass(frozen=True, slots=True, eq=False)
class Deviants:
    """Shots beyond their limits: PMs (J,), aims (A,)."""

    pm: BoolArray
    aim: BoolArray


def deviant(problem: PackedProblem, found: Innovations, pm_kept: BoolArray) -> Deviants:
    """Shots that deviate more than a good one may, where these PMs (J,) count.

    Infinite innovations say nothing: the rest predicted nothing.
    """
    limits = limits_among(problem, pm_kept, int(pm_kept.sum()), len(pm_kept))
    pm, aim = found.pm > limits, found.aim > AIM_LIMIT
    return Deviants(pm & np.isfinite(found.pm), aim & np.isfinite(found.aim))


@dataclass(frozen=True, slots=True, eq=False)
class Sorted:
    """Which shots are kept, PMs (J,) and aims (A,), at the least squares optimum of those kept (one hypothesis).

    ``settled``: every shot kept, and none of the others, is within its limit; False with borderline shots kept.
    """

    state: SharedState
    pm_kept: BoolArray
    aim_kept: BoolArray
    settled: bool


def sort_shots(
    problem: PackedProblem,
    state: SharedState,
    pm_kept: BoolArray,
    aim_kept: BoolArray,
    *,
    doubt_aims: bool = True,
) -> Sorted:
    """Least squares on those kept and innovations of all, in turn, until who is kept no longer changes.

    Args:
        problem: the packed measurements.
        state: one hypothesis.
        pm_kept (J,), aim_kept (A,): where to begin.
        doubt_aims: False leaves ``aim_kept`` as it is.
    """
    seen: set[bytes] = set()
    settled = False
    for _ in range(SETTLE_ROUNDS):
        descent = _Descent(problem, state)
        descent.run(partial(_fixed, pm_kept=pm_kept, aim_kept=aim_kept), MAX_STEPS)
        descent.settle()
        state = descent.state
        found = innovations(descent.parts, pm_kept, aim_kept)
        beyond = deviant(problem, found, pm_kept)
        pm_next = ~beyond.pm & (pm_kept | np.isfinite(found.pm))
        aim_next = ~beyond.aim & (aim_kept | np.isfinite(found.aim)) if doubt_aims else aim_kept
        settled = bool((pm_next == pm_kept).all() and (aim_next == aim_kept).all())
        if settled:
            break
        seen.add(pm_kept.tobytes() + aim_kept.tobytes())
        if pm_next.tobytes() + aim_next.tobytes() in seen:  # a borderline shot: in when out, out when in
            pm_kept, aim_kept = pm_kept | pm_next, aim_kept | aim_next
            break
        pm_kept, aim_kept = pm_next, aim_next
    return Sorted(state, pm_kept, aim_kept, settled)


def predicted_pms(others: PackedProblem, problem: PackedProblem, judged: Sorted) -> BoolArray:
    """Whether PMs that are not in ``problem``, over the same shared variables, fit what is kept of it (J,)."""
    kept = _Descent(problem, judged.state).parts
    _, hessian = _weighted(kept, _repeated(judged.pm_kept, kept.pm), _repeated(judged.aim_kept, kept.aim))
    none = np.zeros(len(others.pms), dtype=bool)
    innovation = _innovation(_Descent(others, judged.state).parts.pm, hessian[0], none)
    limits = limits_among(others, none, int(judged.pm_kept.sum()), len(judged.pm_kept))
    return np.asarray(innovation <= limits)
