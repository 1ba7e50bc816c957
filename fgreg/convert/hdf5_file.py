"""HDF5 files, MATLAB's v7.3 among them, read by ``h5py`` (extra ``[hdf5]``): datasets as variables.

A dataset has its path as its name, ``/`` between groups, and MATLAB's a ``.`` as between structs. MATLAB's axes are
turned back to their order there; its cell and struct arrays, which HDF5 holds as references, become lists.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.convert.variables import Variable
from fgreg.errors import InputError, MissingExtraError
from fgreg.schema.limits import ARRAY_BYTES, ARRAY_VARIABLES

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_NOT_VARIABLES = ("#refs#", "#subsystem#")


def is_hdf5(path: Path) -> bool:
    """Whether a file begins as HDF5 does, or after MATLAB's 512 bytes of text."""
    try:
        with path.open("rb") as file:
            start = file.read(520)
    except OSError:
        return False
    return start.startswith(_SIGNATURE) or start[512:].startswith(_SIGNATURE)


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """An open ``h5py.File``.

    Raises:
        InputError: damaged, also where that shows inside the block.
        MissingExtraError: ``h5py`` is not installed.
    """
    try:
        import h5py
    except ImportError:
        raise MissingExtraError("h5py", "hdf5") from None
    try:
        with h5py.File(path, "r") as file:
            yield file
    except InputError:
        raise
    except (
        OSError,
        RuntimeError,
        ValueError,
        TypeError,
        KeyError,
        AttributeError,
        MemoryError,
        OverflowError,
    ) as error:
        words = (" ".join(str(error).split()) or type(error).__name__)[:160]
        raise InputError(path.name, f"an HDF5 file that cannot be read ({words})", "a whole one") from None


def check_dataset(dataset: Any, where: str) -> None:
    """Raises InputError where a dataset is too large to read, or kept in another file."""
    if dataset.external or dataset.is_virtual:
        raise InputError(where, "a dataset kept in another file", "one in this file")
    if dataset.shape is None or math.prod(dataset.shape) * dataset.dtype.itemsize > ARRAY_BYTES:
        raise InputError(where, f"an array of shape {dataset.shape}", f"at most {ARRAY_BYTES} bytes")


def read_hdf5(path: Path) -> dict[str, Variable]:
    """The datasets of a file.

    Raises:
        InputError: damaged.
        MissingExtraError: ``h5py`` is not installed.
    """
    found: dict[str, Variable] = {}
    with open_hdf5(path) as file:
        matlab = file.userblock_size >= 512 and _begins_as_matlab(path)

        def collect(key: str, item: Any) -> None:
            if key.split("/", 1)[0] in _NOT_VARIABLES or not hasattr(item, "shape"):
                return
            if len(found) >= ARRAY_VARIABLES:
                raise InputError(path.name, f"more than {ARRAY_VARIABLES} datasets", "fewer")
            name = key.replace("/", ".") if matlab else key
            if item.shape and math.prod(item.shape) == 1 and item.dtype.hasobject:
                item = _alone(file, item)  # a cell around an array, as in Verasonics' RcvData
            if hasattr(item, "shape"):
                found[name] = _Stored(path, item.name, f"{path.name}: {name}", matlab).variable(item)

        file.visititems(collect)
    return found


@dataclass(frozen=True, slots=True)
class _Stored:
    """A dataset; the file is opened for each access."""

    path: Path
    key: str
    where: str
    matlab: bool

    def variable(self, dataset: Any) -> Variable:
        import h5py

        kind = _matlab_class(dataset)
        if dataset.attrs.get("MATLAB_object_decode", 0) or kind in ("string", "datetime", "table"):
            return Variable(self.where, (), lambda: None, unreadable="an object (string, table, datetime)")
        if kind == "char" or h5py.check_string_dtype(dataset.dtype) is not None:
            return Variable(self.where, dataset.shape or (1,), self.texts)
        if h5py.check_ref_dtype(dataset.dtype) is not None:
            return Variable(self.where, (math.prod(dataset.shape),), self.entries)
        shape = dataset.shape or ()
        return Variable(self.where, shape[::-1] if self.matlab else shape, self.numbers, self.part, self.matlab)

    @contextmanager
    def _open(self) -> Iterator[tuple[Any, Any]]:
        with open_hdf5(self.path) as file:
            dataset = file[self.key]
            check_dataset(dataset, self.where)
            yield file, dataset

    def numbers(self) -> npt.NDArray[Any]:
        with self._open() as (_, dataset):
            return self._axes(dataset[()])

    def part(self, axis: int, index: int) -> npt.NDArray[Any]:
        with self._open() as (_, dataset):
            at: list[slice | int] = [slice(None)] * dataset.ndim
            at[dataset.ndim - 1 - axis if self.matlab else axis] = index
            return self._axes(dataset[tuple(at)])

    def _axes(self, stored: Any) -> npt.NDArray[Any]:
        return np.asarray(stored).T if self.matlab else np.asarray(stored)

    def texts(self) -> npt.NDArray[np.str_]:
        with self._open() as (_, dataset):
            if _matlab_class(dataset) == "char":
                return np.array([_text(dataset)])
            return np.atleast_1d(np.asarray(dataset.asstr(errors="replace")[()], dtype=str))

    def entries(self) -> list[Any]:
        with self._open() as (file, dataset):
            return [_entry(file[reference], self.where) for reference in dataset[()].ravel()]


def _alone(file: Any, dataset: Any) -> Any:
    """What the only reference of a dataset refers to; the dataset itself where it holds something else."""
    import h5py

    return dataset if h5py.check_ref_dtype(dataset.dtype) is None else file[dataset[()].item()]


def _begins_as_matlab(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(6) == b"MATLAB"


def _matlab_class(dataset: Any) -> str:
    stored = dataset.attrs.get("MATLAB_class", b"")
    return stored.decode("ascii", errors="replace") if isinstance(stored, bytes) else str(stored)


def _text(dataset: Any) -> str:
    """MATLAB's char: a column of UTF-16 codes."""
    if dataset.attrs.get("MATLAB_empty", 0):
        return ""
    return np.asarray(dataset[()], dtype="<u2").tobytes().decode("utf-16-le", errors="replace")


def _entry(dataset: Any, where: str) -> Any:
    """An entry of a cell or struct array: a text, or an array in MATLAB's order of axes."""
    if not hasattr(dataset, "shape"):
        raise InputError(where, "structs or cells inside a cell or struct array", "numbers or char")
    check_dataset(dataset, where)
    if _matlab_class(dataset) == "char":
        return _text(dataset)
    if dataset.attrs.get("MATLAB_empty", 0):
        return np.zeros(0)
    return np.asarray(dataset[()]).T
