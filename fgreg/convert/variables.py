"""Named arrays of a file (MATLAB, HDF5), and their values as the cells of a table: one form for all formats.

MATLAB's arrays have the rows of a table along the last axis (a 4x4xN array of transforms), or are vectors; those of
other HDF5 files have them along the first axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.errors import InputError


@dataclass(frozen=True, slots=True, eq=False)
class Variable:
    """An array of numbers or texts, or a list of such (a cell or struct array).

    Attributes:
        where: file and name, for messages.
        shape: of an array of numbers, in the order of axes of its own program; the number of entries of a list.
        load: all of it: an array of numbers or of texts, or a list of them.
        part: of an array of numbers, the part at one place along one axis.
        rows_last: whether the rows of a table are along the last axis.
        unreadable: what it is, where it is nothing that can be read.
    """

    where: str
    shape: tuple[int, ...]
    load: Callable[[], Any]
    part: Callable[[int, int], npt.NDArray[np.generic]] | None = None
    rows_last: bool = False
    unreadable: str = ""

    @property
    def is_array(self) -> bool:
        """Whether it is an array of numbers."""
        return self.part is not None

    def rows(self, count: int, entry: tuple[int, ...] = ()) -> Sequence[Any]:
        """Its values for each row of a table: numbers or texts, or arrays where ``entry`` is their shape.

        One value is that of all rows. Raises InputError where there is another number of values.
        """
        if self.unreadable:
            raise InputError(self.where, self.unreadable, "numbers, char, or a cell array of char")
        value = self.load()
        if isinstance(value, list):
            found: Sequence[Any] | None = value if len(value) == count else None
        elif entry and self.is_array:
            found = self._arrays(value, count, entry)
        else:
            values = value.ravel(order="F" if self.rows_last else "C").tolist()
            found = values * count if len(values) == 1 else values if len(values) == count else None
        if found is None:
            shape = "x".join(map(str, (*entry, count) if self.rows_last else (count, *entry)))
            raise InputError(
                self.where, " x ".join(map(str, self.shape)) + " values", f"{shape}, as t has {count} rows"
            )
        return found

    def _arrays(self, value: npt.NDArray[Any], count: int, entry: tuple[int, ...]) -> Sequence[Any] | None:
        """Arrays of one shape for each row; also flat ones, row by row, or one for the only row."""
        if value.shape == ((*entry, count) if self.rows_last else (count, *entry)):
            return list(np.moveaxis(value, -1, 0) if self.rows_last else value)
        if value.shape == (count, math.prod(entry)):
            return list(value)
        return [value] if count == 1 and value.shape == entry else None

    def numbers(self) -> npt.NDArray[np.float64]:
        """All its values as real numbers, in one dimension."""
        values = self.load() if self.is_array else None
        if values is None or values.dtype.kind not in "iufb":
            raise InputError(self.where, "no real numbers", "an array of numbers")
        return np.asarray(values, dtype=np.float64).ravel()


def cell_text(value: Any, where: str) -> str:
    """A value as the cell of a table: numbers exactly, matrices row by row; nothing for NaN or an empty value."""
    if isinstance(value, str):
        return value
    array = np.asarray(value)
    if array.dtype.kind == "U":
        return "".join(str(part) for part in array.ravel())
    if array.dtype.kind not in "iufb":
        raise InputError(where, f"an array of {array.dtype}", "real numbers or a text")
    if array.dtype.kind == "f" and np.isnan(array).all():
        return ""
    return " ".join(repr(entry) for entry in array.ravel().tolist())
