"""ROS 2 messages of a live connection: CDR bytes to messages and back, by ``rosbags``; what fgreg sends, as messages.

fgreg.drivers.ros_messages reads images and poses. Lengths are metres and angles radians here, as REP-103 says.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from fgreg.drivers.ros_messages import MM_PER_M, pose_of
from fgreg.errors import MissingExtraError
from fgreg.geometry.quaternions import quaternion_from_rotation
from fgreg.geometry.transforms import FloatArray, inverse, parent_from_right_covariance

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
INFO, JOINTS = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/JointState"
POSE, TRANSFORM = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped"
POSE_COVARIANCE, TF, TEXT = (
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "tf2_msgs/msg/TFMessage",
    "std_msgs/msg/String",
)
STATE, COMMAND = "crtk_msgs/msg/OperatingState", "crtk_msgs/msg/StringStamped"

_CRTK = {
    STATE: "std_msgs/Header header\nstring state\nbool is_homed\nbool is_busy\n",
    COMMAND: "std_msgs/Header header\nstring string\n",
}
"""Messages of CRTK (collaborative robotics toolkit), which no distribution of ROS has."""


@functools.cache
def types() -> Any:
    """ROS 2's common types and CRTK's. Raises MissingExtraError."""
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise MissingExtraError("rosbags", "ros2") from None
    store = get_typestore(Stores.ROS2_JAZZY)
    for kind, text in _CRTK.items():
        store.register(get_types_from_msg(text, kind))
    return store


def hash_of(kind: str) -> str:
    """RIHS01 hash of a type."""
    return str(types().hash_rihs01(kind))


def prepare(*kinds: str) -> None:
    """Load the types and have their code made, which else delays the first message by some 0.3 s."""
    for kind in kinds:
        types().get_msgdef(kind)


def decode(data: bytes, kind: str) -> Any:
    """The message of CDR bytes. Raises ValueError."""
    try:
        return types().deserialize_cdr(data, kind)
    except Exception as error:  # on wrong bytes the parser may raise anything
        raise ValueError(f"bytes that are no {kind} ({type(error).__name__})") from None


def encode(message: Any) -> bytes:
    """CDR bytes of a message made here."""
    return bytes(types().serialize_cdr(message, message.__msgtype__))


def make(kind: str, **fields: Any) -> Any:
    """A message of a type; all of its fields have to be given."""
    return types().types[kind](**fields)


def header(unix_s: float, frame: str = "") -> Any:
    """A header with a time (s since 1970)."""
    sec, nanosec = divmod(round(unix_s * 1e9), 1_000_000_000)
    stamp = make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def text(words: str) -> bytes:
    """A String."""
    return encode(make(TEXT, data=words))


def state_command(command: str, unix_s: float) -> bytes:
    """CRTK's ``state_command``: ``home``, ``pause``, ``resume``, ..."""
    return encode(make(COMMAND, header=header(unix_s), string=command))


def joint_goal(name: str, position_rad: float, speed_rad_s: float | None, unix_s: float) -> bytes:
    """CRTK's ``move_jp`` of one joint, with the speed as its velocity."""
    velocity = [] if speed_rad_s is None else [speed_rad_s]
    arrays = {"position": [position_rad], "velocity": velocity, "effort": []}
    return encode(
        make(
            JOINTS,
            header=header(unix_s),
            name=[name],
            **{key: np.array(value, dtype=np.float64) for key, value in arrays.items()},
        )
    )


def joint_of(message: Any, name: str | None) -> tuple[float, float | None]:
    """Position (rad) and velocity (rad/s; None: not sent) of a joint; ``name`` None: the only one.

    Raises ValueError."""
    if name is None and len(message.position) != 1:
        raise ValueError(f"{len(message.position)} joints, and none is named")
    if name is not None and name not in message.name:
        raise ValueError(f"no joint {name}")
    at = 0 if name is None else list(message.name).index(name)
    if at >= len(message.position):
        raise ValueError(f"{len(message.position)} positions of {len(message.name)} joints")
    position = float(message.position[at])
    velocity = float(message.velocity[at]) if at < len(message.velocity) else None
    if not math.isfinite(position) or (velocity is not None and not math.isfinite(velocity)):
        raise ValueError("a joint that is not finite")
    return position, velocity


def transform_message(parent_T_child: FloatArray, parent: str, child: str, unix_s: float) -> bytes:
    """``/tf`` with one transform; (4, 4) mm becomes metres."""
    x, y, z = (float(value) for value in parent_T_child[:3, 3] / MM_PER_M)
    transform = make(
        "geometry_msgs/msg/Transform",
        translation=make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
        rotation=_quaternion(parent_T_child),
    )
    stamped = make(TRANSFORM, header=header(unix_s, parent), child_frame_id=child, transform=transform)
    return encode(make(TF, transforms=[stamped]))


def pose_message(parent_T_child: FloatArray, covariance: FloatArray | None, parent: str, unix_s: float) -> bytes:
    """PoseWithCovarianceStamped: metres, covariance of (x, y, z, turns about x, y, z) along the parent's axes.

    Args:
        parent_T_child: (4, 4), mm.
        covariance: (6, 6), right tangent (rad, mm); None becomes zeros, which ROS reads as unknown.
    """
    ros = np.zeros((6, 6))
    if covariance is not None:
        order, scale = [3, 4, 5, 0, 1, 2], np.repeat([1.0 / MM_PER_M, 1.0], 3)
        ros = parent_from_right_covariance(parent_T_child[:3, :3], covariance)[np.ix_(order, order)]
        ros = ros * np.outer(scale, scale)
    x, y, z = (float(value) for value in parent_T_child[:3, 3] / MM_PER_M)
    pose = make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=_quaternion(parent_T_child),
    )
    with_covariance = make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=ros.ravel())
    return encode(make(POSE_COVARIANCE, header=header(unix_s, parent), pose=with_covariance))


def _quaternion(transform: FloatArray) -> Any:
    x, y, z, w = quaternion_from_rotation(transform[:3, :3])
    return make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


class FrameTree:
    """Transforms of ``/tf`` and ``/tf_static``; bounded: of frames beyond :attr:`MOST`, none is kept."""

    MOST = 1000

    def __init__(self, parent: str, child: str) -> None:
        self._ends = parent.strip("/"), child.strip("/")
        self._edges: dict[str, tuple[str, FloatArray]] = {}  # by child: its parent, parent_T_child

    def take(self, transforms: Iterable[Any]) -> list[tuple[Any, FloatArray]]:
        """Add transforms. For each that lies between the two frames: its message, and the pose of the child in the
        parent (4, 4), mm, where the tree is whole. Raises ValueError for one that is invalid."""
        found = []
        for stamped in transforms:
            parent, child = str(stamped.header.frame_id).strip("/"), str(stamped.child_frame_id).strip("/")
            if child in self._edges or len(self._edges) < self.MOST:
                self._edges[child] = parent, pose_of(stamped)[0]
            ways = [self._way_up(end) for end in self._ends]
            if child in {frame for way in ways for frame, _ in way} and ways[0][-1][0] == ways[1][-1][0]:
                base_T_parent, base_T_child = ways[0][-1][1], ways[1][-1][1]
                found.append((stamped, np.asarray(inverse(base_T_parent) @ base_T_child)))
        return found

    def _way_up(self, frame: str) -> list[tuple[str, FloatArray]]:
        """The frames from one to its root, each with the pose of the first in it."""
        way = [(frame, np.eye(4))]
        while way[-1][0] in self._edges and len(way) <= len(self._edges):
            parent, transform = self._edges[way[-1][0]]
            way.append((parent, transform @ way[-1][1]))
        return way
