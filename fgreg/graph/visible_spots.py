"""Visible spots of PMs in the reduced problem: the residual of fgreg.factors.visible_spot, for many hypotheses at once.

Arrays of hypotheses have S as the last dimension, as in fgreg.graph.reduced_blocks, but for the derivatives by the
shared variables, which have it first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fgreg.geometry.rig import CAMERA, COUNT
from fgreg.geometry.transforms import FloatArray, IntArray, hat
from fgreg.graph.columns import Columns
from fgreg.model.measurements import FLOOR_MM, VisibleSpot, usable_covariance


@dataclass(frozen=True, slots=True, eq=False)
class SpotArrays:
    """Visible spots of PMs.

    Attributes:
        beam: (N,) the beam of each, which has its PM and epoch.
        camera_p_mm: (N, 3). root: (N, 3, 3) U with ``U' U`` the inverse covariance, camera axes.
        by_constants: (N, 3, C) by how much errors of the constants of ``CAMERA`` move what is seen, mm.
    """

    beam: IntArray
    camera_p_mm: FloatArray
    root: FloatArray
    by_constants: FloatArray

    def take(self, index: IntArray) -> SpotArrays:
        """The spots at ``index``."""
        return SpotArrays(*(getattr(self, name)[index] for name in self.__slots__))


def spot_gain(spot: VisibleSpot) -> FloatArray:
    """(3, COUNT) by how much errors of the constants move a visible spot, mm, camera axes."""
    gain = np.zeros((3, COUNT))
    if spot.dependence is not None:
        gain[:, CAMERA] = spot.dependence.gain
    return gain


def usable_spot_covariance(spot: VisibleSpot) -> FloatArray:
    """(3, 3) with the floor of the noise."""
    return usable_covariance(spot.covariance, (FLOOR_MM,) * 3)


def spot_arrays(spots: Mapping[int, VisibleSpot]) -> SpotArrays:
    """Spots by the number of their beam."""
    n, seen = len(spots), spots.values()
    covariance = np.array([usable_spot_covariance(spot) for spot in seen]).reshape(n, 3, 3)
    gain = np.array([spot_gain(spot) for spot in seen]).reshape(n, 3, COUNT)
    return SpotArrays(
        np.array([*spots], dtype=np.int64),
        np.array([spot.camera_p_mm for spot in seen], dtype=np.float64).reshape(n, 3),
        np.linalg.cholesky(np.linalg.inv(covariance)).swapaxes(1, 2),
        gain[..., CAMERA],
    )


def spot_rows(
    spots: SpotArrays, camera_p: FloatArray, rotation: FloatArray, constants: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Whitened residuals (N, 3, S) of the spots, and their derivatives (N, 3, 3, S) by the PMs (point, row).

    Args:
        camera_p: (N, 3, S) the spots' PMs, camera axes.
        rotation: (N or 1, 3, 3, S) trus_R_camera.
        constants: (C, S) those of the camera.
    """
    if not len(spots.beam):
        return camera_p, np.zeros((0, 3, 3, camera_p.shape[-1]))
    off = camera_p - spots.camera_p_mm[..., None] - spots.by_constants @ constants
    return spots.root @ off, np.einsum("nijs,nkj->niks", rotation, spots.root)


def spot_derivatives(spots: SpotArrays, epoch: IntArray, camera_p: FloatArray, columns: Columns) -> FloatArray:
    """(S, N, 3, D) derivatives of the whitened residuals by the shared variables; ``epoch`` (N,) of each spot."""
    out = np.zeros((camera_p.shape[-1], len(epoch), 3, columns.size))
    if not len(epoch):
        return out
    turned = spots.root @ hat(camera_p.transpose(2, 0, 1))
    for place in range(columns.epochs):
        mine = epoch == place
        out[:, mine, :, 6 * place : 6 * place + 3] = turned[:, mine]
        out[:, mine, :, 6 * place + 3 : 6 * place + 6] = -spots.root[mine]
    if columns.of_camera:
        at = [constant - CAMERA.start for constant in columns.of_camera]
        out[..., columns.size - len(at) :] = -spots.root @ spots.by_constants[..., at]
    return out
