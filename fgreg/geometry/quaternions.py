"""Quaternions, as other programs' files and messages have rotations, and a probe's turn about its axis."""

from __future__ import annotations

import math

import numpy as np

from fgreg.geometry.transforms import FloatArray, log_so3

UNIT_TOLERANCE = 1e-3
"""How far from 1 the length of a quaternion may be that is still taken for a rotation."""


def rotation_from_quaternion(x: float, y: float, z: float, w: float) -> FloatArray:
    """(3, 3) rotation of a unit quaternion.

    Raises:
        ValueError: its length is not 1.
    """
    length = math.hypot(x, y, z, w)
    if not abs(length - 1.0) <= UNIT_TOLERANCE:
        raise ValueError(f"a quaternion of length {length:.4g}, not 1")
    x, y, z, w = x / length, y / length, z / length, w / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(rotation: FloatArray) -> tuple[float, float, float, float]:
    """(x, y, z, w) of a (3, 3) rotation, w >= 0."""
    vector = log_so3(rotation)
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 1e-12 else np.zeros(3)
    x, y, z = (float(value) for value in math.sin(angle / 2.0) * axis)
    return x, y, z, math.cos(angle / 2.0)


def turn_about_x(rotation: FloatArray) -> float:
    """Stage angle (rad) of a probe's rotation in its holder's frame: t where its z axis is along (0, sin t, cos t).

    Raises:
        ValueError: the probe is turned about another axis than x, by more than a degree.
    """
    if math.degrees(math.acos(min(1.0, max(-1.0, float(rotation[0, 0]))))) > 1.0:
        raise ValueError("a turn that is not about x")
    return math.atan2(float(rotation[1, 2]), float(rotation[2, 2]))
