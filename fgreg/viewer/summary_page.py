"""The recording's summary page, as Markdown."""

from __future__ import annotations

import math

import numpy as np

from fgreg.model.estimate import EpochEstimate, SessionEstimate, Verdict
from fgreg.model.session_model import SessionModel
from fgreg.viewer.reason_links import WORST_TARGET, linked

HEADINGS = {
    Verdict.OK: "# OK: the probe may be turned by this registration",
    Verdict.WARNING: "# WARNING: look first: read the reasons before the probe turns",
    Verdict.REFUSED: "# REFUSED: do not use this registration, do not turn the probe",
}
NOTE = """
A link selects its shot in the scene and in the log; the log's times move the cursor. Spheres: radius (drawn no larger
than leaves room for the next) and colour are the 95 % bound of the error there. Bold is the shot at the cursor.
"""


def summary_markdown(
    model: SessionModel, estimate: SessionEstimate, camera_errors: list[tuple[float, float]], limit_mm: float
) -> str:
    """The page: verdict, reasons with their links, registration, pairs.

    Args:
        model: the session's set-up.
        estimate: its result.
        camera_errors: per epoch, translation error (mm) and rotation error (rad), where the truth is known.
        limit_mm: of the predicted error.
    """
    lines = [HEADINGS[estimate.verdict], ""]
    lines += [f"- {linked(reason, estimate)}" for reason in estimate.reasons]
    used = sum(pair.used for pair in estimate.pairs)
    lines += [
        "",
        f"Session **{estimate.session}**: {used} of {len(estimate.pairs)} looks used, "
        f"{sum(aim.used for aim in estimate.aims)} of {len(estimate.aims)} calibration shots used, "
        f"{len(estimate.tracks)} tracking queries.",
        "",
        f"Predicted error at {len(model.targets_mm)} targets, mm; limit of the [worst](recording://{WORST_TARGET}): "
        f"{limit_mm:.1f}:",
        "",
        "| camera epoch | verdict | pairs | mean | 95 % bound, mean | 95 % bound, worst target |",
        "|---|---|---|---|---|---|",
    ]
    lines += [_epoch_row(epoch) for epoch in estimate.epochs]
    for epoch in estimate.epochs:
        lines += _transform(epoch, refused=estimate.verdict is Verdict.REFUSED)
    lines += _checks(estimate)
    for index, (translation_mm, rotation_rad) in enumerate(camera_errors):
        lines += [
            "",
            f"Against the truth, epoch {index}: camera off by {translation_mm:.2f} mm and "
            f"{math.degrees(rotation_rad):.2f} deg.",
        ]
    lines += [NOTE]
    return "\n".join(lines)


def _epoch_row(epoch: EpochEstimate) -> str:
    tre = epoch.predicted_tre
    figures = "| | |" if tre is None else f"{tre.mean_mm:.2f} | {tre.p95_mm:.2f} | {tre.worst_mm:.2f} |"
    return f"| {epoch.index} (from {epoch.start_s:.1f} s) | {epoch.verdict.value} | {epoch.pairs} | {figures}"


def _transform(epoch: EpochEstimate, *, refused: bool) -> list[str]:
    if epoch.trus_T_camera is None:
        return ["", f"Epoch {epoch.index}: no registration could be computed."]
    note = " (refused: for inspection only)" if refused else ""
    rows = ["  ".join(f"{value:10.5f}" for value in row) for row in np.asarray(epoch.trus_T_camera)]
    return ["", f"`trus_T_camera`, epoch {epoch.index}{note}:", "", "```", *rows, "```"]


def _checks(estimate: SessionEstimate) -> list[str]:
    """The registration at the check points; nothing where there are none."""
    compared = [check for check in estimate.checks if check.error_mm is not None]
    if not compared:
        return []
    lines = [
        "",
        "Checks, error in TRUS axes:",
        "",
        "| t | x | y | z | 95 % bound | NIS | verdict |",
        "|---|---|---|---|---|---|---|",
    ]
    for check in compared:
        error = " | ".join(f"{value:.2f}" for value in np.asarray(check.error_mm))
        lines.append(
            f"| {check.t:.1f} s | {error} | {check.predicted_95_mm:.2f} | {check.nis:.1f} | {check.verdict.value} |"
        )
    return lines
