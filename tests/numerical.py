"""Numerical derivatives of GTSAM factors, for tests."""

from __future__ import annotations

import gtsam
import numpy as np

from fgreg.geometry.transforms import FloatArray, exp_so3, make_transform


def random_pose(rng: np.random.Generator, reach_mm: float = 100.0) -> gtsam.Pose3:
    """Any rotation, and a translation within +-reach along each axis."""
    axis = rng.normal(size=3)
    rotation = exp_so3(axis / np.linalg.norm(axis) * rng.uniform(0.0, 3.0))
    return gtsam.Pose3(make_transform(rotation, rng.uniform(-reach_mm, reach_mm, 3)))


def moved(values: gtsam.Values, key: int, tangent: FloatArray) -> gtsam.Values:
    """The values with one variable moved along its tangent."""
    delta = gtsam.VectorValues()
    delta.insert(key, tangent)
    return values.retract(delta)


def whitened_error(factor: gtsam.NoiseModelFactor, values: gtsam.Values) -> FloatArray:
    """The factor's error, divided by its noise."""
    return np.asarray(factor.noiseModel().whiten(factor.unwhitenedError(values)))


def numerical_jacobian(factor: gtsam.NoiseModelFactor, values: gtsam.Values, key: int, step: float) -> FloatArray:
    """Central differences, fourth order, of the whitened error along one variable's tangent."""
    n = values.zeroVectors().at(key).size
    columns = []
    for unit in np.eye(n):
        near, far = (
            whitened_error(factor, moved(values, key, s * unit)) - whitened_error(factor, moved(values, key, -s * unit))
            for s in (step, 2.0 * step)
        )
        columns.append((8.0 * near - far) / (12.0 * step))
    return np.stack(columns, axis=1)


def analytic_jacobian(factor: gtsam.NoiseModelFactor, values: gtsam.Values, key: int) -> FloatArray:
    """The factor's Jacobian for one of its variables, divided by its noise."""
    linear = factor.linearize(values)
    blocks, _ = linear.jacobian()
    start = 0
    for other in linear.keys():  # noqa: SIM118 - a gtsam list of keys, not a dict
        width = values.zeroVectors().at(other).size
        if other == key:
            return np.asarray(blocks[:, start : start + width])
        start += width
    raise AssertionError("the key is not one of the factor's")


def jacobian_mismatch(factor: gtsam.NoiseModelFactor, values: gtsam.Values, step: float = 1e-3) -> dict[int, float]:
    """Per key, the largest difference of analytic and numerical Jacobian, over the numerical one's largest entry.

    A Jacobian that is zero is compared absolutely.
    """
    out = {}
    for key in factor.keys():  # noqa: SIM118
        expected = numerical_jacobian(factor, values, key, step)
        difference = np.abs(analytic_jacobian(factor, values, key) - expected).max()
        out[int(key)] = float(difference / (np.abs(expected).max() or 1.0))
    return out
