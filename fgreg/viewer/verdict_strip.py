"""The verdict as a strip with a sign and a pattern, so that it is told without colours, too."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import Verdict
from fgreg.viewer.palette import Color

HEIGHT, WIDTH = 72, 1728
"""Rows and columns of the strip."""
STRIPE = 72
"""Period of its pattern, px."""


def strip(verdict: Verdict | None, color: Color) -> npt.NDArray[np.uint8]:
    """(HEIGHT, WIDTH, 3): plain for ``ok``, stripes for ``warning``, crosses for ``refused``, a frame for none.

    The sign at the left: a tick, a triangle with a bar, a cross.
    """
    row, column = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
    dark = np.zeros((HEIGHT, WIDTH), dtype=bool)
    rising, falling = (column + row) % STRIPE < 0.3 * STRIPE, (column - row) % STRIPE < 0.3 * STRIPE
    if verdict is Verdict.WARNING:
        dark = (column + row) % STRIPE < 0.5 * STRIPE
    elif verdict is Verdict.REFUSED:
        dark = rising | falling
    elif verdict is None:
        dark = (row >= 6) & (row < HEIGHT - 6) & (column >= 6) & (column < WIDTH - 6)
    image = np.where(dark[..., None], np.array(color) // 4, np.array(color))
    if verdict is not None:
        at = column < 1.6 * HEIGHT
        image[at] = (12, 12, 12)
        image[_sign(verdict, row, column)] = color
    return np.asarray(image, dtype=np.uint8)


def _sign(verdict: Verdict, row: FloatArray, column: FloatArray) -> npt.NDArray[np.bool_]:
    """The pixels of a sign in a square at the left end."""
    x, y, half = column - 0.8 * HEIGHT, row - 0.5 * (HEIGHT - 1), 0.36 * HEIGHT
    inside = (np.abs(x) <= half) & (np.abs(y) <= half)
    width = 0.16 * HEIGHT
    if verdict is Verdict.OK:
        elbow = 0.5 * half
        tick = np.where(x < -0.25 * half, np.abs(y - x - 1.1 * half + 0.2 * half), np.abs(y + x - elbow + 0.1 * half))
        return np.asarray(inside & (tick < width))
    if verdict is Verdict.REFUSED:
        return np.asarray(inside & (np.minimum(np.abs(x - y), np.abs(x + y)) < width))
    triangle = (y <= half) & (np.abs(x) <= 0.55 * (y + half))
    bar = (np.abs(x) < 0.06 * HEIGHT) & (y > -0.25 * half) & (np.abs(y - 0.55 * half) > 0.14 * half) & (y < 0.8 * half)
    return np.asarray(triangle & ~bar)
