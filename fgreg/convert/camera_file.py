"""The file of a camera calibration: ``camera`` and ``systematic`` of a ``session.yaml``, and where they come from.

It is what ``fgreg calibrate-camera`` writes: lines to take over into a session.yaml, which they may be appended to as
they are. ``x_camera_calibration``, which sessions do not read, has the covariance of all parameters, for ``--check``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.calibration import parameters
from fgreg.convert.write import camera_yaml
from fgreg.drivers.calibration_files import read_calibration
from fgreg.errors import InputError
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray
from fgreg.model.camera_model import STEREO_RIG, StereoRig
from fgreg.model.session_model import BoardModel
from fgreg.model.systematic import CAREFUL_LAB, SYSTEMATIC, TEXTS, Systematic
from fgreg.output.atomic_file import FileKind, write_file
from fgreg.schema.kinds import ListOf, Numbers, Text
from fgreg.schema.limits import SETUP_BYTES
from fgreg.schema.problems import FieldError, input_error
from fgreg.schema.record import record
from fgreg.schema.yaml_writer import one_line_yaml, yaml_text
from fgreg.session.yaml_loader import load_yaml, read_bounded

HEAD = "# fgreg-camera/1"
CAMERA_FILE = FileKind("a camera calibration", (HEAD.encode(),))
DETAILS = "x_camera_calibration"
_COEFFICIENT_SIGMA = 1e-3
"""Of a lens' coefficient, where a file has no covariance."""
_GROUPS = (
    ("focal", (Constant.FOCAL_LEFT, Constant.FOCAL_RIGHT)),
    ("principal_point_px", tuple(Constant(Constant.CENTRE_LEFT_X + i) for i in range(4))),
    ("stereo_rotation_deg", tuple(Constant(Constant.STEREO_ROTATION_X + i) for i in range(3))),
    ("stereo_translation_mm", tuple(Constant(Constant.STEREO_TRANSLATION_X + i) for i in range(3))),
)


@dataclass(frozen=True, slots=True, eq=False)
class CameraFile:
    """A calibration to check.

    Attributes:
        rig: the cameras.
        covariance: (P, P) of its parameters (fgreg.calibration.parameters).
        sigma_px: of the corners that it was made from; 0 where that is not known.
        depths_mm: of these corners; empty where not known.
        board: that the file describes, or None.
    """

    rig: StereoRig
    covariance: FloatArray
    sigma_px: float
    depths_mm: tuple[float, ...]
    board: BoardModel | None


def systematic_sigmas(rig: StereoRig, covariance: FloatArray, scale_sigma: float) -> dict[str, float]:
    """Keys of ``systematic`` that a calibration says, in the file's units; of several constants the largest sigma."""
    which, by = parameters.constants(rig)
    sigma = dict(zip(which, np.sqrt(np.diag(by @ covariance @ by.T)), strict=True))
    out = {"camera_scale": scale_sigma} if rig.right is not None else {}
    for key, members in _GROUPS:
        found = [float(sigma[one]) * TEXTS[one].per_unit for one in members if one in sigma]
        if found:
            out[key] = float(f"{min(max(found), 45.0 if key.endswith('_deg') else math.inf):.3g}")
    if "focal" in out:
        out["focal"] = min(out["focal"], 1.0)
    return out


def write_camera(path: Path, rig: StereoRig, systematic: Mapping[str, float], details: Mapping[str, Any]) -> None:
    """Write a calibration; an older one is replaced.

    Args:
        details: what becomes ``x_camera_calibration``, in the file's units.

    Raises:
        InputError: the file cannot be written, or another file is there.
    """
    text = f"{HEAD}: of fgreg calibrate-camera, to be appended to a session.yaml that has no camera and no systematic\n"
    text += camera_yaml(rig)
    text += "systematic:\n" + "".join(f"  {key}: {one_line_yaml(value)}\n" for key, value in systematic.items())
    write_file(path, text + yaml_text({DETAILS: details}, {"board", "halves"}), CAMERA_FILE)


def read_camera(path: Path) -> CameraFile:
    """A calibration: a file of ``fgreg calibrate-camera``, a ``session.yaml``, or another program's file.

    Where there is no covariance it is that of ``systematic``, or of a careful lab.

    Raises:
        InputError: none of these.
    """
    label = str(path)
    if not re.search(rb"(?m)^camera:", read_bounded(path, label, SETUP_BYTES)):
        rig = read_calibration([path]).rig
        return CameraFile(rig, _assumed(rig, CAREFUL_LAB), 0.0, (), None)
    data = load_yaml(path, label)
    rig = _section(data, "camera", STEREO_RIG, label)
    board = _section(data, "board", record(BoardModel), label) if "board" in data else None
    details = data.get(DETAILS)
    if isinstance(details, Mapping) and details:
        if board is None and "board" in details:
            board = _section(details, "board", record(BoardModel), f"{label}: {DETAILS}")
        return _with_details(rig, board, details, label)
    systematic = _section(data, "systematic", SYSTEMATIC, label) if "systematic" in data else CAREFUL_LAB
    return CameraFile(rig, _assumed(rig, systematic), 0.0, (), board)


def read_board(path: Path) -> BoardModel:
    """``board`` of a session.yaml, of its folder, or of a file that has this section alone.

    Raises:
        InputError: there is none.
    """
    file = path / "session.yaml" if path.is_dir() else path
    board: BoardModel = _section(load_yaml(file, str(file)), "board", record(BoardModel), str(file))
    return board


def _section(data: Mapping[str, object], key: str, kind: Any, label: str) -> Any:
    if key not in data:
        raise InputError(f"{label}: {key}", "nothing", kind.expected)
    try:
        return kind.read(data[key])
    except FieldError as error:
        raise input_error(error.below(key)[0], label, data) from None


def _with_details(rig: StereoRig, board: BoardModel | None, details: Mapping[str, object], label: str) -> CameraFile:
    names = parameters.names(rig)
    count = len(names)
    kinds = {
        "names": ListOf(Text("a parameter's name", names)),
        "covariance": ListOf(Numbers(count)),
        "sigma_px": Numbers(1),
        "depth_mm": Numbers(3),
    }
    read = {}
    for key, kind in kinds.items():
        value = details.get(key)
        try:
            read[key] = kind.read([value] if key == "sigma_px" else value)
        except FieldError as error:
            raise input_error(error.below(DETAILS, key)[0], label, None) from None
    covariance = np.array(read["covariance"], dtype=np.float64)
    unit = parameters.per_unit(rig)
    whole = read["names"] == names and covariance.shape == (count, count)
    if whole:
        covariance = 0.5 * (covariance + covariance.T) / np.outer(unit, unit)
        sigma = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        whole = bool(np.linalg.eigvalsh(covariance / np.outer(sigma, sigma))[0] > 0.0)
    if not whole or not 0.0 < read["sigma_px"][0] < 100.0 or (read["depth_mm"] <= 0.0).any():
        expected = f"names, covariance ({count} x {count}), sigma_px and depth_mm as fgreg calibrate-camera writes them"
        raise InputError(f"{label}: {DETAILS}", "values that do not fit the camera", expected)
    return CameraFile(rig, covariance, float(read["sigma_px"][0]), tuple(map(float, read["depth_mm"])), board)


def _assumed(rig: StereoRig, systematic: Systematic) -> FloatArray:
    """(P, P) of sigmas that are declared."""
    sigma = np.full(len(parameters.names(rig)), _COEFFICIENT_SIGMA)
    for camera, columns in zip(parameters.cameras(rig), parameters.lens_columns(rig), strict=True):
        first = columns.start
        sigma[first : first + 2] = max(systematic.focal, 1e-6) * camera.matrix[0, 0]
        sigma[first + 2 : first + 4] = max(systematic.principal_point_px, 1e-3)
    if rig.right is not None:
        sigma[-6:-3] = max(systematic.stereo_rotation_rad, 1e-6)
        sigma[-3:] = max(systematic.stereo_translation_mm, 1e-4)
    return np.diag(sigma**2)
