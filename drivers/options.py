"""The configuration keys of each driver, with type, unit, default, bounds and a line of help."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from fgreg.drivers.base import CommandKind
from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray
from fgreg.schema.files import ExistingPath, exists
from fgreg.schema.kinds import Integer, JsonSchema, Kind, ListOf, Number, Text
from fgreg.schema.matrices import Transform
from fgreg.schema.problems import FieldError, shown
from fgreg.schema.record import Key
from fgreg.stage.limits import LIMITS

NAME_BYTES = 20
IGTL_PORT, SINK_PORT, OVERLAY_PORT, BK_PORT = 18944, 18945, 18946, 7915

_VIDEO_DEVICE = re.compile(r"/dev/video[0-9]+")
_STREAM = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]*://.+")
Words = Annotated[
    tuple[str, ...] | None,
    Key(
        "what it may say beside stop; home, search, follow and reset need a key",
        ListOf(Text("a word", allowed=tuple(CommandKind))),
        null=True,
        example="[next, moved]",
    ),
]
KeyFile = Annotated[
    Path | None,
    Key("file with the key that its words are signed with", ExistingPath(), null=True, example="operator.key"),
]


@dataclass(frozen=True, slots=True)
class VideoSource(Kind):
    """A video input; files are relative to the configuration's folder."""

    takes_text = True

    def read(self, value: object, folder: Path | None = None, /) -> str:
        if type(value) is int and 0 <= value <= 999:
            return str(value)
        if not isinstance(value, str) or not value:
            raise FieldError.of(shown(value), self.expected)
        number = value.isdecimal() and len(value) <= 3  # YAML's reader gives a huge integer as text
        if number or _VIDEO_DEVICE.fullmatch(value) or _STREAM.fullmatch(value):
            return value
        path = (folder or Path()) / value
        if not (exists(path) or ("*" in path.name and _matches(path))):
            raise FieldError.of(shown(value), f"{self.expected}; paths are relative to this file's folder")
        return str(path)

    @property
    def expected(self) -> str:
        return "a video device (0, /dev/video0), a stream (rtsp://...), a video file, or a folder of pictures"

    def json_schema(self, _definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return {"anyOf": [{"type": "integer", "minimum": 0, "maximum": 999}, {"type": "string", "minLength": 1}]}


def _matches(path: Path) -> bool:
    try:
        return any(path.parent.glob(path.name))
    except (OSError, ValueError, NotImplementedError):
        return False


def _check_device(text: str) -> None:
    """Raises InputError for a name that OpenIGTLink would cut."""
    from fgreg.drivers.igtl_messages import check_name

    check_name(text)


def _check_host(text: str) -> None:
    """Raises InputError for an invalid host."""
    from fgreg.drivers.tcp_link import Endpoint

    Endpoint(text, 1)


def _check_fourcc(text: str) -> None:
    """Raises InputError for an invalid FOURCC."""
    if len(text) != 4 or not text.isascii():
        raise InputError("fourcc", repr(text), "four characters such as MJPG")


def _check_title(text: str) -> None:
    """Raises InputError for a title that a window cannot have."""
    if not (text.isprintable() and 1 <= len(text) <= 60):
        raise InputError("title", repr(text), "1 to 60 printable characters")


_PORT = Integer(1, 65535)
_HOST = Text("a host name or an IP address", check=_check_host)
_DEVICE = Text(f"a name of at most {NAME_BYTES} characters", check=_check_device)


def _named(help_text: str) -> Key:
    return Key(f"{help_text}, at most {NAME_BYTES} characters", _DEVICE)


_RATE = Number(0.0, 1000.0, above=True)
_SECONDS = Number(0.0, 60.0, above=True, unit="s")
_GAP = Number(0.0, 1.0, above=True, unit="s")
_MM = Number(-500.0, 500.0, unit="mm")
_RECORDING = ExistingPath()


def _check_topic(text: str) -> None:
    """Raises InputError for an invalid topic."""
    if not re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", text):
        raise InputError("topic", repr(text), "a ROS 2 topic such as /rig/left/image_raw")


def _check_frame(text: str) -> None:
    """Raises InputError for an invalid frame."""
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_/-]*", text):
        raise InputError("frame", repr(text), "a frame's name such as camera, without a leading /")


def _check_router(text: str) -> None:
    """Raises InputError for an invalid address."""
    if not re.fullmatch(r"(tcp|tls|quic|udp)/[A-Za-z0-9_.:\[\]-]+:[0-9]{1,5}", text):
        raise InputError("router", repr(text), "an address such as tcp/127.0.0.1:7447")


_TOPIC = Text("a ROS 2 topic such as /rig/left/image_raw", check=_check_topic)
_FRAME = Text("a frame's name", check=_check_frame)
_ROUTER = Text("an address such as tcp/127.0.0.1:7447", check=_check_router)
_WAY = Text(allowed=("rclpy", "zenoh"))
_POSES = ("PoseStamped", "TransformStamped", "PoseWithCovarianceStamped")

Silent = Annotated[float | None, Key("longest silence until it counts as lost; null: no limit", _SECONDS, null=True)]
Flip = Annotated[bool, Key("its columns run against TRUS x")]
Limits = Annotated[Mapping[str, Any] | None, Key("in addition to those of session.yaml", LIMITS)]


@dataclass(frozen=True, slots=True)
class NoOptions:
    """A driver without keys."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EndoscopeOptions:
    """One or two video inputs."""

    left: Annotated[
        str, Key("device number or path, stream, video file, folder of pictures", VideoSource(), example="/dev/video0")
    ]
    right: Annotated[
        str | None, Key("the right input, where there are two", VideoSource(), null=True, example="/dev/video1")
    ] = None
    layout: Annotated[
        str | None,
        Key(
            "separate with two inputs, else mono",
            Text(allowed=("mono", "separate", "side-by-side", "top-bottom")),
            null=True,
            example="separate",
        ),
    ] = None
    swap: Annotated[bool, Key("left and right are exchanged in each frame")] = False
    fields: Annotated[str, Key("of interlaced frames", Text(allowed=("whole", "top", "bottom", "both")))] = "whole"
    width: Annotated[int | None, Key("requested width, px", Integer(16, 8192), null=True, example="1280")] = None
    height: Annotated[int | None, Key("requested height, px", Integer(16, 8192), null=True, example="720")] = None
    fps: Annotated[float | None, Key("requested rate; rate of a folder", _RATE, null=True, example="30")] = None
    fourcc: Annotated[
        str | None,
        Key("requested pixel format", Text("four characters", check=_check_fourcc), null=True, example="MJPG"),
    ] = None
    loop: Annotated[bool, Key("files and folders are repeated at their end")] = False
    delay_s: Annotated[float, Key("from the exposure to the device's time stamp", Number(-1.0, 1.0, unit="s"))] = 0.0
    max_gap_s: Annotated[float, Key("longest time between left and right", _GAP)] = 0.017
    by_arrival: Annotated[bool, Key("match two inputs by their times of arrival")] = False
    silence_s: Annotated[float, Key("longest silence until it counts as lost", _SECONDS)] = 0.7


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingOptions:
    """A ROS 2 recording that is played."""

    path: Annotated[Path, Key("rosbag2 folder, .mcap or .db3", _RECORDING, example="recording.mcap")]
    speed: Annotated[float, Key("factor on the recorded speed", Number(0.0, 100.0, above=True))] = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedCameraOptions(RecordingOptions):
    """Its images."""

    left: Annotated[
        str | None, Key("topic of the left images; found by its name", null=True, example="/rig/left/image_raw")
    ] = None
    right: Annotated[
        str | None, Key("topic of the right images; found by its name", null=True, example="/rig/right/image_raw")
    ] = None
    max_gap_s: Annotated[float, Key("longest time between left and right", _GAP)] = 0.017


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedMotionOptions(RecordingOptions):
    """Poses of the endoscope's holder."""

    topic: Annotated[
        str | None, Key("of the holder's poses; found by its name", null=True, example="/ECM/measured_cp")
    ] = None
    tip_T_camera: Annotated[
        FloatArray | None, Key("the camera in the frame that the poses are of, mm", Transform(), null=True)
    ] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ThorlabsOptions:
    """PRM1Z8 on a KDC101 or TDC001."""

    port: Annotated[
        str | None, Key("serial port; default: the only connected cube", null=True, example="/dev/ttyUSB0")
    ] = None
    acceleration_deg_s2: Annotated[float, Key("of every motion", Number(0.0, 100.0, above=True, unit="deg/s^2"))] = 20.0
    limits: Limits = None


@dataclass(frozen=True, slots=True, kw_only=True)
class StandInOptions:
    """A simulated stage together with real devices."""

    device_deg: Annotated[float, Key("angle at the start", Number(-180.0, 180.0, unit="deg"))] = 0.0
    homed: Annotated[bool, Key("it is homed at the start")] = False
    max_speed_deg_s: Annotated[float, Key("of the motor", Number(0.0, 100.0, above=True, unit="deg/s"))] = 25.0
    acceleration_deg_s2: Annotated[float, Key("of the motor", Number(0.0, 1000.0, above=True, unit="deg/s^2"))] = 25.0
    limits: Limits = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RoomStageOptions:
    """The stage of the simulated room."""

    limits: Limits = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Connection:
    """A peer that speaks OpenIGTLink."""

    host: Annotated[str, Key("of the peer; with listen: address to listen at", _HOST)] = "127.0.0.1"
    port: Annotated[int, Key("TCP port", _PORT)] = IGTL_PORT
    listen: Annotated[bool, Key("wait for the peer to connect")] = False


@dataclass(frozen=True, slots=True, kw_only=True)
class IgtlProbeOptions(Connection):
    """Images, one for each laser pulse."""

    device: Annotated[str, _named("of the pulses' images")] = "Image_Probe"
    transposed: Annotated[bool, Key("its rows are the columns of session.yaml")] = False
    silent_s: Silent = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class IgtlMotionOptions(Connection):
    """Transforms of the endoscope's holder."""

    device: Annotated[str, _named("of the holder's transforms")] = "CameraToBase"
    inverted: Annotated[bool, Key("the matrix maps base to camera")] = False
    start: Annotated[
        str | None,
        Key(
            "stream to ask for, of trackers that send only then",
            Text(allowed=("TDATA", "QTDATA")),
            null=True,
            example="TDATA",
        ),
    ] = None
    silent_s: Silent = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class IgtlBmodeOptions(Connection):
    """B-mode images."""

    device: Annotated[str, _named("of the images")] = "Image_Reference"
    depth_mm: Annotated[float, Key("of the first row's centre, below the array's face", _MM)] = 0.0
    x_mm: Annotated[
        float | None,
        Key("TRUS x of the leftmost pixel shown; absent: not shown in the plane", _MM, null=True, example="-19"),
    ] = None
    flip: Flip = False
    silent_s: Silent = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class BkOptions:
    """A BK scanner's OEM interface."""

    host: Annotated[
        str,
        Key(
            "name or address of the scanner",
            Text("name or address of the scanner", check=_check_host),
            example="192.168.1.10",
        ),
    ]
    port: Annotated[int, Key("of its OEM interface", _PORT)] = BK_PORT
    rate_hz: Annotated[int, Key("pictures requested per second", Integer(1, 100))] = 20
    flip: Flip = False
    silent_s: Silent = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class IgtlSinkOptions(Connection):
    """Receiver of the registration."""

    port: Annotated[int, Key("TCP port", _PORT)] = SINK_PORT
    listen: Annotated[bool, Key("wait for the peer to connect")] = True
    registration: Annotated[str, _named("of the registration")] = "CameraToTrus"
    plane: Annotated[str, _named("of the image plane")] = "PlaneToTrus"
    status: Annotated[str, _named("of the state")] = "RegistrationStatus"
    verdict: Annotated[str, _named("of the verdict")] = "RegistrationVerdict"
    header_version: Annotated[int, Key("1 for receivers of OpenIGTLink 1 and 2", Integer(1, 2))] = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class IgtlOverlayOptions(Connection):
    """Receiver of the endoscope's picture with the registration drawn on it."""

    port: Annotated[int, Key("TCP port", _PORT)] = OVERLAY_PORT
    listen: Annotated[bool, Key("wait for the peer to connect")] = True
    device: Annotated[str, _named("of the pictures")] = "Overlay"
    header_version: Annotated[int, Key("1 for receivers of OpenIGTLink 1 and 2", Integer(1, 2))] = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowOptions:
    """A window of this machine."""

    title: Annotated[str, Key("of the window", Text("1 to 60 characters", check=_check_title))] = "fgreg"
    full_screen: Annotated[bool, Key("without frame, as large as the screen")] = False


@dataclass(frozen=True, slots=True, kw_only=True)
class IgtlOperatorOptions(Connection):
    """Texts of a foot switch, or of a button in 3D Slicer."""

    device: Annotated[str, _named("of its commands")] = "Operator"
    answers: Annotated[str, _named("of messages to it")] = "OperatorTold"
    words: Words = None
    key: KeyFile = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Ros2Connection:
    """A connection to ROS 2."""

    through: Annotated[
        str | None,
        Key("the way to ROS 2; null: rclpy where a workspace is sourced, else zenoh", _WAY, null=True, example="zenoh"),
    ] = None
    router: Annotated[str, Key("of rmw_zenoh; by zenoh only", _ROUTER)] = "tcp/127.0.0.1:7447"
    domain: Annotated[int, Key("ROS_DOMAIN_ID of the peers", Integer(0, 232))] = 0
    type_hashes: Annotated[bool, Key("false for peers of ROS 2 Humble; by zenoh only")] = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Ros2CameraOptions(Ros2Connection):
    """Image topics."""

    left: Annotated[
        str,
        Key("Image topic; CompressedImage where it ends in /compressed", _TOPIC, example="/rig/left/image_raw"),
    ]
    right: Annotated[
        str | None,
        Key("the same of the right camera", _TOPIC, null=True, example="/rig/right/image_raw"),
    ] = None
    info: Annotated[
        str | None, Key("CameraInfo topic of the left camera", _TOPIC, null=True, example="/rig/left/camera_info")
    ] = None
    delay_s: Annotated[float, Key("from the exposure to the message's stamp", Number(-1.0, 1.0, unit="s"))] = 0.0
    max_gap_s: Annotated[float, Key("longest time between left and right", _GAP)] = 0.017
    silence_s: Annotated[float, Key("longest silence until it counts as lost", _SECONDS)] = 0.7


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ros2MotionOptions(Ros2Connection):
    """Poses of the endoscope's holder."""

    topic: Annotated[str, Key("of the holder's poses, or /tf", _TOPIC)] = "/ECM/measured_cp"
    type: Annotated[str, Key("of its messages, where it is not /tf", Text(allowed=_POSES))] = "PoseStamped"
    base: Annotated[str | None, Key("frame of the holder's base; of /tf", null=True, example="ECM_base")] = None
    tip: Annotated[str | None, Key("frame that moves with the camera; of /tf", null=True, example="ECM")] = None
    tip_T_camera: Annotated[
        FloatArray | None, Key("the camera in the frame that the poses are of, mm", Transform(), null=True)
    ] = None
    silent_s: Silent = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class Ros2StageOptions(Ros2Connection):
    """A rotation stage that speaks CRTK."""

    namespace: Annotated[str, Key("of measured_js, move_jp, operating_state, state_command", _TOPIC)] = "/stage"
    joint: Annotated[str | None, Key("the joint's name, where there are several", null=True, example="rotation")] = None
    acceleration_deg_s2: Annotated[
        float, Key("least deceleration of the device when stopped", Number(0.0, 1000.0, above=True, unit="deg/s^2"))
    ] = 20.0
    limits: Limits = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Ros2OperatorOptions(Ros2Connection):
    """Texts of a foot pedal's or a console's node."""

    topic: Annotated[str, Key("String topic of its commands", _TOPIC)] = "/fgreg/operator"
    answers: Annotated[str, Key("String topic of messages to it", _TOPIC)] = "/fgreg/operator_told"
    words: Words = None
    key: KeyFile = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Ros2SinkOptions(Ros2Connection):
    """Receivers of the registration."""

    parent: Annotated[str, Key("frame of the ultrasound probe", _FRAME)] = "trus"
    child: Annotated[str, Key("frame of the left camera", _FRAME)] = "camera"
    static: Annotated[bool, Key("on /tf_static, which later receivers get too, instead of /tf")] = False
    registration: Annotated[str, Key("topic of pose and covariance", _TOPIC)] = "/fgreg/registration"
    verdict: Annotated[str, Key("String topic of the verdict", _TOPIC)] = "/fgreg/verdict"


@dataclass(frozen=True, slots=True, kw_only=True)
class Ros2OverlayOptions(Ros2Connection):
    """Receivers of the endoscope's picture with the registration drawn on it."""

    topic: Annotated[str, Key("image topic; JPEG where it ends in /compressed", _TOPIC)] = "/fgreg/overlay/compressed"
    frame: Annotated[str, Key("frame of the left camera", _FRAME)] = "camera"
    quality: Annotated[int, Key("of the JPEG", Integer(1, 100))] = 85
