"""The tissue surface as a table: where a beam with no PM heard will end, at camera rate.

The Gaussian process of fgreg.surface costs the square of its number of PMs for every place asked about. It is smooth
(over 15 mm), so a table of its height and sigma every few millimetres, read with cubic interpolation, says the same to
some micrometres at a fixed cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.frames import FloatArray
from fgreg.surface import GRAZING, LONGEST_MM, REACH_MM, TissueSurface

NODES = 40
"""Nodes of the table a side."""
MARGIN_MM = 30.0
"""How far beyond the PMs the table reaches; farther out the surface is its trend, give or take its relief."""
ALONG = np.linspace(1.0, 200.0, 81)
"""Distances (mm) along a ray at which it is compared with the surface; cubic interpolation in between."""
_SPACING = float(ALONG[1] - ALONG[0])
_CUBIC = (
    np.array(
        [[0.0, 6.0, 0.0, 0.0], [-2.0, -3.0, 6.0, -1.0], [3.0, -6.0, 3.0, 0.0], [-1.0, 3.0, -3.0, 1.0]], dtype=np.float64
    )
    / 6.0
)
"""Row k: what t^k adds to the weights of the nodes -1, 0, 1, 2 for a place t in [0, 1) (Lagrange)."""
_STENCIL = (np.arange(4)[:, None] * NODES + np.arange(4)).ravel()


@dataclass(frozen=True, slots=True, eq=False)
class Meeting:
    """A ray's end: distance along it (mm), point (3,) in TRUS, unit normal (3,), sigma of ``normal @ point``."""

    distance_mm: float
    trus_p: FloatArray
    normal: FloatArray
    sigma_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceMap:
    """Heights over a plane in TRUS, mm.

    Attributes:
        axes, centre, place: those of the :class:`TissueSurface`: (3, 3), (3,), (n, 2).
        trend: (3,) plane over (1, u, v). far_variance: (3, 3) quadratic form over (1, u, v): the variance far out.
        origin, spacing: (2,) of the table's nodes.
        table: (NODES, NODES, 2) height less trend, and sigma.
    """

    axes: FloatArray
    centre: FloatArray
    place: FloatArray
    trend: FloatArray
    far_variance: FloatArray
    origin: FloatArray
    spacing: FloatArray
    table: FloatArray

    def meet(self, trus_p: FloatArray, trus_d: FloatArray) -> Meeting | None:
        """Where a ray from (3,) along the unit vector (3,) first meets the surface; None where that is not known.

        It may miss the surface, graze it, or meet it farther than ``REACH_MM`` from all PMs.
        """
        start, step = (trus_p - self.centre) @ self.axes, trus_d @ self.axes
        gap, sigma = self._gap(start, step)
        above, beyond = gap + 2.0 * sigma, gap - 2.0 * sigma
        crossing = _first_rise(gap)
        end = _first_rise(beyond)
        # From where it may have met the surface to where it must have: long where the ray grazes it or comes near it
        # twice.
        begin = float(ALONG[0]) if above[0] > 0.0 else _first_rise(above)
        if crossing is None or end is None or begin is None or end < crossing or beyond[0] > 0.0:
            return None
        stretch = end - begin
        if stretch > LONGEST_MM:
            return None
        at = start + crossing * step
        if float(np.min(np.sum((self.place - at[:2]) ** 2, axis=1))) > REACH_MM**2:
            return None
        slope_u, slope_v = self._slope(float(at[0]), float(at[1]))
        normal = self.axes @ np.array([-slope_u, -slope_v, 1.0])
        normal = normal / float(np.sqrt(normal @ normal))
        towards = float(normal @ trus_d)
        if towards < GRAZING:
            return None
        return Meeting(crossing, trus_p + crossing * trus_d, normal, stretch / 4.0 * towards)

    def _gap(self, start: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How far the ray's points at ``ALONG`` are below the surface (n,), and the sigma of its height there (n,)."""
        points = start + ALONG[:, None] * step
        gap = points[:, 2] - self.trend[0] - points[:, :2] @ self.trend[1:]
        place = (points[:, :2] - self.origin) / self.spacing
        node = place.astype(np.int64)
        # The stencil needs a node before and two after.
        inside = np.flatnonzero(((node >= 1) & (node <= NODES - 3)).all(axis=1))
        sigma = np.empty(len(ALONG))
        if len(inside) < len(ALONG):
            far = points.copy()
            far[:, 2] = 1.0
            far = far[:, [2, 0, 1]]
            sigma = np.sqrt(np.sum((far @ self.far_variance) * far, axis=1))
        if len(inside):
            node = node[inside]
            t = place[inside] - node
            power = np.empty((len(inside), 2, 4))
            power[..., 0], power[..., 1] = 1.0, t
            power[..., 2] = t * t
            power[..., 3] = power[..., 2] * t
            weight = power @ _CUBIC
            weights = (weight[:, 0, :, None] * weight[:, 1, None, :]).reshape(-1, 1, 16)
            nodes = ((node[:, 0] - 1) * NODES + node[:, 1] - 1)[:, None] + _STENCIL
            value = (weights @ self.table.reshape(-1, 2)[nodes])[:, 0]
            gap[inside] -= value[:, 0]
            sigma[inside] = np.abs(value[:, 1])
        return gap, sigma

    def _slope(self, u: float, v: float) -> tuple[float, float]:
        """Derivatives of the height by u and v at a place inside the table."""
        i, s = _node((u - float(self.origin[0])) / float(self.spacing[0]))
        j, t = _node((v - float(self.origin[1])) / float(self.spacing[1]))
        block = self.table[i - 1 : i + 3, j - 1 : j + 3, 0]
        weight_u, weight_v = np.array([1.0, s, s * s, s**3]) @ _CUBIC, np.array([1.0, t, t * t, t**3]) @ _CUBIC
        rate_u = np.array([0.0, 1.0, 2.0 * s, 3.0 * s * s]) @ _CUBIC
        rate_v = np.array([0.0, 1.0, 2.0 * t, 3.0 * t * t]) @ _CUBIC
        by_v = block @ weight_v
        slope_u = float(self.trend[1]) + float(rate_u @ by_v) / float(self.spacing[0])
        slope_v = float(self.trend[2]) + float(weight_u @ (block @ rate_v)) / float(self.spacing[1])
        return slope_u, slope_v


def _node(place: float) -> tuple[int, float]:
    i = min(max(int(place), 1), NODES - 3)
    return i, place - i


def _first_rise(values: FloatArray) -> float | None:
    """The first distance at which values at ``ALONG`` rise through zero."""
    positive = values >= 0.0
    rises = np.flatnonzero(positive[1:] & ~positive[:-1])
    if not len(rises):
        return None
    i = int(rises[0])
    first = min(max(i - 1, 0), len(ALONG) - 4)
    a, b, c, d = values[first : first + 4].tolist()
    low, high = float(i - first), float(i - first + 1)
    # The cubic through four samples, by regula falsi (Illinois): it stays within the bracket.
    below, over = (a, b, c, d)[i - first], (a, b, c, d)[i - first + 1]
    t = low
    for _ in range(8):
        t = (low * over - high * below) / (over - below)
        value = (
            -a * (t - 1.0) * (t - 2.0) * (t - 3.0) / 6.0
            + b * t * (t - 2.0) * (t - 3.0) / 2.0
            - c * t * (t - 1.0) * (t - 3.0) / 2.0
            + d * t * (t - 1.0) * (t - 2.0) / 6.0
        )
        if abs(value) < 1e-6:
            break
        if value >= 0.0:
            high, over, below = t, value, 0.5 * below
        else:
            low, below, over = t, value, 0.5 * over
    return float(ALONG[first]) + t * _SPACING


def make_surface_map(surface: TissueSurface) -> SurfaceMap:
    """The table of a surface. Takes some milliseconds: make it anew only where the surface changes."""
    low, high = surface.place.min(axis=0) - MARGIN_MM, surface.place.max(axis=0) + MARGIN_MM
    spacing = (high - low) / (NODES - 1)
    u, v = np.meshgrid(low[0] + spacing[0] * np.arange(NODES), low[1] + spacing[1] * np.arange(NODES), indexing="ij")
    place = np.column_stack([u.ravel(), v.ravel()])
    height, sigma = surface.height(place)
    height = height - surface.trend[0] - place @ surface.trend[1:]
    far = surface.trend_covariance.copy()
    far[0, 0] += surface.relief_mm**2
    return SurfaceMap(
        axes=surface.axes,
        centre=surface.centre,
        place=surface.place,
        trend=surface.trend,
        far_variance=surface.inflation**2 * far,
        origin=low,
        spacing=spacing,
        table=np.stack([height, sigma], axis=-1).reshape(NODES, NODES, 2),
    )
