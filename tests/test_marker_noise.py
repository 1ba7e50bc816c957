"""Pooling of the corner noise over a session."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from fgreg.detection.corner_noise import CornerNoise, detection_scale, fit_covariance, pool_corner_noise
from fgreg.geometry.transforms import FloatArray


@dataclass
class Fit:
    cost: float
    dof: int = 10
    information: FloatArray = field(default_factory=lambda: np.diag([4.0] * 6))
    common_covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))


def test_prior_alone() -> None:
    noise = pool_corner_noise([], prior_scale=1.5, prior_dof=20.0)
    assert (noise.scale, noise.dof, noise.detections) == (1.5, 20.0, 0)


def test_hand_computed_pool() -> None:
    # (20 * 1 + 30 + 10) / (20 + 20) = 1.5
    noise = pool_corner_noise([Fit(30.0), Fit(10.0)], prior_scale=1.0, prior_dof=20.0)
    assert noise.scale == pytest.approx(1.5)
    assert noise.dof == 40.0


def test_many_detections_outweigh_the_prior() -> None:
    rng = np.random.default_rng(0)
    noise = pool_corner_noise([Fit(4.0 * rng.chisquare(10)) for _ in range(200)])
    assert noise.scale == pytest.approx(4.0, rel=0.1)


def test_one_wild_detection_does_not_spoil_the_session_but_widens_itself() -> None:
    good = [Fit(10.0) for _ in range(20)]
    wild = Fit(5000.0)
    noise = pool_corner_noise([*good, wild])
    assert noise.scale == pytest.approx(1.0)
    assert noise.detections == 20
    assert detection_scale(wild, noise) > 50.0
    assert detection_scale(good[0], noise) == pytest.approx(1.0)


def test_covariance_is_scaled_information_plus_common_errors() -> None:
    common = np.diag([0.0, 0.0, 0.0, 0.0, 0.0, 9.0])
    fit = Fit(20.0, common_covariance=common)
    noise = CornerNoise(scale=2.0, dof=1e6, detections=1)
    covariance = fit_covariance(fit, noise)  # its own 20 / 10 agrees with the pool
    assert np.diag(covariance) == pytest.approx([0.5] * 5 + [9.5])
    assert (covariance == covariance.T).all()
