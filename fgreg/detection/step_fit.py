"""Fit of blurred steps to the pixels about edges: damped Gauss-Newton for all edges at once, outliers weighted down."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.detection.edge_pixels import EdgePixels, PixelArray
from fgreg.detection.step_model import PARAMETERS, seen_levels, step_model
from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray

MIN_CONTRAST = 12.0
"""Least difference in grey levels between the dark and the light side of an edge."""
MAX_BLUR_PX = 5.0
LEVEL_SLOPE_SIGMA = 0.3
"""Prior sigma of b1 and w1 as a share of the contrast: short edges do not determine them."""
LOG_BLUR_SIGMA = 0.7
"""Prior sigma of log s about the starting blur: a step as sharp as a pixel does not determine it."""
KURTOSIS_SIGMA, MAX_KURTOSIS = 0.03, 0.08
"""Prior sigma and largest size of c."""
FALL_OFF_SIGMA = 0.004
"""Prior sigma of g, per px: light changes by about half over a hundred pixels."""
FALL_OFF_COMMON_SIGMA = 0.0001
"""The same about the value from the first pass, which opposite edges of a square share."""
STEEP = 0.3
"""Pixels at which the model is at least this steep, as a share of its steepest, tell its misfit."""
MEDIAN_SIGMAS = 0.6745
"""Median of the size of a normally distributed residual, in standard deviations."""
BINS, CLEAN_SHARE = 40, 0.75
"""Parts along an edge, and the mean weight of a part's pixels below which all of them are left out."""
DIAGONAL = np.eye(PARAMETERS)
LONGEST, LEAST, MOST = (np.full(PARAMETERS, bound) for bound in (np.inf, -np.inf, np.inf))
"""The longest step of each parameter, and its bounds."""
LONGEST[2], LEAST[2], MOST[2] = 0.5, np.log(0.2), np.log(2.0 * MAX_BLUR_PX)
LEAST[8], MOST[8] = -MAX_KURTOSIS, MAX_KURTOSIS


@dataclass(frozen=True, slots=True)
class Pass:
    """How a fit is made.

    Attributes:
        iterations: the most.
        settled_px: step of an edge's place that is the last one; the next one would be a tenth of it.
        ends_from: first iteration that may be the last.
        reweigh_from: first iteration that weights outlier pixels down (a speck, a glint).
        by_parts: whether all pixels of a part of an edge are left out where many are outliers.
        fall_off_sigma: prior sigma of g about the start.
    """

    iterations: int
    settled_px: float
    ends_from: int
    reweigh_from: int
    by_parts: bool
    fall_off_sigma: float


FIRST = Pass(10, 0.02, 4, 3, False, FALL_OFF_SIGMA)
"""From no more than the levels on either side."""
AGAIN = Pass(4, 0.05, 0, 0, False, FALL_OFF_SIGMA)
"""The same, from the fit in the last picture."""
SECOND = Pass(8, 3e-3, 1, 0, True, FALL_OFF_COMMON_SIGMA)
"""About the line that the first pass has found."""
WITH_RESPONSE = Pass(3, 1e-3, 1, 0, False, FALL_OFF_COMMON_SIGMA)
"""About that of the second, for another response: a sigma needs no more, and later iterations change o by 0.003 px."""


@dataclass(frozen=True, slots=True, eq=False)
class Optimum:
    """Parameters (n, 9) at the optimum, with grey levels, residuals, weights (n, p) and Jacobian (n, 9, p) there, and
    the inverse variances (n, 9) of the priors."""

    x: FloatArray
    grey: PixelArray
    residual: PixelArray
    weight: PixelArray
    jacobian: PixelArray
    prior: FloatArray


def fit_steps(
    band: EdgePixels,
    start: FloatArray,
    how: Pass,
    exponent: float = 1.0,
) -> Optimum:
    """The edges by Levenberg-Marquardt from parameters (n, 9), for a camera with this response."""
    x = start.copy()
    contrast = np.maximum(np.abs(x[:, 5] - x[:, 3]), MIN_CONTRAST)
    # Priors: inverse variances about the start.
    prior = np.zeros_like(x)
    prior[:, 2] = LOG_BLUR_SIGMA**-2
    prior[:, 4] = prior[:, 6] = (LEVEL_SLOPE_SIGMA * contrast) ** -2.0
    prior[:, 7] = how.fall_off_sigma**-2
    prior[:, 8] = KURTOSIS_SIGMA**-2
    centre = np.zeros_like(x)
    centre[:, [2, 7]] = x[:, [2, 7]]

    weight = band.used.astype(band.d.dtype)
    parts = _parts_along(band) if how.by_parts else None
    sigma = 0.1 * contrast
    damping = np.full(len(x), 1e-3)
    grey, jacobian = seen_levels(*step_model(band, x), exponent)
    residual = band.grey - grey
    cost = np.full(len(x), np.inf)
    for iteration in range(how.iterations):
        if iteration >= how.reweigh_from:
            sigma = _typical(residual, band.used, jacobian[:, 0])
            square = np.square(residual * column(0.25 / sigma, residual))
            weight = band.used / (1.0 + np.square(square, out=square))
            if parts is not None:
                weight *= _clean_parts(weight, *parts)
        if iteration == 0 or iteration >= how.reweigh_from:
            cost = sum_of_squares(weight, residual) / sigma**2 + np.sum(prior * (x - centre) ** 2, axis=1)
        normal, gradient = normal_equations(jacobian, weight * column(sigma**-2.0, weight), residual)
        normal += prior[..., None] * DIAGONAL
        gradient -= prior * (x - centre)
        normal += DIAGONAL * (damping[:, None, None] * normal + 1e-9)
        step = np.linalg.solve(normal, gradient[..., None])[..., 0]
        step = np.minimum(np.maximum(step, -LONGEST), LONGEST)
        y = np.minimum(np.maximum(x + step, LEAST), MOST)
        if iteration >= how.ends_from and np.abs(step[:, :2]).max() < how.settled_px:
            # The model is linear over such a step.
            change = ((y - x).astype(grey.dtype)[:, None] @ jacobian)[:, 0]
            return Optimum(y, grey + change, residual - change, weight, jacobian, prior)
        new_grey, new_jacobian = seen_levels(*step_model(band, y), exponent)
        new_residual = band.grey - new_grey
        new_cost = sum_of_squares(weight, new_residual) / sigma**2 + np.sum(prior * (y - centre) ** 2, axis=1)
        better = new_cost <= cost
        damping = np.where(better, damping * 0.1, damping * 10.0)
        if better.all():
            x, cost, residual, jacobian, grey = y, new_cost, new_residual, new_jacobian, new_grey
        else:
            x[better], cost[better] = y[better], new_cost[better]
            residual[better], jacobian[better] = new_residual[better], new_jacobian[better]
            grey[better] = new_grey[better]
    return Optimum(x, grey, residual, weight, jacobian, prior)


def column(values: FloatArray, like: PixelArray) -> PixelArray:
    """Values (n,) of edges as (n, 1), of the precision of pixels."""
    return values.astype(like.dtype)[:, None]


def sum_of_squares(weight: PixelArray, residual: PixelArray) -> FloatArray:
    return np.asarray(np.vecdot(weight * residual, residual), dtype=np.float64)


def normal_equations(jacobian: PixelArray, weight: PixelArray, residual: PixelArray) -> tuple[FloatArray, FloatArray]:
    """Normal matrices (n, 9, 9) and gradients (n, 9), without priors."""
    jw = jacobian * weight[:, None]
    normal = jw @ np.swapaxes(jacobian, 1, 2)
    return normal.astype(np.float64), (jw @ residual[..., None])[..., 0].astype(np.float64)


def _parts_along(band: EdgePixels) -> tuple[IntArray, IntArray]:
    """The part (n, p) of its edge that a pixel lies in, and the number of pixels of each part; the last: not used."""
    parts = (0.5 * BINS * (band.u + 1.0)).astype(np.intp)
    np.clip(parts, 0, BINS - 1, out=parts)
    parts += BINS * np.arange(len(parts))[:, None]
    parts[~band.used] = last = BINS * len(parts)
    return parts, np.bincount(parts.ravel(), minlength=last + 1)


def _clean_parts(weight: PixelArray, parts: IntArray, count: IntArray) -> BoolArray:
    """Whether a pixel (n, p) lies where the whole width of the edge is as modelled: a spot spoils what is across it."""
    total = np.bincount(parts.ravel(), weight.ravel(), minlength=len(count))
    return np.asarray((total >= CLEAN_SHARE * count)[parts])


def _typical(residual: PixelArray, used: BoolArray, by_offset: PixelArray) -> FloatArray:
    """Standard deviation (n,) of the pixels about the model where it falls or rises, half of which may be outliers."""
    size = np.abs(by_offset)
    chosen = used & (size > STEEP * (size * used).max(axis=1, keepdims=True))
    out = [median(np.abs(row[steep])) for row, steep in zip(residual, chosen, strict=True)]
    return np.maximum(np.array(out) / MEDIAN_SIGMAS, 0.3)


def median(values: PixelArray) -> float:
    """As ``numpy.median`` of finite values, at a third of its time; 0 of none."""
    count = len(values)
    if not count:
        return 0.0
    middle = count // 2
    if count % 2:
        return float(np.partition(values, middle)[middle])
    parted = np.partition(values, (middle - 1, middle))
    return float(0.5 * (parted[middle - 1] + parted[middle]))
