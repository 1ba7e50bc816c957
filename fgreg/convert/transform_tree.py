"""Poses of one coordinate frame in another through a tree of transforms (``/tf``, ``/tf_static`` of ROS)."""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fgreg.drivers.ros_messages import pose_of, stamp_ns
from fgreg.drivers.ros_recordings import Recorded
from fgreg.errors import InputError
from fgreg.geometry.quaternions import turn_about_x
from fgreg.geometry.transforms import FloatArray, inverse
from fgreg.model.time_sync import PairRefused, interpolate

_MAX_DEPTH = 100


@dataclass(slots=True)
class _Edge:
    """Poses of a frame in its parent: in time order once sorted; one without a time where it is static."""

    parent: str
    static: bool
    poses: list[tuple[float, FloatArray]] = field(default_factory=list)
    problem: str = ""

    def at(self, t: float, gap_s: float) -> FloatArray | None:
        """``parent_T_child``, interpolated between two poses at most ``gap_s`` apart; None where there are none."""
        if self.static:
            return self.poses[-1][1]
        after = bisect.bisect_left(self.poses, t, key=lambda entry: entry[0])
        if after < len(self.poses) and self.poses[after][0] == t:
            return self.poses[after][1]
        if not 0 < after < len(self.poses) or self.poses[after][0] - self.poses[after - 1][0] > gap_s:
            return None
        (t0, a), (t1, b) = self.poses[after - 1], self.poses[after]
        return interpolate(a, b, (t - t0) / (t1 - t0))[0]


class TransformTree:
    """Frames, each with one parent.

    Args:
        name: of the recording, for messages.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._edges: dict[str, _Edge] = {}

    def add_message(self, message: Any, recorded: Recorded, start_ns: int, by_header: bool) -> list[str]:
        """Add the transforms of a message (metres become mm); returns what is wrong with those that are not taken."""
        static = recorded.topic.rpartition("/")[2] == "tf_static"
        problems = []
        for transform in message.transforms:
            time_ns = stamp_ns(transform, recorded.bag_ns) if by_header else recorded.bag_ns
            parent, child = str(transform.header.frame_id), str(transform.child_frame_id)
            try:
                self.add(parent, child, (time_ns - start_ns) / 1e9, pose_of(transform)[0], static=static)
            except ValueError as error:
                problems.append(f"{child} in {parent}: {error}")
        return problems

    def add(self, parent: str, child: str, t: float, parent_T_child: FloatArray, *, static: bool) -> None:
        """Add a transform (mm) at a time (s). A static one holds at all times, and the last one sent counts."""
        parent, child = parent.lstrip("/"), child.lstrip("/")
        edge = self._edges.setdefault(child, _Edge(parent, static))
        if edge.parent != parent:
            edge.problem = f"{edge.parent} and {parent}, both as its parent"
        elif edge.static != static:
            edge.problem = "it on /tf and on /tf_static"
        else:
            edge.poses.append((t, parent_T_child))

    def angles_deg(self, target: str, source: str, gap_s: float) -> list[tuple[float, float]]:
        """Turns (deg) of ``source`` about the x axis of ``target``, as :meth:`poses`.

        Raises:
            InputError: as :meth:`poses`, or a turn about another axis.
        """
        found = []
        for t, pose in self.poses(target, source, gap_s):
            try:
                found.append((t, math.degrees(turn_about_x(pose[:3, :3]))))
            except ValueError as error:
                where = f"{self._name}: {source} in {target}"
                raise InputError(where, str(error), "a rotation of the probe about its x axis") from None
        return found

    def poses(self, target: str, source: str, gap_s: float) -> list[tuple[float, FloatArray]]:
        """``target_T_source`` (mm) at each time at which a transform between them was sent, in time order.

        The other transforms on the way are interpolated to that time; where one has no two poses within ``gap_s``
        around it, there is no pose.

        Raises:
            InputError: a frame that is not there or has two parents, two frames that are not connected, or only static
                transforms between them.
        """
        target, source = target.lstrip("/"), source.lstrip("/")
        to_root = [self._chain(frame) for frame in (target, source)]
        shared = next((frame for frame in to_root[0] if frame in to_root[1]), None)
        where = f"{self._name}: {source} in {target}"
        if shared is None:
            found = f"frames that are not connected ({' < '.join(to_root[0])}; {' < '.join(to_root[1])})"
            raise InputError(where, found, "one tree of transforms")
        down, up = (self._edges_below(chain, shared) for chain in to_root)
        times: set[float] = set()
        for edge in (*down, *up):
            if edge.problem:
                raise InputError(f"{where}: a frame below {edge.parent}", edge.problem, "one parent: a tree")
            if not edge.static:
                edge.poses.sort(key=lambda entry: entry[0])
                times.update(t for t, _ in edge.poses)
        if not times:
            raise InputError(where, "static transforms only", "one that moves with what is tracked")
        found_poses = []
        for t in sorted(times):
            try:
                pose = inverse(_product(down, t, gap_s)) @ _product(up, t, gap_s)
            except PairRefused:
                continue
            found_poses.append((t, pose))
        return found_poses

    def _chain(self, frame: str) -> list[str]:
        """A frame and those above it."""
        if frame not in self._edges and all(edge.parent != frame for edge in self._edges.values()):
            there = ", ".join(sorted({*self._edges, *(edge.parent for edge in self._edges.values())})) or "none"
            raise InputError(f"{self._name}: tf", f"no frame {frame}", f"one of {there}"[:300])
        chain = [frame]
        while chain[-1] in self._edges:
            chain.append(self._edges[chain[-1]].parent)
            if chain[-1] in chain[:-1] or len(chain) > _MAX_DEPTH:
                raise InputError(f"{self._name}: frame {frame}", "a circle of parents", "a tree of transforms")
        return chain

    def _edges_below(self, chain: list[str], top: str) -> list[_Edge]:
        """The edges from ``top`` down to the first frame of a chain."""
        return [self._edges[frame] for frame in reversed(chain[: chain.index(top)])]


def _product(edges: list[_Edge], t: float, gap_s: float) -> FloatArray:
    pose: FloatArray = np.eye(4)
    for edge in edges:
        step = edge.at(t, gap_s)
        if step is None:
            raise PairRefused(f"there is no transform below {edge.parent} at {t:.3f} s")
        pose = pose @ step
    return pose
