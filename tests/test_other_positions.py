"""Looks that may have detected the PM at other positions: the pairs decide, the same in batch and online."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgreg.errors import EventRefused
from fgreg.model.measurements import Look, Measurements, OtherPosition, Track
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine import OnlineRegistration
from fgreg.registration.multistart import targets_moved
from fgreg.registration.solve import solve
from tests.forward import Truth, make_measurements
from tests.online_streams import batch, run, sigmas_apart


def _at(look: Look) -> OtherPosition:
    return OtherPosition(look.x_mm, look.range_mm, look.covariance, look.amplitude)


def _session(
    seed: int, wrong: tuple[int, ...], pairs: int = 15, looks_per_pm: int = 1
) -> tuple[SessionModel, Measurements, Measurements, Truth]:
    """A session in which the first wave of some looks is another sound's, and the same without it.

    The PM's own wave is then the other position. The others have a reflection behind.
    """
    model, clean, truth = make_measurements(np.random.default_rng(seed), pairs=pairs, looks_per_pm=looks_per_pm)
    rng = np.random.default_rng([seed, 1])
    changed = []
    for place, pair in enumerate(clean.pairs):
        side = -1.0 if place in wrong else 1.0
        x_mm, range_mm = pair.look.x_mm + rng.uniform(-4, 4), pair.look.range_mm + side * rng.uniform(5, 15)
        look = replace(pair.look, others=(OtherPosition(x_mm, range_mm, pair.look.covariance),))
        changed.append(replace(pair, look=look.elsewhere()[0] if place in wrong else look))
    return model, replace(clean, pairs=tuple(changed)), clean, truth


def test_an_exchanged_look_has_its_first_position_among_the_others() -> None:
    _, measurements, clean, _ = _session(1, (0,), pairs=4)
    look, before = measurements.pairs[0].look, clean.pairs[0].look
    assert (look.x_mm, look.range_mm) != (before.x_mm, before.range_mm)
    back = look.elsewhere()[0]
    assert (back.x_mm, back.range_mm, back.amplitude) == (before.x_mm, before.range_mm, before.amplitude)
    assert [(p.x_mm, p.range_mm) for p in back.others] == [(look.x_mm, look.range_mm)]
    several = replace(before, others=tuple(replace(_at(before), x_mm=x) for x in (1.0, 2.0, 3.0)))
    assert [[p.x_mm for p in other.others] for other in several.elsewhere()] == [
        [before.x_mm, 2.0, 3.0],
        [before.x_mm, 1.0, 3.0],
        [before.x_mm, 1.0, 2.0],
    ]


@pytest.mark.parametrize("wrong", [(), (2, 7, 11), (0, 1, 4, 9, 13)])
def test_the_position_that_fits_the_other_pairs_is_taken(wrong: tuple[int, ...]) -> None:
    for seed in (1, 4):
        model, measurements, clean, truth = _session(seed, wrong)
        solution = solve(measurements, [], model, SolveConfig())
        assert solution.registration is not None
        taken = solution.registration.looks_of(measurements)
        right = [look.range_mm == pair.look.range_mm for look, pair in zip(taken, clean.pairs, strict=True)]
        assert all(right[place] for place in range(15) if place not in wrong)
        assert sum(right) >= 14
        assert sum(pair.used for pair in solution.pairs) >= 14
        found, alone = solution.epochs[0].trus_T_camera, solve(clean, [], model, SolveConfig()).epochs[0].trus_T_camera
        assert found is not None
        assert alone is not None
        true = truth.trus_T_camera[0]
        limit = 1.3 * targets_moved(true, alone, model.targets_mm) + 0.5
        assert targets_moved(true, found, model.targets_mm) < limit


def test_without_other_positions_those_looks_are_outliers() -> None:
    model, measurements, _, _ = _session(5, (2, 7, 11))
    bare = tuple(replace(pair, look=replace(pair.look, others=())) for pair in measurements.pairs)
    pairs = solve(replace(measurements, pairs=bare), [], model, SolveConfig()).pairs
    assert [place for place, pair in enumerate(pairs) if not pair.used] == [2, 7, 11]


def test_of_several_looks_at_a_pm_the_one_that_does_not_fit_is_exchanged() -> None:
    model, measurements, clean, _ = _session(3, (10, 25), pairs=12, looks_per_pm=3)
    solution = solve(measurements, [], model, SolveConfig())
    assert solution.registration is not None
    taken = solution.registration.looks_of(measurements)
    assert [look.range_mm for look in taken] == [pair.look.range_mm for pair in clean.pairs]
    assert all(pair.used for pair in solution.pairs)


@pytest.mark.parametrize("wrong", [(2, 7, 11), (0, 1, 4, 9, 13)])
def test_online_takes_the_same_positions_as_batch(wrong: tuple[int, ...]) -> None:
    model, measurements, _, _ = _session(4, wrong)
    engine = OnlineRegistration(model, verdicts=False, find_moves=False)
    estimate = run(engine, measurements)[-1]
    found = batch(measurements, model)
    taken = [shot.pair.look.range_mm for shot in engine.state.shots]
    assert taken == [look.range_mm for look in found.looks_of(measurements)]
    assert sigmas_apart(found, estimate) < 0.05
    again = [(pair.look.x_mm, pair.look.range_mm) for pair in engine.measurements().pairs]
    assert again == [(pair.look.x_mm, pair.look.range_mm) for pair in measurements.pairs]


def test_a_query_takes_the_position_on_its_beam() -> None:
    model, measurements, clean, _ = _session(1, (3, 8, 12))
    tracks = [Track(pair.t, 0, pair.marker, (pair.look,)) for pair in measurements.pairs]
    plain = [Track(pair.t, 0, pair.marker, (pair.look,)) for pair in clean.pairs]
    found, expected = (solve(clean, queries, model, SolveConfig()).tracks for queries in (tracks, plain))
    for one, other in zip(found, expected, strict=True):
        assert one.stage_rad == pytest.approx(other.stage_rad, abs=1e-6)


def test_a_position_that_is_no_position_is_refused() -> None:
    model, measurements, _, _ = _session(1, (), pairs=4)
    engine = OnlineRegistration(model, verdicts=False, find_moves=False)
    pair = measurements.pairs[0]
    for bad in ({"x_mm": np.nan}, {"range_mm": -1.0}, {"covariance": np.zeros((3, 3))}):
        other = replace(pair.look.others[0], **bad)
        with pytest.raises(EventRefused, match="position"):
            engine.add(replace(pair, look=replace(pair.look, others=(other,))))
