"""Moves that nobody tells before an epoch's seventh PM: refused or doubted while pairs of both sides are mixed, then
found, and never taken for one registration.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from fgreg.batch import solve
from fgreg.camera_moves.bayes_filter import MoveSettings
from fgreg.config import SolveConfig
from fgreg.estimate import Verdict
from fgreg.frames import exp_so3, make_transform
from fgreg.measurements import Measurements
from fgreg.models import SessionModel
from fgreg.online import OnlineRegistration
from fgreg.online.detect import events_in_order, find_moves, split_epochs
from fgreg.online.early import EarlyCase, early_test
from fgreg.registration import register
from fgreg.steadiness import ALARM, DOUBT, logsumexp, odds_in_epoch
from fgreg.targets import tre_mm
from fgreg.verdict import ABOUT_EVEN, FEW_PMS, unsteady
from tests.forward import Truth, make_measurements
from tests.online_streams import untold_move

FAST = SolveConfig(posterior_effective=60.0, posterior_samples=600)
BUMP = make_transform(exp_so3(np.array([0.03, -0.02, 0.03])), np.array([3.0, -4.0, 2.0]))


@cache
def _ran(before: int) -> tuple[SessionModel, Measurements, tuple[Truth, Truth], OnlineRegistration]:
    """A session with a move after so few PMs, and the engine that went through it: to look at only."""
    model, measurements, truths = untold_move(3, BUMP, 12, before)
    engine = OnlineRegistration(model, judge=None)
    for _, event in events_in_order(measurements):
        engine.add(event)
    return model, measurements, truths, engine


@pytest.mark.parametrize("before", [2, 4, 6])
def test_a_move_after_few_pms_is_found_and_they_become_an_epoch_of_their_own(before: int) -> None:
    model, measurements, truths, engine = _ran(before)
    assert engine.moves
    assert sum(pair.epoch < engine.estimate.epoch for pair in engine.measurements().pairs) == pytest.approx(
        before, abs=1
    )
    estimate = engine.estimate
    assert estimate.trus_T_camera is not None
    assert tre_mm(estimate.trus_T_camera, truths[1].trus_T_camera[0], model.targets_mm).max() < 3.0
    assert estimate.verdict is not Verdict.OK
    assert len(measurements.pairs) == before + 12


def test_online_and_batch_find_the_same_early_move() -> None:
    model, measurements, _, engine = _ran(4)
    moves = find_moves(measurements, model, SolveConfig())
    assert [(m.since, m.since_t, m.alarm_t) for m in moves] == [(m.since, m.since_t, m.alarm_t) for m in engine.moves]
    split, online = split_epochs(measurements, moves), engine.measurements()
    assert [pair.epoch for pair in split.pairs] == [pair.epoch for pair in online.pairs]


def test_pairs_of_both_sides_are_not_solved_as_one_registration() -> None:
    model, measurements, truths, _ = _ran(4)
    mixed = replace(measurements, pairs=measurements.pairs[:8])
    solution = solve(mixed, [], model, FAST)
    epoch = solution.epochs[0]
    assert epoch.trus_T_camera is not None
    assert tre_mm(epoch.trus_T_camera, truths[1].trus_T_camera[0], model.targets_mm).max() > FAST.limit_mm
    assert solution.verdict is not Verdict.OK
    assert any("not fit one registration" in reason for reason in solution.reasons)


def test_steady_sessions_raise_no_alarm_and_hardly_a_doubt() -> None:
    scores = []
    for seed in range(6):
        model, measurements, _ = make_measurements(
            np.random.default_rng([seed, 40]), pairs=12, first_hit=bool(seed % 2)
        )
        found = register(measurements, model, FAST)
        pms, log = odds_in_epoch(found.problem, found.optimum, found.covariance, 0)
        assert len(log) == len(pms) - 1
        scores.append(float(logsumexp(log)))
    assert max(scores) < ALARM
    assert sorted(scores)[4] < DOUBT


def _case(measurements: Measurements, early: int) -> EarlyCase:
    pairs = tuple((replace(pair, pm=n),) for n, pair in enumerate(measurements.pairs))
    return EarlyCase(pairs, tuple(range(len(pairs))), early, measurements.aims)


def test_the_first_pms_are_judged_by_the_last_ones() -> None:
    model, measurements, _, _ = _ran(4)
    tested = early_test(_case(measurements, 6), model, SolveConfig(), None, MoveSettings())
    assert tested is not None
    assert tested.test.alarm
    assert tested.places == (6, 5, 4, 3, 2, 1)
    assert tested.places[tested.test.since] == 4


def test_last_pms_that_are_of_both_sides_judge_nobody() -> None:
    model, measurements, _, _ = _ran(4)
    mixed = replace(measurements, pairs=measurements.pairs[:9])
    assert early_test(_case(mixed, 2), model, SolveConfig(), None, MoveSettings()) is None


def test_a_steady_epoch_s_first_pms_fit_its_last_ones() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(41), pairs=14)
    tested = early_test(_case(measurements, 6), model, SolveConfig(), None, MoveSettings())
    assert tested is not None
    assert not tested.test.alarm
    assert tested.test.score < DOUBT


@pytest.mark.parametrize(
    ("log_odds", "pms", "verdicts"),
    [
        (math.log(7 * ABOUT_EVEN) - 0.1, 8, []),
        (math.log(7 * ABOUT_EVEN) + 0.1, 8, [Verdict.WARNING]),
        (math.log(7 * ABOUT_EVEN) + 0.1, 12, []),
        (math.log(7 * ABOUT_EVEN) + 0.1, 5, []),
        (ALARM + 0.1, 5, [Verdict.REFUSED]),
        (ALARM + 0.1, 8, [Verdict.REFUSED]),
        (math.log(FEW_PMS * ABOUT_EVEN) + 0.1, FEW_PMS + 1, []),
        (ALARM + 0.1, FEW_PMS + 1, [Verdict.WARNING]),
    ],
)
def test_odds_of_a_move_become_a_verdict(log_odds: float, pms: int, verdicts: list[Verdict]) -> None:
    found = unsteady(log_odds, 3, 4, pms)
    assert [condition.verdict for condition in found] == verdicts
    assert all("up to PM 3 and those from PM 4" in condition.text for condition in found)
