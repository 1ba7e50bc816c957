"""Points known to both devices in the reduced problem: terms on the shared variables alone.

The point's place in the camera's frame is eliminated: with the registration (R, t), C and T the covariances of camera
and scanner, and W = (R C R' + T)^-1, its optimum is q = camera_p - C R' W e, and the cost e' W e has the derivative
2 e' W R [-hat(q), I] by the registration. So the optimum is that of the explicit graph (fgreg.factors.known_point).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgreg.geometry.rig import CAMERA, COUNT
from fgreg.geometry.transforms import FloatArray, IntArray, hat
from fgreg.graph.columns import Columns
from fgreg.graph.shared_state import SharedState
from fgreg.model.camera_dependence import nominal_point_gain
from fgreg.model.measurements import FLOOR_MM, LocatedPoint, usable_covariance
from fgreg.model.scanner_dependence import scanner_gain
from fgreg.model.session_model import SessionModel


@dataclass(frozen=True, slots=True, eq=False)
class PointArrays:
    """Points.

    Attributes:
        epoch: (n,) place of the registration. camera_p_mm, trus_p_mm: (n, 3).
        covariance, trus_covariance: (n, 3, 3), each in its own frame.
        seen, shown: (n, 3, COUNT) by how much errors of the constants move the true point against where the camera
            (camera axes) and the scanner (TRUS axes) have it.
    """

    epoch: IntArray
    camera_p_mm: FloatArray
    covariance: FloatArray
    trus_p_mm: FloatArray
    trus_covariance: FloatArray
    seen: FloatArray
    shown: FloatArray

    def __len__(self) -> int:
        return len(self.epoch)

    def take(self, index: IntArray | slice) -> PointArrays:
        """The points at ``index``."""
        return PointArrays(*(getattr(self, name)[index] for name in self.__slots__))

    def mirrored(self) -> PointArrays:
        """The points as the scanner has them with lateral positions counted from the other end."""
        flip = np.array([-1.0, 1.0, 1.0])
        turned = self.trus_covariance * flip * flip[:, None]
        return PointArrays(
            self.epoch,
            self.camera_p_mm,
            self.covariance,
            self.trus_p_mm * flip,
            turned,
            self.seen,
            self.shown * flip[:, None],
        )


NO_POINTS = PointArrays(
    np.zeros(0, dtype=np.int64),
    *(np.zeros((0, 3, *rest)) for rest in ((), (3,), (), (3,), (COUNT,), (COUNT,))),
)
"""None at all."""


def point_arrays(points: Sequence[LocatedPoint], model: SessionModel, places: Sequence[int]) -> PointArrays:
    """Points, each with the place of its registration."""
    n = len(points)
    if not n:
        return NO_POINTS
    camera_p = np.array([point.camera_p_mm for point in points], dtype=np.float64).reshape(n, 3)
    trus_p = np.array([point.trus_p_mm for point in points], dtype=np.float64).reshape(n, 3)
    floor, seen = (FLOOR_MM,) * 3, np.zeros((n, 3, COUNT))
    seen[..., CAMERA] = nominal_point_gain(model, camera_p)
    covariances = [
        np.array([usable_covariance(each, floor) for each in of], dtype=np.float64).reshape(n, 3, 3)
        for of in ([point.covariance for point in points], [point.trus_covariance for point in points])
    ]
    return PointArrays(
        np.array(places, dtype=np.int64),
        camera_p,
        covariances[0],
        trus_p,
        covariances[1],
        seen,
        scanner_gain(model.probe.radius_mm, trus_p),
    )


@dataclass(frozen=True, slots=True, eq=False)
class PointTerms:
    """Cost (S, n), and gradient (S, n, D) and Hessian (S, n, D, D) of half of it, of each point."""

    cost: FloatArray
    gradient: FloatArray
    hessian: FloatArray


def point_cost(points: PointArrays, state: SharedState) -> FloatArray:
    """(S, n) chi square of each point."""
    at = _at(points, state.rotation, state.translation_mm, state.constants)
    return np.asarray(np.sum(at.error * at.weighted, axis=-1))


def point_terms(points: PointArrays, state: SharedState, columns: Columns) -> PointTerms:
    """The points' terms at S hypotheses."""
    at = _at(points, state.rotation, state.translation_mm, state.constants)
    jacobian = np.zeros((*at.error.shape, columns.size))
    by_pose = np.concatenate([-at.rotation @ hat(at.camera_p), at.rotation], axis=-1)
    for place in range(columns.epochs):
        mine = points.epoch == place
        jacobian[:, mine, :, 6 * place : 6 * place + 6] = by_pose[:, mine]
    chosen = list(columns.constants)
    jacobian[..., columns.rig] = at.rotation @ points.seen[..., chosen] - points.shown[..., chosen]
    turned = np.swapaxes(jacobian, -1, -2)
    return PointTerms(
        np.asarray(np.sum(at.error * at.weighted, axis=-1)),
        np.asarray((turned @ at.weighted[..., None])[..., 0]),
        np.asarray(turned @ at.weight @ jacobian),
    )


def camera_places(points: PointArrays, trus_T_camera: FloatArray, constants: FloatArray) -> FloatArray:
    """(n, 3) where the points are in the camera's frame, given registrations (E, 4, 4) and constants (COUNT,)."""
    at = _at(points, trus_T_camera[None, :, :3, :3], trus_T_camera[None, :, :3, 3], constants[None])
    return np.asarray(at.camera_p[0])


@dataclass(frozen=True, slots=True, eq=False)
class _PointsAt:
    """Errors (S, n, 3), weights (S, n, 3, 3), weights times errors; rotations; the points' best places (S, n, 3)."""

    error: FloatArray
    weight: FloatArray
    weighted: FloatArray
    rotation: FloatArray
    camera_p: FloatArray


def _at(points: PointArrays, rotation: FloatArray, translation: FloatArray, constants: FloatArray) -> _PointsAt:
    """The points at registrations (S, E, ...) and constants (S, COUNT)."""
    rotation, translation = rotation[:, points.epoch], translation[:, points.epoch]
    camera_p = points.camera_p_mm + np.einsum("nik,sk->sni", points.seen, constants)
    shown = points.trus_p_mm + np.einsum("nik,sk->sni", points.shown, constants)
    error = (rotation @ camera_p[..., None])[..., 0] + translation - shown
    back = points.covariance @ np.swapaxes(rotation, -1, -2)
    weight = np.asarray(np.linalg.inv(rotation @ back + points.trus_covariance))
    weighted = (weight @ error[..., None])[..., 0]
    return _PointsAt(error, weight, weighted, rotation, camera_p - (back @ weighted[..., None])[..., 0])
