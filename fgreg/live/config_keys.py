"""The keys of a live session's CONFIG.yaml, and a commented example with all of them."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

from fgreg.drivers.choice import DriverChoice
from fgreg.drivers.registry import DriverEntry, Role, drivers_of
from fgreg.live.scope_holder import HolderSettings
from fgreg.live.workflow import WorkflowSettings
from fgreg.model.solve_config import SolveConfig
from fgreg.model.time_sync import Latencies
from fgreg.schema.files import ExistingPath
from fgreg.schema.kinds import Integer, IntegerPair, JsonSchema, Kind, ListOf, Number, Text
from fgreg.schema.record import Field, Inline, Key, record
from fgreg.schema.yaml_writer import one_line_yaml
from fgreg.simulation.room import BUMP_EVERY_S
from fgreg.stage.limits import LIMITS

LIVE_FORMAT = "fgreg-live/1"
Choice = tuple[DriverEntry, Any]


@dataclass(frozen=True, slots=True)
class RoomOptions:
    """The simulated room."""

    seed: Annotated[int, Key("of everything random in it", Integer(0, 2**31 - 1))] = 1
    bump_every_s: Annotated[float, Key("mean time between moves of the camera", Number(1.0, 1e9, unit="s"))] = (
        BUMP_EVERY_S
    )
    width: Annotated[int, Key("of its camera's images, px", Integer(160, 1920))] = 640
    static_tags: Annotated[int, Key("beside the tissue", Integer(0, 3))] = 3


@dataclass(frozen=True, slots=True)
class CalibrationOptions:
    """Files with the endoscope's calibration."""

    left: Annotated[
        Path, Key("of ROS, OpenCV, Kalibr, scikit-surgery or MATLAB (JSON)", ExistingPath(), example="calibration.yaml")
    ]
    right: Annotated[
        Path | None,
        Key("the right camera's, or OpenCV's extrinsics", ExistingPath(), null=True, example="right.yaml"),
    ] = None
    unit: Annotated[
        str | None,
        Key(
            "of the files' lengths; m for ROS and Kalibr, mm for the others",
            Text(allowed=("m", "mm")),
            null=True,
            example="m",
        ),
    ] = None
    image_size: Annotated[
        tuple[int, int] | None,
        Key(
            "width and height, px, where the files do not say",
            IntegerPair(1, 32768, "[width, height], two integers from 1 to 32768"),
            null=True,
            example="[1280, 720]",
        ),
    ] = None
    pictures: Annotated[
        str,
        Key(
            "rectified: the pictures arrive rectified; rectify: rectify them here",
            Text(allowed=("raw", "rectified", "rectify")),
        ),
    ] = "raw"
    of_fields: Annotated[bool, Key("the calibration is that of single fields of interlaced frames")] = False


@dataclass(frozen=True, slots=True)
class LiveSettings:
    """``settings`` of the workflow, the endoscope's holder, the devices and the estimate."""

    workflow: Annotated[WorkflowSettings, Inline()]
    holder: Annotated[HolderSettings, Inline()] = field(default_factory=HolderSettings)
    latencies: Annotated[Latencies, Inline()] = field(default_factory=Latencies)
    solve: Annotated[SolveConfig, Inline()] = field(default_factory=SolveConfig)


@dataclass(frozen=True, slots=True)
class OneOrMore(Kind):
    """One value or a list of them; read as a tuple."""

    each: Kind

    def read(self, value: object, folder: Path | None = None, /) -> tuple[Any, ...]:
        if isinstance(value, list):
            return ListOf(self.each).read(value, folder)
        return (self.each.read(value, folder),)

    @property
    def expected(self) -> str:
        return self.each.expected

    def json_schema(self, definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return {"anyOf": [self.each.json_schema(definitions), ListOf(self.each).json_schema(definitions)]}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LiveDocument:
    """A CONFIG.yaml: a driver with its options for each role."""

    JSON_RULES: ClassVar = (
        {
            "if": {"not": {"properties": {"camera": {"properties": {"driver": {"const": "simulated"}}}}}},
            "then": {
                "required": ["session", "settings"],
                "properties": {"settings": {"required": ["hearing_threshold"]}},
            },
        },
    )

    session: Annotated[
        Path | None,
        Key("the set-up; copied into the new session's folder", ExistingPath(), example="session.yaml"),
    ] = None
    calibration: Annotated[CalibrationOptions | None, Key("of the endoscope, where session.yaml has no camera")] = None
    room: Annotated[
        RoomOptions | None,
        Key("the simulated room: camera, photoacoustic and stage have the driver simulated; no session then"),
    ] = None
    camera: Annotated[Choice, Key("The endoscope.", DriverChoice(Role.CAMERA))]
    photoacoustic: Annotated[
        Choice, Key("The probe's photoacoustic data, one frame for each laser pulse.", DriverChoice(Role.PHOTOACOUSTIC))
    ]
    stage: Annotated[Choice | None, Key("The stage that turns the probe; may be absent.", DriverChoice(Role.STAGE))] = (
        None
    )
    motion: Annotated[Choice | None, Key("The motion of the endoscope's holder.", DriverChoice(Role.MOTION))] = None
    bmode: Annotated[
        Choice | None, Key("B-mode pictures of a scanner, for display only.", DriverChoice(Role.BMODE))
    ] = None
    sinks: Annotated[
        tuple[Choice, ...], Key("Receivers of the registration; any number.", ListOf(DriverChoice(Role.SINKS)))
    ] = ()
    overlay: Annotated[
        tuple[Choice, ...],
        Key(
            "Displays of the endoscope's picture with the registration drawn on it; any number.",
            ListOf(DriverChoice(Role.OVERLAY)),
        ),
    ] = ()
    operator: Annotated[
        tuple[Choice, ...],
        Key("Sources of the operator's commands; a list if there are several.", OneOrMore(DriverChoice(Role.OPERATOR))),
    ] = ()
    settings: Annotated[LiveSettings | None, Key("Of the session.")] = None


LIVE = record(LiveDocument, ("format", LIVE_FORMAT))
"""``CONFIG.yaml``."""

_ABSENT = (Role.MOTION, Role.BMODE, Role.OVERLAY)
"""Roles that the example has as comments only."""


def example_config() -> str:
    """A CONFIG.yaml with every key of every driver; keys with a default and alternatives are commented out."""
    return "\n".join(_lines()) + "\n"


def _lines() -> Iterator[str]:
    top = {entry.name: entry for entry in LIVE.fields}
    yield "# Devices of a live session: fgreg live CONFIG.yaml; fgreg devices CONFIG.yaml asks each of them."
    yield "# Paths are relative to this file's folder. Lines that are commented out are defaults or alternatives."
    yield f"format: {LIVE_FORMAT}"
    yield example_line(top["session"]).removesuffix("; may be absent")
    for name, cls in (("calibration", CalibrationOptions), ("room", RoomOptions)):
        yield ""
        yield f"# {name}:  # {top[name].key.help}"
        yield from (f"#   {example_line(entry)}" for entry in record(cls).fields)
    for role in Role:
        yield ""
        yield f"# {top[role].key.help}"
        first, *others = drivers_of(role).values()
        yield from _entry(role, first, commented=role in _ABSENT)
        for other in others:
            yield from _entry(role, other, commented=True)
    yield ""
    yield "settings:"
    for entry in record(LiveSettings).fields:
        yield f"  {'' if entry.key.example else '# '}{example_line(entry)}"


def _entry(role: Role, entry: DriverEntry, commented: bool) -> Iterator[str]:
    """Lines of a driver's keys."""
    extra = f"; pip install 'fgreg[{entry.extra}]'" if entry.extra else ""
    dash, indent = ("- ", "    ") if role in (Role.SINKS, Role.OVERLAY) else ("", "  ")
    lines = [f"{role}:", f"  {dash}driver: {entry.name}  # {entry.help}{extra}"]
    for key in entry.record.fields:
        if key.kind is LIMITS:
            if not commented:
                lines.append(f"{indent}limits:  # {key.key.help}")
                lines += [
                    f"{indent}  {'' if n == 1 else '# '}{example_line(limit)}" for n, limit in enumerate(LIMITS.fields)
                ]
            continue
        given = key.required or (role is Role.CAMERA and key.name == "right" and not commented)
        lines.append(f"{indent}{'' if given else '# '}{example_line(key)}")
    for line in lines:
        yield f"# {line}" if commented else line


def example_line(entry: Field) -> str:
    """A key's line in the example: ``name: value  # help; default``."""
    key, kind = entry.key, entry.kind
    if key.example:
        value = key.example
    else:
        value = entry.default if isinstance(entry.default, str) else one_line_yaml(kind.write(entry.default))
    notes = [key.help]
    if isinstance(kind, Text) and kind.allowed:
        notes.append(", ".join(kind.allowed))
    if isinstance(kind, Number) and kind.expected != Number().expected:
        notes.append(kind.expected)
    if key.default:
        notes.append(key.default)
    elif entry.default is None and key.example:
        notes.append("may be absent")
    return f"{entry.name}: {value}  # {'; '.join(notes)}"
