"""Static tags (board, markers fixed to the patient or table): whether the camera moved against them, and how.

All static tags move by one and the same rigid motion when the camera does: ``camera_new_T_tag =
camera_new_T_camera_old * camera_old_T_tag``. A tag that goes its own way was bumped or misread. The motion is tested
by its chi square of 6 degrees of freedom, given the covariance of the detections on both sides, averaged over frames.

Detection errors are not independent from frame to frame: a share of their variance (lens, print, view) stays while
nothing moves. Averaging n frames leaves ``share + (1 - share) / n`` of the variance, on either side of the comparison.
Errors common to all tags look like a motion; nothing here can tell them from one.

While a camera is being moved, frames show it anywhere on its way. So an alarm only ends the epoch, which makes the
estimate say that it has no registration; the motion that ties the new epoch to the old one is measured on frames that
agree with each other, against the reference of before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtri

from fgreg.camera_moves.view_shift import view_shift_mm
from fgreg.geometry.transforms import BoolArray, FloatArray, adjoint, exp_so3, inverse, log_so3, make_transform
from fgreg.model.measurements import POSE_FLOOR, usable_covariance

TAG_P = 1e-3
"""A tag that fits a common motion worse than this goes its own way."""
ROUNDS = 4
REST = 6
"""Frames at rest that a motion is measured on."""
REST_P = 0.05
"""Two halves of these differ by more than chance has it with this probability: then it is not sure to rest yet."""


SHAKING = np.diag(np.square([0.0005] * 3 + [0.05] * 3))
"""Added to the covariance of poses in pictures (rad, mm): what shakes, and light that changes."""
MOVE_MM, MOVE_RAD, MOVE_SHARE = 0.1, 0.001, 0.01
"""Standard deviations of a measured move, and their part in proportion to it: errors of the lens' model and of the
detection that are not the same on both sides of it."""


@dataclass(frozen=True, slots=True, eq=False)
class TagPose:
    """One tag, averaged over frames: camera_T_tag (4, 4), covariance (6, 6) right tangent, frames that saw it."""

    camera_T_tag: FloatArray
    covariance: FloatArray
    frames: int


@dataclass(frozen=True, slots=True, eq=False)
class TagFrame:
    """Static tags seen in one frame, by id: camera_T_tag (4, 4), and covariance (6, 6) of the right tangent."""

    camera_T_tag: Mapping[int, FloatArray]
    covariance: Mapping[int, FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class TagMotion:
    """The common rigid motion of tags.

    Attributes:
        camera_new_T_camera_old: (4, 4).
        covariance: (6, 6) of its right tangent.
        chi2: of no motion, 6 degrees of freedom.
        tags: ids that share the motion; apart: those that do not.
    """

    camera_new_T_camera_old: FloatArray
    covariance: FloatArray
    chi2: float
    tags: tuple[int, ...]
    apart: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class TagSettings:
    """Settings of the tag monitor.

    Attributes:
        windows: numbers of last frames that are averaged, each tested.
        reference_frames: frames at the epoch's start (those first seen later: from then) that it is compared with.
        constant_share: of the detections' variance that stays from frame to frame.
        p: probability of an alarm, per test, while nothing moves.
        least_mm: a smaller shift of the view is no move.
    """

    windows: tuple[int, ...] = (3, 10)
    reference_frames: int = 50
    constant_share: float = 0.2
    p: float = 1e-5
    least_mm: float = 0.0

    def __post_init__(self) -> None:
        if not self.windows or min(self.windows) < 1 or self.reference_frames < 1:
            raise ValueError("windows and reference_frames have to be numbers of frames >= 1")
        if not 0.0 <= self.constant_share <= 1.0 or not 0.0 < self.p < 1.0:
            raise ValueError("constant_share and p have to be between 0 and 1")

    @property
    def threshold(self) -> float:
        """Chi square of an alarm."""
        return float(chdtri(6, self.p))

    def is_move(self, motion: TagMotion) -> bool:
        """Whether a motion is significant and large enough."""
        return motion.chi2 > self.threshold and view_shift_mm(motion.camera_new_T_camera_old) >= self.least_mm


def _difference(first: FloatArray, second: FloatArray) -> FloatArray:
    """(..., 6) right tangents from transforms (..., 4, 4) to others, rotation vector and translation apart."""
    between = inverse(first) @ second
    return np.concatenate([log_so3(between[..., :3, :3]), between[..., :3, 3]], axis=-1)


def usable_frame(frame: TagFrame) -> TagFrame:
    """The frame with covariances that can be inverted: a noise of zero counts as the smallest."""
    return TagFrame(frame.camera_T_tag, {tag: usable_covariance(c, POSE_FLOOR) for tag, c in frame.covariance.items()})


def average_tags(frames: Sequence[TagFrame], constant_share: float) -> dict[int, TagPose]:
    """Each tag's mean pose over the frames that saw it; a few misread ones are left out by their median."""
    out = {}
    limit = float(chdtri(6, TAG_P * 0.1))
    for tag in sorted({tag for frame in frames for tag in frame.camera_T_tag}):
        seen = [frame for frame in frames if tag in frame.camera_T_tag]
        poses = np.stack([frame.camera_T_tag[tag] for frame in seen])
        covariance = np.stack([frame.covariance[tag] for frame in seen])
        base = poses[0]
        for _ in range(2):  # the second time about the median, where a flipped first frame no longer matters
            base = _moved(base, np.median(_difference(base, poses), axis=0))
        steps = _difference(base, poses)
        good = np.einsum("na,nab,nb->n", steps, np.linalg.inv(covariance), steps) <= limit
        if 2 * good.sum() <= len(seen):
            continue
        count = int(good.sum())
        mean = covariance[good].mean(axis=0) * (constant_share + (1.0 - constant_share) / count)
        out[tag] = TagPose(_moved(base, steps[good].mean(axis=0)), mean, count)
    return out


def observed(poses: Mapping[int, tuple[FloatArray, FloatArray]]) -> TagFrame:
    """Poses (4, 4) and covariances (6, 6) in a picture, with what their detection does not know of."""
    return TagFrame(
        {tag: pose for tag, (pose, _) in poses.items()},
        {tag: covariance + SHAKING for tag, (_, covariance) in poses.items()},
    )


def turn_rad(motion: FloatArray) -> float:
    """Angle of a motion (4, 4)."""
    return float(np.linalg.norm(log_so3(motion[:3, :3])))


def move_covariance(motion: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariance (6, 6) of a measured move (4, 4), with what the tags' covariance does not know of."""
    rotation, shift = MOVE_RAD + MOVE_SHARE * turn_rad(motion), MOVE_MM + MOVE_SHARE * view_shift_mm(motion)
    return np.asarray(covariance + np.diag(np.square([rotation] * 3 + [shift] * 3)))


def _moved(transform: FloatArray, step: FloatArray) -> FloatArray:
    """A transform moved by a right tangent, rotation and translation apart as in :func:`_difference`."""
    return np.asarray(transform @ make_transform(exp_so3(step[:3]), step[3:]))


@dataclass(frozen=True, slots=True, eq=False)
class _Both:
    """T tags seen on both sides: poses (T, 4, 4), weights (T, 6, 6) of their differences, adjoints (T, 6, 6)."""

    old: FloatArray
    new: FloatArray
    weight: FloatArray
    turn: FloatArray

    def take(self, index: BoolArray) -> _Both:
        return _Both(self.old[index], self.new[index], self.weight[index], self.turn[index])

    def misfits(self, motion: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Errors (T, 6) and chi squares (T,) of the tags under a motion (4, 4)."""
        error = _difference(motion @ self.old, self.new)
        return error, np.einsum("ta,tab,tb->t", error, self.weight, error)

    def fit(self, start: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Least squares motion (4, 4) and its information (6, 6)."""
        motion = start
        weighted = np.swapaxes(self.turn, -1, -2) @ self.weight
        information = np.einsum("tab,tbc->ac", weighted, self.turn)
        for _ in range(ROUNDS):
            error, _ = self.misfits(motion)
            step = np.linalg.solve(information, np.einsum("tab,tb->a", weighted, error))
            motion = _moved(motion, np.asarray(step))
            if step @ information @ step < 1e-6:
                break
        return motion, information


def _both(old: Mapping[int, TagPose], new: Mapping[int, TagPose], tags: Sequence[int]) -> _Both:
    before = np.stack([old[tag].camera_T_tag for tag in tags])
    after = np.stack([new[tag].camera_T_tag for tag in tags])
    covariance = np.stack([old[tag].covariance + new[tag].covariance for tag in tags])
    turn = np.stack([adjoint(inverse(pose)) for pose in before])
    return _Both(before, after, np.asarray(np.linalg.inv(covariance)), turn)


def tag_motion(old: Mapping[int, TagPose], new: Mapping[int, TagPose]) -> TagMotion | None:
    """The motion that most tags seen on both sides share; None where no majority of them agrees."""
    tags = sorted(set(old) & set(new))
    if not tags:
        return None
    both, limit = _both(old, new, tags), float(chdtri(6, TAG_P))
    motion, information = both.fit(both.new[0] @ inverse(both.old[0]))
    together = both.misfits(motion)[1] <= limit
    if not together.all():
        found = _majority(both, limit)
        if found is None:
            return None
        motion, information, together = found
    step = _difference(np.eye(4), motion)
    return TagMotion(
        motion,
        np.asarray(np.linalg.inv(information)),
        float(step @ information @ step),
        tuple(tag for tag, good in zip(tags, together, strict=True) if good),
        tuple(tag for tag, good in zip(tags, together, strict=True) if not good),
    )


def _majority(both: _Both, limit: float) -> tuple[FloatArray, FloatArray, BoolArray] | None:
    """Motion, its information, and the tags that share it.

    Each candidate (no motion, and each tag's own motion) is fitted to the tags near it; the one that most tags agree
    with is used. None without a majority.
    """
    best: tuple[int, float, FloatArray] | None = None
    for start in (np.eye(4), *(both.new @ inverse(both.old))):
        inside = both.misfits(start)[1] <= 2.0 * limit
        if not inside.any():
            continue
        motion, _ = both.take(inside).fit(start)
        misfit = both.misfits(motion)[1]
        score = int(np.sum(misfit <= limit)), -float(np.minimum(misfit, limit).sum())
        if best is None or score > best[:2]:
            best = (*score, motion)
    if best is None or 2 * best[0] <= len(both.old):
        return None
    together = both.misfits(best[2])[1] <= limit
    motion, information = both.take(together).fit(best[2])
    return motion, information, together


@dataclass(frozen=True, slots=True, eq=False)
class TagMoveDetector:
    """Frames of the epoch's start with the tags' mean poses in them, and the last frames."""

    reference: tuple[TagFrame, ...] = ()
    recent: tuple[TagFrame, ...] = ()
    means: Mapping[int, TagPose] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class TagCheck:
    """Result of one more frame: whether the camera moved, its motion (None where the tags do not agree on one), and how
    many of the last frames came after it."""

    alarm: bool
    motion: TagMotion | None
    frames: int


def _part_wanted(reference: Sequence[TagFrame], frame: TagFrame, most: int) -> TagFrame:
    """A frame's tags of which the reference holds fewer than ``most`` poses."""
    wanted = [tag for tag in frame.camera_T_tag if sum(tag in old.camera_T_tag for old in reference) < most]
    return TagFrame({t: frame.camera_T_tag[t] for t in wanted}, {t: frame.covariance[t] for t in wanted})


def detect_tag_move(
    detector: TagMoveDetector, frame: TagFrame, settings: TagSettings
) -> tuple[TagMoveDetector, TagCheck]:
    """Take in a frame and test. After an alarm the caller goes on from :func:`detector_from`."""
    longest = max(settings.windows)
    recent = (*detector.recent, usable_frame(frame))
    reference, means = detector.reference, detector.means
    if len(recent) > longest:
        fresh = _part_wanted(reference, recent[0], settings.reference_frames)
        if fresh.camera_T_tag:
            reference = (*reference, fresh)
            means = average_tags(reference, settings.constant_share)
        recent = recent[1:]
    detector = TagMoveDetector(reference, recent, means)
    best: TagCheck = TagCheck(False, None, 0)
    if not means:
        return detector, best
    for size in settings.windows:
        if size > len(recent):
            continue
        newest = average_tags(recent[-size:], settings.constant_share)
        motion = tag_motion(means, newest)
        if motion is None and _all_moved(means, newest, settings):
            return detector, TagCheck(True, None, size)
        if motion is None or (best.motion is not None and motion.chi2 <= best.motion.chi2):
            continue
        best = TagCheck(settings.is_move(motion), motion, size)
    return detector, best if best.alarm else _on_its_way(means, recent, settings) or best


def _all_moved(old: Mapping[int, TagPose], new: Mapping[int, TagPose], settings: TagSettings) -> bool:
    """Whether each of several tags shows a motion, though they do not agree on one."""
    both = set(old) & set(new)
    alone = [tag_motion({tag: old[tag]}, {tag: new[tag]}) for tag in both]
    return len(both) > 1 and all(motion is not None and settings.is_move(motion) for motion in alone)


def _on_its_way(means: Mapping[int, TagPose], recent: Sequence[TagFrame], settings: TagSettings) -> TagCheck | None:
    """An alarm where the last few frames do not agree with each other, and each of them shows a motion."""
    few = recent[-min(settings.windows) :]
    if len(few) < 2 or average_tags(few, settings.constant_share):
        return None
    motions = [tag_motion(means, average_tags([frame], settings.constant_share)) for frame in few]
    off = [motion for motion in motions if motion is not None and settings.is_move(motion)]
    return TagCheck(True, off[-1], len(few)) if len(off) == len(few) else None


def detector_from(frames: Sequence[TagFrame], settings: TagSettings) -> TagMoveDetector:
    """The detector of an epoch that begins with some frames."""
    return TagMoveDetector(tuple(frames), (), average_tags(frames, settings.constant_share))


# --- epochs by tags ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class TagsMoved:
    """The camera has moved: at ``since_t`` or a frame before."""

    since_t: float


@dataclass(frozen=True, slots=True, eq=False)
class TagsAtRest:
    """The camera is at rest again: its motion (4, 4) against the epoch before the alarm, its covariance (6, 6), and the
    chi square of no motion (6 degrees of freedom)."""

    camera_new_T_camera_old: FloatArray
    covariance: FloatArray
    chi2: float


@dataclass(frozen=True, slots=True, eq=False)
class TagMonitor:
    """State of the monitor between frames; it is never changed in place.

    Attributes:
        detector: of the current epoch.
        times: of its recent frames.
        before: mean poses of the epoch before, from an alarm until the camera is at rest.
        moving: frames since the alarm.
        last: result of the last frame, None while the camera moves.
    """

    detector: TagMoveDetector = field(default_factory=TagMoveDetector)
    times: tuple[float, ...] = ()
    before: Mapping[int, TagPose] = field(default_factory=dict)
    moving: tuple[TagFrame, ...] = ()
    last: TagCheck | None = None

    @property
    def is_moving(self) -> bool:
        """Whether there was an alarm whose motion is not measured yet."""
        return bool(self.before)


def monitored(
    monitor: TagMonitor, t: float, frame: TagFrame, settings: TagSettings
) -> tuple[TagMonitor, TagsMoved | TagsAtRest | None]:
    """Take in one frame: an alarm comes at once, the motion as soon as the camera is at rest again."""
    if monitor.is_moving:
        return _until_rest(monitor, frame, settings)
    detector, check = detect_tag_move(monitor.detector, frame, settings)
    times = (*monitor.times, t)[-len(detector.recent) :]
    if not check.alarm:
        return TagMonitor(detector, times, last=check), None
    since = times[-min(check.frames, len(times))]
    return TagMonitor(before=detector.means, moving=(usable_frame(frame),)), TagsMoved(since)


def _until_rest(monitor: TagMonitor, frame: TagFrame, settings: TagSettings) -> tuple[TagMonitor, TagsAtRest | None]:
    moving = (*monitor.moving, usable_frame(frame))[-REST:]
    going_on = TagMonitor(before=monitor.before, moving=moving)
    if len(moving) < REST:
        return going_on, None
    # What stays of the detections' errors is common to both halves: only the rest may make them differ.
    first, second = (average_tags(half, 0.0) for half in (moving[: REST // 2], moving[REST // 2 :]))
    between = tag_motion(first, second)
    if between is None or between.chi2 > float(chdtri(6, REST_P)):
        return going_on, None
    motion = tag_motion(monitor.before, average_tags(moving, settings.constant_share))
    if motion is None:
        return going_on, None
    at_rest = TagsAtRest(motion.camera_new_T_camera_old, motion.covariance, motion.chi2)
    return TagMonitor(detector_from(moving, settings)), at_rest
