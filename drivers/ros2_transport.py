"""Bytes to and from ROS 2 topics, by ``rclpy`` where a workspace is sourced, or by Eclipse Zenoh without ROS installed.

Both give and take whole CDR messages with their four bytes of encapsulation. Nothing here decodes a message.

**Zenoh** speaks to nodes of ``rmw_zenoh`` through their router, as a client of it: it listens nowhere and looks for no
one on the network. Its keys are ``domain/topic/type/hash``; every entity declares a liveliness token, by which
``ros2 topic info`` sees it and by which this side counts publishers and subscribers; every message has an attachment
(number, time, origin). A topic that keeps its last message for later subscribers (transient local) is an advanced
publisher with a cache.

**rclpy** is imported when it is used; ``raw`` subscriptions and the publishing of bytes are part of its interface.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import struct
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

from fgreg.drivers.base import DeviceLost, host_now
from fgreg.errors import FgregError, MissingExtraError

if TYPE_CHECKING:
    from fgreg.drivers.options import Ros2Connection

Take = Callable[[bytes, str, float], None]
"""Called with a message's bytes, its type as far as the sender says it, and its time of arrival; in any thread."""
Send = Callable[[bytes | None], None]
"""Sends a message and never waits; None withdraws the one that a latched topic keeps. Raises DeviceLost where the link
does not take it."""
DEPTH = 10
NODE = "fgreg"
RETRY_MS = 200
"""Between attempts to reach the router."""
NO_HASH = "TypeHashNotSupported"
"""In place of a type's hash, in ROS 2 Humble."""


class Transport(Protocol):
    """A connection to ROS 2."""

    def subscribe(self, topic: str, kind: str, take: Take, latched: bool = False, depth: int = DEPTH) -> None:
        """Call ``take`` with each message.

        Args:
            topic, kind: what is subscribed to.
            take: see ``Take``.
            latched: also with the last message before now, if the topic keeps it.
            depth: messages that the link holds until they are taken, at least; the oldest go first.
        """

    def publisher(self, topic: str, kind: str, latched: bool = False, urgent: bool = False) -> Send:
        """A function that sends messages. Later subscribers get the last one of a latched topic."""

    def publishers(self, topic: str) -> int:
        """Number of nodes that publish on a topic."""

    def subscribers(self, topic: str) -> int:
        """Number of nodes that listen to a topic."""

    def close(self) -> None:
        """End the connection."""


def open_transport(options: Ros2Connection, hash_of: Callable[[str], str]) -> Transport:
    """The connection of a device; a router or a node that is not there yet is no error.

    Args:
        options: of CONFIG.yaml.
        hash_of: RIHS01 hash of a message type.

    Raises:
        MissingExtraError: neither is installed, or not the one that is named.
        FgregError: it cannot be opened.
    """
    try:
        if way(options) == "rclpy":
            return RclpyTransport(options.domain)
        return ZenohTransport(options.router, options.domain, hash_of if options.type_hashes else lambda _kind: NO_HASH)
    except FgregError:
        raise
    except Exception as error:
        raise FgregError(f"ROS 2 by {way(options)} cannot be opened: {error}") from error


def way(options: Ros2Connection) -> str:
    """``rclpy`` or ``zenoh``. Raises MissingExtraError."""
    if options.through == "rclpy" or (options.through is None and _found("rclpy")):
        if not _found("rclpy"):
            raise FgregError("rclpy cannot be imported: source the ROS 2 workspace first, in a Python that it is for")
        return "rclpy"
    if not _found("zenoh"):
        raise MissingExtraError("eclipse-zenoh", "ros2")
    return "zenoh"


def check(options: Ros2Connection) -> None:
    """Raises MissingExtraError, FgregError: no way to ROS 2."""
    way(options)


def _found(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):
        return False


class ZenohTransport:
    """A client of an ``rmw_zenoh`` router, e.g. ``tcp/127.0.0.1:7447``."""

    def __init__(self, router: str, domain: int, hash_of: Callable[[str], str]) -> None:
        self._zenoh: Any = importlib.import_module("zenoh")
        self._ext: Any = importlib.import_module("zenoh.ext")
        config = self._zenoh.Config()
        for key, value in (
            ("mode", '"client"'),
            ("connect/endpoints", f'["{router}"]'),
            ("connect/timeout_ms", "0"),
            ("connect/exit_on_failure", "false"),
            ("connect/retry", json.dumps(dict.fromkeys(("period_init_ms", "period_max_ms"), RETRY_MS))),
            ("scouting/multicast/enabled", "false"),
            ("scouting/gossip/enabled", "false"),
            ("scouting/delay", "0"),
            ("timestamping/enabled", "true"),  # as a cache of messages needs it
            ("transport/shared_memory/enabled", "false"),  # a process that is killed would leave its blocks behind
        ):
            config.insert_json5(key, value)
        self._domain, self._hash_of = domain, hash_of
        self._lock = threading.Lock()
        self._tokens: dict[str, set[str]] = {}  # of others, by kind and topic
        self._kept: list[Any] = []  # declared: each lives as long as it is held
        self._count = 0
        self._session: Any = None
        self._opening = threading.Lock()
        self._undeclared: list[Callable[[], None]] = []  # until the session is open
        self._end = threading.Event()
        self._when_open(lambda: self._declare_token(f"0/NN/%/%/{NODE}"))
        self._thread = threading.Thread(target=self._open, args=(config,), name="zenoh", daemon=True)
        self._thread.start()

    def subscribe(self, topic: str, kind: str, take: Take, latched: bool = False, depth: int = DEPTH) -> None:  # noqa: ARG002
        """Of any type: a message of another one is told to the receiver with its type."""

        def arrived(sample: Any) -> None:
            take(sample.payload.to_bytes(), ros_type(str(sample.key_expr).split("/")[-2]), host_now())

        key = f"{self._domain}/{topic.strip('/')}/*/*"
        self._entity("MS", topic, kind, latched)
        self._watch("MP", topic)

        def declare() -> None:
            if latched:
                history = self._ext.HistoryConfig(detect_late_publishers=True, max_samples=100)
                made = self._ext.declare_advanced_subscriber(self._session, key, arrived, history=history)
            else:
                made = self._session.declare_subscriber(key, arrived)
            self._kept.append(made)

        self._when_open(declare)

    def publisher(self, topic: str, kind: str, latched: bool = False, urgent: bool = False) -> Send:
        """Messages that the link does not take at once are dropped, by Zenoh's congestion control."""
        zenoh = self._zenoh
        key = f"{self._domain}/{topic.strip('/')}/{dds_type(kind)}/{self._hash_of(kind)}"
        quality: dict[str, Any] = {"congestion_control": zenoh.CongestionControl.DROP, "express": urgent}
        if urgent:
            quality["priority"] = zenoh.Priority.REAL_TIME
        self._entity("MP", topic, kind, latched)
        self._watch("MS", topic)
        turn = threading.RLock()
        made: list[Any] = []
        last: list[bytes] = []  # of a latched topic, before its publisher is declared
        gid, number, declared = os.urandom(16), 0, True

        def declare() -> None:
            with turn:
                if latched:
                    quality.update(cache=self._ext.CacheConfig(max_samples=1), publisher_detection=True)
                    publisher = self._ext.declare_advanced_publisher(self._session, key, **quality)
                else:
                    publisher = self._session.declare_publisher(key, **quality)
                made.append(publisher)
                self._kept.append(publisher)
                while last:
                    put(last.pop())

        def put(data: bytes) -> None:
            nonlocal number
            made[0].put(data, attachment=struct.pack("<qqB16s", number, time.time_ns(), 16, gid))
            number += 1

        def withdraw() -> None:
            nonlocal declared
            last.clear()
            if made:  # its cache ends with the publisher
                publisher, declared = made.pop(), False
                self._kept.remove(publisher)
                publisher.undeclare()

        def send(data: bytes | None) -> None:
            nonlocal declared
            if self._end.is_set():
                return
            try:
                with turn:
                    if data is None:
                        withdraw() if latched else None
                        return
                    if made:
                        put(data)
                        return
                    if not latched:
                        return
                    last[:] = [data]
                    again, declared = not declared, True
                if again:
                    self._when_open(declare)
            except self._zenoh.ZError as error:
                raise DeviceLost(f"{topic}: the link takes no message: {error}") from error

        self._when_open(declare)
        return send

    def publishers(self, topic: str) -> int:
        """By their liveliness tokens."""
        return self._known("MP", topic)

    def subscribers(self, topic: str) -> int:
        """By their liveliness tokens."""
        return self._known("MS", topic)

    def close(self) -> None:
        """End the session."""
        self._end.set()
        self._thread.join(1.0)
        with self._opening:
            session, self._session = self._session, None
            self._undeclared.clear()
        self._kept.clear()
        if session is not None:
            session.close()

    def _open(self, config: Any) -> None:
        """Until the router is there once; after that, the session looks for it by itself."""
        while not self._end.is_set():
            try:
                session = self._zenoh.open(config)
            except self._zenoh.ZError:
                self._end.wait(RETRY_MS / 1000.0)
                continue
            with self._opening:
                self._session = session
                for declare in self._undeclared:
                    declare()
                self._undeclared.clear()
            if self._end.is_set():  # closed meanwhile, and not waited for
                session.close()
            return

    def _when_open(self, declare: Callable[[], None]) -> None:
        with self._opening:
            if self._session is None:
                self._undeclared.append(declare)
            else:
                declare()

    def _entity(self, entity: str, topic: str, kind: str, latched: bool) -> None:
        """Tell ROS 2's graph of a subscription or a publisher."""
        self._count += 1
        name = topic.strip("/").replace("/", "%")
        of_type = f"{dds_type(kind)}/{self._hash_of(kind)}"
        durability = "1" if latched else ""
        token = f"{self._count}/{entity}/%/%/{NODE}/%{name}/{of_type}/:{durability}:,10:,:,:,,"
        self._when_open(lambda: self._declare_token(token))

    def _declare_token(self, token: str) -> None:
        key = f"@ros2_lv/{self._domain}/{self._session.zid()}/0/{token}"
        self._kept.append(self._session.liveliness().declare_token(key))

    def _watch(self, entity: str, topic: str) -> None:
        """Count the tokens of others."""
        known: set[str] = set()
        self._tokens[entity + topic] = known

        def changed(sample: Any) -> None:
            key, session = str(sample.key_expr), self._session
            if session is None or f"/{session.zid()}/" in key:
                return
            with self._lock:
                if sample.kind == self._zenoh.SampleKind.PUT:
                    known.add(key)
                else:
                    known.discard(key)

        name = "%" + topic.strip("/").replace("/", "%")
        pattern = f"@ros2_lv/{self._domain}/*/*/*/{entity}/*/*/*/{name}/*/*/*"

        def declare() -> None:
            self._kept.append(self._session.liveliness().declare_subscriber(pattern, changed, history=True))

        self._when_open(declare)

    def _known(self, entity: str, topic: str) -> int:
        with self._lock:
            return len(self._tokens.get(entity + topic, ()))


class RclpyTransport:
    """A node of its own context, spun in a thread."""

    def __init__(self, domain: int) -> None:
        self._rclpy: Any = importlib.import_module("rclpy")
        self._qos: Any = importlib.import_module("rclpy.qos")
        executors: Any = importlib.import_module("rclpy.executors")
        self._context: Any = importlib.import_module("rclpy.context").Context()
        self._rclpy.init(context=self._context, domain_id=domain)
        self._node: Any = self._rclpy.create_node(f"{NODE}_{os.getpid()}_{id(self):x}", context=self._context)
        self._executor: Any = executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._ended = False
        self._thread = threading.Thread(target=self._spin, name="rclpy", daemon=True)
        self._thread.start()

    def subscribe(self, topic: str, kind: str, take: Take, latched: bool = False, depth: int = DEPTH) -> None:
        """Best effort, which fits every publisher. Transient local fits only its like: there are both, then."""

        def arrived(data: bytes) -> None:
            take(bytes(data), kind, host_now())

        for kept in (False, True) if latched else (False,):
            profile = self._profile(reliable=kept, latched=kept, depth=depth)
            self._node.create_subscription(_message_class(kind), topic, arrived, profile, raw=True)

    def publisher(self, topic: str, kind: str, latched: bool = False, urgent: bool = False) -> Send:  # noqa: ARG002
        """Reliable, with the last ten messages kept for slow subscribers; of a latched topic the last one."""

        def make() -> Any:
            profile = self._profile(reliable=True, latched=latched, depth=1 if latched else DEPTH)
            return self._node.create_publisher(_message_class(kind), topic, profile)

        made: list[Any] = [make()]

        def send(data: bytes | None) -> None:
            try:
                if data is not None:
                    made[:] = made or [make()]
                    made[0].publish(data)
                elif latched and made:  # what it keeps ends with the publisher
                    self._node.destroy_publisher(made.pop())
            except Exception as error:  # of rclpy
                raise DeviceLost(f"{topic}: the link takes no message: {error}") from error

        return send

    def publishers(self, topic: str) -> int:
        """By ROS 2's graph."""
        return int(self._node.count_publishers(topic))

    def subscribers(self, topic: str) -> int:
        """By ROS 2's graph."""
        return int(self._node.count_subscribers(topic))

    def close(self) -> None:
        """End the node."""
        if self._ended:
            return
        self._ended = True
        self._executor.shutdown(timeout_sec=1.0)
        self._thread.join(1.0)
        self._node.destroy_node()
        self._rclpy.shutdown(context=self._context)

    def _spin(self) -> None:
        while not self._ended:
            try:
                self._executor.spin_once(timeout_sec=0.1)
            except Exception:  # of rclpy while it ends; of one message otherwise
                time.sleep(0.01)

    def _profile(self, reliable: bool, latched: bool, depth: int) -> Any:
        reliability, durability = self._qos.ReliabilityPolicy, self._qos.DurabilityPolicy
        return self._qos.QoSProfile(
            depth=depth,
            reliability=reliability.RELIABLE if reliable else reliability.BEST_EFFORT,
            durability=durability.TRANSIENT_LOCAL if latched else durability.VOLATILE,
        )


def _message_class(kind: str) -> Any:
    """Of ``package/msg/Name``. Raises FgregError where the sourced workspace has no such package."""
    package, _, name = kind.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        raise FgregError(f"{kind} is not in the ROS 2 workspace that is sourced: build or install {package}") from None


def dds_type(kind: str) -> str:
    """``std_msgs/msg/String`` as ``std_msgs::msg::dds_::String_``."""
    package, part, name = kind.split("/")
    return f"{package}::{part}::dds_::{name}_"


def ros_type(dds: str) -> str:
    """Inverse of :func:`dds_type`; a text that is none stays as it is."""
    parts = dds.split("::")
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}" if len(parts) == 4 and parts[3].endswith("_") else dds
