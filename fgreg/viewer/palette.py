"""Colours of the recording, red green blue: those of Okabe and Ito (2008), which colour-blind people can tell apart.

What matters is never told by colour alone: the verdict has a sign, a pattern and a word, a shot that was not used a
cross, a refused camera two diagonals, the worst target its figure.
"""

from __future__ import annotations

import math

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import Verdict

Color = tuple[int, int, int]

SKY_BLUE: Color = (86, 180, 233)
BLUE: Color = (0, 114, 178)
BLUISH_GREEN: Color = (0, 158, 115)
YELLOW: Color = (240, 228, 66)
ORANGE: Color = (230, 159, 0)
VERMILLION: Color = (213, 94, 0)
REDDISH_PURPLE: Color = (204, 121, 167)

SOUND = SKY_BLUE
PLANE = SKY_BLUE
PM = ORANGE
BEAM = BLUISH_GREEN
GOAL = BLUISH_GREEN
CAMERA: Color = (90, 140, 235)
"""Blue, lighter than Okabe and Ito's, for thin lines on a dark ground."""
REFUSED = VERMILLION
TRUTH = REDDISH_PURPLE
MARKER: Color = (245, 245, 245)
PROBE: Color = (150, 155, 165)
UNUSED: Color = (100, 100, 100)
TEXT: Color = (225, 228, 232)
AXES: tuple[Color, ...] = (VERMILLION, BLUISH_GREEN, SKY_BLUE)
DRAWN: dict[str, Color] = {
    "PM": PM,
    "sound": SOUND,
    "beam": BEAM,
    "camera": CAMERA,
    "refused": REFUSED,
    "truth": TRUTH,
    "marker": MARKER,
    "not used": UNUSED,
}
"""What has to be told apart in one view."""

VERDICTS: dict[Verdict, Color] = {Verdict.OK: BLUISH_GREEN, Verdict.WARNING: YELLOW, Verdict.REFUSED: VERMILLION}

ERROR_EDGES = (0.5, 1.0, 2.0)
"""Edges of the classes of an error, in limits: beyond 1 the verdict is ``warning``, beyond 2 ``refused``."""
ERRORS: tuple[Color, ...] = (BLUE, SKY_BLUE, ORANGE, VERMILLION)
"""Colours of the classes: cool within the limit, warm beyond it."""


def error_color(error_mm: float, limit_mm: float) -> Color:
    """The colour of an error against the limit; that of the last class where it is not finite."""
    if not math.isfinite(error_mm):
        return ERRORS[-1]
    return ERRORS[sum(error_mm > edge * limit_mm for edge in ERROR_EDGES)]


def error_colors(errors_mm: FloatArray, limit_mm: float) -> list[Color]:
    """The colours of errors (n,)."""
    return [error_color(float(error), limit_mm) for error in np.asarray(errors_mm)]
