"""The minimal solver: poses of three points that lie on three lines (gp3p of poselib)."""

from __future__ import annotations

import ctypes

import poselib

from fgreg.geometry.transforms import FloatArray

SEED = 1
_C = ctypes.CDLL(None)
"""The C library: gp3p turns its equations at random by ``rand()``, whose state is the process's."""


def poses_of_three(origin: FloatArray, direction: FloatArray, points: FloatArray) -> list[poselib.CameraPose]:
    """Poses that place three points (3, 3) on three lines, by their origins and directions (3, 3) each.

    The same input gives the same poses, whatever the process has computed before.
    """
    _C.srand(SEED)
    return list(poselib.gp3p(origin, direction, points))
