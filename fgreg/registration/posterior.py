"""Samples of the posterior of the shared variables; from them the estimate, its covariance, and predicted errors.

With few pairs the Gaussian at the optimum is overconfident: the problem is nonlinear, and the windows are intervals. So
the density of the shared variables (fgreg.graph.reduced_graph.log_posterior) is sampled by adaptive multiple importance
sampling (Cornuet et al., 2012). The first proposals are Student densities about the minima, later ones are fitted to
the samples drawn up to then. All samples are weighted by the mixture of all proposals. Deterministic by seed.

Chart: ``trus_T_camera = estimate * Expmap(xi)``, GTSAM's tangent. In it a rotation about any point of the scene is a
straight line; in separate (rotation, translation) it is curved, since the camera is far from the tissue.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.transforms import FloatArray, IntArray, exp_so3, inverse, log_so3, transform_points
from fgreg.graph.columns import Columns
from fgreg.graph.packing import PackedProblem, only_aims, without_aims
from fgreg.graph.reduced_blocks import PrivateState, cross
from fgreg.graph.reduced_graph import evaluate, log_posterior
from fgreg.graph.reduced_solver import Optimum
from fgreg.graph.reduced_system import refine
from fgreg.graph.shared_state import Quadratic, SharedState, step_between
from fgreg.graph.split_points import logsumexp
from fgreg.model.estimate import PredictedTre
from fgreg.registration.proposals import Conditional, Students, cholesky, effective_samples, refitted, split_columns

QUANTILE = 0.95
MOST_TRANSLATION_MM = 2000.0
"""Largest distance from camera to probe (the session format's bound): beyond it rounding may look like a fit."""
CHUNK = 4000
"""Samples times PMs that are evaluated at once: the arrays then stay in the processor's cache."""
REFINED_PMS = 8
"""With fewer PMs the samples spread so widely that the private variables are refined once more for each."""
FITTING, TAILS = 0.4, 4.0
"""Share of effective samples in the first round below which the posterior has long tails; factor on the goal then."""


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """Weighted samples of the shared variables.

    Attributes:
        columns: places of the shared variables in ``step``.
        mean: the estimate, about which they are centred (one hypothesis).
        step: (S, D) deviations of the samples from it, as :meth:`SharedState.retract` takes them.
        tangent: (S, D) the same with registrations in GTSAM's tangent.
        weight: (S,) sums to 1.
        effective: effective number of independent samples.
        covariance: (D, D) second moment of ``tangent`` about the estimate.
    """

    columns: Columns
    mean: SharedState
    step: FloatArray
    tangent: FloatArray
    weight: FloatArray
    effective: float
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class OutlierMixture:
    """The problem with all PMs, each either inlier or outlier (``problem.log_outlier``).

    ``private`` and ``point_gain`` (1, J, 3, D) are at the optimum of a mode.
    """

    problem: PackedProblem
    private: PrivateState
    point_gain: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Mode:
    """A mode of the posterior: an optimum of a problem (one hypothesis) and the covariance (D, D) about it.

    ``doubted``: the density to sample where shots were left out; the problem's own where None.
    """

    problem: PackedProblem
    optimum: Optimum
    covariance: FloatArray
    mixture: OutlierMixture | None = None


def _expmap_shift(omega: FloatArray, rho: FloatArray) -> FloatArray:
    """Translations (S, 3) of ``Expmap(omega, rho)``: V rho, V = 1 + a hat(omega) + b hat(omega)^2."""
    angle2 = np.sum(omega * omega, axis=1, keepdims=True)
    small = angle2 < 1e-8
    angle = np.sqrt(np.where(small, 1.0, angle2))
    a = np.where(small, 0.5 - angle2 / 24.0, (1.0 - np.cos(angle)) / angle**2)
    b = np.where(small, 1.0 / 6.0 - angle2 / 120.0, (angle - np.sin(angle)) / angle**3)
    turned = cross(omega, rho)
    return np.asarray(rho + a * turned + b * cross(omega, turned))


def _logmap_shift(omega: FloatArray, shift: FloatArray) -> FloatArray:
    """Inverse of :func:`_expmap_shift`: rho (S, 3). V^-1 = 1 - hat(omega) / 2 + c hat(omega)^2."""
    angle2 = np.sum(omega * omega, axis=1, keepdims=True)
    small = angle2 < 1e-3
    half = 0.5 * np.sqrt(np.where(small, 1.0, angle2))
    near = 1.0 / 12.0 + angle2 / 720.0 + angle2**2 / 30240.0
    c = np.where(small, near, (1.0 - half / np.tan(half)) / (4.0 * half**2))
    turned = cross(omega, shift)
    return np.asarray(shift - 0.5 * turned + c * cross(omega, turned))


def step_of_tangent(tangent: FloatArray, columns: Columns) -> FloatArray:
    """(S, D) steps of :meth:`SharedState.retract` from deviations with registrations in GTSAM's tangent."""
    step = tangent.copy()
    for turn, shift in _poses(columns):
        step[:, shift] = _expmap_shift(tangent[:, turn], tangent[:, shift])
    return step


def tangent_of_step(step: FloatArray, columns: Columns) -> FloatArray:
    """Inverse of :func:`step_of_tangent`."""
    tangent = step.copy()
    for turn, shift in _poses(columns):
        tangent[:, shift] = _logmap_shift(step[:, turn], step[:, shift])
    return tangent


def _poses(columns: Columns) -> list[tuple[slice, slice]]:
    """Columns of each registration's rotation and translation."""
    return [(slice(6 * k, 6 * k + 3), slice(6 * k + 3, 6 * k + 6)) for k in range(columns.epochs)]


def _log_volume(tangent: FloatArray, columns: Columns) -> FloatArray:
    """(S,) log of the volume (Haar measure times translation) of the tangent's unit cell: 2 log(2 (1 - cos a) / a^2).

    Once for the rotation, once for the translation's gain.
    """
    total = np.zeros(len(tangent))
    for k in range(columns.epochs):
        angle2 = np.sum(tangent[:, 6 * k : 6 * k + 3] ** 2, axis=1)
        half2 = np.maximum(0.25 * angle2, 1e-12)
        total += 4.0 * np.log(np.abs(np.sinc(np.sqrt(half2) / np.pi)) + 1e-30)
    return total


def light(mode: Mode) -> Mode:
    """The mode with its calibration shots replaced by a Gaussian of the beam (and bias), the variables they depend on.

    In the beam's chart their cost is almost quadratic. At few pairs this saves most of the time of a sample.
    """
    problem, at = mode.problem, mode.optimum.evaluation
    if not len(problem.aims.rotation):
        return mode
    aims = only_aims(problem)
    private = replace(at.private, trus_p_pm=at.private.trus_p_pm[:, :0], beam_error=at.private.beam_error[:, :0])
    there = evaluate(aims, mode.optimum.state, private)
    anchor = Quadratic(mode.optimum.state, float(there.cost[0]), there.gradient[0], there.hessian[0])
    if problem.anchor is not None:
        anchor = anchor.plus(problem.anchor.at(anchor.state, problem.columns))
    lighter = without_aims(problem, anchor)
    private = replace(at.private, aim_error=at.private.aim_error[:, :0], aim_shift=at.private.aim_shift[:, :0])
    evaluation = replace(at, private=private)
    mixture = mode.mixture
    if mixture is not None:
        private = replace(mixture.private, aim_error=private.aim_error, aim_shift=private.aim_shift)
        mixture = replace(mixture, problem=without_aims(mixture.problem, anchor), private=private)
    return Mode(lighter, replace(mode.optimum, evaluation=evaluation), mode.covariance, mixture)


def _repeat(state: SharedState, count: int) -> SharedState:
    return state.take(np.zeros(count, dtype=np.int64))


def log_density(mode: Mode, step: FloatArray) -> FloatArray:
    """(S,) log density at steps (S, D) from a mode's optimum, up to a constant common to a session's modes."""
    problem = mode.problem if mode.mixture is None else mode.mixture.problem
    state = _repeat(mode.optimum.state, len(step)).retract(step, problem.columns)
    private = moved_private(mode, step)
    with np.errstate(all="ignore"):  # numbers of a sample far off may overflow: its density is then zero
        if len(problem.pms) < REFINED_PMS or mode.mixture is not None:
            private = refine(problem, state, private)
        log = log_posterior(problem, state, private)
        near = (np.linalg.norm(state.translation_mm, axis=-1) <= MOST_TRANSLATION_MM).all(axis=1)
    return np.where(np.isfinite(log) & near, log, -np.inf)


def moved_private(mode: Mode, step: FloatArray) -> PrivateState:
    """Private variables of the density's problem at steps (S, D) from the mode's optimum, to first order."""
    at = mode.optimum.evaluation if mode.mixture is None else mode.mixture
    private = at.private.take(np.zeros(len(step), dtype=np.int64))
    return replace(private, trus_p_pm=at.private.trus_p_pm + (at.point_gain @ step[:, None, :, None])[..., 0])


@dataclass(frozen=True, slots=True, eq=False)
class _Target:
    """The density to sample, over tangents about the first mode."""

    modes: tuple[Mode, ...]

    @property
    def columns(self) -> Columns:
        return self.modes[0].problem.columns

    def state(self, tangent: FloatArray) -> SharedState:
        base = self.modes[0].optimum.state
        return _repeat(base, len(tangent)).retract(step_of_tangent(tangent, self.columns), self.columns)

    def log(self, tangent: FloatArray) -> tuple[FloatArray, IntArray]:
        """(S,) log density of samples, and (S,) the mode nearest to each by its own covariance."""
        columns, steps = self.columns, [step_of_tangent(tangent, self.columns)]
        nearest = np.zeros(len(tangent), dtype=np.int64)
        if len(self.modes) > 1:
            state = _repeat(self.modes[0].optimum.state, len(tangent)).retract(steps[0], columns)
            steps += [step_between(mode.optimum.state, state, columns) for mode in self.modes[1:]]
            far = [
                np.sum(np.linalg.solve(cholesky(mode.covariance), step.T) ** 2, axis=0)
                for mode, step in zip(self.modes, steps, strict=True)
            ]
            nearest = np.argmin(far, axis=0)
        out = np.empty(len(tangent))
        for index, (mode, step) in enumerate(zip(self.modes, steps, strict=True)):
            rows = np.flatnonzero(nearest == index)
            for part in np.array_split(rows, max(1, -(-len(rows) * len(mode.problem.pms) // CHUNK))):
                if len(part):
                    out[part] = log_density(mode, step[part])
        return out + _log_volume(tangent, columns), nearest


def sample_posterior(modes: tuple[Mode, ...], *, goal: float, most: int, seed: int) -> Posterior:
    """Weighted samples of the posterior, about the mean of those nearest to the mode of most weight.

    Args:
        modes: minima of one session, the best first.
        goal: effective samples after which it stops.
        most: draws after which it stops with fewer.
        seed: of the random numbers.
    """
    rng = np.random.default_rng(seed)
    modes = tuple(light(mode) for mode in modes)
    columns, target = modes[0].problem.columns, _Target(modes)
    starts = [np.zeros((1, columns.size))]
    starts += [
        tangent_of_step(step_between(modes[0].optimum.state, mode.optimum.state, columns), columns)
        for mode in modes[1:]
    ]
    sampled, linear = split_columns(columns)
    at = np.concatenate(starts)
    proposals = [
        Students(
            sampled=sampled,
            linear=linear,
            centre=at[:, sampled],
            group=np.arange(len(modes)),
            scale=np.ones(len(modes)),
            share=np.full(len(modes), 1.0 / len(modes)),
            root=np.stack([cholesky(mode.covariance[np.ix_(sampled, sampled)]) for mode in modes]),
            mode=np.arange(len(modes)),
            conditional=tuple(
                Conditional.of(centre, mode.covariance, sampled, linear) for centre, mode in zip(at, modes, strict=True)
            ),
        )
    ]
    x, log_target, nearest = np.zeros((0, columns.size)), np.zeros(0), np.zeros(0, dtype=np.int64)
    counts: list[int] = []
    log_proposal, given = np.zeros((0, 0)), np.zeros((len(modes), 0))
    draws = 300
    while True:
        fresh = proposals[-1].draw(rng, draws)
        given_fresh = proposals[0].given(fresh)
        new_under_all = np.stack([proposal.log(fresh, given_fresh) for proposal in proposals])
        if len(x):
            old_under_new = proposals[-1].log(x, given)
            log_proposal = np.concatenate([np.concatenate([log_proposal, old_under_new[None]]), new_under_all], axis=1)
        else:
            log_proposal = new_under_all
        given = np.concatenate([given, given_fresh], axis=1)
        log_fresh, nearest_fresh = target.log(fresh)
        x, log_target = np.concatenate([x, fresh]), np.concatenate([log_target, log_fresh])
        nearest = np.concatenate([nearest, nearest_fresh])
        counts.append(draws)
        share = np.log(np.array(counts) / sum(counts))
        log_drawn = logsumexp(log_proposal + share[:, None], axis=0)
        log_weight = log_target - log_drawn
        if not np.isfinite(log_weight).any():  # the optimum itself is where no camera can be
            break
        if len(counts) == 1 and effective_samples(log_weight) < FITTING * draws:
            goal = TAILS * goal  # far from Gaussian: tails not drawn yet do not lower the effective number
        if effective_samples(log_weight) >= goal or len(x) >= most:
            break
        proposals.append(refitted(proposals[0], x, log_weight, nearest, rng))
        draws = min(max(300, len(x) // 2), max(most - len(x), 100))
    effective = effective_samples(log_weight) if np.isfinite(log_weight).any() else 0.0
    if effective < LEAST_SAMPLES:
        return replace(gaussian_posterior(modes[0], count=round(goal), seed=seed), effective=effective)
    weight = np.exp(log_weight - logsumexp(log_weight))
    first = nearest == 0
    if effective >= ENOUGH_SAMPLES:
        x[first] = _stretched(x, weight, log_drawn, modes[0].covariance)[first]
    mass = np.bincount(nearest, weight, minlength=len(modes))
    main = np.where(nearest == int(np.argmax(mass)), weight, 0.0)
    return _about_mean(target, x, weight, main / main.sum(), effective)


def _stretched(x: FloatArray, weight: FloatArray, log_drawn: FloatArray, covariance: FloatArray) -> FloatArray:
    """(S, D) the samples, stretched about the first mode by what their spread is known to be wrong: a control variate.

    Weighted as draws of the mode's Gaussian, the same samples should have its covariance. They miss it by their
    sampling error, which the posterior's own spread shares the more, the nearer it is to that Gaussian; the slope of a
    regression says how much. Without this, 300 samples make regions too small in some directions and too large in
    others, and the inverse of their covariance 3 % too large (Wishart).

    Args:
        x: (S, D) samples about the mode. weight: (S,) of the posterior. log_drawn: (S,) log density of the draws.
        covariance: (D, D) of the mode's Gaussian.
    """
    root = cholesky(covariance)
    square = np.sum(np.linalg.solve(root, x.T) ** 2, axis=0)
    log = -0.5 * square - log_drawn
    gaussian = np.exp(log - logsumexp(log))
    own, known = weight * square, gaussian * square
    known = known - known.mean()
    shared = min(max(float(known @ own) / max(float(known @ known), 1e-300), 0.0), 1.0)
    moment = shared * (x * gaussian[:, None]).T @ x + (1.0 - shared) * covariance
    return np.asarray(x @ np.linalg.solve(cholesky(moment).T, root.T))


ENOUGH_SAMPLES = 60.0
"""Effective samples from which the samples span all directions: their moments are used without the optimum's own."""
LEAST_SAMPLES = 5.0
"""With fewer effective samples, whose spread is far too small, the Gaussian at the optimum is used instead."""


def gaussian_posterior(mode: Mode, *, count: int, seed: int) -> Posterior:
    """Samples of the Gaussian at a mode, which the posterior approaches with many pairs."""
    x = np.random.default_rng(seed).standard_normal((count, len(mode.covariance)))
    x = np.concatenate([x, -x])  # in pairs about the mode, so that it is the mean
    weight = np.full(len(x), 1.0 / len(x))
    # Scaled to have exactly the mode's covariance.
    x = np.linalg.solve(cholesky(x.T @ x / len(x)), x.T).T @ cholesky(mode.covariance).T
    return _about_mean(_Target((mode,)), x, weight, weight, float(count))


def _about_mean(target: _Target, x: FloatArray, weight: FloatArray, main: FloatArray, effective: float) -> Posterior:
    columns = target.columns
    centre = main @ x
    spread = x - centre
    moment = (spread * main[:, None]).T @ spread
    # A few samples of large weight span too little: the optimum's own covariance is added for what is missing.
    missing = max(0.0, 1.0 - effective / ENOUGH_SAMPLES) + 1e-9
    moment = moment + missing * target.modes[0].covariance
    # The mean has a sampling error of moment / effective. James and Stein's shrinkage towards the optimum removes a
    # shift that is no larger than that. So many pairs, or exact measurements, give the optimum itself.
    square = float(centre @ np.linalg.solve(moment, centre)) * effective if len(x) else 0.0
    keep = max(0.0, 1.0 - (len(centre) - 2.0) / max(square, 1e-12))
    shift = step_of_tangent(keep * centre[None], columns)
    mean = target.modes[0].optimum.state.retract(shift, columns)
    step = step_between(mean, target.state(x), columns)
    tangent = tangent_of_step(step, columns)
    covariance = np.asarray((tangent * weight[:, None]).T @ tangent) + missing * target.modes[0].covariance
    return Posterior(columns, mean, step, tangent, weight, effective, covariance)


def pose_tangent(first: FloatArray, second: FloatArray) -> FloatArray:
    """(6,) ``Logmap(first^-1 second)`` of transforms (4, 4), GTSAM's: rotation rad, then translation mm."""
    back = first[:3, :3].T
    omega = log_so3(back @ second[:3, :3])
    shift = back @ (second[:3, 3] - first[:3, 3])
    return np.concatenate([omega, _logmap_shift(omega[None], shift[None])[0]])


def weighted_quantile(values: FloatArray, weight: FloatArray, quantile: float) -> FloatArray:
    """Quantile along the first axis of (S, n) values with weights (S,): (n,)."""
    order = np.argsort(values, axis=0)
    cumulative = np.cumsum(weight[order], axis=0)
    row = np.minimum((cumulative < quantile).sum(axis=0), len(values) - 1)
    return np.asarray(np.take_along_axis(np.take_along_axis(values, order, axis=0), row[None], axis=0)[0])


def target_errors(posterior: Posterior, epoch: int, targets_mm: FloatArray) -> FloatArray:
    """(S, n) errors (mm): by how far each sample moves the camera points that the estimate maps to the targets."""
    estimate = posterior.mean.trus_T_camera(epoch)[0]
    camera_p = transform_points(inverse(estimate), targets_mm)
    twist = posterior.step[:, 6 * epoch : 6 * epoch + 6]
    # A sample is estimate * (Exp(omega), v): in camera axes it moves p to Exp(omega) p + v.
    moved = (exp_so3(twist[:, :3]) - np.eye(3)) @ camera_p.T + twist[:, 3:, None]
    return np.asarray(np.sqrt(np.einsum("sin,sin->sn", moved, moved)))


def predicted_tre(
    posterior: Posterior, epoch: int, targets_mm: FloatArray
) -> tuple[PredictedTre, FloatArray, FloatArray]:
    """Predicted target registration error of one epoch (definitions: :class:`fgreg.model.estimate.PredictedTre`).

    Returns:
        the figures; per target (n,), the root of the expected square and the 95 % quantile, mm.
    """
    error = target_errors(posterior, epoch, targets_mm)
    quantiles = weighted_quantile(error, posterior.weight, QUANTILE)
    root = np.sqrt(posterior.weight @ error**2)
    figures = PredictedTre(float(root.mean()), float(quantiles.mean()), float(quantiles.max()))
    return figures, root, quantiles
