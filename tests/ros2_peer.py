"""A ROS 2 peer that is not of this package: keys, tokens and qualities by ``pyzeros``, messages by ``ros2_pyterfaces``.

It is the router of ``rmw_zenoh`` and a node in one. ``pyzeros.Pub`` itself compiles a serializer at its first message,
which takes 20 s: its messages are sent here with an attachment packed by hand.
"""

import asyncio
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pyzeros.pub
import pyzeros.sub
import zenoh
from ros2_pyterfaces.cyclone.geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from ros2_pyterfaces.cyclone.idl import IdlStruct, types  # type: ignore[attr-defined]
from ros2_pyterfaces.cyclone.sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState
from ros2_pyterfaces.cyclone.std_msgs.msg import Header, String

__all__ = ["CameraInfo", "CompressedImage", "Image", "JointState", "PoseStamped", "PoseWithCovarianceStamped", "String"]


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs/msg/TFMessage"):  # type: ignore[metaclass]
    transforms: types.sequence[TransformStamped] = field(default_factory=list)  # type: ignore[type-arg, assignment]


@dataclass
class OperatingState(IdlStruct, typename="crtk_msgs/msg/OperatingState"):  # type: ignore[metaclass]
    header: Header = field(default_factory=Header)
    state: str = ""
    is_homed: bool = False
    is_busy: bool = False


@dataclass
class StringStamped(IdlStruct, typename="crtk_msgs/msg/StringStamped"):  # type: ignore[metaclass]
    header: Header = field(default_factory=Header)
    string: str = ""


class Peer:
    """Router and node; ``received`` holds the messages of the topics it listens to, decoded."""

    def __init__(self) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.router = f"tcp/127.0.0.1:{self.port}"
        self.received: dict[str, list[Any]] = {}
        self.on_message: Callable[[str, Any], None] = lambda _topic, _message: None
        self._listens: list[tuple[str, Any]] = []
        self.restore()

    def restore(self) -> None:
        """Start, with what it listened to before."""
        config = zenoh.Config()
        config.insert_json5("mode", '"router"')
        config.insert_json5("listen/endpoints", f'["{self.router}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("scouting/delay", "0")
        config.insert_json5("transport/shared_memory/enabled", "false")
        self.session = zenoh.open(config)
        self._loop = asyncio.new_event_loop()  # pyzeros asks for one; nothing runs in it
        asyncio.set_event_loop(self._loop)
        self.node = pyzeros.Node("peer", session=self.session)
        self._publishers: dict[tuple[str, str], Any] = {}
        self._number = 0
        self._subscriptions: list[Any] = []
        for topic, kind in self._listens:
            self._listen(topic, kind)

    def lose(self) -> None:
        """The node ends, and the router with it."""
        session: Any = self.session
        session.close()
        asyncio.set_event_loop(None)
        self._loop.close()

    def leave(self, topic: str) -> None:
        """The node publishes on a topic no more; the router stays."""
        for key in [key for key in self._publishers if key[0] == topic]:
            self._publishers.pop(key).undeclare()

    def listen(self, topic: str, kind: Any) -> None:
        """Listen to a topic."""
        self.received[topic] = []
        self._listens.append((topic, kind))
        self._listen(topic, kind)

    def _listen(self, topic: str, kind: Any) -> None:
        def took(sample: Any) -> None:
            message = kind.deserialize(sample.payload.to_bytes())
            assert len(sample.attachment.to_bytes()) == 33
            self.received[topic].append(message)
            self.on_message(topic, message)

        self._subscriptions.append(pyzeros.sub.RawSub(kind, topic, took, session=self.node))

    def send(self, topic: str, message: Any, data: bytes | None = None) -> None:
        """Publish a message, or other bytes under its type."""
        key = topic, type(message).__name__
        if key not in self._publishers:
            self._publishers[key] = pyzeros.pub.Pub(type(message), topic, session=self.node)
        self._number += 1
        attachment = struct.pack("<qqB16s", self._number, time.time_ns(), 16, bytes(16))
        self._publishers[key].zenoh_pub.put(message.serialize() if data is None else data, attachment=attachment)


def stamped(message: Any, unix_s: float, frame: str = "") -> Any:
    """The message, with a time in its header."""
    message.header.stamp.sec = int(unix_s)
    message.header.stamp.nanosec = round((unix_s - int(unix_s)) * 1e9)
    message.header.frame_id = frame
    return message
