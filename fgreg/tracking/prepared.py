"""What all queries of one snapshot and epoch have in common, in plain floats."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fgreg.frames import FloatArray
from fgreg.tracking.snapshot import EpochSnapshot, Snapshot


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """Attributes:
    rotation: (3, 3) and translation (3,) of ``trus_T_camera``. covariance: (SHARED, SHARED).
    nominal: (3, 3) and origin (3,) of the beam chart's frame. beam: x, y (mm), a, b.
    bias: mm. edge: rad. speed, radius: see :class:`Snapshot`.
    depth, half_width: of the sensitivity window.
    """

    rotation: FloatArray
    translation: tuple[float, float, float]
    covariance: FloatArray
    nominal: FloatArray
    nominal_origin: tuple[float, float, float]
    beam: tuple[float, float, float, float]
    bias: tuple[float, float, float]
    edge: float
    speed: float
    radius: float
    depth: list[float]
    half_width: list[float]


def prepare(snapshot: Snapshot, epoch: EpochSnapshot) -> Prepared:
    """The epoch's common parts, made once per snapshot."""
    found = snapshot.prepared.get(epoch.number)
    if found is None:
        t, p0, bias = epoch.translation_mm.tolist(), snapshot.marker_T_nominal[:3, 3].tolist(), snapshot.bias_mm.tolist()
        x, y, a, b = snapshot.beam.tolist()
        found = snapshot.prepared[epoch.number] = Prepared(
            rotation=np.ascontiguousarray(epoch.rotation),
            translation=(t[0], t[1], t[2]),
            covariance=epoch.covariance,
            nominal=np.ascontiguousarray(snapshot.marker_T_nominal[:3, :3]),
            nominal_origin=(p0[0], p0[1], p0[2]),
            beam=(x, y, a, b),
            bias=(bias[0], bias[1], bias[2]),
            edge=snapshot.edge_rad,
            speed=snapshot.sound_speed_ratio,
            radius=snapshot.radius_mm,
            depth=snapshot.sensitivity.depth_mm.tolist(),
            half_width=snapshot.sensitivity.half_width_rad.tolist(),
        )
    return found


def turn(w: tuple[float, float, float]) -> FloatArray | None:
    """The rotation matrix (3, 3) of a rotation vector, None of zero."""
    x, y, z = w
    square = x * x + y * y + z * z
    if square == 0.0:
        return None
    angle = math.sqrt(square)
    if angle < 1e-6:
        a, b = 1.0, 0.5
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    return np.array(
        [
            [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )
