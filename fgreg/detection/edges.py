"""Straight edges in an image with sub-pixel accuracy and covariance.

An edge between a dark and a light surface is fitted to the pixels near it as a blurred step,

    I = (1 + g e) (B + (W - B) P(t)) + g s (W - B) phi(t),   P(t) = Phi(t) - c He3(t) phi(t),   t = e / s,
    e = d - o - m u,  B = b0 + b1 u,  W = w0 + w1 u,

with Phi, phi the normal distribution and density, d the distance of a pixel from the starting line (towards the light
side), u in [-1, 1] the position along it, and g the fall-off of light across the edge: the blur of a step in albedo
under light that varies linearly. c is the blur's kurtosis over 24, He3(t) = t^3 - 3 t (Gram-Charlier series): 0 for a
Gaussian, -0.042 for a defocused disc, -0.05 for motion. Without c, g takes its place and moves o: by 0.1 px for a disc
of 4 px, outwards at every edge. o, m, s, the levels, g and c are found by damped Gauss-Newton for all edges at once.
Symmetric blur does not bias o and m, nor does light that falls off along or across the edge (without g the bias
is 0.005 px, the same in both views). No pixel is interpolated, so the noise is independent and the normal equations
give the covariance.

A camera whose levels are no linear function of the light moves all edges towards the dark side, by up to 0.4 s: the
line is that of a linear camera, and ``by_response`` says how far it may be off. More is added where white is cut off,
where odd and even lines disagree, and where the dark side is bright under a veil.

Lengths are *ideal* pixels (camera.py), without lens distortion: the edges of a square are straight in them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from fgreg.detection.edge_pixels import EdgePixels, GreyImage, edge_pixels, segment_frames
from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray
from fgreg.model.camera_model import CameraModel

MAX_ROWS = 112
"""Largest number of pixel rows used across an edge; longer edges are sampled evenly."""
SECTIONS, MIN_SECTIONS = 8, 6
"""Parts of an edge, and the number of parts in which both sides must be in the image."""
MIN_CONTRAST = 12.0
"""Least difference in grey levels between the dark and the light side of an edge."""
MAX_BLUR_PX = 5.0
LEVEL_SLOPE_SIGMA = 0.3
"""Prior sigma of b1 and w1 as a share of the contrast: short edges do not determine them."""
LOG_BLUR_SIGMA = 0.7
"""Prior sigma of log s about the starting blur: a step as sharp as a pixel does not determine it."""
FALL_OFF_SIGMA = 0.004
"""Prior sigma of g, per px: light changes by about half over a hundred pixels."""
FALL_OFF_COMMON_SIGMA = 0.0001
"""The same about the value from the first pass, which opposite edges of a square share."""
KURTOSIS_SIGMA, MAX_KURTOSIS = 0.03, 0.08
"""Prior sigma and largest size of c."""
PARAMETERS = 9
STEEP = 0.3
"""Pixels at which the model is at least this steep, as a share of its steepest, tell its misfit."""
WHITE, CUT_OFF = 255.0, 254.5
"""The highest grey level, and that from which a pixel may be brighter than it says."""
VIDEO, VIDEO_SIGMA = 0.5, 0.08
"""Exponent of video's response (ITU-R BT.709, sRGB) as a power of the light, and how far cameras differ from it."""
EDGE_ERROR, COMMON_ERROR, FULL_RATIO = 0.1, (0.05, 7.0), 16.0
"""Standard deviation of the exponent that one edge, and all edges of a picture, ask for, from blur of other shapes and
from compression, which shows as noise: of the latter a constant, and a factor on noise over contrast. Both are for a
light side brighter than the dark one by this ratio: they grow as its logarithm falls."""
OVEREXPOSED, CUT_SHARE = 0.8, 0.1
"""One sigma of where all edges are together, in blurs, and the share of an edge's pixels cut off at white from which
that counts: neither the response nor how bright the light side is can be told."""
COMBED = 0.1
"""One sigma of an edge's offset and slope as a share of the distance between odd and even lines: the marker moved."""
VEIL = 0.02
"""One sigma of o in blurs, times the square of the dark side's level over the light side's: where the dark side is not
dark there is a veil (smoke, glare) that may vary across the edge."""
LEAST_EXPONENT, MOST_EXPONENT = 0.2, 1.3
CLEARLY_LINEAR = 1e-4
"""Odds of video's response below which it is not looked at."""
MEDIAN_SIGMAS = 0.6745
"""Median of the size of a normally distributed residual, in standard deviations."""
BINS, CLEAN_SHARE = 40, 0.75
"""Parts along an edge, and the mean weight of a part's pixels below which all of them are left out."""
RESPONSE_STEPS = 3
"""Iterations of the fit with video's response: a sigma needs no more, and later ones change o by 0.003 px."""
REWEIGH_AT = 4
"""First iteration that down-weights outlier pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeFit:
    """Edges found near n starting segments.

    Attributes:
        line: (n, 2) offset o at the middle and m at the end of the segment (u = 1), ideal px, along ``normal``.
        covariance: (n, 2, 2) of ``line``, px^2, at the pixel noise that the fit leaves.
        blur_px: (n,) standard deviation s of the step.
        step: (n,) grey levels, left side of the starting segment less its right side.
        good: (n,) whether the edge passed all checks.
        by_response: (n,) one sigma of o, px, by the camera's response: one error for all edges.
    """

    line: FloatArray
    covariance: FloatArray
    blur_px: FloatArray
    step: FloatArray
    good: BoolArray
    by_response: FloatArray


def _step_model(band: EdgePixels, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Grey levels (n, p) of parameters (n, 9) = (o, m, log s, b0, b1, w0, w1, g, c), and their Jacobian (n, 9, p)."""
    u = band.u
    blur = np.exp(x[:, 2])[:, None]
    fall, kurtosis = x[:, 7:8], x[:, 8:9]
    e = band.d - x[:, :1] - x[:, 1:2] * u
    t = e / blur
    t2 = t * t
    phi = np.exp(-0.5 * t2)
    phi *= 1.0 / np.sqrt(2.0 * np.pi)
    t_phi = t * phi
    he3_phi = (t2 - 3.0) * t_phi
    profile = ndtr(t) - kurtosis * he3_phi
    slope = (t2 * (t2 - 6.0) + 3.0) * kurtosis  # of the profile
    slope += 1.0
    slope *= phi
    light = fall * e
    light += 1.0
    blur_phi = blur * phi
    dark = x[:, 4:5] * u + x[:, 3:4]
    step = (x[:, 6:7] - x[:, 4:5]) * u + (x[:, 5:6] - x[:, 3:4])
    jacobian = np.empty((len(u), PARAMETERS, u.shape[1]))
    by_offset, by_slope, by_blur, low, low_u, high, high_u, by_fall, by_kurtosis = jacobian.swapaxes(0, 1)
    # Shares of the two levels: they add up to the light that falls on the pixel.
    np.multiply(light, profile, out=high)
    high += fall * blur_phi
    np.subtract(light, high, out=low)
    np.multiply(low, u, out=low_u)
    np.multiply(high, u, out=high_u)
    # d high / d e = fall (P - t phi) + light P' / s;  d high / d log s = -P' t light + fall s phi (1 + t^2)
    slope *= light
    np.subtract(t_phi, profile, out=by_offset)
    by_offset *= fall
    by_offset -= slope / blur
    by_offset *= step
    by_offset -= fall * dark
    np.multiply(by_offset, u, out=by_slope)
    t2 += 1.0
    t2 *= blur_phi
    t2 *= fall
    np.multiply(slope, t, out=by_blur)
    np.subtract(t2, by_blur, out=by_blur)
    by_blur *= step
    np.multiply(e, profile, out=by_fall)
    by_fall += blur_phi
    by_fall *= step
    by_fall += e * dark
    np.multiply(light, he3_phi, out=by_kurtosis)
    by_kurtosis *= -step
    return dark * light + step * high, jacobian


def _seen(light: FloatArray, by_light: FloatArray, exponent: float) -> tuple[FloatArray, FloatArray]:
    """Grey levels (n, p) of light (n, p), 255 (light / 255)^exponent; and their Jacobian (n, k, p), by the light's,
    which is overwritten."""
    if exponent == 1.0:
        return light, by_light
    share = np.maximum(light, 0.5) / WHITE
    grey = WHITE * share**exponent
    by_light *= (exponent / WHITE * grey / share)[:, None]
    return grey, by_light


@dataclass(frozen=True, slots=True, eq=False)
class _Optimum:
    """Parameters (n, 9) at the optimum, with grey levels, residuals, weights (n, p) and Jacobian (n, 9, p) there, and
    the inverse variances (n, 9) of the priors."""

    x: FloatArray
    grey: FloatArray
    residual: FloatArray
    weight: FloatArray
    jacobian: FloatArray
    prior: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _BandFit:
    """Parameters (n, 9), inverse normal matrix (n, 9, 9), pixel noise sigma (n,); by the response's exponent: what one
    Gauss-Newton step would change of it (n,), and its information (n,); and how far apart odd and even lines have the
    edge (n,) px, 0 where that may be noise."""

    x: FloatArray
    inverse_normal: FloatArray
    sigma: FloatArray
    exponent_step: FloatArray
    exponent_information: FloatArray
    between_fields: FloatArray


def _fit_band(
    band: EdgePixels,
    start: FloatArray,
    iterations: int,
    tolerance_px: float,
    fall_off_sigma: float,
    near: bool,
    exponent: float = 1.0,
) -> _Optimum:
    """The edges by Levenberg-Marquardt, for a camera with this response."""
    x = start.copy()
    contrast = np.maximum(np.abs(x[:, 5] - x[:, 3]), MIN_CONTRAST)
    # Priors: inverse variances about the start.
    prior = np.zeros_like(x)
    prior[:, 2] = LOG_BLUR_SIGMA**-2
    prior[:, 4] = prior[:, 6] = (LEVEL_SLOPE_SIGMA * contrast) ** -2.0
    prior[:, 7] = fall_off_sigma**-2
    prior[:, 8] = KURTOSIS_SIGMA**-2
    centre = np.zeros_like(x)
    centre[:, [2, 7]] = x[:, [2, 7]]
    diagonal = np.arange(PARAMETERS)

    bins = np.clip((0.5 * BINS * (band.u + 1.0)).astype(np.intp), 0, BINS - 1) + BINS * np.arange(len(x))[:, None]
    bins[~band.used] = BINS * len(x)
    weight = band.used.astype(np.float64)
    sigma = 0.1 * contrast
    damping = np.full(len(x), 1e-3)
    grey, jacobian = _seen(*_step_model(band, x), exponent)
    residual = band.grey - grey
    cost = np.full(len(x), np.inf)
    for iteration in range(iterations):
        if iteration == 0 or near or iteration >= REWEIGH_AT:
            if iteration > 0 or near:
                # Down-weight outlier pixels (a speck, a glint).
                sigma = _typical(residual, band.used, jacobian[:, 0])
                weight = band.used / (1.0 + np.square(np.square(residual / (4.0 * sigma[:, None]))))
                if near:
                    weight *= _clean_bins(weight, bins)
            cost = np.sum(weight * residual**2, axis=1) / sigma**2 + np.sum(prior * (x - centre) ** 2, axis=1)
        jw = jacobian * (weight / sigma[:, None] ** 2)[:, None]
        normal = jw @ np.swapaxes(jacobian, 1, 2)
        normal[:, diagonal, diagonal] += prior
        gradient = (jw @ residual[..., None])[..., 0] - prior * (x - centre)
        damped = normal.copy()
        damped[:, diagonal, diagonal] *= 1.0 + damping[:, None]
        damped[:, diagonal, diagonal] += 1e-9
        step = np.linalg.solve(damped, gradient[..., None])[..., 0]
        step[:, 2] = np.clip(step[:, 2], -0.5, 0.5)
        y = x + step
        y[:, 2] = np.clip(y[:, 2], np.log(0.2), np.log(2.0 * MAX_BLUR_PX))
        y[:, 8] = np.clip(y[:, 8], -MAX_KURTOSIS, MAX_KURTOSIS)
        new_grey, new_jacobian = _seen(*_step_model(band, y), exponent)
        new_residual = band.grey - new_grey
        new_cost = np.sum(weight * new_residual**2, axis=1) / sigma**2 + np.sum(prior * (y - centre) ** 2, axis=1)
        better = new_cost <= cost
        damping = np.where(better, damping * 0.1, damping * 10.0)
        if better.all():
            x, cost, residual, jacobian, grey = y, new_cost, new_residual, new_jacobian, new_grey
        else:
            x[better], cost[better] = y[better], new_cost[better]
            residual[better], jacobian[better] = new_residual[better], new_jacobian[better]
            grey[better] = new_grey[better]
        if iteration > (0 if near else REWEIGH_AT) and np.abs(step[:, :2]).max() < tolerance_px:
            break
    return _Optimum(x, grey, residual, weight, jacobian, prior)


def _fit_at(band: EdgePixels, at: _Optimum) -> _BandFit:
    """The fit at an optimum for a camera that is linear."""
    residual, weight, jacobian, diagonal = at.residual, at.weight, at.jacobian, np.arange(PARAMETERS)
    sigma = _spread(residual, weight, weight)
    normal = (jacobian * (weight / sigma[:, None] ** 2)[:, None]) @ np.swapaxes(jacobian, 1, 2)
    normal[:, diagonal, diagonal] += at.prior + 1e-9
    inverse_normal = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    # The exponent as one more parameter of each edge: the Schur complement of the others.
    by_exponent = at.grey * np.log(np.clip(at.grey / WHITE, 1e-3, 1.0))
    weighed = by_exponent * weight / sigma[:, None] ** 2
    others = (inverse_normal @ (jacobian @ weighed[..., None]))[..., 0]
    left = by_exponent - (others[:, None] @ jacobian)[:, 0]
    information = np.sum(weighed * left, axis=1)
    gradient = np.sum(left * weight / sigma[:, None] ** 2 * residual, axis=1)
    step = gradient / np.maximum(information, 1e-9)
    return _BandFit(
        at.x,
        inverse_normal,
        sigma,
        step,
        information,
        _between_fields(band, residual, jacobian[:, 0], weight),
    )


def _between_fields(band: EdgePixels, residual: FloatArray, by_offset: FloatArray, weight: FloatArray) -> FloatArray:
    """Distance (n,) px of an edge on odd lines from that on even ones: interlaced video of something that moved."""
    offset, variance = [], []
    for lines in (band.odd, ~band.odd):
        information = np.maximum(np.sum(weight * lines * by_offset**2, axis=1), 1e-6)
        offset.append(np.sum(weight * lines * by_offset * residual, axis=1) / information)
        mean = np.where(lines, residual - by_offset * offset[-1][:, None], 0.0)
        variance.append(np.sum(weight * by_offset**2 * mean**2, axis=1) / information**2)
    apart = np.abs(offset[0] - offset[1])
    return np.where(apart > 4.0 * np.sqrt(variance[0] + variance[1]), apart, 0.0)


def _asked_exponent(fit: _BandFit, near: BoolArray) -> tuple[float, float]:
    """The response's exponent that edges ask for which were fitted with 1, and its sigma."""
    light = np.clip(fit.x[near][:, [3, 5]], 1.0, WHITE)
    ratio = np.maximum(np.log(light[:, 1] / light[:, 0]) / np.log(FULL_RATIO), 0.02)
    variance = 1.0 / np.maximum(fit.exponent_information[near], 1e-6) + (EDGE_ERROR / ratio) ** 2
    asked = np.clip(1.0 + fit.exponent_step[near], LEAST_EXPONENT, MOST_EXPONENT)
    mean, weight = float(np.median(asked)), 1.0 / variance
    for _ in range(5):  # Huber: a spot on an edge asks for anything
        size = np.abs(asked - mean) / np.sqrt(variance)
        weight = np.minimum(1.0, 1.5 / np.maximum(size, 1e-9)) / variance
        mean = float(weight @ asked / weight.sum())
    contrast = np.maximum(light[:, 1] - light[:, 0], MIN_CONTRAST)
    common = np.hypot(COMMON_ERROR[0], COMMON_ERROR[1] * np.median(fit.sigma[near] / contrast)) / np.median(ratio)
    return mean, float(np.hypot(weight.sum() ** -0.5, common))


def _by_response(band: EdgePixels, linear: _BandFit, near: BoolArray) -> FloatArray:
    """One sigma (n,) px of o, one error for all edges, because the camera's response to light is not known.

    The edges are fitted for a camera that is linear. One that has about video's response makes dark squares smaller
    and skews the blur: that gives the odds of these two hypotheses, equal before; a second fit says how far apart
    they are.
    """
    nothing = np.zeros(len(linear.x))
    if not near.any():
        return nothing
    asked, sigma = _asked_exponent(linear, near)
    spread = np.hypot(sigma, VIDEO_SIGMA)
    log_odds = (
        0.5 * ((asked - 1.0) / sigma) ** 2 + np.log(sigma) - 0.5 * ((asked - VIDEO) / spread) ** 2 - np.log(spread)
    )
    video_odds = float(1.0 / (1.0 + np.exp(-np.clip(log_odds, -50.0, 50.0))))
    if video_odds < CLEARLY_LINEAR:
        return nothing
    start = linear.x.copy()
    start[:, [3, 5]] = WHITE * (np.clip(linear.x[:, [3, 5]], 0.5, WHITE) / WHITE) ** (1.0 / VIDEO)
    start[:, [4, 6]] = 0.0
    video = _fit_band(band, start, RESPONSE_STEPS, 1e-3, FALL_OFF_COMMON_SIGMA, near=True, exponent=VIDEO)
    return np.asarray(np.sqrt(video_odds) * np.abs(video.x[:, 0] - linear.x[:, 0]))


def _clean_bins(weight: FloatArray, bins: IntArray) -> BoolArray:
    """Whether a pixel (n, p) lies where the whole width of the edge is as modelled: a spot spoils what is across it."""
    total = np.bincount(bins.ravel(), weight.ravel(), minlength=bins.max() + 1)
    count = np.bincount(bins.ravel(), minlength=bins.max() + 1)
    return np.asarray((total >= CLEAN_SHARE * count)[bins])


def _typical(residual: FloatArray, used: BoolArray, by_offset: FloatArray) -> FloatArray:
    """Standard deviation (n,) of the pixels about the model where it falls or rises, half of which may be outliers."""
    size = np.abs(by_offset)
    chosen = used & (size > STEEP * (size * used).max(axis=1, keepdims=True))
    out = [_median(np.abs(row[steep])) for row, steep in zip(residual, chosen, strict=True)]
    return np.maximum(np.array(out) / MEDIAN_SIGMAS, 0.3)


def _median(values: FloatArray) -> float:
    """As ``numpy.median`` of finite values, at a third of its time; 0 of none."""
    count = len(values)
    if not count:
        return 0.0
    middle = count // 2
    if count % 2:
        return float(np.partition(values, middle)[middle])
    parted = np.partition(values, (middle - 1, middle))
    return float(0.5 * (parted[middle - 1] + parted[middle]))


def _spread(residual: FloatArray, weight: FloatArray, counted: FloatArray) -> FloatArray:
    """Standard deviation (n,) of the pixels about the model, at least that of rounding to whole grey levels."""
    dof = np.maximum(counted.sum(axis=1) - PARAMETERS, 1.0)
    return np.asarray(np.maximum(np.sqrt(np.sum(weight * residual**2, axis=1) / dof), 0.3))


def _sections_seen(band: EdgePixels, x: FloatArray, reach: FloatArray, margin_px: FloatArray) -> IntArray:
    """Number (n,) of sections of |u| < reach (n,) with pixels beyond ``margin_px`` (n,) on both sides."""
    e = band.d - x[:, :1] - x[:, 1:2] * band.u
    section = np.floor((band.u / reach[:, None] + 1.0) * (SECTIONS / 2)).astype(np.intp)
    seen = np.zeros((len(x), SECTIONS), dtype=np.int64)
    edge = np.broadcast_to(np.arange(len(x))[:, None], e.shape)
    for bit, side in ((1, e > margin_px[:, None]), (2, e < -margin_px[:, None])):
        chosen = band.used & side & (section >= 0) & (section < SECTIONS)
        present = np.zeros((len(x), SECTIONS), dtype=bool)
        present[edge[chosen], section[chosen]] = True
        seen += bit * present
    return np.asarray((seen == 3).sum(axis=1))


def _first_guess(band: EdgePixels, half_width: FloatArray, blur_px: FloatArray) -> FloatArray:
    """Levels from the outer thirds of the band, no offset, a wide blur."""
    x = np.zeros((len(band.d), PARAMETERS))
    x[:, 2] = np.log(blur_px)
    for k, side in ((3, -1.0), (5, 1.0)):
        share = band.used & (side * band.d > 0.5 * half_width[:, None])
        x[:, k] = [_median(grey[chosen]) for grey, chosen in zip(band.grey, share, strict=True)]
    return x


def _locate(
    camera: CameraModel, image: GreyImage, start: FloatArray, end: FloatArray, cell_px: FloatArray, widest_px: float
) -> tuple[FloatArray, BoolArray, FloatArray]:
    """First pass: (parameters (n, 9), whether an edge is near (n,), light less dark level about the start (n,))."""
    half_width = np.clip(0.55 * cell_px, 2.0, widest_px)
    trim = np.clip(0.12 * np.linalg.norm(end - start, axis=1), 2.0, 12.0)
    band = edge_pixels(camera, image, start, end, half_width, trim, 40)
    guess = _first_guess(band, half_width, np.clip(0.35 * half_width, 0.8, 0.3 * widest_px))
    x = _fit_band(band, guess, 10, 0.02, FALL_OFF_SIGMA, near=False).x
    near = (np.abs(x[:, 0]) + np.abs(x[:, 1]) < half_width) & (x[:, 5] - x[:, 3] > MIN_CONTRAST)
    near &= np.exp(x[:, 2]) < MAX_BLUR_PX
    return np.where(near[:, None], x, guess), near, guess[:, 5] - guess[:, 3]


def fit_edges(
    camera: CameraModel, image: GreyImage, start: FloatArray, end: FloatArray, cell_px: FloatArray
) -> EdgeFit:
    """Find the sides of black squares near starting segments, dark on the right of their direction as drawn (y down).

    Args:
        image: (h, w).
        start, end: (n, 2) ideal px, the four sides of a square in turn, within about half of ``cell_px`` (and 15 px) of
            the true corners.
        cell_px: (n,) width of the dark band along the edge: limits the pixels used on either side.
    """
    length = np.linalg.norm(end - start, axis=1)
    x, near, step = _locate(camera, image, start, end, cell_px, 8.0)
    far = np.flatnonzero(~near & (cell_px > 15.0))
    if far.size:
        # The detector may have found the inner outline of a thick border, up to about ten pixels inside.
        shift = np.minimum(0.3 * cell_px[far], 6.0)
        _, _, normal, _ = segment_frames(start[far], end[far])
        outward = shift[:, None] * normal
        x[far], near[far], _ = _locate(camera, image, start[far] + outward, end[far] + outward, cell_px[far], 18.0)
        x[far, 0] += shift

    # Second pass: about the line found, with a width that fits its blur.
    _, _, normal, _ = segment_frames(start, end)
    start2 = start + (x[:, 0] - x[:, 1])[:, None] * normal
    end2 = end + (x[:, 0] + x[:, 1])[:, None] * normal
    blur = np.exp(x[:, 2])
    # Not so wide that the next cell's blur reaches in.
    half_width2 = np.clip(3.0 * blur + 1.5, 2.0, np.clip(cell_px - 3.5 * blur, 2.0, 14.0))
    trim2 = np.clip(3.0 * blur + 1.0, 2.0, 0.25 * length)
    band = edge_pixels(camera, image, start2, end2, half_width2, trim2, MAX_ROWS)
    # Opposite edges look opposite ways: what their g have in common is a misfit of the blur, not light.
    x[:, 7] = 0.5 * (x[:, 7] - x[:, 7].reshape(-1, 2, 2)[:, ::-1].ravel())
    x[:, [0, 1, 8]] = 0.0
    x[:, 2] = np.log(np.clip(blur, 0.4, MAX_BLUR_PX))
    fit = _fit_at(band, _fit_band(band, x, 8, 1e-3, FALL_OFF_COMMON_SIGMA, near=True))
    by_response = _by_response(band, fit, near)
    cut = np.sum(band.used & (band.grey >= CUT_OFF), axis=1) > CUT_SHARE * np.sum(band.used, axis=1)
    by_response = np.hypot(by_response, OVEREXPOSED * cut * np.exp(fit.x[:, 2]))
    x, inverse_normal, sigma = fit.x, fit.inverse_normal, fit.sigma

    # Back to the starting segments' frame: they differ by the small rotation of the first pass.
    middle, direction, _, half_length = segment_frames(start, end)
    _, _, normal2, _ = segment_frames(start2, end2)
    ends = np.stack([start2 + (x[:, 0] - x[:, 1])[:, None] * normal2, end2 + (x[:, 0] + x[:, 1])[:, None] * normal2], 1)
    relative = ends - middle[:, None]
    place = np.einsum("eki,ei->ek", relative, direction) / half_length[:, None]
    height = np.einsum("eki,ei->ek", relative, normal)
    slope = (height[:, 1] - height[:, 0]) / (place[:, 1] - place[:, 0])
    line = np.stack([height[:, 0] - slope * place[:, 0], slope], axis=1)

    blur = np.exp(x[:, 2])
    contrast = np.minimum(x[:, 5], WHITE) - x[:, 3]
    sections = _sections_seen(band, x, 1.0 - 2.0 * trim2 / length, np.minimum(blur, 0.4 * half_width2))
    good = (
        near
        & (contrast > np.maximum(MIN_CONTRAST, 4.0 * sigma))
        & (blur < MAX_BLUR_PX)
        & (sections >= MIN_SECTIONS)
        & (np.abs(x[:, 0]) + np.abs(x[:, 1]) < 1.5)
    )
    covariance = inverse_normal[:, :2, :2] + np.square(COMBED * fit.between_fields)[:, None, None] * np.eye(2)
    covariance[:, 0, 0] += np.square(VEIL * blur * np.clip(x[:, 3] / np.maximum(x[:, 5], 1.0), 0.0, 1.0) ** 2)
    return EdgeFit(line=line, covariance=covariance, blur_px=blur, step=step, good=good, by_response=by_response)
