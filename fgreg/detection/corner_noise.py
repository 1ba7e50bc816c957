"""Corner noise of a session: a variance scale, pooled from the residuals of the detections, with a prior.

Each corner comes with a stated covariance (corners.py). Its error for this camera's images is
one number, the *scale* (a variance ratio). One detection determines it poorly: two views of one tag leave 10 degrees
of freedom, one view 2. So the residuals of the session are pooled with an inverse-gamma prior. The pooled value is in
turn the prior for each detection's own scale.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fgreg.geometry.transforms import FloatArray

PRIOR_DOF = 20.0
"""Degrees of freedom of the prior at the stated corner noise."""
SHARED_DOF = 30.0
"""Degrees of freedom of the pooled value as the prior of one detection: detections differ."""


class Weighed(Protocol):
    """A fit with its whitened sum of squares and degrees of freedom."""

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
    """A fit with its information and the covariance of its common errors, both (6, 6)."""

    @property
    def information(self) -> FloatArray: ...

    @property
    def common_covariance(self) -> FloatArray: ...


@dataclass(frozen=True, slots=True)
class CornerNoise:
    """Pooled corner noise.

    Attributes:
        scale: variance of the corners over their stated variance.
        dof: its degrees of freedom, including the prior's.
        detections: number of pooled detections.
    """

    scale: float = 1.0
    dof: float = PRIOR_DOF
    detections: int = 0


def pool_corner_noise(
    fits: Iterable[Weighed], *, prior_scale: float = 1.0, prior_dof: float = PRIOR_DOF
) -> CornerNoise:
    """Corner noise of a session from its detections (all of one kind: markers, or boards).

    A detection whose residuals exceed nine times the median (per degree of freedom) is an outlier and is not pooled.
    Its own residuals still enter :func:`fit_covariance`.
    """
    costs = np.array([[fit.cost, fit.dof] for fit in fits], dtype=np.float64).reshape(-1, 2)
    costs = costs[costs[:, 1] > 0]
    if len(costs) >= 5:
        each = costs[:, 0] / costs[:, 1]
        costs = costs[each <= 9.0 * max(float(np.median(each)), 1e-12)]
    dof = prior_dof + float(costs[:, 1].sum())
    return CornerNoise((prior_dof * prior_scale + float(costs[:, 0].sum())) / dof, dof, len(costs))


def detection_scale(fit: Residuals, noise: CornerNoise) -> float:
    """The corner noise scale of one detection: the pooled one, updated with the detection's own residuals."""
    weight = min(SHARED_DOF, noise.dof)
    return (weight * noise.scale + fit.cost) / (weight + fit.dof)


def fit_covariance(fit: Residuals, noise: CornerNoise) -> FloatArray:
    """(6, 6) covariance over the right tangent (rotation rad, translation mm)."""
    covariance = detection_scale(fit, noise) * np.linalg.inv(fit.information) + fit.common_covariance
    return np.asarray(0.5 * (covariance + covariance.T))
