"""From frames of static tags to epochs: an alarm at once, the motion as soon as the camera stands still again.

While a camera is being moved, frames show it anywhere on its way. So the alarm only ends the epoch, which makes the
estimate say that it has no registration; the motion that ties the new epoch to the old one is measured on frames that
agree with each other, against the reference of before.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from scipy.special import chdtri

from fgreg.camera_moves.static_tags import (
    TagFrame,
    TagMoveDetector,
    TagPose,
    TagSettings,
    average_tags,
    detect_tag_move,
    restart_detector,
    tag_motion,
    usable_frame,
)
from fgreg.geometry.transforms import FloatArray
from fgreg.online.events import StaticTags

REST = 6
"""Frames at rest that a motion is measured on."""
REST_P = 0.05
"""Two halves of these differ by more than chance has it with this probability: then it is not sure to rest yet."""


@dataclass(frozen=True, slots=True)
class TagsMoved:
    """The camera has left its place: at ``since_t`` or a frame before."""

    since_t: float


@dataclass(frozen=True, slots=True, eq=False)
class TagsAtRest:
    """The camera stands again: its motion (4, 4) since the alarm's epoch began, and its covariance (6, 6)."""

    camera_new_T_camera_old: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class TagMonitor:
    """State of the guard, a value.

    Attributes:
        watch: for the epoch that lasts.
        times: of the watch's recent frames.
        before: mean poses of the epoch before, while the camera has not come to rest since an alarm.
        moving: frames since then.
    """

    detector: TagMoveDetector = field(default_factory=TagMoveDetector)
    times: tuple[float, ...] = ()
    before: Mapping[int, TagPose] = field(default_factory=dict)
    moving: tuple[TagFrame, ...] = ()

    @property
    def is_moving(self) -> bool:
        """Whether an alarm's motion is still to be measured."""
        return bool(self.before)


def monitored(
    monitor: TagMonitor, event: StaticTags, settings: TagSettings
) -> tuple[TagMonitor, TagsMoved | TagsAtRest | None]:
    """Take in one frame, and what it says."""
    frame = TagFrame(event.camera_T_tag, event.covariance)
    if monitor.is_moving:
        return _until_rest(monitor, frame, settings)
    detector, check = detect_tag_move(monitor.detector, frame, settings)
    times = (*monitor.times, event.t)[-len(detector.recent) :]
    if not check.alarm:
        return TagMonitor(detector, times), None
    since = times[-min(check.frames, len(times))]
    return TagMonitor(before=detector.means, moving=(usable_frame(frame),)), TagsMoved(since)


def _until_rest(monitor: TagMonitor, frame: TagFrame, settings: TagSettings) -> tuple[TagMonitor, TagsAtRest | None]:
    moving = (*monitor.moving, usable_frame(frame))[-REST:]
    going_on = TagMonitor(before=monitor.before, moving=moving)
    if len(moving) < REST:
        return going_on, None
    share = settings.constant_share
    # What stays of the detections' errors is common to both halves: only the rest may make them differ.
    first, second = (average_tags(half, 0.0) for half in (moving[: REST // 2], moving[REST // 2 :]))
    between = tag_motion(first, second)
    if between is None or between.chi2 > float(chdtri(6, REST_P)):
        return going_on, None
    motion = tag_motion(monitor.before, average_tags(moving, share))
    if motion is None:
        return going_on, None
    detector = restart_detector(TagMoveDetector(recent=moving), len(moving), settings)
    return TagMonitor(detector), TagsAtRest(motion.camera_new_T_camera_old, motion.covariance)
