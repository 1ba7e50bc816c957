"""What the messages of a recording say of themselves, held against each other: coordinate frames, stamps, units.

What cannot be is refused, what is doubtful is told. ROS's poses and points are in metres, its angles in radians.
"""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from fgreg.errors import InputError

FIXED_FRAMES = frozenset({"map", "world", "odom", "earth", "base", "base_link", "base_footprint"})
"""ROS's usual names of frames that no camera has."""
MOST_M = {"marker": 5.0, "ecm": 20.0, "look": 1.0}
"""Median distances above these are not in metres."""
FULL_TURN_DEG = 360.0
SMALL_DEG = 1.6
"""Stage angles that are all smaller than this may be in radians."""
CLOCKS_S = 1.0
"""Stamps of two topics that differ by more than this, against the times of recording, are of two clocks."""


@dataclass(slots=True)
class TopicClaims:
    """Headers of one topic's messages, in the order of recording."""

    topic: str
    count: int = 0
    unstamped: int = 0
    backwards: int = 0
    late_ns: list[int] = field(default_factory=list)
    frames: Counter[tuple[str, str]] = field(default_factory=Counter)
    _last_ns: int = 0

    def add(self, message: Any, bag_ns: int) -> str | None:
        """Count a message; why it is not like the first one, None where it is."""
        self.count += 1
        header = getattr(message, "header", None)
        if header is None:
            return None
        stamp_ns = int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
        if stamp_ns <= 0:
            self.unstamped += 1
        else:
            self.backwards += stamp_ns < self._last_ns
            self._last_ns = stamp_ns
            self.late_ns.append(bag_ns - stamp_ns)
        own = str(header.frame_id), str(getattr(message, "child_frame_id", ""))
        self.frames[own] += 1
        first = next(iter(self.frames))
        if any(a and b and a != b for a, b in zip(own, first, strict=True)):
            return (
                f"{' of '.join(filter(None, own[::-1]))} is another frame than {' of '.join(filter(None, first[::-1]))}"
            )
        return None

    @property
    def frame(self) -> str:
        """The frame of the first message that names one."""
        return next((frame for frame, _ in self.frames if frame), "")


def told_of_stamps(claims: Iterable[TopicClaims]) -> list[str]:
    """Sentences about headers' times; only where these are used."""
    told, late_s = [], dict[str, float]()
    for topic in claims:
        if topic.unstamped:
            text = f"{topic.unstamped} of {topic.count} messages on {topic.topic} have no stamp"
            told.append(f"{text}: the time of their recording is taken")
        if topic.backwards:
            told.append(f"stamps on {topic.topic} go back {topic.backwards} times")
        if topic.count:
            late_s[topic.topic] = statistics.median(topic.late_ns) / 1e9 if topic.late_ns else 0.0
    if late_s:
        early, late = min(late_s, key=late_s.__getitem__), max(late_s, key=late_s.__getitem__)
        if late_s[late] - late_s[early] > CLOCKS_S:
            text = f"against the times of recording, stamps on {late} are {late_s[late] - late_s[early]:.3f} s behind"
            told.append(
                f"{text} those on {early}: two clocks? clock: recorder in the mapping takes the times of recording"
            )
    return told


def told_of_frames(roles: Mapping[str, TopicClaims]) -> list[str]:
    """Sentences about the frames that poses are stated in; by role."""
    marker = roles.get("marker")
    if marker is None or not marker.frame:
        return []
    what = f"marker poses on {marker.topic} are stated in frame {marker.frame!r}"
    for role in ("left", "left_info"):
        if role in roles and roles[role].frame not in ("", marker.frame):
            return [
                f"{what}, the left camera's images in {roles[role].frame!r}: they are taken as in the camera's frame"
            ]
    if marker.frame.lower().rpartition("/")[2] in FIXED_FRAMES:
        return [f"{what}, which is no camera's: they are taken as in the left camera's frame"]
    return []


def check_metres(role: str, topic: str, distances_mm: Sequence[float]) -> None:
    """Raises InputError where a topic's lengths, converted from metres, are none."""
    middle_m = statistics.median(distances_mm) / 1000.0 if distances_mm else 0.0
    if middle_m > MOST_M[role]:
        found = f"distances of {middle_m:.4g} m"
        raise InputError(topic, found, f"metres, as ROS has them: at most {MOST_M[role]:g} m. Are they in mm?")


def told_of_angles(topic: str, scans_deg: Sequence[float], unit: str, mapped: bool) -> list[str]:
    """Sentences about stage angles that were read in ``unit``, in ``mapped`` as the mapping says.

    Raises:
        InputError: more than a turn.
    """
    most = max(map(abs, scans_deg), default=0.0)
    if unit == "rad" and most > FULL_TURN_DEG:
        found = f"an angle of {most:.4g} deg"
        raise InputError(topic, found, "radians; or scan.unit: deg in the mapping")
    if unit == "deg" and not mapped and 0.0 < most < SMALL_DEG:
        return [
            f"stage angles on {topic} are all within {most:.3g} deg: scan.unit: rad in the mapping, if they are radians"
        ]
    return []
