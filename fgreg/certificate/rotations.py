"""Cells that cover all rotations, and how they are halved.

A rotation is a quaternion up to its sign; one of the four numbers is the largest. Divided by it, the other three are in
a cube, which is cut into smaller cubes (cells). The angle from a cell's centre to its farthest rotation is that to one
of its corners: angular distance on a half sphere has convex level sets, and a cell is the hull of its corners.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.geometry.transforms import FloatArray, IntArray

_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """n cells.

    Attributes:
        largest: (n,) which of the four numbers is the largest. cube: (n, 3) centres of the other three over it.
        half: (n,) half widths of the cubes.
        rotation: (n, 3, 3), quaternion: (n, 4): the centres. reach_rad: (n,) angle to a cell's farthest rotation.
    """

    largest: IntArray
    cube: FloatArray
    half: FloatArray
    quaternion: FloatArray
    rotation: FloatArray
    reach_rad: FloatArray

    def __len__(self) -> int:
        return len(self.half)

    @classmethod
    def of(cls, largest: IntArray, cube: FloatArray, half: FloatArray) -> Cells:
        """From the cubes."""
        middle = _quaternions(largest, cube)
        corners = cube[:, None] + half[:, None, None] * _CORNERS
        corner = _quaternions(np.repeat(largest, 8), corners.reshape(-1, 3)).reshape(-1, 8, 4)
        least = np.abs(np.einsum("ni,nki->nk", middle, corner)).min(axis=1, initial=1.0)
        reach = 2.0 * np.arccos(np.clip(least, -1.0, 1.0)) * (1.0 + 1e-9) + 1e-9
        return cls(largest, cube, half, middle, _matrices(middle), reach)

    @classmethod
    def cover(cls, along: int) -> Cells:
        """All rotations, with ``along`` cells along each side of the four cubes."""
        ticks = (2.0 * np.arange(along) + 1.0) / along - 1.0
        cube = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
        largest = np.repeat(np.arange(4), len(cube))
        return cls.of(largest, np.tile(cube, (4, 1)), np.full(len(largest), 1.0 / along))

    def take(self, index: IntArray) -> Cells:
        """Some of the cells."""
        return Cells(*(getattr(self, name)[index] for name in self.__slots__))

    def halved(self) -> Cells:
        """Eight cells in place of each, in order."""
        half = 0.5 * np.repeat(self.half, 8)
        cube = np.repeat(self.cube, 8, axis=0) + half[:, None] * np.tile(_CORNERS, (len(self), 1))
        return Cells.of(np.repeat(self.largest, 8), cube, half)


def _quaternions(largest: IntArray, three: FloatArray) -> FloatArray:
    """(n, 4) unit quaternions (w, x, y, z)."""
    out = np.ones((len(largest), 4))
    rows = np.arange(len(largest))
    for i in range(3):
        out[rows, (largest + 1 + i) % 4] = three[:, i]
    return np.asarray(out / np.sqrt(1.0 + np.square(three).sum(axis=1))[:, None])


def _matrices(quaternions: FloatArray) -> FloatArray:
    w, x, y, z = quaternions.T
    out = np.empty((len(quaternions), 3, 3))
    out[:, 0, 0], out[:, 0, 1], out[:, 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[:, 1, 0], out[:, 1, 1], out[:, 1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[:, 2, 0], out[:, 2, 1], out[:, 2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return out
