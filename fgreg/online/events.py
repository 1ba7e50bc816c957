"""What the online registration takes in, beside the measurement types. Millimetres, radians, seconds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fgreg.frames import FloatArray
from fgreg.measurements import Aim, Pair


@dataclass(frozen=True, slots=True, eq=False)
class CameraMoved:
    """The camera moved: what follows belongs to a new epoch.

    Attributes:
        t: when it was told, or found out.
        camera_new_T_camera_old: (4, 4), where kinematics gave it.
        covariance: (6, 6) over its right tangent; a motion without one says nothing to rely on.
        detected: found out by the program itself.
        since_t: where found out: pairs from this time on belong to the new epoch.
    """

    t: float
    camera_new_T_camera_old: FloatArray | None = None
    covariance: FloatArray | None = None
    detected: bool = False
    since_t: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class StaticTags:
    """Tags fixed in the room as the camera sees them now.

    Attributes:
        t: time.
        camera_T_tag: (4, 4) by tag.
        covariance: (6, 6) over the right tangent, by tag.
    """

    t: float
    camera_T_tag: Mapping[int, FloatArray]
    covariance: Mapping[int, FloatArray]


OnlineEvent = Aim | Pair | CameraMoved | StaticTags
