"""Mappings: the columns, topics or fields of a recording and their roles. One YAML file; every key has a default.

format: fgreg-mapping/1
# CSV
delimiter: ";"
columns: {t: time_s, scan_deg: {column: angle_rad, scale: 57.29577951}, type: {value: pair}}
# ROS
topics: {left: /rig/left/image_raw, marker: /marker/pose, scan: /stage/joint_states, frame: /probe/channels}
tf: {marker: [endoscope_left_optical, marker], scan: [probe_holder, probe], ecm: [base, endoscope_tip]}
scan: {joint: stage, unit: deg}
clock: recorder
max_gap_s: 0.1
same_pm_s: 0.5
camera_moved: {mm: 1.0, deg: 0.5, sigma_mm: 1.0, sigma_deg: 0.5, tip_T_camera: [[...]]}
# MATLAB, HDF5, UFF
array: {variable: rf, axes: [samples, elements, frames], wavelength_nm: 800}
# PLUS
fields: {marker: MarkerToCameraTransform, scan: StageAngle, pm: Pm}
images: envelope
orientation: MF
frames: [3, 4, 17]
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np

from fgreg.convert.drafts import ImageKind
from fgreg.geometry.transforms import FloatArray, as_float_array
from fgreg.model.events import TrusRecord
from fgreg.schema.kinds import Converted, Integer, JsonSchema, Kind, ListOf, Number, Text
from fgreg.schema.matrices import Covariance, Transform
from fgreg.schema.problems import FieldError, input_error, shown
from fgreg.schema.record import Field, Key, Section, record
from fgreg.session.yaml_loader import load_yaml

MAPPING_FORMAT = "fgreg-mapping/1"

LOOK = tuple(key for key in record(TrusRecord).fields if not isinstance(key.kind, Covariance | ListOf))
"""Keys of a look in a table."""

COLUMNS = (
    *("t", "type", "pm", *(key.name for key in LOOK), "left", "right", "text"),
    *("camera_T_marker", "marker_x_mm", "marker_y_mm", "marker_z_mm", "marker_qx", "marker_qy", "marker_qz"),
    *("marker_qw", "marker_rx_rad", "marker_ry_rad", "marker_rz_rad", "spot_x_mm", "spot_y_mm", "spot_z_mm"),
    *("corner_column", "corner_row", "camera_new_T_camera_old", "frame_index"),
)
"""Roles of CSV columns; a column has the name of its role unless the mapping names another."""

TOPICS = ("left", "right", "left_info", "right_info", "marker", "scan", "look", "frame", "mark", "ecm")
"""Roles of ROS topics; images, their camera_info and the ECM are also found by name."""

TF_ROLES = ("marker", "scan", "ecm")
"""Roles that a pose of ``/tf`` and ``/tf_static`` can have, in place of a topic."""

FIELDS = ("marker", "scan", "type", "pm", "sweep", "amplitude", "x_mm", "range_mm", "text")
"""Roles of the fields of a PLUS frame, besides its image and time."""


ORIENTATIONS = tuple(a + b for a, b in itertools.product("MU", "FN")) + tuple(b + a for a in "MU" for b in "FN")


def _by_name(name: str, known: tuple[str, ...], kind: Kind) -> Section:
    """A mapping from some of the known names to values of one kind."""
    return Section(name, tuple(Field(key, key, kind, False, None, Key("")) for key in known))


@dataclass(frozen=True, slots=True)
class Constant(Kind):
    """A number or a text, read as text."""

    takes_text = True

    def read(self, value: object, _folder: Path | None = None, /) -> str:
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise FieldError.of(shown(value), self.expected)
        return str(value)

    @property
    def expected(self) -> str:
        return "a number or a text"

    def json_schema(self, _definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return {"type": ["number", "string"]}


@dataclass(frozen=True, slots=True)
class Column:
    """Source of a value: ``scale * cell + offset`` of a column, or one value for all rows."""

    column: Annotated[str, Key("its name", Text("the name of a column"))] = ""
    scale: Annotated[float, Key("factor to the unit of the format", Number())] = 1.0
    offset: Annotated[float, Key("added after that", Number())] = 0.0
    value: Annotated[str | None, Key("instead: one value for all rows", Constant())] = None

    def __post_init__(self) -> None:
        if bool(self.column) == (self.value is not None):
            raise FieldError.of("both column and value, or neither", "one of them")


@dataclass(frozen=True, slots=True)
class ColumnKind(Kind):
    """A column's name, or a mapping of :class:`Column`."""

    takes_text = True

    def read(self, value: object, folder: Path | None = None, /) -> Column:
        if isinstance(value, Mapping):
            column: Column = record(Column).read(value, folder)
            return column
        return Column(Text(self.expected).read(value))

    @property
    def expected(self) -> str:
        return "the name of a column, or a mapping with column, scale, offset, or value"

    def json_schema(self, definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return {"anyOf": [{"type": "string", "minLength": 1}, record(Column).json_schema(definitions)]}


_LENGTH, _ANGLE = Number(0.0, 1e3, above=True), Number(0.0, 180.0, above=True)


@dataclass(frozen=True, slots=True, eq=False)
class CameraMoves:
    """Detection of camera moves from the pose of the endoscope's holder."""

    mm: Annotated[float, Key("a shift above this is a camera move", _LENGTH)] = 1.0
    deg: Annotated[float, Key("or a rotation above this", _ANGLE)] = 0.5
    sigma_mm: Annotated[float, Key("standard deviation of the holder's shift", _LENGTH)] = 1.0
    sigma_deg: Annotated[float, Key("standard deviation of its rotation", _ANGLE)] = 0.5
    tip_T_camera: Annotated[FloatArray, Key("pose of the camera on the holder", Transform(), default="identity")] = (
        field(default_factory=lambda: as_float_array(np.eye(4)))
    )


def _check_delimiter(text: str) -> None:
    if len(text) != 1:
        raise FieldError.of(shown(text), "one character")


_GAP = Number(0.0, 3600.0, above=True, unit="s")


def _two(names: tuple[str, ...]) -> tuple[str, str]:
    if len(names) != 2:
        raise FieldError.of(f"{len(names)} names", "two: the frame to express the pose in, and the frame of the body")
    return names[0], names[1]


_TWO_FRAMES = Converted(ListOf(Text("the name of a frame"), "a list of two names of frames"), _two, list)
AXES = ("elements", "samples", "depth", "lateral", "frames")
"""Names of the axes of an array of frames: channel data have elements and samples, images depth and lateral."""


def _axes(names: tuple[str, ...]) -> tuple[str, ...]:
    of_frame = set(names) - {"frames"}
    if len(set(names)) != len(names) or of_frame not in ({"elements", "samples"}, {"depth", "lateral"}):
        raise FieldError.of(
            shown(list(names)), "elements and samples, or depth and lateral, and frames, in their order"
        )
    return names


_AXES = Converted(ListOf(Text(allowed=AXES), "a list of names of axes"), _axes, list)
_FRAMES = ListOf(Integer(0, 2**31 - 1), "a list of frame numbers from 0")


@dataclass(frozen=True, slots=True, eq=False)
class RecordingMapping:
    """The contents of a mapping file; the defaults hold without a file."""

    columns: Annotated[
        Mapping[str, Column], Key("of CSV tables: where each value is", _by_name("Columns", COLUMNS, ColumnKind()))
    ] = field(default_factory=dict)
    delimiter: Annotated[
        str | None, Key("of CSV tables; absent: comma, semicolon or tab", Text("one character", check=_check_delimiter))
    ] = None
    topics: Annotated[
        Mapping[str, str], Key("of ROS recordings, by their roles", _by_name("Topics", TOPICS, Text("a name")))
    ] = field(default_factory=dict)
    tf: Annotated[
        Mapping[str, tuple[str, str]],
        Key("of ROS recordings: poses from /tf and /tf_static, by their roles", _by_name("Tf", TF_ROLES, _TWO_FRAMES)),
    ] = field(default_factory=dict)
    joint: Annotated[str | None, Key("joint that is the stage", Text("the name of a joint"), name="scan.joint")] = None
    angle_unit: Annotated[str | None, Key("unit of plain numbers", Text(allowed=("rad", "deg")), name="scan.unit")] = (
        None
    )
    clock: Annotated[
        str, Key("clock of the times: message headers, or the recorder", Text(allowed=("header", "recorder")))
    ] = "header"
    max_gap_s: Annotated[float, Key("largest time between joined data", _GAP)] = 0.1
    same_pm_s: Annotated[
        float | None, Key("looks within this time are of one PM; absent: each look has its own PM", _GAP)
    ] = None
    moves: Annotated[CameraMoves, Key("when the camera moved", name="camera_moved")] = field(
        default_factory=CameraMoves
    )
    array_variable: Annotated[
        str | None, Key("of MATLAB, HDF5, UFF: array of frames; absent: frame", Text("a name"), name="array.variable")
    ] = None
    array_axes: Annotated[
        tuple[str, ...] | None,
        Key("of that array: its axes, in the order of its own program", _AXES, name="array.axes"),
    ] = None
    wavelength_nm: Annotated[
        float | None,
        Key("of IPASC data: the wavelength to take", Number(1.0, 1e5, unit="nm"), name="array.wavelength_nm"),
    ] = None
    fields: Annotated[
        Mapping[str, str], Key("of PLUS sequences, by their roles", _by_name("Fields", FIELDS, Text("a name")))
    ] = field(default_factory=dict)
    frames: Annotated[
        frozenset[int] | None,
        Key("numbers of the frames of a PLUS sequence to take", Converted(_FRAMES, frozenset, sorted)),
    ] = None

    images: Annotated[
        ImageKind | None,
        Key(
            "what a PLUS sequence's images are: linear or log-compressed pixels, or the data of single elements",
            Text.of(ImageKind, "a kind of images"),
        ),
    ] = None

    orientation: Annotated[
        str | None,
        Key(
            "directions of x and y of a sequence's images where it has none: M or U to a side, F or N in depth",
            Text(allowed=ORIENTATIONS),
        ),
    ] = None

    @property
    def by_header(self) -> bool:
        """Whether times are from the messages' headers, not from the recorder."""
        return self.clock == "header"


MAPPING = record(RecordingMapping, ("format", MAPPING_FORMAT))
"""A mapping file."""


def read_mapping(path: Path) -> RecordingMapping:
    """Read a mapping file.

    Raises:
        InputError: the first problem, with key and line.
    """
    data = load_yaml(path, path.name)
    try:
        mapping: RecordingMapping = MAPPING.read(data)
    except FieldError as error:
        raise input_error(error.problems[0], path.name, data) from None
    return mapping
