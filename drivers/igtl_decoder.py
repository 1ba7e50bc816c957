"""Turns one connection's bytes into OpenIGTLink messages, and answers what the peer asks for.

Queries (``GET_TYPE``), and requests to start and stop a stream (``STT_TYPE``, ``STP_TYPE``), are always answered: a
query with the message or a STATUS that says why not, a request with ``RTS_TYPE``. A type holds 12 bytes, so long ones
are cut in queries: the protocol's library asks with GET_TRANS, others with GET_TRANSFOR.
"""

from __future__ import annotations

import struct
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from fgreg.drivers.igtl_contents import Content, Image, ImageParts, Status, Tracked
from fgreg.drivers.igtl_messages import (
    HEADER,
    STATUS_NOT_FOUND,
    STATUS_NOT_READY,
    STATUS_UNKNOWN,
    Header,
    Message,
    check_body,
    pack_raw,
    pack_status,
    parse_body,
    parse_header,
)
from fgreg.drivers.stream_decoder import Decoder, Rejections
from fgreg.drivers.tcp_link import KEPT_S

POSE_TYPES = ("TRANSFORM", "POSITION", "TDATA", "QTDATA")
"""Types with poses: who wants a device's TRANSFORM takes its pose from any of them."""
QUERIES = ("GET_", "STT_", "STP_")
CAPABILITY, ASK_CAPABILITY = "CAPABILITY", "GET_CAPABIL"
TYPE_BYTES = 12
MOST_INSTEAD, MOST_IMAGES = 4, 4
"""Largest number of other devices that are named, and of images of which parts are kept."""
START = struct.Struct(">i32s")
START_MS = 20
"""Interval that a tracker is asked for."""


def pack_start(kind: str) -> bytes:
    """A request to stream TDATA or QTDATA."""
    return pack_raw(f"STT_{kind}", "", START.pack(START_MS, b""), time.time(), version=1)


@dataclass(slots=True)
class Offers:
    """What a peer may ask for.

    Attributes:
        devices: by type. why: there is none of those that are not ready.
    """

    devices: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    why: str = "there is none yet"
    _ready: tuple[float, Mapping[tuple[str, str], bytes]] = field(default=(0.0, {}))

    def offer(self, messages: Mapping[tuple[str, str], bytes]) -> None:
        """The newest message of each type and device; for KEPT_S, and in place of all before."""
        self._ready = time.monotonic(), messages

    def answer(self, header: Header) -> bytes:
        """The answer to a query or request."""
        now, version = time.time(), header.version
        operation, _, kind = header.kind.partition("_")
        if header.kind == ASK_CAPABILITY:
            asked = (f"GET_{'TRANS' if kind == 'TRANSFORM' else kind}" for kind in self.devices)
            kinds = [*self.devices, *asked, ASK_CAPABILITY]
            names = b"".join(kind[:TYPE_BYTES].encode().ljust(TYPE_BYTES, b"\0") for kind in kinds)
            return pack_raw(CAPABILITY, header.device, names, now, version=version)
        kind = next((whole for whole in self.devices if len(kind) > 4 and whole.startswith(kind)), kind)
        devices = self.devices.get(kind, ())
        named = [device for device in devices if header.device in ("", device)]
        if operation != "GET":
            started = operation == "STT" and bool(devices)
            return pack_raw(f"RTS_{kind}"[:TYPE_BYTES], header.device, bytes([not started]), now, version=version)
        since_s, ready = self._ready
        for device in named if time.monotonic() - since_s <= KEPT_S else ():
            if (message := ready.get((kind, device))) is not None:
                return message
        if not devices:
            status = Status(STATUS_UNKNOWN, 0, "UNKNOWN", f"{header.kind} is not served here")
        elif not named:
            status = Status(STATUS_NOT_FOUND, 0, "NOT_FOUND", f"{kind} is served of {' and '.join(devices)}")
        else:
            status = Status(STATUS_NOT_READY, 0, "NOT_READY", self.why)
        return pack_status(header.device or "Status", status, now, {}, version)


class MessageDecoder(Decoder[Message]):
    """Turns one connection's bytes into the messages of the wanted devices.

    Args:
        rejections: counts messages with a wrong checksum or content, and those of a wanted device whose type is not
            read. They are left out; the stream continues, since their length is known.
        wanted: (type, device) pairs; an empty device takes every device of that type. Messages of other devices are
            skipped. ``TRANSFORM`` stands for all types with poses; instruments of TDATA are devices of their own.
        counts: number of messages up to now by (type, device), across connections.
        offers: what the peer may ask for.
    """

    def __init__(
        self,
        rejections: Rejections,
        wanted: frozenset[tuple[str, str]],
        counts: Counter[tuple[str, str]],
        offers: Offers | None = None,
    ) -> None:
        super().__init__(rejections)
        self._wanted, self._counts, self._offers = wanted, counts, offers or Offers()
        self._names = frozenset(device for _, device in wanted if device)
        self._buffer = bytearray()
        self._header: Header | None = None
        self._images: dict[str, ImageParts] = {}
        self._skipped: dict[str, None] = {}

    @property
    def partial(self) -> bool:
        """Whether a message has begun and is not complete."""
        return self._header is not None or bool(self._buffer)

    def feed(self, data: bytes, host_s: float) -> list[Message]:
        """Messages completed by these bytes. Raises StreamBroken."""
        self._buffer += data
        messages: list[Message] = []
        while True:
            needed = HEADER.size if self._header is None else self._header.body_bytes
            if len(self._buffer) < needed:
                return messages
            taken = bytes(self._buffer[:needed])
            del self._buffer[:needed]
            if self._header is None:
                self._header = parse_header(taken)
                continue
            header, self._header = self._header, None
            self.completed += 1
            messages += self._complete(header, taken, host_s)

    def _complete(self, header: Header, body: bytes, host_s: float) -> Iterator[Message]:
        """The messages of a header and its body."""
        kind = "TRANSFORM" if header.kind in POSE_TYPES else header.kind
        several = header.kind in ("TDATA", "QTDATA") and any(wanted == "TRANSFORM" for wanted, _ in self._wanted)
        key = self._key(kind, header.device)
        try:
            if header.kind.startswith(QUERIES):
                check_body(header, body)
                self.replies.append(self._offers.answer(header))
            elif header.kind.startswith("RTS_"):
                check_body(header, body)
                if body[-1:] != b"\0":
                    raise ValueError(f"{header.kind}: it does not start the stream it was asked for")
            elif several:
                content, metadata = parse_body(header, body)
                assert isinstance(content, Tracked)
                for name, pose in content.poses.items():
                    if (key := self._key("TRANSFORM", name)) is None:
                        self._skip(header.kind, name)
                    elif isinstance(pose, str):
                        self._counts[key] += 1
                        self.rejections.add(f"{header.kind} {name}: {pose}")
                    else:
                        yield self._message(header, host_s, key, name, pose, metadata)
            elif key is not None:
                self._counts[key] += 1  # also where it is left out
                content, metadata = parse_body(header, body)
                whole = self._whole(header, content)
                self._counts[key] -= 1
                if whole is not None:
                    yield self._message(header, host_s, key, header.device, whole, metadata)
            elif header.device in self._names:
                raise ValueError(f"{header.kind} {header.device}: not a type that is read here")
            else:
                self._skip(header.kind, header.device)
        except ValueError as error:
            self.rejections.add(str(error))

    def _key(self, kind: str, device: str) -> tuple[str, str] | None:
        """The entry of ``wanted``: only those are counted, since a sender may invent any number of names."""
        return next((key for key in ((kind, device), (kind, "")) if key in self._wanted), None)

    def _message(
        self,
        header: Header,
        host_s: float,
        key: tuple[str, str],
        device: str,
        content: Content,
        metadata: Mapping[str, str],
    ) -> Message:
        index = self._counts[key]
        self._counts[key] += 1
        return Message(device, header.sent_s, host_s, index, content, metadata, self.rejections.peer)

    def _whole(self, header: Header, content: Content) -> Content | None:
        """The content; of an image that comes in parts, the whole once all of them are there."""
        if not isinstance(content, Image) or content.is_whole:
            return content
        if header.device not in self._images and len(self._images) >= MOST_IMAGES:
            raise ValueError(f"IMAGE {header.device}: parts of more than {MOST_IMAGES} images at a time")
        parts = self._images.setdefault(header.device, ImageParts())
        whole, given_up = parts.add(content, header.sent_s)
        if given_up:
            self.rejections.add(f"IMAGE {header.device}: parts of it did not come")
        return whole

    def _skip(self, kind: str, device: str) -> None:
        """Remember a device that is not asked for, to name it where what is asked for does not come."""
        if self._wanted and len(self._skipped) < MOST_INSTEAD:
            self._skipped[f"{kind} {device}"] = None
            self.instead = f"; it sends {', '.join(self._skipped)}"
