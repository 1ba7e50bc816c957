"""Contents of OpenIGTLink messages, and their bytes: IMAGE and its parts, POSITION, TDATA, QTDATA, STATUS.

All parsers take untrusted bytes; they raise ValueError or struct.error, and take no memory beyond the bytes' own.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.geometry.quaternions import rotation_from_quaternion
from fgreg.geometry.transforms import FloatArray, make_transform
from fgreg.schema.limits import IGTL_BODY_BYTES

STATUS = struct.Struct(">Hq20s")
IMAGE = struct.Struct(">HBBBB3H12f3H3H")
POSE = struct.Struct(">3f4f")
SHORT_POSE = struct.Struct(">3f3f")
TRACKED = struct.Struct(">20sBB12f")
QUATERNION_TRACKED = struct.Struct(">20sBB3f4f")
SCALARS = {2: "i1", 3: "u1", 4: "i2", 5: "u2", 6: "i4", 7: "u4", 10: "f4", 11: "f8"}
POSES = {1: "tracker", 2: "6D"}
"""Types of a tracked instrument whose pose is known in full; 3D has no orientation, 5D no roll."""


@dataclass(frozen=True, slots=True, eq=False)
class Image:
    """IMAGE: ``pixels`` (k, j, i) or (k, j, i, components); ``world_T_ijk`` (4, 4), mm per step along i, j, k.

    A part of an image (sub-volume) has the whole one's ``size`` (k, j, i), and ``start``, its first pixel there.
    """

    pixels: npt.NDArray[Any]
    world_T_ijk: FloatArray
    size: tuple[int, int, int]
    start: tuple[int, int, int] = (0, 0, 0)

    @property
    def is_whole(self) -> bool:
        """Whether it is no part."""
        return self.pixels.shape[:3] == self.size


@dataclass(frozen=True, slots=True, eq=False)
class Transform:
    """TRANSFORM, POSITION: ``to_T_from`` (4, 4), where the device is named ``FromToTo``; millimetres."""

    to_T_from: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """TDATA, QTDATA: the instruments by name; a text where an instrument's pose is not known in full."""

    poses: Mapping[str, Transform | str]


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


Content = Image | Transform | Tracked | Text | Status


def padded(raw: bytes) -> str:
    """Text of a field of fixed length. Raises UnicodeDecodeError."""
    return raw.split(b"\0", 1)[0].decode("utf-8").rstrip()


def finite(matrix: FloatArray) -> FloatArray:
    """The matrix. Raises ValueError."""
    if not np.isfinite(matrix).all():
        raise ValueError("an entry is not finite")
    return matrix


def parse_image(content: bytes) -> Image:
    """An image or a part of one."""
    fields = IMAGE.unpack(content[: IMAGE.size])
    _, components, scalar, order, _, *rest = fields
    size, axes, start, part = rest[:3], rest[3:15], rest[15:18], rest[18:]
    if not components or scalar not in SCALARS:
        raise ValueError(f"an image of {components} components of type {scalar}")
    whole_bytes = math.prod(size) * components * np.dtype(SCALARS[scalar]).itemsize
    if not whole_bytes or not math.prod(part) or whole_bytes > IGTL_BODY_BYTES:
        raise ValueError(f"an image of {tuple(size)}, its part of {tuple(part)}")
    if any(first + count > most for first, count, most in zip(start, part, size, strict=True)):
        raise ValueError(f"a part of {tuple(part)} from {tuple(start)} on in an image of {tuple(size)}")
    wire = np.dtype(SCALARS[scalar]).newbyteorder(">" if order == 1 else "<")
    shape = (*part[::-1], components) if components > 1 else tuple(part[::-1])
    pixels = np.frombuffer(content[IMAGE.size :], wire).reshape(shape).astype(wire.newbyteorder("="))
    world_T_ijk = np.eye(4)
    world_T_ijk[:3] = np.reshape(axes, (4, 3)).T  # the columns i, j, k and the centre
    world_T_ijk[:3, 3] -= world_T_ijk[:3, :3] @ ((np.array(size) - 1.0) / 2.0)
    depth, rows, columns = size[::-1]
    first_k, first_j, first_i = start[::-1]
    return Image(pixels, world_T_ijk, (depth, rows, columns), (first_k, first_j, first_i))


def image_head(pixels: npt.NDArray[Any]) -> bytes:
    """What stands before the pixels (k, j, i) or (k, j, i, components) of a whole image of unit spacing."""
    (k, j, i), components = pixels.shape[:3], int(np.prod(pixels.shape[3:]))
    scalar = next(kind for kind, name in SCALARS.items() if np.dtype(name) == pixels.dtype.newbyteorder("="))
    order = 1 if pixels.dtype.byteorder == ">" else 2
    centre = ((i - 1) / 2.0, (j - 1) / 2.0, (k - 1) / 2.0)
    axes = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    return IMAGE.pack(1, components, scalar, order, 2, i, j, k, *axes, *centre, 0, 0, 0, i, j, k)


def parse_position(content: bytes) -> Transform:
    """A position with its orientation as a quaternion; its scalar part may be left away."""
    if len(content) == SHORT_POSE.size:
        *position, x, y, z = SHORT_POSE.unpack(content)
        return _pose(position, (x, y, z, math.sqrt(max(0.0, 1.0 - x * x - y * y - z * z))))
    if len(content) != POSE.size:
        raise ValueError(f"a position of {len(content)} bytes, expected {POSE.size} with its orientation")
    fields = POSE.unpack(content)
    return _pose(fields[:3], fields[3:])


def parse_tracked(content: bytes) -> Tracked:
    """TDATA: matrices."""
    return Tracked(
        {
            padded(name): _known(kind, lambda values=values: _matrix(values))  # type: ignore[misc]
            for name, kind, _, *values in TRACKED.iter_unpack(content)
        }
    )


def parse_quaternion_tracked(content: bytes) -> Tracked:
    """QTDATA: positions and quaternions."""
    return Tracked(
        {
            padded(name): _known(kind, lambda values=values: _pose(values[:3], values[3:]))  # type: ignore[misc]
            for name, kind, _, *values in QUATERNION_TRACKED.iter_unpack(content)
        }
    )


def parse_status(content: bytes) -> Status:
    """STATUS."""
    code, subcode, error = STATUS.unpack(content[: STATUS.size])
    return Status(code, subcode, padded(error), padded(content[STATUS.size :]))


PARSERS: Mapping[str, Callable[[bytes], Content]] = {
    "IMAGE": parse_image,
    "POSITION": parse_position,
    "TDATA": parse_tracked,
    "QTDATA": parse_quaternion_tracked,
    "STATUS": parse_status,
}


def _known(kind: int, pose: Callable[[], Transform]) -> Transform | str:
    if kind not in POSES:
        return f"its pose is not known in full (type {kind})"
    try:
        return pose()
    except ValueError as error:
        return str(error)


def _matrix(values: list[float]) -> Transform:
    matrix = np.eye(4)
    matrix[:3] = np.reshape(values, (4, 3)).T
    return Transform(finite(matrix))


def _pose(position: Any, xyzw: Any) -> Transform:
    finite(np.array([*position, *xyzw]))
    length = float(np.linalg.norm(xyzw))
    if not 0.5 < length < 2.0:  # the protocol's library takes any length, and its examples send 0.88
        raise ValueError(f"a quaternion of length {length:.3g}")
    return Transform(make_transform(rotation_from_quaternion(*(np.array(xyzw) / length)), np.array(position)))


class ImageParts:
    """Puts parts of images together. An image is given once all its pixels have come.

    Parts belong together if they have the time stamp and the form of those before and bring pixels that were missing.
    """

    def __init__(self) -> None:
        self._form: tuple[Any, ...] | None = None
        self._pixels: npt.NDArray[Any] = np.zeros(0)
        self._missing: npt.NDArray[np.bool_] = np.zeros(0, np.bool_)
        self._left = 0

    def add(self, part: Image, sent_s: float | None) -> tuple[Image | None, bool]:
        """Take in a part; the image that it completes, and whether another one was given up for it."""
        form = (sent_s, part.size, part.pixels.dtype, part.pixels.shape[3:])
        at = tuple(slice(a, a + n) for a, n in zip(part.start, part.pixels.shape[:3], strict=True))
        given_up = False
        if form != self._form or not self._missing[at].all():
            given_up = self._form is not None
            self._form, self._left = form, math.prod(part.size)
            self._pixels = np.zeros((*part.size, *part.pixels.shape[3:]), part.pixels.dtype)
            self._missing = np.ones(part.size, np.bool_)
        self._pixels[at], self._missing[at] = part.pixels, False
        self._left -= math.prod(part.pixels.shape[:3])
        if self._left:
            return None, given_up
        self._form = None
        return Image(self._pixels, part.world_T_ijk, part.size), given_up
