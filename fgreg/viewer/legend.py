"""The legend of the 3D view: what each sign and colour is."""

from __future__ import annotations

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.viewer import palette, shapes
from fgreg.viewer.palette import Color

COLUMNS, CELL = 3, (110.0, 40.0)
"""Entries side by side; width and height of an entry, px."""
ENTRIES: tuple[tuple[str, str, Color], ...] = (
    ("PM, 95 %", "dot", palette.PM),
    ("not used", "cross", palette.UNUSED),
    ("laser beam", "line", palette.BEAM),
    ("sound's arc", "arc", palette.SOUND),
    ("image plane", "plane", palette.PLANE),
    ("marker", "square", palette.MARKER),
    ("camera", "camera", palette.CAMERA),
    ("refused", "crossed", palette.REFUSED),
    ("truth", "dot", palette.TRUTH),
)
"""Words, sign and colour of each entry."""
SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
_ARC = np.linspace(-0.9, 0.9, 15)
SIGNS: dict[str, list[FloatArray]] = {
    "cross": [np.array([[-1.0, -1.0], [1.0, 1.0]]), np.array([[-1.0, 1.0], [1.0, -1.0]])],
    "line": [np.array([[-2.0, -1.0], [2.0, 1.0]])],
    "arc": [np.column_stack([2.5 * np.sin(_ARC), 2.5 * (0.7 - np.cos(_ARC))])],
    "plane": [SQUARE * [2.0, 1.0]],
    "square": [SQUARE],
    "camera": [SQUARE * [1.6, 1.0], np.array([[-1.6, -1.0], [0.0, -1.8], [1.6, -1.0]])],
    "crossed": [
        SQUARE * [1.6, 1.0],
        np.array([[-1.6, -1.0], [0.0, -1.8], [1.6, -1.0]]),
        np.array([[-1.6, -1.0], [1.6, 1.0]]),
        np.array([[-1.6, 1.0], [1.6, -1.0]]),
    ],
}
"""Lines of each sign, in units of SIZE."""
SIZE = 5.5


def draw(rec: shapes.Recorder) -> None:
    """Draw the legend under ``legend``, for all times."""
    for number, (words, sign, color) in enumerate(ENTRIES):
        middle = np.array([number % COLUMNS + 0.5, number // COLUMNS + 0.4]) * CELL
        path = f"legend/{number}"
        if sign == "dot":
            rec.static(f"{path}/sign", shapes.points_2d(middle[None], color, 5.0))
        else:
            rec.static(f"{path}/sign", shapes.strips_2d([middle + SIZE * part for part in SIGNS[sign]], color, 1.3))
        below = middle[None] + [[0.0, 1.6 * SIZE]]
        rec.static(f"{path}/words", shapes.points_2d(below, palette.TEXT, 0.1, [words]))


def bounds() -> tuple[tuple[float, float], tuple[float, float]]:
    """What the view of the legend shows: x and y, px."""
    rows = -(-len(ENTRIES) // COLUMNS)
    return (0.0, COLUMNS * CELL[0]), (0.0, rows * CELL[1])
