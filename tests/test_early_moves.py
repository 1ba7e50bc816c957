"""Unreported moves before an epoch's seventh PM.

Refused or a warning while pairs of both sides are mixed, then found, and never solved as one registration.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from fgreg.camera_moves.detector import CameraMove, find_camera_move
from fgreg.camera_moves.recorded_session import find_moves, split_epochs
from fgreg.geometry.target_error import tre_mm
from fgreg.geometry.transforms import exp_so3, make_transform
from fgreg.graph.split_points import ALARM, GATE, logsumexp
from fgreg.model.estimate import Verdict
from fgreg.model.measurements import Measurements
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine import OnlineRegistration
from fgreg.online.events import events_in_order
from fgreg.registration.move_doubt import move_doubt, moves_in_epoch, outliers_in_a_row
from fgreg.registration.register import register
from fgreg.registration.solve import solve
from fgreg.registration.verdict import MOST_WRONG
from tests.camera_move_cases import move_case, moved_session
from tests.forward import Truth, make_measurements
from tests.online_streams import unreported_move

FAST = SolveConfig(posterior_effective=60.0, posterior_samples=600)
BUMP = make_transform(exp_so3(np.array([0.03, -0.02, 0.03])), np.array([3.0, -4.0, 2.0]))


@cache
def _ran(before: int) -> tuple[SessionModel, Measurements, tuple[Truth, Truth], OnlineRegistration]:
    """A session with a move after few PMs, and the engine that took it in: read only."""
    model, measurements, truths = unreported_move(3, BUMP, 12, before)
    engine = OnlineRegistration(model, verdicts=False)
    for _, event in events_in_order(measurements):
        engine.add(event)
    return model, measurements, truths, engine


@pytest.mark.parametrize("before", [2, 6])
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


def test_few_pairs_before_a_move_lead_no_registration_astray() -> None:
    # Four pairs determine the old registration so weakly that full steps of its optimum diverge, to 1e22 mm.
    model, measurements, truths = unreported_move(6, BUMP, 14, 4)
    engine = OnlineRegistration(model, verdicts=False)
    for _, event in events_in_order(measurements):
        engine.add(event)
    assert [move.since for move in engine.moves] == [4]
    earlier, estimate = engine.state.epochs[0].state, engine.estimate
    assert earlier is not None
    assert np.linalg.norm(earlier.translation_mm) < 300.0
    assert estimate.trus_T_camera is not None
    assert tre_mm(estimate.trus_T_camera, truths[1].trus_T_camera[0], model.targets_mm).max() < 3.0


def test_online_and_batch_find_the_same_early_move() -> None:
    model, measurements, _, engine = _ran(4)
    moves = find_moves(measurements, model, SolveConfig())
    assert [(m.since, m.since_t) for m in moves] == [(m.since, m.since_t) for m in engine.moves]
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


def test_steady_sessions_raise_no_alarm_and_few_warnings() -> None:
    scores = []
    for seed in range(6):
        model, measurements, _ = make_measurements(
            np.random.default_rng([seed, 40]), pairs=12, first_hit=bool(seed % 2)
        )
        found = register(measurements, model, FAST)
        pms, moved = moves_in_epoch(found, 0, outliers=True)
        assert len(moved.log) == len(pms) - 1
        scores.append(float(logsumexp(moved.log)))
    assert max(scores) < ALARM
    assert sorted(scores)[4] < GATE


@pytest.mark.parametrize(("seed", "before"), [(3, 4), (1, 5), (2, 2)])
def test_early_moves_are_found_by_the_many_pms_after_them(seed: int, before: int) -> None:
    model, measurements, _ = moved_session(seed, BUMP, before, 12)
    found = find_camera_move(move_case(measurements, model), model, SolveConfig())
    assert isinstance(found, CameraMove)
    assert abs(found.first - before) <= 1
    assert found.score >= found.log_bayes > ALARM


@pytest.mark.parametrize("split", [4, 12])
def test_a_move_reads_the_same_in_either_direction_of_time(split: int) -> None:
    model, measurements, _ = moved_session(3, BUMP, split, 16 - split)
    case = move_case(measurements, model)
    back = replace(case, pms=case.pms[::-1], places=tuple(range(16)), inlier=case.inlier[::-1])
    forward, backward = (find_camera_move(of, model, SolveConfig()) for of in (case, back))
    assert isinstance(forward, CameraMove)
    assert isinstance(backward, CameraMove)
    assert backward.first == 16 - forward.first
    assert backward.score == pytest.approx(forward.score, abs=1e-6)


def test_as_few_pms_on_both_sides_as_no_registration_takes_are_not_tested() -> None:
    model, measurements, _ = moved_session(3, BUMP, 5, 5)
    assert find_camera_move(move_case(measurements, model), model, SolveConfig()) is None


def test_a_side_of_outliers_has_no_registration_to_test_the_other_against() -> None:
    model, measurements, _ = moved_session(3, BUMP, 4, 12)
    case = move_case(measurements, model)
    assert isinstance(find_camera_move(case, model, SolveConfig()), CameraMove)
    few = np.arange(16) >= 11
    assert find_camera_move(replace(case, inlier=few), model, SolveConfig()) is None


def test_without_an_estimate_there_is_nothing_to_test() -> None:
    model, measurements, _ = moved_session(3, BUMP, 4, 12)
    case = replace(move_case(measurements, model), known=None)
    assert find_camera_move(case, model, SolveConfig()) is None


def test_screening_passes_over_a_steady_epoch() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(41), pairs=14)
    assert find_camera_move(move_case(measurements, model), model, SolveConfig()) is None


@pytest.mark.parametrize(
    ("outliers", "row"),
    [
        ((), None),
        ((7,), None),
        ((2, 7, 12), None),
        ((8, 9), slice(8, 10)),
        ((1, 7, 8, 9), slice(7, 10)),
        ((5, 6, 8, 9), slice(5, 10)),
        ((0, 3, 6, 9), None),
    ],
)
def test_outliers_in_a_row_may_be_one_side_of_a_move(outliers: tuple[int, ...], row: slice | None) -> None:
    inlier = np.ones(10, dtype=bool)
    inlier[[i for i in outliers if i < 10]] = False
    assert outliers_in_a_row(inlier) == row


def test_the_probability_of_a_large_error_is_that_of_the_move() -> None:
    model, measurements, _ = moved_session(3, BUMP, 5, 5)
    found = register(measurements, model, FAST)
    near, far = (move_doubt(found, 0, limit_mm) for limit_mm in (1.0, 1000.0))
    assert near is not None
    assert far is not None
    assert near.wrong > 0.5
    assert far.wrong < MOST_WRONG
    assert near.before in (3, 4, 5)
    steady, clean, _ = make_measurements(np.random.default_rng([1, 40]), pairs=12)
    calm = move_doubt(register(clean, steady, FAST), 0, 3.0)
    assert calm is not None
    assert calm.wrong < MOST_WRONG


def test_last_pairs_that_fit_one_other_registration_are_refused_and_scattered_outliers_are_not() -> None:
    model, measurements, _ = moved_session(3, BUMP, 16, 3)
    solution = solve(measurements, [], model, replace(FAST, limit_mm=1000.0))
    assert solution.verdict is Verdict.REFUSED
    assert any("in a row, PM 16 to 18" in reason for reason in solution.reasons)
    order = [16, *range(4), 17, *range(4, 10), 18, *range(10, 16)]
    mixed = tuple(replace(measurements.pairs[k], t=measurements.pairs[i].t) for i, k in enumerate(order))
    scattered = solve(replace(measurements, pairs=mixed), [], model, replace(FAST, limit_mm=1000.0))
    assert scattered.verdict is not Verdict.REFUSED


@pytest.mark.parametrize(("limit_mm", "refused"), [(1.5, True), (1000.0, False)])
def test_outliers_in_a_row_between_pairs_that_fit_are_refused_only_beside_another_doubt(
    limit_mm: float, refused: bool
) -> None:
    model, measurements, _ = moved_session(3, BUMP, 22, 2)
    order = [*range(11), 22, 23, *range(11, 22)]
    between = tuple(replace(measurements.pairs[k], t=measurements.pairs[i].t) for i, k in enumerate(order))
    solution = solve(replace(measurements, pairs=between), [], model, replace(FAST, limit_mm=limit_mm))
    assert (solution.verdict is Verdict.REFUSED) is refused
    assert any("in a row, PM 22 to 23" in reason for reason in solution.reasons) is refused


def test_outliers_count_in_the_doubt_of_a_move() -> None:
    model, measurements, _ = moved_session(3, BUMP, 16, 3)
    found = register(measurements, model, FAST)
    assert not found.shots.pm_inlier[16:].any()
    doubt = move_doubt(found, 0, 3.0)
    assert doubt is not None
    assert (doubt.before, doubt.after, doubt.pms) == (15, 16, 19)
    assert doubt.log_odds > ALARM
    assert doubt.wrong > MOST_WRONG
