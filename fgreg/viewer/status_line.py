"""What has to be seen at a glance while a session goes on: verdict, what comes next, the stage, what is gone."""

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
"""Without one of these a session does not go on."""


class BmodePicture(Protocol):
    """As fgreg.drivers.base.BmodeFrame has it."""

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
    """How a session under way stands, besides its estimate.

    Attributes:
        stage: how far the session has come.
        task: what comes next. news: told last.
        lost: devices that are gone, by role.
        scan_rad: where the image plane stands; None where the stage is not there.
        homed, moving: of the stage. latched: why it stands still until it is asked again; empty where it does not.
        goal_rad, sigma_rad: where the beam will be heard (scan angle); None where that cannot be told, for ``reason``.
        ended: the session is over; this is its last picture.
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
    """Where the stage is and should be, in the degrees that it shows itself."""
    if now.scan_rad is None:
        return "LOST" if "stage" in now.lost else "there is none"
    at = math.degrees(stage.device_from_scan(now.scan_rad))
    if not now.homed:
        return f"{at:.1f}° by its own account; it has to find its zero position"
    parts = [f"at {at:.1f}°" + (", turning" if now.moving else "")]
    goal = goal_line(now, stage)
    if now.goal_rad is not None:
        goal = f"beam at {goal}, {abs(math.degrees(now.goal_rad - now.scan_rad)):.1f}° away"
    return "; ".join([*parts, *filter(None, [goal, now.latched])])


def goal_line(now: Now, stage: StageModel) -> str:
    """The angle at which the beam will be heard, or why it cannot be told."""
    if now.goal_rad is None:
        return now.reason
    spread = "" if now.sigma_rad is None else f" ± {math.degrees(now.sigma_rad):.1f}°"
    return f"{math.degrees(stage.device_from_scan(now.goal_rad)):.1f}°{spread}"


def next_line(now: Now) -> str:
    """What comes next: without its devices nothing does."""
    needed = [role for role in now.lost if role in NEEDED]
    return f"get the {' and the '.join(needed)} back" if needed else now.task or "wait"


def error_line(tre: PredictedTre | None) -> str:
    """The predicted error."""
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
    """The page; ``verdict`` None where there is no registration yet."""
    heading = "# No registration yet" if verdict is None else HEADINGS[verdict]
    lines = ["# THE SESSION HAS ENDED: this is its last picture", ""] if now.ended else []
    lines += [heading, ""]
    if now.lost:
        lines += [f"# LOST: {', '.join(now.lost)}", ""]
    if not now.ended:
        lines += [f"## Next: {next_line(now)}", ""]
    lines += [f"**Stage:** {stage_line(now, stage)}", ""]
    lines += [f"**Predicted error at the worst target (95 %):** {error_line(tre)}", ""]
    lines += [f"**Session:** {now.stage}; {pairs} pairs in camera epoch {epoch}", ""]
    if now.news and now.news != now.task:
        lines += [f"**Told last:** {now.news}", ""]
    return "\n".join([*lines, *(f"- {reason}" for reason in reasons)])
