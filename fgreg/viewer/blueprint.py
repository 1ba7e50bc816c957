"""The blueprint of a recording: its views, their layout, and the eyes of its 3D views.

The verdict is a strip over the whole width. Below it are, from left to right, the errors at the targets, the largest
picture, with their scale; the scene with its legend; what was seen and heard, the reasons, and plots.
"""

from __future__ import annotations

from dataclasses import dataclass

import rerun.blueprint as rrb

from fgreg.model.estimate import Verdict
from fgreg.viewer.scene import Eye

WORLD_PX = (400, 640)
"""Width and height of the scene in a window of 1600 x 1000, for which its eye and its labels are chosen."""
TARGETS_PX = (620, 640)
"""The same of the errors at the targets."""
WORLD_NAMES = {
    None: "Scene",
    Verdict.OK: "Scene",
    Verdict.WARNING: "Scene: WARNING",
    Verdict.REFUSED: "Scene: REFUSED",
}
BACKGROUNDS = {
    None: (18, 20, 24),
    Verdict.OK: (18, 20, 24),
    Verdict.WARNING: (44, 40, 10),
    Verdict.REFUSED: (58, 22, 6),
}
TARGETS_NAME = "Predicted error at the targets: 95 % bound, mm"
NOT_SCENE = ("world/camera/right/**", "world/camera/left/seen/**", "world/camera/left/marker/**", "world/targets/**")
"""What the scene leaves out: the other camera, what lies on the picture, the errors, which have a view of their own."""


@dataclass(frozen=True, slots=True)
class Contents:
    """What a recording contains, so that no view is empty.

    Attributes:
        left, right: endoscope images. bmode: B-mode images. result: text of a result. shots: their number in a result.
        pa_size: photoacoustic frames, (rows, columns) px; None without.
        online: states per shot. now: of a live session. registered: there is a registration that may be used.
    """

    left: bool = False
    right: bool = False
    pa_size: tuple[int, int] | None = None
    result: bool = False
    shots: int = 0
    online: bool = False
    bmode: bool = False
    now: bool = False
    registered: bool = False


@dataclass(frozen=True, slots=True)
class Eyes:
    """The eyes of the scene and of the errors; None leaves it to the viewer."""

    world: Eye | None = None
    targets: Eye | None = None


def make_blueprint(contents: Contents, verdict: Verdict | None, eyes: Eyes) -> rrb.Blueprint:
    """The blueprint; the cursor at the last shot."""
    name = "Scene (live)" if contents.now else WORLD_NAMES[verdict]
    scene = [_view_3d(name, ["world/**", *(f"- {path}" for path in NOT_SCENE)], verdict, eyes.world)]
    world = rrb.Vertical(*scene, _flat("legend", "Legend", (0.0, 330.0), (0.0, 126.0)), row_shares=[1.0, 0.26])
    columns: list[rrb.View | rrb.Container] = [world, _right(contents)]
    shares = [0.72, 1.05]
    if contents.result:
        shown = ["world/probe", "world/trus/**", "world/targets/**"]
        targets = _view_3d(TARGETS_NAME, shown, verdict, eyes.targets)
        scale = _flat("scale", "Scale: a dot per target, and the limit", (-14.0, 310.0), (-42.0, 34.0))
        columns.insert(0, rrb.Vertical(targets, scale, row_shares=[1.0, 0.26]))
        shares.insert(0, 1.1)
    rows: list[rrb.View | rrb.Container] = [rrb.Horizontal(*columns, column_shares=shares)]
    row_shares = [1.0]
    if contents.result:
        rows.insert(0, _flat("verdict", "Verdict", (0.0, 1728.0), (0.0, 72.0), titlebar=False))
        row_shares.insert(0, 0.075)
    return rrb.Blueprint(
        rrb.Vertical(*rows, row_shares=row_shares),
        rrb.TimePanel(timeline="shot", play_state="following", state="collapsed"),
        collapse_panels=True,
    )


def _view_3d(name: str, contents: list[str], verdict: Verdict | None, eye: Eye | None) -> rrb.Spatial3DView:
    controls = None
    if eye is not None:
        controls = rrb.EyeControls3D(
            position=eye.position_mm.tolist(), look_target=eye.target_mm.tolist(), eye_up=[0.0, 0.0, 1.0]
        )
    return rrb.Spatial3DView(
        origin="world",
        contents=contents,
        name=name,
        background=BACKGROUNDS[verdict],
        line_grid=False,
        eye_controls=controls,
    )


def _flat(
    origin: str, name: str, x: tuple[float, float], y: tuple[float, float], titlebar: bool = True
) -> rrb.Spatial2DView:
    bounds = rrb.VisualBounds2D(x_range=x, y_range=y)
    return rrb.Spatial2DView(
        origin=origin, name=name, visual_bounds=bounds, background=BACKGROUNDS[None], titlebar=titlebar
    )


def _right(contents: Contents) -> rrb.Container:
    """Endoscope, text, sound and plots."""
    rows: list[rrb.View | rrb.Container] = []
    shares: list[float] = []
    endoscope: list[rrb.View] = [
        rrb.Spatial2DView(origin=f"world/camera/{side}", contents=["$origin/**"], name=f"Endoscope, {side}")
        for side, there in (("left", contents.left), ("right", contents.right))
        if there
    ]
    if endoscope:
        rows.append(rrb.Tabs(*endoscope, active_tab=0))
        shares.append(0.85)
    text: list[rrb.View] = []
    if contents.result:
        text.append(rrb.TextDocumentView(origin="summary", name="Now" if contents.now else "Reasons and figures"))
    text.append(rrb.TextLogView(origin="log", contents=["$origin/**"], name="Log"))
    plots = _plots(contents)
    text += plots[2:]
    rows.append(rrb.Tabs(*text, active_tab=0))
    shares.append(1.0)
    sound: list[rrb.View] = []
    if contents.pa_size is not None:
        count, columns = contents.pa_size
        bounds = rrb.VisualBounds2D(x_range=[-0.08 * columns, 1.04 * columns], y_range=[-0.12 * count, 1.02 * count])
        sound.append(rrb.Spatial2DView(origin="pa", name="Sound, mm", visual_bounds=bounds))
    if contents.bmode:
        sound.append(rrb.Spatial2DView(origin="bmode", name="B-mode"))
    below: list[rrb.View | rrb.Container] = [rrb.Tabs(*sound, active_tab=0)] if sound else []
    if plots:
        below.append(rrb.Tabs(*plots[:2], active_tab=0))
    if below:
        rows.append(rrb.Horizontal(*below))
        shares.append(0.8)
    return rrb.Vertical(*rows, row_shares=shares)


def _plots(contents: Contents) -> list[rrb.View]:
    """The plots over the shots, the most telling ones first."""
    if contents.online:
        origins = {"online/predicted_worst_mm": "Worst error, mm", "online/pairs": "Pairs"}
        origins |= {"online/stage_deg": "Stage, deg"} if contents.now else {"online/nis": "NIS"}
    elif contents.result:
        origins = {"plots/nis": "NIS", "plots/residual_mm": "Residual, mm", "plots/rotation_deg": "Turn, deg"}
        origins |= {"plots/lambda_mm": "Beam, mm"}
    else:
        origins = {}
    axis = None
    if contents.shots:  # a shot's width more at either end, so that no sign is cut
        ends = [rrb.TimeRangeBoundary.absolute(seq=seq) for seq in (-1, contents.shots)]
        axis = rrb.TimeAxis(view_range=rrb.TimeRange(start=ends[0], end=ends[1]))
    legend = rrb.PlotLegend("RightTop", visible=True)
    return [
        rrb.TimeSeriesView(origin=origin, name=name, axis_x=axis, plot_legend=legend)
        for origin, name in origins.items()
    ]
