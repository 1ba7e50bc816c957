"""What the curvature of wavefronts says about the rig's constants.

Sound from a source at distance d of the array, true speed (1 + s) times the assumed one, reaches the element that lies
a beside the source at assumed speed times arrival time

    q = hypot(d, (1 + pitch) a) / (1 + s) + late,    measured range r = q at a = 0,    d = (1 + s) r + offset

with ``offset`` = -(1 + s) late of a trigger, a lens or a pulse's shape. A wavefront without ``late`` that arrives at r
has q = hypot(r, a / ratio), whose curvature 1 / (r ratio^2) is that of the true one where

    ratio^2 = (1 + s) d / (r (1 + pitch)^2),    to first order ratio = 1 + s - pitch + offset / (2 r)

A sound speed shows alike at all depths, an offset more the nearer the source. Wide apertures also see the next order:
an offset moves the fitted ratio by ``BY_OFFSET`` / r (0.43 to 0.48 in rendered frames at 12 to 60 mm).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from fgreg.geometry.rig import COUNT, Constant
from fgreg.geometry.transforms import FloatArray
from fgreg.model.measurements import Look

BY_OFFSET = 0.46
SHOT_RATIO = 0.0015
"""Sigma of one wavefront's ratio, added to its noise: tissue that is not the same everywhere bends each differently.
Where the wavefronts scatter by more, their scatter counts."""
COMMON_RATIO = 0.002
COMMON_OFFSET_MM = 0.2
"""Sigmas of what is the same in all wavefronts of a session and no constant: layers of tissue, directivity and lens of
the elements. A silicone lens of 0.5 mm bends wavefronts as an offset of 0.2 mm does. It does not average out."""
_NEAREST_MM = 1.0


def wavefront_evidence(looks: Iterable[Look]) -> tuple[FloatArray, FloatArray]:
    """Information (COUNT, COUNT) and pull (COUNT,) of a session's wavefronts on the constants.

    Their chi square changes by ``c' information c - 2 pull' c`` for constants c. Where the ratios scatter by more than
    their sigmas say, all count less.
    """
    heard = [(look.wavefront, look.range_mm) for look in looks if look.wavefront is not None]
    if not heard:
        return np.zeros((COUNT, COUNT)), np.zeros(COUNT)
    beyond = np.array([wavefront.ratio - 1.0 for wavefront, _ in heard])
    variance = np.array([wavefront.sigma**2 for wavefront, _ in heard]) + SHOT_RATIO**2
    # Of each ratio by (a factor common to all, an offset).
    by = np.array([[1.0, BY_OFFSET / max(range_mm, _NEAREST_MM)] for _, range_mm in heard])
    information, pull = by.T @ (by / variance[:, None]), by.T @ (beyond / variance)
    best = np.linalg.lstsq(information, pull, rcond=1e-12)[0]
    scatter = float(np.sum((beyond - by @ best) ** 2 / variance)) / max(len(heard) - 2, 1)
    information, pull = information / max(1.0, scatter), pull / max(1.0, scatter)
    common = np.diag([COMMON_RATIO**2, COMMON_OFFSET_MM**2])
    information, pull = np.split(
        np.linalg.solve(np.eye(2) + information @ common, np.column_stack([information, pull])), [2], axis=1
    )
    spread = np.zeros((2, COUNT))
    spread[0, [Constant.SOUND_SPEED, Constant.PITCH]] = 1.0, -1.0
    spread[1, Constant.RANGE_OFFSET] = 1.0
    total = spread.T @ information @ spread
    return 0.5 * (total + total.T), spread.T @ pull[:, 0]
