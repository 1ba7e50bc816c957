"""Closing the loop: an earlier epoch's registration is used again only where pairs or tags say that it fits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgreg.camera_moves.bayes_filter import relinearisation
from fgreg.camera_moves.loop_closure import Return, ReturnTest, default_return_settings, fits_again, which_epoch
from fgreg.camera_moves.static_tags import TagMotion
from fgreg.camera_moves.whitened import linearise, pose_columns
from fgreg.config import SolveConfig
from fgreg.frames import FloatArray, exp_so3, inverse, make_transform
from fgreg.graph.pm_selection import select_pms
from fgreg.registration import pack_session, register
from tests.epoch_follower import EpochFollower, summarise_aims
from tests.forward import make_measurements, random_marker_T_laser, random_trus_T_camera

CONFIG = SolveConfig()
SETTINGS = default_return_settings()
BEFORE = 20


def _test_after(seed: int, motion: FloatArray, pairs: int, *, spoil: bool = False) -> ReturnTest:
    """The test on so many pairs taken after a motion off a steady epoch of 20."""
    rng = np.random.default_rng(seed)
    trus_T_camera, beam = random_trus_T_camera(rng), random_marker_T_laser(rng)
    again = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 1])  # so that both have one window edge
    model, first, _ = make_measurements(
        again[0], aims=12, pairs=BEFORE, marker_T_laser=beam, trus_T_camera=trus_T_camera
    )
    _, second, _ = make_measurements(
        again[1], aims=0, pairs=pairs, marker_T_laser=beam, trus_T_camera=trus_T_camera @ inverse(motion)
    )
    later = [replace(p, pm=p.pm + BEFORE, marker=replace(p.marker, id=p.marker.id + 1000)) for p in second.pairs]
    if spoil:
        later[1] = replace(later[1], look=replace(later[1].look, x_mm=later[1].look.x_mm - 15.0))
    state = register(first, model, CONFIG).optimum.state
    problem = summarise_aims(pack_session(replace(first, pairs=(*first.pairs, *later)), model, CONFIG), state)
    follower = EpochFollower(problem, state, BEFORE)
    tail = select_pms(problem, np.arange(BEFORE, BEFORE + pairs))
    return fits_again(
        follower.everything(),
        linearise(tail, follower.state),
        SETTINGS,
        pose=pose_columns(0),
        relinearise=relinearisation(tail, follower.state),
    )


def test_a_camera_put_back_is_mostly_recognised_and_never_taken_for_elsewhere() -> None:
    decisions = [_test_after(seed, np.eye(4), 15).decision for seed in range(1, 9)]
    assert Return.NEW not in decisions
    assert decisions.count(Return.SAME) >= 5


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(
    "motion",
    [
        make_transform(np.eye(3), np.array([0.0, 6.0, 0.0])),
        make_transform(exp_so3(np.array([0.2, -0.3, 0.1])), np.array([20.0, -10.0, 15.0])),
    ],
    ids=["near", "far"],
)
def test_a_camera_elsewhere_is_not_taken_for_back(seed: int, motion: FloatArray) -> None:
    assert _test_after(seed, motion, 12).decision is Return.NEW


def test_one_junk_pair_costs_little_of_the_evidence_for_being_back() -> None:
    clean, spoiled = (_test_after(1, np.eye(4), 12, spoil=spoil).log_bayes for spoil in (False, True))
    assert spoiled > 2.0
    assert clean - spoiled < 2.0


def test_two_pairs_decide_nothing_for_re_use() -> None:
    assert _test_after(1, np.eye(4), 2).decision is Return.OPEN


def _tags(motion: FloatArray, sigma_mm: float, sigma_rad: float | None) -> TagMotion:
    covariance = np.diag([sigma_rad or sigma_mm / 100.0] * 3 + [sigma_mm] * 3) ** 2
    return TagMotion(motion, covariance, 0.0, (0, 1, 2), ())


def _by_tags(motion: FloatArray, sigma_mm: float, sigma_rad: float | None = None) -> Return:
    model, measurements, _ = make_measurements(np.random.default_rng(1), aims=12, pairs=8)
    state = register(measurements, model, CONFIG).optimum.state
    follower = EpochFollower(summarise_aims(pack_session(measurements, model, CONFIG), state), state, 8)
    none = linearise(select_pms(follower.problem, np.arange(0, 1)), state).take(np.zeros(0, dtype=np.int64))
    return fits_again(
        follower.everything(), none, SETTINGS, pose=pose_columns(0), tags=_tags(motion, sigma_mm, sigma_rad)
    ).decision


def test_tags_decide_before_there_is_a_pair() -> None:
    assert _by_tags(np.eye(4), 0.2) is Return.SAME
    assert _by_tags(make_transform(np.eye(3), np.array([0.0, 2.0, 0.0])), 0.2) is Return.NEW


def test_tags_that_are_not_sure_decide_nothing() -> None:
    assert _by_tags(np.eye(4), 8.0) is Return.OPEN


def test_tags_that_are_sure_of_the_turn_only_do_not_say_that_nothing_was_shifted() -> None:
    assert _by_tags(np.eye(4), 3.0, 0.001) is not Return.SAME


def test_without_pairs_and_tags_it_is_open() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(1), aims=12, pairs=8)
    state = register(measurements, model, CONFIG).optimum.state
    problem = summarise_aims(pack_session(measurements, model, CONFIG), state)
    earlier = EpochFollower(problem, state, 8).everything()
    none = linearise(problem, state).take(np.zeros(0, dtype=np.int64))
    assert fits_again(earlier, none, SETTINGS, pose=pose_columns(0)).decision is Return.OPEN


def test_of_several_epochs_that_fit_the_best_is_used_and_of_none_none() -> None:
    same, better, new = ReturnTest(5.0, Return.SAME), ReturnTest(9.0, Return.SAME), ReturnTest(-9.0, Return.NEW)
    assert which_epoch({0: same, 1: new, 2: better}) == 2
    assert which_epoch({0: new, 1: ReturnTest(1.0, Return.OPEN)}) is None


def test_limits_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="accept and reject"):
        replace(SETTINGS, accept=-1.0)
