"""Queries without a detection: rays end where a fine grid says, results spread as samples do."""

from __future__ import annotations

import numpy as np
import pytest

from fgreg.geometry.transforms import FloatArray
from fgreg.model.solve_config import SolveConfig
from fgreg.model.tissue_surface import TissueSurface, fit_surface
from fgreg.tracking.query import track
from tests import tracking_reference
from tests.test_tracking import surface_case
from tests.track_cases import solved_of


def some_surface(seed: int, count: int) -> TissueSurface:
    rng = np.random.default_rng(seed)
    place = rng.uniform(-20.0, 20.0, (count, 2))
    height = 42.0 + 0.1 * place[:, 0] + 4.0 * np.sin(place[:, 1] / 14.0) + 0.01 * place[:, 0] ** 2
    points = np.column_stack([place, height]) + 0.3 * rng.standard_normal((count, 3))
    surface = fit_surface(points, np.tile(0.09 * np.eye(3), (count, 1, 1)), np.tile([0.0, 0.0, 1.0], (count, 1)))
    assert surface is not None
    return surface


def _rays(seed: int, count: int) -> list[tuple[FloatArray, FloatArray]]:
    rng = np.random.default_rng(seed)
    rays = []
    for _ in range(count):
        end = np.array([*rng.uniform(-35.0, 35.0, 2), 42.0])
        direction = np.array([*rng.normal(size=2) * 0.5, 1.0])
        direction = direction / np.linalg.norm(direction)
        rays.append((end - rng.uniform(20.0, 90.0) * direction, direction))
    return rays


@pytest.mark.parametrize("count", [6, 25, 150])
def test_rays_end_where_the_surface_is(count: int) -> None:
    surface = some_surface(count, count)
    met = missed = torn = 0
    for trus_p, trus_d in _rays(count, 60):
        expected, found = tracking_reference.meet(surface, trus_p, trus_d), surface.meet(trus_p, trus_d)
        if expected is None or found is None:
            missed += expected is None and found is None
            torn += (expected is None) != (found is None)
            continue
        met += 1
        assert found.distance_mm == pytest.approx(expected.distance_mm, abs=0.01 + 0.01 * expected.sigma_mm)
        np.testing.assert_allclose(found.normal, expected.normal, atol=2e-3)
        assert found.sigma_mm == pytest.approx(expected.sigma_mm, rel=0.02, abs=0.03)
    assert met > 15
    assert missed > 2
    assert torn <= 2  # rays at the very limit of what counts as known


@pytest.mark.parametrize("seed", range(3))
def test_answers_and_sigmas_are_those_of_sampling(seed: int) -> None:
    case = surface_case(seed, heard=False, count=8)
    session = solved_of(case.solution, case.model, SolveConfig())
    compared = 0
    for query in case.queries:
        expected, found = tracking_reference.track(query, session), track(query, session.snapshot)
        if expected.stage_rad is None or expected.sigma_rad is None:
            assert found.reason == expected.reason
            continue
        assert found.stage_rad is not None
        assert abs(found.stage_rad - expected.stage_rad) < 0.02 * expected.sigma_rad
        assert found.sigma_rad == pytest.approx(expected.sigma_rad, rel=0.02)
        compared += 1
    assert compared >= 6
