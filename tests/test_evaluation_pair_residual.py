"""The published pair residual (Eq. 12): hand-computed numbers, a dense search, and why it is not a TRE."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fgreg.evaluation.pair_residual import line_to_arc
from fgreg.evaluation.resolve import pair_residuals
from fgreg.geometry.target_error import tre_mm
from fgreg.geometry.transforms import exp_so3, make_transform
from fgreg.graph.shared_state import make_state
from tests.forward import make_measurements


def test_a_beam_across_the_plane_passes_the_arc_by_a_hand_computed_distance() -> None:
    # Element at (5, 0, 10), arc of 30 mm in the plane x = 5; the beam runs along x through (0, 18, 36).
    # In the plane its distance from the element is hypot(18, 26) = 31.6228, so 1.6228 mm remain, at atan2(18, 26).
    found = line_to_arc(
        np.array([[0.0, 18.0, 36.0]]),
        np.array([[1.0, 0.0, 0.0]]),
        np.array([0.0]),
        np.array([5.0]),
        np.array([30.0]),
        10.0,
    )
    assert found.distance_mm[0] == pytest.approx(math.hypot(18, 26) - 30.0, abs=1e-9)
    assert found.theta_rad[0] == pytest.approx(math.atan2(18, 26), abs=1e-9)
    assert found.lambda_mm[0] == pytest.approx(5.0, abs=1e-6)


def test_a_beam_beside_the_arcs_plane_keeps_its_offset() -> None:
    # Along z through (8, 0, .): 3 mm beside the plane x = 5, and the arc crosses y = 0 straight below.
    found = line_to_arc(
        np.array([[8.0, 0.0, 90.0]]),
        np.array([[0.0, 0.0, -1.0]]),
        np.array([0.0]),
        np.array([5.0]),
        np.array([30.0]),
        10.0,
    )
    assert found.distance_mm[0] == pytest.approx(3.0, abs=1e-9)
    assert found.lambda_mm[0] == pytest.approx(50.0, abs=1e-6)


def test_agrees_with_a_dense_search() -> None:
    rng = np.random.default_rng(0)
    n = 60
    p = rng.uniform(-40, 40, (n, 3)) + np.array([0, 0, 80])
    d = rng.standard_normal((n, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    scan, x, r = rng.uniform(-0.6, 0.6, n), rng.uniform(-20, 20, n), rng.uniform(20, 45, n)
    found = line_to_arc(p, d, scan, x, r, 10.0)
    theta = scan[:, None] + np.linspace(-math.pi / 2, math.pi / 2, 20001)
    y = 10 * np.sin(scan)[:, None] + r[:, None] * np.sin(theta)
    z = 10 * np.cos(scan)[:, None] + r[:, None] * np.cos(theta)
    gap = np.stack([np.broadcast_to(x[:, None], y.shape), y, z], axis=-1) - p[:, None]
    distance = np.linalg.norm(np.cross(gap, d[:, None]), axis=-1).min(axis=1)
    np.testing.assert_allclose(found.distance_mm, distance, atol=1e-3)
    assert np.all(found.distance_mm <= distance + 1e-9)


def test_a_rolled_registration_reads_small_residuals_where_the_error_is_large() -> None:
    model, measurements, truth = make_measurements(np.random.default_rng(3), pairs=40, noise=False)
    state = make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser)
    assert pair_residuals(state, (0,), measurements.pairs, 10.0).max() < 1e-6
    roll = make_transform(exp_so3(np.array([math.radians(20.0), 0.0, 0.0])), np.zeros(3))
    rolled_T = roll @ truth.trus_T_camera[0]
    rolled = replace(state, rotation=rolled_T[None, None, :3, :3], translation_mm=rolled_T[None, None, :3, 3])
    residual = pair_residuals(rolled, (0,), measurements.pairs, 10.0)
    error = tre_mm(rolled_T, truth.trus_T_camera[0], model.targets_mm)
    assert error.mean() > 12.0
    assert residual.mean() < 0.1 * error.mean()
