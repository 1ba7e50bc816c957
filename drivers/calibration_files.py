"""Reads calibration files as a StereoRig: ROS ``camera_info``, OpenCV FileStorage, Kalibr camchains.

Content of each kind, and how it is converted (``right_T_left`` maps left coordinates to right ones, mm):

- ROS: ``K``, ``D``, ``R``, ``P`` of each camera, metres. The rectified cameras are parallel, apart by
  ``b = P_right[:, 3] / f - P_left[:, 3] / f``; so ``right_T_left = [R_right' R_left, R_right' b]``.
- OpenCV: matrices ``M1 D1 M2 D2`` (or ``K1``, ``cameraMatrix1``, ...) with ``R``, ``T`` of ``stereoCalibrate``, which
  are ``right_T_left`` itself, in the units of the board; read as millimetres.
- Kalibr: ``cam0`` is left, ``cam1`` right, ``T_cn_cnm1`` of cam1 is ``right_T_left``, metres.

Lens models are those of OpenCV: plumb_bob or radtan, the rational and the thin prism one, and fisheye (equidistant, of
Kannala and Brandt). Files of other models are refused by name. ``rectified`` reads the model of images that were
rectified already: the matrix from ``P``, no distortion, cameras parallel. The ``camera`` frame is then the *rectified*
left camera, rotated by ``R_left`` against the real one, and the registration refers to it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.drivers.opencv_storage import is_storage, read_storage
from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray, as_float_array, is_rigid, make_transform, nearest_rotation
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.schema.kinds import Integer, Kind, Numbers, Text
from fgreg.schema.matrices import Matrix
from fgreg.schema.problems import FieldError, Problem, input_error, shown
from fgreg.session.yaml_loader import load_yaml, read_bounded

MM_PER = {"m": 1000.0, "mm": 1.0}
"""Units that a calibration's lengths can have."""

POLYNOMIAL = ("plumb_bob", "radtan", "rational_polynomial", "pinhole", "none", "")
FISHEYE = ("fisheye", "equidistant")
_BASELINE_MM = (0.5, 500.0)
_MAX_BYTES = 4_000_000
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True, slots=True)
class Calibration:
    """An endoscope's calibration, and warnings about values that are allowed but probably a mistake."""

    rig: StereoRig
    warnings: tuple[str, ...] = ()


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


def read_calibration(
    files: Sequence[Path],
    *,
    unit: str | None = None,
    rectified: bool = False,
    image_size: tuple[int, int] | None = None,
) -> Calibration:
    """An endoscope's calibration from one file or two.

    Args:
        files: one (one camera, or both in one file) or two: left, then right ``camera_info``; or OpenCV's intrinsics
            and extrinsics in any order.
        unit: of the file's lengths, ``m`` or ``mm``. Default: metres for ROS and Kalibr, millimetres for OpenCV.
        rectified: the images were rectified with this calibration.
        image_size: (width, height) px, for OpenCV files without it.

    Raises:
        InputError: bad input, with file and key.
    """
    if not 1 <= len(files) <= 2:
        raise InputError("calibration", f"{len(files)} files", "one file, or two: left and right")
    if unit is not None and unit not in MM_PER:
        raise InputError("calibration: unit", unit, "m or mm")
    storage = [is_storage(read_bounded(path, path.name, _MAX_BYTES)) for path in files]
    if all(storage):
        rig = _from_storage(files, MM_PER[unit or "mm"], rectified, image_size)
        return _checked(rig, files[0].name, unit or "mm")
    if any(storage):
        raise InputError(files[storage.index(True)].name, "an OpenCV file beside another kind", "two of one kind")
    documents = [load_yaml(path, path.name, max_bytes=_MAX_BYTES) for path in files]
    chains = ["cam0" in document for document in documents]
    scale = MM_PER[unit or "m"]
    if any(chains):
        if len(files) > 1:
            raise InputError(files[1].name, "a second file", "a Kalibr camchain alone, which has both cameras")
        if rectified:
            raise InputError(files[0].name, "a Kalibr camchain", "a calibration with projection matrices (ROS, OpenCV)")
        rig = _from_kalibr(documents[0], files[0].name, scale)
    else:
        infos = [_camera_info(document, path.name) for document, path in zip(documents, files, strict=True)]
        rig = rig_of_infos(infos[0], infos[1] if len(infos) == 2 else None, scale, rectified)
    return _checked(rig, files[-1].name, unit or "m")


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
    for name, matrix in (("K", info.matrix), ("P", info.projection)):
        if not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
            raise InputError(f"{info.where}: {name}", "focal lengths that are not > 0", "a calibrated camera")
    r = info.rectification
    if np.abs(r.T @ r - np.eye(3)).max() > _ROTATION_TOLERANCE or np.linalg.det(r) < 0:
        raise InputError(f"{info.where}: R", "a matrix that is no rotation", "a rotation")
    if rectified:
        return _camera(info.image_size, info.projection[:, :3], np.zeros(5), f"{info.where}: P")
    distortion, fisheye = lens(info.distortion, info.distortion_model, f"{info.where}: D")
    return _camera(info.image_size, info.matrix, distortion, f"{info.where}: K", fisheye)


def lens(values: FloatArray, model: str, where: str) -> tuple[FloatArray, bool]:
    """A file's distortion parameters in OpenCV's order, at least 5 or 4 of a fisheye lens, and whether it is one.

    Raises:
        InputError: another model, or a number of parameters that it does not have.
    """
    values = np.asarray(values, dtype=np.float64).ravel()
    if model in FISHEYE:
        if values.size != 4:
            raise InputError(where, f"{values.size} parameters", "4, of a fisheye lens")
        return values, True
    if model not in POLYNOMIAL:
        expected = "plumb_bob, radtan, rational_polynomial, or equidistant (fisheye); calibrate with one of these"
        raise InputError(where, f"the distortion model {shown(model)}", expected)
    if values.size not in (0, 4, 5, 8, 12, 14):
        raise InputError(where, f"{values.size} parameters", "4, 5, 8 or 12, in OpenCV's order")
    if values[12:].any():
        raise InputError(where, f"{values.size} parameters, with a tilted sensor", "4, 5, 8 or 12, in OpenCV's order")
    needed = next(size for size in (5, 8, 12) if not values[size:].any())
    out = np.zeros(needed)
    out[: values.size] = values[:needed]
    return out, False


def _camera(
    size: tuple[int, int], matrix: FloatArray, distortion: FloatArray, where: str, fisheye: bool = False
) -> CameraModel:
    try:
        matrix, distortion = as_float_array(matrix, 3, 3), as_float_array(distortion)
    except ValueError as error:
        raise InputError(where, str(error), "a camera matrix of 3 x 3 numbers") from None
    off = (matrix[0, 1], matrix[1, 0], matrix[2, 0], matrix[2, 1], matrix[2, 2] - 1.0)
    if not (matrix[0, 0] > 0 and matrix[1, 1] > 0) or np.abs(off).max() > 1e-9:
        raise InputError(where, "another matrix", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px with fx, fy > 0")
    if not all(1 <= n <= 32768 for n in size):
        raise InputError(where, f"an image of {size[0]} x {size[1]} px", "width and height of the images")
    return CameraModel(size, matrix, distortion, fisheye)


def _checked(rig: StereoRig, name: str, unit: str) -> Calibration:
    """Check that the baseline can be an endoscope's, which catches metres read as millimetres."""
    if rig.right_T_left is None:
        return Calibration(rig)
    shift = rig.right_T_left[:3, 3]
    baseline = float(np.linalg.norm(shift))
    low, high = _BASELINE_MM
    if not low <= baseline <= high:
        other = "mm" if unit == "m" else "m"
        found = f"cameras {baseline:.4g} mm apart, where lengths are in {unit}"
        raise InputError(name, found, f"{low:g} to {high:g} mm; say so where lengths are in {other}")
    if shift[0] > 0.0 and abs(shift[0]) > 0.5 * baseline:
        text = f"{name}: the camera called right is {shift[0]:.3g} mm to the left of the other; are the two swapped?"
        return Calibration(rig, (text,))
    return Calibration(rig)


# ROS camera_info


def _camera_info(document: Mapping[str, object], name: str) -> CameraInfo:
    """A ``camera_info`` file: of camera_calibration (nested matrices) or an echoed message (flat lists)."""
    file = _Values(document, name)
    nested = "camera_matrix" in document
    if not nested and not ("k" in document or "K" in document):
        kinds = "ROS camera_info, OpenCV FileStorage or Kalibr camchain"
        raise InputError(name, "no camera_matrix, K or cam0", f"a calibration: {kinds}")
    width, height = (file.read(Integer(1, 32768), f"image_{key}" if nested else key) for key in ("width", "height"))

    def matrix(long: str, letter: str, kind: Kind) -> FloatArray:
        key = letter if letter in document else letter.upper()
        values: FloatArray = file.read(kind, long, "data") if nested else file.read(kind, key)
        return values

    k, r = (matrix(long, short, Numbers(9)) for long, short in (("camera_matrix", "k"), ("rectification_matrix", "r")))
    d, p = matrix("distortion_coefficients", "d", _PARAMETERS), matrix("projection_matrix", "p", Numbers(12))
    model = file.read(Text("the name of a distortion model"), "distortion_model", default="plumb_bob")
    _refuse_cropped(file, (width, height))
    return CameraInfo(name, (width, height), k.reshape(3, 3), d, model, r.reshape(3, 3), p.reshape(3, 4))


def _refuse_cropped(file: _Values, size: tuple[int, int]) -> None:
    for key in ("binning_x", "binning_y"):
        found = file.document.get(key)
        if found not in (None, 0, 1):
            raise file.error(shown(found), "0 or 1: images without binning", key)
    roi = file.document.get("roi")
    if isinstance(roi, Mapping) and (roi.get("width") or 0, roi.get("height") or 0) not in ((0, 0), size):
        raise file.error("a part of the image", "the whole image", "roi")


# OpenCV FileStorage

_LEFT_MATRIX = ("M1", "K1", "cameraMatrix1", "camera_matrix_1", "camera_matrix_left", "left_camera_matrix", "M_left")
_LEFT_DISTORTION = (
    "D1",
    "distCoeffs1",
    "dist_coeffs_1",
    "distortion_1",
    "distortion_left",
    "left_distortion",
    "D_left",
)
_ONE_MATRIX = ("camera_matrix", "cameraMatrix", "K", "M", "intrinsic", "camera_intrinsics")
_ONE_DISTORTION = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "D", "distortion")
_ROTATION, _TRANSLATION = ("R", "rotation", "R_stereo"), ("T", "translation", "t", "T_stereo")


def _right_names(names: Sequence[str]) -> tuple[str, ...]:
    return tuple(re.sub("1$", "2", name).replace("left", "right") for name in names)


def _from_storage(
    files: Sequence[Path], mm_per_unit: float, rectified: bool, image_size: tuple[int, int] | None
) -> StereoRig:
    """OpenCV's own files: both cameras by numbered names, or one camera a file and R, T in either."""
    contents = [read_storage(path, path.name) for path in files]
    merged: dict[str, object] = {}
    for content in contents:
        merged |= content
    name = " and ".join(path.name for path in files)
    size = image_size or _storage_size(merged, name)
    both = any(key in merged for key in _LEFT_MATRIX)
    if both:
        left = _storage_camera(merged, name, _LEFT_MATRIX, _LEFT_DISTORTION, size)
        right = _storage_camera(merged, name, _right_names(_LEFT_MATRIX), _right_names(_LEFT_DISTORTION), size)
    else:
        cameras = [
            _storage_camera(content, path.name, _ONE_MATRIX, _ONE_DISTORTION, size)
            for content, path in zip(contents, files, strict=True)
        ]
        if len(cameras) == 1:
            if rectified:
                raise InputError(name, "one camera", "a stereo calibration with P1 and P2, for rectified images")
            return StereoRig(cameras[0])
        left, right = cameras
    if rectified:
        return _storage_rectified(merged, name, size, mm_per_unit)
    rotation = _array(merged, _ROTATION, name, 9).reshape(3, 3)
    shift = _array(merged, _TRANSLATION, name, 3)
    transform = make_transform(rotation, shift * mm_per_unit)
    if not is_rigid(transform, _ROTATION_TOLERANCE):
        raise InputError(f"{name}: R", "a matrix that is no rotation", "the rotation of stereoCalibrate")
    return StereoRig(left, right, as_float_array(make_transform(nearest_rotation(rotation), transform[:3, 3])))


def _storage_rectified(
    content: Mapping[str, object], name: str, size: tuple[int, int], mm_per_unit: float
) -> StereoRig:
    infos = []
    for key in ("P1", "P2"):
        p = _array(content, (key,), name, 12).reshape(3, 4)
        infos.append(CameraInfo(f"{name}: {key}", size, p[:, :3], np.zeros(5), "plumb_bob", np.eye(3), p))
    return rig_of_infos(infos[0], infos[1], mm_per_unit, rectified=True)


def _storage_camera(
    content: Mapping[str, object], name: str, matrix: Sequence[str], distortion: Sequence[str], size: tuple[int, int]
) -> CameraModel:
    values = _array(content, matrix, name, 9).reshape(3, 3)
    found = next((key for key in distortion if key in content), None)
    parameters = np.zeros(5) if found is None else _array(content, (found,), name, None)
    coefficients, fisheye = lens(parameters, _storage_model(content), f"{name}: {found}")
    return _camera(size, values, coefficients, f"{name}: {matrix[0]}", fisheye)


def _storage_model(content: Mapping[str, object]) -> str:
    """The lens model that an OpenCV file names; nothing where it names none. Four parameters alone do not tell."""
    if any(content.get(key) not in (None, 0.0) for key in ("fisheye_model", "fisheye")):
        return "fisheye"
    named = next((content[key] for key in ("distortion_model", "camera_model", "model") if key in content), "")
    return named.lower() if isinstance(named, str) else ""


def _array(content: Mapping[str, object], names: Sequence[str], file: str, count: int | None) -> FloatArray:
    key = next((name for name in names if name in content), None)
    if key is None:
        kind = "a matrix" if count is None else f"{count} numbers"
        raise InputError(f"{file}: {names[0]}", "nothing", f"{kind} called {', '.join(names)}")
    value = content[key]
    if not isinstance(value, np.ndarray) or (count is not None and value.size != count):
        found = f"{value.size} numbers" if isinstance(value, np.ndarray) else shown(value)
        raise InputError(f"{file}: {key}", found, "a matrix" if count is None else f"{count} numbers")
    if not np.isfinite(value).all():
        raise InputError(f"{file}: {key}", "an entry that is not finite", "finite numbers")
    return np.asarray(value, dtype=np.float64).ravel()


def _storage_size(content: Mapping[str, object], name: str) -> tuple[int, int]:
    for across, down in (("image_width", "image_height"), ("width", "height"), ("imageWidth", "imageHeight")):
        pair = content.get(across), content.get(down)
        if isinstance(pair[0], float) and isinstance(pair[1], float):
            return _whole(pair[0], pair[1], f"{name}: {across}")
    for key in ("image_size", "imageSize", "size", "resolution"):
        value = content.get(key)
        if isinstance(value, np.ndarray) and value.size == 2:
            return _whole(float(value.ravel()[0]), float(value.ravel()[1]), f"{name}: {key}")
    raise InputError(name, "no size of the images", "image_width and image_height, or the size given besides")


def _whole(width: float, height: float, where: str) -> tuple[int, int]:
    if not (width == int(width) and height == int(height)):
        raise InputError(where, f"{width:g} x {height:g} px", "whole numbers")
    return int(width), int(height)


# Kalibr


def _from_kalibr(document: Mapping[str, object], name: str, mm_per_unit: float) -> StereoRig:
    file = _Values(document, name)
    if any(key.startswith("cam") and key not in ("cam0", "cam1") for key in document):
        raise InputError(name, "more than two cameras", "cam0, the left one, and cam1, the right one")
    left = _kalibr_camera(file, "cam0")
    if "cam1" not in document:
        return StereoRig(left)
    right = _kalibr_camera(file, "cam1")
    matrix = file.read(Matrix(4), "cam1", "T_cn_cnm1")
    if not is_rigid(matrix, _ROTATION_TOLERANCE):
        raise file.error("a matrix that is not rigid", "the transform from cam0 to cam1", "cam1", "T_cn_cnm1")
    if left.image_size != right.image_size:
        raise InputError(f"{name}: cam1.resolution", "another one than cam0's", "two cameras of one size")
    right_T_left = make_transform(nearest_rotation(matrix[:3, :3]), matrix[:3, 3] * mm_per_unit)
    return StereoRig(left, right, as_float_array(right_T_left))


def _kalibr_camera(file: _Values, key: str) -> CameraModel:
    file.read(Text(allowed=("pinhole",)), key, "camera_model", default="pinhole")
    fu, fv, pu, pv = file.read(Numbers(4), key, "intrinsics")
    width, height = file.read(Numbers(2), key, "resolution")
    distortion_model = file.read(Text("radtan"), key, "distortion_model", default="none")
    distortion = file.read(_PARAMETERS, key, "distortion_coeffs", default=np.zeros(0))
    matrix = np.array([[fu, 0.0, pu], [0.0, fv, pv], [0.0, 0.0, 1.0]])
    size = _whole(float(width), float(height), f"{file.name}: {key}.resolution")
    parameters, fisheye = lens(distortion, distortion_model, f"{file.name}: {key}.distortion_coeffs")
    return _camera(size, matrix, parameters, f"{file.name}: {key}.intrinsics", fisheye)


# Values of other programs' YAML files; unknown keys are ignored.


@dataclass(frozen=True, slots=True)
class _Parameters(Numbers):
    """Any number of numbers, also none."""

    def read(self, value: object, folder: Path | None = None, /) -> FloatArray:
        return as_float_array([]) if value == [] else Numbers.read(self, value, folder)


_PARAMETERS = _Parameters(None)


@dataclass(frozen=True, slots=True)
class _Values:
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
