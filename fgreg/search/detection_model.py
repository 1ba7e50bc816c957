"""Detection model of the search: amplitude of a PM at a stage angle, and probability of its detection.

A PM of amplitude ``peak`` in the plane is received at rotation d from it with

    log amplitude = log peak + log gain(d) + noise,        noise ~ N(0, amplitude_sigma^2),

and is detected if the amplitude reaches the detection threshold. The peak is unknown: it depends on the tissue, the
fibre's distance and the depth. The gain is the session's sensitivity curve.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from fgreg.geometry.transforms import FloatArray
from fgreg.model.probe_model import SensitivityModel
from fgreg.model.sensitivity import AMPLITUDE_SIGMA, amplitude_curve

ASSUMED_SIGMA = 0.15
"""Relative noise if the session has no curve; a bell of half height at the sensitivity window's edge is used then."""
EDGE_MARGIN = 1.0
"""A sweep's steps assume the half width minus this many of its sigmas."""
LAPSE = 0.01
"""Share of looks that carry no information on this PM: the pulse failed, or another source was detected."""
_LAPSE_LOG_SPAN = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class DetectionModel:
    """Gain against rotation, threshold, noise.

    Attributes:
        rotation_rad, log_gain: (m,), the curve, with maximum 0; extrapolated with its last slopes.
        threshold: least amplitude of a detection, in the unit of the amplitudes.
        amplitude_sigma: relative noise of an amplitude.
        scan_sigma_rad: of the stage reading; adds noise by the curve's slope.
        width_sigma: relative uncertainty of the curve's width: sigma of the window's edge over its half width.
        reach_rad: rotation to either side within which a PM is surely detected: half width minus its uncertainty.
    """

    rotation_rad: FloatArray
    log_gain: FloatArray
    threshold: float
    amplitude_sigma: float
    scan_sigma_rad: float
    width_sigma: float
    reach_rad: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.threshold) and self.threshold > 0):
            raise ValueError(f"the detection threshold is {self.threshold}, expected a number > 0")
        if not (0 < self.amplitude_sigma <= 1 and min(self.scan_sigma_rad, self.width_sigma) >= 0 < self.reach_rad):
            raise ValueError("amplitude_sigma has to be in (0, 1], the other sigmas >= 0, reach_rad > 0")

    @classmethod
    def of_session(
        cls,
        sensitivity: SensitivityModel,
        threshold: float,
        *,
        amplitude_sigma: float = AMPLITUDE_SIGMA,
        scan_sigma_rad: float = 0.0,
    ) -> Self:
        """The session's curve; without one, a bell of half height at the smallest half width, and more noise."""
        narrow = float(sensitivity.half_width_rad.min())
        reach = max(narrow - EDGE_MARGIN * sensitivity.edge_sigma_rad, 0.5 * narrow)
        width_sigma = sensitivity.edge_sigma_rad / narrow
        curve = amplitude_curve(sensitivity)
        if curve is not None:
            log = np.asarray(curve.log_amplitude - curve.log_amplitude.max())
            return cls(curve.rotation_rad, log, threshold, amplitude_sigma, scan_sigma_rad, width_sigma, reach)
        rotation = np.linspace(-1.5, 1.5, 61) * narrow
        log = np.asarray(-math.log(2.0) * (rotation / narrow) ** 2)
        return cls(rotation, log, threshold, max(amplitude_sigma, ASSUMED_SIGMA), scan_sigma_rad, width_sigma, reach)

    def gain_log(self, rotation_rad: npt.ArrayLike) -> FloatArray:
        """Log gain at rotations of any shape; beyond the curve with its last slope, decreasing in any case."""
        d = np.asarray(rotation_rad, dtype=np.float64)
        x, y = self.rotation_rad, self.log_gain
        inside = np.interp(d, x, y)
        left, right = (y[1] - y[0]) / (x[1] - x[0]), (y[-1] - y[-2]) / (x[-1] - x[-2])
        steepest = 1.0 / self.reach_rad  # e-fold per reach, at least
        return np.asarray(
            inside
            - max(left, steepest) * np.maximum(x[0] - d, 0.0)
            - max(-right, steepest) * np.maximum(d - x[-1], 0.0)
        )

    def noise_log(self, rotation_rad: npt.ArrayLike) -> FloatArray:
        """Sigma of the log amplitude at rotations: amplitude noise, and stage reading and width by the curve's slope.

        The width's error is common to all looks at a PM. It is treated as independent noise of each, which still gives
        looks on the flanks a smaller weight.
        """
        step = 0.05 * self.reach_rad
        d = np.asarray(rotation_rad, dtype=np.float64)
        slope = np.abs(self.gain_log(d + step) - self.gain_log(d - step)) / (2.0 * step)
        by_slope = slope * np.hypot(self.scan_sigma_rad, self.width_sigma * d)
        return np.asarray(np.hypot(self.amplitude_sigma, np.minimum(by_slope, 1.0)))

    def likelihood(self, expected_log: FloatArray, sigma: FloatArray, amplitude: float | None) -> FloatArray:
        """Likelihood of a look given mean ``expected_log`` and ``sigma`` (broadcasting) of the log amplitude.

        Args:
            amplitude: of the detection; None if nothing was detected.

        Raises:
            ValueError: an amplitude that is not a positive number.
        """
        if amplitude is None:
            missed = ndtr((math.log(self.threshold) - expected_log) / sigma)
            return np.asarray((1.0 - LAPSE) * missed + LAPSE)
        if not (math.isfinite(amplitude) and amplitude > 0):
            raise ValueError(f"the amplitude is {amplitude}, expected a number > 0, or None where nothing was detected")
        z = (math.log(amplitude) - expected_log) / sigma
        detected = np.exp(-0.5 * z * z) / (math.sqrt(2.0 * math.pi) * sigma)
        return np.asarray((1.0 - LAPSE) * detected + LAPSE / _LAPSE_LOG_SPAN)
