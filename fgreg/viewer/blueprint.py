"""The blueprint of a recording: its views, their layout, and the eye of the 3D view."""

from __future__ import annotations

from dataclasses import dataclass

import rerun.blueprint as rrb

from fgreg.model.estimate import Verdict
from fgreg.viewer.scene import Eye

WORLD_NAME = {
    None: "World: TRUS frame, mm (no result in this recording)",
    Verdict.OK: "World: TRUS frame, mm",
    Verdict.WARNING: "World: TRUS frame, mm (usable with a WARNING: see the summary)",
    Verdict.REFUSED: "World: REFUSED. Do not use this registration",
}
BACKGROUND = {
    None: (18, 20, 24),
    Verdict.OK: (18, 20, 24),
    Verdict.WARNING: (18, 20, 24),
    Verdict.REFUSED: (58, 10, 12),
}
ACCUMULATED = ("world/looks/arc", "world/looks/beam", "world/looks/pm", "world/looks/pm_95")
"""Entities that are shown for every shot up to the time cursor, not only for the newest."""


@dataclass(frozen=True, slots=True)
class Contents:
    """What a recording contains, so that no view is empty.

    Attributes:
        left, right: endoscope images. bmode: B-mode images. result: text of a result.
        pa_size: photoacoustic frames, (rows, columns) px; None without.
        online: states per shot. now: of a live session. registered: the live session has a registration.
    """

    left: bool = False
    right: bool = False
    pa_size: tuple[int, int] | None = None
    result: bool = False
    online: bool = False
    bmode: bool = False
    now: bool = False
    registered: bool = False


def make_blueprint(contents: Contents, verdict: Verdict | None, eye: Eye | None) -> rrb.Blueprint:
    """The blueprint: the 3D world at the left; images, text and plots at the right; the cursor at the last shot."""
    until_now = rrb.VisibleTimeRanges(
        [
            rrb.VisibleTimeRange(
                timeline, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
            )
            for timeline in ("shot", "time")
        ]
    )
    world = rrb.Spatial3DView(
        origin="world",
        contents=["world/**", "- world/camera/right/**"],
        name="World: TRUS frame, mm (live)" if contents.now else WORLD_NAME[verdict],
        background=BACKGROUND[verdict],
        line_grid=False,
        overrides=dict.fromkeys(ACCUMULATED, until_now),
        eye_controls=None
        if eye is None
        else rrb.EyeControls3D(
            position=eye.position_mm.tolist(), look_target=eye.target_mm.tolist(), eye_up=[0.0, 0.0, 1.0]
        ),
    )
    images: list[rrb.View | rrb.Container] = []
    endoscope: list[rrb.View] = [
        rrb.Spatial2DView(origin=f"world/camera/{side}", contents=["$origin/**"], name=f"Endoscope, {side}")
        for side, there in (("left", contents.left), ("right", contents.right))
        if there
    ]
    if endoscope:
        images.append(rrb.Tabs(*endoscope, active_tab=0) if len(endoscope) > 1 else endoscope[0])
    if contents.pa_size is not None:
        rows, columns = contents.pa_size
        bounds = rrb.VisualBounds2D(x_range=[-0.08 * columns, 1.04 * columns], y_range=[-0.12 * rows, 1.02 * rows])
        name = "Photoacoustic frame (x, range; mm)"
        images.append(rrb.Spatial2DView(origin="pa", name=name, visual_bounds=bounds))
    if contents.bmode:
        images.append(rrb.Spatial2DView(origin="bmode", name="B-mode"))
    hidden = rrb.PlotLegend(visible=False)
    text: list[rrb.View] = (
        [rrb.TextDocumentView(origin="summary", name="Now" if contents.now else "Summary")] if contents.result else []
    )
    text.append(rrb.TextLogView(origin="log", name="Log"))
    rows_right: list[rrb.View | rrb.Container] = []
    shares: list[float] = []
    if contents.now:
        rows_right.append(rrb.Spatial2DView(origin="verdict", name="Verdict"))
        shares.append(0.28)
    if images:
        rows_right.append(rrb.Horizontal(*images, column_shares=[1.35, 1.0][: len(images)]))
        shares.append(1.0)
    rows_right.append(rrb.Tabs(*text, active_tab=0))
    shares.append(1.1)
    if contents.online:
        second = ("online/stage_deg", "Stage, deg") if contents.now else ("online/nis", "NIS per pair")
        rows_right.append(
            rrb.Horizontal(
                rrb.TimeSeriesView(
                    origin="online/predicted_worst_mm", name="Predicted worst TRE, mm", plot_legend=hidden
                ),
                rrb.TimeSeriesView(origin=second[0], name=second[1], plot_legend=rrb.PlotLegend(visible=contents.now)),
                rrb.TimeSeriesView(origin="online/pairs", name="Pairs in the epoch", plot_legend=hidden),
            )
        )
        shares.append(0.8)
    elif contents.result:
        rows_right.append(
            rrb.Horizontal(
                rrb.TimeSeriesView(origin="plots/residual_mm", name="Residual, mm", plot_legend=hidden),
                rrb.TimeSeriesView(origin="plots/nis", name="NIS", plot_legend=hidden),
                rrb.Tabs(
                    rrb.TimeSeriesView(origin="plots/rotation_deg", name="Rotation, deg", plot_legend=hidden),
                    rrb.TimeSeriesView(origin="plots/lambda_mm", name="Lambda, mm", plot_legend=hidden),
                    active_tab=0,
                ),
            )
        )
        shares.append(0.8)
    return rrb.Blueprint(
        rrb.Horizontal(world, rrb.Vertical(*rows_right, row_shares=shares), column_shares=[1.0, 1.0]),
        rrb.TimePanel(timeline="shot", play_state="following", state="collapsed"),
        collapse_panels=True,
    )
