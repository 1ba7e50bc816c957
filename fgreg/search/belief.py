"""Posterior of one PM on a grid: distribution over its plane angle and the logarithm of its peak amplitude."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.special import ndtr

from fgreg.geometry.transforms import FloatArray
from fgreg.search.detection_model import DetectionModel

GRID_RAD = math.radians(0.1)
"""Spacing of angles."""
GRID_LOG = 0.04
"""Spacing of log peaks: below the noise of an amplitude."""
PEAK_SPAN = 40.0
"""Ratio of the largest peak to the threshold; the prior of the log peak is uniform in between."""
CENTRAL_MASS = 0.98
"""Central share of the distribution over which expectations are taken, so that looks do not follow far-off tails."""
_OUTCOME_LOG = 0.05
_NOISE_CLASSES = (1.0, 1.4, 2.0, 3.0, 6.0)
"""Multiples of the amplitude's noise that expectations distinguish; the noise grows on the curve's flanks."""


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """Weights (J, K), summing to 1, over plane angles (J,) and log peaks (K,)."""

    model: DetectionModel
    angle_rad: FloatArray
    log_peak: FloatArray
    weight: FloatArray

    @classmethod
    def flat(cls, model: DetectionModel, low_rad: float, high_rad: float) -> Self:
        """Uniform between two angles."""
        count = max(2, round((high_rad - low_rad) / GRID_RAD) + 1)
        angle = np.linspace(low_rad, high_rad, count)
        top = math.log(PEAK_SPAN)
        log_peak = math.log(model.threshold) + np.linspace(0.0, top, round(top / GRID_LOG) + 1)
        return cls(model, angle, log_peak, np.full((count, log_peak.size), 1.0 / (count * log_peak.size)))

    def times(self, prior: FloatArray) -> Self:
        """Multiplied by a prior (J,) over the angle."""
        weight = self.weight * prior[:, None]
        return replace(self, weight=weight / weight.sum())

    def after(self, scan_rad: float, amplitude: float | None) -> Self:
        """Updated with one look; ``amplitude`` is None if nothing was detected."""
        rotation = self.angle_rad - scan_rad
        expected = self.log_peak[None, :] + self.model.gain_log(rotation)[:, None]
        like = self.model.likelihood(expected, self.model.noise_log(rotation)[:, None], amplitude)
        weight = self.weight * like
        return replace(self, weight=weight / weight.sum())

    def angle_weight(self) -> FloatArray:
        """Marginal distribution of the angle, (J,)."""
        return np.asarray(self.weight.sum(axis=1))

    def quantile(self, share: float) -> float:
        """The angle (rad) below which ``share`` of the distribution lies; linear between grid points."""
        cumulated = np.cumsum(self.angle_weight())
        half = 0.5 * (self.angle_rad[1] - self.angle_rad[0])
        return float(np.interp(share, np.r_[0.0, cumulated], np.r_[self.angle_rad[0] - half, self.angle_rad + half]))

    def best_rad(self) -> float:
        """Mean angle over the central mass, rad."""
        angle, weight = self._central_angles()
        return float(weight @ angle / weight.sum())

    def sigma_rad(self) -> float:
        """A quarter of the width of the central 95.45 %, rad: the standard deviation of a Gaussian.

        It is robust against far-off lapses and cut-off tails; with two separate modes it shows their distance.
        """
        tail = 0.5 * (1.0 - 0.9545)
        return 0.25 * (self.quantile(1.0 - tail) - self.quantile(tail))

    def _central_angles(self) -> tuple[FloatArray, FloatArray]:
        low, high = self.quantile(0.5 * (1.0 - CENTRAL_MASS)), self.quantile(0.5 * (1.0 + CENTRAL_MASS))
        half = 0.5 * (self.angle_rad[1] - self.angle_rad[0])
        central = (self.angle_rad >= low - half) & (self.angle_rad <= high + half)
        return np.asarray(self.angle_rad[central]), np.asarray(self.angle_weight()[central])

    def expected_sigma(self, scan_rad: FloatArray) -> FloatArray:
        """Expected standard deviation of the angle after one more look at each of C positions: (C,) rad.

        This is the posterior variance for each outcome (no detection, or an amplitude in one of many bins), weighted
        with the outcome's probability. The expected log amplitudes of the grid points are binned first; the noise then
        moves mass between bins, so that the sum is a product of small matrices.
        """
        low, high = self.quantile(0.5 * (1.0 - CENTRAL_MASS)), self.quantile(0.5 * (1.0 + CENTRAL_MASS))
        rows = np.flatnonzero((self.angle_rad >= low) & (self.angle_rad <= high))
        if rows.size == 0:
            rows = np.array([int(np.argmin(np.abs(self.angle_rad - 0.5 * (low + high))))])
        part = self.weight[rows]
        j, k = np.nonzero(part > 2e-4 * part.max())
        weight, angle, peak = part[j, k], self.angle_rad[rows][j], self.log_peak[k]
        weight = weight / weight.sum()
        off = angle - float(weight @ angle)  # so that variances are not differences of large numbers

        threshold = math.log(self.model.threshold)
        first = threshold - 6.0 * self.model.amplitude_sigma
        bins = math.ceil((self.log_peak[-1] - first) / _OUTCOME_LOG) + 1
        rotation = self.angle_rad[rows][None, :] - scan_rad[:, None]
        expected = self.model.gain_log(rotation)[:, j] + peak[None, :]
        index = np.clip(((expected - first) / _OUTCOME_LOG).astype(np.int64), 0, bins - 1)
        noise = np.searchsorted(_NOISE_CLASSES[1:], self.model.noise_log(rotation) / self.model.amplitude_sigma)
        index += bins * (noise[:, j] + len(_NOISE_CLASSES) * np.arange(scan_rad.size)[:, None])
        carry = np.concatenate([self._carry(first, bins, threshold, c) for c in _NOISE_CLASSES])
        mass, mean, square = (
            np.bincount(index.ravel(), np.broadcast_to(w, index.shape).ravel(), len(carry) * scan_rad.size).reshape(
                scan_rad.size, -1
            )
            @ carry
            for w in (weight, weight * off, weight * off * off)
        )
        variance = np.sum(square - mean * mean / np.maximum(mass, 1e-300), axis=1)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def _carry(self, first: float, bins: int, threshold: float, noise: float) -> FloatArray:
        """(bins, outcomes): probability of each outcome per bin of expected log amplitude; outcome 0 is no detection.

        ``noise`` is in units of ``amplitude_sigma``.
        """
        sigma = noise * self.model.amplitude_sigma
        centre = first + _OUTCOME_LOG * (np.arange(bins) + 0.5)
        top = centre[-1] + 4.0 * self.model.amplitude_sigma
        edges = np.r_[-np.inf, np.arange(threshold, top + _OUTCOME_LOG, _OUTCOME_LOG), np.inf]
        return np.asarray(np.diff(ndtr((edges[None, :] - centre[:, None]) / sigma), axis=1))
