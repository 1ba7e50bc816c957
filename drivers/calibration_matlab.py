"""Calibrations of MATLAB's Computer Vision Toolbox: the struct of its parameters, as JSON, YAML or in a ``.mat``.

    fprintf(fopen("stereo.json", "w"), "%s", jsonencode(toStruct(stereoParams)));

MATLAB's conventions, and what they become:

- pixels count from 1: the principal point is one less, along both axes;
- points are rows, ``[X2 Y2 Z2] = [X1 Y1 Z1] * RotationOfCamera2 + TranslationOfCamera2``: the rotation is transposed;
- ``IntrinsicMatrix`` is transposed, ``K`` (since R2022b) is not: where the principal point stands in the matrix tells;
- ``PoseCamera2`` (since R2022b) has columns and needs no change;
- ``ImageSize`` is rows, columns; ``RadialDistortion`` k1, k2[, k3] and ``TangentialDistortion`` p1, p2 are OpenCV's.

What ``stereoParametersToOpenCV`` returned has OpenCV's conventions and the names of the function's outputs
(``intrinsicMatrix1``, ``rotationOfCamera2``, ...), by which it is known.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fgreg.drivers.calibration_parts import (
    MM_PER,
    PARAMETERS,
    Values,
    camera_of,
    lens,
    sized,
    stereo_transform,
    whole_size,
)
from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.schema.kinds import Numbers, Text
from fgreg.schema.matrices import Matrix
from fgreg.schema.problems import shown

_MM = {"mm": 1.0, "millimeters": 1.0, "cm": 10.0, "centimeters": 10.0, "m": 1000.0, "meters": 1000.0}
_MM |= {"in": 25.4, "inches": 25.4}
_CAMERAS = ("CameraParameters1", "CameraParameters2")
_MATRICES = ("IntrinsicMatrix", "K")
_OPENCV = "intrinsicMatrix1"
_FISHEYE = "MappingCoefficients"
HINT = 'the struct as JSON: fprintf(fopen("stereo.json", "w"), "%s", jsonencode(toStruct(stereoParams)))'


def is_binary(data: bytes) -> bool:
    """Whether a file is a .mat file."""
    return data.startswith((b"MATLAB ", b"\x89HDF\r\n\x1a\n"))


def struct_of(document: Mapping[str, object]) -> Mapping[str, object] | None:
    """The struct of a document, also where it stands under the variable's name; None where the document is of another
    kind."""
    inner = list(document.values())
    for candidate in (document, inner[0] if len(inner) == 1 else None):
        if isinstance(candidate, Mapping) and any(
            key in candidate for key in (*_CAMERAS, "IntrinsicMatrix", "RadialDistortion", _OPENCV, _FISHEYE)
        ):
            return candidate
    return None


def rig_of_struct(
    document: Mapping[str, object], name: str, unit: str | None, image_size: tuple[int, int] | None
) -> tuple[StereoRig, str]:
    """The rig of a struct and the unit that its lengths had; ``unit``: instead of the one that the struct states.

    Raises:
        InputError: bad input, with file and key, MATLAB's fisheye model, or no size of the images.
    """
    file = Values(document, name)
    if _OPENCV in document:
        return _opencv_rig(file, unit, image_size), unit or "mm"
    if _CAMERAS[0] not in document:
        return StereoRig(_camera(file, (), image_size)), unit or "mm"
    left, right = (_camera(file, (key,), image_size) for key in _CAMERAS)
    if left.image_size != right.image_size:
        raise InputError(f"{name}: {_CAMERAS[1]}.ImageSize", "another one than the first camera's", "two of one size")
    stated = file.read(Text("a unit"), _CAMERAS[0], "WorldUnits", default="mm")
    unit = unit or stated
    if unit not in _MM:
        raise InputError(f"{name}: WorldUnits", shown(unit), "mm, cm, m or in; or the unit given besides")
    if "RotationOfCamera2" in document:
        rotation = file.read(Matrix(3), "RotationOfCamera2").T
        shift = file.read(Numbers(3), "TranslationOfCamera2")
    else:
        pose = file.read(Matrix(4), "PoseCamera2", "A")
        rotation, shift = pose[:3, :3], pose[:3, 3]
    return StereoRig(left, right, stereo_transform(rotation, _MM[unit] * shift, f"{name}: RotationOfCamera2")), unit


def _camera(file: Values, path: tuple[str, ...], given: tuple[int, int] | None) -> CameraModel:
    """A camera of ``cameraParameters`` or, within them, of ``cameraIntrinsics``."""
    content = _mapping(file, path)
    if _FISHEYE in content or _FISHEYE in _inner(content):
        raise file.error("MATLAB's fisheye model (Scaramuzza's)", "cameraParameters; calibrate with these", *path)
    if not any(key in content for key in _MATRICES) and any(key in _inner(content) for key in _MATRICES):
        path = (*path, "Intrinsics")
        content = _mapping(file, path)
    key = next((key for key in _MATRICES if key in content), _MATRICES[0])
    matrix: FloatArray = file.read(Matrix(3), *path, key)
    if np.abs(matrix[:2, 2]).max() <= 1e-9 < np.abs(matrix[2, :2]).max():
        matrix = matrix.T
    matrix = matrix.copy()
    matrix[:2, 2] -= 1.0
    radial = file.read(PARAMETERS, *path, "RadialDistortion", default=np.zeros(2))
    tangential = file.read(PARAMETERS, *path, "TangentialDistortion", default=np.zeros(2))
    if radial.size not in (2, 3) or tangential.size != 2:
        found = f"{radial.size} radial and {tangential.size} tangential coefficients"
        raise file.error(found, "2 or 3 radial and 2 tangential ones", *path, "RadialDistortion")
    coefficients, fisheye = lens(np.concatenate([radial[:2], tangential, radial[2:]]), "", file.name)
    where = ".".join((*path, key))
    stated = _size(file, given, *path, "ImageSize")
    return camera_of(stated, matrix, coefficients, f"{file.name}: {where}", fisheye)


def _opencv_rig(file: Values, unit: str | None, given: tuple[int, int] | None) -> StereoRig:
    """What ``stereoParametersToOpenCV`` returned."""
    size = _size(file, given, "imageSize")
    cameras = []
    for side in ("1", "2"):
        parameters = file.read(PARAMETERS, f"distortionCoefficients{side}")
        coefficients, fisheye = lens(parameters, "", f"{file.name}: distortionCoefficients{side}")
        matrix = file.read(Matrix(3), f"intrinsicMatrix{side}")
        cameras.append(camera_of(size, matrix, coefficients, f"{file.name}: intrinsicMatrix{side}", fisheye))
    shift = MM_PER[unit or "mm"] * file.read(Numbers(3), "translationOfCamera2")
    rotation = file.read(Matrix(3), "rotationOfCamera2")
    right_T_left = stereo_transform(rotation, shift, f"{file.name}: rotationOfCamera2")
    return StereoRig(cameras[0], cameras[1], right_T_left)


def _size(file: Values, given: tuple[int, int] | None, *path: str) -> tuple[int, int]:
    stated = None
    values = file.read(PARAMETERS, *path, default=np.zeros(0))
    if values.size:
        if values.size != 2:
            raise file.error(f"{values.size} numbers", "rows, columns", *path)
        stated = whole_size(float(values[1]), float(values[0]), f"{file.name}: {'.'.join(path)}")
    return sized(stated, given, f"{file.name}: {'.'.join(path)}")


def _mapping(file: Values, path: tuple[str, ...]) -> Mapping[str, object]:
    value: object = file.document
    for key in path:
        value = value.get(key) if isinstance(value, Mapping) else None
    if not isinstance(value, Mapping):
        raise file.error(shown(value), "the struct of a camera", *path)
    return value


def _inner(content: Mapping[str, object]) -> Mapping[str, object]:
    inner = content.get("Intrinsics")
    return inner if isinstance(inner, Mapping) else {}
