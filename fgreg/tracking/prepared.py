"""What all queries of one snapshot and epoch have in common, in plain floats."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fgreg.frames import FloatArray
from fgreg.sensitivity import AmplitudeCurve, amplitude_curve
from fgreg.tracking.snapshot import BEAM, BIAS, EDGE, POSE, RADIUS, SPEED, EpochSnapshot, Snapshot


@dataclass(frozen=True, slots=True, eq=False)
class SharedPlace:
    """The shared variables at some values.

    Attributes:
        rotation: (3, 3) and translation (3,) mm of ``trus_T_camera``.
        chart: (3, 6), marker frame: the beam's point at lambda = 0, its direction; how the point moves with x and y,
            and the direction with a and b, of the beam chart.
        bias: mm. edge: rad. speed, radius: see :class:`Snapshot`.
        tangent: (6, 6) derivative of the registration's right tangent by the deviation from the snapshot's, None
            where that is zero.
    """

    rotation: FloatArray
    translation: tuple[float, float, float]
    chart: FloatArray
    bias: tuple[float, float, float]
    edge: float
    speed: float
    radius: float
    tangent: FloatArray | None


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """An epoch's common parts.

    Attributes:
        nominal: (3, 3) and origin (3,) of the beam chart's frame. beam: x, y (mm), a, b.
        covariance: (SHARED, SHARED).
        depth, half_width: of the sensitivity window. curve: of amplitudes, where there is one.
        place: where the shared variables are.
    """

    nominal: FloatArray
    nominal_origin: FloatArray
    beam: tuple[float, float, float, float]
    covariance: FloatArray
    depth: list[float]
    half_width: list[float]
    curve: AmplitudeCurve | None
    place: SharedPlace

    def moved(self, shared: list[float]) -> SharedPlace:
        """The place where the shared variables are ``shared`` (SHARED,) off the snapshot's."""
        place = self.place
        w, v = shared[POSE : POSE + 3], shared[POSE + 3 : POSE + 6]
        rotation, translation, tangent = place.rotation, place.translation, None
        turned = turn((w[0], w[1], w[2]))
        if turned is not None:
            m0, m1, m2 = (rotation @ _expmap_shift(w, v)).tolist()
            rotation = rotation @ turned
            translation = (translation[0] + m0, translation[1] + m1, translation[2] + m2)
            tangent = _tangent_gain(w, v)
        (x, y, a, b), (b0, b1, b2) = self.beam, place.bias
        return SharedPlace(
            rotation=rotation,
            translation=translation,
            chart=_chart(
                self.nominal,
                self.nominal_origin,
                x + shared[BEAM],
                y + shared[BEAM + 1],
                a + shared[BEAM + 2],
                b + shared[BEAM + 3],
            ),
            bias=(b0 + shared[BIAS], b1 + shared[BIAS + 1], b2 + shared[BIAS + 2]),
            edge=place.edge + shared[EDGE],
            speed=place.speed + shared[SPEED],
            radius=place.radius + shared[RADIUS],
            tangent=tangent,
        )


def prepare(snapshot: Snapshot, epoch: EpochSnapshot) -> Prepared:
    """The epoch's common parts, made once per snapshot."""
    found = snapshot.prepared.get(epoch.number)
    if found is None:
        found = snapshot.prepared[epoch.number] = _prepared(snapshot, epoch)
    return found


def _prepared(snapshot: Snapshot, epoch: EpochSnapshot) -> Prepared:
    t, bias, nominal = epoch.translation_mm.tolist(), snapshot.bias_mm.tolist(), snapshot.marker_T_nominal
    x, y, a, b = snapshot.beam.tolist()
    frame, origin = np.ascontiguousarray(nominal[:3, :3]), np.ascontiguousarray(nominal[:3, 3])
    return Prepared(
        nominal=frame,
        nominal_origin=origin,
        beam=(x, y, a, b),
        covariance=epoch.covariance,
        depth=snapshot.sensitivity.depth_mm.tolist(),
        half_width=snapshot.sensitivity.half_width_rad.tolist(),
        curve=amplitude_curve(snapshot.sensitivity),
        place=SharedPlace(
            rotation=np.ascontiguousarray(epoch.rotation),
            translation=(t[0], t[1], t[2]),
            chart=_chart(frame, origin, x, y, a, b),
            bias=(bias[0], bias[1], bias[2]),
            edge=snapshot.edge_rad,
            speed=snapshot.sound_speed_ratio,
            radius=snapshot.radius_mm,
            tangent=None,
        ),
    )


def _chart(nominal: FloatArray, origin: FloatArray, x: float, y: float, a: float, b: float) -> FloatArray:
    square = 1.0 + a * a + b * b
    unit = 1.0 / math.sqrt(square)
    cube = unit / square
    chart = nominal @ np.array(
        [
            [x, a * unit, 1.0, 0.0, unit - cube * a * a, -cube * a * b],
            [y, b * unit, 0.0, 1.0, -cube * a * b, unit - cube * b * b],
            [0.0, unit, 0.0, 0.0, -cube * a, -cube * b],
        ]
    )
    chart[:, 0] += origin
    return np.asarray(chart)


def _expmap_shift(w: list[float], v: list[float]) -> FloatArray:
    """Translation of ``Expmap(w, v)``, to second order in w."""
    (x, y, z), (p, q, r) = w, v
    a, b, c = 0.5 * (y * r - z * q), 0.5 * (z * p - x * r), 0.5 * (x * q - y * p)
    k = 1.0 / 3.0
    return np.array([p + a + k * (y * c - z * b), q + b + k * (z * a - x * c), r + c + k * (x * b - y * a)])


def _tangent_gain(w: list[float], v: list[float]) -> FloatArray:
    """(6, 6) right Jacobian of SE(3) at a tangent (w, v), to first order: ``I - ad / 2``."""
    x, y, z = 0.5 * w[0], 0.5 * w[1], 0.5 * w[2]
    p, q, r = 0.5 * v[0], 0.5 * v[1], 0.5 * v[2]
    return np.array(
        [
            [1.0, z, -y, 0.0, 0.0, 0.0],
            [-z, 1.0, x, 0.0, 0.0, 0.0],
            [y, -x, 1.0, 0.0, 0.0, 0.0],
            [0.0, r, -q, 1.0, z, -y],
            [-r, 0.0, p, -z, 1.0, x],
            [q, -p, 0.0, y, -x, 1.0],
        ]
    )


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
