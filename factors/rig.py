"""The rig's constants in a factor: one Vector variable of those that are estimated.

All constants that are variables share one GTSAM variable, so that a factor has the same few keys whatever is estimated.
A residual function takes all constants (COUNT,), and gives its derivative by all of them. Source: docs/model.md,
section 6; :mod:`fgreg.geometry.rig`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from fgreg.factors.adapter import Residual, Row, Rows, custom_factor
from fgreg.geometry.rig import COUNT
from fgreg.geometry.transforms import FloatArray, as_float_array

AS_DECLARED: tuple[float, ...] = (0.0,) * COUNT
"""All constants as declared."""


@dataclass(frozen=True, slots=True)
class RigKey:
    """The variable: its key, and which constants it holds, in ascending order."""

    key: int
    constants: tuple[int, ...]

    def read(self, values: gtsam.Values) -> list[float]:
        """All constants (COUNT,); those that are no variables are as declared."""
        out = [0.0] * COUNT
        for constant, value in zip(self.constants, values.atVector(self.key).tolist(), strict=True):
            out[constant] = value
        return out


def rig_rows(jacobians: Sequence[Rows], rig: RigKey | None) -> Sequence[Rows]:
    """Jacobians whose last one is by all constants (m, COUNT), with that one over the rig's variable (m, K)."""
    if not jacobians:
        return ()
    if rig is None:
        return jacobians[:-1]
    return [*jacobians[:-1], [[row[constant] for constant in rig.constants] for row in jacobians[-1]]]


def rig_prior_factor(rig: RigKey, mean: FloatArray, information: FloatArray) -> gtsam.NoiseModelFactor:
    """Prior of the constants: mean (K,), information (K, K)."""
    count = len(rig.constants)
    noise_model = gtsam.noiseModel.Gaussian.Information(as_float_array(information, count, count))
    return gtsam.PriorFactorVector(rig.key, as_float_array(mean, count), noise_model)


def spot_residual(camera_p_spot: Row, constants: Row, observed_mm: Row, gain: FloatArray) -> Residual:
    """An aimed-at spot against its measurement: ``e = p - observed - gain c``.

    Args:
        camera_p_spot: (3,) mm.
        constants: (COUNT,).
        observed_mm: (3,) mm.
        gain: (3, COUNT) by how much errors of the constants move the measurement.

    Returns:
        error (3,) mm; Jacobians (3, 3), (3, COUNT).
    """
    error = np.subtract(camera_p_spot, observed_mm) - gain @ np.asarray(constants)
    return error.tolist(), (np.eye(3).tolist(), (-gain).tolist())


def spot_factor(
    camera_p_spot_key: int,
    observed_mm: FloatArray,
    covariance: FloatArray,
    gain: FloatArray,
    rig: RigKey,
) -> gtsam.CustomFactor:
    """The factor of an aimed-at spot: Point3 and the rig, Vector K.

    Args:
        camera_p_spot_key, rig: variables.
        observed_mm: (3,) camera frame. covariance: (3, 3) mm^2.
        gain: (3, COUNT) as of :func:`spot_residual`.
    """
    observed = as_float_array(observed_mm, 3).tolist()
    noise_model = gtsam.noiseModel.Gaussian.Covariance(as_float_array(covariance, 3, 3))

    def evaluate(values: gtsam.Values, want_jacobians: bool) -> Residual:
        error, jacobians = spot_residual(values.atPoint3(camera_p_spot_key).tolist(), rig.read(values), observed, gain)
        return error, rig_rows(jacobians, rig) if want_jacobians else ()

    keys, sizes = (camera_p_spot_key, rig.key), (3, len(rig.constants))
    return custom_factor("aimed-at spot", noise_model, keys, 3, sizes, evaluate)
