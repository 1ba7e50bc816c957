"""What the online engine answers."""

from __future__ import annotations

from dataclasses import dataclass

from fgreg.estimate import PredictedTre, Verdict
from fgreg.frames import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class OnlineEstimate:
    """The registration after an event: ``trus_T_camera`` (4, 4), covariance (6, 6) over the right tangent."""

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
