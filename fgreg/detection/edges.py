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

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgreg.detection.edge_pixels import EdgePixels, GreyImage, PixelArray, edge_pixels, segment_frames
from fgreg.detection.step_fit import (
    AGAIN,
    FIRST,
    MAX_BLUR_PX,
    MIN_CONTRAST,
    SECOND,
    WITH_RESPONSE,
    Optimum,
    column,
    fit_steps,
    median,
    normal_equations,
    sum_of_squares,
)
from fgreg.detection.step_model import PARAMETERS, WHITE
from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray
from fgreg.model.camera_model import CameraModel

FIRST_ROWS, MAX_ROWS = 44, 120
"""Most pixel rows used across an edge in the first pass and in the second; longer edges are sampled evenly."""
SECTIONS, MIN_SECTIONS = 8, 6
"""Parts of an edge, and the number of parts in which both sides must be in the image."""
CUT_OFF = 254.5
"""Grey level from which a pixel may be brighter than it says."""
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
SAME_PLACE_PX = 1.0
"""An edge that is this far from where the last picture had it, beside its starting segment, is looked for as a new one.
"""
RESPONSE_PIXELS = 4
"""One pixel in this many is used for it."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeStart:
    """What a fit found that the fit of the same edges in the next picture may start with.

    Attributes:
        parameters: (n, 9) of the step, light and blur included, about the starting segment.
        response: (n,) one sigma of o by the camera's response, in blurs.
    """

    parameters: FloatArray
    response: FloatArray

    def of_squares(self) -> list[EdgeStart]:
        """Of each square, four edges."""
        return [
            EdgeStart(self.parameters[k : k + 4], self.response[k : k + 4]) for k in range(0, len(self.response), 4)
        ]

    @staticmethod
    def joined(parts: Sequence[EdgeStart]) -> EdgeStart:
        """Of all edges of some squares."""
        return EdgeStart(np.concatenate([p.parameters for p in parts]), np.concatenate([p.response for p in parts]))


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
        again: where to start in the next picture.
    """

    line: FloatArray
    covariance: FloatArray
    blur_px: FloatArray
    step: FloatArray
    good: BoolArray
    by_response: FloatArray
    again: EdgeStart


@dataclass(frozen=True, slots=True, eq=False)
class _BandFit:
    """Parameters (n, 9), inverse normal matrix (n, 9, 9), pixel noise sigma (n,); and how far apart odd and even lines
    have the edge (n,) px, 0 where that may be noise."""

    x: FloatArray
    inverse_normal: FloatArray
    sigma: FloatArray
    between_fields: FloatArray


def _fit_at(band: EdgePixels, at: Optimum) -> _BandFit:
    """The fit at an optimum for a camera that is linear."""
    residual, weight, jacobian = at.residual, at.weight, at.jacobian
    sigma = _spread(residual, weight)
    normal, _ = normal_equations(jacobian, weight * column(sigma**-2.0, weight), residual)
    normal += (at.prior + 1e-9)[..., None] * np.eye(PARAMETERS)
    inverse_normal = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    return _BandFit(at.x, inverse_normal, sigma, _between_fields(band, residual, jacobian[:, 0], weight))


def _exponent_step(at: Optimum, fit: _BandFit) -> tuple[FloatArray, FloatArray]:
    """What one Gauss-Newton step would change of the response's exponent (n,), and its information (n,).

    It is one more parameter of each edge: the Schur complement of the others.
    """
    by_exponent = at.grey * np.log(np.clip(at.grey / WHITE, 1e-3, 1.0))
    weighed = by_exponent * at.weight * column(fit.sigma**-2.0, at.weight)
    others = fit.inverse_normal @ (at.jacobian @ weighed[..., None])
    left = by_exponent - (others[..., 0].astype(at.grey.dtype)[:, None] @ at.jacobian)[:, 0]
    information = np.vecdot(weighed, left).astype(np.float64)
    left *= at.weight * column(fit.sigma**-2.0, at.weight)
    return np.vecdot(left, at.residual) / np.maximum(information, 1e-9), information


def _between_fields(band: EdgePixels, residual: PixelArray, by_offset: PixelArray, weight: PixelArray) -> FloatArray:
    """Distance (n,) px of an edge on odd lines from that on even ones: interlaced video of something that moved."""
    offset, variance = [], []
    for lines in (band.odd, ~band.odd):
        weighed = weight * by_offset * lines
        information = np.maximum(np.vecdot(weighed, by_offset), 1e-6)
        offset.append(np.vecdot(weighed, residual) / information)
        rest = residual - by_offset * offset[-1][:, None]
        variance.append(np.vecdot(weighed * by_offset, np.square(rest)) / information**2)
    apart = np.abs(offset[0] - offset[1])
    return np.where(apart > 4.0 * np.sqrt(variance[0] + variance[1]), apart, 0.0).astype(np.float64)


def _asked_exponent(at: Optimum, fit: _BandFit, near: BoolArray) -> tuple[float, float]:
    """The response's exponent that edges ask for which were fitted with 1, and its sigma."""
    light = np.clip(fit.x[near][:, [3, 5]], 1.0, WHITE)
    ratio = np.maximum(np.log(light[:, 1] / light[:, 0]) / np.log(FULL_RATIO), 0.02)
    step, information = _exponent_step(at, fit)
    variance = 1.0 / np.maximum(information[near], 1e-6) + (EDGE_ERROR / ratio) ** 2
    asked = np.clip(1.0 + step[near], LEAST_EXPONENT, MOST_EXPONENT)
    mean, weight = float(np.median(asked)), 1.0 / variance
    for _ in range(5):  # Huber: a spot on an edge asks for anything
        size = np.abs(asked - mean) / np.sqrt(variance)
        weight = np.minimum(1.0, 1.5 / np.maximum(size, 1e-9)) / variance
        mean = float(weight @ asked / weight.sum())
    contrast = np.maximum(light[:, 1] - light[:, 0], MIN_CONTRAST)
    common = np.hypot(COMMON_ERROR[0], COMMON_ERROR[1] * np.median(fit.sigma[near] / contrast)) / np.median(ratio)
    return mean, float(np.hypot(weight.sum() ** -0.5, common))


def _response(band: EdgePixels, at: Optimum, linear: _BandFit, near: BoolArray) -> FloatArray:
    """One sigma (n,) of o in blurs, one error for all edges, because the camera's response to light is not known.

    The edges are fitted for a camera that is linear. One that has about video's response makes dark squares smaller
    and skews the blur: that gives the odds of these two hypotheses, equal before; a second fit says how far apart
    they are.
    """
    nothing = np.zeros(len(linear.x))
    if not near.any():
        return nothing
    asked, sigma = _asked_exponent(at, linear, near)
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
    video = fit_steps(band.some(RESPONSE_PIXELS), start, WITH_RESPONSE, exponent=VIDEO)
    return np.asarray(np.sqrt(video_odds) * np.abs(video.x[:, 0] - linear.x[:, 0]) * np.exp(-linear.x[:, 2]))


def _spread(residual: PixelArray, weight: PixelArray) -> FloatArray:
    """Standard deviation (n,) of the pixels about the model, at least that of rounding to whole grey levels."""
    dof = np.maximum(weight.sum(axis=1, dtype=np.float64) - PARAMETERS, 1.0)
    return np.asarray(np.maximum(np.sqrt(sum_of_squares(weight, residual) / dof), 0.3))


def _sections_seen(band: EdgePixels, x: FloatArray, reach: FloatArray, margin_px: FloatArray) -> IntArray:
    """Number (n,) of sections of |u| < reach (n,) with pixels beyond ``margin_px`` (n,) on both sides."""
    n = len(x)
    e = band.d - column(x[:, 0], band.d) - column(x[:, 1], band.d) * band.u
    along = (band.u * column(1.0 / reach, band.u) + 1.0) * (SECTIONS / 2)
    within = band.used & (along >= 0.0) & (along < SECTIONS)
    section = along.astype(np.intp) + SECTIONS * np.arange(n)[:, None]
    margin = column(margin_px, e)
    above, below = (np.bincount(section[within & side], minlength=SECTIONS * n) for side in (e > margin, e < -margin))
    return np.asarray(((above > 0) & (below > 0)).reshape(n, SECTIONS).sum(axis=1))


def _first_guess(band: EdgePixels, half_width: FloatArray, blur_px: FloatArray) -> FloatArray:
    """Levels from the outer thirds of the band, no offset, a wide blur."""
    x = np.zeros((len(band.d), PARAMETERS))
    x[:, 2] = np.log(blur_px)
    for k, side in ((3, -1.0), (5, 1.0)):
        share = band.used & (side * band.d > 0.5 * half_width[:, None])
        x[:, k] = [median(grey[chosen]) for grey, chosen in zip(band.grey, share, strict=True)]
    return x


def _locate(
    camera: CameraModel,
    image: GreyImage,
    start: FloatArray,
    end: FloatArray,
    cell_px: FloatArray,
    widest_px: float,
    last: EdgeStart | None = None,
) -> tuple[FloatArray, BoolArray, FloatArray]:
    """First pass: (parameters (n, 9), whether an edge is near (n,), light less dark level about the start (n,))."""
    half_width = np.clip(0.55 * cell_px, 2.0, widest_px)
    trim = np.clip(0.12 * np.linalg.norm(end - start, axis=1), 2.0, 12.0)
    band = edge_pixels(camera, image, start, end, half_width, trim, FIRST_ROWS)
    if last is None:
        guess = _first_guess(band, half_width, np.clip(0.35 * half_width, 0.8, 0.3 * widest_px))
        x = fit_steps(band, guess, FIRST).x
    else:
        guess = last.parameters
        x = fit_steps(band, guess, AGAIN).x
    near = (np.abs(x[:, 0]) + np.abs(x[:, 1]) < half_width) & (x[:, 5] - x[:, 3] > MIN_CONTRAST)
    near &= np.exp(x[:, 2]) < MAX_BLUR_PX
    return np.where(near[:, None], x, guess), near, guess[:, 5] - guess[:, 3]


def fit_edges(
    camera: CameraModel,
    image: GreyImage,
    start: FloatArray,
    end: FloatArray,
    cell_px: FloatArray,
    last: EdgeStart | None = None,
) -> EdgeFit:
    """Find the sides of black squares near starting segments, dark on the right of their direction as drawn (y down).

    Args:
        image: (h, w).
        start, end: (n, 2) ideal px, the four sides of a square in turn, within about half of ``cell_px`` (and 15 px) of
            the true corners.
        cell_px: (n,) width of the dark band along the edge: limits the pixels used on either side.
        last: of the same edges in the last picture, where they were about as far off the segments: a start for the
            first pass, and the camera's response. Where an edge is not found so, all is done without it.
    """
    if last is not None:
        x, near, step = _locate(camera, image, start, end, cell_px, 8.0, last)
        near &= np.abs(x[:, :2] - last.parameters[:, :2]).sum(axis=1) < SAME_PLACE_PX
        if near.all():
            fit = _fit_about(camera, image, start, end, cell_px, x, near, step, last.response)
            if fit.good.all():
                return fit
    x, near, step = _locate(camera, image, start, end, cell_px, 8.0)
    far = np.flatnonzero(~near & (cell_px > 15.0))
    if far.size:
        # The detector may have found the inner outline of a thick border, up to about ten pixels inside.
        shift = np.minimum(0.3 * cell_px[far], 6.0)
        _, _, normal, _ = segment_frames(start[far], end[far])
        outward = shift[:, None] * normal
        x[far], near[far], _ = _locate(camera, image, start[far] + outward, end[far] + outward, cell_px[far], 18.0)
        x[far, 0] += shift

    return _fit_about(camera, image, start, end, cell_px, x, near, step, None)


def _fit_about(
    camera: CameraModel,
    image: GreyImage,
    start: FloatArray,
    end: FloatArray,
    cell_px: FloatArray,
    x: FloatArray,
    near: BoolArray,
    step: FloatArray,
    response: FloatArray | None,
) -> EdgeFit:
    """Second pass: about the lines found, with a width that fits their blur.

    Args:
        x: (n, 9) parameters of the lines.
        near: (n,) which were found. step: (n,) as of :class:`EdgeFit`.
        response: (n,) as of :class:`EdgeStart`; None: to be found out.
    """
    length = np.linalg.norm(end - start, axis=1)
    _, _, normal, _ = segment_frames(start, end)
    start2 = start + (x[:, 0] - x[:, 1])[:, None] * normal
    end2 = end + (x[:, 0] + x[:, 1])[:, None] * normal
    blur = np.exp(x[:, 2])
    # Not so wide that the next cell's blur reaches in.
    half_width = np.clip(3.0 * blur + 1.5, 2.0, np.clip(cell_px - 3.5 * blur, 2.0, 14.0))
    trim = np.clip(3.0 * blur + 1.0, 2.0, 0.25 * length)
    band = edge_pixels(camera, image, start2, end2, half_width, trim, MAX_ROWS)
    x = x.copy()
    x[:, [0, 1, 8]] = 0.0
    x[:, 2] = np.log(np.clip(blur, 0.4, MAX_BLUR_PX))
    # Opposite edges look opposite ways: what their g have in common is a misfit of the blur, not light.
    x[:, 7] = 0.5 * (x[:, 7] - x[:, 7].reshape(-1, 2, 2)[:, ::-1].ravel())
    optimum = fit_steps(band, x, SECOND)
    fit = _fit_at(band, optimum)
    x, inverse_normal, sigma = fit.x, fit.inverse_normal, fit.sigma
    blur = np.exp(x[:, 2])
    if response is None:
        response = _response(band, optimum, fit, near)
    cut = np.sum(band.used & (band.grey >= CUT_OFF), axis=1) > CUT_SHARE * np.sum(band.used, axis=1)
    by_response = np.hypot(response, OVEREXPOSED * cut) * blur

    # Back to the starting segments' frame: they differ by the small rotation of the first pass.
    middle, direction, _, half_length = segment_frames(start, end)
    _, _, normal2, _ = segment_frames(start2, end2)
    ends = np.stack([start2 + (x[:, 0] - x[:, 1])[:, None] * normal2, end2 + (x[:, 0] + x[:, 1])[:, None] * normal2], 1)
    relative = ends - middle[:, None]
    place = np.einsum("eki,ei->ek", relative, direction) / half_length[:, None]
    height = np.einsum("eki,ei->ek", relative, normal)
    slope = (height[:, 1] - height[:, 0]) / (place[:, 1] - place[:, 0])
    line = np.stack([height[:, 0] - slope * place[:, 0], slope], axis=1)

    contrast = np.minimum(x[:, 5], WHITE) - x[:, 3]
    sections = _sections_seen(band, x, 1.0 - 2.0 * trim / length, np.minimum(blur, 0.4 * half_width))
    good = (
        near
        & (contrast > np.maximum(MIN_CONTRAST, 4.0 * sigma))
        & (blur < MAX_BLUR_PX)
        & (sections >= MIN_SECTIONS)
        & (np.abs(x[:, 0]) + np.abs(x[:, 1]) < 1.5)
    )
    covariance = inverse_normal[:, :2, :2] + np.square(COMBED * fit.between_fields)[:, None, None] * np.eye(2)
    covariance[:, 0, 0] += np.square(VEIL * blur * np.clip(x[:, 3] / np.maximum(x[:, 5], 1.0), 0.0, 1.0) ** 2)
    again = EdgeStart(np.column_stack([line, x[:, 2:]]), response)
    return EdgeFit(line, covariance, blur, step, good, by_response, again)
