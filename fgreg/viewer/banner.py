"""The verdict's strip with its word."""

from __future__ import annotations

import numpy as np

from fgreg.model.estimate import Verdict
from fgreg.viewer import palette, shapes
from fgreg.viewer.palette import Color
from fgreg.viewer.verdict_strip import HEIGHT, WIDTH, strip


def draw(rec: shapes.Recorder, verdict: Verdict | None, word: str, color: Color, *, static: bool = False) -> None:
    """Draw the strip with its word under ``verdict``."""
    log = rec.static if static else rec.log
    log("verdict", shapes.exact(strip(verdict, color)))
    middle = np.array([[0.5 * WIDTH, 0.02 * HEIGHT]])
    log("verdict/word", shapes.points_2d(middle, palette.MARKER, 0.5, [word]))
