"""Status of a live session for the viewer: verdict, next step, stage, lost devices."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from fgreg.model.estimate import PredictedTre, Verdict
from fgreg.model.session_model import StageModel
from fgreg.viewer.summary_page import HEADINGS

NEEDED = ("camera", "probe", "stage", "operator")
"""Devices without which a session cannot continue."""


class BmodePicture(Protocol):
    """Interface of fgreg.drivers.base.BmodeFrame."""

    @property
    def image(self) -> npt.NDArray[np.uint8]:
        """(depth, lateral) grey or (depth, lateral, 3) BGR; columns along TRUS x."""

    @property
    def pixel_mm(self) -> tuple[float, float] | None:
        """Size of a pixel along depth and x, where known."""

    @property
    def origin_mm(self) -> tuple[float, float] | None:
        """Depth below the array's face and TRUS x of the centre of the first pixel, where known."""


@dataclass(frozen=True, slots=True)
class Now:
    """Status of a live session besides its estimate.

    Attributes:
        stage: phase of the session.
        task: the next step. news: the last message.
        lost: roles of the lost devices.
        scan_rad: angle of the image plane; None without a stage.
        homed, moving: of the stage. latched: why it is stopped until the next command; empty where it is not.
        goal_rad, sigma_rad: scan angle at which the PM will be detected; None where unknown, with ``reason``.
        ended: the session is over; this is its last status.
    """

    stage: str
    task: str
    news: str = ""
    lost: tuple[str, ...] = ()
    scan_rad: float | None = None
    homed: bool = False
    moving: bool = False
    latched: str = ""
    goal_rad: float | None = None
    sigma_rad: float | None = None
    reason: str = ""
    ended: bool = False


def stage_line(now: Now, stage: StageModel) -> str:
    """Current and desired stage angle, in the stage's own degrees."""
    if now.scan_rad is None:
        return "LOST" if "stage" in now.lost else "there is none"
    at = math.degrees(stage.device_from_scan(now.scan_rad))
    if not now.homed:
        return f"{at:.1f}° as it reports; it has to be homed"
    parts = [f"at {at:.1f}°" + (", turning" if now.moving else "")]
    goal = goal_line(now, stage)
    if now.goal_rad is not None:
        goal = f"beam at {goal}, {abs(math.degrees(now.goal_rad - now.scan_rad)):.1f}° away"
    return "; ".join([*parts, *filter(None, [goal, now.latched])])


def goal_line(now: Now, stage: StageModel) -> str:
    """The stage angle at which the PM will be detected, or the reason why it is unknown."""
    if now.goal_rad is None:
        return now.reason
    spread = "" if now.sigma_rad is None else f" ± {math.degrees(now.sigma_rad):.1f}° (1 sigma)"
    return f"{math.degrees(stage.device_from_scan(now.goal_rad)):.1f}°{spread}"


def next_line(now: Now) -> str:
    """The next step; with a needed device lost, to reconnect it."""
    needed = [role for role in now.lost if role in NEEDED]
    return f"get the {' and the '.join(needed)} back" if needed else now.task or "wait"


def error_line(tre: PredictedTre | None) -> str:
    """The predicted 95 % error at the worst target, as text."""
    return "not known yet" if tre is None or not math.isfinite(tre.worst_mm) else f"{tre.worst_mm:.2f} mm"


def now_markdown(
    now: Now,
    stage: StageModel,
    verdict: Verdict | None,
    tre: PredictedTre | None,
    pairs: int,
    epoch: int,
    reasons: tuple[str, ...],
) -> str:
    """The status page as Markdown; ``verdict`` is None where there is no registration yet."""
    heading = "# No registration yet" if verdict is None else HEADINGS[verdict]
    lines = ["# THE SESSION HAS ENDED: this is its last status", ""] if now.ended else []
    lines += [heading, ""]
    if now.lost:
        lines += [f"# LOST: {', '.join(now.lost)}", ""]
    if not now.ended:
        lines += [f"## Next: {next_line(now)}", ""]
    lines += [f"**Stage:** {stage_line(now, stage)}", ""]
    lines += [f"**Predicted error at the worst target (95 % bound):** {error_line(tre)}", ""]
    lines += [f"**Session:** {now.stage}; {pairs} pairs in camera epoch {epoch}", ""]
    if now.news and now.news != now.task:
        lines += [f"**Last message:** {now.news}", ""]
    return "\n".join([*lines, *(f"- {reason}" for reason in reasons)])
