"""By how much the scanner shows a point elsewhere than it is, per constant of probe and stage, to first order.

The point lies in the plane, which is turned to it; its ``x``, its range r and the rotation are held while the constants
change (docs/model.md, section 6). Along the array, outwards, and towards larger stage angles it truly lies further by

    x pitch - r tilt_in_plane
    radius + r sound_speed + range_offset + x tilt_in_plane
    array_offset + r tilt_elevation + x tilt_radial + (R + r) window_centre
"""

from __future__ import annotations

import numpy as np

from fgreg.geometry.rig import COUNT, Constant
from fgreg.geometry.transforms import FloatArray


def scanner_gain(radius_mm: float, trus_p_mm: FloatArray) -> FloatArray:
    """(n, 3, COUNT) shift of points (n, 3), TRUS axes, mm per unit of each constant."""
    x, from_axis = trus_p_mm[:, 0], np.hypot(trus_p_mm[:, 1], trus_p_mm[:, 2])
    sin_scan, cos_scan = trus_p_mm[:, 1] / from_axis, trus_p_mm[:, 2] / from_axis
    r, none, one = from_axis - radius_mm, np.zeros_like(x), np.ones_like(x)
    by: dict[Constant, tuple[FloatArray, FloatArray, FloatArray]] = {  # along, outwards, tangential
        Constant.RADIUS: (none, one, none),
        Constant.RANGE_OFFSET: (none, one, none),
        Constant.SOUND_SPEED: (none, r, none),
        Constant.PITCH: (x, none, none),
        Constant.ARRAY_OFFSET: (none, none, one),
        Constant.TILT_IN_PLANE: (-r, x, none),
        Constant.TILT_RADIAL: (none, none, x),
        Constant.TILT_ELEVATION: (none, none, r),
        Constant.WINDOW_CENTRE: (none, none, from_axis),
    }
    out = np.zeros((len(trus_p_mm), 3, COUNT))
    for constant, (along, outwards, tangential) in by.items():
        out[:, 0, constant] = along
        out[:, 1, constant] = sin_scan * outwards + cos_scan * tangential
        out[:, 2, constant] = cos_scan * outwards - sin_scan * tangential
    return out
