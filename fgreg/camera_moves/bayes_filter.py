"""The full test: Bayes factors of camera moves at given split points, with outliers, windows and large moves.

The filter starts from the Gaussian of the shared variables given the first PMs. Under a hypothesis the marginal
likelihood of the following PMs (as whitened equations, fgreg.camera_moves.whitened) is the product of the predictive
densities of a Kalman filter. Hypotheses:

- none: the camera did not move.
- moved at a split point: the registration is ``trus_T_camera * Exp(xi)`` from that PM on, xi about the camera with a
  zero-mean prior that mixes scales, from a nudge to a camera put back anywhere.

Under each of them any PM may be an outlier, which has a constant density
(fgreg.registration.outliers.OUTLIER_DENSITY). So one gross outlier is an outlier, and several in a row that agree on
one moved registration are a move. The likeliest few sequences of labels (inlier or outlier, PM by PM) are carried
along: a Gaussian sum, cut down to its heaviest terms.

Large moves are not linear: moved hypotheses are linearised again about the registrations they lead to.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from fgreg.camera_moves.whitened import POSE, Gaussian, WhitenedPms, WindowRows, linearise
from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray
from fgreg.graph.packing import PackedProblem
from fgreg.graph.shared_state import SharedState
from fgreg.graph.split_points import ALARM, MoveScales, default_scales, logsumexp
from fgreg.model.sensitivity import interval_moments, log_interval
from fgreg.registration.outliers import OUTLIER_DENSITY

BRANCHES = 4
"""Sequences of labels per hypothesis."""
REACH_RAD, REACH_MM = math.radians(4.0), 10.0
"""Largest moves that are linear enough."""
ROUNDS, SETTLED = 6, 5.0
"""Largest number of linearisations of moved hypotheses; they stop when a move changes by less than reach over this."""
CLOSER = 6
"""Number of split points that are linearised again."""
SUSPICION = 2.0
"""Log score of the first linearisation above which large moves are linearised again."""

OUTLIER_PRIOR, OUTLIER_PRIOR_PMS, OUTLIER_MEMORY = 0.04, 10.0, 50
"""Prior share of outliers, its weight in PMs, and the number of PMs from which it is learned."""
LEAST_OUTLIERS, MOST_OUTLIERS = 0.01, 0.5
"""Bounds of that share: even in a clean stream a single outlier must not look like a move."""


Relinearise = Callable[[FloatArray], WhitenedPms]
"""Linearises the same PMs at steps (S, D) from the base; their steps are counted from the base."""


@dataclass(frozen=True, slots=True, eq=False)
class MoveSettings:
    """Priors and threshold.

    Attributes:
        scales: prior of a move.
        outlier_probability: of each PM; :meth:`learned` from the first PMs.
        threshold: log score from which a camera move is reported.
    """

    scales: MoveScales = field(default_factory=default_scales)
    outlier_probability: float = OUTLIER_PRIOR
    threshold: float = ALARM

    def __post_init__(self) -> None:
        if not 0.0 < self.outlier_probability < 1.0:
            raise ValueError(f"outlier_probability is {self.outlier_probability}, expected a number between 0 and 1")

    def learned(self, inlier: BoolArray) -> MoveSettings:
        """Settings with the outlier probability of the PMs before (n,): where it is small, two in a row are a move."""
        recent = inlier[-OUTLIER_MEMORY:]
        outliers = OUTLIER_PRIOR_PMS * self.outlier_probability + float(np.sum(~recent))
        share = outliers / (OUTLIER_PRIOR_PMS + len(recent))
        return replace(self, outlier_probability=min(max(share, LEAST_OUTLIERS), MOST_OUTLIERS))


@dataclass(frozen=True, slots=True, eq=False)
class MoveEvidence:
    """Result of the filter.

    Attributes:
        log_bayes: (C,) log Bayes factor of a move at each split point against none.
        moved: the shared variables' step given all PMs, if the camera moved at the likeliest one (registration: the
            new one).
    """

    log_bayes: FloatArray
    moved: Gaussian


@dataclass(slots=True, eq=False)
class _Groups:
    """G hypotheses of B label sequences each: mean (G, B, D), covariance (G, B, D, D), log weight (G, B)."""

    mean: FloatArray
    covariance: FloatArray
    log_weight: FloatArray

    @staticmethod
    def one(gaussian: Gaussian) -> _Groups:
        """A single hypothesis of a single sequence; the other sequences have weight zero."""
        log_weight = np.full((1, BRANCHES), -np.inf)
        log_weight[0, 0] = 0.0
        return _Groups(
            np.repeat(gaussian.mean[None, None], BRANCHES, axis=1),
            np.repeat(gaussian.covariance[None, None], BRANCHES, axis=1),
            log_weight,
        )

    def moved(self, move: FloatArray) -> _Groups:
        """A single hypothesis after a move of the registration, for each of K priors of it (K, 6, 6)."""
        count = len(move)
        covariance = np.repeat(self.covariance, count, axis=0)
        covariance[:, :, POSE, POSE] += move[:, None]
        return _Groups(np.repeat(self.mean, count, axis=0), covariance, np.repeat(self.log_weight, count, axis=0))


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
    """One PM under G (or 1) hypotheses: residual (G, q), jacobian (G, q, D), rest (G,); its window, if any."""

    residual: FloatArray
    jacobian: FloatArray
    rest: FloatArray
    window: WindowRows | None


def _rows(terms: WhitenedPms, j: int, hypotheses: slice, times: int) -> _Rows:
    """PM ``j`` of some hypotheses of the terms, each repeated ``times`` times."""

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
    """Step given that the rotation is in its window, by the exact first two moments, and the log density.

    Means (G, B, D), covariances (G, B, D, D). The density is that of the interval, in units of the window's site.
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


def _advance(groups: _Groups, rows: _Rows, log_outlier: float, log_inlier: float) -> _Groups:
    """One more PM: as an inlier, and as an outlier, which changes no estimate; the heaviest sequences are continued.

    ``log_outlier``: log of an outlier's probability and density; ``log_inlier``: of an inlier's probability.
    """
    jacobian = rows.jacobian[:, None]
    gain = groups.covariance @ np.swapaxes(jacobian, -1, -2)
    inverted, log_det = _spread(jacobian @ gain + np.eye(jacobian.shape[-2]))
    innovation = rows.residual[:, None] + (jacobian @ groups.mean[..., None])[..., 0]
    weighted = (inverted @ innovation[..., None])[..., 0]
    log = log_inlier - 0.5 * (np.sum(innovation * weighted, axis=-1) + log_det + rows.rest[:, None])
    mean = groups.mean - (gain @ weighted[..., None])[..., 0]
    covariance = groups.covariance - gain @ inverted @ np.swapaxes(gain, -1, -2)
    if rows.window is not None:
        mean, covariance, more = _in_window(mean, covariance, rows.window)
        log = log + more
    both = np.concatenate([groups.log_weight + log, groups.log_weight + log_outlier], axis=1)
    heaviest = np.argpartition(-both, BRANCHES - 1, axis=1)[:, :BRANCHES]
    parent, inlier = heaviest % BRANCHES, heaviest < BRANCHES
    at = np.arange(len(both))[:, None]
    return _Groups(
        np.where(inlier[..., None], mean[at, parent], groups.mean[at, parent]),
        np.where(inlier[..., None, None], covariance[at, parent], groups.covariance[at, parent]),
        np.take_along_axis(both, heaviest, axis=1),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """Final states of the filters: no move (G = 1), and moves in order of split point and scale."""

    none: _Groups
    moved: _Groups

    def log_bayes(self, share: FloatArray) -> FloatArray:
        """(C, K) of each split point and scale."""
        moved = logsumexp(self.moved.log_weight, axis=1).reshape(-1, len(share)) + np.log(share)
        return np.asarray(moved - logsumexp(self.none.log_weight, axis=1))


def _run(
    before: Gaussian,
    terms: WhitenedPms,
    again: WhitenedPms | None,
    splits: IntArray,
    settings: MoveSettings,
) -> _Run:
    """Run all filters; ``again``: terms as each split point is linearised, (C, n, ...), where that is not ``terms``."""
    scales = settings.scales.covariance
    none = _Groups.one(before)
    moved: _Groups | None = None
    born = 0
    for j in range(terms.count):
        log_outlier = math.log(settings.outlier_probability) + 0.5 * int(terms.equations[j]) * math.log(OUTLIER_DENSITY)
        log_inlier = math.log1p(-settings.outlier_probability)
        if born < len(splits) and splits[born] == j:
            new = none.moved(scales)
            moved = new if moved is None else _joined([moved, new])
            born += 1
        here = _rows(terms, j, slice(None), 1)
        if moved is not None:
            rows = here if again is None else _rows(again, j, slice(0, born), len(scales))
            moved = _advance(moved, rows, log_outlier, log_inlier)
        none = _advance(none, here, log_outlier, log_inlier)
    assert moved is not None  # there is a split point
    return _Run(none, moved)


def move_evidence(
    before: Gaussian,
    terms: WhitenedPms,
    splits: IntArray,
    settings: MoveSettings,
    relinearise: Relinearise | None = None,
) -> MoveEvidence:
    """Test PMs for a move of the camera.

    Args:
        before: the shared variables' step given the first PMs, and all else.
        terms: the other PMs in filter order, linearised once, at the base of the steps.
        splits: (C,) increasing, indices of the first PM after a move.
        settings: priors.
        relinearise: for large moves; without it they are tested with ``terms`` only.

    Raises:
        ValueError: no split point, or one that does not exist.
    """
    if not len(splits) or splits[0] < 0 or splits[-1] >= terms.count or (np.diff(splits) <= 0).any():
        raise ValueError(f"splits are {splits.tolist()}, expected increasing indices of {terms.count} PMs")
    share = settings.scales.share
    run = _run(before, terms, None, splits, settings)
    by_scale = run.log_bayes(share)
    best = [_likeliest(run.moved, c * len(share) + int(np.argmax(by_scale[c]))) for c in range(len(splits))]
    log_bayes = logsumexp(by_scale, axis=1)
    if relinearise is not None and logsumexp(log_bayes) > SUSPICION:
        _look_closer(before, terms, splits, settings, relinearise, log_bayes, best)
    return MoveEvidence(log_bayes, best[int(np.argmax(log_bayes))])


def _likeliest(groups: _Groups, row: int) -> Gaussian:
    """Step of the likeliest sequence of one hypothesis."""
    at = int(np.argmax(groups.log_weight[row]))
    return Gaussian(groups.mean[row, at], groups.covariance[row, at])


def _look_closer(
    before: Gaussian,
    terms: WhitenedPms,
    splits: IntArray,
    settings: MoveSettings,
    relinearise: Relinearise,
    log_bayes: FloatArray,
    best: list[Gaussian],
) -> None:
    """Test the likeliest split points of large moves again, linearised about the moved registration; in place."""
    share = settings.scales.share
    likeliest = np.sort(np.argsort(-log_bayes)[:CLOSER])
    far = np.array([c for c in likeliest if _far(best[c].mean[POSE])], dtype=np.int64)
    if not len(far):
        return
    at = np.zeros((len(far), len(before.mean)))
    for _ in range(ROUNDS):
        steps = np.stack([best[c].mean for c in far])
        if not any(_far(step[POSE]) for step in (steps - at) * SETTLED):
            break
        at = steps
        run = _run(before, terms, relinearise(at), splits[far], settings)
        by_scale = run.log_bayes(share)
        for row, c in enumerate(far):
            best[c] = _likeliest(run.moved, row * len(share) + int(np.argmax(by_scale[row])))
            log_bayes[c] = logsumexp(by_scale[row])


def _far(move: FloatArray) -> bool:
    return bool(np.linalg.norm(move[:3]) > REACH_RAD or np.linalg.norm(move[3:]) > REACH_MM)


def relinearisation(problem: PackedProblem, base: SharedState) -> Relinearise:
    """:data:`Relinearise` of the PMs of a problem about a base state (one hypothesis)."""

    def about(steps: FloatArray) -> WhitenedPms:
        many = base.take(np.zeros(len(steps), dtype=np.int64))
        return linearise(problem, many.retract(steps, problem.columns), base)

    return about
