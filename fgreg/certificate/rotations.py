"""Cells that cover all turns from a reference, and how they are halved.

A turn is a quaternion up to its sign; one of the four numbers is the largest. Divided by it, the other three are in a
cube, which is cut into boxes (cells). From a cell's centre q0 the turn to q0 + d is the quaternion (q0 + d) q0*, linear
in d. So its rotation vector's component along an axis is at most twice that of the vector over the least scalar. Near
the reference the boxes' sides are turns about the axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray

_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


@dataclass(frozen=True, slots=True, eq=False)
class Reach:
    """How far B cells' rotations are from their centres: ``about`` (3, B) each axis, ``angle`` (B,), rad, at most."""

    about: FloatArray
    angle: FloatArray

    def __len__(self) -> int:
        return len(self.angle)

    @classmethod
    def ball(cls, angle: FloatArray) -> Reach:
        """All within an angle (B,)."""
        return cls(np.stack([angle] * 3), angle)

    def take(self, index: IntArray) -> Reach:
        return Reach(self.about[:, index], self.angle[index])


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """n cells.

    Attributes:
        largest: (n,) which of the four numbers is the largest. cube: (n, 3) centres of the other three over it.
        half: (n, 3) half widths of the boxes.
        rotation: (n, 3, 3), quaternion: (n, 4): the centres' turns from the reference.
        about_rad: (n, 3) turns from a cell's centre to any in it, about each of the axes, at most. reach_rad: (n,)
            their angle, at most.
    """

    largest: IntArray
    cube: FloatArray
    half: FloatArray
    quaternion: FloatArray
    rotation: FloatArray
    about_rad: FloatArray
    reach_rad: FloatArray

    def __len__(self) -> int:
        return len(self.half)

    @property
    def reach(self) -> Reach:
        return Reach(self.about_rad.T, self.reach_rad)

    @property
    def sides_rad(self) -> FloatArray:
        """(n, 3, 3) turns about each of the axes that half of each side makes, about."""
        steps = _steps(self.largest, self.quaternion) / np.sqrt(1.0 + np.square(self.cube).sum(axis=1))[:, None, None]
        return np.asarray(2.0 * np.abs(steps[:, :, 1:]) * self.half[:, :, None])

    @classmethod
    def of(cls, largest: IntArray, cube: FloatArray, half: FloatArray) -> Cells:
        """From the boxes."""
        middle = _quaternions(largest, cube)
        steps = _steps(largest, middle) / np.sqrt(1.0 + np.square(cube).sum(axis=1))[:, None, None]
        scalar = 1.0 - np.einsum("ni,ni->n", np.abs(steps[:, :, 0]), half)
        vector = np.einsum("nik,ni->nk", np.abs(steps[:, :, 1:]), half)
        about = 2.0 * vector / np.maximum(scalar, 1e-9)[:, None]
        about = np.minimum(about * (1.0 + 1e-9) + 1e-9, np.pi)
        return cls(largest, cube, half, middle, _matrices(middle), about, _reach(steps, half))

    @classmethod
    def cover(cls, along: int) -> Cells:
        """All turns, with ``along`` cells along each side of the four cubes."""
        ticks = (2.0 * np.arange(along) + 1.0) / along - 1.0
        cube = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
        largest = np.repeat(np.arange(4), len(cube))
        return cls.of(largest, np.tile(cube, (4, 1)), np.full((len(largest), 3), 1.0 / along))

    def take(self, index: IntArray) -> Cells:
        """Some of the cells."""
        return Cells(*(getattr(self, name)[index] for name in self.__slots__))

    def halved(self, sides: BoolArray) -> tuple[Cells, IntArray]:
        """Two, four or eight cells in place of each, halved along some ``sides`` (n, 3); and (m,) of which each is."""
        index = np.repeat(np.arange(len(self)), 8)
        signs = np.tile(_CORNERS, (len(self), 1))
        split = sides[index]
        wanted = (split | (signs > 0.0)).all(axis=1)
        index, signs, split = index[wanted], signs[wanted], split[wanted]
        half = np.where(split, 0.5, 1.0) * self.half[index]
        cube = self.cube[index] + np.where(split, signs * half, 0.0)
        return Cells.of(self.largest[index], cube, half), index


def _steps(largest: IntArray, middle: FloatArray) -> FloatArray:
    """(n, 3, 4) quaternions e q0* of the three numbers' units e and unit quaternions q0 (n, 4)."""
    w, v = middle[:, 0], -middle[:, 1:]  # of q0*
    out = np.empty((len(middle), 3, 4))
    rows = np.arange(len(middle))
    for i in range(3):
        unit = np.zeros((len(middle), 4))
        unit[rows, (largest + 1 + i) % 4] = 1.0
        out[:, i, 0] = unit[:, 0] * w - np.einsum("nk,nk->n", unit[:, 1:], v)
        out[:, i, 1:] = unit[:, :1] * v + w[:, None] * unit[:, 1:] + np.cross(unit[:, 1:], v)
    return out


def _reach(steps: FloatArray, half: FloatArray) -> FloatArray:
    """(n,) angle from a cell's centre to the farthest of its corners.

    Angular distance on a half sphere has convex level sets, and a cell is the hull of its corners.
    """
    corner = np.einsum("nik,ci,ni->nck", steps, _CORNERS, half)
    scalar, vector = 1.0 + corner[..., 0], np.sqrt(np.square(corner[..., 1:]).sum(axis=-1))
    return np.asarray(2.0 * np.arctan2(vector, np.abs(scalar)).max(axis=1, initial=0.0) * (1.0 + 1e-9) + 1e-9)


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
