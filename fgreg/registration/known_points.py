"""What the registration makes of its known points: each against all other shots, and those that contradict them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.graph.known_points import point_terms
from fgreg.model.estimate import PointEstimate, Verdict
from fgreg.model.known_points import nis_limit
from fgreg.model.measurements import Measurements
from fgreg.registration.checks import direction_text
from fgreg.registration.outliers import innovations_of
from fgreg.registration.register import Registration
from fgreg.registration.verdict import Condition


def read_points(
    measurements: Measurements, registration: Registration, trus_T_camera: Sequence[FloatArray]
) -> tuple[PointEstimate, ...]:
    """One estimate per known point of ``measurements``, in order.

    Args:
        registration: at its optimum.
        trus_T_camera: (4, 4) of each of its epochs, as reported.

    NIS: the squared deviation from what all other shots predict, in closed form (fgreg.registration.outliers).
    """
    problem, at = registration.problem, registration.optimum.evaluation
    terms = point_terms(problem.points, registration.optimum.state, problem.columns)
    inlier = np.ones(len(problem.points), dtype=bool)
    nis = innovations_of(terms.cost[0], terms.gradient[0], terms.hessian[0], at.hessian[0], inlier)
    out, place = [], 0
    for point in measurements.points:
        if point.epoch not in registration.epochs:
            reason = f"camera epoch {point.epoch} has too few pairs for a registration"
            out.append(PointEstimate(point.t, point.epoch, used=False, reason=reason))
            continue
        registered = trus_T_camera[registration.epochs.index(point.epoch)]
        error = registered[:3, :3] @ point.camera_p_mm + registered[:3, 3] - point.trus_p_mm
        seen = float(nis[place]) if np.isfinite(nis[place]) else None
        out.append(PointEstimate(point.t, point.epoch, used=True, error_mm=error, nis=seen))
        place += 1
    return tuple(out)


def point_conditions(points: Sequence[PointEstimate], measurements: Measurements) -> list[Condition]:
    """Warnings of points that are not where the other shots have them."""
    limit, found = nis_limit(points), []
    for point, measured in zip(points, measurements.points, strict=True):
        if point.error_mm is None or point.nis is None or point.nis <= limit:
            continue
        text = (
            f"the known point at {point.t:.1f} s contradicts the other shots (nis {point.nis:.1f}, {limit:.1f} at "
            f"most): it is off by {float(np.linalg.norm(point.error_mm)):.1f} mm "
            f"{direction_text(point.error_mm, measured.trus_p_mm)}: locate it again"
        )
        found.append(Condition(Verdict.WARNING, text))
    return found
