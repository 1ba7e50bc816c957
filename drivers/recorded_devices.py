"""Recordings played back in real time in place of the devices that were recorded."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fgreg.drivers.base import DeviceLost, MotionSample, StereoFrame, host_now
from fgreg.drivers.ros_messages import IMAGE_TYPES, POSE_TYPES, picture_of, pose_of, stamp_ns
from fgreg.drivers.ros_recordings import ECM_POSE, Recorded, Recording
from fgreg.drivers.stereo_matching import StereoMatcher
from fgreg.drivers.video_input import Grabbed
from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray, adjoint, as_float_array, inverse
from fgreg.model.time_sync import Stamp

if TYPE_CHECKING:
    from fgreg.drivers.base import DriverContext, MotionSource, StereoCamera
    from fgreg.drivers.options import RecordedCameraOptions, RecordedMotionOptions


@dataclass(frozen=True, slots=True)
class Pace:
    """When recorded messages are due: ``bag_start_s`` at ``host_start_s``, then ``speed`` times as fast as recorded.

    Devices that play one recording together share one.
    """

    bag_start_s: float
    host_start_s: float
    speed: float = 1.0

    def __post_init__(self) -> None:
        if not self.speed > 0.0:
            raise ValueError(f"speed is {self.speed}, expected a number > 0")

    @classmethod
    def of(cls, path: Path, speed: float = 1.0) -> Pace:
        """A recording that starts now."""
        with Recording(path) as recording:
            return cls(recording.start_ns / 1e9, host_now(), speed)

    def due_s(self, bag_s: float) -> float:
        """Host time at which a message is due."""
        return self.host_start_s + (bag_s - self.bag_start_s) / self.speed


class _Player:
    """Messages of some topics as they become due; at most ``room`` of each topic at once, older ones are dropped."""

    def __init__(self, path: Path, recording: Recording, topics: Collection[str], pace: Pace, room: int) -> None:
        self.name = f"{path.name} {' and '.join(topics)}"
        self.recording = recording
        self.dropped = 0
        self.ended = False
        self._reported = False
        self._messages = recording.messages(topics)
        self._pace, self._room = pace, room
        self._next = next(self._messages, None)
        self._counts = dict.fromkeys(topics, 0)

    def due(self) -> list[tuple[Recorded, int]]:
        """Messages that are due, each with its index in its topic. Raises DeviceLost once, at the recording's end."""
        found: dict[str, deque[tuple[Recorded, int]]] = {}
        now = host_now()
        while not self.ended and self._next is not None and self._pace.due_s(self._next.bag_ns / 1e9) <= now:
            topic = self._next.topic
            waiting = found.setdefault(topic, deque())
            waiting.append((self._next, self._counts[topic]))
            self._counts[topic] += 1
            if len(waiting) > self._room:
                waiting.popleft()
                self.dropped += 1
            self._next = next(self._messages, None)
        out = sorted((message for waiting in found.values() for message in waiting), key=lambda m: m[0].bag_ns)
        if self._next is None:
            self.ended = True
            if not out and not self._reported:
                self._reported = True
                raise DeviceLost(f"recording {self.name}: played to its end")
        return out

    def close(self) -> None:
        self.ended = self._reported = True
        self._next = None
        self.recording.close()


class _RecordedDevice:
    """A device of a recording that is played."""

    _player: _Player

    @property
    def name(self) -> str:
        """File and topics."""
        return self._player.name

    @property
    def connected(self) -> bool:
        """Whether the recording goes on."""
        return not self._player.ended

    @property
    def dropped(self) -> int:
        """Number of messages that were not fetched in time or cannot be used."""
        return self._player.dropped

    def close(self) -> None:
        """Close the file."""
        self._player.close()


class RecordedMotion(_RecordedDevice):
    """A MotionSource: the endoscope's pose by its holder (CRTK ``measured_cp`` of the ECM; metres become mm).

    Args:
        path: rosbag2 folder, .mcap, .db3 or .bag (ROS 1).
        topic: PoseStamped, TransformStamped or PoseWithCovarianceStamped. Default: ``/ECM/measured_cp``.
        tip_T_camera: (4, 4), mm, camera pose in the frame that the topic's poses are of. Default: identity.
        pace: shared with other devices that play the recording. Default: from now, at recorded speed.
        room: largest number of samples of one poll.
    """

    def __init__(
        self,
        path: Path,
        topic: str | None = None,
        tip_T_camera: FloatArray | None = None,
        pace: Pace | None = None,
        room: int = 256,
    ) -> None:
        recording = Recording(path)
        try:
            name = topic or recording.endoscope_pose_topic()[0] or f"/{ECM_POSE}"
            recording.topic(name, POSE_TYPES, "the endoscope's pose")
            pace = pace or Pace(recording.start_ns / 1e9, host_now())
            self._player = _Player(path, recording, [name], pace, room)
        except BaseException:
            recording.close()
            raise
        self._tip_T_camera = as_float_array(np.eye(4) if tip_T_camera is None else tip_T_camera, 4, 4)

    def poll(self) -> list[MotionSample]:
        """Samples that became due since the last call. Raises DeviceLost once, at the end."""
        out = []
        tip_from_camera = adjoint(inverse(self._tip_T_camera))
        for recorded, _ in self._player.due():
            message = self._player.recording.decode(recorded)
            try:
                transform, covariance = pose_of(message)
            except ValueError:
                self._player.dropped += 1  # a robot that is not ready sends invalid poses
                continue
            if covariance is not None:
                covariance = as_float_array(tip_from_camera @ covariance @ tip_from_camera.T)
            stamp = Stamp(stamp_ns(message, recorded.bag_ns) / 1e9, host_now())
            out.append(MotionSample(stamp, as_float_array(transform @ self._tip_T_camera), covariance))
        return out


class RecordedCamera(_RecordedDevice):
    """A StereoCamera: recorded images, raw or compressed, 8 or 16 bits as sent, matched by the times in their headers.

    Args:
        path: rosbag2 folder, .mcap, .db3 or .bag (ROS 1).
        left, right: topics. Default: found by name; one camera if there is no right topic.
        pace: as in RecordedMotion.
        max_gap_s: longest time between left and right.
        room: largest number of frames of one poll.
    """

    def __init__(
        self,
        path: Path,
        left: str | None = None,
        right: str | None = None,
        pace: Pace | None = None,
        max_gap_s: float = 0.017,
        room: int = 8,
    ) -> None:
        recording = Recording(path)
        try:
            first = left or recording.image_topic("left")
            if first is None:
                raise InputError(path.name, "no images of a left camera", "a topic .../left/image_raw, or its name")
            second = right or (recording.image_topic("right") if left is None else None)
            topics = [first] if second is None else [first, second]
            for name in topics:
                recording.topic(name, IMAGE_TYPES, "images")
            self._player = _Player(path, recording, topics, pace or Pace(recording.start_ns / 1e9, host_now()), room)
        except BaseException:
            recording.close()
            raise
        self._left, self._right = first, second
        self._matcher = StereoMatcher(max_gap_s, lambda g: g.stamp.device_s, 2 * room)

    @property
    def dropped(self) -> int:
        """Images that were not fetched in time, have no partner, or cannot be decoded."""
        return self._player.dropped + self._matcher.dropped

    def poll(self) -> list[StereoFrame]:
        """Frames that became due since the last call. Raises DeviceLost once, at the end."""
        grabbed: dict[str, list[Grabbed]] = {name: [] for name in (self._left, self._right) if name is not None}
        for recorded, index in self._player.due():
            message = self._player.recording.decode(recorded)
            try:
                picture = picture_of(message)
            except ValueError:
                self._player.dropped += 1
                continue
            stamp = Stamp(stamp_ns(message, recorded.bag_ns) / 1e9, host_now())
            grabbed[recorded.topic].append(Grabbed(stamp, picture, index))
        rights = [] if self._right is None else grabbed[self._right]
        expected = self._right is not None and not self._player.ended
        pairs = self._matcher.take(grabbed[self._left], rights, right_expected=expected)
        return [StereoFrame(a.stamp, a.picture, None if b is None else b.picture, a.index) for a, b in pairs]


def check_camera(options: RecordedCameraOptions) -> None:
    """Raises InputError: no recording, or no such images in it."""
    RecordedCamera(options.path, options.left, options.right, max_gap_s=options.max_gap_s).close()


def open_camera(context: DriverContext, options: RecordedCameraOptions) -> StereoCamera:
    """Images of a ROS 2 recording."""
    pace = _pace(context, options.path, options.speed)
    return RecordedCamera(options.path, options.left, options.right, pace, options.max_gap_s)


def check_motion(options: RecordedMotionOptions) -> None:
    """Raises InputError: no recording, or no such poses in it."""
    RecordedMotion(options.path, options.topic, options.tip_T_camera).close()


def open_motion(context: DriverContext, options: RecordedMotionOptions) -> MotionSource:
    """Poses of a ROS 2 recording."""
    pace = _pace(context, options.path, options.speed)
    return RecordedMotion(options.path, options.topic, options.tip_T_camera, pace)


def _pace(context: DriverContext, path: Path, speed: float) -> Pace:
    """One for all that play a recording, from the first of them on."""
    key = (path.resolve(), speed)
    if key not in context.paces:
        context.paces[key] = Pace.of(path, speed)
    pace: Pace = context.paces[key]
    return pace
