"""Whether the camera moved among the last pairs, and since which: Bayes factors, in closed form per linearisation.

Given the Gaussian of the shared variables from all that came before, the marginal likelihood of the last pairs (as
whitened equations, fgreg.camera_moves.whitened) under a hypothesis is a product of predictive densities, as a Kalman
filter runs through them. Hypotheses:

- steady: nothing happened.
- moved before the m-th last pair: the registration is ``trus_T_camera * Exp(xi)`` from there on, xi about the camera
  with a zero-mean prior that mixes scales, from a nudge to a camera put back anywhere.

Under each of them any pair may be junk: then it has a constant density (fgreg.robust.JUNK_DENSITY). So one gross
outlier is junk, and several in a row that agree on one moved registration are a move. The likeliest few sequences of
labels (good or junk, pair by pair) are carried along: a Gaussian sum, cut down to its heaviest terms.

Large moves are not linear: moved hypotheses are linearised again about the registrations they lead to.

Sequential use: the score is the log of the sum over m of the Bayes factors (Shiryaev, 1963; Roberts, 1966). While
nothing happens that sum, less the number of pairs, is a martingale: if the model holds, a threshold A on it is passed
at most once in A pairs on average.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from fgreg.camera_moves.whitened import Gaussian, WhiteTerms, WindowRows, linearise
from fgreg.frames import BoolArray, FloatArray, IntArray
from fgreg.graph.packing import PackedProblem
from fgreg.graph.shared_state import SharedState
from fgreg.robust import JUNK_DENSITY
from fgreg.sensitivity import interval_moments, log_interval
from fgreg.steadiness import ALARM, MoveScales, default_scales, log_move_odds, logsumexp

BRANCHES = 4
"""Sequences of junk labels carried along per hypothesis."""
REACH_RAD, REACH_MM = math.radians(4.0), 10.0
"""Moves up to this are linear enough."""
ROUNDS, SETTLED = 6, 5.0
"""Times that moved hypotheses are linearised again, at most, until they move by no more than reach over this."""
CLOSER = 6
"""Candidates that are looked at more closely."""
SUSPICION = 2.0
"""Log of the score by the first linearisation from which large moves are linearised again."""

JUNK_PRIOR, JUNK_PRIOR_PAIRS, JUNK_MEMORY = 0.04, 10.0, 50
"""Share of junk expected at first, how many pairs that opinion is worth, and how many pairs back it is learned from."""
LEAST_JUNK, MOST_JUNK = 0.01, 0.5
"""However clean the stream: a single odd pair must never pass for a move."""


Relinearise = Callable[[FloatArray], WhiteTerms]
"""From steps (S, D) off the base to the same PMs linearised there, steps counted from the base."""


@dataclass(frozen=True, slots=True, eq=False)
class MoveSettings:
    """How to test.

    Attributes:
        scales: prior of a move.
        junk_probability: of each pair, before it is looked at; :meth:`learned` from those before.
        threshold: log score from which it is an alarm.
    """

    scales: MoveScales = field(default_factory=default_scales)
    junk_probability: float = JUNK_PRIOR
    threshold: float = ALARM

    def __post_init__(self) -> None:
        if not 0.0 < self.junk_probability < 1.0:
            raise ValueError(f"junk_probability is {self.junk_probability}, expected a number between 0 and 1")

    def learned(self, kept: BoolArray) -> MoveSettings:
        """With junk as probable as the pairs before (n,) say: two odd pairs in a row are a move where junk is rare."""
        recent = kept[-JUNK_MEMORY:]
        junk = JUNK_PRIOR_PAIRS * self.junk_probability + float(np.sum(~recent))
        share = junk / (JUNK_PRIOR_PAIRS + len(recent))
        return replace(self, junk_probability=min(max(share, LEAST_JUNK), MOST_JUNK))


@dataclass(frozen=True, slots=True, eq=False)
class MoveTest:
    """What the last M pairs say.

    Attributes:
        log_bayes: (M,) log Bayes factor of a move before pair j (0 the oldest of them) against none.
        score: log of their sum.
        since: index of the first pair after the likeliest move.
        alarm: whether the score passes the threshold.
        moved: the shared variables' step given all pairs, if the camera moved there (registration: the new one).
        good: (M,) probability that a pair is not junk, if so.
        steady_good: (M,) likewise if it did not move.
    """

    log_bayes: FloatArray
    score: float
    since: int
    alarm: bool
    moved: Gaussian
    good: FloatArray
    steady_good: FloatArray


@dataclass(slots=True, eq=False)
class _Groups:
    """G hypotheses of B label sequences each: mean (G, B, D), covariance (G, B, D, D), log weight (G, B), labels."""

    mean: FloatArray
    covariance: FloatArray
    log_weight: FloatArray
    good: FloatArray

    @staticmethod
    def one(gaussian: Gaussian, pairs: int) -> _Groups:
        """A single hypothesis of a single sequence; the others do not weigh anything."""
        log_weight = np.full((1, BRANCHES), -np.inf)
        log_weight[0, 0] = 0.0
        return _Groups(
            np.repeat(gaussian.mean[None, None], BRANCHES, axis=1),
            np.repeat(gaussian.covariance[None, None], BRANCHES, axis=1),
            log_weight,
            np.ones((1, BRANCHES, pairs)),
        )

    def spawn(self, move: FloatArray, pose: slice) -> _Groups:
        """What a single hypothesis becomes when the registration moves by each of K priors (K, 6, 6)."""
        count = len(move)
        covariance = np.repeat(self.covariance, count, axis=0)
        covariance[:, :, pose, pose] += move[:, None]
        return _Groups(
            np.repeat(self.mean, count, axis=0),
            covariance,
            np.repeat(self.log_weight, count, axis=0),
            np.repeat(self.good, count, axis=0),
        )

    def take(self, index: IntArray) -> _Groups:
        return _Groups(self.mean[index], self.covariance[index], self.log_weight[index], self.good[index])


def _joined(parts: list[_Groups]) -> _Groups:
    return _Groups(*(np.concatenate([getattr(p, name) for p in parts]) for name in _Groups.__slots__))


def _spread(innovation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverse and log determinant of covariances (..., q, q)."""
    if innovation.shape[-1] == 2:
        a, b, d = innovation[..., 0, 0], innovation[..., 0, 1], innovation[..., 1, 1]
        det = a * d - b * b
        out = np.empty_like(innovation)
        out[..., 0, 0], out[..., 1, 1], out[..., 0, 1] = d / det, a / det, -b / det
        out[..., 1, 0] = out[..., 0, 1]
        return out, np.log(det)
    return np.asarray(np.linalg.inv(innovation)), np.asarray(np.linalg.slogdet(innovation)[1])


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """One pair as G (or 1) hypotheses have it: residual (G, q), jacobian (G, q, D), rest (G,); its window, if any."""

    residual: FloatArray
    jacobian: FloatArray
    rest: FloatArray
    window: WindowRows | None


def _rows(terms: WhiteTerms, j: int, hypotheses: slice, times: int) -> _Rows:
    """Pair ``j`` of some hypotheses of the terms, each several times over."""

    def of(values: FloatArray) -> FloatArray:
        return np.repeat(values[hypotheses, j], times, axis=0) if times > 1 else values[hypotheses, j]

    window = None
    if terms.windows is not None and terms.windows.there[j]:
        w = terms.windows
        window = replace(w.take(np.array([j])), mean=of(w.mean), variance=of(w.variance), gain=of(w.gain))
    return _Rows(of(terms.residual), of(terms.jacobian), of(terms.rest), window)


def _in_window(
    mean: FloatArray, covariance: FloatArray, window: WindowRows
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Step given that the rotation is in its window, by moments (exact ones of its first two), and the log density.

    Means (G, B, D), covariances (G, B, D, D). Density: of the interval's, in units of the site that stands for it.
    """
    gain = window.gain[:, None]
    along = (covariance @ gain[..., None])[..., 0]
    sigma = np.sqrt(window.variance[:, None] + np.sum(gain * along, axis=-1) + window.soft**2)
    at = window.mean[:, None] + np.sum(gain * mean, axis=-1)
    log = log_interval(window.low - at, window.high - at, sigma)
    log = log + np.log(math.sqrt(2.0 * math.pi) * window.site / (window.high - window.low))
    slope, bend = interval_moments(window.low - at, window.high - at, sigma)
    covariance = covariance - bend[..., None, None] * (along[..., :, None] * along[..., None, :])
    return mean + slope[..., None] * along, covariance, log


def _advance(groups: _Groups, j: int, rows: _Rows, junk: tuple[float, float]) -> _Groups:
    """One pair more; ``junk``: log of its probability times its density, and of the probability of a good pair."""
    log_junk, log_good = junk
    jacobian = rows.jacobian[:, None]
    gain = groups.covariance @ np.swapaxes(jacobian, -1, -2)
    inverted, log_det = _spread(jacobian @ gain + np.eye(jacobian.shape[-2]))
    innovation = rows.residual[:, None] + (jacobian @ groups.mean[..., None])[..., 0]
    weighted = (inverted @ innovation[..., None])[..., 0]
    log = log_good - 0.5 * (np.sum(innovation * weighted, axis=-1) + log_det + rows.rest[:, None])
    mean = groups.mean - (gain @ weighted[..., None])[..., 0]
    covariance = groups.covariance - gain @ inverted @ np.swapaxes(gain, -1, -2)
    if rows.window is not None:
        mean, covariance, more = _in_window(mean, covariance, rows.window)
        log = log + more
    # Each sequence with this pair good, and with it junk (it then learns nothing); the heaviest go on.
    both = np.concatenate([groups.log_weight + log, groups.log_weight + log_junk], axis=1)
    keep = np.argpartition(-both, BRANCHES - 1, axis=1)[:, :BRANCHES]
    parent, is_good = keep % BRANCHES, keep < BRANCHES
    at = np.arange(len(both))[:, None]
    good = groups.good[at, parent]
    good[..., j] = is_good
    return _Groups(
        np.where(is_good[..., None], mean[at, parent], groups.mean[at, parent]),
        np.where(is_good[..., None, None], covariance[at, parent], groups.covariance[at, parent]),
        np.take_along_axis(both, keep, axis=1),
        good,
    )


def _junk_logs(equations: int, probability: float) -> tuple[float, float]:
    """Log of junk's probability times its density over that of a good pair at its best, and of a good pair's."""
    density = 0.5 * equations * math.log(JUNK_DENSITY)
    return math.log(probability) + density, math.log1p(-probability)


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """The filters' ends: the steady hypothesis (G = 1), and the moved ones in order of candidate and scale."""

    steady: _Groups
    moved: _Groups

    def log_bayes(self, share: FloatArray) -> FloatArray:
        """(C, K) of each candidate and scale."""
        moved = logsumexp(self.moved.log_weight, axis=1).reshape(-1, len(share)) + np.log(share)
        return np.asarray(moved - logsumexp(self.steady.log_weight, axis=1))


def _run(
    before: Gaussian,
    terms: WhiteTerms,
    moved: WhiteTerms | None,
    settings: MoveSettings,
    pose: slice,
    candidates: IntArray,
) -> _Run:
    """Run all filters.

    ``candidates`` (C,): increasing, the pairs before which the camera may have moved; ``moved``: terms as each of them
    is linearised, (C, n, ...); None: as ``terms``.
    """
    scales = settings.scales.covariance
    kinds = len(scales)
    steady = _Groups.one(before, terms.count)
    alive: _Groups | None = None
    born = 0
    for j in range(terms.count):
        junk = _junk_logs(int(terms.equations[j]), settings.junk_probability)
        if born < len(candidates) and candidates[born] == j:
            fresh = steady.spawn(scales, pose)
            alive = fresh if alive is None else _joined([alive, fresh])
            born += 1
        if alive is not None:
            if moved is None:
                alive = _advance(alive, j, _rows(terms, j, slice(None), 1), junk)
            else:
                alive = _advance(alive, j, _rows(moved, j, slice(0, born), kinds), junk)
        steady = _advance(steady, j, _rows(terms, j, slice(None), 1), junk)
    assert alive is not None  # there is a candidate
    return _Run(steady, alive)


def _best_sequence(groups: _Groups, row: int) -> tuple[Gaussian, FloatArray]:
    """Step of the likeliest sequence of one hypothesis, and each pair's probability to be good over all of them."""
    weight = np.exp(groups.log_weight[row] - logsumexp(groups.log_weight[row]))
    best = int(np.argmax(weight))
    return Gaussian(groups.mean[row, best], groups.covariance[row, best]), weight @ groups.good[row]


def check_for_move(
    before: Gaussian,
    terms: WhiteTerms,
    settings: MoveSettings,
    *,
    pose: slice,
    first: int = 0,
    last: int | None = None,
    relinearise: Relinearise | None = None,
) -> MoveTest:
    """Test the last pairs for a move of the camera.

    Args:
        before: the shared variables' step given everything before these pairs.
        terms: the last M pairs, oldest first, linearised once, at the base of the steps.
        settings: prior, junk and threshold.
        pose: columns of the current epoch's registration.
        first: the oldest pair before which a move is looked for; those before it only inform.
        last: the newest such pair; the newest of all where None.
        relinearise: for large moves; without, they are judged by ``terms`` alone.

    Raises:
        ValueError: no pair to look at.
    """
    births = range(first, terms.count if last is None else last + 1)
    if not 0 <= births.start < births.stop <= terms.count:
        raise ValueError(f"first and last are {first} and {last}, expected pairs of {terms.count}")
    share = settings.scales.share
    candidates = np.arange(births.start, births.stop)
    run = _run(before, terms, None, settings, pose, candidates)
    by_scale = run.log_bayes(share)
    best = [_best_sequence(run.moved, c * len(share) + int(np.argmax(by_scale[c]))) for c in range(len(candidates))]
    score = logsumexp(by_scale, axis=1)
    if relinearise is not None and logsumexp(score) > SUSPICION:
        _look_closer(before, terms, settings, pose, first, relinearise, score, best)
    log_bayes = np.full(terms.count, -np.inf)
    log_bayes[births.start : births.stop] = score
    since = int(np.argmax(log_bayes))
    moved, good = best[since - first]
    total = float(logsumexp(score))
    steady_good = _best_sequence(run.steady, 0)[1]
    return MoveTest(log_bayes, total, since, total > settings.threshold, moved, good, steady_good)


def _look_closer(
    before: Gaussian,
    terms: WhiteTerms,
    settings: MoveSettings,
    pose: slice,
    first: int,
    relinearise: Relinearise,
    score: FloatArray,
    best: list[tuple[Gaussian, FloatArray]],
) -> None:
    """Judge the likeliest candidates for large moves anew, linearised about where they lead; in place."""
    share = settings.scales.share
    order = np.argsort(-score)[:CLOSER]
    far = np.array([c for c in sorted(order) if _far(best[c][0].mean[pose])], dtype=np.int64)
    if not len(far):
        return
    at = np.zeros((len(far), len(before.mean)))
    for _ in range(ROUNDS):
        steps = np.stack([best[c][0].mean for c in far])
        if not any(_far(step[pose]) for step in (steps - at) * SETTLED):
            break
        at = steps
        run = _run(before, terms, relinearise(at), settings, pose, first + far)
        by_scale = run.log_bayes(share)
        for row, c in enumerate(far):
            best[c] = _best_sequence(run.moved, row * len(share) + int(np.argmax(by_scale[row])))
            score[c] = logsumexp(by_scale[row])


def _far(move: FloatArray) -> bool:
    return bool(np.linalg.norm(move[:3]) > REACH_RAD or np.linalg.norm(move[3:]) > REACH_MM)


def quick_score(posterior: Gaussian, terms: WhiteTerms, scales: MoveScales, pose: slice) -> float:
    """Log score as of :func:`check_for_move`, but of Gaussians throughout: no junk, no windows, no large moves.

    Exact for these, and next to nothing to compute (:func:`fgreg.steadiness.log_move_odds`).

    Args:
        posterior: of the shared variables' step, given all pairs and that nothing moved.
        terms: the last M pairs, linearised once.
        scales: prior of the move.
        pose: columns of the current epoch's registration.
    """
    jacobian = terms.jacobian[0]
    left = terms.residual[0] + jacobian @ posterior.mean
    hessian = np.swapaxes(jacobian, -1, -2) @ jacobian
    pull = -np.einsum("nqd,nq->nd", jacobian, left)
    return float(logsumexp(log_move_odds(hessian, pull, posterior.covariance, scales, pose)))


def relinearisation(problem: PackedProblem, base: SharedState) -> Relinearise:
    """:data:`Relinearise` of the PMs of a problem about a base state (one hypothesis)."""

    def about(steps: FloatArray) -> WhiteTerms:
        many = base.take(np.zeros(len(steps), dtype=np.int64))
        return linearise(problem, many.retract(steps, problem.columns), base)

    return about
