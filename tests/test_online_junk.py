"""Junk among the pairs of a stream: who counts online is who counts in the batch solve."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fgreg.config import SolveConfig
from fgreg.graph.packing import pack
from fgreg.measurements import Measurements, Pair
from fgreg.online import OnlineRegistration
from fgreg.online.state import WINDOW
from fgreg.online.updates import pms_in_epoch
from fgreg.registration import register, register_near
from fgreg.robust import limits_among
from tests.forward import make_measurements
from tests.online_streams import batch, run, sigmas_apart


def _with_false_pms(measurements: Measurements, places: list[int]) -> Measurements:
    pairs: list[Pair] = list(measurements.pairs)
    for place in places:
        look = pairs[place].look
        pairs[place] = replace(pairs[place], look=replace(look, x_mm=-look.x_mm - 8.0, range_mm=look.range_mm + 7.0))
    return replace(measurements, pairs=tuple(pairs))


def test_who_counts_near_an_optimum_is_who_counts_after_a_search() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(11), pairs=24)
    spoiled = _with_false_pms(measurements, [3, 9, 14, 20])
    found = register(spoiled, model, SolveConfig())
    # From the optimum of before the last pairs, with the junk among them.
    before = register(replace(spoiled, pairs=spoiled.pairs[:18]), model, SolveConfig())
    near = register_near(spoiled, model, SolveConfig(), before.optimum.state, [0])
    np.testing.assert_array_equal(near.shots.pm_kept, found.shots.pm_kept)
    assert not near.shots.pm_kept[[3, 9, 14, 20]].any()
    there = found.optimum.state.trus_T_camera()[0]
    np.testing.assert_allclose(near.optimum.state.trus_T_camera()[0], there, rtol=0, atol=1e-4)


def test_a_pm_at_the_border_has_one_limit_whether_it_counts_or_not() -> None:
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
    model, measurements, _ = make_measurements(np.random.default_rng(13), pairs=22)
    spoiled = _with_false_pms(measurements, [9, 12, 17])
    engine = OnlineRegistration(model, judge=None)
    estimate = run(engine, spoiled)[-1]
    found = batch(spoiled, model)
    np.testing.assert_array_equal(engine.kept, found.shots.pm_kept[found.shots.problem.look_pm])
    assert not np.array(engine.kept)[[9, 12, 17]].any()
    assert sigmas_apart(found, estimate) < 0.05


def test_a_junk_look_is_split_off_beyond_the_first_pairs_and_later_looks_join_the_good_ones() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(14), pairs=15, looks_per_pm=3)
    spoiled = _with_false_pms(measurements, [43])  # the second of the last PM's three looks
    engine = OnlineRegistration(model, judge=None)
    estimate = run(engine, spoiled)[-1]
    found = batch(spoiled, model)
    assert engine.kept[42:] == (True, False, True)
    np.testing.assert_array_equal(engine.kept, found.shots.pm_kept[found.shots.problem.look_pm])
    assert sigmas_apart(found, estimate) < 0.05


def test_a_look_at_the_oldest_pm_of_a_full_window_does_not_count_twice() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(15), pairs=30, looks_per_pm=2)
    engine = OnlineRegistration(model, judge=None)
    run(engine, replace(measurements, pairs=()))
    looks = iter(measurements.pairs[::2])
    t = 0.0
    while engine.state.window is None or len(engine.state.window.groups) < WINDOW:
        pair = next(looks)
        t = pair.t
        engine.add(pair)
    oldest = engine.state.window.groups[0].label
    before = pms_in_epoch(engine.state)
    again = next(pair for pair in measurements.pairs[1::2] if pair.pm == oldest)
    assert engine.add(replace(again, t=t + 1.0)).used
    assert engine.state.window is not None
    assert oldest in {group.label for group in engine.state.window.groups}
    assert pms_in_epoch(engine.state) == before
