"""Merges the looks at one spot into one PM. The hand trembles, so the beam's end moves while the stage turns.

The graph has one point per PM and one beam through it. So all looks share one marker observation, the mean over their
pulses, and the scatter of the beam's end about the mean is added to each look's noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.transforms import FloatArray, exp_so3, log_so3, make_transform
from fgreg.live.actions import LocatedPulse
from fgreg.model.time_sync import TimedPose

REACH_MM = 50.0
"""Lever arm along the beam that turns a rotation of the marker into a shift of the beam's end; spots are 20 to 80 mm
away."""
LEAST_SCATTER_MM = 0.05
"""Lower limit of the standard deviation of the beam's end."""


@dataclass(frozen=True, slots=True, eq=False)
class Spot:
    """Looks with one marker observation."""

    marker: TimedPose
    looks: tuple[LocatedPulse, ...]


def one_spot(looks: Sequence[LocatedPulse]) -> Spot:
    """Looks at one PM with a common marker observation.

    The mean pose gets the mean covariance of the poses, since their errors are strongly correlated. Each look's
    covariance (2, 2), mm^2, grows by the variance per axis of the beam's end about the mean.

    Raises:
        ValueError: no look, or one without a marker.
    """
    poses = [look.marker for look in looks if look.marker is not None]
    if not poses or len(poses) < len(looks):
        raise ValueError("a look without a marker")
    if len(poses) == 1:
        return Spot(poses[0], tuple(looks))
    first = poses[0].parent_T_child
    turns = np.stack([log_so3(first[:3, :3].T @ pose.parent_T_child[:3, :3]) for pose in poses])
    origins = np.stack([pose.parent_T_child[:3, 3] for pose in poses])
    mean = make_transform(first[:3, :3] @ exp_so3(turns.mean(axis=0)), origins.mean(axis=0))
    freedom = len(poses) - 1
    shift = float(np.square(origins - origins.mean(axis=0)).sum()) / (3.0 * freedom)
    turn = float(np.square(turns - turns.mean(axis=0)).sum()) / (3.0 * freedom)
    variance = max(shift + REACH_MM**2 * turn, LEAST_SCATTER_MM**2)
    covariance: FloatArray = np.mean([pose.covariance for pose in poses], axis=0)
    marker = TimedPose(float(np.mean([pose.t_s for pose in poses])), mean, covariance)
    return Spot(marker, tuple(_wider(look, variance) for look in looks))


def _wider(look: LocatedPulse, variance: float) -> LocatedPulse:
    if look.covariance is None:
        return look
    more = variance * np.eye(2)
    others = tuple(replace(other, covariance=other.covariance + more) for other in look.others)
    return replace(look, covariance=look.covariance + more, others=others)
