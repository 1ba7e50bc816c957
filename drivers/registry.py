"""The drivers that a configuration can name, by role: keys, factory, and the extra that their library comes with.

A driver's module is imported when it is opened, not before: nothing here needs a device library.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, cast

from fgreg.drivers.options import Key, Kind
from fgreg.errors import InputError, MissingExtraError
from fgreg.session.schema import Bounds

NAME_BYTES = 20
IGTL_PORT, SINK_PORT, BK_PORT = 18944, 18945, 7915


class Role(StrEnum):
    """What a device is for; also the key of a configuration."""

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
"""Of the package: the module that each brings, and what it is for."""

_DISTRIBUTIONS = {"serial": "pyserial"}


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """What drivers are given besides their options.

    Attributes:
        say: shows one line to the operator.
        corners: columns and rows of the board's inner corners.
        rectified: fgreg.drivers.rectification.Rectification of the endoscope's pictures, where that is wanted.
        room: socket of the simulated room, where there is one.
        paces: of recordings that play together; filled by the drivers.
    """

    say: Callable[[str], None]
    corners: tuple[int, int] | None = None
    rectified: Any = None
    room: Path | None = None
    paces: dict[tuple[Path, float], Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class DriverEntry:
    """One driver of one role.

    Attributes:
        role, name: what a configuration calls it.
        help: one line.
        keys: that it takes.
        factory: ``package.module:function``, called with Surroundings and the keys; of a stage, as
            ``fgreg.motion.watchdog`` calls it.
        extra: of the package, where it needs one.
        room: whether the device is one of the simulated room.
        check: ``package.module:function``, called with the keys: raises InputError, opens no device.
        ask: ``package.module:function``, called with Surroundings and the keys: says what is there, or raises; of
            devices that are not to be opened only to see whether they answer.
    """

    role: Role
    name: str
    help: str
    keys: tuple[Key, ...]
    factory: str
    extra: str | None = None
    room: bool = False
    check: str | None = None
    ask: str | None = None

    def require(self) -> None:
        """Raises MissingExtraError where its library is not installed."""
        if self.extra is not None and not installed(self.extra):
            raise MissingExtraError(distribution(self.extra), self.extra)

    def checked(self, options: Mapping[str, Any]) -> None:
        """Raises InputError, MissingExtraError, ValueError where these options, right each by itself, cannot be."""
        self.require()
        if self.check is not None:
            load(self.check)(**options)

    def open(self, around: Surroundings, options: Mapping[str, Any]) -> Any:
        """The device; not for stages, which the watchdog opens. Raises what its driver raises."""
        self.require()
        return load(self.factory)(around, **options)


def installed(extra: str) -> bool:
    """Whether an extra's library is there; it is not imported."""
    try:
        return importlib.util.find_spec(EXTRAS[extra][0]) is not None
    except (ImportError, ValueError):
        return False


def distribution(extra: str) -> str:
    """What the package index calls an extra's library."""
    module = EXTRAS[extra][0]
    return _DISTRIBUTIONS.get(module, module)


def load(dotted: str) -> Callable[..., Any]:
    """The function that ``package.module:name`` names."""
    module, _, name = dotted.partition(":")
    return cast("Callable[..., Any]", getattr(importlib.import_module(module), name))


def device_name(text: str) -> None:
    """Raises InputError where OpenIGTLink would cut it."""
    from fgreg.drivers.igtl_messages import check_name

    check_name(text)


def host_name(text: str) -> None:
    """Raises InputError for what cannot be a host."""
    from fgreg.drivers.tcp_link import Endpoint

    Endpoint(text, 1)


def four_characters(text: str) -> None:
    """Raises InputError for what is no FOURCC."""
    if len(text) != 4 or not text.isascii():
        raise InputError("fourcc", repr(text), "four characters such as MJPG")


def _address(port: int, listen: bool = False) -> tuple[Key, ...]:
    return (
        Key("host", Kind.TEXT, "the other side's; with listen: where to listen", "127.0.0.1", check=host_name),
        Key("port", Kind.INTEGER, "TCP port", port, Bounds(1, 65535)),
        Key("listen", Kind.TRUTH, "wait for the other side to connect", listen),
    )


def _device(help_text: str, default: str, name: str = "device") -> Key:
    return Key(name, Kind.TEXT, f"{help_text}, at most {NAME_BYTES} characters", default, check=device_name)


_SECONDS = Bounds(0.0, 60.0, above=True, unit="s")
_SILENT = Key(
    "silent_s", Kind.NUMBER, "silent for so long, it counts as lost; null: never", 0.8, _SECONDS, nullable=True
)
_SPEED = Key("speed", Kind.NUMBER, "how many times as fast as it was recorded", 1.0, Bounds(0.0, 100.0, above=True))
_RECORDING = Key("path", Kind.FILE, "rosbag2 folder, .mcap or .db3", example="recording.mcap")
_LAYOUTS = ("mono", "separate", "side-by-side", "top-bottom")
_DEG_S = Bounds(0.0, 100.0, above=True, unit="deg/s")

_ENDOSCOPE = (
    Key("left", Kind.VIDEO, "device number or path, stream, video file, folder of pictures", example="/dev/video0"),
    Key("right", Kind.VIDEO, "the right input, where there are two", None, example="/dev/video1"),
    Key("layout", Kind.CHOICE, "separate with two inputs, else mono", None, choices=_LAYOUTS, example="separate"),
    Key("swap", Kind.TRUTH, "left and right are the other way round in each frame", False),
    Key("fields", Kind.CHOICE, "of interlaced frames", "whole", choices=("whole", "top", "bottom", "both")),
    Key("width", Kind.INTEGER, "asked of a device, px", None, Bounds(16, 8192), example="1280"),
    Key("height", Kind.INTEGER, "asked of a device, px", None, Bounds(16, 8192), example="720"),
    Key("fps", Kind.NUMBER, "asked of a device; a folder's pace", None, Bounds(0.0, 1000.0, above=True), example="30"),
    Key("fourcc", Kind.TEXT, "kind of pixels asked of a device", None, example="MJPG", check=four_characters),
    Key("loop", Kind.TRUTH, "files and folders begin again at their end", False),
    Key("delay_s", Kind.NUMBER, "from the exposure to the device's time stamp", 0.0, Bounds(-1.0, 1.0, unit="s")),
    Key("max_gap_s", Kind.NUMBER, "most time between left and right", 0.017, Bounds(0.0, 1.0, above=True, unit="s")),
    Key("by_arrival", Kind.TRUTH, "match two inputs by their times of arrival", False),
    Key("silence_s", Kind.NUMBER, "silent for so long, it counts as lost", 0.7, _SECONDS),
)
_RECORDED_CAMERA = (
    _RECORDING,
    Key("left", Kind.TEXT, "topic of the left images; found by its name", None, example="/rig/left/image_raw"),
    Key("right", Kind.TEXT, "topic of the right images; found by its name", None, example="/rig/right/image_raw"),
    Key("max_gap_s", Kind.NUMBER, "most time between left and right", 0.017, Bounds(0.0, 1.0, above=True, unit="s")),
    _SPEED,
)
_RECORDED_MOTION = (
    _RECORDING,
    Key("topic", Kind.TEXT, "of the holder's poses; found by its name", None, example="/ECM/measured_cp"),
    Key("tip_T_camera", Kind.TRANSFORM, "where the camera is on what the poses are of, mm", None),
    _SPEED,
)
_THORLABS = (
    Key("port", Kind.TEXT, "serial port; the only cube that is plugged in", None, example="/dev/ttyUSB0"),
    Key("acceleration_deg_s2", Kind.NUMBER, "of every motion", 20.0, Bounds(0.0, 100.0, above=True, unit="deg/s^2")),
)
_STAND_IN = (
    Key("device_deg", Kind.NUMBER, "where it stands at first", 0.0, Bounds(-180.0, 180.0, unit="deg")),
    Key("homed", Kind.TRUTH, "it knows its zero position at first", False),
    Key("max_speed_deg_s", Kind.NUMBER, "of the motor", 25.0, _DEG_S),
    Key("acceleration_deg_s2", Kind.NUMBER, "of the motor", 25.0, Bounds(0.0, 1000.0, above=True, unit="deg/s^2")),
)
_PULSES = (
    _device("of the pulses' images", "Image_Probe"),
    Key("transposed", Kind.TRUTH, "its rows are what session.yaml has as columns", False),
    _SILENT,
)
_HOLDER = (
    _device("of the holder's transforms", "CameraToBase"),
    Key("inverted", Kind.TRUTH, "the matrix maps base to camera", False),
    _SILENT,
)
_NAMES = (
    _device("of the registration", "CameraToTrus", name="registration"),
    _device("of the image plane", "PlaneToTrus", name="plane"),
    _device("of the state", "RegistrationStatus", name="status"),
    _device("of the verdict", "RegistrationVerdict", name="verdict"),
    Key("header_version", Kind.INTEGER, "1 for receivers of OpenIGTLink 1 and 2", 2, Bounds(1, 2)),
)
_SPOKEN = (
    _device("of its words", "Operator"),
    _device("of what it is told", "OperatorTold", name="answers"),
)
_FLIP = Key("flip", Kind.TRUTH, "its columns run against TRUS x", False)
_MM = Bounds(-500.0, 500.0, unit="mm")
_PICTURES = (
    _device("of the images", "Image_Reference"),
    Key("depth_mm", Kind.NUMBER, "of the first row's centre, below the array's face", 0.0, _MM),
    Key(
        "x_mm",
        Kind.NUMBER,
        "TRUS x of the leftmost pixel shown; absent: not shown in the plane",
        None,
        _MM,
        example="-19",
    ),
    _FLIP,
    _SILENT,
)
_SCANNER = (
    Key("host", Kind.TEXT, "name or address of the scanner", example="192.168.1.10", check=host_name),
    Key("port", Kind.INTEGER, "of its OEM interface", BK_PORT, Bounds(1, 65535)),
    Key("rate_hz", Kind.INTEGER, "pictures asked for, a second", 20, Bounds(1, 100)),
    _FLIP,
    _SILENT,
)

_HERE = "fgreg.drivers.factories"


def _simulated(role: Role, help_text: str, factory: str, ask: str | None = None) -> DriverEntry:
    return DriverEntry(role, "simulated", help_text, (), factory, room=True, ask=ask)


ENTRIES: tuple[DriverEntry, ...] = (
    DriverEntry(
        Role.CAMERA,
        "endoscope",
        "one or two video inputs",
        _ENDOSCOPE,
        f"{_HERE}:endoscope",
        check=f"{_HERE}:check_endoscope",
    ),
    DriverEntry(
        Role.CAMERA,
        "recorded",
        "images of a ROS 2 recording",
        _RECORDED_CAMERA,
        f"{_HERE}:recorded_camera",
        "ros",
        check=f"{_HERE}:check_recorded_camera",
    ),
    _simulated(Role.CAMERA, "of the simulated room", f"{_HERE}:simulated_camera"),
    DriverEntry(
        Role.PHOTOACOUSTIC,
        "igtl",
        "images of PLUS or a scanner over OpenIGTLink, one for each laser pulse",
        (*_address(IGTL_PORT), *_PULSES),
        f"{_HERE}:igtl_photoacoustic",
        "igtl",
    ),
    _simulated(Role.PHOTOACOUSTIC, "of the simulated room", f"{_HERE}:simulated_probe"),
    DriverEntry(
        Role.STAGE,
        "thorlabs",
        "PRM1Z8 on a KDC101 or TDC001",
        _THORLABS,
        "fgreg.drivers.thorlabs_stage:open_stage",
        "stage",
        ask=f"{_HERE}:ask_thorlabs",
    ),
    _simulated(Role.STAGE, "of the simulated room", "fgreg.drivers.simulated:open_stage", f"{_HERE}:ask_room_stage"),
    DriverEntry(
        Role.STAGE,
        "stand-in",
        "a simulated stage beside real devices, for rehearsals: nothing turns",
        _STAND_IN,
        "fgreg.drivers.simulated_stage:open_stage",
        ask=f"{_HERE}:ask_stand_in",
    ),
    DriverEntry(
        Role.MOTION,
        "igtl",
        "transforms of the endoscope's holder over OpenIGTLink",
        (*_address(IGTL_PORT), *_HOLDER),
        f"{_HERE}:igtl_motion",
        "igtl",
    ),
    DriverEntry(
        Role.MOTION,
        "recorded",
        "poses of a ROS 2 recording",
        _RECORDED_MOTION,
        f"{_HERE}:recorded_motion",
        "ros",
        check=f"{_HERE}:check_recorded_motion",
    ),
    _simulated(Role.MOTION, "the endoscope's holder in the simulated room", f"{_HERE}:simulated_motion"),
    DriverEntry(
        Role.BMODE,
        "igtl",
        "B-mode images over OpenIGTLink",
        (*_address(IGTL_PORT), *_PICTURES),
        f"{_HERE}:igtl_bmode",
        "igtl",
    ),
    DriverEntry(Role.BMODE, "bk", "a BK scanner over its OEM interface", _SCANNER, f"{_HERE}:bk_bmode"),
    _simulated(Role.BMODE, "of the simulated room", f"{_HERE}:simulated_scanner"),
    DriverEntry(
        Role.SINKS,
        "igtl",
        "3D Slicer, PLUS: takes the registration over OpenIGTLink",
        (*_address(SINK_PORT, listen=True), *_NAMES),
        f"{_HERE}:igtl_sink",
        "igtl",
    ),
    DriverEntry(
        Role.OPERATOR,
        "keyboard",
        "whoever sits at the terminal",
        (),
        f"{_HERE}:keyboard",
        ask=f"{_HERE}:ask_keyboard",
    ),
    DriverEntry(
        Role.OPERATOR,
        "igtl",
        "texts over OpenIGTLink: a foot switch, a button in 3D Slicer",
        (*_address(IGTL_PORT), *_SPOKEN),
        f"{_HERE}:igtl_operator",
        "igtl",
    ),
    _simulated(Role.OPERATOR, "the surgeon of the simulated room", f"{_HERE}:simulated_operator"),
)
"""All of them; the first of a role is the one that examples show."""


def drivers_of(role: Role) -> Mapping[str, DriverEntry]:
    """By name."""
    return {entry.name: entry for entry in ENTRIES if entry.role is role}
