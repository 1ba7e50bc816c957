"""Pairs by time: the marker pose at the moment of the laser pulse, on one clock for all devices.

Marker poses come from a camera, laser pulses from the ultrasound side. Each device stamps with its own clock, and the
host adds the time of arrival. :class:`DeviceClock` converts a device's time to the host's clock. :func:`pose_at`
interpolates marker poses to a pulse and refuses where the poses around it are too far apart.

Host times are seconds of ``time.monotonic()``: one clock for all processes of a machine, which no one sets.
"""

import itertools
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from fgreg.geometry.transforms import FloatArray, exp_so3, hat, log_so3, make_transform
from fgreg.schema.kinds import Number
from fgreg.schema.record import Key

MAX_GAP_S = 0.1
"""Longest time between two poses that are interpolated (three frames at 30 frames/s)."""
UNSTEADY_MM_S2, UNSTEADY_RAD_S2 = 300.0, 3.0
"""Sigmas of the acceleration of a hand-held fibre between two poses: a tremor of 0.1 mm and 1 mrad at 9 Hz."""
_LATENCY = Number(0.0, 1.0, unit="s")
HELD_GAP_S = 0.7
"""The same where the fibre is held still, with a machine too slow for more frames."""
NEAR_S, FEWEST_NEAR, SCATTERS = 1.5, 4, 2.0
"""How near in time the poses are that show how steady the hand is, how many are needed, and how much they count."""
CLOCK_MEMORY = 256
"""Number of stamps over which a device's clock is compared with the host's."""


@dataclass(frozen=True, slots=True)
class Stamp:
    """Times of an event: ``device_s`` by the device's clock, ``host_s`` of its arrival at the host.

    A device without a clock stamps both with the host's.
    """

    device_s: float
    host_s: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.device_s) and math.isfinite(self.host_s)):
            raise ValueError(f"times are {self.device_s} and {self.host_s}, expected two finite numbers")


@dataclass(slots=True)
class DeviceClock:
    """A device's time on the host's clock, from the stamps it sends.

    Transmission only delays, so the smallest of the recent ``host - device`` differences is nearest to the offset of
    the clocks. Jitter has no effect, and a drift is followed. ``latency_s`` is the shortest time from event to arrival,
    where it is known.
    """

    latency_s: float = 0.0
    _offsets: deque[float] = field(default_factory=lambda: deque(maxlen=CLOCK_MEMORY))
    _last_device_s: float = -math.inf

    def host_time(self, stamp: Stamp) -> float:
        """Host time (s) of the event itself; takes the stamp into account.

        A device time that goes back starts again: the device was switched off and on. One that jumps ahead is the
        smallest difference at once. A single delayed message has no effect.
        """
        if stamp.device_s < self._last_device_s:
            self._offsets.clear()
        self._last_device_s = stamp.device_s
        self._offsets.append(stamp.host_s - stamp.device_s)
        return stamp.device_s + min(self._offsets) - self.latency_s


@dataclass(frozen=True, slots=True)
class Latencies:
    """Shortest times from event to arrival at the host (s), where they were measured: a grabber delays a picture by
    some frames, a scanner's packet comes after its pulse. Their difference shifts the marker pose at a pulse."""

    camera_s: Annotated[float, Key("from exposure to arrival, at best", _LATENCY, name="camera_latency_s")] = 0.0
    pulse_s: Annotated[float, Key("from laser pulse to arrival, at best", _LATENCY, name="pulse_latency_s")] = 0.0
    holder_s: Annotated[float, Key("the same of motion's samples", _LATENCY, name="holder_latency_s")] = 0.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(value) and value >= 0 for value in (self.camera_s, self.pulse_s, self.holder_s)):
            raise ValueError(f"latencies are {self.camera_s}, {self.pulse_s}, {self.holder_s} s, expected 0 or more")


@dataclass(frozen=True, slots=True, eq=False)
class TimedPose:
    """A pose at a host time: ``parent_T_child`` (4, 4) and its covariance (6, 6), right tangent (rad, mm)."""

    t_s: float
    parent_T_child: FloatArray
    covariance: FloatArray


class PairRefused(Exception):  # noqa: N818
    """There is no pose for this moment; the text says why, with the figures."""


def pose_at(poses: Sequence[TimedPose], t_s: float, max_gap_s: float = MAX_GAP_S) -> TimedPose:
    """The pose at a time, between the pose before and the pose after.

    The rotation is interpolated along its geodesic, the origin along a straight line: a body of constant angular
    velocity whose origin has constant velocity. The covariance is propagated from both ends, taken as independent: half
    way between two equal ones it is half of either, as for the mean of two detections. An acceleration a between the
    poses is added: it moves the body off the straight line by ``a gap^2 s (1 - s) / 2`` at share s. Where that is more
    than the poses of the time about it scatter, ``SCATTERS`` times their scatter is added: a hand that is held trembles
    between the frames of a slow camera as it does from one to the next.

    Args:
        poses: in time order.
        t_s: the moment, host time.
        max_gap_s: longest time between the two poses used. There is no extrapolation.

    Raises:
        PairRefused: no pose on one side, or the two are farther apart than ``max_gap_s``.
        ValueError: poses out of order.
    """
    before, after, share = _bracket([pose.t_s for pose in poses], t_s, max_gap_s)
    first, second = poses[before], poses[after]
    if before == after:
        return first
    gap = second.t_s - first.t_s
    transform, from_first, from_second = interpolate(first.parent_T_child, second.parent_T_child, share)
    covariance = from_first @ first.covariance @ from_first.T + from_second @ second.covariance @ from_second.T
    off = 0.5 * gap * gap * share * (1.0 - share)
    turn, way = UNSTEADY_RAD_S2 * off, UNSTEADY_MM_S2 * off
    if gap > MAX_GAP_S:
        near = [pose.parent_T_child for pose in poses if abs(pose.t_s - t_s) < NEAR_S]
        if len(near) >= FEWEST_NEAR:
            scatter_rad, scatter_mm = _scatter(near)
            turn, way = min(turn, SCATTERS * scatter_rad), min(way, SCATTERS * scatter_mm)
    covariance += np.diag(np.repeat([turn**2, way**2], 3))
    return TimedPose(t_s, transform, np.asarray(0.5 * (covariance + covariance.T)))


def _scatter(poses: Sequence[FloatArray]) -> tuple[float, float]:
    """Standard deviation per axis of poses (4, 4) about their mean: rotation, rad, and origin, mm."""
    turns = np.stack([log_so3(poses[0][:3, :3].T @ pose[:3, :3]) for pose in poses])
    origins = np.stack([pose[:3, 3] for pose in poses])
    rad, mm = (np.sqrt(np.square(v - v.mean(axis=0)).sum() / (3.0 * (len(v) - 1))) for v in (turns, origins))
    return float(rad), float(mm)


def _bracket(times: Sequence[float], t_s: float, max_gap_s: float) -> tuple[int, int, float]:
    """Indices before and after a moment, and its share of the interval; the same index twice for an exact match."""
    if any(later < earlier for earlier, later in itertools.pairwise(times)):
        raise ValueError("marker poses are not in time order")
    if not math.isfinite(t_s):
        raise PairRefused(f"the pulse's time is {t_s}")
    after = int(np.searchsorted(times, t_s, side="left"))
    if after < len(times) and times[after] == t_s:
        return after, after, 0.0
    if not times:
        raise PairRefused("no marker pose at all")
    if after == 0 or after == len(times):
        side, nearest = ("before", times[0]) if after == 0 else ("after", times[-1])
        raise PairRefused(f"no marker pose {side} the pulse: the nearest is {1e3 * abs(nearest - t_s):.0f} ms away")
    gap = times[after] - times[after - 1]
    if gap > max_gap_s:
        raise PairRefused(
            f"the marker poses around the pulse are {1e3 * gap:.0f} ms apart, at most {1e3 * max_gap_s:.0f} ms allowed"
        )
    return after - 1, after, (t_s - times[after - 1]) / gap


def interpolate(p_T_a: FloatArray, p_T_b: FloatArray, share: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Between two transforms (4, 4) at ``share`` in [0, 1], with derivatives by both, right tangents, (6, 6) each.

    Rotation ``R = Ra Exp(s w)``, ``w = Log(Ra' Rb)``; origin ``t = (1 - s) ta + s tb``. By the right Jacobian Jr of
    the rotation's exponential, with ``Q = Exp(s w)``:

        dR/da = Q' - s Jr(s w) Jr(w)^-1 Exp(w)',    dR/db = s Jr(s w) Jr(w)^-1,
        dt/da = (1 - s) R' Ra,                      dt/db = s R' Rb.
    """
    a, b = p_T_a[:3, :3], p_T_b[:3, :3]
    turn = log_so3(a.T @ b)
    part = exp_so3(share * turn)
    rotation = a @ part
    by_b = share * _right_jacobian(share * turn) @ np.linalg.inv(_right_jacobian(turn))
    from_a, from_b = np.zeros((6, 6)), np.zeros((6, 6))
    from_a[:3, :3] = part.T - by_b @ exp_so3(turn).T
    from_b[:3, :3] = by_b
    from_a[3:, 3:] = (1.0 - share) * rotation.T @ a
    from_b[3:, 3:] = share * rotation.T @ b
    origin = (1.0 - share) * p_T_a[:3, 3] + share * p_T_b[:3, 3]
    return make_transform(rotation, origin), from_a, from_b


def _right_jacobian(w: FloatArray) -> FloatArray:
    """``Exp(w + d) = Exp(w) Exp(Jr(w) d)`` to first order; (3,) -> (3, 3)."""
    angle = float(np.linalg.norm(w))
    k = hat(w)
    if angle < 1e-5:
        return np.asarray(np.eye(3) - 0.5 * k + k @ k / 6.0)
    return np.asarray(
        np.eye(3) - (1.0 - math.cos(angle)) / angle**2 * k + (angle - math.sin(angle)) / angle**3 * (k @ k)
    )


@dataclass(slots=True)
class PoseHistory:
    """The recent poses of one body, oldest first, for :func:`pose_at`; ``keep_s`` bounds their age."""

    keep_s: float = 3.0
    _poses: deque[TimedPose] = field(default_factory=deque)

    def add(self, pose: TimedPose) -> bool:
        """Add a pose; False, and nothing added, where it is not later than the last one (a clock went back)."""
        if self._poses and pose.t_s <= self._poses[-1].t_s:
            return False
        self._poses.append(pose)
        while self._poses[0].t_s < pose.t_s - self.keep_s:
            self._poses.popleft()
        return True

    def clear(self) -> None:
        """Remove all poses: their frame or their clock has changed."""
        self._poses.clear()

    def newest(self) -> TimedPose | None:
        """The newest pose."""
        return self._poses[-1] if self._poses else None

    def since(self, t_s: float) -> tuple[TimedPose, ...]:
        """The poses from a time on, oldest first."""
        return tuple(pose for pose in self._poses if pose.t_s >= t_s)

    def at(self, t_s: float, max_gap_s: float = MAX_GAP_S) -> TimedPose:
        """:func:`pose_at` in this history."""
        return pose_at(tuple(self._poses), t_s, max_gap_s)

    def can_tell(self, t_s: float) -> bool:
        """Whether there is a pose at or after a time: before that, a refusal of :meth:`at` is not final."""
        return bool(self._poses) and self._poses[-1].t_s >= t_s
