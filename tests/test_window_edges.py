"""First detections of a found PM from both sides of its sensitivity window."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from fgreg.search.planner import Phase
from fgreg.search.window_edges import WindowEdges

DEG = math.radians(1.0)
FOUND, HALF_WIDTH, STEP = 3.0 * DEG, 6.0 * DEG, 2.0 * DEG


def edges(*, stands_deg: float = 0.0, low_deg: float = -40.0, high_deg: float = 40.0) -> WindowEdges:
    sigma, width_sigma = 0.4 * DEG, 0.5 * DEG
    low, high, stands = low_deg * DEG, high_deg * DEG, stands_deg * DEG
    return WindowEdges(FOUND, sigma, HALF_WIDTH, width_sigma, STEP, 0.5, low, high, stands)


def bell(true_rad: float, half_width_rad: float = HALF_WIDTH, peak: float = 1.0) -> Callable[[float], float]:
    """Amplitude by plane angle: half of the peak at the half width."""
    return lambda scan: peak * 0.5 ** (((scan - true_rad) / half_width_rad) ** 2)


def play(search: WindowEdges, amplitude: Callable[[float], float], threshold: float = 0.3) -> list[tuple[float, int]]:
    """All stops: plane angle, and sweep where it was a first detection."""
    stops = []
    while (turn := search.next()) is not None:
        assert turn.phase is Phase.EDGES
        assert search.next() == turn
        heard = amplitude(turn.scan_rad)
        stops.append((turn.scan_rad, search.add_look(heard if heard >= threshold else None)))
        assert len(stops) < 30
    return stops


@pytest.mark.parametrize("seed", range(20))
def test_each_first_detection_is_one_step_behind_a_silent_stop_and_within_a_step_of_the_edge(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true, width = FOUND + 0.4 * DEG * rng.standard_normal(), HALF_WIDTH + 0.5 * DEG * rng.standard_normal()
    stops = play(edges(), bell(true, width))
    hits = {sweep: (number, scan) for number, (scan, sweep) in enumerate(stops) if sweep}
    assert sorted(hits) == [-1, 1]
    for sweep, (number, scan) in hits.items():
        before = stops[number - 1][0]
        assert scan - before == pytest.approx(sweep * STEP)
        ahead = sweep * (true - scan)
        assert width - STEP <= ahead <= width
        assert sweep * (true - before) > width
    middle = 0.5 * (hits[1][1] + hits[-1][1])
    assert abs(middle - true) <= 0.5 * STEP
    assert len(stops) <= 10


def test_a_window_much_wider_than_declared_is_reached_from_farther_out() -> None:
    stops = play(edges(), bell(FOUND, HALF_WIDTH + 2.5 * DEG))
    assert sorted(sweep for _, sweep in stops if sweep) == [-1, 1]
    for scan, sweep in stops:
        if sweep:
            assert 6.5 * DEG <= sweep * (FOUND - scan) <= 8.5 * DEG


def test_a_first_detection_at_every_start_tells_no_sweep() -> None:
    assert [sweep for _, sweep in play(edges(), lambda _: 1.0)] == [0, 0, 0, 0]


def test_a_pm_that_is_not_detected_any_more_ends_both_sides_at_the_middle() -> None:
    stops = play(edges(), lambda _: 0.0)
    assert all(sweep == 0 for _, sweep in stops)
    assert len({scan for scan, _ in stops}) == len(stops) == 8
    assert all(abs(scan - FOUND) < HALF_WIDTH + 2.0 * STEP for scan, _ in stops)


def test_the_side_where_the_stage_stands_comes_first() -> None:
    for stands, first in ((-20.0, 1), (20.0, -1)):
        hits = [sweep for _, sweep in play(edges(stands_deg=stands), bell(FOUND)) if sweep]
        assert hits == [first, -first]


def test_a_side_that_the_stage_cannot_reach_is_left_out() -> None:
    stops = play(edges(high_deg=9.0), bell(FOUND))
    assert [sweep for _, sweep in stops if sweep] == [1]
    assert all(scan <= 9.0 * DEG for scan, _ in stops)
    none = edges(low_deg=-3.0, high_deg=9.0)
    assert none.next() is None
    with pytest.raises(ValueError, match="both sides are done"):
        none.add_look(None)
