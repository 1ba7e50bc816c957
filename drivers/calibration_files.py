"""Reads calibration files as a StereoRig: of ROS, OpenCV, Kalibr, scikit-surgery and MATLAB.

Content of each kind, and how it is converted (``right_T_left`` maps left coordinates to right ones, mm):

- ROS: ``K``, ``D``, ``R``, ``P`` of each camera, metres. The rectified cameras are parallel, apart by
  ``b = P_right[:, 3] / f - P_left[:, 3] / f``; so ``right_T_left = [R_right' R_left, R_right' b]``.
- OpenCV: matrices ``M1 D1 M2 D2`` (or ``K1``, ``cameraMatrix1``, ...) with ``R``, ``T`` of ``stereoCalibrate``, which
  are ``right_T_left`` itself, in the units of the board; read as millimetres. Of ``cv2.FileStorage``, or plain JSON or
  YAML with the same names.
- Kalibr: ``cam0`` is left, ``cam1`` right, ``T_cn_cnm1`` of cam1 is ``right_T_left``, metres.
- ``ost.txt`` and scikit-surgery: fgreg.drivers.calibration_texts. MATLAB: fgreg.drivers.calibration_matlab.

Lens models are those of OpenCV: plumb_bob or radtan, the rational and the thin prism one, and fisheye (equidistant, of
Kannala and Brandt). Files of other models are refused by name. ``rectified`` reads the model of images that were
rectified already: the matrix from ``P``, no distortion, cameras parallel. The ``camera`` frame is then the *rectified*
left camera, rotated by ``R_left`` against the real one, and the registration refers to it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from fgreg.drivers.calibration_matlab import HINT, is_binary, rig_of_struct, struct_of
from fgreg.drivers.calibration_parts import (
    MM_PER,
    PARAMETERS,
    ROTATION_TOLERANCE,
    CameraInfo,
    Values,
    bounded,
    camera_of,
    lens,
    rig_of_infos,
    sized,
    stereo_transform,
    whole_size,
)
from fgreg.drivers.calibration_texts import is_ost, is_scikit_surgery, read_ost, read_scikit_surgery
from fgreg.drivers.confined_parsers import is_storage, read_mat, read_storage
from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray, is_rigid
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.schema.kinds import Integer, Kind, Numbers, Text
from fgreg.schema.limits import SETUP_BYTES
from fgreg.schema.matrices import Matrix
from fgreg.schema.problems import shown
from fgreg.session.yaml_loader import load_yaml, read_bounded

_BASELINE_MM = (0.5, 500.0)


@dataclass(frozen=True, slots=True)
class Calibration:
    """An endoscope's calibration, and warnings about values that are allowed but probably a mistake."""

    rig: StereoRig
    warnings: tuple[str, ...] = ()


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
        unit: of the file's lengths, ``m`` or ``mm``. Default: metres for ROS and Kalibr, what the file states for
            MATLAB, else millimetres.
        rectified: the images were rectified with this calibration.
        image_size: (width, height) px, for files that do not state it.

    Raises:
        InputError: bad input, with file and key.
    """
    if not 1 <= len(files) <= 2:
        raise InputError("calibration", f"{len(files)} files", "one file, or two: left and right")
    if unit is not None and unit not in MM_PER:
        raise InputError("calibration: unit", unit, "m or mm")
    kinds = [_kind(path) for path in files]
    if kinds[0] is not kinds[-1]:
        raise InputError(files[1].name, f"{kinds[1].value} beside {kinds[0].value}", "two of one kind")
    kind, name = kinds[0], files[0].name
    if len(files) > 1 and kind in _ALONE:
        raise InputError(files[1].name, "a second file", f"{kind.value} alone, which has both cameras")
    if rectified and kind not in _WITH_PROJECTION:
        expected = "a calibration with projection matrices (ROS, OpenCV), for rectified images"
        raise InputError(name, kind.value, expected)
    metres = kind in (_Kind.ROS, _Kind.OST, _Kind.KALIBR)
    used = unit or ("m" if metres else "mm")
    if kind is _Kind.OPENCV:
        rig = _from_storage(files, MM_PER[used], rectified, image_size)
    elif kind is _Kind.SCIKIT_SURGERY:
        rig = read_scikit_surgery(files[0], MM_PER[used], image_size)
    elif kind is _Kind.OST:
        rig = _rig_of(read_ost(files), MM_PER[used], rectified)
    else:
        documents = [_document(path) for path in files]
        if kind is _Kind.KALIBR:
            rig = _from_kalibr(documents[0], name, MM_PER[used])
        elif kind is _Kind.MATLAB:
            rig, used = rig_of_struct(struct_of(documents[0]) or {}, name, unit, image_size)
        else:
            infos = [_camera_info(document, path.name) for document, path in zip(documents, files, strict=True)]
            rig = _rig_of(infos, MM_PER[used], rectified)
    sized(rig.left.image_size, image_size, name)
    return _checked(rig, files[-1].name, used)


class _Kind(Enum):
    """Who wrote a file, as messages call it."""

    ROS = "a ROS camera_info"
    OST = "an ost.txt"
    OPENCV = "an OpenCV file"
    KALIBR = "a Kalibr camchain"
    SCIKIT_SURGERY = "a scikit-surgery file"
    MATLAB = "a MATLAB struct"


_ALONE = (_Kind.KALIBR, _Kind.SCIKIT_SURGERY, _Kind.MATLAB)
_WITH_PROJECTION = (_Kind.ROS, _Kind.OST, _Kind.OPENCV)


def _kind(path: Path) -> _Kind:
    data = read_bounded(path, path.name, SETUP_BYTES)
    if is_scikit_surgery(path):
        return _Kind.SCIKIT_SURGERY
    if is_storage(data):
        return _Kind.OPENCV
    if is_ost(data):
        return _Kind.OST
    document = _document(path)
    if "cam0" in document:
        return _Kind.KALIBR
    if _is_plain(document):
        return _Kind.OPENCV
    return _Kind.ROS if struct_of(document) is None else _Kind.MATLAB


def _document(path: Path) -> Mapping[str, object]:
    """The content of a YAML, JSON or .mat file."""
    if not is_binary(read_bounded(path, path.name, SETUP_BYTES)):
        return load_yaml(path, path.name)
    try:
        return read_mat(path, path.name)
    except InputError as error:
        raise InputError(path.name, error.found, f"{error.expected}, or {HINT}") from None


def _rig_of(infos: Sequence[CameraInfo], mm_per_unit: float, rectified: bool) -> StereoRig:
    return rig_of_infos(infos[0], infos[1] if len(infos) == 2 else None, mm_per_unit, rectified)


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
    file = Values(document, name)
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
    d, p = matrix("distortion_coefficients", "d", PARAMETERS), matrix("projection_matrix", "p", Numbers(12))
    model = file.read(Text("the name of a distortion model"), "distortion_model", default="plumb_bob")
    _refuse_cropped(file, (width, height))
    return CameraInfo(name, (width, height), k.reshape(3, 3), d, model, r.reshape(3, 3), p.reshape(3, 4))


def _refuse_cropped(file: Values, size: tuple[int, int]) -> None:
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
    *("D1", "distCoeffs1", "dist_coeffs_1", "distortion_1", "distortion_left", "left_distortion", "D_left"),
    *("distortion_coefficients_left", "distortion_coeffs_left", "dist_coeffs_left", "left_distortion_coefficients"),
    *("distCoeffs_left", "dist_left", "distortion_coefficients_1", "distortion1"),
)
_ONE_MATRIX = ("camera_matrix", "cameraMatrix", "K", "M", "intrinsic", "camera_intrinsics", "mtx")
_ONE_DISTORTION = (
    *("distortion_coefficients", "distCoeffs", "dist_coeffs", "D", "distortion", "dist_coeff", "dist"),
    *("distortion_coeffs", "dist_coefs", "dist_coefficients"),
)
_ROTATION = ("R", "rotation", "R_stereo", "rotation_matrix")
_TRANSLATION = ("T", "translation", "t", "T_stereo", "translation_vector")


def _right_names(names: Sequence[str]) -> tuple[str, ...]:
    return tuple(re.sub("1$", "2", name).replace("left", "right") for name in names)


def _from_storage(
    files: Sequence[Path], mm_per_unit: float, rectified: bool, image_size: tuple[int, int] | None
) -> StereoRig:
    """OpenCV's own files: both cameras by numbered names, or one camera a file and R, T in either."""
    contents = [_storage(path) for path in files]
    merged: dict[str, object] = {}
    for content in contents:
        merged |= content
    name = " and ".join(path.name for path in files)
    size = sized(_storage_size(merged, name), image_size, name)
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
    return StereoRig(left, right, stereo_transform(rotation, shift * mm_per_unit, f"{name}: R"))


def _storage(path: Path) -> Mapping[str, object]:
    """The values of a file by their names: of ``cv2.FileStorage``, or of plain JSON or YAML with lists of numbers."""
    if is_storage(read_bounded(path, path.name, SETUP_BYTES)):
        return read_storage(path, path.name)
    return {key: _plain(value) for key, value in _document(path).items()}


def _plain(value: object) -> object:
    try:
        return np.array(value, dtype=np.float64) if isinstance(value, list) else value
    except (ValueError, TypeError, OverflowError):
        return None


def _is_plain(document: Mapping[str, object]) -> bool:
    """Whether a document has OpenCV's matrices as lists of rows, as programs write that dump arrays."""
    names = (*_LEFT_MATRIX, *_ONE_MATRIX, *_ROTATION)
    return any(isinstance(rows := document.get(name), list) and len(rows) == 3 for name in names)


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
    other = [key for key in content if re.search("dist(?!ance|ortion_model)", key, re.IGNORECASE)]
    if found is None and other:  # a lens that is left out is a wrong camera
        raise InputError(f"{name}: {distortion[0]}", f"nothing, beside {shown(other[0])}", ", ".join(distortion)[:300])
    parameters = np.zeros(5) if found is None else _array(content, (found,), name, None)
    coefficients, fisheye = lens(parameters, _storage_model(content), f"{name}: {found}")
    return camera_of(size, values, coefficients, f"{name}: {matrix[0]}", fisheye)


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
    return bounded(np.asarray(value, dtype=np.float64).ravel(), f"{file}: {key}")


def _storage_size(content: Mapping[str, object], name: str) -> tuple[int, int] | None:
    for across, down in (("image_width", "image_height"), ("width", "height"), ("imageWidth", "imageHeight")):
        pair = content.get(across), content.get(down)
        if isinstance(pair[0], float | int) and isinstance(pair[1], float | int):
            return whole_size(float(pair[0]), float(pair[1]), f"{name}: {across}")
    for key in ("image_size", "imageSize", "size", "resolution"):
        value = content.get(key)
        if isinstance(value, np.ndarray) and value.size == 2:
            return whole_size(float(value.ravel()[0]), float(value.ravel()[1]), f"{name}: {key}")
    return None


# Kalibr


def _from_kalibr(document: Mapping[str, object], name: str, mm_per_unit: float) -> StereoRig:
    file = Values(document, name)
    if any(key.startswith("cam") and key not in ("cam0", "cam1") for key in document):
        raise InputError(name, "more than two cameras", "cam0, the left one, and cam1, the right one")
    left = _kalibr_camera(file, "cam0")
    if "cam1" not in document:
        return StereoRig(left)
    right = _kalibr_camera(file, "cam1")
    matrix = file.read(Matrix(4), "cam1", "T_cn_cnm1")
    if not is_rigid(matrix, ROTATION_TOLERANCE):
        raise file.error("a matrix that is not rigid", "the transform from cam0 to cam1", "cam1", "T_cn_cnm1")
    if left.image_size != right.image_size:
        raise InputError(f"{name}: cam1.resolution", "another one than cam0's", "two cameras of one size")
    right_T_left = stereo_transform(matrix[:3, :3], matrix[:3, 3] * mm_per_unit, f"{name}: cam1.T_cn_cnm1")
    return StereoRig(left, right, right_T_left)


def _kalibr_camera(file: Values, key: str) -> CameraModel:
    file.read(Text(allowed=("pinhole",)), key, "camera_model", default="pinhole")
    fu, fv, pu, pv = file.read(Numbers(4), key, "intrinsics")
    width, height = file.read(Numbers(2), key, "resolution")
    distortion_model = file.read(Text("radtan"), key, "distortion_model", default="none")
    distortion = file.read(PARAMETERS, key, "distortion_coeffs", default=np.zeros(0))
    matrix = np.array([[fu, 0.0, pu], [0.0, fv, pv], [0.0, 0.0, 1.0]])
    size = whole_size(float(width), float(height), f"{file.name}: {key}.resolution")
    parameters, fisheye = lens(distortion, distortion_model, f"{file.name}: {key}.distortion_coeffs")
    return camera_of(size, matrix, parameters, f"{file.name}: {key}.intrinsics", fisheye)
