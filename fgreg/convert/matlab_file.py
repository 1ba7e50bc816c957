"""MATLAB files before v7.3 (``.mat``), read by scipy: variables, fields of structs as ``struct.field``.

A damaged file makes scipy's reader end the process (a type code out of range: scipy pull request 25349) or fill the
memory, so it reads in a child process.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.convert.probe_frames import MAX_BYTES
from fgreg.convert.variables import Variable
from fgreg.errors import InputError
from fgreg.workers.worker_process import START_S, WorkerProcess

_MAX_DEPTH = 20
_MAX_VARIABLES = 10_000
_READ_S = 120.0
_MEMORY = 3 * MAX_BYTES

Value = npt.NDArray[Any] | list[Any] | None
"""Of a variable: an array of numbers or texts, the entries of a struct or cell array, or None for an object."""


def read_matlab(path: Path) -> dict[str, Variable]:
    """The variables of a file.

    Raises:
        InputError: no MATLAB file, a damaged one, or one that needs too much time or memory.
    """
    what = f"the reader of {path.name}"
    worker: WorkerProcess[str, dict[str, Value]] = WorkerProcess(
        _reader, name="fgreg mat", what=what, niceness=0, answer_s=_READ_S, restart=False
    )
    with closing(worker):
        worker.send(str(path))
        reply = worker.fetch(START_S + _READ_S + 1.0)
        found = None if reply is None else reply[0]
        if found is None:
            words = (worker.failure or "no answer")[:200]
            raise InputError(path.name, f"a MATLAB file that cannot be read ({words})", "a whole one")
    return {key: _variable(f"{path.name}: {key}", value) for key, value in found.items()}


def _variable(where: str, value: Value) -> Variable:
    if value is None:
        return Variable(where, (), lambda: None, unreadable="an object (string, table, datetime, sparse)")
    if isinstance(value, list):
        return Variable(where, (len(value),), partial(list, value))
    part = None if value.dtype.kind == "U" else (lambda axis, index: np.take(value, index, axis=axis))
    return Variable(where, value.shape, lambda: value, part, rows_last=True)


def _reader() -> Callable[[str], dict[str, Value]]:
    """In the child: limits its memory, and gives the function that reads a file."""
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    return _read


def _read(path: str) -> dict[str, Value]:
    """The values of all variables. Raises whatever scipy does on a damaged file."""
    import warnings

    from scipy.io import loadmat, matlab, whosmat

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", matlab.MatReadWarning)  # variables that cannot be read, or are there twice
        size = sum(8 * math.prod(int(n) for n in shape) for _, shape, _ in whosmat(path, appendmat=False))
        if size > 2 * MAX_BYTES:
            raise ValueError(f"arrays of {size} bytes, more than {2 * MAX_BYTES}")
        stored = loadmat(path, appendmat=False, chars_as_strings=True, struct_as_record=True)
    values = _Values(matlab.MatlabOpaque)
    for key, value in stored.items():
        if not key.startswith("__"):
            values.collect(key, value, 0)
    return values.found


class _Values:
    """The values of variables and fields."""

    def __init__(self, opaque: type) -> None:
        self._opaque = opaque
        self.found: dict[str, Value] = {}

    def collect(self, key: str, value: Any, depth: int) -> None:
        """Add a variable, or the fields of a struct. Raises ValueError where they are beyond measure."""
        if depth > _MAX_DEPTH or len(self.found) > _MAX_VARIABLES:
            raise ValueError(f"more than {_MAX_DEPTH} structs inside each other, or more than {_MAX_VARIABLES} fields")
        if isinstance(value, self._opaque) or not isinstance(value, np.ndarray):
            self.found[key] = None
        elif value.dtype.names is not None:
            for field in value.dtype.names:
                self._entries(f"{key}.{field}", list(value[field].ravel(order="F")), depth)
        elif value.dtype == object:
            self._entries(key, list(value.ravel(order="F")), depth)
        else:
            self.found[key] = value

    def _entries(self, key: str, entries: list[Any], depth: int) -> None:
        """Add the entries of a struct or cell array; a single one is itself, as in Verasonics' RcvData."""
        if len(entries) == 1:
            self.collect(key, entries[0], depth + 1)
        else:
            self.found[key] = [np.asarray(entry) for entry in entries]
