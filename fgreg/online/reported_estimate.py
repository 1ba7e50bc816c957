"""What is reported of the incremental estimate, with what the last full solve said of its epoch."""

from __future__ import annotations

import math

import gtsam
import numpy as np

from fgreg.geometry.target_error import tre_mm
from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import Verdict
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.estimate import OnlineEstimate, gaussian_tre
from fgreg.online.full_solve import Report
from fgreg.registration.error_budget import with_effects
from fgreg.registration.verdict import accuracy
from fgreg.smoother.shared_variables import POSE
from fgreg.smoother.state import State

NOT_SOLVED = "this camera epoch has not been through the full solve yet: take the estimate as preliminary"
NO_REGISTRATION = "no registration of this camera epoch"


def reported(
    state: State, t: float, report: Report | None, model: SessionModel, config: SolveConfig, *, settled: bool
) -> OnlineEstimate:
    """The estimate of a state.

    Args:
        state: the incremental estimate.
        t: time of the last event.
        report: of the last full solve of the current epoch; None where there was none.
        model, config: of the session.
        settled: the report is of exactly these measurements, and stands as it is.

    Raises:
        ArithmeticError: a number is not finite.
    """
    active = state.active_window
    optimum = None if active is None else active.state.trus_T_camera()[0]
    count = state.epoch_pairs if active is None else sum(shot.inlier for shot in state.current)
    if report is not None and settled:
        return OnlineEstimate(
            t, state.epoch, report.trus_T_camera, report.covariance, report.predicted_tre, state.nis, state.used,
            report.verdict, report.reasons, report.pairs, optimum, True,
        )  # fmt: skip
    if active is None or optimum is None:
        reason = f"{NO_REGISTRATION}: {state.why_none}"
        return OnlineEstimate(
            t, state.epoch, None, None, None, state.nis, state.used, Verdict.REFUSED, (reason,), count, None, False
        )
    covariance = active.covariance[POSE, POSE]
    pose = optimum
    verdict: Verdict = Verdict.WARNING
    reasons: tuple[str, ...] = (NOT_SOLVED,)
    if state.is_open:
        verdict = Verdict.REFUSED
        reasons = ("two registrations explain these pairs equally well: take more", *reasons)
    if report is not None:
        covariance, shift = report.applied(covariance)
        if np.any(shift):
            pose = optimum @ gtsam.Pose3.Expmap(shift).matrix()
        verdict, reasons = report.verdict, report.reasons
        if (far := _moved_since(report, pose, model)) is not None:
            verdict, reasons = max(verdict, Verdict.WARNING, key=lambda v: v.severity), (far, *reasons)
    tre = gaussian_tre(covariance, pose, model.targets_mm)
    if report is not None:
        tre = with_effects(tre, report.epochs[-1].common if report.epochs else ())
    if not (math.isfinite(tre.worst_mm) and np.isfinite(pose).all()):
        raise ArithmeticError("the reported registration is not finite")
    for condition in accuracy(tre, config):
        if condition.verdict.severity > verdict.severity or report is None:
            verdict = max(verdict, condition.verdict, key=lambda v: v.severity)
            reasons = (*reasons, condition.text)
    return OnlineEstimate(
        t, state.epoch, pose, covariance, tre, state.nis, state.used, verdict, reasons, count, optimum, False
    )


def _moved_since(report: Report, pose: FloatArray, model: SessionModel) -> str | None:
    """Where the estimate is too far from that of the full solve whose verdict it would have: how far.

    More pairs make it more certain, so that it stays within the bound that it had.
    """
    if report.trus_T_camera is None or report.predicted_tre is None:
        return None
    moved_mm = float(tre_mm(report.trus_T_camera, pose, model.targets_mm).max())
    if moved_mm <= report.predicted_tre.worst_mm:
        return None
    return (
        f"the last pairs have moved the estimate by {moved_mm:.1f} mm at the worst target, beyond the bound of the "
        f"full solve before them ({report.predicted_tre.worst_mm:.1f} mm): wait for the next one"
    )
