"""Whether the fibre is held still, and seen. The hand's tremor and the detection's noise do not count as motion."""

from __future__ import annotations

import numpy as np

from fgreg.geometry.transforms import FloatArray, log_so3
from fgreg.model.time_sync import PoseHistory

STILL_S = 0.35
"""The fibre is held still once it has been within the limits for this long."""
STILL_MM, STILL_RAD = 0.8, 0.02
"""Largest distance and rotation from the median pose."""
FEWEST = 4
"""Least number of poses."""
SLOW_S = 2.0
"""Where fewer than that come in ``STILL_S``, the last ones count up to this long: a slow machine has few frames."""

NOT_SEEN = "the marker is not seen"
NO_PICTURE = "no new picture was looked at"
UNSEEN_S = 2.0
"""The marker is not seen once its newest pose is older; a slow machine has two frames a second."""


def unseen(poses: PoseHistory, pictured_s: float, now_s: float) -> str:
    """Why there is no recent pose of the marker; empty if there is one.

    ``pictured_s``: host time of the newest picture that was looked at. Without one the marker may well be in view.
    """
    newest = poses.newest()
    if newest is not None and now_s - newest.t_s <= UNSEEN_S:
        return ""
    return NOT_SEEN if now_s - pictured_s <= UNSEEN_S else NO_PICTURE


def held_pose(poses: PoseHistory, now_s: float, over_s: float = STILL_S) -> FloatArray | None:
    """Pose at which the marker is held, ``camera_T_marker`` (4, 4): the one nearest to the median; None if it moves.

    Uses the poses of the last ``over_s`` before ``now_s``; they have to span most of that time.
    """
    recent = poses.since(now_s - over_s)
    if len(recent) < FEWEST and len(slow := poses.since(now_s - SLOW_S)[-FEWEST:]) == FEWEST:
        recent, over_s = slow, max(over_s, now_s - slow[0].t_s)
    if len(recent) < FEWEST or now_s - recent[-1].t_s > 0.5 * over_s or recent[0].t_s > now_s - 0.5 * over_s:
        return None
    points = np.stack([pose.parent_T_child[:3, 3] for pose in recent])
    middle = np.median(points, axis=0)
    away = np.linalg.norm(points - middle, axis=1)
    held = recent[int(np.argmin(away))].parent_T_child
    if away.max() > STILL_MM or any(turned_rad(held, pose.parent_T_child) > STILL_RAD for pose in recent):
        return None
    return held


def turned_rad(first: FloatArray, second: FloatArray) -> float:
    """Rotation angle between two poses (4, 4)."""
    return float(np.linalg.norm(log_so3(first[:3, :3].T @ second[:3, :3])))


def moved_mm(first: FloatArray, second: FloatArray) -> float:
    """Distance between the origins of two poses (4, 4)."""
    return float(np.linalg.norm(first[:3, 3] - second[:3, 3]))
