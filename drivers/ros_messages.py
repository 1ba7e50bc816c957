"""ROS 2 messages as this package's types: metres become millimetres, quaternions rotations, images arrays.

Functions take any object with the message's fields, so that neither ROS nor a reader of recordings is needed here.
Each raises ValueError with a short text if a message's content is invalid.
"""

from __future__ import annotations

import math
import sys
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from fgreg.detection.frame_files import Picture, decode_picture
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

MM_PER_M = 1000.0

_CHANNELS = {"mono8": 1, "8UC1": 1, "bgr8": 3, "8UC3": 3, "rgb8": 3, "bgra8": 4, "8UC4": 4, "rgba8": 4}
_TO_BGR = {"rgb8": cv2.COLOR_RGB2BGR, "bgra8": cv2.COLOR_BGRA2BGR, "8UC4": cv2.COLOR_BGRA2BGR}
_TO_BGR |= {"rgba8": cv2.COLOR_RGBA2BGR}
# ROS names a Bayer pattern by its first line, OpenCV by its second and third pixel of the second line.
_BAYER = {"bayer_rggb8": cv2.COLOR_BayerBG2BGR, "bayer_bggr8": cv2.COLOR_BayerRG2BGR}
_BAYER |= {"bayer_gbrg8": cv2.COLOR_BayerGR2BGR, "bayer_grbg8": cv2.COLOR_BayerGB2BGR}
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
    """An endoscope image, (h, w) grey or (h, w, 3) BGR, of an Image or CompressedImage."""
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
    encoding = str(message.encoding)
    if encoding in _BAYER:
        return np.asarray(cv2.cvtColor(_pixels(message, 1, "u1"), _BAYER[encoding]), dtype=np.uint8)
    if encoding not in _CHANNELS:
        raise ValueError(f"an image encoded as {encoding}, which is none of {', '.join([*_CHANNELS, *_BAYER])}")
    picture = _pixels(message, _CHANNELS[encoding], "u1")
    if encoding in _TO_BGR:
        picture = cv2.cvtColor(picture, _TO_BGR[encoding])
    return np.array(picture, dtype=np.uint8)


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


def _pixels(message: Any, channels: int, kind: str) -> npt.NDArray[Any]:
    """Pixels without the padding at the end of each row, in this machine's byte order."""
    width, height, step = int(message.width), int(message.height), int(message.step)
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
