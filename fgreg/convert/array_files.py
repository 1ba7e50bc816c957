"""MATLAB and HDF5 files, IPASC's and UFF among them: their variables, and the probe's frames in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.convert.hdf5_file import is_hdf5, open_hdf5, read_hdf5
from fgreg.convert.ipasc import is_ipasc, read_ipasc
from fgreg.convert.mapping import RecordingMapping
from fgreg.convert.matlab_file import read_matlab
from fgreg.convert.probe_frames import DeclaredProbe, ProbeFrames
from fgreg.convert.uff import channel_data_of, read_uff
from fgreg.convert.variables import Variable
from fgreg.errors import InputError

ARRAY_SUFFIXES = (".mat", ".h5", ".hdf5", ".uff")


@dataclass(frozen=True, slots=True, eq=False)
class ArrayFile:
    """The variables of a file by their names, and the probe's frames in it, None where it has none."""

    variables: Mapping[str, Variable]
    frames: ProbeFrames | None


def open_array_file(path: Path, mapping: RecordingMapping) -> ArrayFile:
    """Open a file in this process; a damaged one may end it (fgreg.convert.child_reader).

    Raises:
        InputError: another file, a damaged one, an array of frames whose axes are not said, or no such variable.
        MissingExtraError: what reads it is not installed.
    """
    variables = _variables(path)
    return ArrayFile(variables, _probe_frames(path, mapping, variables))


def _variables(path: Path) -> dict[str, Variable]:
    """All variables of a MATLAB or HDF5 file.

    Raises:
        InputError: neither of them, or damaged.
        MissingExtraError: what reads it is not installed.
    """
    if is_hdf5(path):
        return read_hdf5(path)
    if path.suffix.lower() != ".mat":
        raise InputError(str(path), "another file", "an HDF5 file")
    return read_matlab(path)


def _probe_frames(path: Path, mapping: RecordingMapping, variables: Mapping[str, Variable]) -> ProbeFrames | None:
    if is_hdf5(path):
        with open_hdf5(path) as file:
            ipasc, uff = is_ipasc(file), bool(channel_data_of(file))
        if ipasc and mapping.array_variable is None:
            return read_ipasc(path, mapping)
        if uff:
            return read_uff(path, mapping)
    name = mapping.array_variable or "frame"
    variable = variables.get(name)
    if variable is None or (mapping.array_variable is None and not (variable.is_array or mapping.array_axes)):
        if mapping.array_variable is None:
            return None
        there = ", ".join(sorted(variables))
        raise InputError(f"{path.name}: {name}", "no such variable", f"one of {there}"[:300])
    return _frames_of(path.name, name, variable, mapping.array_axes)


def _frames_of(file: str, name: str, variable: Variable, axes: tuple[str, ...] | None) -> ProbeFrames:
    """The frames of an array, or of a list of arrays of two axes."""
    size = " x ".join(map(str, variable.shape))
    if variable.unreadable:
        raise InputError(variable.where, variable.unreadable, "an array of numbers")
    if axes is None:
        expected = "array.axes in the mapping, such as [elements, samples, frames]"
        raise InputError(variable.where, f"frames of {size} numbers and nothing about their axes", expected)
    first, second = ("elements", "samples") if "elements" in axes else ("depth", "lateral")
    flat = [axis for axis in axes if axis != "frames"]
    read_part = variable.part
    if read_part is None:
        entries = [np.asarray(entry) for entry in variable.load()]
        if "frames" in axes or any(entry.ndim != 2 for entry in entries):
            raise InputError(variable.where, "a list of arrays", f"arrays with axes {', '.join(flat)}")
        count, shape = len(entries), entries[0].shape if entries else (0, 0)
    else:
        shape = variable.shape
        if len(shape) == len(axes) - 1 and axes[-1] == "frames":  # MATLAB leaves out a last axis of one
            axes = axes[:-1]
        if len(shape) != len(axes):
            raise InputError(variable.where, f"{len(shape)} axes ({size})", f"{len(axes)}: {', '.join(axes)}")
        count = shape[axes.index("frames")] if "frames" in axes else 1
        shape = tuple(shape[axes.index(axis)] for axis in flat)

    def read(index: int) -> npt.NDArray[Any]:
        if read_part is None:
            stored = entries[index]
        elif "frames" in axes:
            stored = read_part(axes.index("frames"), index)
        else:
            stored = np.asarray(variable.load())
        return stored if flat == [first, second] else stored.T

    elements = shape[flat.index("elements")] if "elements" in flat else None
    declared = DeclaredProbe(variable.where, elements=elements, channels=elements is not None)
    return ProbeFrames(file, count, read, declared, taken=(name,))
