"""Loop closure: whether the camera is back where an earlier epoch had it.

The hypothesis that the current epoch's PMs have the earlier epoch's registration (with its uncertainty and a tolerance)
is tested against a registration elsewhere. This is the camera-move test with one split point, before the first PM.
Elsewhere begins where using the earlier registration would do harm. A smaller difference is accepted, and the test for
moves goes on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from fgreg.camera_moves.bayes_filter import MoveSettings, Relinearise, move_evidence
from fgreg.camera_moves.whitened import POSE, Gaussian, WhitenedPms
from fgreg.geometry.transforms import FloatArray
from fgreg.graph.split_points import MoveScales
from fgreg.model.measurements import EpochStart

MIN_LOOKS, MOST_LOOKS = 8, 30
"""Range of the current epoch's number of looks in which a loop is closed; with more it determines its registration well
by itself."""
MIN_EARLIER = 8
"""Smallest number of PMs of an earlier epoch that a loop may be closed to."""
CANDIDATES = 4
"""Number of last epochs that are tested."""


def elsewhere_scales() -> MoveScales:
    """Prior of the camera's place if it is not back: from just far enough to matter to anywhere.

    Near by, pure rotations and pure shifts have shares of their own; otherwise a shift without a rotation would count
    as evidence for the same place.
    """
    degrees, mm = [1.0, 1.2, 0.1, 2.0, 10.0, 40.0], [2.0, 0.3, 2.4, 4.0, 30.0, 120.0]
    return MoveScales(np.radians(degrees), np.array(mm), np.array([0.2, 0.15, 0.15, 0.2, 0.2, 0.1]))


@dataclass(frozen=True, slots=True, eq=False)
class LoopClosureSettings:
    """Settings of the loop closure.

    Attributes:
        elsewhere: prior of the registration's difference where the camera is not back, and of outliers.
        accept: log Bayes factor of the same place from which a loop is closed; chosen by the share of cameras 2 mm or 1
            deg off for which a loop is closed wrongly (tools/study_returns.py).
        tolerance: sigmas of the rotation (rad) and shift (mm) of a camera that is back.
    """

    elsewhere: MoveSettings = field(default_factory=lambda: MoveSettings(elsewhere_scales()))
    accept: float = 4.7
    tolerance: tuple[float, float] = (math.radians(0.15), 0.3)

    def __post_init__(self) -> None:
        if not self.accept > 0:
            raise ValueError(f"accept is {self.accept}, expected a number > 0")


def log_bayes_of_same_place(
    earlier: Gaussian, terms: WhitenedPms, settings: LoopClosureSettings, relinearise: Relinearise | None = None
) -> float:
    """Log Bayes factor of an earlier epoch's registration for the current epoch's PMs, against elsewhere.

    Args:
        earlier: the shared variables' step given everything before these PMs.
        terms: these PMs, linearised at the earlier registration.
        settings: priors.
        relinearise: for large differences.
    """
    covariance = earlier.covariance.copy()
    covariance[POSE, POSE] += _spread(settings)
    before = replace(earlier, covariance=covariance)
    first = np.zeros(1, dtype=np.int64)
    return -float(move_evidence(before, terms, first, settings.elsewhere, relinearise).log_bayes[0])


def back_to(start: EpochStart, epoch: int, settings: LoopClosureSettings | None = None) -> EpochStart:
    """The start of an epoch in which the camera is where an earlier one had it, within the tolerance."""
    return EpochStart(start.t, np.eye(4), _spread(settings or LoopClosureSettings()), epoch)


def _spread(settings: LoopClosureSettings) -> FloatArray:
    return np.asarray(np.diag(np.repeat(settings.tolerance, 3) ** 2))
