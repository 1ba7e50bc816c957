"""Do two groups of PMs have the same registration? A score test for each way to part them that has a known cause.

At the optimum of all PMs, with gradient g_j and Hessian H_j of half of PM j's chi square and S the covariance of the
shared variables, a registration of its own for a group B would lower the chi square by

    h' F^-1 h,    h = -sum_B g_j[pose],    F = sum_B H_j[pose, pose] - sum_B H_j[pose] S sum_B H_j[., pose]

(Rao's score test), which has six degrees of freedom where both groups have one registration.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from fgreg.geometry.transforms import BoolArray, FloatArray
from fgreg.graph.contributions import contributions, pm_columns
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced_solver import Optimum
from fgreg.model.estimate import Verdict
from fgreg.registration.verdict import Condition

DIFFERENT_P = 1e-4
"""Tail probability below which two groups differ: with four partings one session in 2,500 by chance."""
LEAST_PMS = 4
"""PMs that each group needs."""
UNSEEN = 1e-9
"""Eigenvalue of a correlation matrix below which a direction of the registration is not determined by the group."""


@dataclass(frozen=True, slots=True, eq=False)
class Parting:
    """A way to part the PMs of an epoch: ``second`` (n,), names of both groups, and what to check where they differ."""

    second: BoolArray
    names: tuple[str, str]
    check: str


def group_conditions(problem: PackedProblem, optimum: Optimum, covariance: FloatArray, epoch: int) -> list[Condition]:
    """Groups of an epoch's PMs that contradict each other.

    Args:
        problem: of the inliers. optimum: one hypothesis. covariance: (D, D) there.
        epoch: of ``problem.columns``.
    """
    mine = np.unique(problem.beam_pm[problem.beam_epoch == epoch])
    if len(mine) < 2 * LEAST_PMS:
        return []
    partings = [p for p in _partings(problem, mine) if min(p.second.sum(), (~p.second).sum()) >= LEAST_PMS]
    if not partings:
        return []
    parts = contributions(problem, optimum.state, optimum.evaluation.private).pm
    columns = pm_columns(problem, mine, epoch)
    pose = np.flatnonzero((columns >= 6 * epoch) & (columns < 6 * epoch + 6))
    gradient, hessian = parts.gradient[0, mine][:, columns[pose]], parts.hessian(mine, columns)[0][:, pose]
    covariance = covariance[np.ix_(columns, columns)]
    found = []
    for parting in partings:
        across = hessian[parting.second].sum(axis=0)
        pull = -gradient[parting.second].sum(axis=0)
        information = across[:, pose] - across @ covariance @ across.T
        chi2, freedom = _score(information, pull)
        if freedom and chdtrc(freedom, chi2) < DIFFERENT_P:
            first, second = parting.names
            text = (
                f"the pairs {first} and those {second} contradict each other (chi square {chi2:.0f} for {freedom} "
                f"degrees of freedom): {parting.check}"
            )
            found.append(Condition(Verdict.WARNING, text))
    return found


def _partings(problem: PackedProblem, mine: np.ndarray) -> Iterator[Parting]:
    looks = problem.looks
    first = np.zeros(len(problem.pms), dtype=np.int64)
    first[problem.look_pm[::-1]] = np.arange(len(problem.look_pm))[::-1]
    look = first[mine]
    one_way = np.array([len(set(looks.sweep[problem.look_pm == pm])) == 1 for pm in mine])
    if one_way.all() and (looks.sweep[look] != 0.0).all():
        yield Parting(
            looks.sweep[look] < 0.0,
            ("swept one way", "swept the other way"),
            "check the stage's backlash, the sensitivity window, and the signs of sweeps",
        )
    yield Parting(
        looks.range_mm[look] > np.median(looks.range_mm[look]),
        ("near the probe", "far from it"),
        "check sound speed, trigger delay and the probe's radius",
    )
    yield Parting(
        looks.x_mm[look] > np.median(looks.x_mm[look]),
        ("at smaller x", "at larger x"),
        "check the element pitch, the tilt of the array and the cameras' calibration",
    )
    yield Parting(
        np.arange(len(mine)) >= len(mine) // 2,
        ("of the first half", "of the second half"),
        "the camera may have moved between them, or the marker on the fibre: record the move, or take the pairs again",
    )


def _score(information: FloatArray, pull: FloatArray) -> tuple[float, int]:
    """``pull' information^-1 pull`` over the directions that are determined, and their number."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-30))
    value, vector = np.linalg.eigh(information * np.outer(scale, scale))
    seen = value > UNSEEN * max(float(value[-1]), 1e-30)
    along = vector.T @ (scale * pull)
    return float(np.sum(along[seen] ** 2 / value[seen])), int(seen.sum())
