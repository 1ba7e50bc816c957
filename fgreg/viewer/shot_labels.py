"""The words in the 3D view: names of frames and parts of the shot at the cursor, placed so that none covers another."""

from __future__ import annotations

import numpy as np

from fgreg.geometry.transforms import FloatArray, transform_points
from fgreg.model.session_model import SessionModel
from fgreg.viewer import palette, scene, shapes
from fgreg.viewer.scene import Eye, Label

AXIS_MM = 14.0
"""Length of the axes of TRUS beyond the probe's surface."""


def axes_reach_mm(model: SessionModel) -> FloatArray:
    """(3,) lengths of the axes of TRUS, which end outside the probe."""
    length = scene.array_length_mm(model.probe)
    return np.array([length / 2.0 + 4.0, 0.0, 0.0]) + model.probe.radius_mm + AXIS_MM


def draw(
    rec: shapes.Recorder,
    model: SessionModel,
    view: tuple[Eye | None, tuple[int, int]],
    *,
    trus_T_camera: FloatArray | None = None,
    refused: bool = False,
    camera_T_marker: FloatArray | None = None,
    marker_T_laser: FloatArray | None = None,
    spot: tuple[str, FloatArray] | None = None,
    plane: tuple[str, FloatArray] | None = None,
) -> None:
    """Log the labels of a shot under ``world/shot/labels``.

    Args:
        rec: where.
        model: the session's set-up.
        view: the eye, None where it is not known, and the view's width and height, px.
        trus_T_camera: of the registration. refused: it is not to be used.
        camera_T_marker, marker_T_laser: of the shot.
        spot: words and place (3,) mm of the PM.
        plane: words and corners (4, 3) mm of the image plane.
    """
    reach = axes_reach_mm(model)
    ends = np.diag(reach)
    labels = []
    if spot is not None:
        text, at = spot
        labels.append(Label(text, at[None], palette.PM))
    if trus_T_camera is not None:
        name, color = ("camera: REFUSED", palette.REFUSED) if refused else ("camera", palette.CAMERA)
        labels.append(Label(name, trus_T_camera[:3, 3][None], color))
        if camera_T_marker is not None:
            trus_T_marker = trus_T_camera @ camera_T_marker
            corners = np.array([*_outer_corners(model), [0.0, 0.0, 0.0]])
            labels.append(Label("marker", transform_points(trus_T_marker, corners), palette.MARKER))
            if marker_T_laser is not None:
                origin = (trus_T_marker @ marker_T_laser)[:3, 3]
                labels.append(Label("laser", origin[None], palette.BEAM))
    if plane is not None:
        text, corners = plane
        labels.append(Label(text, corners[[2, 3, 1, 0]], palette.PLANE))
    for name, end, color in zip(("TRUS x: rotation axis", "y", "z"), ends, palette.AXES, strict=True):
        labels.append(Label(name, end[None], color))
    side = reach[0] - AXIS_MM
    below = np.array([[-side, 0.0, -4.0], [side, 0.0, -4.0], [0.0, 0.0, -model.probe.radius_mm]])
    labels.append(Label("TRUS probe", below, palette.TEXT))
    rec.log("world/shot/labels", shapes.labels(scene.place_labels(labels, *view)))


def _outer_corners(model: SessionModel) -> FloatArray:
    """(n, 3) the corners of the marker's tags, marker frame."""
    if model.marker is None:
        return np.zeros((0, 3))
    return np.concatenate([tag.marker_p_corners_mm for tag in model.marker.tags])
