"""MATLAB and HDF5 files as tables: each variable is a column, each of its values belongs to one event.

The columns are those of CSV tables (fgreg.convert.table), which checks the rows. Where the file has the probe's frames
(IPASC, UFF, or an array that the mapping names), frame k is that of row k, unless ``frame_index`` says otherwise or the
row has a position (x, range). IPASC's ``measurement_timestamps`` are the times where there is no variable ``t``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fgreg.convert import child_reader
from fgreg.convert.drafts import Imported
from fgreg.convert.mapping import COLUMNS, RecordingMapping
from fgreg.convert.probe_frames import ProbeFrames
from fgreg.convert.table import events_of_rows
from fgreg.convert.variables import Variable, cell_text
from fgreg.errors import InputError
from fgreg.schema.limits import EVENT_LINES

_MATRICES = ("camera_T_marker", "camera_new_T_camera_old")
_OF_FRAMES = ("frame", "frame_index")


def read_arrays(path: Path, mapping: RecordingMapping) -> Imported:
    """Read a MATLAB or HDF5 file as events.

    Raises:
        InputError: damaged, no times, a variable with another number of values than ``t``, an invalid value.
        MissingExtraError: what reads it is not installed.
    """
    opened = child_reader.open_array_file(path, mapping)
    variables, frames = opened.variables, opened.frames
    columns: dict[str, Sequence[Any]] = {}
    count = _times(path, variables, frames, mapping, columns)
    for role in COLUMNS:
        name = _name(role, mapping)
        if name in variables and name not in columns and not (role == "frame" and frames is not None):
            entry = (4, 4) if role in _MATRICES else ()
            columns[name] = variables[name].rows(count, entry)
    if frames is not None:
        _add_frames(path, frames, mapping, count, columns)
    _check_pose_and_scan(path, mapping, columns, variables)
    read = columns.keys() if frames is None else columns.keys() | {name for name in variables if frames.takes(name)}
    rest = {name: [""] * count for name in variables if name not in read}
    names = [*columns, *rest]
    texts = {name: _texts(values, f"{path.name}: {name}") for name, values in columns.items()} | rest
    rows = ((f"row {i}", [texts[name][i] for name in names]) for i in range(count))
    return events_of_rows(path, mapping, names, rows, f"variables of {path.name}")


def _name(role: str, mapping: RecordingMapping) -> str:
    """The variable of a role."""
    return mapping.columns[role].column if role in mapping.columns else role


def _times(
    path: Path,
    variables: Mapping[str, Variable],
    frames: ProbeFrames | None,
    mapping: RecordingMapping,
    columns: dict[str, Sequence[Any]],
) -> int:
    """Add the times to the columns; their number is that of the rows."""
    name = _name("t", mapping)
    if name in variables:
        columns[name] = variables[name].numbers().tolist()
    elif frames is not None and frames.times_s is not None and "t" not in mapping.columns:
        columns[name] = frames.times_s.tolist()
    else:
        there = ", ".join(sorted(variables)) or "no variables"
        expected = f"{name}, the time of each event in s; or a CSV table whose column frame names this file"
        raise InputError(path.name, there[:200], expected)
    count = len(columns[name])
    if not 0 < count <= EVENT_LINES:
        raise InputError(f"{path.name}: {name}", f"{count} values", f"1 to {EVENT_LINES}")
    return count


def _add_frames(
    path: Path, frames: ProbeFrames, mapping: RecordingMapping, count: int, columns: dict[str, Sequence[Any]]
) -> None:
    """Add the columns frame and frame_index."""
    if "frame" in mapping.columns:
        raise InputError("columns.frame", f"it, and frames in {path.name}", "array.variable, which names those")
    index = _name("frame_index", mapping)
    if index and index not in columns:
        if frames.count != count:
            expected = f"{count}, as there are times, or a variable frame_index"
            raise InputError(f"{path.name}: frames", str(frames.count), expected)
        columns[index] = range(count)
    given = [columns.get(_name(role, mapping), [""] * count) for role in ("x_mm", "range_mm")]
    located = ["".join(cell_text(values[i], path.name) for values in given) for i in range(count)]
    columns["frame"] = ["" if there else path.name for there in located]


def _check_pose_and_scan(
    path: Path, mapping: RecordingMapping, columns: dict[str, Sequence[Any]], variables: Mapping[str, Variable]
) -> None:
    """Raises InputError where the file has frames and times alone: poses and angles are in another one then."""
    for role, others in (("scan_deg", ()), ("camera_T_marker", ("marker_x_mm", "left"))):
        names = [_name(one, mapping) for one in (role, *others)]
        constant = any(one in mapping.columns and mapping.columns[one].value is not None for one in (role, *others))
        if not constant and not any(name in columns for name in names):
            there = ", ".join(sorted(variables))
            expected = f"{' or '.join(names)}; or a CSV table whose column frame names this file"
            raise InputError(path.name, there[:200], expected)


def _texts(values: Sequence[Any], where: str) -> list[str]:
    return [cell_text(value, where) for value in values]
