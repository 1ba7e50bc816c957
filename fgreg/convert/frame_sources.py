"""The frames that the rows of a table name: NPY files and pictures, or frames inside other programs' files."""

from __future__ import annotations

from collections.abc import Mapping
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
from fgreg.detection.frame_files import png_bytes, read_picture
from fgreg.errors import InputError
from fgreg.schema.problems import shown
from fgreg.session.yaml_loader import read_bounded

ARRAY_SUFFIXES = (".mat", ".h5", ".hdf5", ".uff")
_MAX_BYTES = 256_000_000


def read_variables(path: Path) -> dict[str, Variable]:
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


def open_probe_frames(
    path: Path, mapping: RecordingMapping, variables: Mapping[str, Variable] | None = None
) -> ProbeFrames | None:
    """The probe's frames in a MATLAB, HDF5, IPASC or UFF file; None where it has none.

    Args:
        path: the file.
        mapping: the array of frames and its axes.
        variables: those of the file, where they have been read.

    Raises:
        InputError: damaged, an array whose axes are not said, or no such variable.
        MissingExtraError: what reads it is not installed.
    """
    if is_hdf5(path):
        with open_hdf5(path) as file:
            ipasc, uff = is_ipasc(file), bool(channel_data_of(file))
        if ipasc and mapping.array_variable is None:
            return read_ipasc(path, mapping)
        if uff:
            return read_uff(path, mapping)
    variables = variables if variables is not None else read_variables(path)
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
    declared = DeclaredProbe(variable.where, elements=elements)
    return ProbeFrames(file, count, read, declared, taken=(name,))


class FrameSources:
    """Names in the session of the frames that rows name, and what is written under them.

    Args:
        mapping: how frames are stored in MATLAB and HDF5 files.
    """

    def __init__(self, mapping: RecordingMapping) -> None:
        self._mapping = mapping
        self._names: dict[tuple[Path, int | None], str] = {}
        self._opened: dict[Path, ProbeFrames] = {}

    @property
    def declared(self) -> list[DeclaredProbe]:
        """What the files of the frames say of the probe."""
        return [frames.declared for frames in self._opened.values()]

    def name(self, path: Path, text: str, index: int | None, where: str, suffix: str) -> str:
        """The name of a frame in the session; the same frame always has the same name.

        Args:
            path: the file.
            text: its name as given.
            index: number of the frame in a file of several, None where that is not said.
            where: the place of the name, for messages.
            suffix: ``.png`` of a picture, ``.npy`` of a frame of the probe.

        Raises:
            InputError: no such file or frame, or one of another kind.
        """
        if not path.is_file():
            raise InputError(where, f"{shown(text)}: no such file", "a file relative to the table")
        if suffix == ".npy" and path.suffix.lower() in ARRAY_SUFFIXES:
            index = self._index(path, index, where)
        elif suffix == ".npy" and path.suffix.lower() != ".npy":
            expected = f"an NPY array, or a file that ends in {', '.join(ARRAY_SUFFIXES)}"
            raise InputError(where, shown(text), expected)
        else:
            index = None
        stem = "".join(c if c.isascii() and (c.isalnum() or c in "-_.") else "_" for c in path.stem)[:60]
        number = "" if index is None else f"-{index:06d}"
        return self._names.setdefault((path, index), f"frames/{len(self._names):04d}-{stem}{number}{suffix}")

    def _index(self, path: Path, index: int | None, where: str) -> int:
        """The number of a frame in a file."""
        if path not in self._opened:
            frames = open_probe_frames(path, self._mapping)
            if frames is None:
                raise InputError(
                    where, f"{shown(path.name)}, in which no array is called frame", "array.variable in the mapping"
                )
            self._opened[path] = frames
        count = self._opened[path].count
        if index is None and count != 1:
            raise InputError(
                f"{where}_index", "nothing", f"the number of one of the {count} frames in {path.name}, from 0"
            )
        if index is not None and not 0 <= index < count:
            raise InputError(
                f"{where}_index", str(index), f"a number below {count}, from 0: {path.name} has as many frames"
            )
        return index or 0

    def write(self, folder: Path) -> None:
        """Write all named frames; pictures of other formats are converted to PNG."""
        for (path, index), name in self._names.items():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            if index is not None:
                np.save(target, self._opened[path].frame(index), allow_pickle=False)
                continue
            data = read_bounded(path, str(path), _MAX_BYTES)
            if path.suffix.lower() not in (".npy", ".png"):
                picture = read_picture(path)
                if picture is None:
                    raise InputError(str(path), "a file that is not an image", "a picture (PNG, JPEG, BMP, TIFF)")
                data = png_bytes(picture)
            target.write_bytes(data)
