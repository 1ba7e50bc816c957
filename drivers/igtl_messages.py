"""OpenIGTLink messages: bytes to typed content and back, with checks of everything that a sender can get wrong.

Packing and parsing of contents is pyigtl's; header, checksum, sizes and STATUS are checked or made here, since pyigtl
does none of it. Its own client and server are not used: they keep only the newest message of each device, so laser
pulses would be lost. They accept any body size and any checksum, do not reconnect after the other side hangs up, and
loop for ever if it hangs up inside a header.

Header version 2 (OpenIGTLink 3) carries metadata; receivers of protocol 1 and 2 cannot read it and lose the stream.
"""

from __future__ import annotations

import functools
import importlib
import struct
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.drivers.tcp_link import Rejections, StreamBroken
from fgreg.errors import InputError, MissingExtraError
from fgreg.geometry.transforms import FloatArray
from fgreg.schema.limits import IGTL_BODY_BYTES

NAME_BYTES = 20
HEADER = struct.Struct(">H12s20sIIQQ")
STATUS = struct.Struct(">Hq20s")

STATUS_OK, STATUS_NOT_READY = 1, 13


@dataclass(frozen=True, slots=True, eq=False)
class Image:
    """IMAGE: ``pixels`` (k, j, i) or (k, j, i, components); ``world_T_ijk`` (4, 4), mm per step along i, j, k."""

    pixels: npt.NDArray[Any]
    world_T_ijk: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Transform:
    """TRANSFORM: ``to_T_from`` (4, 4), where the device is named ``FromToTo``; millimetres."""

    to_T_from: FloatArray


@dataclass(frozen=True, slots=True)
class Text:
    """STRING."""

    text: str


@dataclass(frozen=True, slots=True)
class Status:
    """STATUS: ``code`` 1 is fine, all others are not."""

    code: int
    subcode: int
    error: str
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """One message.

    Attributes:
        device: the sender's name for it.
        sent_s: its time stamp (s since 1970 as a rule), None where the sender gives none.
        host_s: when it was complete here, ``time.monotonic()``.
        index: counts the messages of one entry of ``wanted`` (a device, or all of a type), including those left out.
        metadata: of header version 2.
    """

    device: str
    sent_s: float | None
    host_s: float
    index: int
    content: Image | Transform | Text | Status
    metadata: Mapping[str, str] = field(default_factory=dict)

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


def parse_header(data: bytes) -> Header:
    """A header (58 bytes).

    Raises:
        StreamBroken: not a header, or a body that is too large, so that the next message cannot be found.
    """
    version, kind, device, seconds, fraction, body_bytes, checksum = HEADER.unpack(data)
    if version not in (1, 2):
        raise StreamBroken(f"header version {version}: not OpenIGTLink")
    try:
        kind_text, device_text = (_padded(raw) for raw in (kind, device))
    except UnicodeDecodeError as error:
        raise StreamBroken("names that are not text: not OpenIGTLink") from error
    if not (kind_text.isprintable() and device_text.isprintable() and kind_text):
        raise StreamBroken("names that are not text: not OpenIGTLink")
    if body_bytes > IGTL_BODY_BYTES:
        raise StreamBroken(f"a message of {body_bytes} bytes announced, at most {IGTL_BODY_BYTES} taken")
    sent_s = seconds + fraction / 2**32 if seconds or fraction else None
    return Header(version, kind_text, device_text, sent_s, body_bytes, checksum)


def parse_body(header: Header, body: bytes, host_s: float, index: int = 0) -> Message:
    """A message from its parts.

    Raises:
        ValueError: wrong checksum, or content that does not fit its type.
    """
    library = _pyigtl()
    if library.messages.CRC64(body) != header.checksum:
        raise ValueError(f"{header.kind} {header.device}: wrong checksum")
    raw = _status_class()() if header.kind == "STATUS" else library.MessageBase.create_message(header.kind)
    if raw is None:
        raise ValueError(f"{header.kind} {header.device}: not a type that is read here")
    fields = {
        "header_version": header.version,
        "message_type": header.kind,
        "device_name": header.device,
        "timestamp": header.sent_s or 0.0,
    }
    try:
        raw.unpack(fields, body)
        content = _content(header.kind, raw)
    except Exception as error:  # a third party's parser on untrusted bytes may raise anything
        raise ValueError(f"{header.kind} {header.device}: {error}") from error
    return Message(header.device, header.sent_s, host_s, index, content, dict(raw.metadata))


def pack_transform(
    device: str, to_T_from: FloatArray, sent_s: float, metadata: Mapping[str, str], version: int = 2
) -> bytes:
    """TRANSFORM; single precision on the wire."""
    return _pack(_pyigtl().TransformMessage(to_T_from), device, sent_s, metadata, version)


def pack_text(device: str, text: str, sent_s: float, metadata: Mapping[str, str], version: int = 2) -> bytes:
    """STRING, ASCII; cut to 65,535 bytes."""
    return _pack(_pyigtl().StringMessage(_ascii(text)[:65535]), device, sent_s, metadata, version)


def pack_status(device: str, status: Status, sent_s: float, metadata: Mapping[str, str], version: int = 2) -> bytes:
    """STATUS; its error name holds 20 bytes, the text is ASCII."""
    raw = _status_class()()
    raw.status = status
    return _pack(raw, device, sent_s, metadata, version)


def pack_image(device: str, pixels: npt.NDArray[Any], sent_s: float, version: int = 2) -> bytes:
    """IMAGE (k, j, i) of one component per pixel, unit spacing: a scanner's part, for tests and simulated rooms."""
    return _pack(_pyigtl().ImageMessage(np.ascontiguousarray(pixels)), device, sent_s, {}, version)


class MessageDecoder:
    """Turns one connection's bytes into the messages of the wanted devices.

    Args:
        rejections: counts messages with a wrong checksum or content. They are left out; the stream continues, since
            their length is known.
        wanted: (type, device) pairs; an empty device takes every device of that type. Other messages are skipped.
        counts: number of messages up to now by (type, device), across connections.
    """

    def __init__(
        self, rejections: Rejections, wanted: frozenset[tuple[str, str]], counts: Counter[tuple[str, str]]
    ) -> None:
        self._rejections, self._wanted, self._counts = rejections, wanted, counts
        self._buffer = bytearray()
        self._header: Header | None = None

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
            if not {(header.kind, header.device), (header.kind, "")} & self._wanted:
                continue
            # Only wanted devices are counted separately: the sender may invent any number of names.
            key = (header.kind, header.device if (header.kind, header.device) in self._wanted else "")
            index = self._counts[key]
            self._counts[key] += 1
            try:
                messages.append(parse_body(header, taken, host_s, index))
            except ValueError as error:
                self._rejections.add(str(error))


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
def _status_class() -> Any:
    base = _pyigtl().MessageBase

    class StatusMessage(base):  # type: ignore[misc, valid-type]
        """STATUS, which pyigtl lacks."""

        def __init__(self) -> None:
            base.__init__(self)
            self._message_type = "STATUS"
            self._valid_message = True
            self.status = Status(0, 0, "", "")

        def _pack_content(self) -> bytes:
            error = _ascii(self.status.error)[:NAME_BYTES].encode()
            text = _ascii(self.status.text).encode()
            return STATUS.pack(self.status.code, self.status.subcode, error) + text + b"\0"

        def _unpack_content(self, content: bytes) -> None:
            code, subcode, error = STATUS.unpack(content[: STATUS.size])
            self.status = Status(code, subcode, _padded(error), _padded(content[STATUS.size :]))

    return StatusMessage


def _content(kind: str, raw: Any) -> Image | Transform | Text | Status:
    if kind == "TRANSFORM":
        matrix = np.array(raw.matrix, dtype=np.float64)
        if not np.isfinite(matrix).all():
            raise ValueError("an entry is not finite")
        return Transform(matrix)
    if kind == "IMAGE":
        if 0 in raw.image.shape:
            raise ValueError(f"an image of {raw.image.shape}")
        native = raw.image.dtype.newbyteorder("=")
        return Image(np.array(raw.image, dtype=native), np.array(raw.ijk_to_world_matrix, dtype=np.float64))
    if kind == "STRING":
        return Text(str(raw.string))
    if kind == "STATUS":
        status: Status = raw.status
        return status
    raise ValueError("not a type that is read here")


def _pack(raw: Any, device: str, sent_s: float, metadata: Mapping[str, str], version: int) -> bytes:
    raw.device_name = check_name(device)
    raw.timestamp = sent_s
    raw.header_version = version
    raw.metadata = {_ascii(key): _ascii(value) for key, value in metadata.items()} if version > 1 else {}
    return bytes(raw.pack())


def _padded(raw: bytes) -> str:
    """Text of a field of fixed length. Raises UnicodeDecodeError."""
    return raw.split(b"\0", 1)[0].decode("utf-8").rstrip()


def _ascii(text: str) -> str:
    """ASCII text with other characters as escapes, since receivers treat them differently."""
    return text.encode("ascii", "backslashreplace").decode("ascii")
