"""A quick test of the static tags: whether they are in the pictures where they were, without fitting their poses.

A camera that is bumped shifts all of them in the picture at once, one that stands none. A shift of :data:`LIMIT_RAD`
is 0.25 mm at 100 mm, which is less than the registration's error; the corners as the detector reports them repeat to a
few tenths of a pixel. What the shift was, and whether it lasts, is for the tags' poses to say. So is a slow drift of
the holder: the places at rest go along with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from fgreg.geometry.transforms import FloatArray

LIMIT_RAD = 0.0025
LEAST_PX = 1.2
"""In small pictures the corners' own noise is larger than :data:`LIMIT_RAD`."""
FIRST_FRAMES = 3
"""Frames at the start whose mean is the place at rest."""
LAST_FRAMES = 60
"""Later it is the mean of about so many last ones."""


class TagCorners:
    """Where the static tags are in the pictures while the camera stands.

    Args:
        focal_px: focal length of each view.
    """

    def __init__(self, focal_px: Sequence[float]) -> None:
        self._limit_px = [max(LIMIT_RAD * focal, LEAST_PX) for focal in focal_px]
        self._at: dict[tuple[int, int], tuple[FloatArray, int]] = {}  # place at rest, and of how many frames it is

    def begin_again(self) -> None:
        """Learn the place at rest again, from the frames to come."""
        self._at.clear()

    def at_rest(self, views: Sequence[Mapping[int, FloatArray]]) -> bool | None:
        """Whether the tags are where they were; None where that cannot be told.

        So it is while no place at rest is known of those that are seen, and where of two one has moved.

        Args:
            views: of either camera: corners (4, 2) px of the static tags in a frame, by tag.

        Of several tags the middle one counts, so that one that is touched, or covered in part, is no camera move.
        """
        centres = {(view, tag): at.mean(axis=0) for view, seen in enumerate(views) for tag, at in seen.items()}
        known = {key: place for key, (place, count) in self._at.items() if count >= FIRST_FRAMES}
        shifts: dict[int, float] = {}
        for view, tag in centres.keys() & known.keys():
            shift = float(np.linalg.norm(centres[view, tag] - known[view, tag]))
            shifts[tag] = max(shifts.get(tag, 0.0), shift / self._limit_px[view])
        away = sum(shift > 1.0 for shift in shifts.values())
        if 2 * away > len(shifts):
            return False
        if away and 2 * away == len(shifts):
            return None
        if known and not shifts:  # the camera may have moved: others are not learnt where they are now
            return None
        for key, centre in centres.items():
            place, count = self._at.get(key, (centre, 0))
            self._at[key] = place + (centre - place) / (count + 1), min(count + 1, LAST_FRAMES - 1)
        return True if shifts else None
