"""Values as a stream of plain numbers and texts, and back: nothing that is read is ever run or unpickled."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from fgreg.frames import RIGID_TOLERANCE, BoolArray, FloatArray, IntArray

FARTHEST_MM = 1e6
"""Beyond all bounds of a session's numbers."""


@dataclass(frozen=True, slots=True, eq=False)
class Numbers:
    """What was written: integers (n,) of 64 bits, floats (m,), texts."""

    integers: IntArray
    floats: FloatArray
    texts: tuple[str, ...]


@dataclass(slots=True)
class Sink:
    """Takes values in order."""

    _integers: list[IntArray] = field(default_factory=list)
    _floats: list[FloatArray] = field(default_factory=list)
    _texts: list[str] = field(default_factory=list)

    def integers(self, *values: int) -> None:
        self._integers.append(np.array(values, dtype=np.int64))

    def integer_array(self, values: IntArray | Iterable[int]) -> None:
        """Its length is not written."""
        found = values if isinstance(values, np.ndarray) else np.fromiter(values, dtype=np.int64)
        self._integers.append(found.astype(np.int64).ravel())

    def floats(self, *values: float) -> None:
        self._floats.append(np.array(values, dtype=np.float64))

    def array(self, values: FloatArray) -> None:
        """Its shape is not written."""
        self._floats.append(np.asarray(values, dtype=np.float64).ravel())

    def text(self, value: str) -> None:
        self._texts.append(value)

    def append(self, numbers: Numbers) -> None:
        """All that another one was given, in its order."""
        self._integers.append(numbers.integers)
        self._floats.append(numbers.floats)
        self._texts.extend(numbers.texts)

    def numbers(self) -> Numbers:
        """All that was put in."""
        return Numbers(
            np.concatenate([np.zeros(0, dtype=np.int64), *self._integers]),
            np.concatenate([np.zeros(0), *self._floats]),
            tuple(self._texts),
        )


class Source:
    """Gives values in the order in which they were put in.

    Raises:
        ValueError: from all methods: there are not so many, or they are not what they should be.
    """

    def __init__(self, numbers: Numbers) -> None:
        if not np.isfinite(numbers.floats).all():
            raise ValueError("a number that is not finite")
        self._numbers = numbers
        self._integer = self._float = self._text = 0

    def integer(self, low: int, high: int) -> int:
        """One within bounds, both included."""
        value = int(self.integer_array(1)[0])
        if not low <= value <= high:
            raise ValueError(f"{value}, expected {low} to {high}")
        return value

    def flag(self) -> bool:
        return bool(self.integer(0, 1))

    def integer_array(self, count: int) -> IntArray:
        end = self._integer + count
        if count < 0 or end > len(self._numbers.integers):
            raise ValueError("too few integers")
        out = self._numbers.integers[self._integer : end]
        self._integer = end
        return out

    def flags(self, count: int) -> BoolArray:
        """(count,) of bool."""
        values = self.integer_array(count)
        if ((values != 0) & (values != 1)).any():
            raise ValueError("a flag is 0 or 1")
        return values.astype(bool)

    def number(self) -> float:
        return float(self.array(1)[0])

    def array(self, *shape: int) -> FloatArray:
        """A copy of its own, so that one of them does not hold all in memory."""
        count = 1
        for size in shape:
            if size < 0:
                raise ValueError("a negative size")
            count *= size
        end = self._float + count
        if end > len(self._numbers.floats):
            raise ValueError("too few numbers")
        out = self._numbers.floats[self._float : end].reshape(shape).copy()
        self._float = end
        return out

    def text(self) -> str:
        if self._text >= len(self._numbers.texts):
            raise ValueError("too few texts")
        self._text += 1
        return self._numbers.texts[self._text - 1]

    def rest(self) -> Numbers:
        """All that is left; nothing is then."""
        found = self._numbers
        left = Numbers(found.integers[self._integer :], found.floats[self._float :], found.texts[self._text :])
        self._integer, self._float, self._text = len(found.integers), len(found.floats), len(found.texts)
        return left

    def finish(self) -> None:
        """All has to be used up."""
        left = (
            len(self._numbers.integers) - self._integer,
            len(self._numbers.floats) - self._float,
            len(self._numbers.texts) - self._text,
        )
        if any(left):
            raise ValueError(f"{left} integers, numbers, texts too many")


def check_poses(poses: FloatArray) -> None:
    """Refuse (n, 4, 4) that are no rigid transforms within a session's bounds.

    Raises:
        ValueError: there is one.
    """
    r = poses[:, :3, :3]
    off = np.abs(r.swapaxes(1, 2) @ r - np.eye(3)).max(initial=0.0)
    flat = np.abs(poses[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(initial=0.0)
    far = np.abs(poses[:, :3, 3]).max(initial=0.0)
    if not (off <= RIGID_TOLERANCE and flat <= RIGID_TOLERANCE and far <= FARTHEST_MM):
        raise ValueError("no rigid transform")
    if (np.linalg.det(r) < 0.0).any():
        raise ValueError("a mirror")


def check_covariances(covariances: FloatArray) -> None:
    """Refuse (n, d, d) that are not symmetric with variances >= 0.

    Raises:
        ValueError: there is one.
    """
    scale = np.abs(covariances).max(axis=(1, 2), initial=0.0)
    skew = np.abs(covariances - covariances.swapaxes(1, 2)).max(axis=(1, 2), initial=0.0)
    if (skew > 1e-6 * scale).any() or (np.diagonal(covariances, axis1=1, axis2=2) < 0.0).any():
        raise ValueError("no covariance")
