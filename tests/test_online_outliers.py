"""Outliers among the pairs of a stream: the inliers are those of the batch solve."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgreg.graph.packing import pack
from fgreg.model.measurements import Measurements, Pair
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine import OnlineRegistration
from fgreg.registration.outliers import limits_among
from fgreg.registration.register import register, register_near
from fgreg.smoother.updates import LEAVE, MOST
from tests.forward import make_measurements
from tests.online_streams import batch, first, restored, sigmas_apart


def _with_false_pms(measurements: Measurements, places: list[int]) -> Measurements:
    pairs: list[Pair] = list(measurements.pairs)
    for place in places:
        look = pairs[place].look
        pairs[place] = replace(pairs[place], look=replace(look, x_mm=-look.x_mm - 8.0, range_mm=look.range_mm + 7.0))
    return replace(measurements, pairs=tuple(pairs))


def test_inliers_near_an_optimum_are_those_after_a_search() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(11), pairs=24)
    spoiled = _with_false_pms(measurements, [3, 9, 14, 20])
    found = register(spoiled, model, SolveConfig())
    # From the optimum of before the last pairs, with the outliers among them.
    before = register(replace(spoiled, pairs=spoiled.pairs[:18]), model, SolveConfig())
    near = register_near(spoiled, model, SolveConfig(), before.optimum.state, [0])
    np.testing.assert_array_equal(near.shots.pm_inlier, found.shots.pm_inlier)
    assert not near.shots.pm_inlier[[3, 9, 14, 20]].any()
    there = found.optimum.state.trus_T_camera()[0]
    np.testing.assert_allclose(near.optimum.state.trus_T_camera()[0], there, rtol=0, atol=1e-4)


def test_a_pm_at_the_border_has_one_limit_as_inlier_and_as_outlier() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(12), pairs=10)
    problem = pack(measurements, model)
    counts = np.ones(10, dtype=bool)
    counts[7:] = False
    with_it = counts.copy()
    with_it[7] = True
    out, back = limits_among(problem, counts, 7, 10), limits_among(problem, with_it, 8, 10)
    assert out[7] == back[7]
    assert out[0] < back[0]


def test_online_and_batch_reject_the_same_pairs_while_few_are_there() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(13), pairs=18)
    spoiled = _with_false_pms(measurements, [9, 12, 16])
    engine = OnlineRegistration(model, verdicts=False, find_moves=False)
    restored(engine, first(spoiled, 7))
    for pair in spoiled.pairs[7:]:
        estimate = engine.add(pair)
    found = batch(spoiled, model)
    np.testing.assert_array_equal(engine.inliers, found.shots.pm_inlier[found.shots.problem.look_pm])
    assert not np.array(engine.inliers)[[9, 12, 16]].any()
    assert sigmas_apart(found, estimate) < 0.05


def test_a_look_that_is_an_outlier_is_split_off_and_later_looks_join_the_good_ones() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(14), pairs=15, looks_per_pm=3)
    spoiled = _with_false_pms(measurements, [43])  # the second of the last PM's three looks
    engine = OnlineRegistration(model, verdicts=False, find_moves=False)
    restored(engine, first(spoiled, 39))
    for pair in spoiled.pairs[39:]:
        estimate = engine.add(pair)
    found = batch(spoiled, model)
    assert engine.inliers[42:] == (True, False, True)
    np.testing.assert_array_equal(engine.inliers, found.shots.pm_inlier[found.shots.problem.look_pm])
    assert sigmas_apart(found, estimate) < 0.05


@pytest.mark.parametrize("pms", [MOST, MOST + 1], ids=["still in the active window", "in the marginal prior"])
def test_another_look_at_the_oldest_pm_does_not_count_it_twice(pms: int) -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(15), pairs=MOST + 1, looks_per_pm=2)
    once = replace(measurements, pairs=measurements.pairs[: 2 * pms : 2])
    engine = OnlineRegistration(model, verdicts=False, find_moves=False)
    restored(engine, first(once, MOST - 1))
    for pair in once.pairs[MOST - 1 :]:
        estimate = engine.add(pair)
    assert len(engine.state.marginalised) == (LEAVE if pms > MOST else 0)
    oldest = engine.state.shots[0].label
    again = replace(next(pair for pair in measurements.pairs[1::2] if pair.pm == oldest), t=estimate.t + 1.0)
    estimate = engine.add(again)
    assert estimate.used
    assert estimate.pairs == pms + 1
    assert engine.state.active_window is not None
    assert oldest in {group.label for group in engine.state.active_window.groups}
    assert oldest not in engine.state.marginalised
    assert engine.state.epoch_pms == pms
    assert sigmas_apart(batch(replace(once, pairs=(*once.pairs, again)), model), estimate) < 0.05
