"""Point on line: the beam, seen through marker and camera, goes through the PM or the aimed-at spot."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest

from fgreg.factors.adapter import FactorError
from fgreg.factors.point_on_line import (
    aim_point_on_line_factor,
    aim_residual,
    point_on_line_factor,
    residual,
)
from fgreg.geometry.transforms import FloatArray
from tests.forward import make_measurements
from tests.numerical import jacobian_mismatch, random_pose

TRUS_T_CAMERA, CAMERA_T_MARKER, LASER, LAMBDA, POINT = range(5)


def random_state(rng: np.random.Generator) -> tuple[gtsam.Values, FloatArray]:
    values = gtsam.Values()
    values.insert(TRUS_T_CAMERA, random_pose(rng))
    values.insert(CAMERA_T_MARKER, random_pose(rng))
    values.insert(LASER, np.array([*rng.uniform(-20, 20, 2), *rng.uniform(-1.5, 1.5, 2)]))
    values.insert(LAMBDA, float(rng.uniform(-20, 150)))
    values.insertPoint3(POINT, rng.uniform(-60, 60, 3))
    return values, random_pose(rng, 20.0).matrix()


def test_jacobians_of_the_pair() -> None:
    rng = np.random.default_rng(11)
    for _ in range(100):
        values, nominal = random_state(rng)
        factor = point_on_line_factor(TRUS_T_CAMERA, CAMERA_T_MARKER, LASER, LAMBDA, POINT, nominal)
        mismatch = jacobian_mismatch(factor, values)
        assert set(mismatch) == {0, 1, 2, 3, 4}
        assert max(mismatch.values()) < 1e-8, mismatch


def test_jacobians_of_the_aim() -> None:
    rng = np.random.default_rng(12)
    for _ in range(100):
        values, nominal = random_state(rng)
        factor = aim_point_on_line_factor(CAMERA_T_MARKER, LASER, LAMBDA, POINT, nominal)
        mismatch = jacobian_mismatch(factor, values)
        assert set(mismatch) == {1, 2, 3, 4}
        assert max(mismatch.values()) < 1e-8, mismatch


def test_zero_at_truth() -> None:
    _, measurements, truth = make_measurements(np.random.default_rng(13), aims=5, pairs=5, noise=False)
    # The true beam itself as the nominal frame: x = y = a = b = 0, and lambda counts from its own origin.
    beam = [0.0, 0.0, 0.0, 0.0]
    nominal = truth.marker_T_laser.tolist()
    for index, pair in enumerate(measurements.pairs):
        error, _ = residual(
            truth.trus_T_camera[0].tolist(),
            truth.pair_camera_T_marker[index].tolist(),
            beam,
            truth.pair_lambda_mm[index],
            truth.trus_p_pm_mm[pair.pm].tolist(),
            nominal,
        )
        assert np.abs(error).max() < 1e-11
    for index in range(5):
        error, _ = aim_residual(
            truth.aim_camera_T_marker[index].tolist(),
            beam,
            truth.aim_lambda_mm[index],
            truth.camera_p_spot_mm[index].tolist(),
            nominal,
        )
        assert np.abs(error).max() < 1e-11


IDENTITY = np.eye(4).tolist()


def test_by_hand() -> None:
    # Marker 10 mm along the camera's x, quarter turn about z: marker (x, y, z) -> camera (10 - y, x, z).
    camera_T_marker = [[0.0, -1.0, 0.0, 10.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    # Camera looks along TRUS -z from 100 mm above: camera (x, y, z) -> trus (x, -y, 100 - z).
    trus_T_camera = [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 100.0], [0.0, 0.0, 0.0, 1.0]]
    # Nominal frame 5 mm up the marker's z. Slopes (3/4, 0): direction (0.6, 0, 0.8); from (1, 2) on, 50 mm along it:
    # marker (31, 2, 45) -> camera (8, 31, 45) -> trus (8, -31, 55).
    nominal = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 5.0], [0.0, 0.0, 0.0, 1.0]]
    error, jacobians = residual(
        trus_T_camera, camera_T_marker, (1.0, 2.0, 0.75, 0.0), 50.0, (7.0, -30.0, 50.0), nominal
    )
    np.testing.assert_allclose(error, [1.0, -1.0, 5.0], atol=1e-13)
    # One more millimetre along the beam: (0.6, 0, 0.8) -> (0, 0.6, 0.8) -> (0, -0.6, -0.8).
    np.testing.assert_allclose(jacobians[3], [[0.0], [-0.6], [-0.8]], atol=1e-15)
    error, _ = aim_residual(camera_T_marker, (1.0, 2.0, 0.75, 0.0), 50.0, (7.0, 30.0, 50.0), nominal)
    np.testing.assert_allclose(error, [1.0, 1.0, -5.0], atol=1e-13)


def test_lambda_is_a_distance_along_the_beam_whatever_its_slope() -> None:
    def tip(lambda_mm: float) -> FloatArray:
        error, _ = aim_residual(IDENTITY, (3.0, -4.0, 1.2, -0.7), lambda_mm, (0.0, 0.0, 0.0), IDENTITY)
        return np.asarray(error)

    assert np.linalg.norm(tip(37.0) - tip(0.0)) == pytest.approx(37.0, rel=1e-14)
    np.testing.assert_allclose(tip(0.0), [3.0, -4.0, 0.0])


def test_state_that_is_not_finite_is_refused() -> None:
    values, nominal = random_state(np.random.default_rng(14))
    values.update(LAMBDA, math.nan)
    factor = point_on_line_factor(TRUS_T_CAMERA, CAMERA_T_MARKER, LASER, LAMBDA, POINT, nominal)
    with pytest.raises(FactorError, match="point on line"):
        factor.linearize(values)


def test_nominal_frame_of_the_wrong_shape_is_refused() -> None:
    with pytest.raises(ValueError, match="shape"):
        aim_point_on_line_factor(CAMERA_T_MARKER, LASER, LAMBDA, POINT, np.eye(3))
