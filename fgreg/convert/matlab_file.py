"""MATLAB files before v7.3 (``.mat``), read by scipy: variables, fields of structs as ``struct.field``."""

from __future__ import annotations

import math
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.convert.variables import Variable
from fgreg.errors import InputError
from fgreg.schema.limits import ARRAY_BYTES, ARRAY_VARIABLES, NESTING


def read_matlab(path: Path) -> dict[str, Variable]:
    """The variables of a file.

    Raises:
        InputError: no MATLAB file, or a damaged one.
    """
    from scipy.io import loadmat, matlab, whosmat

    name = path.name
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", matlab.MatReadWarning)  # a variable that cannot be read, or is there twice
            size = sum(8 * math.prod(int(n) for n in shape) for _, shape, _ in whosmat(str(path), appendmat=False))
            if size > 2 * ARRAY_BYTES:
                raise InputError(name, f"arrays of {size} bytes", f"at most {2 * ARRAY_BYTES}")
            stored = loadmat(str(path), appendmat=False, chars_as_strings=True, struct_as_record=True)
    except InputError:
        raise
    except Exception as error:  # on a damaged file the parser raises anything
        words = (" ".join(str(error).split()) or type(error).__name__)[:160]
        raise InputError(name, f"a MATLAB file that cannot be read ({words})", "a whole one") from None
    variables = _Variables(name, matlab.MatlabOpaque)
    for key, value in stored.items():
        if not key.startswith("__"):
            variables.collect(key, value, 0)
    return variables.found


class _Variables:
    """The variables of a file, and the fields of its structs."""

    def __init__(self, file: str, opaque: type) -> None:
        self._file, self._opaque = file, opaque
        self.found: dict[str, Variable] = {}

    def collect(self, key: str, value: Any, depth: int) -> None:
        """Add a variable, or the fields of a struct."""
        where = f"{self._file}: {key}"
        if depth > NESTING or len(self.found) > ARRAY_VARIABLES:
            expected = f"at most {NESTING} levels and {ARRAY_VARIABLES} fields"
            raise InputError(where, "more structs inside each other, or more fields", expected)
        if isinstance(value, self._opaque) or not isinstance(value, np.ndarray):
            unreadable = "an object (string, table, datetime, sparse)"
            self.found[key] = Variable(where, (), lambda: None, unreadable=unreadable)
        elif value.dtype.names is not None:
            for field in value.dtype.names:
                self._entries(f"{key}.{field}", list(value[field].ravel(order="F")), depth)
        elif value.dtype == object:
            self._entries(key, list(value.ravel(order="F")), depth)
        else:
            part = None if value.dtype.kind == "U" else (lambda axis, index: np.take(value, index, axis=axis))
            self.found[key] = Variable(where, value.shape, lambda: value, part, rows_last=True)

    def _entries(self, key: str, entries: list[Any], depth: int) -> None:
        """Add the entries of a struct or cell array; a single one is itself, as in Verasonics' RcvData."""
        if len(entries) == 1:
            self.collect(key, entries[0], depth + 1)
        else:
            self.found[key] = Variable(f"{self._file}: {key}", (len(entries),), partial(list, entries))
