"""The model of a blurred step between two surfaces (edges.py has its formula), with its Jacobian.

The arrays of pixels may be of single precision: grey levels are told apart to 1e-4, and a step takes a fifth of the
time.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from fgreg.detection.edge_pixels import EdgePixels, PixelArray
from fgreg.geometry.transforms import FloatArray

PARAMETERS = 9
WHITE = 255.0
"""The highest grey level."""


def step_model(band: EdgePixels, x: FloatArray) -> tuple[PixelArray, PixelArray]:
    """Grey levels (n, p) of parameters (n, 9) = (o, m, log s, b0, b1, w0, w1, g, c), and their Jacobian (n, 9, p)."""
    u = band.u
    offset, slant, log_blur, b0, b1, w0, w1, fall, kurtosis = x.astype(u.dtype).T[:, :, None]
    blur = np.exp(log_blur)
    e = band.d - offset - slant * u
    t = e / blur
    t2 = t * t
    phi = np.exp(-0.5 * t2)
    phi *= np.asarray(1.0 / np.sqrt(2.0 * np.pi), dtype=u.dtype)
    t_phi = t * phi
    he3_phi = (t2 - 3.0) * t_phi
    profile = normal_cdf(t, phi) - kurtosis * he3_phi
    slope = (t2 * (t2 - 6.0) + 3.0) * kurtosis  # of the profile
    slope += 1.0
    slope *= phi
    light = fall * e
    light += 1.0
    blur_phi = blur * phi
    dark = b1 * u + b0
    step = (w1 - b1) * u + (w0 - b0)
    jacobian = np.empty((len(u), PARAMETERS, u.shape[1]), dtype=u.dtype)
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


def normal_cdf(t: PixelArray, density: PixelArray) -> PixelArray:
    """The standard normal distribution function at ``t``, where its density is known.

    In single precision to 3e-7, by formula 26.2.17 of Abramowitz and Stegun (1964): a third of the time of ``ndtr``.
    """
    if t.dtype != np.float32:
        return np.asarray(ndtr(t))
    k = np.abs(t)
    k *= np.float32(0.2316419)
    k += np.float32(1.0)
    np.reciprocal(k, out=k)
    tail = k * np.float32(1.330274429)
    for coefficient in (-1.821255978, 1.781477937, -0.356563782, 0.319381530):
        tail += np.float32(coefficient)
        tail *= k
    tail *= density
    return np.asarray(np.where(t > 0.0, np.float32(1.0) - tail, tail))


def seen_levels(light: PixelArray, by_light: PixelArray, exponent: float) -> tuple[PixelArray, PixelArray]:
    """Grey levels (n, p) of light (n, p), 255 (light / 255)^exponent; and their Jacobian (n, k, p), by the light's,
    which is overwritten."""
    if exponent == 1.0:
        return light, by_light
    share = np.maximum(light, 0.5) / WHITE
    grey = WHITE * share**exponent
    by_light *= (exponent / WHITE * grey / share)[:, None]
    return grey, by_light
