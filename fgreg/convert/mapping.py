"""Mappings: which columns, topics or fields of a recording are what. One YAML file; all of it has defaults.

format: fgreg-mapping/1
# CSV
delimiter: ";"
columns: {t: time_s, scan_deg: {column: angle_rad, scale: 57.29577951}, type: {value: pair}}
# ROS 2
topics: {left: /rig/left/image_raw, marker: /marker/pose, scan: /stage/joint_states, frame: /probe/channels}
scan: {joint: stage, unit: deg}
clock: recorder
max_gap_s: 0.1
same_pm_s: 0.5
camera_moved: {mm: 1.0, deg: 0.5, sigma_mm: 1.0, sigma_deg: 0.5, tip_T_camera: [[...]]}
# PLUS
fields: {marker: MarkerToCameraTransform, scan: StageAngle, pm: Pm}
frames: [3, 4, 17]
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fgreg.errors import InputError
from fgreg.frames import FloatArray, as_float_array
from fgreg.session.safe_yaml import load_yaml
from fgreg.session.schema import Bounds, Fields, Place, shown

MAPPING_FORMAT = "fgreg-mapping/1"

COLUMNS = (
    *("t", "type", "pm", "scan_deg", "x_mm", "range_mm", "amplitude", "sweep", "frame", "left", "right", "text"),
    *("camera_T_marker", "marker_x_mm", "marker_y_mm", "marker_z_mm", "marker_qx", "marker_qy", "marker_qz"),
    *("marker_qw", "marker_rx_rad", "marker_ry_rad", "marker_rz_rad", "spot_x_mm", "spot_y_mm", "spot_z_mm"),
    *("corner_column", "corner_row", "camera_new_T_camera_old"),
)
"""What a CSV table can have; each is looked for under its own name unless the mapping gives another."""

TOPICS = ("left", "right", "left_info", "right_info", "marker", "scan", "look", "frame", "mark", "ecm")
"""What a ROS 2 recording can have; images, their camera_info and the ECM are found by name."""

FIELDS = ("marker", "scan", "type", "pm", "sweep", "amplitude", "x_mm", "range_mm", "text")
"""What a PLUS sequence can have for each frame, besides its image and time."""

_SECTIONS = ("columns", "delimiter", "topics", "scan", "clock", "max_gap_s", "same_pm_s", "camera_moved", "fields")
_GAP = Bounds(0.0, 3600.0, above=True, unit="s")


@dataclass(frozen=True, slots=True)
class Column:
    """Where a value comes from: ``scale * cell + offset`` of a column, or one value for all rows."""

    column: str = ""
    scale: float = 1.0
    offset: float = 0.0
    value: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CameraMoves:
    """When the endoscope's holder says that the camera moved (mm, deg), how well it knows by how much, and where on
    it the camera is."""

    mm: float = 1.0
    deg: float = 0.5
    sigma_mm: float = 1.0
    sigma_deg: float = 0.5
    tip_T_camera: FloatArray = field(default_factory=lambda: as_float_array(np.eye(4)))


@dataclass(frozen=True, slots=True, eq=False)
class RecordingMapping:
    """A mapping, read; empty where there is no file.

    Attributes:
        columns, delimiter: of CSV tables.
        topics: of ROS 2 recordings, by their roles.
        joint, angle_unit: of the stage's angle.
        by_header: times are those of the messages' headers, not those of recording.
        max_gap_s: most time between what is put together.
        same_pm_s: looks that follow each other within so long are at the same PM; None: each is at one of its own.
        moves: of the camera.
        fields, frames: of PLUS sequences; frames are the numbers of those to take, None: all.
    """

    columns: Mapping[str, Column] = field(default_factory=dict)
    delimiter: str | None = None
    topics: Mapping[str, str] = field(default_factory=dict)
    joint: str | None = None
    angle_unit: str | None = None
    by_header: bool = True
    max_gap_s: float = 0.1
    same_pm_s: float | None = None
    moves: CameraMoves = field(default_factory=CameraMoves)
    fields: Mapping[str, str] = field(default_factory=dict)
    frames: frozenset[int] | None = None


def read_mapping(path: Path) -> RecordingMapping:
    """Reads a mapping file.

    Raises:
        InputError: the first problem, with key and line.
    """
    problems: list[InputError] = []
    top = Fields(load_yaml(path, path.name), ("format", *_SECTIONS, "frames"), Place(path.name), problems)
    top.text("format", MAPPING_FORMAT, allowed=(MAPPING_FORMAT,))
    columns: dict[str, Column] = {}
    if top.has("columns") and (inner := top.child("columns", COLUMNS)) is not None:
        columns = {name: _column(inner, name) for name in COLUMNS if inner.has(name)}
    delimiter = top.text("delimiter", "one character") if top.has("delimiter") else None
    if delimiter is not None and len(delimiter) != 1:
        top.fail("delimiter", shown(delimiter), "one character")
    joint = unit = None
    if top.has("scan") and (inner := top.child("scan", ("joint", "unit"))) is not None:
        joint = inner.text("joint", "the name of a joint") if inner.has("joint") else None
        unit = inner.text("unit", "rad or deg", allowed=("rad", "deg")) if inner.has("unit") else None
    clock = top.text("clock", "header or recorder", default="header", allowed=("header", "recorder"))
    frames: frozenset[int] | None = None
    if top.has("frames"):
        numbers = [entry for entry, _ in top.items("frames", "a list of frame numbers from 0")]
        if all(type(entry) is int and entry >= 0 for entry in numbers):
            frames = frozenset(entry for entry in numbers if isinstance(entry, int))
        else:
            top.fail("frames", "something else", "a list of frame numbers from 0")
    found = RecordingMapping(
        columns=columns,
        delimiter=delimiter,
        topics=_texts(top, "topics", TOPICS),
        joint=joint,
        angle_unit=unit,
        by_header=clock == "header",
        max_gap_s=top.number("max_gap_s", _GAP, default=0.1),
        same_pm_s=top.number("same_pm_s", _GAP) if top.has("same_pm_s") else None,
        moves=_moves(top),
        fields=_texts(top, "fields", FIELDS),
        frames=frames,
    )
    if problems:
        raise problems[0]
    return found


def _texts(top: Fields, key: str, known: tuple[str, ...]) -> dict[str, str]:
    inner = top.child(key, known) if top.has(key) else None
    return {} if inner is None else {name: inner.text(name, "a name") for name in known if inner.has(name)}


def _column(columns: Fields, name: str) -> Column:
    value = columns.raw(name)
    if not isinstance(value, Mapping):
        return Column(columns.text(name, "the name of a column, or a mapping with column, scale, offset, or value"))
    inner = columns.child(name, ("column", "scale", "offset", "value"))
    if inner is None:
        return Column()
    if inner.has("value") == inner.has("column"):
        inner.fail("", "both column and value, or neither", "one of them")
    if inner.has("value"):
        constant = inner.raw("value")
        if isinstance(constant, bool) or not isinstance(constant, int | float | str):
            inner.fail("value", shown(constant), "a number or a text")
        return Column(value=str(constant))
    column = inner.text("column", "the name of a column")
    return Column(column, inner.number("scale", default=1.0), inner.number("offset", default=0.0))


def _moves(top: Fields) -> CameraMoves:
    inner = None
    if top.has("camera_moved"):
        inner = top.child("camera_moved", ("mm", "deg", "sigma_mm", "sigma_deg", "tip_T_camera"))
    if inner is None:
        return CameraMoves()
    default, length, angle = CameraMoves(), Bounds(0.0, 1e3, above=True), Bounds(0.0, 180.0, above=True)
    return CameraMoves(
        mm=inner.number("mm", length, default=default.mm),
        deg=inner.number("deg", angle, default=default.deg),
        sigma_mm=inner.number("sigma_mm", length, default=default.sigma_mm),
        sigma_deg=inner.number("sigma_deg", angle, default=default.sigma_deg),
        tip_T_camera=inner.transform("tip_T_camera") if inner.has("tip_T_camera") else default.tip_T_camera,
    )
