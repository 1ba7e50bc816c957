"""Starts without an initial guess: the beam from the aims, the registration from lines and arc points.

The beam: aimed-at spots, transformed into the marker frame, lie on one line. The registration: each PM, placed on its
arc at the centre of the sensitivity prior, should lie on its beam. With the translation eliminated the sum of squared
distances is a quadratic form in the nine entries of the rotation; it is minimised on SO(3) from many rotations at once.
For few pairs the minimal solver (three points on three lines; gp3p of poselib, after Kneip et al. and Kukelova et
al.) over triples adds starts that the descent can miss.
"""

from __future__ import annotations

from functools import cache
from itertools import combinations

import numpy as np

from fgreg.geometry.transforms import FloatArray, IntArray, exp_so3, hat, inverse, make_transform, transform_points
from fgreg.model.measurements import Aim
from fgreg.registration.minimal_solver import poses_of_three

SEED = 20260
TRIPLES = 24
DESCENT_STEPS = 25
SETTLED_RAD = 1e-3
"""The descent ends when no start rotates by more than this in a step."""
SAME_START_RAD = 0.1
"""Rotations no farther apart than this are the same start."""
CLEAR_AXIS = 0.4
"""Ratio of the second to the first axis of the spots below which the first one is the beam's."""


@cache
def cube_rotations() -> FloatArray:
    """The 24 rotations of the cube, (24, 3, 3): any rotation is within 62.8 deg of one of them."""
    out = []
    for axes in ((0, 1, 2), (1, 2, 0), (2, 0, 1), (0, 2, 1), (2, 1, 0), (1, 0, 2)):
        for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            r = np.zeros((3, 3))
            r[0, axes[0]], r[1, axes[1]] = signs
            r[2] = np.cross(r[0], r[1])
            out.append(r)
    return np.array(out)


def beam_starts(aims: tuple[Aim, ...]) -> list[tuple[FloatArray, FloatArray]]:
    """Candidate beams (origin mm, unit direction) in the marker frame, likeliest first; empty without aims.

    The candidate is the principal axis of the spots. Where the distances hardly vary noise decides which axis is the
    longest, so all long axes and the line from the marker's origin are candidates. Directions point from the marker to
    the spots.
    """
    if not aims:
        return []
    marker_p = np.array([transform_points(inverse(a.marker.camera_T_marker), a.camera_p_spot_mm) for a in aims])
    centre = marker_p.mean(axis=0)
    directions: list[FloatArray] = []
    clear = False
    if len(aims) >= 2:
        _, spread, axes = np.linalg.svd(marker_p - centre, full_matrices=False)
        clear = bool(len(aims) > 2 and spread[1] < CLEAR_AXIS * spread[0])
        directions.extend(axes[:1] if clear else axes[spread > CLEAR_AXIS * spread[0]])
    length = np.linalg.norm(centre)
    if length > 1e-6 and not clear:
        directions.append(centre / length)
    starts = []
    for direction in directions:
        towards = direction if direction @ centre >= 0 else -direction
        origin = centre - (centre @ towards) * towards
        starts.append((origin, towards))
    return starts


def distinct_rotations(rotation: FloatArray, order: IntArray, keep: int) -> IntArray:
    """Indices of up to ``keep`` rotations (n, 3, 3), in this order, each ``SAME_START_RAD`` from all before it."""
    flat = rotation[order].reshape(-1, 9)
    near = flat @ flat.T > 1.0 + 2.0 * np.cos(SAME_START_RAD)
    free = np.ones(len(order), dtype=bool)
    chosen: list[int] = []
    for place in range(len(order)):
        if free[place]:
            chosen.append(place)
            free &= ~near[place]
        if len(chosen) == keep:
            break
    return np.asarray(order[chosen])


def registration_starts(origin_mm: FloatArray, direction: FloatArray, trus_p: FloatArray, keep: int = 12) -> FloatArray:
    """Distinct registrations that bring points onto lines, best first.

    Args:
        origin_mm, direction: (n, 3) a point on each line, and its unit direction, in camera axes.
        trus_p: (n, 3) the point of each line in TRUS.
        keep: largest number of them.

    Returns:
        (m, 4, 4) ``trus_T_camera``.
    """
    across = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    rotations = [cube_rotations()]
    if 3 <= len(trus_p) <= 14:
        rotations.append(_minimal_rotations(origin_mm, direction, trus_p))
    camera_R_trus, cost = _descend(np.concatenate(rotations), origin_mm, across, trus_p)
    rotation = camera_R_trus[distinct_rotations(camera_R_trus, np.argsort(cost), keep)]
    translation = _best_translation(rotation, origin_mm, across, trus_p)
    return inverse(make_transform(rotation, translation))


def _best_translation(rotation: FloatArray, origin: FloatArray, across: FloatArray, points: FloatArray) -> FloatArray:
    """(S, 3) translations that minimise the squared distances to the lines for rotations (S, 3, 3)."""
    total = across.sum(axis=0) + 1e-9 * np.eye(3)
    gap = np.einsum("sij,nj->sni", rotation, points) - origin
    return np.asarray(-np.linalg.solve(total, np.einsum("nij,snj->si", across, gap)[..., None])[..., 0])


def _descend(
    rotation: FloatArray, origin: FloatArray, across: FloatArray, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Damped Gauss-Newton on SO(3) from rotations (S, 3, 3), translation eliminated: rotations and costs (S,)."""
    total_inverse = np.linalg.inv(across.sum(axis=0) + 1e-9 * np.eye(3))
    # The squared distance is vec(R)' A vec(R) - 2 b' vec(R) + c: all lines enter A once, so that steps are cheap.
    n = len(points)
    design = np.einsum("nij,nk->nijk", across, points).reshape(n, 3, 9)
    offset = np.einsum("nij,nj->ni", across, origin)
    mean_design, mean_offset = design.sum(axis=0), offset.sum(axis=0)
    quadratic = np.einsum("nia,nib->ab", design, design) - mean_design.T @ total_inverse @ mean_design
    linear = np.einsum("nia,ni->a", design, offset) - mean_design.T @ total_inverse @ mean_offset
    constant = np.sum(offset * origin) - mean_offset @ total_inverse @ mean_offset

    def cost_of(r: FloatArray) -> FloatArray:
        v = r.reshape(-1, 9)
        return np.asarray(np.sum((v @ quadratic) * v, axis=1) - 2 * v @ linear + constant)

    generators = hat(np.eye(3))
    cost = cost_of(rotation)
    damping = np.full(len(rotation), 1e-3)
    for _ in range(DESCENT_STEPS):
        tangent = (rotation[:, None] @ generators).reshape(-1, 3, 9)
        gradient = ((rotation.reshape(-1, 1, 9) @ quadratic - linear) @ tangent.swapaxes(-1, -2))[:, 0]
        curvature = tangent @ quadratic @ tangent.swapaxes(-1, -2)
        scale = np.trace(curvature, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
        step = -np.linalg.solve(curvature + damping[:, None, None] * scale, gradient[..., None])[..., 0]
        trial = rotation @ exp_so3(step)
        trial_cost = cost_of(trial)
        good = trial_cost <= cost
        rotation = np.where(good[:, None, None], trial, rotation)
        cost = np.where(good, trial_cost, cost)
        damping = np.where(good, damping * 0.3, damping * 6.0)
        if np.abs(step).max() < SETTLED_RAD:
            break
    return rotation, cost


def _minimal_rotations(origin: FloatArray, direction: FloatArray, points: FloatArray) -> FloatArray:
    """Rotations ``camera_R_trus`` (m, 3, 3) of the minimal solver over triples of lines."""
    triples = list(combinations(range(len(points)), 3))
    if len(triples) > TRIPLES:
        picked = np.random.default_rng(SEED).choice(len(triples), TRIPLES, replace=False)
        triples = [triples[i] for i in sorted(picked)]
    found: list[FloatArray] = []
    for triple in triples:
        rows = list(triple)
        solutions = poses_of_three(origin[rows], direction[rows], points[rows])
        found.extend(solution.R for solution in solutions if np.isfinite(solution.R).all())
    return np.array(found, dtype=np.float64).reshape(-1, 3, 3)
