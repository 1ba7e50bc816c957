"""Starts by consensus of minimal sets: most shots agree on them, and outliers do not matter.

The minimal solver (three points on three lines) runs over random triples; all lines score each solution with a
truncated cost (MSAC; Torr and Zisserman, 2000). For the beam the minimal sets are two aimed-at spots.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from fgreg.geometry.transforms import FloatArray, inverse, make_transform, transform_points
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced_blocks import arc_points, perpendicular_basis
from fgreg.model.measurements import FLOOR_MM, Aim
from fgreg.registration.initialization import distinct_rotations
from fgreg.registration.minimal_solver import poses_of_three

TRIPLES = 160
"""Random triples of the consensus: with 60 % outliers ten of them still have inliers only."""
STARTS = 24
"""Distinct solutions used as starts: fewer miss the deepest minimum where only the window is known."""
SEED = 40961
SCORE_LIMIT = 13.8
"""Squared deviation over its variance at which the score is truncated."""


def consensus_starts(
    problem: PackedProblem, marker_T_beam: FloatArray, lambda_mm: float, keep: int = STARTS
) -> FloatArray:
    """Registrations that most PMs of a one-epoch problem agree on, best first.

    Args:
        problem: packed; the first look of each PM is used.
        marker_T_beam: (4, 4), z along the beam.
        lambda_mm: typical distance of a spot from the frame's origin, at which the beam's uncertainty is taken.
        keep: largest number of distinct ones.

    Returns:
        (m, 4, 4) ``trus_T_camera``; empty for fewer than three PMs.
    """
    pms = len(problem.pms)
    if pms < 3:
        return np.zeros((0, 4, 4))
    look = np.zeros(pms, dtype=np.int64)
    look[problem.look_pm[::-1]] = np.arange(len(problem.look_pm))[::-1]
    beam = problem.look_beam[look]
    origin = problem.beams.rotation[beam] @ marker_T_beam[:3, 3] + problem.beams.translation_mm[beam]
    direction = problem.beams.rotation[beam] @ marker_T_beam[:3, 2]
    points = arc_points(problem, np.zeros(1))[0, look]

    found = _minimal_poses(origin, direction, points)
    if not len(found):
        return np.zeros((0, 4, 4))
    camera_R_trus, camera_t = found[:, :3, :3], found[:, :3, 3]
    # Across the beam a PM's deviation is the beam's error and its own; along its arc it is the width of the window.
    covariance = problem.beams.covariance[beam]
    reach = np.sqrt(lambda_mm**2 + float(marker_T_beam[:3, 3] @ marker_T_beam[:3, 3]))
    variance = np.trace(covariance[:, 3:, 3:], axis1=1, axis2=2) / 3
    variance = variance + reach**2 * np.trace(covariance[:, :3, :3], axis1=1, axis2=2) / 3 + 1.0
    radial = points - problem.radius_mm * np.stack(
        [points[:, 0] * 0, np.sin(problem.looks.scan_rad[look]), np.cos(problem.looks.scan_rad[look])], axis=-1
    )
    tangent = np.stack([np.zeros(pms), radial[:, 2], -radial[:, 1]], axis=-1)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    slack = (problem.radius_mm + problem.looks.range_mm[look]) ** 2 / problem.looks.weight[look, 2, 2]
    across = perpendicular_basis(direction)
    camera_R_trus_t = camera_R_trus.swapaxes(1, 2)
    gap = np.einsum("nia,sni->sna", across, points @ camera_R_trus_t + camera_t[:, None] - origin)
    along_arc = np.einsum("nia,sni->sna", across, tangent @ camera_R_trus_t)
    # (variance I + slack v v')^-1 by Sherman and Morrison.
    projected = np.sum(gap * along_arc, axis=-1)
    square = np.sum(gap**2, axis=-1) - slack * projected**2 / (variance + slack * np.sum(along_arc**2, axis=-1))
    score = np.sum(np.minimum(square / variance, SCORE_LIMIT), axis=1)
    return inverse(found[distinct_rotations(camera_R_trus, np.argsort(score)[: 40 * keep], keep)])


def _minimal_poses(origin: FloatArray, direction: FloatArray, points: FloatArray) -> FloatArray:
    """``camera_T_trus`` (m, 4, 4) of the minimal solver over triples of lines."""
    count = len(points)
    if count * (count - 1) * (count - 2) // 6 <= TRIPLES:
        triples = np.array(list(combinations(range(count), 3)))
    else:
        triples = np.argsort(np.random.default_rng(SEED).random((TRIPLES, count)), axis=1)[:, :3]
    rotations, translations = [], []
    for rows in triples:
        for pose in poses_of_three(origin[rows], direction[rows], points[rows]):
            rotations.append(pose.R)
            translations.append(pose.t)
    if not rotations:
        return np.zeros((0, 4, 4))
    poses = make_transform(np.array(rotations), np.array(translations))
    return poses[np.isfinite(poses).all(axis=(1, 2))]


def consensus_beams(aims: tuple[Aim, ...], keep: int = 4) -> list[tuple[FloatArray, FloatArray]]:
    """Beams (origin mm, unit direction, marker frame) through two aimed-at spots that most spots agree on."""
    if len(aims) < 3:
        return []
    marker_p = np.array([transform_points(inverse(a.marker.camera_T_marker), a.camera_p_spot_mm) for a in aims])
    first, second = np.array(list(combinations(range(len(aims)), 2))[:2000]).T
    apart = marker_p[second] - marker_p[first]
    length = np.linalg.norm(apart, axis=1)
    long = length > 1.0
    start, along = marker_p[first[long]], apart[long] / length[long, None]
    variance = np.array(
        [
            FLOOR_MM**2  # noise of zero is no weight
            + (np.trace(a.covariance) + np.trace(a.marker.covariance[3:, 3:])) / 3
            + p @ p * np.trace(a.marker.covariance[:3, :3]) / 3
            for a, p in zip(aims, marker_p, strict=True)
        ]
    )
    offset = marker_p - start[:, None]
    square = np.sum(offset**2, axis=-1) - np.sum(offset * along[:, None], axis=-1) ** 2
    score = np.sum(np.minimum(square / variance, SCORE_LIMIT), axis=1)
    out: list[tuple[FloatArray, FloatArray]] = []
    for index in np.argsort(score):
        towards = along[index] if along[index] @ marker_p.mean(axis=0) >= 0 else -along[index]
        if all(towards @ other < np.cos(0.05) for _, other in out):
            inside = offset[index][square[index] < SCORE_LIMIT * variance]  # the two spots that define it, at least
            centre = start[index] + inside.mean(axis=0)
            out.append((centre - (centre @ towards) * towards, towards))
        if len(out) == keep:
            break
    return out
