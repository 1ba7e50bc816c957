"""CSV tables: one event per row. Columns have the names of their roles, or those of a mapping."""

from __future__ import annotations

import csv
import io
import itertools
import math
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from fgreg.convert.drafts import Document, Draft, Imported, rows
from fgreg.convert.frame_sources import FrameSources
from fgreg.convert.mapping import COLUMNS, LOOK, Column, RecordingMapping
from fgreg.errors import InputError
from fgreg.geometry.quaternions import rotation_from_quaternion
from fgreg.geometry.transforms import FloatArray, exp_so3, is_rigid, make_transform
from fgreg.schema.files import FrameName
from fgreg.schema.kinds import Number
from fgreg.schema.limits import EVENT_LINES, TABLE_BYTES, TABLE_COLUMNS
from fgreg.schema.problems import shown
from fgreg.session.yaml_loader import read_bounded

_DELIMITERS = (",", ";", "\t")
_POSITION = ("marker_x_mm", "marker_y_mm", "marker_z_mm")
_QUATERNION = ("marker_qx", "marker_qy", "marker_qz", "marker_qw")
_TURN = ("marker_rx_rad", "marker_ry_rad", "marker_rz_rad")
_SPOT = ("spot_x_mm", "spot_y_mm", "spot_z_mm")
_WITH_MARKER = ("aim", "pair", "track")


def read_table(path: Path, mapping: RecordingMapping) -> Imported:
    """Read a table; the frames it names are in files relative to its folder.

    Raises:
        InputError: the first invalid cell, with its line.
    """
    try:
        text = read_bounded(path, path.name, TABLE_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(path.name, "bytes that are not UTF-8", "a CSV table in UTF-8") from None
    lines = text.splitlines(keepends=True)
    if len(lines) > EVENT_LINES:
        raise InputError(path.name, f"{len(lines)} lines", f"at most {EVENT_LINES}: a part of the table")
    start = next((i for i, line in enumerate(lines) if line.strip() and not line.startswith("#")), None)
    if start is None:
        raise InputError(path.name, "nothing", "a table with a line of column names")
    delimiter = mapping.delimiter or max(_DELIMITERS, key=lines[start].count)
    reader = csv.reader(io.StringIO("".join(lines[start:])), delimiter=delimiter, strict=True)

    def rows_of_cells() -> Iterator[tuple[str, list[str]]]:
        for cells in reader:
            if any(cell.strip() for cell in cells) and not cells[0].startswith("#"):
                yield f"line {start + reader.line_num}", cells

    try:
        names = [name.strip() for name in next(reader)]
        return events_of_rows(path, mapping, names, rows_of_cells(), f"CSV table {path.name}")
    except csv.Error as error:
        raise InputError(f"{path.name}: line {start + reader.line_num}", str(error), "a row of a CSV table") from None


def events_of_rows(
    path: Path, mapping: RecordingMapping, names: list[str], rows: Iterable[tuple[str, list[str]]], source: str
) -> Imported:
    """The events of a table.

    Args:
        path: of the table, for messages; the files that it names are relative to its folder.
        mapping: names of the columns.
        names: of the columns, in order.
        rows: the place of each row in the file, and its cells.
        source: description of the table.

    Raises:
        InputError: a role without its column, an invalid cell, times that go back.
    """
    table = _Table(path, mapping)
    table.take_header(names)
    frames = FrameSources(mapping)
    drafts = [_Row(table, cells, place, frames).draft() for place, cells in rows]
    for before, after in itertools.pairwise(drafts):
        if after.t < before.t:
            where = before.where.removeprefix(f"{path.name}: ")
            raise InputError(f"{after.where}: t", f"{after.t:.17g}", f"at least {before.t:.17g}, the time on {where}")
    notes = [f"columns that are not used: {', '.join(table.unused)}"] if table.unused else []
    return Imported(drafts, frames.write, source, notes, declared=frames.declared)


class _Table:
    """The header of a table: the column of each role."""

    def __init__(self, path: Path, mapping: RecordingMapping) -> None:
        self.path, self._mapping = path, mapping
        self.places: dict[str, int] = {}
        self.columns: dict[str, Column] = {}
        self.width = 0
        self.unused: list[str] = []

    def take_header(self, names: list[str]) -> None:
        if len(names) > TABLE_COLUMNS:
            raise InputError(f"{self.path.name}: header", f"{len(names)} columns", f"at most {TABLE_COLUMNS}")
        twice = sorted({name for name in names if name and names.count(name) > 1})
        if twice:
            raise InputError(f"{self.path.name}: header", f"the column {shown(twice[0])} twice", "each name once")
        self.width = len(names)
        for role in COLUMNS:
            column = self._mapping.columns.get(role)
            if column is None:
                if role in names:
                    column = Column(role)
                else:
                    continue
            if column.value is None:
                if column.column not in names:
                    found = f"no column {shown(column.column)}, which the mapping has for {role}"
                    raise InputError(f"{self.path.name}: header", found, f"one of {', '.join(names)[:200]}")
                self.places[role] = names.index(column.column)
            self.columns[role] = column
        taken = {names[place] for place in self.places.values()}
        self.unused = [name for name in names if name and name not in taken]
        if "t" not in self.columns:
            raise InputError(f"{self.path.name}: header", ", ".join(names)[:200] or "nothing", "a column t, in seconds")


class _Row:
    """One row: its cells by role."""

    def __init__(self, table: _Table, cells: list[str], place: str, frames: FrameSources) -> None:
        self._table, self._cells, self._frames = table, cells, frames
        self.where = f"{table.path.name}: {place}"
        if len(cells) != table.width:
            raise InputError(self.where, f"{len(cells)} cells", f"{table.width}, as the header has")

    def draft(self) -> Draft:
        """The row as an event; missing values are reported when the event is read."""
        kind = self.text("type") or "pair"
        document: Document = {"type": kind, "t": self.need("t")}
        if kind == "pair":
            document["pm"] = self.whole("pm")
        if kind in _WITH_MARKER:
            document["marker"] = self._marker()
        if kind == "pair":
            document["trus"] = self._trus()
        elif kind == "track":
            has_look = any(self.text(key) for key in ("x_mm", "range_mm", "frame"))
            document |= {"trus": self._trus()} if has_look else {"scan_deg": self.need("scan_deg")}
        elif kind == "aim":
            spot = self.three(_SPOT)
            if spot is not None:
                document["camera_p_spot_mm"] = spot
            if self.text("corner_column") or self.text("corner_row"):
                document["corner"] = [self.whole("corner_column"), self.whole("corner_row")]
        elif kind == "camera_moved":
            moved = self.transform("camera_new_T_camera_old")
            if moved is not None:
                document["camera_new_T_camera_old"] = rows(moved)
        elif kind == "note":
            document["text"] = self.text("text")
        return Draft(document, self.where)

    def text(self, role: str) -> str:
        """A cell, stripped; empty where there is none."""
        column = self._table.columns.get(role)
        if column is None:
            return ""
        return column.value if column.value is not None else self._cells[self._table.places[role]].strip()

    def number(self, role: str) -> float | None:
        """A number, or None where the cell is empty."""
        text = self.text(role)
        if not text:
            return None
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"{self.where}: {role}", shown(text), "a finite number, with a decimal point")
        column = self._table.columns[role]
        converted = value * column.scale + column.offset
        if not math.isfinite(converted):
            found = f"{shown(text)} times {column.scale:g} plus {column.offset:g}"
            raise InputError(f"{self.where}: {role}", found, "a finite number")
        return converted

    def need(self, role: str) -> float:
        """A required number."""
        value = self.number(role)
        if value is None:
            raise InputError(f"{self.where}: {role}", "nothing", "a number")
        return value

    def whole(self, role: str) -> int:
        """A required whole number."""
        value = self.need(role)
        if value != round(value):
            raise InputError(f"{self.where}: {role}", f"{value:g}", "a whole number")
        return round(value)

    def three(self, roles: tuple[str, ...]) -> list[float] | None:
        """Numbers that are all given, or None where none is."""
        if not any(self.text(role) for role in roles):
            return None
        return [self.need(role) for role in roles]

    def transform(self, role: str) -> FloatArray | None:
        """A 4x4 matrix in one cell, row by row."""
        text = self.text(role)
        if not text:
            return None
        try:
            values = np.array([float(word) for word in text.replace(";", " ").replace(",", " ").split()])
        except ValueError:
            values = np.zeros(0)
        if values.size != 16 or not np.isfinite(values).all() or not is_rigid(values.reshape(4, 4)):
            raise InputError(f"{self.where}: {role}", shown(text), "a rigid 4x4 matrix: 16 numbers, row by row")
        return values.reshape(4, 4)

    def _marker(self) -> Document:
        marker: Document = {}
        pose = self.transform("camera_T_marker")
        position = self.three(_POSITION)
        if pose is None and position is not None:
            pose = make_transform(self._rotation(), np.array(position))
        if pose is not None:
            marker["camera_T_marker"] = rows(pose)
        for side in ("left", "right"):
            if name := self.text(side):
                marker[side] = self._frame(side, name, ".png")
        return marker

    def _rotation(self) -> FloatArray:
        quaternion, turn = self.three(_QUATERNION), self.three(_TURN)
        if (quaternion is None) == (turn is None):
            found = "neither a quaternion nor a turn" if turn is None else "a quaternion and a turn"
            raise InputError(self.where, found, f"{', '.join(_QUATERNION)} or {', '.join(_TURN)}")
        if turn is not None:
            return exp_so3(np.array(turn))
        if quaternion is None:
            raise AssertionError("one of the two is there")
        try:
            return rotation_from_quaternion(*quaternion)
        except ValueError as error:
            raise InputError(f"{self.where}: marker_qx", str(error), "a unit quaternion") from None

    def _trus(self) -> Document:
        trus: Document = {}
        for key in LOOK:
            name = key.name
            if isinstance(key.kind, FrameName):
                value: object = self._frame(name, self.text(name), ".npy") if self.text(name) else None
            elif isinstance(key.kind, Number):
                value = self.need(name) if key.required else self.number(name)
            else:
                value = self.whole(name) if self.text(name) else None
            if value is not None:
                trus[name] = value
        return trus

    def _frame(self, role: str, name: str, suffix: str) -> str:
        """The name of a frame in the session."""
        index = self.whole("frame_index") if role == "frame" and self.text("frame_index") else None
        return self._frames.name(self._table.path.parent / name, name, index, f"{self.where}: {role}", suffix)
