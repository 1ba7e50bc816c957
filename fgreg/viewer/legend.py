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
    middles = np.array([[n % COLUMNS + 0.5, n // COLUMNS + 0.4] for n in range(len(ENTRIES))]) * CELL
    words = [words for words, _, _ in ENTRIES]
    below = middles + np.array([0.0, 1.6 * SIZE])
    rec.static("legend/words", shapes.points_2d(below, palette.TEXT, 0.1, words))
    dots = [(middle, color) for middle, (_, sign, color) in zip(middles, ENTRIES, strict=True) if sign == "dot"]
    places, colors = zip(*dots, strict=True)
    rec.static("legend/dots", shapes.coloured_points_2d(np.array(places), colors, 5.0))
    lines = [
        (middle + SIZE * part, color)
        for middle, (_, sign, color) in zip(middles, ENTRIES, strict=True)
        for part in SIGNS.get(sign, [])
    ]
    strips, colors = zip(*lines, strict=True)
    rec.static("legend/signs", shapes.coloured_strips_2d(strips, colors, 1.3))
