"""Size of a camera move: how far what it looks at is displaced."""

from __future__ import annotations

import numpy as np

from fgreg.geometry.transforms import FloatArray, transform_points

SEEN_MM = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 100.0], [40.0, 0.0, 100.0], [0.0, 40.0, 100.0]])
"""Points in the camera frame, (4, 3), mm, about where tissue is."""


def view_shift_mm(camera_new_T_camera_old: FloatArray) -> float:
    """Largest displacement (mm) of :data:`SEEN_MM` by a move (4, 4)."""
    shift = transform_points(camera_new_T_camera_old, SEEN_MM) - SEEN_MM
    return float(np.linalg.norm(shift, axis=1).max())
