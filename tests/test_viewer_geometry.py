"""The geometry a recording shows, against numbers worked out another way."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest

from fgreg.geometry.target_error import target_bounds_mm
from fgreg.geometry.transforms import as_float_array, exp_so3, make_transform
from fgreg.model.camera_model import CameraModel
from fgreg.model.measurements import Look, Measurements
from fgreg.viewer import scene as scene
from fgreg.viewer.result import measured_pairs
from tests.answers import answer_from_truth, random_covariance
from tests.forward import make_measurements, make_session

PROBE = make_session().probe


def look_at(scan_deg: float, range_mm: float) -> Look:
    return Look(math.radians(scan_deg), 0.002, 4.0, range_mm, as_float_array(np.eye(2)))


def test_the_plane_at_stage_angle_t_points_along_sin_t_cos_t() -> None:
    turned = scene.trus_T_plane(math.radians(30.0))
    np.testing.assert_allclose(turned @ [0.0, 0.0, 1.0, 1.0], [0.0, 0.5, math.sqrt(0.75), 1.0], atol=1e-12)
    np.testing.assert_allclose(turned @ [1.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 1.0], atol=1e-12)


@pytest.mark.parametrize("scan_deg", [-40.0, 0.0, 25.0])
@pytest.mark.parametrize("range_mm", [5.0, 30.0, 60.0])
def test_an_arc_keeps_its_range_from_the_element_and_ends_where_the_stage_turns_one_and_a_half_windows(
    scan_deg: float, range_mm: float
) -> None:
    look = look_at(scan_deg, range_mm)
    strip = scene.arc_strip_mm(look, PROBE)
    t = math.radians(scan_deg)
    element = np.array([4.0, 10.0 * math.sin(t), 10.0 * math.cos(t)])
    np.testing.assert_allclose(np.linalg.norm(strip - element, axis=1), range_mm, rtol=1e-12)
    np.testing.assert_allclose(strip[:, 0], 4.0)
    ends = np.degrees(np.arctan2(strip[[0, -1], 1], strip[[0, -1], 2])) - scan_deg
    np.testing.assert_allclose(ends, [-9.0, 9.0], atol=1e-9)


def test_ellipsoids_have_the_sigmas_times_the_chi_square_quantile_as_half_sizes() -> None:
    ellipsoid = scene.ellipsoid_95(np.diag([1.0, 4.0, 9.0]))
    np.testing.assert_allclose(sorted(ellipsoid.half_sizes_mm), np.sqrt(7.814728) * np.array([1.0, 2.0, 3.0]))


def test_ellipsoids_hold_95_percent_of_the_draws() -> None:
    rng = np.random.default_rng(1)
    covariance = random_covariance(rng, 3, 2.0)
    ellipsoid = scene.ellipsoid_95(covariance)
    assert np.linalg.det(ellipsoid.rotation) == pytest.approx(1.0)
    draws = rng.multivariate_normal(np.zeros(3), covariance, 20000)
    inside = np.sum((draws @ ellipsoid.rotation / ellipsoid.half_sizes_mm) ** 2, axis=1) <= 1.0
    assert inside.mean() == pytest.approx(0.95, abs=0.006)
    outline = scene.ellipse_95(np.zeros(2), covariance[:2, :2])
    distance = np.einsum("ni,ij,nj->n", outline, np.linalg.inv(covariance[:2, :2]), outline)
    np.testing.assert_allclose(distance, -2.0 * math.log(0.05), rtol=1e-6)


def test_quaternions_turn_vectors_as_their_rotations_do() -> None:
    rng = np.random.default_rng(2)
    for _ in range(5):
        rotation = exp_so3(rng.normal(size=3) * 1.5)
        x, y, z, w = scene.quaternion_xyzw(rotation)
        np.testing.assert_allclose(gtsam.Rot3.Quaternion(w, x, y, z).matrix(), rotation, atol=1e-12)


def test_target_bounds_are_those_of_targets_moved_by_registrations_drawn_from_the_covariance() -> None:
    rng = np.random.default_rng(3)
    pose = gtsam.Pose3(make_transform(exp_so3(rng.normal(size=3)), rng.normal(size=3) * 80.0))
    covariance = random_covariance(rng, 6, 1.0) * np.outer(*2 * [np.array([1e-3] * 3 + [0.2] * 3)])
    targets = np.array([[0.0, 0.0, 40.0], [20.0, -15.0, 30.0]])
    camera_p = [pose.transformTo(target) for target in targets]
    draws = rng.multivariate_normal(np.zeros(6), covariance, 8000)
    moved = np.array([[pose.retract(xi).transformFrom(p) for p in camera_p] for xi in draws])
    drawn = np.quantile(np.linalg.norm(moved - targets, axis=2), 0.95, axis=0)
    worst = float(drawn.max())
    np.testing.assert_allclose(target_bounds_mm(covariance, pose.matrix(), targets, worst), drawn, rtol=0.03)
    # What a verdict adds counts at every target.
    np.testing.assert_allclose(
        target_bounds_mm(covariance, pose.matrix(), targets, worst + 2.0), drawn + 2.0, rtol=0.03
    )


def test_the_frustum_is_the_outline_of_the_image() -> None:
    matrix = as_float_array([[800.0, 0.0, 600.0], [0.0, 400.0, 180.0], [0.0, 0.0, 1.0]])
    strips = scene.frustum_strips_mm(CameraModel((1280, 360), matrix, as_float_array(np.zeros(5))), 20.0)
    projected = strips[0] @ matrix.T
    np.testing.assert_allclose(
        projected[:, :2] / projected[:, 2:], [[0, 0], [1280, 0], [1280, 360], [0, 360], [0, 0]], atol=1e-9
    )
    assert all((strip[0] == 0.0).all() for strip in strips[1:])


def test_the_eye_has_everything_in_view_from_above() -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        points = rng.normal(size=(30, 3)) * rng.uniform(5.0, 80.0, 3) + rng.normal(size=3) * 50.0
        eye = scene.best_eye(points, (500, 400), margin=0.4 / scene.VIEW_TANGENT)
        forward = eye.target_mm - eye.position_mm
        forward /= np.linalg.norm(forward)
        assert -0.8 < forward[2] < -0.3
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        up = np.cross(right, forward)
        depth = (points - eye.position_mm) @ forward
        assert (depth > 0.0).all()
        across, height = (points - eye.position_mm) @ right / depth, (points - eye.position_mm) @ up / depth
        assert np.abs(across).max() <= 0.5 + 1e-9
        assert np.abs(height).max() <= 0.4 + 1e-9
        # No farther away than needed: something touches the edge.
        assert max(np.abs(across).max() / 0.5, np.abs(height).max() / 0.4) == pytest.approx(1.0)


def test_shots_are_numbered_in_time_order_over_all_kinds() -> None:
    rng = np.random.default_rng(5)
    session, measurements, truth = make_measurements(rng, aims=2, pairs=3)
    estimate = answer_from_truth(rng, session, measurements, truth)
    shots = scene.shots_of(estimate)
    assert [(shot.number, shot.kind, shot.position) for shot in shots] == [
        (0, "aim", 0),
        (1, "aim", 1),
        (2, "pair", 0),
        (3, "pair", 1),
        (4, "pair", 2),
    ]


def test_looks_that_were_not_measured_have_no_measured_pair() -> None:
    rng = np.random.default_rng(6)
    session, measurements, truth = make_measurements(rng, aims=0, pairs=4)
    estimate = answer_from_truth(rng, session, measurements, truth, unused=(1, 2))
    # The second look was measured and left out, the third was never detected.
    heard = Measurements((), tuple(measurements.pairs[i] for i in (0, 1, 3)), measurements.epochs)
    assert measured_pairs(estimate.pairs, heard) == (*measurements.pairs[:2], None, measurements.pairs[3])


def test_of_two_looks_at_one_moment_the_one_in_use_has_the_measurement() -> None:
    rng = np.random.default_rng(7)
    session, measurements, truth = make_measurements(rng, aims=0, pairs=1)
    estimate = answer_from_truth(rng, session, measurements, truth)
    unheard = answer_from_truth(rng, session, measurements, truth, unused=(0,)).pairs[0]
    assert measured_pairs((unheard, estimate.pairs[0]), measurements) == (None, measurements.pairs[0])
