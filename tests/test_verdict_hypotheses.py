"""Sessions with one thing wrong throughout are not `ok`, and the reason names it and what to do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgreg.geometry.target_error import tre_mm
from fgreg.geometry.transforms import as_float_array, exp_so3, make_transform
from fgreg.model.estimate import PredictedTre, Verdict
from fgreg.model.solve_config import SolveConfig
from fgreg.model.systematic import EXACT
from fgreg.registration.register import register
from fgreg.registration.solve import solve
from fgreg.registration.verdict import (
    Causes,
    accuracy,
    causes_of_error,
    understated_noise,
)
from tests.forward import make_measurements, make_session


@pytest.mark.parametrize("seed", range(2))
def test_sweep_signs_turned_round_are_named_in_a_two_way_session(seed: int) -> None:
    model, clean, _ = make_measurements(np.random.default_rng(seed), pairs=20)
    pairs = tuple(replace(pair, look=replace(pair.look, sweep=-pair.look.sweep)) for pair in clean.pairs)
    solution = solve(replace(clean, pairs=pairs), [], model, SolveConfig())
    assert solution.verdict is Verdict.REFUSED
    assert any("signs reversed" in reason and "sweep in events.jsonl" in reason for reason in solution.reasons)


def test_a_marker_swapped_after_calibration_is_named() -> None:
    model, clean, _ = make_measurements(np.random.default_rng(1), pairs=20)
    other_T_marker = make_transform(exp_so3(np.array([0.1, -0.15, 0.2])), np.array([6.0, -4.0, 3.0]))
    pairs = tuple(
        replace(p, marker=replace(p.marker, camera_T_marker=as_float_array(p.marker.camera_T_marker @ other_T_marker)))
        for p in clean.pairs
    )
    solution = solve(replace(clean, pairs=pairs), [], model, SolveConfig())
    assert solution.verdict is Verdict.REFUSED
    assert any(
        "another beam than the aims" in reason and "take the aims again" in reason for reason in solution.reasons
    )


def test_noise_of_three_times_the_stated_one_is_reported() -> None:
    for seed in range(3):
        model, clean, _ = make_measurements(np.random.default_rng(seed), pairs=20)
        pairs = tuple(
            replace(
                p,
                marker=replace(p.marker, covariance=p.marker.covariance / 9),
                look=replace(p.look, covariance=p.look.covariance / 9),
            )
            for p in clean.pairs
        )
        solution = solve(replace(clean, pairs=pairs), [], model, SolveConfig())
        assert solution.verdict is not Verdict.OK
        assert any("larger than the stated noise explains" in reason for reason in solution.reasons)


def test_a_wrong_sound_speed_shows_where_pairs_are_many() -> None:
    declared = make_session(systematic=replace(EXACT, sound_speed=0.001))
    model, right, _ = make_measurements(np.random.default_rng(0), pairs=400, session=declared)
    assert not [reason for reason in solve(right, [], model, SolveConfig()).reasons if "sound speed" in reason]
    model, wrong, truth = make_measurements(
        np.random.default_rng(0), pairs=400, session=declared, sound_speed_ratio=1.02
    )
    found = solve(wrong, [], model, SolveConfig())
    assert found.verdict is not Verdict.OK
    assert any("contradict the sound speed" in reason and "larger than declared" in reason for reason in found.reasons)
    (speed,) = (constant for constant in found.systematic if constant.name == "sound_speed")
    assert speed.value / speed.observed == pytest.approx(0.02, abs=0.01)
    # The predicted error includes that of what is named: without it, it would be below the true one.
    (epoch,), (report,) = found.epochs, found.reports
    assert epoch.trus_T_camera is not None
    assert epoch.predicted_tre is not None
    named = sum(condition.effect_mm for condition in report.common)
    worst = tre_mm(epoch.trus_T_camera, truth.trus_T_camera[0], model.targets_mm).max()
    assert epoch.predicted_tre.worst_mm - named < worst < epoch.predicted_tre.worst_mm


def test_the_beams_share_of_the_error_grows_as_aims_are_taken_away() -> None:
    model, clean, _ = make_measurements(np.random.default_rng(3), pairs=15, aims=60, roll_deg=30.0)
    shares = []
    for aims in (5, 15, 60):
        found = register(replace(clean, aims=clean.aims[:aims]), model, SolveConfig())
        shares.append(causes_of_error(found, 0, model.targets_mm).beam)
    assert 1.0 > shares[0] > shares[1] > shares[2] > 0.0


def test_a_beam_that_dominates_the_error_is_to_be_calibrated_with_roll() -> None:
    tre = PredictedTre(mean_mm=2.0, p95_mm=3.0, worst_mm=4.0)
    text = accuracy(tre, SolveConfig(), Causes(beam=0.7, edge=0.1))[0].text
    assert "roll the fibre about its beam during calibration" in text
    assert "70 %" in text
    assert "more pairs" in accuracy(tre, SolveConfig(), Causes(beam=0.2, edge=0.1))[0].text
    assert "both sides at each PM" in accuracy(tre, SolveConfig(), Causes(beam=0.2, edge=0.6))[0].text
    known = accuracy(tre, SolveConfig(), Causes(beam=0.2, edge=0.6), both_sides=True)[0].text
    assert "both sides" not in known
    assert "measure the window's half width" in known
    named = accuracy(tre, SolveConfig(), Causes(beam=0.7, edge=0.1), named_mm=3.0)[0].text
    assert "3.0 mm of it by what is named above" in named


def test_one_shot_far_off_is_an_outlier_but_several_a_little_off_are_noise() -> None:
    nis = np.array([1.0, 2.0, 300.0, 16.0, 20.0] + [1.5] * 30)
    none, single, several = (np.zeros(35, dtype=bool) for _ in range(3))
    single[2] = True
    several[[3, 4]] = True
    assert understated_noise(none, nis) == []
    assert understated_noise(single, nis) == []
    assert understated_noise(several, nis)[0].verdict is Verdict.WARNING
    # Among many gross outliers two that are only a little off are outliers, too.
    nis[5:13], several[5:13] = 500.0, True
    assert understated_noise(several, nis) == []
