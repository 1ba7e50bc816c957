"""The tissue surface that the PMs trace, for the end of a beam whose PM is not detected.

Heights over the PMs' best plane are a plane plus a Gaussian process (kriging with a linear trend). Its amplitude comes
from the data. Its predictive sigma is widened where leave-one-out errors of the PMs show that it is too small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.geometry.transforms import FloatArray, rotation_to_direction

LENGTH_MM = 15.0
"""Correlation length of the surface's deviations from its plane."""
MIN_RELIEF_MM = 0.5
"""Least sigma of these deviations: no tissue is flatter."""
MIN_POINTS = 5
MOST_POINTS = 150
"""Largest number of PMs used. It covers a field of 40 mm every 3 mm; the time grows with the cube of the number."""
MIN_SPREAD_MM = 1.0
"""Least root mean square distance of the PMs from their best line."""
GRAZING = 0.2
"""Least cosine between beam and normal: below it the distance cannot be determined."""
REACH_MM = 12.0
"""Largest distance from a PM at which the surface is used."""
LONGEST_MM = 30.0
"""Longest interval (four sigmas) of a beam in which its end may lie."""
ALONG_MM = np.arange(1.0, 201.0)
"""Distances along a ray at which it is compared with the surface; linear in between."""
SLOPE_STEP_MM = 0.1
"""Step to either side of a place for the surface's slope."""


@dataclass(frozen=True, slots=True, eq=False)
class Meeting:
    """End of a ray: distance along it (mm), point (3,) in TRUS, unit normal (3,), sigma of ``normal @ point``."""

    distance_mm: float
    trus_p: FloatArray
    normal: FloatArray
    sigma_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class TissueSurface:
    """Heights over a plane in TRUS: ``axes`` (3, 3) columns u, v, height (away from the fibre); all mm.

    Attributes:
        axes: ``trus_R_surface``, third column the best plane's normal, on the side the beams go to.
        centre: (3,) TRUS origin of the surface's coordinates.
        place: (n, 2) of the PMs.
        covariance_inverse: (n, n). trend: (3,) coefficients over (1, u, v). trend_covariance: (3, 3).
        residual: (n,) heights less trend. relief_mm: sigma of the Gaussian process. inflation: of the sigma.
    """

    axes: FloatArray
    centre: FloatArray
    place: FloatArray
    covariance_inverse: FloatArray
    trend: FloatArray
    trend_covariance: FloatArray
    residual: FloatArray
    relief_mm: float
    inflation: float

    def height(self, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Height and its sigma (m,) at places (m, 2), mm."""
        near = _kernel(place, self.place, self.relief_mm)
        design = _design(place)
        weights = near @ self.covariance_inverse
        mean = design @ self.trend + weights @ self.residual
        left = design - weights @ _design(self.place)
        variance = self.relief_mm**2 - np.sum(weights * near, axis=1)
        variance = np.maximum(variance, 0.0) + np.sum((left @ self.trend_covariance) * left, axis=1)
        return mean, self.inflation * np.sqrt(variance)

    def meet(self, trus_p: FloatArray, trus_d: FloatArray) -> Meeting | None:
        """Where a ray from (3,) along the unit vector (3,) first meets the surface.

        None where it misses the surface, grazes it, or meets it farther than ``REACH_MM`` from all PMs.
        """
        points = (trus_p + ALONG_MM[:, None] * trus_d - self.centre) @ self.axes
        height, sigma = self.height(points[:, :2])
        gap = points[:, 2] - height
        crossing, end = _first_rise(gap), _first_rise(gap - 2.0 * sigma)
        # From where the ray may have met the surface to where it must have: a long interval where it grazes the
        # surface or comes near it twice.
        begin = float(ALONG_MM[0]) if gap[0] + 2.0 * sigma[0] > 0.0 else _first_rise(gap + 2.0 * sigma)
        if crossing is None or end is None or begin is None or end < crossing or gap[0] > 2.0 * sigma[0]:
            return None
        stretch = end - begin
        met = trus_p + crossing * trus_d
        place = ((met - self.centre) @ self.axes)[:2]
        if stretch > LONGEST_MM or float(np.linalg.norm(self.place - place, axis=1).min()) > REACH_MM:
            return None
        step = SLOPE_STEP_MM * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        near, _ = self.height(place + step)
        slope = np.array([near[0] - near[1], near[2] - near[3]]) / (2.0 * SLOPE_STEP_MM)
        normal = self.axes @ np.array([-slope[0], -slope[1], 1.0])
        normal = normal / np.linalg.norm(normal)
        towards = float(normal @ trus_d)
        if towards < GRAZING:
            return None
        return Meeting(crossing, met, normal, stretch / 4.0 * towards)


def _first_rise(values: FloatArray) -> float | None:
    """The first distance at which values at ``ALONG_MM`` rise through zero."""
    rises = np.flatnonzero((values[:-1] < 0.0) & (values[1:] >= 0.0))
    if not len(rises):
        return None
    i = int(rises[0])
    share = values[i] / (values[i] - values[i + 1])
    return float(ALONG_MM[i] + share * (ALONG_MM[i + 1] - ALONG_MM[i]))


def _kernel(first: FloatArray, second: FloatArray, relief_mm: float) -> FloatArray:
    square = np.sum((first[:, None] - second[None]) ** 2, axis=-1)
    return np.asarray(relief_mm**2 * np.exp(-0.5 * square / LENGTH_MM**2))


def _design(place: FloatArray) -> FloatArray:
    return np.column_stack([np.ones(len(place)), place])


def fit_surface(trus_p_pm: FloatArray, covariance: FloatArray, trus_d_beam: FloatArray) -> TissueSurface | None:
    """The surface through PMs (n, 3) with covariances (n, 3, 3), seen along beams (n, 3); None below 5 PMs."""
    if len(trus_p_pm) < MIN_POINTS:
        return None
    if len(trus_p_pm) > MOST_POINTS:
        some = np.linspace(0, len(trus_p_pm) - 1, MOST_POINTS).round().astype(np.int64)
        trus_p_pm, covariance, trus_d_beam = trus_p_pm[some], covariance[some], trus_d_beam[some]
    centre = trus_p_pm.mean(axis=0)
    _, spread, directions = np.linalg.svd(trus_p_pm - centre)
    if spread[1] < MIN_SPREAD_MM * np.sqrt(len(trus_p_pm)):
        return None  # PMs in a row do not determine the slope across it
    normal = directions[2] * (1.0 if directions[2] @ trus_d_beam.mean(axis=0) >= 0 else -1.0)
    axes = rotation_to_direction(normal)
    local = (trus_p_pm - centre) @ axes
    place, height = local[:, :2], local[:, 2]
    noise = np.einsum("i,nij,j->n", axes[:, 2], covariance, axes[:, 2])
    design = _design(place)

    def solve(relief_mm: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, float]:
        total = _kernel(place, place, relief_mm) + np.diag(noise + 1e-6)
        inverse = np.asarray(np.linalg.inv(total), dtype=np.float64)
        information = design.T @ inverse @ design
        trend_covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        trend = trend_covariance @ (design.T @ inverse @ height)
        residual = height - design @ trend
        likelihood = residual @ inverse @ residual + np.linalg.slogdet(total)[1] + np.linalg.slogdet(information)[1]
        return inverse, trend, trend_covariance, residual, float(likelihood)

    reliefs = np.geomspace(MIN_RELIEF_MM, 10.0, 12)
    relief = float(min(reliefs, key=lambda value: solve(float(value))[4]))
    inverse, trend, trend_covariance, residual, _ = solve(relief)
    # Leave-one-out errors in closed form: with the trend projected out, e_i = (P h)_i / P_ii, variance 1 / P_ii.
    projected = inverse - inverse @ design @ trend_covariance @ design.T @ inverse
    left_out = (projected @ height) ** 2 / np.diag(projected)
    inflation = float(np.sqrt(max(1.0, left_out.mean())))
    return TissueSurface(axes, centre, place, inverse, trend, trend_covariance, residual, relief, inflation)
