"""OpenIGTLink messages: bytes to typed content and back, with checks of everything that a sender can get wrong.

Metadata, TRANSFORM and STRING are pyigtl's; header, checksum, sizes and the other
contents are read or made here (``igtl_contents``), since pyigtl does not: it has no STATUS, TDATA and QTDATA, takes no
part of an image, and its POSITION is not that of the protocol. Its own client and server are not used: they keep only
the newest message of each device, so laser pulses would be lost. They accept any body size and any checksum, do not
reconnect after the other side hangs up, and loop for ever if it hangs up inside a header.

Header version 2 (OpenIGTLink 3) carries metadata; receivers of protocol 1 and 2 cannot read it and lose the stream.
"""

from __future__ import annotations

import functools
import importlib
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.drivers.igtl_contents import (
    PARSERS,
    STATUS,
    Content,
    Image,
    Status,
    Text,
    Transform,
    finite,
    image_head,
    padded,
)
from fgreg.drivers.stream_decoder import StreamBroken
from fgreg.errors import InputError, MissingExtraError
from fgreg.geometry.transforms import FloatArray
from fgreg.schema.limits import IGTL_BODY_BYTES

NAME_BYTES = 20
HEADER = struct.Struct(">H12s20sIIQQ")
EXTENDED = struct.Struct(">HHII")
"""Extended header of version 2: its size, those of the metadata's header and of the metadata, the message's number."""

STATUS_OK, STATUS_NOT_FOUND, STATUS_UNKNOWN, STATUS_NOT_READY = 1, 4, 12, 13


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """One message.

    Attributes:
        device: the sender's name for it.
        sent_s: its time stamp (s since 1970 as a rule), None where the sender gives none.
        host_s: when it was complete here, ``time.monotonic()``.
        index: counts the messages of one entry of ``wanted`` (a device, or all of a type), including those left out.
        metadata: of header version 2.
        peer: address and port of who sent it.
    """

    device: str
    sent_s: float | None
    host_s: float
    index: int
    content: Content
    metadata: Mapping[str, str] = field(default_factory=dict)
    peer: str = ""

    @property
    def nbytes(self) -> int:
        """Memory held, about."""
        pixels = self.content.pixels.nbytes if isinstance(self.content, Image) else 0
        return 1024 + pixels


@dataclass(frozen=True, slots=True)
class Header:
    """The first 58 bytes of a message."""

    version: int
    kind: str
    device: str
    sent_s: float | None
    body_bytes: int
    checksum: int


def check_name(name: str) -> str:
    """A valid OpenIGTLink device name. Raises InputError for others, which the protocol would cut silently."""
    if not (name.isascii() and name.isprintable() and 1 <= len(name) <= NAME_BYTES) or name != name.strip():
        raise InputError("OpenIGTLink device name", repr(name), f"1 to {NAME_BYTES} printable ASCII characters")
    return name


def check_version(version: int) -> int:
    """A valid header version. Raises InputError."""
    if version not in (1, 2):
        raise InputError("OpenIGTLink header version", str(version), "1 or 2")
    return version


def parse_header(data: bytes) -> Header:
    """A header (58 bytes).

    Raises:
        StreamBroken: not a header, or a body that is too large, so that the next message cannot be found.
    """
    version, kind, device, seconds, fraction, body_bytes, checksum = HEADER.unpack(data)
    if version not in (1, 2):
        raise StreamBroken(f"header version {version}: not OpenIGTLink")
    try:
        kind_text, device_text = (padded(raw) for raw in (kind, device))
    except UnicodeDecodeError as error:
        raise StreamBroken("names that are not text: not OpenIGTLink") from error
    if not (kind_text.isprintable() and device_text.isprintable() and kind_text):
        raise StreamBroken("names that are not text: not OpenIGTLink")
    if body_bytes > IGTL_BODY_BYTES:
        raise StreamBroken(f"a message of {body_bytes} bytes announced, at most {IGTL_BODY_BYTES} taken")
    sent_s = seconds + fraction / 2**32 if seconds or fraction else None
    return Header(version, kind_text, device_text, sent_s, body_bytes, checksum)


def parse_body(header: Header, body: bytes) -> tuple[Content, Mapping[str, str]]:
    """A message's content and metadata.

    Raises:
        ValueError: wrong checksum, or content that does not fit its type.
    """
    check_body(header, body)
    raw = _raw_class(header.kind)()
    fields = {
        "header_version": header.version,
        "message_type": header.kind,
        "device_name": header.device,
        "timestamp": header.sent_s or 0.0,
    }
    try:
        raw.unpack(fields, body)
        return _content(header.kind, raw), dict(raw.metadata)
    except Exception as error:  # a third party's parser on untrusted bytes may raise anything
        raise ValueError(f"{header.kind} {header.device}: {error}") from error


def check_body(header: Header, body: bytes) -> None:
    """Raises ValueError where the checksum is wrong."""
    if _pyigtl().messages.CRC64(body) != header.checksum:
        raise ValueError(f"{header.kind} {header.device}: wrong checksum")


def pack_transform(
    device: str, to_T_from: FloatArray, sent_s: float, metadata: Mapping[str, str], version: int = 2
) -> bytes:
    """TRANSFORM; single precision on the wire."""
    return _pack(_pyigtl().TransformMessage(to_T_from), check_name(device), sent_s, metadata, version)


def pack_text(device: str, text: str, sent_s: float, metadata: Mapping[str, str], version: int = 2) -> bytes:
    """STRING, ASCII; cut to 65,535 bytes."""
    return _pack(_pyigtl().StringMessage(_ascii(text)[:65535]), check_name(device), sent_s, metadata, version)


def pack_status(device: str, status: Status, sent_s: float, metadata: Mapping[str, str], version: int = 2) -> bytes:
    """STATUS; its error name holds 20 bytes, the text is ASCII."""
    error, text = _ascii(status.error)[:NAME_BYTES].encode(), _ascii(status.text).encode()
    content = STATUS.pack(status.code, status.subcode, error) + text + b"\0"
    return pack_raw("STATUS", check_name(device), content, sent_s, metadata, version)


def pack_image(device: str, pixels: npt.NDArray[Any], sent_s: float, version: int = 2) -> bytes:
    """IMAGE (k, j, i) of one component per pixel or (k, j, i, components), unit spacing.

    Made here, since pyigtl copies the pixels five times.
    """
    head, data = image_head(pixels), np.ascontiguousarray(pixels).data
    before, after = (EXTENDED.pack(EXTENDED.size, 2, 0, 0), b"\0\0") if version > 1 else (b"", b"")
    body = b"".join((before, head, data, after))
    checksum = _pyigtl().messages.CRC64(body)
    seconds, name = int(sent_s), check_name(device).encode()
    fraction = int((sent_s - seconds) * 2**32)
    return b"".join((HEADER.pack(version, b"IMAGE", name, seconds, fraction, len(body), checksum), body))


def pack_raw(
    kind: str, device: str, content: bytes, sent_s: float, metadata: Mapping[str, str] | None = None, version: int = 2
) -> bytes:
    """A message of any type from its content; ``device`` may be empty, as in queries."""
    raw = _raw_class(kind)()
    raw.content = content
    return _pack(raw, device, sent_s, metadata or {}, version)


def require_pyigtl() -> None:
    """Raises MissingExtraError if pyigtl is not installed."""
    _pyigtl()


@functools.cache
def _pyigtl() -> ModuleType:
    try:
        return importlib.import_module("pyigtl")
    except ModuleNotFoundError as error:
        raise MissingExtraError("pyigtl", "igtl") from error


@functools.cache
def _raw_class(kind: str) -> Any:
    """pyigtl's class of the types that it reads here; for the others one that holds the content's bytes."""
    library = _pyigtl()
    if kind in ("TRANSFORM", "STRING"):
        return library.messages.message_type_to_class_constructor[kind]
    base = library.MessageBase

    class RawMessage(base):  # type: ignore[misc, valid-type]
        """A message whose content is bytes."""

        def __init__(self) -> None:
            base.__init__(self)
            self._message_type, self._valid_message, self.content = kind, True, b""

        def _pack_content(self) -> bytes:
            return self.content

        def _unpack_content(self, content: bytes) -> None:
            self.content = content

    return RawMessage


def _content(kind: str, raw: Any) -> Content:
    if kind == "TRANSFORM":
        return Transform(finite(np.array(raw.matrix, dtype=np.float64)))
    if kind == "STRING":
        return Text(str(raw.string))
    if kind in PARSERS:
        return PARSERS[kind](raw.content)
    raise ValueError("not a type that is read here")


def _pack(raw: Any, device: str, sent_s: float, metadata: Mapping[str, str], version: int) -> bytes:
    raw.device_name = device
    raw.timestamp = sent_s
    raw.header_version = version
    raw.metadata = {_ascii(key): _ascii(value) for key, value in metadata.items()} if version > 1 else {}
    return bytes(raw.pack())


def _ascii(text: str) -> str:
    """ASCII text with other characters as escapes, since receivers treat them differently."""
    return text.encode("ascii", "backslashreplace").decode("ascii")
