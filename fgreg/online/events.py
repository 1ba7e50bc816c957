"""What the online engine takes in: measurements, and that the camera moved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fgreg.frames import FloatArray
from fgreg.measurements import Aim, Pair


@dataclass(frozen=True, slots=True, eq=False)
class CameraMoved:
    """A new camera epoch; the motion (4, 4) and its (6, 6) covariance (right tangent) where kinematics gave them."""

    t: float
    camera_new_T_camera_old: FloatArray | None = None
    covariance: FloatArray | None = None
    detected: bool = False
    since_t: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class StaticTags:
    """Tags that stand still, by id: ``camera_T_tag`` (4, 4) and covariance (6, 6), right tangent."""

    t: float
    camera_T_tag: Mapping[int, FloatArray]
    covariance: Mapping[int, FloatArray]


OnlineEvent = Aim | Pair | CameraMoved | StaticTags
