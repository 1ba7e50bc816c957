"""Reads Rerun recordings back, for tests."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import RrdReader

from fgreg.geometry.transforms import FloatArray


@dataclass(frozen=True, slots=True)
class Row:
    """One entry of an entity: shot and seconds (None where static), component values by name."""

    shot: int | None
    seconds: float | None
    values: dict[str, Any]

    def array(self, name: str) -> FloatArray:
        return np.asarray(self.values[name], dtype=np.float64)


def _rows(path: Path, blueprint: bool) -> Iterator[tuple[str, Row]]:
    reader = RrdReader(str(path))
    store = reader.blueprints()[-1] if blueprint else None
    for chunk in reader.stream(store=store):
        batch = chunk.to_record_batch()
        # Times as integers: without pandas pyarrow cannot represent nanoseconds.
        columns = {name: batch.column(name).to_pylist() for name in batch.schema.names if ":" in name or name == "shot"}
        if "time" in batch.schema.names:
            columns["time"] = batch.column("time").cast("int64").to_pylist()
        for i in range(batch.num_rows):
            values = {name: column[i] for name, column in columns.items() if ":" in name and column[i] is not None}
            shot, nanoseconds = (columns[name][i] if name in columns else None for name in ("shot", "time"))
            yield str(chunk.entity_path), Row(shot, None if nanoseconds is None else nanoseconds * 1e-9, values)


def read_recording(path: Path, *, blueprint: bool = False) -> dict[str, list[Row]]:
    """Entities of a recording (or of its last blueprint), each with its rows in order of shots, static ones first."""
    out: dict[str, list[Row]] = {}
    for entity, row in _rows(path, blueprint):
        out.setdefault(entity, []).append(row)
    for rows in out.values():
        rows.sort(key=lambda row: -1 if row.shot is None else row.shot)
    return out


def transform_of(row: Row) -> FloatArray:
    """(4, 4) of a Transform3D; Rerun stores matrices by columns."""
    out = np.eye(4)
    out[:3, :3] = row.array("Transform3D:mat3x3").reshape(3, 3).T
    out[:3, 3] = row.array("Transform3D:translation").reshape(3)
    return out


def views_of(path: Path) -> list[tuple[str, str]]:
    """Origin and shown name of each view of the blueprint."""
    rows = [row for rows in read_recording(path, blueprint=True).values() for row in rows]
    return [
        (row.values["ViewBlueprint:space_origin"][0], row.values["ViewBlueprint:display_name"][0])
        for row in rows
        if "ViewBlueprint:space_origin" in row.values
    ]


def views(path: Path) -> dict[str, str]:
    """Origin of each view of the blueprint, with its shown name (of one view where several have the origin)."""
    return dict(views_of(path))
