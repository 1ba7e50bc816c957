"""Known points: the same point is never both data and check, and from where one contradicts the other shots."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from fgreg.model.estimate import PointEstimate
from fgreg.model.measurements import Check, KnownPoint

SAME_CHI2 = 11.3
"""Squared distance of two points, over the sum of their covariances, up to which they may be one (99 %)."""
CONTRADICTS_P = 1e-3
"""A point that fits deviates by more than its limit with at most this probability, all points together."""


def data_at(check: Check, points: Iterable[KnownPoint]) -> str | None:
    """The reason why a check is no check: the scanner has it where it has a point that is data; None: nowhere near."""
    for point in points:
        off = check.trus_p_mm - point.trus_p_mm
        if off @ np.linalg.solve(check.trus_covariance + point.trus_covariance, off) < SAME_CHI2:
            return f"it is the point at {point.t:.1f} s, which is data of the registration: check another one"
    return None


def nis_limit(points: Sequence[PointEstimate]) -> float:
    """NIS from which a point contradicts the other shots."""
    from scipy.special import chdtri  # takes a tenth of a second to load

    return float(chdtri(3, CONTRADICTS_P / max(sum(point.nis is not None for point in points), 1)))
