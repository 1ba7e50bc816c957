"""The windows' own shapes in the reduced problem: ratio of the rotations' likelihoods to their Gaussian sites.

The reduced problem is Gaussian in each PM's point: every look has a Gaussian *site* on its rotation ``rho``, of
precision ``l`` about ``centre + gain * window_edge``. Without the sites of its PM the rotation has the *cavity*, a
Gaussian of precision ``q = 1 / v - sum l`` (v the variance with them). The actual likelihood is an interval with soft
ends (and the amplitudes' table), so a state's density is multiplied by

    integral of cavity(d) * product of intervals(rho + d) dd  /  integral of cavity(d) * product of sites(rho + d) dd

with d the PM's shift in plane angle, common to its looks: closed form for one look, a quadrature for several.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray
from fgreg.graph.packing import PackedProblem, RotationShapes
from fgreg.model.sensitivity import log_interval

LEAST_PRECISION = 0.1
"""Least precision of a cavity, rad^-2: even without information a PM is within about three radians."""
NODES, WEIGHTS = np.polynomial.legendre.leggauss(24)
REACH = 6.0
"""Range of the quadratures, in sigmas."""


@dataclass(frozen=True, slots=True, eq=False)
class LookGroups:
    """PMs by kind: ``single`` looks (n,) alone at their PM; of the others the PMs (m,), looks (m, K), and a mask."""

    single: IntArray
    pm: IntArray
    looks: IntArray
    there: BoolArray


def group_looks(problem: PackedProblem, shapes: RotationShapes) -> LookGroups:
    """Split PMs into those with the closed form and those that need a quadrature."""
    pms = len(problem.pms)
    count = np.bincount(problem.look_pm, minlength=pms)
    plain = (count == 1) & (shapes.amplitude_look < 0)
    single = np.flatnonzero(plain[problem.look_pm])
    pm = np.flatnonzero(~plain)
    width = int(count[pm].max()) if len(pm) else 0
    looks, there = np.zeros((len(pm), width), dtype=np.int64), np.zeros((len(pm), width), dtype=bool)
    for row, index in enumerate(pm):
        mine = np.flatnonzero(problem.look_pm == index)
        looks[row, : len(mine)], there[row, : len(mine)] = mine, True
    return LookGroups(single, pm, looks, there)


def interval_at(shapes: RotationShapes, edge_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ends (S, L) of the looks' intervals for errors of the half width (S,)."""
    windows = shapes.windows
    low = windows.low_rad + windows.low_gain * edge_rad[:, None]
    high = windows.high_rad + windows.high_gain * edge_rad[:, None]
    return low, np.maximum(high, low + 1e-6)


def log_shape_ratios(
    problem: PackedProblem, edge_rad: FloatArray, offset: FloatArray, variance: FloatArray
) -> FloatArray:
    """(S, J) log ratio of each PM's density with intervals to that with Gaussian sites.

    Args:
        problem: with shapes; its sites are ``looks.weight[:, 2, 2]``, ``looks.centre_rad`` and ``looks.edge_gain``.
        edge_rad: (S,) errors of the half width.
        offset: (S, L) rotations with the sites included, less the sites' expectation.
        variance: (S, L) of the rotations given the shared variables, sites included.
    """
    shapes = problem.shapes
    if shapes is None or not len(problem.look_pm):
        return np.zeros((len(edge_rad), len(problem.pms)))
    groups = group_looks(problem, shapes)
    site = problem.looks.weight[:, 2, 2]
    rotation = offset + problem.looks.centre_rad + problem.looks.edge_gain * edge_rad[:, None]
    low, high = interval_at(shapes, edge_rad)
    soft = shapes.windows.soft_rad
    out = np.zeros((len(edge_rad), len(problem.pms)))
    if len(groups.single):
        i = groups.single
        q = np.maximum(1.0 / variance[:, i] - site[i], LEAST_PRECISION)
        shift = site[i] * offset[:, i] / q  # from the mean with the site to the cavity's mean
        mean = rotation[:, i] + shift
        log = log_interval(low[:, i] - mean, high[:, i] - mean, np.sqrt(1.0 / q + soft[i] ** 2))
        log = log - np.log(high[:, i] - low[:, i])
        log = log + 0.5 * np.log1p(site[i] / q) + 0.5 * (offset[:, i] + shift) ** 2 * site[i] * q / (site[i] + q)
        out[:, problem.look_pm[i]] = log
    if len(groups.pm):
        out[:, groups.pm] = _group_ratio(problem, shapes, groups, offset, rotation, variance, low, high)
    return out


def _group_ratio(
    problem: PackedProblem,
    shapes: RotationShapes,
    groups: LookGroups,
    offset: FloatArray,
    rotation: FloatArray,
    variance: FloatArray,
    low: FloatArray,
    high: FloatArray,
) -> FloatArray:
    """:func:`log_shape_ratios` of PMs with several looks or amplitudes, (S, m)."""
    looks, there = groups.looks, groups.there
    site = np.where(there, problem.looks.weight[looks, 2, 2], 0.0)
    total = site.sum(axis=1)
    q = np.maximum(1.0 / variance[:, looks[:, 0]] - total, LEAST_PRECISION)
    pull = np.sum(site * offset[:, looks], axis=2)
    centre = pull / q
    inside_low = np.where(there, low[:, looks] - rotation[:, looks], -np.inf).max(axis=2)
    inside_high = np.where(there, high[:, looks] - rotation[:, looks], np.inf).min(axis=2)
    soft = shapes.windows.soft_rad[looks]
    margin, sigma = REACH * soft.max(axis=1), 1.0 / np.sqrt(q)
    begin = np.maximum(centre - REACH * sigma, inside_low - margin)
    end = np.minimum(centre + REACH * sigma, inside_high + margin)
    apart = end <= begin  # the looks contradict each other or the rest: use the nearest place
    near = np.clip(centre, np.minimum(inside_low, inside_high) - margin, np.maximum(inside_low, inside_high) + margin)
    begin, end = np.where(apart, near - margin, begin), np.where(apart, near + margin, end)
    half = 0.5 * (end - begin)
    d = 0.5 * (begin + end)[..., None] + half[..., None] * NODES
    log = -0.5 * q[..., None] * (d - centre[..., None]) ** 2 + 0.5 * np.log(q / (2.0 * np.pi))[..., None]
    for k in range(looks.shape[1]):
        i = looks[:, k]
        at = rotation[:, i, None] + d
        inside = log_interval(low[:, i, None] - at, high[:, i, None] - at, soft[:, k, None])
        log = log + np.where(there[:, k, None], inside, 0.0)
    log = log + _amplitude_log(shapes, groups, rotation + problem.looks.scan_rad, d)
    peak = log.max(axis=2)
    value = peak + np.log(np.sum(np.exp(log - peak[..., None]) * WEIGHTS, axis=2) * half)
    # Later stage angles were chosen from the first look: only the place of the first look in its window is random.
    value = value - np.log(high[:, looks[:, 0]] - low[:, looks[:, 0]])
    spread = np.sum(site * offset[:, looks] ** 2, axis=2)
    at_site = -pull / np.maximum(total, 1e-300)
    gaussian = 0.5 * np.log(q / (q + total)) - 0.5 * (centre - at_site) ** 2 * q * total / (q + total)
    gaussian = gaussian - 0.5 * (spread - total * at_site**2)
    return np.asarray(value - gaussian)


def _amplitude_log(shapes: RotationShapes, groups: LookGroups, plane_rad: FloatArray, d: FloatArray) -> FloatArray:
    """(S, m, nodes) of the amplitudes at the PMs' plane angles ``plane + d``."""
    out = np.zeros_like(d)
    for row, pm in enumerate(groups.pm):
        if shapes.amplitude_look[pm] >= 0:
            at = plane_rad[:, groups.looks[row, 0], None] + d[:, row]
            out[:, row] = np.interp(at, shapes.plane_rad[pm], shapes.amplitude_log[pm])
    return out
