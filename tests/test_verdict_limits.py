"""Conditions of the verdict on both sides of their limits: whether there is one, how severe it is, and its figures."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.special import chdtri

from fgreg.geometry.transforms import BoolArray, FloatArray
from fgreg.model.estimate import ExcludedShot, PredictedPart, PredictedTre, Verdict
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.move_doubt import MoveDoubt
from fgreg.registration.multistart import EpochSearch
from fgreg.registration.verdict import (
    SURE_OF_AIMS,
    SURE_OF_PAIRS,
    Causes,
    Condition,
    accuracy,
    ambiguity,
    beam_sides,
    by_hand,
    causes_of_error,
    consistency,
    estimated,
    hypotheses,
    left_out,
    possible_camera_move,
    refused_shots,
    repeated_markers,
    sampling,
    spread,
    sweeps,
    too_few_to_tell,
    two_sided,
    understated_noise,
    verdict_of,
    worst_first,
)

CONFIG = SolveConfig()
NOTHING, WARNING, REFUSED = None, Verdict.WARNING, Verdict.REFUSED


def assert_only(found: list[Condition], verdict: Verdict | None, *texts: str) -> None:
    """Nothing, or one condition of this verdict that says these texts."""
    assert [condition.verdict for condition in found] == ([] if verdict is None else [verdict]), found
    for text in texts:
        assert text in "".join(condition.text for condition in found)


def any_like(**fields: Any) -> Any:
    return SimpleNamespace(**fields)


def search(*costs: float, mirrored: float | None = None, **more: Any) -> EpochSearch:
    minima: Any = tuple(any_like(cost=cost) for cost in costs)
    return EpochSearch(minima, mirrored, **more)


@pytest.mark.parametrize(
    ("out", "total", "verdict", "says"),
    [
        (0, 4, NOTHING, ()),
        (5, 20, NOTHING, ()),
        (6, 20, WARNING, ("6 of 20 pairs do not fit", "(nis 41 to 46, at most 25 % accepted)", "take 6 pairs again")),
        (10, 20, WARNING, ("10 of 20 pairs",)),
        (11, 20, REFUSED, ("11 of 20 pairs",)),
        (2, 11, NOTHING, ()),
        (2, 10, WARNING, ("2 of 10 pairs do not fit", "8 inliers are few", "(9 needed): take more pairs")),
        (1, 4, WARNING, ("3 inliers are few",)),
    ],
)
def test_shares_of_outliers(out: int, total: int, verdict: Verdict | None, says: tuple[str, ...]) -> None:
    number = np.arange(total)
    kept, nis = number >= out, np.where(number < out, 41.0 + number, 1.0)
    assert_only(left_out(kept, nis, "pairs", SURE_OF_PAIRS), verdict, *says)
    assert (SURE_OF_PAIRS, SURE_OF_AIMS) == (9, 6)


def test_what_is_left_out_by_hand_is_counted_and_named() -> None:
    pm, other = ExcludedShot("pair", 5, 1.0, pm=3), ExcludedShot("pair", 6, 1.0, pm=4)
    aim, point = ExcludedShot("aim", 1, 0.0, aim=2), ExcludedShot("point", 7, 2.0, point=0)
    assert_only(by_hand([], 10), NOTHING)
    assert_only(by_hand([pm], 10), WARNING, "1 of 11 shots was left out by hand (PM 3)")
    assert_only(by_hand([aim, pm, other], 10), WARNING, "3 of 13 shots were left out by hand (PM 3 to 4; aim 2)")
    assert_only(by_hand([point], 0), WARNING, "1 of 1 shots was left out by hand (known point 0)")


def test_refused_shots_are_counted_with_the_first_reason() -> None:
    assert_only(refused_shots([]), NOTHING)
    assert_only(refused_shots(["a crash", "b"]), WARNING, "(2; the first: a crash)")
    assert_only(refused_shots(["y" * 500]), WARNING, f"the first: {'y' * 97}...)")


def mask(total: int, *places: int) -> BoolArray:
    return np.isin(np.arange(total), places)


def test_mild_misfits_are_noise() -> None:
    nis = np.full(35, 1.5)
    nis[[3, 4, 5]] = 16.0, 59.5, 60.0
    assert_only(understated_noise(mask(35, 3), nis), NOTHING)
    assert_only(understated_noise(mask(35, 3, 5), nis), NOTHING)
    assert_only(understated_noise(mask(35, 3, 4), nis), WARNING, "residuals of 2 of 35 shots", "(nis 16 to 60)")
    nis[10:30] = 200.0  # among so many gross outliers two mild ones are as expected
    assert_only(understated_noise(mask(35, 3, 4, *range(10, 30)), nis), NOTHING)


def test_a_shot_that_does_not_fit_among_too_few_is_named() -> None:
    nis = np.array([1.0, 30.0, 20.0, 99.0])
    names = [f"PM {pm}" for pm in range(4)]
    kept = np.array([True, True, True, False])
    assert_only(too_few_to_tell(mask(4, 3), kept, nis, names), NOTHING)
    assert_only(
        too_few_to_tell(mask(4, 2, 1, 3), kept, nis, names), WARNING, "PM 1 does not fit", "(nis 30.0), and 3 are too"
    )
    nis[2] = 30.1
    assert_only(too_few_to_tell(mask(4, 2, 1, 3), kept, nis, names), REFUSED, "PM 2 does not fit the others (nis 30.1)")


@pytest.mark.parametrize(
    ("pms", "somewhere", "wrong", "verdict", "says"),
    [
        (6, 0.59, 0.5, NOTHING, ()),
        (6, 0.61, 0.0, WARNING, ("up to PM 4 and those from PM 7 may not fit", "(odds 3 to 1): if")),
        (6, 2.01, 0.0, WARNING, ("PM 7 do not fit",)),
        (6, 1.99, 0.0, WARNING, ("PM 7 may not fit",)),
        (5, 0.61, 0.5, NOTHING, ()),
        (21, 0.61, 0.0, WARNING, ("may not fit",)),
        (22, 0.61, 0.0, NOTHING, ()),
        (22, 1.99, 0.0, NOTHING, ()),
        (22, 2.01, 0.0, WARNING, ("do not fit",)),
        (6, 0.61, 0.0199, WARNING, ()),
        (6, 0.61, 0.0201, REFUSED, ("which could be off by more than 6.0 mm: if",)),
        (22, 0.61, 0.0201, REFUSED, ("may not fit",)),
        (22, 0.59, 0.0201, NOTHING, ()),
    ],
)
def test_odds_of_a_camera_move_at_any_split_point(
    pms: int, somewhere: float, wrong: float, verdict: Verdict | None, says: tuple[str, ...]
) -> None:
    doubt = MoveDoubt(math.log(somewhere * (pms - 1)), 4, 7, pms, wrong)
    assert_only(possible_camera_move(doubt, 3.0), verdict, *says)


@pytest.mark.parametrize(
    ("log_odds", "wrong", "verdict", "says"),
    [
        (5.39, 0.5, NOTHING, ()),
        (5.41, 0.0, WARNING, ("PM 2 do not fit one registration (odds 224 to 1): if",)),
        (5.41, 0.5, REFUSED, ("more than 6.0 mm",)),
        (1000.0, 0.0, WARNING, ("(odds 485165195 to 1)",)),
    ],
)
def test_odds_of_a_camera_move_among_very_few(
    log_odds: float, wrong: float, verdict: Verdict | None, says: tuple[str, ...]
) -> None:
    assert_only(possible_camera_move(MoveDoubt(log_odds, 1, 2, 3, wrong), 3.0), verdict, *says)
    if log_odds > 100.0:
        assert_only(possible_camera_move(MoveDoubt(log_odds, 1, 2, 30, wrong), 3.0), verdict, *says)


@pytest.mark.parametrize(
    ("deg", "away_mm", "verdict", "says"),
    [
        (1.9, 9.0, REFUSED, "the beams are parallel (1.9 deg about their mean, 2 needed)"),
        (2.1, 9.0, WARNING, "the beams are nearly parallel (2.1 deg about their mean, 5 needed)"),
        (4.9, 9.0, WARNING, "the beams are nearly parallel (4.9 deg"),
        (5.1, 4.1, NOTHING, ""),
        (5.1, 3.9, WARNING, "the spots lie nearly on one line (3.9 mm about it, 4 needed)"),
        (5.1, 2.1, WARNING, "the spots lie nearly on one line (2.1 mm"),
        (5.1, 1.9, REFUSED, "the spots lie on one line (1.9 mm about it, 2 needed)"),
    ],
)
def test_parallel_beams_and_spots_on_a_line(deg: float, away_mm: float, verdict: Verdict | None, says: str) -> None:
    around = np.radians([0.0, 90.0, 180.0, 270.0])
    tilt = math.radians(deg)
    beams = np.stack([math.sin(tilt) * np.cos(around), math.sin(tilt) * np.sin(around), np.full(4, math.cos(tilt))], 1)
    spots = 30.0 + np.array([[x, y, 0.0] for x in (-10.0, 10.0) for y in (-away_mm, away_mm)])
    assert_only(spread(beams, spots, CONFIG), verdict, says)


def looks(*shots: tuple[int, int, int]) -> Any:
    """Looks by PM, sweep and marker."""
    return [any_like(pm=pm, look=any_like(sweep=sweep), marker=any_like(id=marker)) for pm, sweep, marker in shots]


def test_sweeps_from_both_sides() -> None:
    def of(up: int, down: int) -> Any:
        return looks(*((pm, 1, pm) for pm in range(up)), *((pm, -1, pm) for pm in range(down)), (99, 0, 99))

    assert_only(sweeps(of(0, 0), CONFIG), NOTHING)
    assert_only(sweeps(of(8, 3), CONFIG), NOTHING)
    assert_only(sweeps(of(8, 2), CONFIG), WARNING, "8 of 10 sweeps went one way", "both sides (at least 1)")
    assert_only(sweeps(of(0, 4), CONFIG), WARNING, "4 of 4 sweeps went one way", "both sides (at least 3)")
    assert two_sided(looks((0, 1, 0), (0, -1, 0), (1, 1, 1), (1, -1, 1), (2, 1, 2)))
    assert not two_sided(looks((0, 1, 0), (0, -1, 0), (1, 1, 1), (1, 0, 1)))
    assert not two_sided(looks((0, 1, 0), (1, -1, 1), (2, 0, 2)))


def test_one_marker_observation_at_several_pms() -> None:
    assert_only(repeated_markers(looks((0, 0, 5), (0, 0, 5), (1, 0, 6))), NOTHING)
    shared = looks((4, 0, 5), (0, 0, 5), (1, 0, 6), (2, 0, 6))
    assert_only(repeated_markers(shared), WARNING, "2 marker observations serve several PMs (PM 0, 4)")


def test_chi_square_against_the_stated_noise() -> None:
    suspicious, impossible = float(chdtri(10, 1e-3)), float(chdtri(10, 1e-9))
    assert_only(consistency(1e6, 0), NOTHING)
    assert_only(consistency(2.0 * float(chdtri(1, 1e-3)), 1), WARNING)
    assert_only(consistency(suspicious - 0.1, 10), NOTHING)
    assert_only(consistency(suspicious + 0.1, 10), WARNING, "(chi square 30 for 10 degrees of freedom)")
    assert_only(consistency(impossible - 0.1, 10), WARNING)
    assert_only(consistency(impossible + 0.1, 10), REFUSED)


def test_a_variable_of_the_session_outside_its_prior() -> None:
    inside = estimated("radius", 10.59, 0.1, 10.0, 0.2, " mm")
    assert inside == Condition(Verdict.OK, "estimated radius 10.59 +- 0.1 mm (given 10 +- 0.2 mm; 1 sigma)")
    for value in (10.61, 9.39):
        assert estimated("radius", value, 0.1, 10.0, 0.2, " mm").verdict is WARNING


def test_samples_of_the_posterior() -> None:
    assert_only(sampling(60.0), NOTHING)
    assert_only(sampling(59.4), WARNING, "(worth 59 independent samples, 60 needed)")


def tre(worst_mm: float, systematic_mm: float | None = None) -> PredictedTre:
    part = None if systematic_mm is None else PredictedPart(0.1, 0.2, systematic_mm)
    return PredictedTre(1.0, 2.0, worst_mm, systematic=part)


def test_predicted_error_against_the_limit() -> None:
    assert_only(accuracy(tre(3.0), CONFIG), NOTHING)
    assert_only(accuracy(tre(3.01), CONFIG), WARNING, "is 3.0 mm (95 % bound), the limit 3.0 mm: take more pairs")
    assert_only(accuracy(tre(6.0), CONFIG), WARNING)
    assert_only(accuracy(tre(6.01), CONFIG), REFUSED)
    assert accuracy(tre(6.01), CONFIG)[0].is_error


@pytest.mark.parametrize(
    ("given", "advice"),
    [
        ({"named_mm": 2.0}, "take more pairs"),
        ({"named_mm": 2.01}, "2.0 mm of it by what is named above"),
        ({"largest": "", "systematic_mm": 3.9}, "take more pairs"),
        ({"largest": "radius", "systematic_mm": 2.8}, "take more pairs"),
        (
            {"largest": "radius", "systematic_mm": 2.85},
            "systematic (radius): measure these, and take looks from both sides",
        ),
        ({"largest": "radius", "systematic_mm": 2.85, "both_sides": True}, "systematic (radius): measure these"),
        ({"causes": Causes(0.5, 0.0)}, "take more pairs"),
        ({"causes": Causes(0.51, 0.51)}, "51 % of its variance is the beam's"),
        ({"causes": Causes(0.51, 0.52)}, "52 % of its variance is the window edge's: take looks from both sides"),
        ({"causes": Causes(0.0, 0.5)}, "take more pairs"),
        ({"causes": Causes(0.0, 0.51), "both_sides": True}, "the window edge's: measure the window's half width"),
    ],
)
def test_advice_that_lowers_the_error_most(given: dict[str, Any], advice: str) -> None:
    (found,) = accuracy(tre(4.0, given.pop("systematic_mm", None)), CONFIG, **given)
    assert advice in found.text
    assert ("both sides" in found.text) == ("both sides" in advice or advice == "take more pairs")


def test_shares_of_the_beam_and_the_edge_in_the_error_at_the_worst_target() -> None:
    """By hand, camera axes, at 100 mm: 1 mm^2 along x by the beam; along y 2 by the edge, 1 of its own and 1 of a turn
    about x, which moves the target the other way, -0.4."""
    covariance = np.zeros((17, 17))
    beam, edge = slice(12, 16), 16
    covariance[beam, beam], covariance[edge, edge] = np.eye(4), 4.0
    covariance[6, 6] = 1e-4
    covariance[9, 9] = covariance[9, 15] = covariance[15, 9] = 1.0
    covariance[10, 10], covariance[10, 16], covariance[16, 10] = 3.0, math.sqrt(8.0), math.sqrt(8.0)
    covariance[6, 10] = covariance[10, 6] = 0.002
    columns = any_like(beam=12, at=lambda _: edge)
    trus_T_camera = np.eye(4)
    trus_T_camera[2, 3] = 5.0
    state = any_like(trus_T_camera=lambda place: np.stack([trus_T_camera]) if place == 1 else None)
    registration = any_like(problem=any_like(columns=columns), covariance=covariance, optimum=any_like(state=state))
    targets: FloatArray = np.array([[0.0, 0.0, 15.0], [0.0, 0.0, 105.0], [0.0, 0.0, 25.0]])
    causes = causes_of_error(registration, 1, targets)
    assert causes.beam == pytest.approx(1.0 / 4.6)
    assert causes.edge == pytest.approx(2.0 / 4.6)


def test_spots_behind_the_beams_origin() -> None:
    assert_only(beam_sides(np.array([0.0, 1.0])), NOTHING)
    assert_only(beam_sides(np.array([-0.1, 0.0, 30.0])), WARNING, "1 of 3 spots lie behind")


def test_second_minima_and_too_few_pairs() -> None:
    def of(found: EpochSearch, pairs: int, is_open: bool = False, has_initial: bool = False) -> list[Condition]:
        return ambiguity(found, pairs, is_open=is_open, has_initial=has_initial, config=CONFIG)

    assert_only(of(search(10.0, 14.0), 6), NOTHING)
    assert_only(of(search(10.0), 6, is_open=True), NOTHING)
    assert_only(of(search(), 6, is_open=True), REFUSED, "starts from an ambiguous registration")
    assert_only(
        of(search(10.0, 14.0), 6, is_open=True),
        REFUSED,
        "the 6 pairs (chi square 10.0 and 14.0, 4.0 apart, 9.2 needed)",
    )
    assert_only(of(search(10.0), 4), REFUSED, "4 pairs leave the registration open (6 needed", "take 2 more")
    assert_only(of(search(10.0), 4, has_initial=True), NOTHING)


AWAY = "the beams run away from the probe"
MIRRORED = "the mirrored hypothesis fits better"


@pytest.mark.parametrize(
    ("found", "verdict", "says"),
    [
        (search(100.0, mirrored=None, outside=False), NOTHING, ""),
        (search(mirrored=1.0), NOTHING, ""),
        (search(100.0, mirrored=90.8), NOTHING, ""),
        (search(100.0, 200.0, mirrored=100.0), NOTHING, ""),
        (search(100.0, mirrored=90.7), REFUSED, MIRRORED + " (chi square 90.7 against 100.0)"),
        (search(100.0, mirrored=81.7, clean=False), NOTHING, ""),
        (search(100.0, mirrored=81.5, clean=False), REFUSED, MIRRORED),
        (search(100.0, mirrored=97.0, mirrored_outside_cost=98.0), NOTHING, ""),
        (search(100.0, mirrored=97.0, mirrored_outside_cost=97.9), REFUSED, MIRRORED + " (chi square 97.9 against"),
        (search(100.0, mirrored=95.0, mirrored_outside_cost=96.0, clean=False), NOTHING, ""),
        (search(100.0, mirrored=95.0, mirrored_outside_cost=95.9, clean=False), REFUSED, MIRRORED),
        (search(100.0, mirrored=95.0, outside=False), WARNING, AWAY),
        (search(100.0, mirrored=95.0, mirrored_outside_cost=109.3, outside=False), WARNING, AWAY),
        (search(100.0, mirrored=95.0, mirrored_outside_cost=109.1, outside=False), REFUSED, "fits as well"),
    ],
)
def test_the_mirrored_hypothesis(found: EpochSearch, verdict: Verdict | None, says: str) -> None:
    assert_only(ambiguity(found, 9, is_open=False, has_initial=False, config=CONFIG), verdict, says)


def test_reversed_sweeps_and_another_beam() -> None:
    beam = 100.0 - float(chdtri(4, 1e-9))
    assert_only(hypotheses(search(other_way_cost=1.0), CONFIG), NOTHING)
    assert_only(hypotheses(search(100.0, 200.0, other_way_cost=81.7, own_beam_cost=beam + 0.1), CONFIG), NOTHING)
    assert_only(
        hypotheses(search(100.0, other_way_cost=81.5), CONFIG),
        REFUSED,
        "signs reversed (chi square 81.5 against 100.0)",
    )
    assert_only(hypotheses(search(100.0, own_beam_cost=beam - 0.1), CONFIG), REFUSED, "another beam than the aims")


def test_reasons_stand_in_the_order_to_look_at_them() -> None:
    ok, warning, error = Condition(Verdict.OK, "d"), Condition(WARNING, "c"), Condition(REFUSED, "b", is_error=True)
    cause, refusal = Condition(WARNING, "a", effect_mm=1.0), Condition(REFUSED, "0")
    mixed = [(condition, condition.text) for condition in (ok, warning, error, cause, refusal)]
    assert worst_first(mixed) == ("0", "a", "b", "c", "d")
    assert verdict_of([ok, warning]) is WARNING
    assert verdict_of([]) is Verdict.OK
