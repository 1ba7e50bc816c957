"""The sequential test for camera moves: junk is no move, a move is, and both have the closed form's evidence."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from fgreg.camera_moves.bayes_filter import MoveSettings, MoveTest, check_for_move
from fgreg.camera_moves.whitened import Gaussian, WhiteTerms
from fgreg.config import SolveConfig
from fgreg.frames import FloatArray, exp_so3, inverse, make_transform
from fgreg.measurements import Measurements
from fgreg.registration import pack_session, register
from fgreg.robust import JUNK_DENSITY
from fgreg.steadiness import MoveScales, default_scales
from tests.epoch_follower import EpochFollower, summarise_aims
from tests.forward import make_measurements, random_marker_T_laser, random_trus_T_camera

CONFIG = SolveConfig()
SETTINGS = MoveSettings(default_scales())
ONE_SCALE = MoveScales(np.array([0.02]), np.array([2.0]), np.array([1.0]))


def _terms(rng: np.random.Generator, pairs: int, size: int = 7) -> tuple[Gaussian, WhiteTerms]:
    """A random linear problem: pose in the first six columns, and one variable more."""
    jacobian = rng.normal(size=(1, pairs, 2, size)) * np.array([30.0] * 3 + [1.0] * (size - 3))
    root = rng.normal(size=(size, size)) * np.array([0.01] * 3 + [0.5] * (size - 3))
    before = Gaussian(rng.normal(size=size) * 0.01, root.T @ root)
    rest = rng.uniform(0.0, 0.5, size=(1, pairs))
    return before, WhiteTerms(rng.normal(size=(1, pairs, 2)), jacobian, rest, np.full(pairs, 2))


def _evidence(before: Gaussian, terms: WhiteTerms, moved: FloatArray, since: int, good: tuple[bool, ...]) -> float:
    """Log density of the good pairs' equations, written out as one Gaussian, less the one of all at their best.

    Registration and move are variables of their own here: the old pose serves pairs before ``since``.
    """
    size = len(before.mean)
    rows, values, log = [], [], 0.0
    for j, is_good in enumerate(good):
        if not is_good:
            log += math.log(JUNK_DENSITY)  # two equations: half the power of two
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


def _all_labels(before: Gaussian, terms: WhiteTerms, moved: FloatArray, since: int, junk: float) -> float:
    """Log of the sum over all sequences of labels."""
    logs = []
    for code in range(2**terms.count):
        good = tuple(not (code >> j) & 1 for j in range(terms.count))
        prior = sum(math.log(1.0 - junk if g else junk) for g in good)
        logs.append(prior + _evidence(before, terms, moved, since, good))
    return float(np.logaddexp.reduce(logs))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_bayes_factors_are_those_of_the_joint_gaussians_summed_over_all_labels(seed: int) -> None:
    before, terms = _terms(np.random.default_rng(seed), 2)
    settings = MoveSettings(ONE_SCALE, junk_probability=0.1)
    found = check_for_move(before, terms, settings, pose=slice(0, 6))
    steady = _all_labels(before, terms, np.zeros((6, 6)), 2, 0.1)
    for since in range(2):
        moved = _all_labels(before, terms, ONE_SCALE.covariance[0], since, 0.1)
        assert found.log_bayes[since] == pytest.approx(moved - steady, abs=1e-8)
    assert found.score == pytest.approx(float(np.logaddexp.reduce(found.log_bayes)))


def test_heaviest_labels_hold_nearly_all_of_the_evidence() -> None:
    before, terms = _terms(np.random.default_rng(4), 6)
    found = check_for_move(before, terms, MoveSettings(ONE_SCALE, 0.05), pose=slice(0, 6))
    steady = _all_labels(before, terms, np.zeros((6, 6)), 6, 0.05)
    exact = [_all_labels(before, terms, ONE_SCALE.covariance[0], since, 0.05) - steady for since in range(6)]
    np.testing.assert_allclose(found.log_bayes, exact, atol=0.3)


def test_only_candidates_asked_for_are_looked_at() -> None:
    before, terms = _terms(np.random.default_rng(5), 6)
    some = check_for_move(before, terms, SETTINGS, pose=slice(0, 6), first=2, last=3)
    every = check_for_move(before, terms, SETTINGS, pose=slice(0, 6))
    np.testing.assert_allclose(some.log_bayes[2:4], every.log_bayes[2:4], atol=1e-9)
    assert np.isneginf(some.log_bayes[[0, 1, 4, 5]]).all()


@pytest.mark.parametrize(("first", "last"), [(6, None), (-1, None), (3, 2), (0, 6)])
def test_candidates_that_are_not_there_are_refused(first: int, last: int | None) -> None:
    before, terms = _terms(np.random.default_rng(5), 6)
    with pytest.raises(ValueError, match="pairs"):
        check_for_move(before, terms, SETTINGS, pose=slice(0, 6), first=first, last=last)


def test_shares_have_to_add_up() -> None:
    with pytest.raises(ValueError, match="add up to 1"):
        MoveScales(np.array([0.1, 0.2]), np.array([1.0, 2.0]), np.array([0.5, 0.4]))


def test_junk_is_as_probable_as_the_stream_says() -> None:
    clean = SETTINGS.learned(np.ones(40, dtype=bool)).junk_probability
    spoiled = SETTINGS.learned(np.arange(40) % 5 > 0).junk_probability
    assert 0.01 <= clean < SETTINGS.junk_probability < 0.12 < spoiled < 0.25


def _stream(seed: int, motion: FloatArray, before: int = 15, after: int = 8) -> tuple[EpochFollower, Measurements]:
    """A follower that has taken in the steady pairs, with all pairs in its problem."""
    rng = np.random.default_rng(seed)
    trus_T_camera, beam = random_trus_T_camera(rng), random_marker_T_laser(rng)
    again = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 1])  # so that both have one window edge
    model, first, _ = make_measurements(
        again[0], aims=12, pairs=before, marker_T_laser=beam, trus_T_camera=trus_T_camera
    )
    _, second, _ = make_measurements(
        again[1], aims=0, pairs=after, marker_T_laser=beam, trus_T_camera=trus_T_camera @ inverse(motion)
    )
    later = tuple(replace(p, pm=p.pm + before, marker=replace(p.marker, id=p.marker.id + 1000)) for p in second.pairs)
    state = register(first, model, CONFIG).optimum.state
    whole = replace(first, pairs=first.pairs + later)
    return EpochFollower(summarise_aims(pack_session(whole, model, CONFIG), state), state, before), whole


def _tests(follower: EpochFollower) -> list[MoveTest]:
    out = []
    for count in range(follower.count + 1, len(follower.problem.pms) + 1):
        follower.advance(count)
        test = follower.test(SETTINGS)
        assert test is not None
        out.append(test)
    return out


def test_nothing_moved_is_no_alarm() -> None:
    follower, _ = _stream(1, np.eye(4), after=12)
    assert not any(test.alarm for test in _tests(follower))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_shift_is_an_alarm_and_since_says_where(seed: int) -> None:
    follower, _ = _stream(seed, make_transform(np.eye(3), np.array([5.0, -5.0, 3.0])))
    tests = _tests(follower)
    assert tests[-1].alarm
    assert abs(len(tests[-1].log_bayes) - tests[-1].since - len(tests)) <= 1


def test_a_large_move_is_found_and_its_registration_with_it() -> None:
    motion = make_transform(exp_so3(np.array([0.25, -0.1, 0.3])), np.array([25.0, -10.0, 20.0]))
    follower, _ = _stream(2, motion, after=10)
    tests = _tests(follower)
    assert all(test.alarm for test in tests[4:])
    moved = follower.state.retract(tests[-1].moved.mean[None], follower.problem.columns).trus_T_camera()[0]
    expected = follower.state.trus_T_camera()[0] @ inverse(motion)
    middle = np.array([0.0, 0.0, 110.0, 1.0])
    away = np.linalg.norm((moved @ middle - expected @ middle)[:3])
    assert away < 0.2 * np.linalg.norm((follower.state.trus_T_camera()[0] @ middle - expected @ middle)[:3])


def test_one_gross_outlier_is_junk_and_no_alarm() -> None:
    follower, _ = _stream(3, np.eye(4), after=6)
    looks = follower.problem.looks
    looks.x_mm[17] += 25.0
    tests = _tests(follower)
    assert not any(test.alarm for test in tests)
    assert tests[-1].steady_good[-4] < 0.05  # the 18th of 21 pairs
    assert (np.delete(tests[-1].steady_good, len(tests[-1].steady_good) - 4) > 0.5).all()
