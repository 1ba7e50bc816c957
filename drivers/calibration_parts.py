"""What readers of calibration files share: ``camera_info``, cameras made of a file's numbers, values of a document."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray, as_float_array, make_transform, nearest_rotation
from fgreg.model.camera_model import MOST_COEFFICIENT, MOST_PX, CameraModel, StereoRig, lens_coefficients
from fgreg.schema.kinds import Kind, Numbers
from fgreg.schema.problems import FieldError, Problem, input_error, shown

MM_PER = {"m": 1000.0, "mm": 1.0}
"""Units that a calibration's lengths can have."""
ROTATION_TOLERANCE = 1e-3
_MOST = 1e9
"""Of a number in a calibration: far above any, and far below where products overflow."""
_LEAST_PX = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class CameraInfo:
    """One ROS ``camera_info``: size (w, h) px, K (3, 3), D (n,) of a named model, R (3, 3), P (3, 4)."""

    where: str
    image_size: tuple[int, int]
    matrix: FloatArray
    distortion: FloatArray
    distortion_model: str
    rectification: FloatArray
    projection: FloatArray


def rig_of_infos(left: CameraInfo, right: CameraInfo | None, mm_per_unit: float, rectified: bool = False) -> StereoRig:
    """A rig of two ``camera_info``.

    Raises:
        InputError: another distortion model, different sizes, or no baseline in the right projection matrix.
    """
    left_model = _info_model(left, rectified)
    if right is None:
        return StereoRig(left_model)
    right_model = _info_model(right, rectified)
    if left.image_size != right.image_size:
        found = "{} x {} px".format(*right.image_size)
        raise InputError(right.where, found, "{} x {} px, as the left camera".format(*left.image_size))
    offset = _rectified_offset(right) - _rectified_offset(left)
    if np.linalg.norm(offset) * mm_per_unit < 1e-3:
        found = "a projection matrix without a baseline"
        raise InputError(right.where, found, "P[0][3] = -fx times the baseline, of a stereo calibration")
    if rectified:
        transform = make_transform(np.eye(3), offset * mm_per_unit)
    else:
        back = right.rectification.T
        transform = make_transform(nearest_rotation(back @ left.rectification), back @ offset * mm_per_unit)
    return StereoRig(left_model, right_model, as_float_array(transform))


def _rectified_offset(info: CameraInfo) -> FloatArray:
    p = info.projection
    return np.array([p[0, 3] / p[0, 0], p[1, 3] / p[1, 1], 0.0])


def _info_model(info: CameraInfo, rectified: bool) -> CameraModel:
    for name, matrix in (("K", info.matrix), ("R", info.rectification), ("P", info.projection)):
        bounded(matrix, f"{info.where}: {name}")
    for name, matrix in (("K", info.matrix), ("P", info.projection)):
        if not (matrix[0, 0] > _LEAST_PX and matrix[1, 1] > _LEAST_PX):
            raise InputError(f"{info.where}: {name}", "focal lengths that are not > 0", "a calibrated camera")
    r = info.rectification
    if np.abs(r.T @ r - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(r) < 0:
        raise InputError(f"{info.where}: R", "a matrix that is no rotation", "a rotation")
    if rectified:
        return camera_of(info.image_size, info.projection[:, :3], np.zeros(5), f"{info.where}: P")
    distortion, fisheye = lens(info.distortion, info.distortion_model, f"{info.where}: D")
    return camera_of(info.image_size, info.matrix, distortion, f"{info.where}: K", fisheye)


def bounded(values: FloatArray, where: str) -> FloatArray:
    """Numbers of a file.

    Raises:
        InputError: one that is not finite or above 1e9.
    """
    if not (np.abs(values) <= _MOST).all():
        raise InputError(where, "a number that is not finite or beyond +-1e9", "numbers of a calibration")
    return values


def lens(values: FloatArray, model: str, where: str) -> tuple[FloatArray, bool]:
    """:func:`lens_coefficients` of what a file holds at ``where``.

    Raises:
        InputError: another model, or a number of coefficients that it does not have.
    """
    try:
        return lens_coefficients(values, model)
    except FieldError as error:
        problem = error.problems[0]
        raise InputError(where, problem.found, problem.expected) from None


def camera_of(
    size: tuple[int, int], matrix: FloatArray, distortion: FloatArray, where: str, fisheye: bool = False
) -> CameraModel:
    try:
        matrix, distortion = as_float_array(matrix, 3, 3), as_float_array(distortion)
    except ValueError as error:
        raise InputError(where, str(error), "a camera matrix of 3 x 3 numbers") from None
    off = (matrix[0, 1], matrix[1, 0], matrix[2, 0], matrix[2, 1], matrix[2, 2] - 1.0)
    if not (matrix[0, 0] > 0 and matrix[1, 1] > 0) or np.abs(off).max() > 1e-9:
        raise InputError(where, "another matrix", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px with fx, fy > 0")
    if np.abs(matrix).max() > MOST_PX:
        raise InputError(where, f"an entry of {np.abs(matrix).max():g} px", f"at most {MOST_PX:g} px")
    if np.abs(distortion).max() > MOST_COEFFICIENT:
        found = f"a lens with a coefficient of {np.abs(distortion).max():g}"
        raise InputError(where, found, f"coefficients within +-{MOST_COEFFICIENT:g}")
    if not all(1 <= n <= 32768 for n in size):
        raise InputError(where, f"an image of {size[0]} x {size[1]} px", "width and height of the images")
    return CameraModel(size, matrix, distortion, fisheye)


def whole_size(width: float, height: float, where: str) -> tuple[int, int]:
    if not (width == int(width) and height == int(height)):
        raise InputError(where, f"{width:g} x {height:g} px", "whole numbers")
    return int(width), int(height)


# Values of other programs' YAML files; unknown keys are ignored.


@dataclass(frozen=True, slots=True)
class _Parameters(Numbers):
    """Any number of numbers, also none."""

    def read(self, value: object, folder: Path | None = None, /) -> FloatArray:
        return as_float_array([]) if value == [] else Numbers.read(self, value, folder)


PARAMETERS = _Parameters(None)


@dataclass(frozen=True, slots=True)
class Values:
    """A document; ``name`` is how messages call its file."""

    document: Mapping[str, object]
    name: str

    def error(self, found: str, expected: str, *path: str) -> InputError:
        return input_error(Problem(path, found, expected), self.name, self.document)

    def read(self, kind: Kind, *path: str, default: object = None) -> Any:
        """A value of a kind; ``default`` where it is absent. Raises InputError."""
        value: object = self.document
        for i, key in enumerate(path):
            if not isinstance(value, Mapping):
                raise self.error(shown(value), f"a mapping with {', '.join(path[i:])}", *path[:i])
            if key not in value:
                if default is None:
                    raise self.error("nothing", kind.expected, *path[: i + 1])
                return default
            value = value[key]
        try:
            return kind.read(value)
        except FieldError as error:
            raise input_error(error.below(*path)[0], self.name, self.document) from None


def sized(stated: tuple[int, int] | None, given: tuple[int, int] | None, where: str) -> tuple[int, int]:
    """The size (w, h) px of the images, which the file states or the user gives.

    Raises:
        InputError: neither, or two sizes.
    """
    if stated is None and given is None:
        expected = "its width and height, or the size besides it (--calibration-size; image_size in a configuration)"
        raise InputError(where, "no size of the images", expected)
    if stated is not None and given is not None and stated != given:
        found = "images of {} x {} px".format(*stated)
        raise InputError(where, found, "{} x {} px, as the size that is given besides".format(*given))
    return stated or given or (0, 0)


def stereo_transform(rotation: FloatArray, shift_mm: FloatArray, where: str) -> FloatArray:
    """``right_T_left`` (4, 4) of a rotation (3, 3) with the rounding of a file and a translation (3,) mm.

    Raises:
        InputError: not a rotation.
    """
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise InputError(where, "a matrix that is no rotation", "a rotation")
    return as_float_array(make_transform(nearest_rotation(rotation), shift_mm))
