"""Calibrations in plain text: ``ost.txt`` of ROS' camera_calibration, and the files of scikit-surgery.

``ost.txt`` has the numbers of a ``camera_info`` without the name of the lens model: 5 coefficients are plumb_bob, 8 the
rational model. A file with 4 is refused, since those may be a fisheye lens' as well; ``ost.yaml`` beside it says.

scikit-surgery writes, with a prefix (``calib`` by default), ``PREFIX.left.intrinsics.txt`` (3 x 3),
``PREFIX.left.distortion.txt`` and the same of ``right``, and ``PREFIX.l2r.txt``, the 4 x 4 ``right_T_left`` of
``cv2.stereoCalibrate``, mm; of one camera ``PREFIX.intrinsics.txt`` and ``PREFIX.distortion.txt``. The size of the
images is in none of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fgreg.drivers.calibration_parts import (
    CameraInfo,
    bounded,
    camera_of,
    lens,
    sized,
    stereo_transform,
    whole_size,
)
from fgreg.errors import InputError, one_line
from fgreg.geometry.transforms import FloatArray
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.schema.limits import SETUP_BYTES
from fgreg.session.yaml_loader import read_bounded

_L2R, _INTRINSICS, _DISTORTION = ".l2r.txt", ".intrinsics.txt", ".distortion.txt"
_OST_KEYS = {"width": 1, "height": 1, "camera matrix": 9, "distortion": None, "rectification": 9, "projection": 12}
_MOST_NUMBERS = 20


# ost.txt


def is_ost(data: bytes) -> bool:
    """Whether a file is an ``ost.txt``."""
    return any(line.strip() == b"[image]" for line in data[:4096].splitlines())


def read_ost(files: Sequence[Path]) -> list[CameraInfo]:
    """The cameras of one or two files, left first where their sections are called ``.../left`` and ``.../right``.

    Raises:
        InputError: bad input, with file and line.
    """
    found: list[tuple[str, CameraInfo]] = []
    for path in files:
        found += _ost_cameras(_text(path), path.name)
    if not 1 <= len(found) <= 2:
        raise InputError(files[-1].name, f"{len(found)} cameras", "one camera, or left and right")
    names = [name.rsplit("/", 1)[-1] for name, _ in found]
    return [info for _, info in (reversed(found) if names == ["right", "left"] else found)]


def _ost_cameras(text: str, name: str) -> list[tuple[str, CameraInfo]]:
    """The cameras of a file with their sections' names; each camera begins with a section ``[image]``."""
    cameras: list[tuple[str, CameraInfo]] = []
    section, key = "", ""
    values: dict[str, list[float]] = {}

    def finish() -> None:
        if values:
            cameras.append((section, _ost_info(values, f"{name}: [{section}]")))

    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or words[0][0] in "#;":
            continue
        stripped = line.strip()
        if stripped.startswith("[") and stripped.endswith("]"):
            if stripped == "[image]":
                finish()
                values = {}
            section, key = stripped[1:-1], ""
            continue
        if stripped in _OST_KEYS:
            if stripped in values:
                raise InputError(f"{name}: line {number}", f"a second {stripped}", "one in a camera")
            key = stripped
            values[key] = []
            continue
        if not key or stripped[0].isalpha() or len(values[key]) + len(words) > _MOST_NUMBERS:
            raise InputError(f"{name}: line {number}", f"'{one_line(stripped)[:40]}'", "one of " + ", ".join(_OST_KEYS))
        values[key] += _numbers(words, f"{name}: line {number}")
    finish()
    return cameras


def _ost_info(values: dict[str, list[float]], where: str) -> CameraInfo:
    for key, count in _OST_KEYS.items():
        if key not in values or (count is not None and len(values[key]) != count):
            found = f"{len(values[key])} numbers" if key in values else "nothing"
            raise InputError(f"{where}: {key}", found, f"{count} numbers" if count else "the coefficients")
    distortion = np.array(values["distortion"])
    if distortion.size == 4:
        expected = "5 or 8 (4 may be k1, k2, p1, p2 or a fisheye lens'): ost.yaml, which names the model"
        raise InputError(f"{where}: distortion", "4 coefficients without the name of their model", expected)
    k, r, p = (np.array(values[key]).reshape(3, -1) for key in ("camera matrix", "rectification", "projection"))
    size = whole_size(values["width"][0], values["height"][0], f"{where}: width")
    return CameraInfo(where, size, k, distortion, "rational_polynomial" if distortion.size == 8 else "plumb_bob", r, p)


# scikit-surgery


def is_scikit_surgery(path: Path) -> bool:
    """Whether a file is one of scikit-surgery's, by its name."""
    return path.name.endswith((_L2R, _INTRINSICS, _DISTORTION))


def read_scikit_surgery(path: Path, mm_per_unit: float, image_size: tuple[int, int] | None) -> StereoRig:
    """Both cameras of a ``.l2r.txt`` and the files beside it, or the one of an ``.intrinsics.txt``.

    Raises:
        InputError: bad input, with the file, or no size of the images.
    """
    size = sized(None, image_size, path.name)
    if not path.name.endswith(_L2R):
        end = _INTRINSICS if path.name.endswith(_INTRINSICS) else _DISTORTION
        return StereoRig(_scikit_camera(path, path.name.removesuffix(end), size))
    prefix = path.name.removesuffix(_L2R)
    left, right = (_scikit_camera(path, f"{prefix}.{side}", size) for side in ("left", "right"))
    matrix = _table(path, 16).reshape(4, 4)
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-9:
        raise InputError(path.name, "a last row that is not 0 0 0 1", "a rigid transform, 4 x 4")
    return StereoRig(left, right, stereo_transform(matrix[:3, :3], mm_per_unit * matrix[:3, 3], path.name))


def _scikit_camera(beside: Path, prefix: str, size: tuple[int, int]) -> CameraModel:
    intrinsics, distortion = (beside.with_name(prefix + end) for end in (_INTRINSICS, _DISTORTION))
    coefficients, fisheye = lens(_table(distortion, None), "", distortion.name)
    return camera_of(size, _table(intrinsics, 9).reshape(3, 3), coefficients, intrinsics.name, fisheye)


def _table(path: Path, count: int | None) -> FloatArray:
    numbers: list[float] = []
    for number, line in enumerate(_text(path).splitlines(), 1):
        if len(numbers) > _MOST_NUMBERS:
            break
        numbers += _numbers(line.split(), f"{path.name}: line {number}")
    if count is not None and len(numbers) != count:
        raise InputError(path.name, f"{len(numbers)} numbers", f"{count} numbers")
    return np.array(numbers)


def _text(path: Path) -> str:
    try:
        return read_bounded(path, path.name, SETUP_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(path.name, "bytes that are not text (UTF-8)", "a text file") from None


def _numbers(words: Sequence[str], where: str) -> list[float]:
    out = []
    for word in words:
        try:
            out.append(float(word))
        except ValueError:
            raise InputError(where, f"'{one_line(word)[:40]}'", "a number") from None
    bounded(np.array(out), where)
    return out
