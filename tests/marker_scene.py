"""An endoscope, poses before it and rendered frames, for the tests of marker and board detection."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.geometry.transforms import (
    FloatArray,
    as_float_array,
    exp_so3,
    inverse,
    log_so3,
    make_transform,
    rotation_to_direction,
    transform_points,
)
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.session_model import MarkerModel, TagModel
from fgreg.simulation.lens import project_points
from fgreg.simulation.render import Optics, render_frame
from fgreg.simulation.surfaces import Background, Surface, TagSurface

SIZE = (1280, 720)
Frame = npt.NDArray[np.uint8]

LEFT = CameraModel(
    SIZE,
    as_float_array([[1100.0, 0.0, 635.0], [0.0, 1102.0, 355.0], [0.0, 0.0, 1.0]], 3, 3),
    as_float_array([-0.18, 0.06, 0.0006, -0.0004, 0.0], 5),
)
RIGHT = CameraModel(
    SIZE,
    as_float_array([[1096.0, 0.0, 645.0], [0.0, 1098.0, 361.0], [0.0, 0.0, 1.0]], 3, 3),
    as_float_array([-0.17, 0.05, -0.0003, 0.0005, 0.0], 5),
)
RIGHT_T_LEFT = as_float_array(
    make_transform(exp_so3(np.array([0.002, 0.006, -0.003])), np.array([-5.0, 0.05, 0.1])), 4, 4
)
RIG = StereoRig(LEFT, RIGHT, RIGHT_T_LEFT)
ONE_TAG = MarkerModel("DICT_4X4_50", (TagModel(0, 30.0),))


def facing_pose(
    xyz_mm: tuple[float, float, float], tilt_deg: float, around_deg: float = 30.0, roll_deg: float = 20.0
) -> FloatArray:
    """``camera_T_tag`` of a tag whose face looks at the camera, leaning ``tilt_deg`` off the line of sight."""
    t = np.array(xyz_mm)
    around = np.radians(around_deg)
    lean = exp_so3(np.radians(tilt_deg) * np.array([np.cos(around), np.sin(around), 0.0]))
    roll = exp_so3(np.array([0.0, 0.0, np.radians(roll_deg)]))
    rotation = rotation_to_direction(t / np.linalg.norm(t)) @ lean @ np.diag([1.0, -1.0, -1.0]) @ roll
    return make_transform(rotation, t)


def surfaces_of(marker: MarkerModel, camera_T_marker: FloatArray) -> list[Surface]:
    """The body's tags as printed sheets."""
    return [
        TagSurface(marker.dictionary, tag.id, tag.size_mm, camera_T_marker @ tag.marker_T_tag) for tag in marker.tags
    ]


def frames_of(surfaces: list[Any], seed: int = 0, blur_px: float = 0.9, far_mm: float = 200.0) -> tuple[Frame, Frame]:
    """Left and right frames."""
    rng = np.random.default_rng(seed)
    optics = Optics(blur_px=blur_px, reference_mm=0.6 * far_mm)
    back = Background(make_transform(np.eye(3), np.array([0.0, 0.0, far_mm])), seed=seed)
    left = render_frame(LEFT, surfaces, rng, optics, back)
    right = render_frame(
        RIGHT, [s.seen_from(RIGHT_T_LEFT) for s in surfaces], rng, optics, back.seen_from(RIGHT_T_LEFT)
    )
    return left, right


def left_pixels(camera_T_body: FloatArray, body_p: FloatArray) -> FloatArray:
    """Where points of a body are in the left frame, by the renderer's own projection."""
    return project_points(LEFT, transform_points(camera_T_body, body_p))


def pose_error(true: FloatArray, found: FloatArray) -> FloatArray:
    """(6,) rotation (rad) and translation (mm) of ``inv(true) @ found``."""
    error = inverse(true) @ found
    return np.concatenate([log_so3(error[:3, :3]), error[:3, 3]])


def rotation_error_deg(true: FloatArray, found: FloatArray) -> float:
    """Angle between two poses."""
    return float(np.degrees(np.linalg.norm(pose_error(true, found)[:3])))
