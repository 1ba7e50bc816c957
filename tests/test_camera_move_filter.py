"""The filter of the full test: its Bayes factors are those of the joint Gaussians, summed over inliers and outliers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from fgreg.camera_moves.bayes_filter import MoveSettings, move_evidence
from fgreg.camera_moves.whitened import Gaussian, WhitenedPms
from fgreg.geometry.transforms import FloatArray
from fgreg.graph.split_points import MoveScales, default_scales
from fgreg.registration.outliers import OUTLIER_DENSITY

SETTINGS = MoveSettings(default_scales())
ONE_SCALE = MoveScales(np.array([0.02]), np.array([2.0]), np.array([1.0]))


def _terms(rng: np.random.Generator, pairs: int, size: int = 7) -> tuple[Gaussian, WhitenedPms]:
    """A random linear problem: pose in the first six columns, and one variable more."""
    jacobian = rng.normal(size=(1, pairs, 2, size)) * np.array([30.0] * 3 + [1.0] * (size - 3))
    root = rng.normal(size=(size, size)) * np.array([0.01] * 3 + [0.5] * (size - 3))
    before = Gaussian(rng.normal(size=size) * 0.01, root.T @ root)
    rest = rng.uniform(0.0, 0.5, size=(1, pairs))
    return before, WhitenedPms(rng.normal(size=(1, pairs, 2)), jacobian, rest, np.full(pairs, 2))


def _evidence(before: Gaussian, terms: WhitenedPms, moved: FloatArray, since: int, good: tuple[bool, ...]) -> float:
    """Log density of the good pairs' equations, written out as one Gaussian, less the one of all at their best.

    Registration and move are variables of their own here: the old pose serves pairs before ``since``.
    """
    size = len(before.mean)
    rows, values, log = [], [], 0.0
    for j, is_good in enumerate(good):
        if not is_good:
            log += math.log(OUTLIER_DENSITY)  # two equations: half the power of two
            continue
        jacobian = terms.jacobian[0, j]
        by_move = jacobian[:, :6] if j >= since else np.zeros((2, 6))
        rows.append(np.hstack([jacobian, by_move]))
        values.append(-terms.residual[0, j])
        log -= 0.5 * float(terms.rest[0, j])
    if not rows:
        return log
    design, value = np.vstack(rows), np.concatenate(values)
    prior = np.zeros((size + 6, size + 6))
    prior[:size, :size], prior[size:, size:] = before.covariance, moved
    mean = design[:, :size] @ before.mean
    spread = design @ prior @ design.T + np.eye(len(value))
    density = float(multivariate_normal(mean, spread, allow_singular=True).logpdf(value))
    return log + density + 0.5 * len(value) * math.log(2.0 * math.pi)


def _all_labels(before: Gaussian, terms: WhitenedPms, moved: FloatArray, since: int, outlier: float) -> float:
    """Log of the sum over all sequences of labels."""
    logs = []
    for code in range(2**terms.count):
        good = tuple(not (code >> j) & 1 for j in range(terms.count))
        prior = sum(math.log(1.0 - outlier if g else outlier) for g in good)
        logs.append(prior + _evidence(before, terms, moved, since, good))
    return float(np.logaddexp.reduce(logs))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_bayes_factors_are_those_of_the_joint_gaussians_summed_over_all_labels(seed: int) -> None:
    before, terms = _terms(np.random.default_rng(seed), 2)
    settings = MoveSettings(ONE_SCALE, outlier_probability=0.1)
    found = move_evidence(before, terms, np.arange(terms.count), settings)
    steady = _all_labels(before, terms, np.zeros((6, 6)), 2, 0.1)
    for since in range(2):
        moved = _all_labels(before, terms, ONE_SCALE.covariance[0], since, 0.1)
        assert found.log_bayes[since] == pytest.approx(moved - steady, abs=1e-8)


def test_heaviest_labels_hold_nearly_all_of_the_evidence() -> None:
    before, terms = _terms(np.random.default_rng(4), 6)
    found = move_evidence(before, terms, np.arange(6), MoveSettings(ONE_SCALE, 0.05))
    steady = _all_labels(before, terms, np.zeros((6, 6)), 6, 0.05)
    exact = [_all_labels(before, terms, ONE_SCALE.covariance[0], since, 0.05) - steady for since in range(6)]
    np.testing.assert_allclose(found.log_bayes, exact, atol=0.3)


def test_each_split_point_is_tested_as_if_it_were_the_only_one() -> None:
    before, terms = _terms(np.random.default_rng(5), 6)
    some = move_evidence(before, terms, np.array([2, 3]), SETTINGS)
    every = move_evidence(before, terms, np.arange(6), SETTINGS)
    np.testing.assert_allclose(some.log_bayes, every.log_bayes[2:4], atol=1e-9)


@pytest.mark.parametrize("splits", [[], [6], [-1], [3, 2], [2, 2]])
def test_split_points_that_are_not_there_are_refused(splits: list[int]) -> None:
    before, terms = _terms(np.random.default_rng(5), 6)
    with pytest.raises(ValueError, match="increasing indices of 6 PMs"):
        move_evidence(before, terms, np.array(splits, dtype=np.int64), SETTINGS)


def test_shares_have_to_add_up() -> None:
    with pytest.raises(ValueError, match="add up to 1"):
        MoveScales(np.array([0.1, 0.2]), np.array([1.0, 2.0]), np.array([0.5, 0.4]))


def test_outliers_are_as_probable_as_the_pms_before_say() -> None:
    clean = SETTINGS.learned(np.ones(40, dtype=bool)).outlier_probability
    spoiled = SETTINGS.learned(np.arange(40) % 5 > 0).outlier_probability
    assert 0.01 <= clean < SETTINGS.outlier_probability < 0.12 < spoiled < 0.25
