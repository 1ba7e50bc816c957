"""Influence of each PM on the registration: the change without it, in closed form at the optimum.

The reduced problem is a sum over PMs, half cost = rest + part i. At the optimum the gradients cancel, so without part i
(gradient g, Hessian A) a Newton step moves the shared variables by (H - A)^-1 g. No solve is repeated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fgreg.geometry.target_error import expected_tre_mm, moved_mm
from fgreg.geometry.transforms import FloatArray, IntArray
from fgreg.graph.contributions import contributions, pms_by_epochs
from fgreg.graph.scaled_inverse import inverse_hessian, without_others
from fgreg.registration.register import Registration


@dataclass(frozen=True, slots=True, eq=False)
class Influence:
    """One PM's influence on the registration of its epoch.

    Attributes:
        pm, epoch: which.
        step: (6,) right tangent by which leaving it out moves ``trus_T_camera``; infinite where the rest does not
            determine it.
        moved_mm: mean distance by which the targets then move; worst_moved_mm: the largest.
        expected_mm, expected_without_mm: predicted TRE (mean over targets) with and without it; with it, the solve's.
    """

    pm: int
    epoch: int
    step: FloatArray
    moved_mm: float
    worst_moved_mm: float
    expected_mm: float
    expected_without_mm: float


def influences(
    registration: Registration, targets_mm: FloatArray, predicted_mm: Mapping[int, float] | None = None
) -> tuple[Influence, ...]:
    """Influence of every PM that entered a registration, in order of first look.

    The Gaussian at the optimum says by which factor the predicted TRE grows without a PM. ``predicted_mm``: the
    predicted TRE of each of the session's epochs (mean over targets), from the whole posterior; None: that Gaussian's.
    """
    problem, optimum = registration.problem, registration.optimum
    parts = contributions(problem, optimum.state, optimum.evaluation.private).pm
    without: dict[int, tuple[IntArray, FloatArray]] = {}
    for group in pms_by_epochs(problem):
        reduced = without_others(optimum.evaluation.hessian[0], group.columns)
        own = parts.hessian(group.pms, group.columns)[0]
        without |= {int(pm): (group.columns, reduced - one) for pm, one in zip(group.pms, own, strict=True)}
    out = []
    for index, pm in enumerate(problem.pms):
        place = int(problem.beam_epoch[np.flatnonzero(problem.beam_pm == index)[0]])
        transform = optimum.state.trus_T_camera(place)[0]
        pose = slice(6 * place, 6 * place + 6)
        columns, rest = without[index]
        first = int(np.searchsorted(columns, pose.start))
        block = slice(first, first + 6)
        gaussian = float(expected_tre_mm(registration.covariance[pose, pose], transform, targets_mm).mean())
        expected = gaussian if predicted_mm is None else predicted_mm[registration.epochs[place]]
        covariance = inverse_hessian(rest)
        step, expected_without, moved = np.full(6, np.inf), np.inf, np.full(1, np.inf)
        if covariance is not None:
            step = (covariance @ parts.gradient[0, index, columns])[block]
            moved = moved_mm(step, transform, targets_mm)
            expected_without = float(expected_tre_mm(covariance[block, block], transform, targets_mm).mean())
            expected_without *= expected / gaussian
        out.append(
            Influence(
                pm=pm,
                epoch=registration.epochs[place],
                step=step,
                moved_mm=float(moved.mean()),
                worst_moved_mm=float(moved.max()),
                expected_mm=expected,
                expected_without_mm=expected_without,
            )
        )
    return tuple(out)
