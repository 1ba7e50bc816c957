"""Interlaced video: one frame holds two fields, taken half a frame period apart, on its even and its odd lines.

Moving objects are torn apart by that, so each field becomes a picture of its own: half as high, with half of the whole
frame's ``fy`` (so ``fx`` is about twice ``fy``), and a centre that depends on the field. Line ``v`` of the frame is
line ``(v - parity) / 2`` of the field, hence ``fy' = fy / 2``, ``cy' = (cy - parity) / 2``; distortion acts on
normalised coordinates and stays.
"""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum

import numpy as np

from fgreg.detection.frame_files import Picture, as_picture
from fgreg.geometry.transforms import as_float_array
from fgreg.model.camera_model import CameraModel, StereoRig


class Fields(StrEnum):
    """How a video frame is split into pictures."""

    WHOLE = "whole"
    """The frame as it is: progressive video, or a device that delivers single fields."""
    TOP = "top"
    """The even lines."""
    BOTTOM = "bottom"
    """The odd lines."""
    BOTH = "both"
    """Two pictures from each frame, the even lines first; both with the geometry of the top field."""


_PARITY = {Fields.TOP: 0, Fields.BOTTOM: 1, Fields.BOTH: 0}


def field_of(frame: Picture, parity: int) -> Picture:
    """One field, (h // 2, w[, 3]), of a frame: its lines ``parity``, ``parity + 2``, ..."""
    return as_picture(np.ascontiguousarray(frame[parity : 2 * (frame.shape[0] // 2) : 2]))


def bottom_on_top(frame: Picture) -> Picture:
    """The odd lines, resampled to where the even ones are: pictures of both fields with one camera model.

    Line 2k of the frame is half way between the odd lines 2k - 1 and 2k + 1; the first has no upper neighbour.
    """
    odd = field_of(frame, 1).astype(np.uint32)
    odd[1:] = (odd[:-1] + odd[1:] + 1) // 2
    return as_picture(odd.astype(frame.dtype))


def split(frame: Picture, fields: Fields) -> list[Picture]:
    """The pictures in a frame, in time order."""
    if fields is Fields.WHOLE:
        return [frame]
    if fields is Fields.BOTH:
        return [field_of(frame, 0), bottom_on_top(frame)]
    return [field_of(frame, _PARITY[fields])]


def field_camera(camera: CameraModel, fields: Fields) -> CameraModel:
    """The model of a camera's fields from that of its whole frames."""
    if fields is Fields.WHOLE:
        return camera
    matrix = camera.matrix.copy()
    matrix[1, 1] /= 2.0
    matrix[1, 2] = (matrix[1, 2] - _PARITY[fields]) / 2.0
    width, height = camera.image_size
    return replace(camera, image_size=(width, height // 2), matrix=as_float_array(matrix, 3, 3))


def field_rig(rig: StereoRig, fields: Fields) -> StereoRig:
    """:func:`field_camera` of both cameras; their relative pose does not change."""
    right = None if rig.right is None else field_camera(rig.right, fields)
    return replace(rig, left=field_camera(rig.left, fields), right=right)
