"""The parameters of a stereo calibration as one vector: lenses of both cameras, then right_T_left.

Of each camera fx, fy, cx, cy (px) and the coefficients of its lens; of the stereo pose the right tangent (rotation rad,
translation mm), as the rig's constants have it (docs/model.md, section 6).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from fgreg.calibration.views import SIDES
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, exp_so3, inverse, log_so3, make_transform, nearest_rotation
from fgreg.model.camera_model import CameraModel, StereoRig

_POLYNOMIAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
_DEG = math.degrees(1.0)


def cameras(rig: StereoRig) -> tuple[CameraModel, ...]:
    """Left and, where there is one, right."""
    return (rig.left,) if rig.right is None else (rig.left, rig.right)


def names(rig: StereoRig) -> tuple[str, ...]:
    """(P,) such as ``left.fx``, ``right.k1``, ``right_T_left.rotation_deg[0]``."""
    out = []
    for side, camera in zip(SIDES, cameras(rig), strict=False):
        count = len(camera.distortion)
        lens = tuple(f"k{i + 1}" for i in range(count)) if camera.fisheye else _POLYNOMIAL[:count]
        out += [f"{side}.{name}" for name in ("fx", "fy", "cx", "cy", *lens)]
    if rig.right is not None:
        out += [f"right_T_left.rotation_deg[{i}]" for i in range(3)]
        out += [f"right_T_left.translation_mm[{i}]" for i in range(3)]
    return tuple(out)


def per_unit(rig: StereoRig) -> FloatArray:
    """(P,) of the unit that ``names`` say in one of the memory's: degrees per radian, else 1."""
    return np.array([_DEG if "_deg" in name else 1.0 for name in names(rig)])


def lens_columns(rig: StereoRig) -> tuple[slice, ...]:
    """Of each camera, where its parameters are."""
    at, out = 0, []
    for camera in cameras(rig):
        size = 4 + len(camera.distortion)
        out.append(slice(at, at + size))
        at += size
    return tuple(out)


def lens_vector(camera: CameraModel) -> FloatArray:
    """fx, fy, cx, cy and the coefficients of a camera."""
    k = camera.matrix
    return np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *camera.distortion])


def with_lens(camera: CameraModel, values: FloatArray) -> CameraModel:
    """The camera with these parameters, as :func:`lens_vector` has them."""
    fx, fy, cx, cy = values[:4]
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return replace(camera, matrix=matrix, distortion=np.array(values[4:]))


def moved(rig: StereoRig, step: FloatArray) -> StereoRig:
    """The rig with its parameters changed by ``step`` (P,)."""
    lenses = [
        with_lens(camera, lens_vector(camera) + step[columns])
        for camera, columns in zip(cameras(rig), lens_columns(rig), strict=True)
    ]
    if rig.right is None or rig.right_T_left is None:
        return StereoRig(lenses[0])
    pose = rig.right_T_left @ make_transform(exp_so3(step[-6:-3]), step[-3:])
    pose[:3, :3] = nearest_rotation(pose[:3, :3])
    return StereoRig(lenses[0], lenses[1], pose)


def difference(rig: StereoRig, other: StereoRig) -> FloatArray:
    """(P,) the step from ``other`` to ``rig``."""
    parts = [lens_vector(a) - lens_vector(b) for a, b in zip(cameras(rig), cameras(other), strict=True)]
    if rig.right_T_left is not None and other.right_T_left is not None:
        apart = inverse(other.right_T_left) @ rig.right_T_left
        parts += [log_so3(apart[:3, :3]), apart[:3, 3]]
    return np.concatenate(parts)


def constants(rig: StereoRig) -> tuple[tuple[Constant, ...], FloatArray]:
    """The rig's constants that a calibration has, C of them, and their derivative (C, P) by its parameters."""
    lenses = lens_columns(rig)
    size = lenses[-1].stop + (0 if rig.right is None else 6)
    focal, centre = (Constant.FOCAL_LEFT, Constant.FOCAL_RIGHT), (Constant.CENTRE_LEFT_X, Constant.CENTRE_RIGHT_X)
    which, rows = [], []

    def add(constant: Constant, columns: dict[int, float]) -> None:
        which.append(constant)
        row = np.zeros(size)
        row[list(columns)] = list(columns.values())
        rows.append(row)

    for camera, columns, f, c in zip(cameras(rig), lenses, focal, centre, strict=False):
        first = columns.start
        add(f, {first: 0.5 / camera.matrix[0, 0], first + 1: 0.5 / camera.matrix[1, 1]})
        for i in range(2):
            add(Constant(c + i), {first + 2 + i: 1.0})
    if rig.right is not None:
        for i in range(6):
            add(Constant(Constant.STEREO_ROTATION_X + i), {size - 6 + i: 1.0})
    return tuple(which), np.array(rows)
