"""Whether the camera moved, from tags that stand still: the board, markers on the table, the probe's mount.

Every frame's tag poses are compared with the mean of those since the epoch's start: one rigid motion
``camera_new_T_camera_old`` common to all tags is fitted (``camera_new_T_tag = camera_new_T_camera_old *
camera_old_T_tag``), and what it takes off the chi square is, while nothing moves, chi square of six degrees of freedom.
Several frames are averaged, for small moves; the last ones alone are looked at, too, for large moves at once.

What is assumed of the errors: they have the detections' covariances. A share of that variance (``drift_share``) changes
slowly (light, focus, temperature; correlated over ``drift_frames`` frames as exp(-lag / drift_frames)) and does not
average out in a few frames; the rest is new in every frame. Errors that stay the same as long as the camera does
(calibration of the camera, size of a tag) cancel, as only differences count; those of different tags are independent.
A tag that does not move as the others do is loose, and left out.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from fgreg.frames import FloatArray, adjoint, exp_so3, hat, inverse, make_transform
from fgreg.measurements import POSE_FLOOR, usable_covariance
from fgreg.posterior import pose_tangent

ROUNDS = 4
"""Gauss-Newton steps of the motion."""
MANY_FRAMES = 400


@dataclass(frozen=True, slots=True)
class TagSettings:
    """How to test.

    Attributes:
        windows: numbers of last frames that are averaged, increasing.
        least_reference: frames that the reference takes.
        drift_share, drift_frames: see the module's text.
        alarm_p: an alarm where chance alone would go so far this rarely, in each window of each frame.
        loose_p: a tag is loose where chance alone would have it so far from the others this rarely.
    """

    windows: tuple[int, ...] = (1, 3, 10)
    least_reference: int = 5
    drift_share: float = 0.2
    drift_frames: float = 30.0
    alarm_p: float = 3e-6
    loose_p: float = 1e-6

    def __post_init__(self) -> None:
        if not self.windows or self.windows[0] < 1 or any(np.diff(self.windows) <= 0):
            raise ValueError(f"windows are {self.windows}, expected increasing numbers of frames")
        if not 0.0 <= self.drift_share <= 1.0 or self.drift_frames <= 0.0:
            raise ValueError("drift_share has to be between 0 and 1, drift_frames positive")


@dataclass(frozen=True, slots=True, eq=False)
class TagTest:
    """What the last frames say.

    Attributes:
        alarm: whether the camera moved.
        chi2: what the common motion takes off the misfit, six degrees of freedom.
        frames: number of last frames averaged in what follows.
        camera_new_T_camera_old: (4, 4) the motion since the reference.
        covariance: (6, 6) of it, right tangent.
        loose: tags that do not move as the others do.
        contradictory: two tags disagree, and there is no third to tell which is loose.
    """

    alarm: bool
    chi2: float
    frames: int
    camera_new_T_camera_old: FloatArray
    covariance: FloatArray
    loose: tuple[int, ...]
    contradictory: bool = False


def exp_se3(tangent: FloatArray) -> FloatArray:
    """(4, 4) GTSAM's Expmap of a tangent (6,): rotation rad, translation mm."""
    w, v = tangent[:3], tangent[3:]
    angle = float(np.linalg.norm(w))
    k = hat(w)
    if angle < 1e-6:
        gain = np.eye(3) + 0.5 * k
    else:
        gain = np.eye(3) + (1 - math.cos(angle)) / angle**2 * k + (angle - math.sin(angle)) / angle**3 * (k @ k)
    return make_transform(exp_so3(w), gain @ v)


def variance_of_mean(frames: int, settings: TagSettings) -> float:
    """Variance of the mean of so many frames' errors in a row, over that of one."""
    lag = np.arange(1, frames)
    together = frames + 2.0 * float(np.sum((frames - lag) * np.exp(-lag / settings.drift_frames)))
    return settings.drift_share * together / frames**2 + (1.0 - settings.drift_share) / frames


@dataclass(slots=True, eq=False)
class _Tag:
    """One tag: its first pose, what a motion does to tangents there (6, 6), and sums over the reference's frames."""

    anchor: FloatArray
    jacobian: FloatArray
    count: int
    total: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Sight:
    """One tag in one frame: tangent (6,) from its anchor, covariance (6, 6)."""

    tangent: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Differences:
    """T tags then and now.

    Attributes:
        ids: which.
        anchor, jacobian: (T, 4, 4), (T, 6, 6) as of :class:`_Tag`.
        then, now: (T, 6) tangents from the anchors.
        information: (T, 6, 6) of their differences.
    """

    ids: tuple[int, ...]
    anchor: FloatArray
    jacobian: FloatArray
    then: FloatArray
    now: FloatArray
    information: FloatArray

    def without(self, at: int) -> _Differences:
        rest = np.arange(len(self.ids)) != at
        ids = tuple(name for name, keep in zip(self.ids, rest, strict=True) if keep)
        return _Differences(ids, *(getattr(self, name)[rest] for name in _Differences.__slots__[1:]))

    def poses(self) -> tuple[list[FloatArray], list[FloatArray]]:
        """camera_T_tag then and now."""
        then = [anchor @ exp_se3(tangent) for anchor, tangent in zip(self.anchor, self.then, strict=True)]
        now = [anchor @ exp_se3(tangent) for anchor, tangent in zip(self.anchor, self.now, strict=True)]
        return then, now


@dataclass(frozen=True, slots=True, eq=False)
class _Motion:
    """Motion (4, 4) common to tags, its information (6, 6) over the right tangent, misfit there and without it."""

    camera_new_T_camera_old: FloatArray
    information: FloatArray
    misfit: float
    still: float


class StaticTagsWatch:
    """Watches static tags frame by frame. State: the reference, and the last frames."""

    def __init__(self, settings: TagSettings | None = None) -> None:
        self.settings = settings or TagSettings()
        self._limit = float(chdtri(6, self.settings.alarm_p))
        self._means: dict[int, float] = {}
        self.reset()

    def reset(self) -> None:
        """Begin a new reference: at an epoch's start."""
        self._tags: dict[int, _Tag] = {}
        self._recent: deque[dict[int, _Sight]] = deque()
        self.frames = 0

    def add(self, camera_T_tag: Mapping[int, FloatArray], covariance: Mapping[int, FloatArray]) -> TagTest | None:
        """One frame more; None while there are too few for a reference.

        Args:
            camera_T_tag: (4, 4) poses of the tags seen, by id.
            covariance: (6, 6) of each, right tangent.

        Raises:
            ValueError: a pose without a covariance, or a number that is not finite; nothing is taken in then.
        """
        for name, pose in camera_T_tag.items():
            if name not in covariance:
                raise ValueError(f"tag {name} has no covariance")
            if not (np.isfinite(pose).all() and np.isfinite(covariance[name]).all()):
                raise ValueError(f"the pose or covariance of tag {name} is not finite")
        frame: dict[int, _Sight] = {}
        for name, pose in camera_T_tag.items():
            if name not in self._tags:
                jacobian = adjoint(inverse(pose))
                self._tags[name] = _Tag(np.array(pose), jacobian, 0, np.zeros(6), np.zeros((6, 6)))
            spread = usable_covariance(covariance[name], POSE_FLOOR)
            frame[name] = _Sight(pose_tangent(self._tags[name].anchor, pose), spread)
        self.frames += 1
        self._recent.append(frame)
        if len(self._recent) > self.settings.windows[-1]:
            self._learn(self._recent.popleft())
        found = [test for size in self.settings.windows if (test := self._test(size)) is not None]
        alarms = [test for test in found if test.alarm]
        if alarms:
            return max(alarms, key=lambda test: test.chi2)
        return found[-1] if found else None

    def _learn(self, frame: Mapping[int, _Sight]) -> None:
        """Take a frame that has left the windows into the reference."""
        for name, sight in frame.items():
            tag = self._tags[name]
            tag.total = tag.total + sight.tangent
            tag.count += 1
            tag.covariance = tag.covariance + (sight.covariance - tag.covariance) / tag.count

    def _of_mean(self, frames: int) -> float:
        """:func:`variance_of_mean`; of very many frames as of some hundreds, which is more than it is."""
        frames = min(frames, MANY_FRAMES)
        if frames not in self._means:
            self._means[frames] = variance_of_mean(frames, self.settings)
        return self._means[frames]

    def _differences(self, size: int) -> _Differences | None:
        """The tags that have a reference and are in all of the last ``size`` frames; None where there is none."""
        recent = list(self._recent)[-size:]
        if len(recent) < size:
            return None
        names = [
            name
            for name in recent[0]
            if self._tags[name].count >= self.settings.least_reference and all(name in frame for frame in recent)
        ]
        if not names:
            return None
        tags = [self._tags[name] for name in names]
        now = np.array([[frame[name].tangent for frame in recent] for name in names]).mean(axis=1)
        spread = np.array([[frame[name].covariance for frame in recent] for name in names]).mean(axis=1)
        before = np.array([self._of_mean(tag.count) * tag.covariance for tag in tags])
        return _Differences(
            ids=tuple(names),
            anchor=np.array([tag.anchor for tag in tags]),
            jacobian=np.array([tag.jacobian for tag in tags]),
            then=np.array([tag.total / tag.count for tag in tags]),
            now=now,
            information=np.linalg.inv(self._of_mean(size) * spread + before),
        )

    def _test(self, size: int) -> TagTest | None:
        """The test over the last ``size`` frames; None where no tag has a reference and was seen in all of them."""
        tags = self._differences(size)
        if tags is None:
            return None
        loose: list[int] = []
        found = _fit_small(tags)
        contradictory = False
        while len(tags.ids) > 1 and found.misfit > (worst := float(chdtri(6 * (len(tags.ids) - 1), self.settings.loose_p))):
            found = _fit_large(tags)
            if found.misfit <= worst:
                break
            if len(tags.ids) == 2:
                contradictory = True
                break
            trials = [tags.without(at) for at in range(len(tags.ids))]
            fits = [_fit_large(trial) for trial in trials]
            best = int(np.argmin([fit.misfit for fit in fits]))
            loose.append(tags.ids[best])
            tags, found = trials[best], fits[best]
        chi2 = max(found.still - found.misfit, 0.0)
        alarm = chi2 > self._limit and not contradictory
        if alarm:
            found = _fit_large(tags)
        covariance = np.linalg.inv(found.information)
        return TagTest(alarm, chi2, size, found.camera_new_T_camera_old, covariance, tuple(loose), contradictory)


def _normal(tags: _Differences, error: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Information (6, 6) and right-hand side (6,) of the motion for errors (T, 6)."""
    weighted = tags.information @ tags.jacobian
    information = np.einsum("tba,tbc->ac", tags.jacobian, weighted)
    return np.asarray(information), np.asarray(np.einsum("tba,tb->a", weighted, error))


def _square(tags: _Differences, error: FloatArray) -> float:
    return float(np.einsum("ta,tab,tb->", error, tags.information, error))


def _fit_small(tags: _Differences) -> _Motion:
    """The common motion to first order: all that a test takes as long as nothing moves."""
    error = tags.now - tags.then
    information, pull = _normal(tags, error)
    step = np.linalg.solve(information, pull)
    left = error - tags.jacobian @ step
    return _Motion(exp_se3(step), information, _square(tags, left), _square(tags, error))


def _fit_large(tags: _Differences) -> _Motion:
    """The common motion by Gauss-Newton on the poses."""
    then, now = tags.poses()
    jacobian = np.array([adjoint(inverse(pose)) for pose in then])
    exact = replace(tags, jacobian=jacobian)

    def error_at(motion: FloatArray) -> FloatArray:
        return np.array([pose_tangent(motion @ old, new) for old, new in zip(then, now, strict=True)])

    motion = now[0] @ inverse(then[0])
    information = np.eye(6)
    for _ in range(ROUNDS):
        information, pull = _normal(exact, error_at(motion))
        step = np.linalg.solve(information, pull)
        motion = motion @ exp_se3(step)
        if step @ information @ step < 1e-8:
            break
    return _Motion(motion, information, _square(exact, error_at(motion)), _square(exact, error_at(np.eye(4))))
