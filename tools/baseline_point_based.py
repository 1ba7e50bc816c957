"""The conventional method: PMs seen directly in both frames, closed-form rigid registration."""

from __future__ import annotations

from fgreg.geometry.transforms import FloatArray, make_transform, nearest_rotation


def register_points(camera_p: FloatArray, trus_p: FloatArray) -> FloatArray:
    """``trus_T_camera`` (4, 4) of least squared distance between points (n, 3) seen in both frames, mm.

    Rotation from the singular vectors of the cross-covariance (Arun, Huang and Blostein, 1987; Umeyama, 1991, for the
    sign), translation from the centroids.

    Raises:
        ValueError: fewer than three points, or not as many in both.
    """
    if camera_p.shape != trus_p.shape or camera_p.ndim != 2 or len(camera_p) < 3:
        raise ValueError(f"shapes {camera_p.shape} and {trus_p.shape}, expected the same (n, 3), n at least 3")
    camera_centre, trus_centre = camera_p.mean(axis=0), trus_p.mean(axis=0)
    rotation = nearest_rotation((trus_p - trus_centre).T @ (camera_p - camera_centre))
    return make_transform(rotation, trus_centre - rotation @ camera_centre)
