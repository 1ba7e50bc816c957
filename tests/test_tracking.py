"""Results of tracking queries: right within their sigma, refused where there is no registration."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from fgreg.geometry.transforms import (
    FloatArray,
    as_float_array,
    exp_so3,
    inverse,
    make_transform,
    rotation_to_direction,
    transform_points,
)
from fgreg.model.estimate import TrackEstimate
from fgreg.model.measurements import Look, MarkerObservation, Track, default_marker_covariance
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.tissue_surface import fit_surface
from fgreg.registration.solve import Solution, solve
from fgreg.tracking.query import track
from tests.forward import Truth, hear, make_measurements


@dataclass
class SurfaceCase:
    model: SessionModel
    truth: Truth
    solution: Solution
    queries: list[Track]
    bearings: list[float]


def _surface_point(x: float, bearing: float) -> FloatArray:
    """A gently curved tissue surface in TRUS: 42 mm from the axis in the middle, more to the sides."""
    reach = 42.0 + 0.004 * x * x + 6.0 * bearing * bearing
    return np.array([x, reach * math.sin(bearing), reach * math.cos(bearing)])


def surface_case(seed: int, *, heard: bool, count: int = 4, noise: bool = True) -> SurfaceCase:
    """A session whose PMs lie on one surface, and queries at other places on it."""
    rng = np.random.default_rng(seed)
    model, measurements, truth = make_measurements(rng, pairs=25, noise=noise)
    camera_T_trus = inverse(truth.trus_T_camera[0])

    def beam_to(trus_p: FloatArray) -> MarkerObservation:
        camera_p = transform_points(camera_T_trus, trus_p)
        tilt = rng.uniform(-0.3, 0.3, 2)
        direction = np.array([tilt[0], tilt[1], 1.0])
        camera_R_laser = rotation_to_direction(direction / np.linalg.norm(direction))
        camera_T_laser = make_transform(camera_R_laser, camera_p - rng.uniform(30, 50) * camera_R_laser[:, 2])
        observed = camera_T_laser @ inverse(truth.marker_T_laser)
        if noise:
            observed[:3, :3] = exp_so3(rng.normal(size=3) * model.noise.marker_rotation_rad) @ observed[:3, :3]
            observed[:3, 3] += rng.normal(size=3) * model.noise.marker_translation_mm
        covariance = default_marker_covariance(observed, model.noise)
        return MarkerObservation(
            as_float_array(observed, 4, 4), as_float_array(covariance, 6, 6), int(rng.integers(1 << 40))
        )

    def look_at(trus_p: FloatArray, offset: float) -> Look:
        scan = math.atan2(trus_p[1], trus_p[2]) - offset
        distance, _, _ = hear(trus_p, scan, model.probe.radius_mm)
        scatter = rng.normal(size=2) * (0.3, 0.2) if noise else np.zeros(2)
        covariance = as_float_array(np.diag([0.09, 0.04]), 2, 2)
        return Look(scan, model.noise.scan_rad, trus_p[0] + scatter[0], distance + scatter[1], covariance)

    pairs = []
    for pair in measurements.pairs:
        trus_p = _surface_point(rng.uniform(-20, 20), rng.uniform(-0.5, 0.5))
        w = float(model.probe.sensitivity.half_width_at(30.0))
        sweep = 1 if pair.pm % 2 else -1
        offset = sweep * (w - rng.uniform(0, 1) * model.stage.step_rad)
        pairs.append(replace(pair, marker=beam_to(trus_p), look=replace(look_at(trus_p, offset), sweep=sweep)))
    queries, bearings = [], []
    for i in range(count):
        trus_p = _surface_point(rng.uniform(-14, 14), rng.uniform(-0.35, 0.35))
        looks = (look_at(trus_p, rng.uniform(-0.1, 0.1)),) if heard else ()
        queries.append(Track(200.0 + i, 0, beam_to(trus_p), looks, 0.0))
        bearings.append(math.atan2(trus_p[1], trus_p[2]))
    solution = solve(replace(measurements, pairs=tuple(pairs)), queries, model, SolveConfig())
    return SurfaceCase(model, truth, solution, queries, bearings)


def _scores(case: SurfaceCase) -> list[float]:
    out = []
    for answer, bearing in zip(case.solution.tracks, case.bearings, strict=True):
        if answer.stage_rad is not None:
            assert answer.sigma_rad is not None
            out.append((answer.stage_rad - bearing) / answer.sigma_rad)
    return out


@pytest.mark.parametrize("heard", [True, False])
def test_answers_lie_within_their_sigmas(heard: bool) -> None:
    scores = np.concatenate([_scores(surface_case(seed, heard=heard, count=6)) for seed in range(6)])
    assert len(scores) > 24
    assert 0.4 < np.sqrt(np.mean(scores**2)) < 1.5
    assert np.abs(scores).max() < 4.5


def test_without_a_pm_the_sigma_is_larger() -> None:
    heard, silent = surface_case(1, heard=True), surface_case(1, heard=False)

    def mean_sigma(case: SurfaceCase) -> float:
        return float(np.mean([t.sigma_rad for t in case.solution.tracks if t.sigma_rad is not None]))

    assert mean_sigma(silent) > mean_sigma(heard)


def test_a_query_does_not_touch_the_estimate() -> None:
    with_queries, without = surface_case(2, heard=True), surface_case(2, heard=True, count=0)
    first, second = with_queries.solution.epochs[0], without.solution.epochs[0]
    assert first.trus_T_camera is not None
    assert second.trus_T_camera is not None
    np.testing.assert_array_equal(first.trus_T_camera, second.trus_T_camera)


def test_answers_are_device_angles() -> None:
    case = surface_case(3, heard=True)
    snapshot = case.solution.snapshot
    assert snapshot is not None
    turned = replace(snapshot, stage=replace(case.model.stage, direction=-1, zero_device_rad=0.1))
    plain, device = track(case.queries[0], snapshot), track(case.queries[0], turned)
    assert plain.stage_rad is not None
    assert device.stage_rad == pytest.approx(0.1 - plain.stage_rad)


def test_an_angle_beyond_the_stages_limits_is_not_given() -> None:
    case = surface_case(3, heard=True)
    snapshot = case.solution.snapshot
    assert snapshot is not None
    narrow = replace(snapshot, stage=replace(case.model.stage, limits_device_rad=(1.0, 1.1)))
    answer = track(case.queries[0], narrow)
    assert answer.stage_rad is None
    assert "outside its limits 57 to 63 deg" in answer.reason


def test_a_refused_registration_answers_nothing() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(0), pairs=4)
    query = Track(9.0, 0, measurements.pairs[0].marker, (measurements.pairs[0].look,))
    answer: TrackEstimate = solve(measurements, [query], model, SolveConfig()).tracks[0]
    assert answer.stage_rad is None
    assert "refused" in answer.reason


def test_a_beam_that_misses_the_surface_is_not_answered() -> None:
    case = surface_case(4, heard=False, count=1)
    query = case.queries[0]
    away = query.marker.camera_T_marker.copy()
    away[:3, 3] += [80.0, 0.0, 0.0]
    snapshot = case.solution.snapshot
    assert snapshot is not None
    answer = track(replace(query, marker=replace(query.marker, camera_T_marker=away)), snapshot)
    assert answer.stage_rad is None
    assert "misses the part of the surface" in answer.reason


def test_a_plane_is_met_where_it_is() -> None:
    rng = np.random.default_rng(0)
    place = rng.uniform(-20, 20, (12, 2))
    points = np.column_stack([place, 40.0 + 0.2 * place[:, 0]])
    covariance = np.tile(1e-4 * np.eye(3), (12, 1, 1))
    surface = fit_surface(points, covariance, np.tile([0.0, 0.0, 1.0], (12, 1)))
    assert surface is not None
    ray = np.array([0.1, 0.0, 1.0]) / math.hypot(0.1, 1.0)
    met = surface.meet(np.array([1.0, 2.0, 0.0]), ray)
    assert met is not None
    # z = 40 + 0.2 x with x = 1 + 0.1 z: z = 40.2 / 0.98
    assert met.trus_p[2] == pytest.approx(40.2 / 0.98, abs=0.02)
    assert met.sigma_mm < 1.0


def test_four_points_or_a_row_of_them_are_no_surface() -> None:
    points = np.column_stack([np.linspace(-20, 20, 9), np.zeros(9), np.full(9, 40.0)])
    covariance, beams = np.tile(0.1 * np.eye(3), (9, 1, 1)), np.tile([0.0, 0.0, 1.0], (9, 1))
    assert fit_surface(points, covariance, beams) is None
    assert fit_surface(points[:4], covariance[:4], beams[:4]) is None
