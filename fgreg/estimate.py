"""What comes out: registration, beam, PMs, tracks and a verdict. Millimetres, radians."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from fgreg.frames import FloatArray


class Verdict(StrEnum):
    """``ok``: usable; ``warning``: usable, a condition missed; ``refused``: no transform may be used."""

    OK = "ok"
    WARNING = "warning"
    REFUSED = "refused"

    @property
    def severity(self) -> int:
        return [Verdict.OK, Verdict.WARNING, Verdict.REFUSED].index(self)


def worst_verdict(*verdicts: Verdict) -> Verdict:
    """The most severe of the verdicts, ``ok`` of none."""
    return max(verdicts, key=lambda verdict: verdict.severity, default=Verdict.OK)


@dataclass(frozen=True, slots=True, eq=False)
class LaserEstimate:
    """The beam: ``marker_T_laser`` (4, 4), +z along it; covariance (6, 6), right tangent, zero along the gauge."""

    marker_T_laser: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class PredictedTre:
    """Predicted target registration error, mm.

    mean: average over targets of sqrt(E|e|^2); p95: average over targets of the 95 % quantile of |e|; worst: the
    largest of those quantiles.
    """

    mean_mm: float
    p95_mm: float
    worst_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class EpochEstimate:
    """One camera epoch: registration (None where none can be computed), covariance (6, 6) over the right tangent."""

    index: int
    start_s: float
    trus_T_camera: FloatArray | None
    covariance: FloatArray | None
    pairs: int
    verdict: Verdict
    predicted_tre: PredictedTre | None


@dataclass(frozen=True, slots=True, eq=False)
class PairEstimate:
    """One look, in event order.

    Attributes:
        lambda_mm: distance along the beam from the laser frame's origin.
        theta_rad: arc angle theta' (TRUS convention).
        rotation_rad: turn of the *device* from the look's scan angle that brings the PM into the plane.
        trus_p_pm_mm, covariance: the PM and its (3, 3) covariance.
        residual_mm: root of the squared (x, range) misfit, both in mm.
        nis: squared misfit over its predicted covariance, both by the estimate without this PM.
        reason: why it was not used; empty where it was.
    """

    t: float
    pm: int
    epoch: int
    used: bool
    reason: str = ""
    lambda_mm: float | None = None
    theta_rad: float | None = None
    rotation_rad: float | None = None
    trus_p_pm_mm: FloatArray | None = None
    covariance: FloatArray | None = None
    residual_mm: float | None = None
    nis: float | None = None


@dataclass(frozen=True, slots=True)
class TrackEstimate:
    """Where to turn to: absolute device angle and sigma (rad), or None with a reason."""

    t: float
    stage_rad: float | None
    sigma_rad: float | None
    lambda_mm: float | None
    causal: bool
    reason: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class AimEstimate:
    """One calibration shot: distance of the spot from the beam (mm), and its misfit (``nis`` as of a pair)."""

    t: float
    used: bool
    reason: str = ""
    lambda_mm: float | None = None
    residual_mm: float | None = None
    nis: float | None = None


@dataclass(frozen=True, slots=True)
class Quantiles:
    """Of how long something took, ms: median, 99 % quantile, longest."""

    p50: float
    p99: float
    max: float


@dataclass(frozen=True, slots=True)
class Timing:
    """How long taking in an event (``add``) and answering a query (``track``) took; None where there was none."""

    add: Quantiles | None
    track: Quantiles | None


@dataclass(frozen=True, slots=True, eq=False)
class SessionEstimate:
    """The whole answer for a session; what ``result.yaml`` holds, and the calibration shots besides.

    ``timing``: where events were taken in one by one.
    """

    session: str
    verdict: Verdict
    reasons: tuple[str, ...]
    laser: LaserEstimate | None
    epochs: tuple[EpochEstimate, ...]
    pairs: tuple[PairEstimate, ...]
    tracks: tuple[TrackEstimate, ...]
    aims: tuple[AimEstimate, ...] = ()
    timing: Timing | None = None
