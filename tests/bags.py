"""ROS 2 recordings for tests: by the writer of ``rosbags``, and by the ``mcap`` library, packed by hand."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="rosbags is not installed (pip install 'fgreg[ros]')")

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

STORE: Any = get_typestore(Stores.ROS2_HUMBLE)
TYPES: Any = STORE.types
START_NS = 1_700_000_000_000_000_000
Message = tuple[str, float, Any]
"""Topic, seconds after the start, message."""


def header(t_s: float, frame: str = "map") -> Any:
    ns = START_NS + round(t_s * 1e9)
    stamp = TYPES["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
    return TYPES["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def pose_stamped(t_s: float, xyz_m: Sequence[float], xyzw: Sequence[float] = (0.0, 0.0, 0.0, 1.0)) -> Any:
    return TYPES["geometry_msgs/msg/PoseStamped"](header=header(t_s), pose=_pose(xyz_m, xyzw))


def pose_with_covariance(t_s: float, xyz_m: Sequence[float], xyzw: Sequence[float], covariance: Any) -> Any:
    inner = TYPES["geometry_msgs/msg/PoseWithCovariance"](
        pose=_pose(xyz_m, xyzw), covariance=np.asarray(covariance, dtype=np.float64).ravel()
    )
    return TYPES["geometry_msgs/msg/PoseWithCovarianceStamped"](header=header(t_s), pose=inner)


def _pose(xyz_m: Sequence[float], xyzw: Sequence[float]) -> Any:
    return TYPES["geometry_msgs/msg/Pose"](
        position=TYPES["geometry_msgs/msg/Point"](*map(float, xyz_m)),
        orientation=TYPES["geometry_msgs/msg/Quaternion"](*map(float, xyzw)),
    )


def transform_stamped(t_s: float, xyz_m: Sequence[float], xyzw: Sequence[float] = (0.0, 0.0, 0.0, 1.0)) -> Any:
    transform = TYPES["geometry_msgs/msg/Transform"](
        translation=TYPES["geometry_msgs/msg/Vector3"](*map(float, xyz_m)),
        rotation=TYPES["geometry_msgs/msg/Quaternion"](*map(float, xyzw)),
    )
    return TYPES["geometry_msgs/msg/TransformStamped"](header=header(t_s), child_frame_id="ecm", transform=transform)


def point_stamped(t_s: float, xyz_m: Sequence[float]) -> Any:
    point = TYPES["geometry_msgs/msg/Point"](*map(float, xyz_m))
    return TYPES["geometry_msgs/msg/PointStamped"](header=header(t_s), point=point)


def joint_state(t_s: float, names: Sequence[str], positions: Sequence[float]) -> Any:
    empty = np.zeros(0)
    return TYPES["sensor_msgs/msg/JointState"](
        header=header(t_s), name=list(names), position=np.array(positions, float), velocity=empty, effort=empty
    )


def number(value: float) -> Any:
    return TYPES["std_msgs/msg/Float64"](data=float(value))


def text(value: str) -> Any:
    return TYPES["std_msgs/msg/String"](data=value)


def image(t_s: float, encoding: str, array: Any, *, padding: int = 0, big: bool = False) -> Any:
    """An Image message; each row followed by ``padding`` bytes of rubbish."""
    array = np.asarray(array)
    if array.dtype.itemsize > 1:
        array = array.astype(array.dtype.newbyteorder(">" if big else "<"))
    rows = np.frombuffer(array.tobytes(), np.uint8).reshape(array.shape[0], -1)
    rows = np.concatenate([rows, np.full((len(rows), padding), 0xEE, np.uint8)], axis=1)
    return TYPES["sensor_msgs/msg/Image"](
        header=header(t_s),
        height=array.shape[0],
        width=array.shape[1],
        encoding=encoding,
        is_bigendian=int(big),
        step=rows.shape[1],
        data=rows.ravel(),
    )


def compressed(t_s: float, data: bytes, form: str = "png") -> Any:
    return TYPES["sensor_msgs/msg/CompressedImage"](
        header=header(t_s), format=form, data=np.frombuffer(data, dtype=np.uint8)
    )


def multi_array(values: Any, kind: str = "Float32MultiArray") -> Any:
    values = np.asarray(values)
    dims = [TYPES["std_msgs/msg/MultiArrayDimension"](label="", size=n, stride=0) for n in values.shape]
    layout = TYPES["std_msgs/msg/MultiArrayLayout"](dim=dims, data_offset=0)
    return TYPES[f"std_msgs/msg/{kind}"](layout=layout, data=values.ravel())


def camera_info(t_s: float, k: Any, d: Any, r: Any, p: Any, size: tuple[int, int] = (64, 48)) -> Any:
    roi = TYPES["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    k, d, r, p = (np.asarray(value, dtype=np.float64).ravel() for value in (k, d, r, p))
    return TYPES["sensor_msgs/msg/CameraInfo"](
        header=header(t_s),
        height=size[1],
        width=size[0],
        distortion_model="plumb_bob",
        d=d,
        k=k,
        r=r,
        p=p,
        binning_x=0,
        binning_y=0,
        roi=roi,
    )


def write_bag(path: Path, messages: Sequence[Message], *, mcap: bool = False) -> Path:
    """A rosbag2 folder; messages are recorded 5 ms after their time."""
    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    with Writer(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for topic, t_s, message in sorted(messages, key=lambda m: m[1]):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            when = START_NS + round((t_s + 0.005) * 1e9)
            writer.write(connections[topic], when, STORE.serialize_cdr(message, kind))
    return path


POSE_STAMPED = """\
std_msgs/Header header
geometry_msgs/Pose pose
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""


def packed_pose(t_s: float, numbers: Sequence[float]) -> bytes:
    """A PoseStamped as CDR, little endian, by the standard's rules: header word, then fields aligned from there."""
    ns = START_NS + round(t_s * 1e9)
    frame = b"ECM_base\0"
    body = struct.pack("<iII", ns // 10**9, ns % 10**9, len(frame)) + frame
    body += b"\0" * (-len(body) % 8)
    return b"\0\1\0\0" + body + struct.pack("<7d", *numbers)


def write_mcap(
    path: Path, topic: str, poses: Sequence[tuple[float, Sequence[float]]], definition: str = POSE_STAMPED
) -> Path:
    """An MCAP file of PoseStamped by the mcap library: (seconds, x y z qx qy qz qw)."""
    writer_module = pytest.importorskip("mcap.writer", reason="mcap is not installed")
    with path.open("wb") as file:
        writer = writer_module.Writer(file)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema("geometry_msgs/msg/PoseStamped", "ros2msg", definition.encode())
        channel = writer.register_channel(topic, "cdr", schema)
        for i, (t_s, numbers) in enumerate(poses):
            ns = START_NS + round((t_s + 0.005) * 1e9)
            writer.add_message(channel, log_time=ns, data=packed_pose(t_s, numbers), publish_time=ns, sequence=i)
        writer.finish()
    return path


def tf(transforms: Sequence[tuple[float, str, str, Sequence[float], Sequence[float]]]) -> Any:
    """A TFMessage: (seconds, parent, child, x y z in m, quaternion xyzw)."""
    made = []
    for t_s, parent, child, xyz_m, xyzw in transforms:
        one = transform_stamped(t_s, xyz_m, xyzw)
        one.header.frame_id, one.child_frame_id = parent, child
        made.append(one)
    return TYPES["tf2_msgs/msg/TFMessage"](transforms=made)


def write_ros1_bag(path: Path, messages: Sequence[Message], compression: str = "") -> Path:
    """A ROS 1 bag (``.bag``) by the writer of rosbags, with the same messages as :func:`write_bag`."""
    from rosbags.rosbag1 import Writer as Writer1

    old: Any = get_typestore(Stores.ROS1_NOETIC)
    old.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    writer: Any = Writer1(path)
    if compression:
        writer.set_compression(Writer1.CompressionFormat[compression])
    with writer:
        connections: dict[str, Any] = {}
        for topic, t_s, message in sorted(messages, key=lambda m: m[1]):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=old)
            when = START_NS + round((t_s + 0.005) * 1e9)
            data = old.serialize_ros1(_of_ros1(old, message), kind)
            writer.write(connections[topic], when, data)
    return path


def _of_ros1(store: Any, value: Any) -> Any:
    """A message with the fields of ROS 1: headers count, and camera_info has capital letters."""
    if isinstance(value, list):
        return [_of_ros1(store, entry) for entry in value]
    kind = getattr(value, "__msgtype__", None)
    if kind is None:
        return value
    fields = {key: _of_ros1(store, getattr(value, key)) for key in value.__dataclass_fields__ if key != "__msgtype__"}
    if kind == "std_msgs/msg/Header":
        fields["seq"] = 7
    if kind == "sensor_msgs/msg/CameraInfo":
        fields = {key.upper() if key in "dkrp" else key: entry for key, entry in fields.items()}
    return store.types[kind](**fields)
