"""The registration as the sinks get it. Pure."""

from __future__ import annotations

from fgreg.drivers.base import Registration
from fgreg.model.estimate import TrackEstimate, Verdict
from fgreg.model.session_model import StageModel
from fgreg.model.time_sync import Stamp
from fgreg.online.estimate import OnlineEstimate


def sent_registration(
    stamp: Stamp, estimate: OnlineEstimate | None, invalid: str, tracking: TrackEstimate | None, stage: StageModel
) -> Registration:
    """What is sent: no transform and no angle where the estimate is refused, or none, or ``invalid`` for a reason."""
    if estimate is None or estimate.verdict is Verdict.REFUSED or invalid:
        reasons = ("there is no registration",) if estimate is None else estimate.reasons
        return Registration(stamp, Verdict.REFUSED.value, None, None, reasons=(invalid,) if invalid else reasons)
    stage_rad = None if tracking is None else tracking.stage_rad
    return Registration(
        stamp,
        estimate.verdict.value,
        estimate.trus_T_camera,
        estimate.covariance,
        None if stage_rad is None else stage.scan_from_device(stage_rad),
        None if tracking is None else tracking.sigma_rad,
        estimate.reasons,
        stage_rad,
    )
