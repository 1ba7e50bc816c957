"""Draws what the registration puts into the endoscope's picture (:mod:`fgreg.viewer.endoscope_lines`)."""

from __future__ import annotations

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.model.camera_model import CameraModel
from fgreg.viewer import palette, shapes
from fgreg.viewer.endoscope_lines import Seen, lines_of

PATH = "world/camera/left/seen"
REFUSED = "REFUSED: where PMs and image plane are is not known"


def draw(rec: shapes.Recorder, camera: CameraModel, trus_T_camera: FloatArray | None, seen: Seen) -> None:
    """Draw over the left picture, at the present time; nothing where ``trus_T_camera`` is None (none, or refused)."""
    rec.clear(PATH)
    if trus_T_camera is None:
        return
    lines = lines_of(camera, trus_T_camera, seen)
    strips = {
        "plane": (lines.plane, palette.PLANE, 1.2),
        "array": (lines.array, palette.PLANE, 3.0),
        "beam": (lines.beam, palette.BEAM, 2.0),
        "not_used": (lines.crosses, palette.UNUSED, 1.5),
    }
    for name, (drawn, color, size) in strips.items():
        if drawn:
            rec.log(f"{PATH}/{name}", shapes.strips_2d(drawn, color, size))
    if len(lines.spot):
        rec.log(f"{PATH}/spot", shapes.points_2d(lines.spot, palette.BEAM, 4.0))
    if len(lines.pms):
        rec.log(f"{PATH}/pms", shapes.points_2d(lines.pms, palette.PM, 3.0))


def say_refused(rec: shapes.Recorder, camera: CameraModel) -> None:
    """Say in place of it why nothing is drawn, at the present time."""
    width, height = camera.image_size
    rec.clear(PATH)
    top = np.array([[0.5 * width, 0.04 * height]])
    rec.log(f"{PATH}/refused", shapes.points_2d(top, palette.REFUSED, 0.5, [REFUSED]))
