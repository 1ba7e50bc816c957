"""The registry of drivers: what a configuration can name, by role, with options, factory, and the extra it needs.

CONFIG.yaml, its example, its JSON Schema, the table of docs/devices.md and ``fgreg devices`` are made from
:data:`ENTRIES`. A driver's module is imported when it is opened, not before: nothing here needs a device library.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any, cast

from fgreg.drivers import options
from fgreg.drivers.base import DriverContext
from fgreg.errors import MissingExtraError
from fgreg.model.session_model import StageModel
from fgreg.schema.record import Record, record


class Role(StrEnum):
    """Role of a device; also its key in a configuration."""

    CAMERA = "camera"
    PHOTOACOUSTIC = "photoacoustic"
    STAGE = "stage"
    MOTION = "motion"
    BMODE = "bmode"
    SINKS = "sinks"
    OVERLAY = "overlay"
    OPERATOR = "operator"


SEVERAL = (Role.SINKS, Role.OVERLAY, Role.OPERATOR)
"""Roles that may have several devices; these send nothing by themselves."""

EXTRAS: Mapping[str, tuple[str, str]] = {
    "igtl": ("pyigtl", "OpenIGTLink"),
    "stage": ("serial", "rotation stages on serial ports"),
    "ros": ("rosbags", "ROS 2 recordings"),
    "ros2": ("rosbags", "ROS 2, live"),
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

    def for_watchdog(self, context: DriverContext, chosen: Any) -> tuple[str, dict[str, Any]]:
        """Of a stage: the factory that the watchdog loads, and the factory's options as JSON holds them."""
        if self.room and context.room:
            return f"fgreg.drivers.{self.factory}", {"path": os.fspath(context.room)}
        own = {key: value for key, value in asdict(chosen).items() if key != "limits"}
        return f"fgreg.drivers.{self.factory}", own

    def described(self, context: DriverContext, chosen: Any, _stage: StageModel) -> str | None:
        """What a device says of itself that must not be opened only for a check; None for all others. Raises what
        its driver raises."""
        return None if self.ask is None else str(load(self.ask)(context, chosen))


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
        Role.CAMERA,
        "ros2",
        "images of ROS 2 topics",
        options.Ros2CameraOptions,
        "ros2:open_camera",
        extra="ros2",
        check="ros2_transport:check",
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
        "ros2",
        "a stage that speaks CRTK over ROS 2",
        options.Ros2StageOptions,
        "ros2_stage:open_stage",
        extra="ros2",
        check="ros2_transport:check",
        ask="ros2_stage:ask_stage",
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
        "ros2",
        "poses of the endoscope's holder over ROS 2: CRTK, /tf",
        options.Ros2MotionOptions,
        "ros2:open_motion",
        extra="ros2",
        check="ros2:check_motion",
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
        Role.SINKS,
        "ros2",
        "receivers of the registration over ROS 2",
        options.Ros2SinkOptions,
        "ros2:open_sink",
        extra="ros2",
        check="ros2_transport:check",
    ),
    DriverEntry(
        Role.OVERLAY,
        "igtl",
        "receivers of the endoscope's picture with the registration drawn on it",
        options.IgtlOverlayOptions,
        "igtl_overlay:open_overlay",
        extra="igtl",
    ),
    DriverEntry(
        Role.OVERLAY,
        "ros2",
        "the same over ROS 2",
        options.Ros2OverlayOptions,
        "ros2_overlay:open_overlay",
        extra="ros2",
        check="ros2_transport:check",
    ),
    DriverEntry(
        Role.OVERLAY,
        "window",
        "a window with that picture; needs an OpenCV with windows",
        options.WindowOptions,
        "overlay_window:open_window",
        check="overlay_window:check_window",
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
        check="peer_words:check_operator",
    ),
    DriverEntry(
        Role.OPERATOR,
        "ros2",
        "texts over ROS 2: a foot pedal, a console",
        options.Ros2OperatorOptions,
        "ros2:open_operator",
        extra="ros2",
        check="ros2:check_operator",
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
