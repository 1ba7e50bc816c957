"""Whether the fibre is held still: a hand trembles, a detection is noisy, and neither is a motion."""

from __future__ import annotations

import numpy as np

from fgreg.geometry.transforms import FloatArray, log_so3
from fgreg.model.time_sync import PoseHistory

STILL_S = 0.35
"""Held still means for so long."""
STILL_MM, STILL_RAD = 0.8, 0.02
"""And by no more than this from the middle."""
FEWEST = 4


def held_pose(poses: PoseHistory, now_s: float, over_s: float = STILL_S) -> FloatArray | None:
    """Where the marker is held, ``camera_T_marker`` (4, 4): the pose nearest to the middle; None where it moves.

    Of the last ``over_s`` before ``now_s``, in which there have to be poses from near its beginning to near its end.
    """
    recent = poses.since(now_s - over_s)
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
    """Angle between two poses (4, 4)."""
    return float(np.linalg.norm(log_so3(first[:3, :3].T @ second[:3, :3])))


def moved_mm(first: FloatArray, second: FloatArray) -> float:
    """Distance between the origins of two poses (4, 4)."""
    return float(np.linalg.norm(first[:3, 3] - second[:3, 3]))
