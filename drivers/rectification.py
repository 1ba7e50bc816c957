"""Rectified stereo pictures: without distortion, both cameras parallel, the same line for the same point.

The ``camera`` frame is then the *rectified* left camera, rotated about the same centre: ``rectified_p =
rectified_R_left * left_p``. A registration from rectified pictures maps rectified coordinates; ``trus_T_left =
trus_T_rectified * [rectified_R_left, 0]``. Marker detection does not need rectified pictures, since it uses the model
with distortion. Rectify only if another program needs it, and then in the whole processing chain.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from fgreg.detection.frame_files import Picture, as_picture
from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray, as_float_array, exp_so3, log_so3, make_transform
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.lens import in_view, normalized_from_pixels, project

Float32Array = npt.NDArray[np.float32]
FAR_MM = 1000.0
"""Of points along a ray: any distance will do."""


@dataclass(frozen=True, slots=True, eq=False)
class Rectification:
    """How to rectify an endoscope's pictures.

    Attributes:
        rig: the model of the rectified pictures: one camera matrix for both, no distortion, right at (-b, 0, 0).
        rectified_R_left, rectified_R_right: (3, 3) turns from the real cameras.
        left_maps, right_maps: for cv2.remap.
    """

    rig: StereoRig
    rectified_R_left: FloatArray
    rectified_R_right: FloatArray
    left_maps: tuple[Float32Array, Float32Array]
    right_maps: tuple[Float32Array, Float32Array]

    def left(self, picture: Picture) -> Picture:
        """The left picture, rectified."""
        return _remapped(picture, self.left_maps, self.rig.left.image_size)

    def right(self, picture: Picture) -> Picture:
        """The right picture, rectified."""
        return _remapped(picture, self.right_maps, self.rig.left.image_size)


def rectification(rig: StereoRig) -> Rectification:
    """Rectification of a rig whose cameras stand side by side.

    Each camera is turned by half of the turn between them, then both so that the baseline lies along x. ``fx`` and
    ``fy`` are each the mean of the two cameras': fields of interlaced video keep their geometry (OpenCV's own
    ``stereoRectify`` makes pixels square). One centre for both, so that infinitely far points have no disparity.

    Raises:
        InputError: one camera only, cameras that do not stand side by side, or a lens model that cannot be inverted.
    """
    if rig.right is None or rig.right_T_left is None:
        raise InputError("camera.right", "nothing", "two cameras, to rectify their pictures")
    shift = rig.right_T_left[:3, 3]
    if abs(shift[0]) <= np.linalg.norm(shift[1:]):
        found = "cameras " + ", ".join(f"{v:.3g}" for v in shift) + " mm apart along x, y, z"
        raise InputError("camera.right_T_left", found, "cameras side by side, apart along x")
    half = exp_so3(0.5 * log_so3(rig.right_T_left[:3, :3]))
    # Both cameras after half a turn towards each other are parallel; the baseline in their axes:
    baseline = half.T @ shift
    x = np.sign(baseline[0]) * baseline / np.linalg.norm(baseline)
    y = np.cross([0.0, 0.0, 1.0], x)
    y /= np.linalg.norm(y)
    level = np.stack([x, y, np.cross(x, y)])
    turn_left, turn_right = level @ half, level @ half.T
    matrix = _common_matrix(((rig.left, turn_left), (rig.right, turn_right)))
    size = rig.left.image_size
    model = CameraModel(size, matrix, as_float_array(np.zeros(5)))
    transform = make_transform(np.eye(3), level @ baseline)
    transform[1:3, 3] = 0.0  # by construction; rounding only
    return Rectification(
        StereoRig(model, model, as_float_array(transform)),
        as_float_array(turn_left),
        as_float_array(turn_right),
        _maps(rig.left, turn_left, matrix),
        _maps(rig.right, turn_right, matrix),
    )


def _common_matrix(cameras: tuple[tuple[CameraModel, FloatArray], ...]) -> FloatArray:
    """One matrix for both: mean focal lengths, and the pictures' corners centred on average."""
    fx, fy = (float(np.mean([camera.matrix[i, i] for camera, _ in cameras])) for i in (0, 1))
    width, height = cameras[0][0].image_size
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], dtype=np.float64)
    middles = []
    for (camera, turn), side in zip(cameras, ("left", "right"), strict=True):
        normalized = normalized_from_pixels(camera, corners)
        if not np.isfinite(normalized).all():
            found = "a lens model that cannot be inverted in the image's corners"
            raise InputError(f"camera.{side}.distortion", found, "one that holds over the image, to rectify it")
        rays = np.column_stack([normalized, np.ones(4)]) @ turn.T
        if rays[:, 2].min() <= 0.0:
            raise InputError(f"camera.{side}", "a corner 90 degrees off the rectified axis", "a narrower lens")
        middles.append((rays[:, :2] / rays[:, 2:]).mean(axis=0))
    middle = np.mean(middles, axis=0)
    cx, cy = (width - 1) / 2.0 - fx * middle[0], (height - 1) / 2.0 - fy * middle[1]
    return as_float_array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _maps(camera: CameraModel, turn: FloatArray, matrix: FloatArray) -> tuple[Float32Array, Float32Array]:
    """Column and row (h, w), px, in the camera's picture of each rectified pixel; -1 where it sees nothing of it."""
    width, height = camera.image_size
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    x, y = (columns - matrix[0, 2]) / matrix[0, 0], (rows - matrix[1, 2]) / matrix[1, 1]
    camera_p = FAR_MM * np.stack([x, y, np.ones_like(x)], axis=-1) @ turn
    seen = in_view(camera, camera_p, -1.0)
    pixels = np.where(seen[..., None], project(camera, np.where(seen[..., None], camera_p, [0.0, 0.0, FAR_MM])), -1.0)
    return pixels[..., 0].astype(np.float32), pixels[..., 1].astype(np.float32)


def _remapped(picture: Picture, maps: tuple[Float32Array, Float32Array], size: tuple[int, int]) -> Picture:
    if picture.shape[1::-1] != size:
        found = f"a picture of {picture.shape[1]} x {picture.shape[0]} px"
        raise InputError("endoscope", found, f"{size[0]} x {size[1]} px, as its calibration")
    return as_picture(np.asarray(cv2.remap(picture, maps[0], maps[1], cv2.INTER_LINEAR)))
