"""What the registration puts into the endoscope's picture, in pixels: PMs, beam and image plane, bent by the lens.

Does not import Rerun: the recording (:mod:`fgreg.viewer.endoscope_view`) and the overlay draw the same lines.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fgreg.geometry.transforms import BoolArray, FloatArray, inverse, transform_points
from fgreg.model.camera_model import CameraModel
from fgreg.model.lens import project

NEAR_MM = 5.0
"""Points nearer to the camera's plane than this, and those behind it, are not drawn."""
WIDEST = 3.0
"""Points farther from the axis than this, as x / z or y / z, are not drawn: a lens model holds within its picture."""
POINTS = 33
"""Of a straight line, which a lens bends."""
CROSS_PX = 0.006
"""Half size of the cross of a PM that was not used, in widths of the picture."""


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What there is to see, TRUS mm.

    Attributes:
        plane: (4, 3) corners of the image plane, face of the array first; None without one.
        beam: (2, 3) its origin and its end; None without one.
        pms: (n, 3) PMs so far. unused: (m, 3) those that were not used.
        goal: (4, 3) corners of the image plane where the stage will turn; None where unknown.
    """

    plane: FloatArray | None
    beam: FloatArray | None
    pms: FloatArray
    unused: FloatArray
    goal: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """The same in the left picture: lines of (n, 2) and points (n, 2), px.

    ``array`` is the edge of the plane at the probe's face: it tells which side of the plane is the probe's. ``turn``
    leads from the middle of the plane's far edge to that of the goal's, as the stage turns. ``spot`` is the beam's end.
    ``crosses`` mark PMs that were not used.
    """

    plane: list[FloatArray]
    array: list[FloatArray]
    goal: list[FloatArray]
    turn: list[FloatArray]
    beam: list[FloatArray]
    spot: FloatArray
    pms: FloatArray
    crosses: list[FloatArray]


def line_px(camera: CameraModel, camera_p_mm: FloatArray) -> list[FloatArray]:
    """The parts (n, 2) px of a polyline (m, 3) mm that lie before the camera, bent by the lens."""
    parts = [np.linspace(a, b, POINTS) for a, b in pairwise(camera_p_mm)]
    points = np.concatenate(parts)
    shown = _is_before(points)
    runs = np.split(np.arange(len(points)), np.flatnonzero(np.diff(shown.astype(int))) + 1)
    return [project(camera, points[run]) for run in runs if shown[run[0]] and len(run) > 1]


def points_px(camera: CameraModel, camera_p_mm: FloatArray) -> FloatArray:
    """(k, 2) px of those points (n, 3) mm that lie before the camera."""
    points = np.reshape(camera_p_mm, (-1, 3))
    return project(camera, points[_is_before(points)])


def lines_of(camera: CameraModel, trus_T_camera: FloatArray, seen: Seen) -> Lines:
    """What is seen in the picture of a camera."""
    camera_T_trus = inverse(trus_T_camera)

    def in_camera(points: FloatArray | None) -> FloatArray:
        return transform_points(camera_T_trus, np.reshape(np.zeros((0, 3)) if points is None else points, (-1, 3)))

    def outline(corners: FloatArray) -> list[FloatArray]:
        return line_px(camera, np.vstack([corners, corners[:1]])) if len(corners) else []

    plane, beam = in_camera(seen.plane), in_camera(seen.beam)
    half = CROSS_PX * camera.image_size[0]
    ends = np.array([[[-half, -half], [half, half]], [[-half, half], [half, -half]]])
    return Lines(
        outline(plane),
        line_px(camera, plane[:2]) if len(plane) else [],
        outline(in_camera(seen.goal)),
        [] if seen.plane is None or seen.goal is None else line_px(camera, in_camera(_turn(seen.plane, seen.goal))),
        line_px(camera, beam) if len(beam) else [],
        points_px(camera, beam[1:]),
        points_px(camera, in_camera(seen.pms)),
        [at + end for at in points_px(camera, in_camera(seen.unused)) for end in ends],
    )


def _turn(plane: FloatArray, goal: FloatArray) -> FloatArray:
    """(n, 3) the arc about the TRUS x axis from the middle of a plane's far edge to that of another."""
    (x, *start), (_, *end) = plane[2:].mean(axis=0), goal[2:].mean(axis=0)
    angles = np.linspace(np.arctan2(*start), np.arctan2(*end), 9)
    radius = np.hypot(*start)
    return np.column_stack([np.full(9, x), radius * np.sin(angles), radius * np.cos(angles)])


def _is_before(camera_p_mm: FloatArray) -> BoolArray:
    depth = camera_p_mm[:, 2]
    off = np.abs(camera_p_mm[:, :2]).max(axis=1)
    return np.asarray((depth > NEAR_MM) & (off < WIDEST * np.maximum(depth, NEAR_MM)))
