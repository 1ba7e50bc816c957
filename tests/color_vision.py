"""How colour-blind people see colours: Machado, Oliveira and Fernandes (2009), severity 1, on linear sRGB."""

from __future__ import annotations

import numpy as np

from fgreg.geometry.transforms import FloatArray

SEEN = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
}


def linear(color: tuple[int, int, int]) -> FloatArray:
    """(3,) linear sRGB, 0 to 1, of a colour."""
    value = np.asarray(color) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def contrast(first: tuple[int, int, int], second: tuple[int, int, int]) -> float:
    """Contrast ratio of two colours as WCAG defines it, 1 to 21."""
    low, high = sorted(float(np.array([0.2126, 0.7152, 0.0722]) @ linear(color)) for color in (first, second))
    return (high + 0.05) / (low + 0.05)


def difference(first: tuple[int, int, int], second: tuple[int, int, int], seen: str) -> float:
    """CIE 1976 distance of two colours in L*a*b* (just noticeable: 2.3), as they are ``seen``."""
    return float(np.linalg.norm(_lab(first, SEEN[seen]) - _lab(second, SEEN[seen])))


def _lab(color: tuple[int, int, int], seen: FloatArray) -> FloatArray:
    rgb = np.clip(seen @ linear(color), 0.0, 1.0)
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ rgb
    xyz = xyz / [0.9505, 1.0, 1.089]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16.0 / 116.0)
    return np.array([116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])])
