"""The estimate after each event, and the predicted error of a Gaussian in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.target_error import gaussian_quantile_mm, target_jacobians
from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import CheckEstimate, PredictedTre, Verdict, worst_verdict
from fgreg.registration.verdict import Condition, verdict_of


@dataclass(frozen=True, slots=True, eq=False)
class OnlineEstimate:
    """The estimate after an event, for the current epoch.

    Attributes:
        t: of the event.
        epoch: index of the camera epoch.
        trus_T_camera: (4, 4) as reported: the graph's optimum moved to the posterior mean; None where there is none.
        covariance: (6, 6), GTSAM's tangent (rotation rad, translation mm), right perturbation.
        predicted_tre: from that covariance, with the error of what the last full solve names.
        nis: innovation of the pair just added: its squared deviation from what all others predict, over the predicted
            covariance; None for other events, and where the others predict nothing.
        used: whether the pair just added is an inlier.
        verdict, reasons: as of a solve; no better than a warning until the full solve has covered this epoch.
        pairs: inlier looks of this epoch.
        optimum_trus_T_camera: (4, 4) the graph's optimum, comparable with :mod:`fgreg.registration.register`.
        settled: whether the full solve has covered exactly these measurements.
        checks: the registration at the check points of this epoch.
    """

    t: float
    epoch: int
    trus_T_camera: FloatArray | None
    covariance: FloatArray | None
    predicted_tre: PredictedTre | None
    nis: float | None
    used: bool
    verdict: Verdict
    reasons: tuple[str, ...]
    pairs: int
    optimum_trus_T_camera: FloatArray | None
    settled: bool
    checks: tuple[CheckEstimate, ...] = ()


def with_conditions(estimate: OnlineEstimate, conditions: Sequence[Condition]) -> OnlineEstimate:
    """The estimate with conditions of the whole session; they come first."""
    if not conditions:
        return estimate
    reasons = (*(condition.text for condition in conditions), *estimate.reasons)
    return replace(estimate, verdict=worst_verdict(estimate.verdict, verdict_of(conditions)), reasons=reasons)


def gaussian_tre(covariance: FloatArray, trus_T_camera: FloatArray, targets_mm: FloatArray) -> PredictedTre:
    """Predicted target registration error of a Gaussian (definitions: :class:`fgreg.model.estimate.PredictedTre`).

    Args:
        covariance: (6, 6), right tangent of ``trus_T_camera`` (4, 4).
        targets_mm: (n, 3), TRUS.
    """
    jacobian = target_jacobians(trus_T_camera, targets_mm)
    spread = jacobian @ covariance @ jacobian.swapaxes(1, 2)
    quantiles = gaussian_quantile_mm(spread)
    mean = np.sqrt(np.maximum(spread.reshape(-1, 9)[:, ::4].sum(axis=1), 0.0)).mean()
    return PredictedTre(float(mean), float(quantiles.mean()), float(quantiles.max()))
