"""ROS messages (1 and 2) as this package's types: metres become millimetres, quaternions rotations, images arrays.

Functions take any object with the message's fields, so that neither ROS nor a reader of recordings is needed here.
Each raises ValueError with a short text if a message's content is invalid.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from fgreg.detection.frame_files import Picture, as_picture, decode_picture
from fgreg.drivers.calibration_parts import CameraInfo
from fgreg.errors import InputError
from fgreg.geometry.quaternions import rotation_from_quaternion, turn_about_x
from fgreg.geometry.transforms import FloatArray, as_float_array, make_transform, right_from_parent_covariance

IMAGE_TYPES = frozenset({"sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"})
INFO_TYPES = frozenset({"sensor_msgs/msg/CameraInfo"})
POSE_TYPES = frozenset(
    f"geometry_msgs/msg/{name}" for name in ("PoseStamped", "TransformStamped", "PoseWithCovarianceStamped")
)
POINT_TYPES = frozenset({"geometry_msgs/msg/PointStamped"})
SCAN_TYPES = POSE_TYPES | {"sensor_msgs/msg/JointState", "std_msgs/msg/Float64", "std_msgs/msg/Float32"}
ARRAY_TYPES = frozenset(
    {"sensor_msgs/msg/Image", "std_msgs/msg/Float32MultiArray", "std_msgs/msg/Int16MultiArray"},
)
TEXT_TYPES = frozenset({"std_msgs/msg/String"})
TF_TYPES = frozenset({"tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"})

MM_PER_M = 1000.0


@dataclass(frozen=True, slots=True)
class _Encoding:
    """Pixels of an image: their type, values for each, OpenCV's conversion to grey or BGR, rows per row of pixels."""

    kind: str
    channels: int
    to_bgr: int | None = None
    rows: float = 1.0


def _encodings() -> dict[str, _Encoding]:
    """ROS's names of encodings; OpenCV's type names and names without an alpha channel are synonyms."""
    found: dict[str, _Encoding] = {}
    for bits, kind in ((8, "u1"), (16, "u2")):
        grey, bgr, bgra = _Encoding(kind, 1), _Encoding(kind, 3), _Encoding(kind, 4, cv2.COLOR_BGRA2BGR)
        found |= {f"mono{bits}": grey, f"{bits}UC1": grey, f"bgr{bits}": bgr, f"{bits}UC3": bgr}
        found |= {f"rgb{bits}": _Encoding(kind, 3, cv2.COLOR_RGB2BGR), f"bgra{bits}": bgra, f"{bits}UC4": bgra}
        found |= {f"rgba{bits}": _Encoding(kind, 4, cv2.COLOR_RGBA2BGR)}
        # ROS names a Bayer pattern by its first line, OpenCV by its second and third pixel of the second line.
        for pattern, code in (("rggb", "BG"), ("bggr", "RG"), ("gbrg", "GR"), ("grbg", "GB")):
            found[f"bayer_{pattern}{bits}"] = _Encoding(kind, 1, getattr(cv2, f"COLOR_Bayer{code}2BGR"))
    # yuv422 is ROS's older name of uyvy, yuv422_yuy2 of yuyv.
    uyvy, yuyv = _Encoding("u1", 2, cv2.COLOR_YUV2BGR_UYVY), _Encoding("u1", 2, cv2.COLOR_YUV2BGR_YUY2)
    found |= {"uyvy": uyvy, "yuv422": uyvy, "yuyv": yuyv, "yuv422_yuy2": yuyv}
    # A plane of Y, then one of half its height with U and V.
    found |= {"nv21": _Encoding("u1", 1, cv2.COLOR_YUV2BGR_NV21, 1.5)}
    return found | {"nv12": _Encoding("u1", 1, cv2.COLOR_YUV2BGR_NV12, 1.5)}


_ENCODINGS = _encodings()
_ARRAYS: dict[str, str] = {"32FC1": "f4", "16SC1": "i2", "16UC1": "u2", "mono16": "u2", "8UC1": "u1", "mono8": "u1"}


def stamp_ns(message: Any, recorded_ns: int) -> int:
    """Time in a message's header, or the recording time if it has none or zero.

    In ns, since a double with seconds since 1970 would round to 0.2 us.
    """
    header = getattr(message, "header", None)
    if header is None:
        return recorded_ns
    found = int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
    return found if found > 0 else recorded_ns


def pose_of(message: Any) -> tuple[FloatArray, FloatArray | None]:
    """(4, 4) transform ``frame_id_T_child`` in mm, and its (6, 6) covariance over the right tangent where there is one.

    ROS states covariances over (x, y, z, rotations about x, y, z) along the parent's axes.
    """
    pose = getattr(message, "pose", None)
    covariance = None
    if pose is None:
        position, turn = message.transform.translation, message.transform.rotation
    else:
        if hasattr(pose, "covariance"):
            covariance = np.asarray(pose.covariance, dtype=np.float64).reshape(6, 6)
            pose = pose.pose
        position, turn = pose.position, pose.orientation
    rotation = rotation_from_quaternion(turn.x, turn.y, turn.z, turn.w)
    shift_mm = MM_PER_M * np.array([position.x, position.y, position.z], dtype=np.float64)
    if not np.isfinite(shift_mm).all():
        raise ValueError("a position that is not finite")
    transform = as_float_array(make_transform(rotation, shift_mm))
    if covariance is None or not covariance.any():
        return transform, None
    if not np.isfinite(covariance).all():
        raise ValueError("a covariance that is not finite")
    order, scale = [3, 4, 5, 0, 1, 2], np.repeat([1.0, MM_PER_M], 3)
    parent = covariance[np.ix_(order, order)] * np.outer(scale, scale)
    return transform, as_float_array(right_from_parent_covariance(rotation, parent))


def scan_deg_of(message: Any, joint: str | None, unit: str) -> float:
    """Stage angle (deg) of a joint state, a number, or a pose of the probe in its holder's frame.

    Args:
        message: of one of SCAN_TYPES.
        joint: name of the joint; None if there is only one.
        unit: ``rad`` or ``deg`` of numbers; joint states and poses are in rad.
    """
    if hasattr(message, "position") and hasattr(message, "name"):
        names = list(message.name)
        if joint is None and len(message.position) != 1:
            raise ValueError(f"{len(message.position)} joints, and none is named in the mapping")
        if joint is not None and joint not in names:
            raise ValueError(f"no joint {joint}")
        if joint is not None and len(names) != len(message.position):
            raise ValueError(f"{len(message.position)} positions of {len(names)} joints")
        value = float(message.position[0 if joint is None else names.index(joint)])
        found = math.degrees(value) if unit == "rad" else value
    elif hasattr(message, "data"):
        found = float(message.data) if unit == "deg" else math.degrees(float(message.data))
    else:
        found = math.degrees(turn_about_x(pose_of(message)[0][:3, :3]))
    if not math.isfinite(found):
        raise ValueError("an angle that is not finite")
    return found


def picture_of(message: Any) -> Picture:
    """An endoscope image, (h, w) grey or (h, w, 3) BGR, of an Image or CompressedImage, 8 or 16 bits as sent."""
    if not hasattr(message, "encoding"):
        if "compresseddepth" in str(message.format).lower().replace(" ", ""):
            raise ValueError("a depth image")
        data = np.frombuffer(message.data, dtype=np.uint8)
        try:
            decoded = decode_picture(data.tobytes(), "a compressed image")
        except InputError as error:
            raise ValueError(error.found) from None
        if decoded is None:
            raise ValueError(f"a compressed image that cannot be decoded ({message.format})")
        return decoded
    name = str(message.encoding)
    encoding = _ENCODINGS.get(name)
    if encoding is None:
        raise ValueError(f"an image encoded as {name}, which is none of {', '.join(_ENCODINGS)}")
    pixels = _pixels(message, encoding.channels, encoding.kind, encoding.rows)
    if (encoding.channels == 2 or encoding.rows != 1.0) and (pixels.shape[1] % 2 or int(message.height) % 2):
        raise ValueError(f"an image encoded as {name} with {message.width} x {message.height} px, which are not even")
    return as_picture(np.array(pixels if encoding.to_bgr is None else cv2.cvtColor(pixels, encoding.to_bgr)))


def array_of(message: Any) -> npt.NDArray[Any]:
    """A probe's frame: an Image with one channel, or a MultiArray with two dimensions; (rows, columns) as sent.

    The result is float32 or int16; 8 and 16 bit unsigned images become float32 with the same values.
    """
    if hasattr(message, "encoding"):
        encoding = str(message.encoding)
        if encoding not in _ARRAYS:
            raise ValueError(f"a frame encoded as {encoding}, which is none of {', '.join(_ARRAYS)}")
        array = _pixels(message, 1, _ARRAYS[encoding])
    else:
        sizes = [int(entry.size) for entry in message.layout.dim]
        data = np.asarray(message.data)[int(message.layout.data_offset) :]
        if len(sizes) != 2 or min(sizes) < 1 or data.size != sizes[0] * sizes[1]:
            raise ValueError(f"{data.size} numbers of dimensions {sizes}, expected two that fit")
        array = data.reshape(sizes)
    kind = np.int16 if array.dtype.kind == "i" else np.float32
    return np.ascontiguousarray(array, dtype=kind)


def _pixels(message: Any, channels: int, kind: str, rows_per_row: float = 1.0) -> npt.NDArray[Any]:
    """Pixels without the padding at the end of each row, in this machine's byte order."""
    width, height, step = int(message.width), int(int(message.height) * rows_per_row), int(message.step)
    item = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    row = width * channels * item.itemsize
    data = np.frombuffer(np.ascontiguousarray(message.data), dtype=np.uint8)
    if width < 1 or height < 1 or step < row or data.size < step * (height - 1) + row:
        raise ValueError(f"{data.size} bytes of {width} x {height} px with rows of {step}, which do not fit")
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1), writeable=False)
    pixels = np.ascontiguousarray(rows).view(item)
    if item.itemsize > 1 and bool(message.is_bigendian) != (sys.byteorder == "big"):
        pixels = pixels.astype(item.newbyteorder("="))
    return pixels.reshape((height, width) if channels == 1 else (height, width, channels))


def info_of(message: Any, where: str) -> CameraInfo:
    """A CameraInfo message; ``where`` names it in messages.

    Raises:
        InputError: only a part of the image, or arrays of the wrong size.
    """
    size = int(message.width), int(message.height)
    roi = message.roi
    if (int(roi.width), int(roi.height)) not in ((0, 0), size):
        raise InputError(f"{where}: roi", "a part of the image", "the whole image")
    for key in ("binning_x", "binning_y"):
        if int(getattr(message, key)) not in (0, 1):
            raise InputError(f"{where}: {key}", str(getattr(message, key)), "0 or 1: images without binning")

    def numbers(letter: str, *shape: int) -> FloatArray:
        values = getattr(message, letter, getattr(message, letter.upper(), None))
        try:
            return as_float_array(np.asarray(values, dtype=np.float64).reshape(shape))
        except (ValueError, TypeError):
            raise InputError(f"{where}: {letter}", "something else", "finite numbers, as calibrated") from None

    model = str(message.distortion_model)
    k, d, r, p = numbers("k", 3, 3), numbers("d", -1), numbers("r", 3, 3), numbers("p", 3, 4)
    return CameraInfo(where, size, k, d, model, r, p)
