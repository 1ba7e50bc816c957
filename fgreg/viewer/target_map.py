"""Predicted errors at the targets: spheres in the scene, and the scale of their colours with the limit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from fgreg.errors import one_line
from fgreg.geometry.transforms import FloatArray
from fgreg.model.session_model import SessionModel
from fgreg.viewer import palette, shapes
from fgreg.viewer.blueprint import TARGETS_PX
from fgreg.viewer.scene import Eye, best_eye, probe_points_mm

LEAST_RADIUS_MM = 0.6
"""Of a sphere, so that it is seen."""
MARGIN = 0.78
"""Part of the view that the targets fill; beside it is room for the label of the worst one."""
LONGEST_NAME = 18
"""Characters of a target's name that fit into the margin, under its sphere."""
END = 3.0
"""Right end of the scale, in limits; larger errors are drawn there."""
PX_PER_LIMIT = 100
BAND_PX = 14
DOT_PX = 5.0
"""Pitch of the dots above the scale."""


def radii_mm(bounds: FloatArray, targets_mm: FloatArray) -> FloatArray:
    """(n,) radii of the spheres: the bounds, but at most so large that no two spheres touch."""
    apart = np.linalg.norm(targets_mm[:, None] - targets_mm[None], axis=2)
    apart[apart < 1e-9] = np.inf
    room = 0.45 * float(apart.min()) if np.isfinite(apart.min()) else np.inf
    return np.asarray(np.clip(bounds, LEAST_RADIUS_MM, max(room, LEAST_RADIUS_MM)))


def draw(
    rec: shapes.Recorder, targets_mm: FloatArray, bounds: FloatArray, limit_mm: float, names: Sequence[str] = ()
) -> None:
    """Draw spheres under ``world/targets`` and dots under ``scale``, at the present time.

    Args:
        rec: where.
        targets_mm: (n, 3). bounds: (n,) 95 % bounds of the error there, mm. limit_mm: of the worst one.
        names: of the targets; a number is none.
    """
    colors = palette.error_colors(bounds, limit_mm)
    rec.log("world/targets/bound_95", shapes.spheres(targets_mm, radii_mm(bounds, targets_mm), colors))
    worst = int(np.argmax(bounds))
    name = f"\n{one_line(names[worst], LONGEST_NAME)}" if names and not names[worst].isdigit() else ""
    label = f"worst: {bounds[worst]:.2f} mm{name}"
    rec.log("world/targets/worst", shapes.point(targets_mm[worst], palette.TEXT, 1.0, label))
    rec.log("scale/targets", shapes.coloured_points_2d(dots_px(bounds, limit_mm), colors, 2.6))


def clear(rec: shapes.Recorder) -> None:
    """Draw no errors from the present time on."""
    rec.clear("world/targets", "scale/targets")


def dots_px(bounds: FloatArray, limit_mm: float) -> FloatArray:
    """(n, 2) places of one dot per target above the scale, side by side errors on top of each other."""
    across = np.minimum(bounds / limit_mm, END) * PX_PER_LIMIT
    out = np.zeros((len(bounds), 2))
    stacked: dict[int, int] = {}
    for i in np.argsort(across):
        column = round(float(across[i]) / DOT_PX)
        out[i] = across[i], -DOT_PX * (1.0 + stacked.get(column, 0))
        stacked[column] = stacked.get(column, 0) + 1
    return out


def eye(model: SessionModel) -> Eye:
    """The eye from which targets and probe fill the view of the errors."""
    return best_eye(np.concatenate([probe_points_mm(model.probe), model.targets_mm]), TARGETS_PX, margin=MARGIN)


def draw_scale(rec: shapes.Recorder, limit_mm: float) -> None:
    """Draw the band of colours with its edges named, for all times."""
    rec.static("scale", shapes.exact(_band()))
    edges = np.array([0.0, *palette.ERROR_EDGES])
    words = ["0 mm", *(f"{edge * limit_mm:.1f}" for edge in palette.ERROR_EDGES)]
    words[2] = f"limit {limit_mm:.1f} mm"
    words[3] = f"refused from {2.0 * limit_mm:.1f} mm"
    at = np.column_stack([edges * PX_PER_LIMIT, np.full(len(edges), float(BAND_PX))])
    rec.static("scale/edges", shapes.points_2d(at, palette.TEXT, 0.5, words))
    limit = np.array([[PX_PER_LIMIT, BAND_PX], [PX_PER_LIMIT, -7.0 * DOT_PX]], dtype=np.float64)
    rec.static("scale/limit", shapes.strips_2d([limit], palette.TEXT, 1.0))


def _band() -> npt.NDArray[np.uint8]:
    """(BAND_PX, END limits, 3) the classes' colours."""
    limits = (np.arange(round(END * PX_PER_LIMIT)) + 0.5) / PX_PER_LIMIT
    row = np.array(palette.error_colors(limits, 1.0), dtype=np.uint8)
    return np.repeat(row[None], BAND_PX, axis=0)
