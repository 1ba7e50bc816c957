"""What the registration puts into the endoscope's picture: PMs, beam and image plane, with the lens' distortion."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fgreg.geometry.transforms import FloatArray, inverse, transform_points
from fgreg.model.camera_model import CameraModel
from fgreg.model.lens import project
from fgreg.viewer import palette, shapes

PATH = "world/camera/left/seen"
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
    """

    plane: FloatArray | None
    beam: FloatArray | None
    pms: FloatArray
    unused: FloatArray


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


def _is_before(camera_p_mm: FloatArray) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    depth = camera_p_mm[:, 2]
    off = np.abs(camera_p_mm[:, :2]).max(axis=1)
    return np.asarray((depth > NEAR_MM) & (off < WIDEST * np.maximum(depth, NEAR_MM)))


def draw(rec: shapes.Recorder, camera: CameraModel, trus_T_camera: FloatArray | None, seen: Seen) -> None:
    """Draw over the left picture, at the present time; nothing where ``trus_T_camera`` is None (none, or refused)."""
    rec.clear(PATH)
    if trus_T_camera is None:
        return
    camera_T_trus = inverse(trus_T_camera)

    def in_camera(points: FloatArray) -> FloatArray:
        return transform_points(camera_T_trus, np.reshape(points, (-1, 3)))

    if seen.plane is not None:
        corners = in_camera(seen.plane)
        if outline := line_px(camera, np.vstack([corners, corners[:1]])):
            rec.log(f"{PATH}/plane", shapes.strips_2d(outline, palette.PLANE, 1.2))
        if face := line_px(camera, corners[:2]):  # bold: it tells which side of the plane is the probe's
            rec.log(f"{PATH}/array", shapes.strips_2d(face, palette.PLANE, 3.0))
    if seen.beam is not None and (beam := line_px(camera, in_camera(seen.beam))):
        rec.log(f"{PATH}/beam", shapes.strips_2d(beam, palette.BEAM, 2.0))
        if len(spot := points_px(camera, in_camera(seen.beam[1:]))):
            rec.log(f"{PATH}/spot", shapes.points_2d(spot, palette.BEAM, 4.0))
    if len(pms := points_px(camera, in_camera(seen.pms))):
        rec.log(f"{PATH}/pms", shapes.points_2d(pms, palette.PM, 3.0))
    half = CROSS_PX * camera.image_size[0]
    ends = np.array([[[-half, -half], [half, half]], [[-half, half], [half, -half]]])
    if crosses := [at + end for at in points_px(camera, in_camera(seen.unused)) for end in ends]:
        rec.log(f"{PATH}/not_used", shapes.strips_2d(crosses, palette.UNUSED, 1.5))


def say_refused(rec: shapes.Recorder, camera: CameraModel) -> None:
    """Say in place of it why nothing is drawn, at the present time."""
    width, height = camera.image_size
    rec.clear(PATH)
    words = "REFUSED: where PMs and image plane are is not known"
    top = np.array([[0.5 * width, 0.04 * height]])
    rec.log(f"{PATH}/refused", shapes.points_2d(top, palette.REFUSED, 0.5, [words]))
