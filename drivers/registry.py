"""The registry of drivers: what a configuration can name, by role, with options, factory, and the extra it needs.

CONFIG.yaml, its example, its JSON Schema, the table of docs/devices.md and ``fgreg devices`` are made from
:data:`ENTRIES`. A driver's module is imported when it is opened, not before: nothing here needs a device library.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, cast

from fgreg.drivers import options
from fgreg.drivers.base import DriverContext
from fgreg.errors import InputError, MissingExtraError, one_line
from fgreg.schema.kinds import JsonSchema, Kind, Text
from fgreg.schema.problems import FieldError, Problem, nearest, shown
from fgreg.schema.record import Record, record


class Role(StrEnum):
    """Role of a device; also its key in a configuration."""

    CAMERA = "camera"
    PHOTOACOUSTIC = "photoacoustic"
    STAGE = "stage"
    MOTION = "motion"
    BMODE = "bmode"
    SINKS = "sinks"
    OPERATOR = "operator"


EXTRAS: Mapping[str, tuple[str, str]] = {
    "igtl": ("pyigtl", "OpenIGTLink"),
    "stage": ("serial", "rotation stages on serial ports"),
    "ros": ("rosbags", "ROS 2 recordings"),
    "plots": ("matplotlib", "plots of fgreg evaluate"),
}
"""Extras of the package: the module of each, and its purpose."""

_DISTRIBUTIONS = {"serial": "pyserial"}


@dataclass(frozen=True, slots=True, eq=False)
class DriverEntry:
    """One driver of one role.

    Attributes:
        role, name: what a configuration calls it.
        help: one line.
        options: class of its keys (fgreg.drivers.options).
        factory: ``module:function`` in fgreg.drivers, called with DriverContext and the options; of a stage, as
            ``fgreg.stage.watchdog`` calls it.
        extra: of the package, where it needs one.
        room: whether the device is one of the simulated room.
        check: ``module:function``, called with the options: raises InputError, ValueError, opens no device.
        ask: ``module:function``, called with DriverContext and the options: describes the device, or raises; for
            devices that must not be opened only for a check.
    """

    role: Role
    name: str
    help: str
    options: type
    factory: str
    extra: str | None = None
    room: bool = False
    check: str | None = None
    ask: str | None = None

    def require(self) -> None:
        """Raise MissingExtraError where its library is not installed."""
        if self.extra is not None and not installed(self.extra):
            raise MissingExtraError(distribution(self.extra), self.extra)

    @property
    def record(self) -> Record:
        """Of a mapping that names it."""
        return record(self.options, ("driver", self.name))

    def checked(self, chosen: Any) -> None:
        """Raises InputError, MissingExtraError, ValueError where options do not fit together."""
        self.require()
        if self.check is not None:
            load(self.check)(chosen)

    def open(self, context: DriverContext, chosen: Any) -> Any:
        """The device; not for stages, which the watchdog opens. Raises what its driver raises."""
        self.require()
        return load(self.factory)(context, chosen)


def installed(extra: str) -> bool:
    """Whether an extra's library is installed; it is not imported."""
    try:
        return importlib.util.find_spec(EXTRAS[extra][0]) is not None
    except (ImportError, ValueError):
        return False


def distribution(extra: str) -> str:
    """Name of an extra's library in the package index."""
    module = EXTRAS[extra][0]
    return _DISTRIBUTIONS.get(module, module)


def load(place: str) -> Callable[..., Any]:
    """The function that ``module:name`` names, a module of fgreg.drivers."""
    module, _, name = place.partition(":")
    return cast("Callable[..., Any]", getattr(importlib.import_module(f"fgreg.drivers.{module}"), name))


ENTRIES: tuple[DriverEntry, ...] = (
    DriverEntry(
        Role.CAMERA,
        "endoscope",
        "one or two video inputs: V4L2 devices, streams, files, picture folders",
        options.EndoscopeOptions,
        "endoscope:open_endoscope",
        check="endoscope:endoscope_config",
    ),
    DriverEntry(
        Role.CAMERA,
        "recorded",
        "images of a ROS 2 recording",
        options.RecordedCameraOptions,
        "recorded_devices:open_camera",
        extra="ros",
        check="recorded_devices:check_camera",
    ),
    DriverEntry(
        Role.CAMERA, "simulated", "of the simulated room", options.NoOptions, "simulated:open_camera", room=True
    ),
    DriverEntry(
        Role.PHOTOACOUSTIC,
        "igtl",
        "images of PLUS or a scanner over OpenIGTLink, one for each laser pulse",
        options.IgtlProbeOptions,
        "igtl:open_photoacoustic",
        extra="igtl",
    ),
    DriverEntry(
        Role.PHOTOACOUSTIC, "simulated", "of the simulated room", options.NoOptions, "simulated:open_probe", room=True
    ),
    DriverEntry(
        Role.STAGE,
        "thorlabs",
        "PRM1Z8 on a KDC101 or TDC001",
        options.ThorlabsOptions,
        "thorlabs_stage:open_stage",
        extra="stage",
        ask="thorlabs_identify:ask_stage",
    ),
    DriverEntry(
        Role.STAGE,
        "simulated",
        "of the simulated room",
        options.RoomStageOptions,
        "simulated:open_stage",
        room=True,
        ask="simulated:ask_stage",
    ),
    DriverEntry(
        Role.STAGE,
        "stand-in",
        "a simulated stage together with real devices, for rehearsals: nothing turns",
        options.StandInOptions,
        "simulated_stage:open_stage",
        ask="simulated_stage:ask_stage",
    ),
    DriverEntry(
        Role.MOTION,
        "igtl",
        "transforms of the endoscope's holder over OpenIGTLink",
        options.IgtlMotionOptions,
        "igtl:open_motion",
        extra="igtl",
    ),
    DriverEntry(
        Role.MOTION,
        "recorded",
        "poses of a ROS 2 recording",
        options.RecordedMotionOptions,
        "recorded_devices:open_motion",
        extra="ros",
        check="recorded_devices:check_motion",
    ),
    DriverEntry(
        Role.MOTION,
        "simulated",
        "the endoscope's holder in the simulated room",
        options.NoOptions,
        "simulated:open_motion",
        room=True,
    ),
    DriverEntry(
        Role.BMODE, "igtl", "B-mode images over OpenIGTLink", options.IgtlBmodeOptions, "igtl:open_bmode", extra="igtl"
    ),
    DriverEntry(Role.BMODE, "bk", "a BK scanner over its OEM interface", options.BkOptions, "bk_oem:open_scanner"),
    DriverEntry(
        Role.BMODE, "simulated", "of the simulated room", options.NoOptions, "simulated:open_scanner", room=True
    ),
    DriverEntry(
        Role.SINKS,
        "igtl",
        "3D Slicer, PLUS: receivers of the registration over OpenIGTLink",
        options.IgtlSinkOptions,
        "igtl:open_sink",
        extra="igtl",
    ),
    DriverEntry(
        Role.OPERATOR,
        "keyboard",
        "the operator at the terminal",
        options.NoOptions,
        "keyboard:open_keyboard",
        ask="keyboard:ask_keyboard",
    ),
    DriverEntry(
        Role.OPERATOR,
        "igtl",
        "texts over OpenIGTLink: a foot switch, a button in 3D Slicer",
        options.IgtlOperatorOptions,
        "operators:open_operator",
        extra="igtl",
    ),
    DriverEntry(
        Role.OPERATOR,
        "simulated",
        "the surgeon of the simulated room",
        options.NoOptions,
        "simulated:open_operator",
        room=True,
    ),
)
"""All drivers; examples show the first of a role."""


def drivers_of(role: Role) -> Mapping[str, DriverEntry]:
    """By name."""
    return {entry.name: entry for entry in ENTRIES if entry.role is role}


@dataclass(frozen=True, slots=True)
class DriverChoice(Kind):
    """A mapping that names one of a role's drivers, with its options: the entry and the options, both checked."""

    role: Role

    def read(self, value: object, folder: Path | None = None, /) -> tuple[DriverEntry, Any]:
        """Raises FieldError, MissingExtraError."""
        entries = drivers_of(self.role)
        if not isinstance(value, Mapping):
            raise FieldError.of(shown(value), self.expected)
        if "driver" not in value:
            for key in value:
                if nearest(key, ["driver"]):
                    raise FieldError.of("an unknown key", "a known one (did you mean driver?)", key)
            raise FieldError.of("nothing", f"one of {', '.join(entries)}", "driver")
        try:
            entry = entries[Text(allowed=tuple(entries)).read(value["driver"])]
        except FieldError as error:
            raise FieldError(error.below("driver")) from None
        entry.require()
        others = {name for other in entries.values() for name in other.record.names} - {*entry.record.names}
        names = ", ".join(name for name in entry.record.names if name not in ("driver", "limits"))
        takes = f"one of {entry.name}'s: {names}" if names else f"{entry.name} alone"
        problems = [Problem((key,), "a key of another driver", takes) for key in value if key in others]
        own = {key: entry for key, entry in value.items() if key not in others} if problems else value
        try:
            chosen = entry.record.read(own, folder)
            if not problems:
                entry.checked(chosen)
        except FieldError as error:
            problems += error.problems
        except ValueError as error:
            found = f"values that do not fit together ({one_line(str(error), 200)})"
            problems.append(Problem((), found, "values that do"))
        except InputError as error:
            problems.append(Problem((), f"{error.found} ({error.where})", error.expected))
        if problems:
            raise FieldError(problems)
        return entry, chosen

    @property
    def expected(self) -> str:
        names = dict.fromkeys(name for entry in drivers_of(self.role).values() for name in entry.record.names)
        return f"a mapping with {', '.join(names)}"

    def json_schema(self, definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return {"oneOf": [entry.record.json_schema(definitions) for entry in drivers_of(self.role).values()]}
