"""Corner noise of a session: what the detections' own residuals say, pooled, with a prior.

Each corner comes with a stated covariance (corners.py). How much too small or large that is in this camera's pictures
is one number, the *scale* (a variance ratio), about which one detection says little: two views of one tag leave 10
degrees of freedom, one view 2. So the residuals of the session are pooled over an inverse-gamma prior, and each
detection's own residuals then count against the pooled value in the same way.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fgreg.geometry.transforms import FloatArray

PRIOR_DOF = 20.0
"""How many degrees of freedom the stated corner noise is worth."""
SHARED_DOF = 30.0
"""How many degrees of freedom the pooled value is worth against a detection's own: detections differ."""


class Weighed(Protocol):
    """What a fit leaves: whitened sum of squares, its degrees of freedom."""

    @property
    def cost(self) -> float: ...

    @property
    def dof(self) -> int: ...


@dataclass(frozen=True, slots=True)
class Misfit:
    """:class:`Weighed`, and nothing else."""

    cost: float
    dof: int


class Residuals(Weighed, Protocol):
    """What a fit leaves, with its information and common errors."""

    @property
    def information(self) -> FloatArray: ...

    @property
    def common_covariance(self) -> FloatArray: ...


@dataclass(frozen=True, slots=True)
class CornerNoise:
    """Pooled corner noise.

    Attributes:
        scale: variance of the corners over their stated variance.
        dof: degrees of freedom behind it, the prior's included.
        detections: how many were pooled.
    """

    scale: float = 1.0
    dof: float = PRIOR_DOF
    detections: int = 0


def pool_corner_noise(
    fits: Iterable[Weighed], *, prior_scale: float = 1.0, prior_dof: float = PRIOR_DOF
) -> CornerNoise:
    """Corner noise of a session from its detections (all of one kind: markers, or boards).

    A detection whose residuals are far off the others' (beyond nine times the median per degree of freedom) is no
    measure of the common noise and is left out here; it keeps its own residuals in :func:`fit_covariance`.
    """
    costs = np.array([[fit.cost, fit.dof] for fit in fits], dtype=np.float64).reshape(-1, 2)
    costs = costs[costs[:, 1] > 0]
    if len(costs) >= 5:
        each = costs[:, 0] / costs[:, 1]
        costs = costs[each <= 9.0 * max(float(np.median(each)), 1e-12)]
    dof = prior_dof + float(costs[:, 1].sum())
    return CornerNoise((prior_dof * prior_scale + float(costs[:, 0].sum())) / dof, dof, len(costs))


def detection_scale(fit: Residuals, noise: CornerNoise) -> float:
    """The corner noise scale of one detection: the pooled one, moved by the detection's own residuals."""
    weight = min(SHARED_DOF, noise.dof)
    return (weight * noise.scale + fit.cost) / (weight + fit.dof)


def fit_covariance(fit: Residuals, noise: CornerNoise) -> FloatArray:
    """(6, 6) covariance over the right tangent (rotation rad, translation mm)."""
    covariance = detection_scale(fit, noise) * np.linalg.inv(fit.information) + fit.common_covariance
    return np.asarray(0.5 * (covariance + covariance.T))
