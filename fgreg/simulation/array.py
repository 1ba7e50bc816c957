"""The probe's array as it is mounted, which may not be where the session says: exact geometry, in TRUS axes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, exp_so3
from fgreg.model.probe_model import ProbeModel


@dataclass(frozen=True, slots=True, eq=False)
class TrueArray:
    """Where the array is at stage angle 0, in the TRUS frame, and how it measures.

    Attributes:
        radius_mm, tangential_mm: the array's middle is at (0, tangential, radius).
        trus_R_array: (3, 3). Its columns: along the array, normal to the image plane, out of the array in the plane.
        pitch_ratio, sound_speed_ratio: true over declared.
        range_offset_mm: true distance = sound_speed_ratio * measured range + range_offset_mm.
        window_centre_rad: the middle of the window, as stage rotation into the image plane.
    """

    radius_mm: float
    tangential_mm: float
    trus_R_array: FloatArray
    pitch_ratio: float
    sound_speed_ratio: float
    range_offset_mm: float
    window_centre_rad: float

    @staticmethod
    def of(probe: ProbeModel, deviations: Mapping[Constant, float]) -> TrueArray:
        """The array of a declared probe whose constants deviate (true less declared)."""

        def by(constant: Constant) -> float:
            return float(deviations.get(constant, 0.0))

        # About x the plane leans towards +y by a negative turn; about y elements at +x rise by a negative one.
        turn = np.array(
            [-by(Constant.TILT_ELEVATION), -by(Constant.TILT_IN_PLANE), by(Constant.TILT_RADIAL)], dtype=np.float64
        )
        return TrueArray(
            probe.radius_mm + by(Constant.RADIUS),
            by(Constant.ARRAY_OFFSET),
            exp_so3(turn),
            1.0 + by(Constant.PITCH),
            1.0 + by(Constant.SOUND_SPEED),
            by(Constant.RANGE_OFFSET),
            by(Constant.WINDOW_CENTRE),
        )

    def middle_mm(self, scan_rad: FloatArray) -> FloatArray:
        """(..., 3) the array's middle at stage angles (...)."""
        c, s = np.cos(scan_rad), np.sin(scan_rad)
        y, z = self.tangential_mm * c + self.radius_mm * s, self.radius_mm * c - self.tangential_mm * s
        return np.stack([np.zeros_like(y), y, z], axis=-1)

    def along(self, scan_rad: FloatArray) -> FloatArray:
        """(..., 3) unit vectors along the array, in the order of x, at stage angles (...)."""
        return self._axis(0, scan_rad)

    def across(self, scan_rad: FloatArray) -> FloatArray:
        """(..., 3) unit vectors across the image plane, towards larger stage angles, at stage angles (...)."""
        return self._axis(1, scan_rad)

    def _axis(self, which: int, scan_rad: FloatArray) -> FloatArray:
        c, s = np.cos(scan_rad), np.sin(scan_rad)
        x, y, z = self.trus_R_array[:, which]
        return np.stack([x + 0.0 * c, y * c + z * s, z * c - y * s], axis=-1)

    def x_mm(self, trus_p_mm: FloatArray, scan_rad: FloatArray) -> FloatArray:
        """Lateral position that is measured of points (..., 3): of the element nearest, by the declared pitch."""
        away = trus_p_mm - self.middle_mm(scan_rad)
        return np.asarray(np.sum(away * self.along(scan_rad), axis=-1) / self.pitch_ratio)

    def distance_mm(self, trus_p_mm: FloatArray, scan_rad: FloatArray) -> FloatArray:
        """True distance of points (..., 3) from the array's line."""
        away, along = trus_p_mm - self.middle_mm(scan_rad), self.along(scan_rad)
        across = away - np.sum(away * along, axis=-1, keepdims=True) * along
        return np.asarray(np.hypot(np.hypot(across[..., 0], across[..., 1]), across[..., 2]))

    def range_mm(self, trus_p_mm: FloatArray, scan_rad: FloatArray) -> FloatArray:
        """Range that is measured of points (..., 3)."""
        distance = self.distance_mm(trus_p_mm, scan_rad)
        return np.asarray((distance - self.range_offset_mm) / self.sound_speed_ratio)

    def plane_angle_rad(self, trus_p_mm: FloatArray) -> FloatArray:
        """Stage angle at which the image plane passes through points (..., 3).

        With n the plane's normal and o the array's middle at stage angle 0, n . Rx(-s) p = n . o is solved for s.
        """
        n = self.trus_R_array[:, 1]
        middle = n[1] * self.tangential_mm + n[2] * self.radius_mm
        across = np.hypot(trus_p_mm[..., 1], trus_p_mm[..., 2]) * np.hypot(n[1], n[2])
        ahead = np.arcsin((middle - n[0] * trus_p_mm[..., 0]) / across)
        polar = np.arctan2(trus_p_mm[..., 1], trus_p_mm[..., 2])
        return np.asarray(polar - ahead + np.arctan2(n[2], n[1]))

    def rotation_rad(self, trus_p_mm: FloatArray, scan_rad: FloatArray) -> FloatArray:
        """Stage rotation from ``scan_rad`` to where the window about points (..., 3) has its middle."""
        return np.asarray(self.plane_angle_rad(trus_p_mm) - scan_rad - self.window_centre_rad)


def map_by_declared(probe: ProbeModel, scan_rad: FloatArray, x_mm: FloatArray, range_mm: FloatArray) -> FloatArray:
    """(..., 3) where the declared geometry has what is seen in the plane at a stage angle, x and range (...)."""
    rho = probe.radius_mm + range_mm
    return np.stack([x_mm + 0.0 * rho, rho * np.sin(scan_rad), rho * np.cos(scan_rad)], axis=-1)
