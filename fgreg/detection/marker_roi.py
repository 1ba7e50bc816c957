"""Marker detection in a camera's image stream: near the last position, and in the whole image now and then."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fgreg.detection.marker import Near, ViewCorners, Window, view_corners
from fgreg.geometry.transforms import FloatArray
from fgreg.model.camera_model import CameraModel
from fgreg.model.session_model import MarkerModel

EVERYWHERE = 10
"""The whole image is to be searched once in this many images: a second tag of the same id makes both unusable, and tags
that are not the marker's are found."""
MARGIN, MARGIN_PX = 0.5, 24.0
"""Margin around the last outline for the search: a share of the marker's size, plus pixels."""


class MarkerRoi:
    """Detector of one view with its state.

    Args:
        camera, view, view_T_camera, marker: as of :func:`fgreg.detection.marker.view_corners`.
    """

    def __init__(self, camera: CameraModel, view: int, view_T_camera: FloatArray, marker: MarkerModel) -> None:
        self._camera, self._view, self._view_T_camera, self._marker = camera, view, view_T_camera, marker
        self._last: ViewCorners | None = None

    def detect(self, image: npt.NDArray[np.generic], *, whole: bool = False) -> ViewCorners:
        """The body's corners in the next image. If the search window loses a tag, the whole image is searched.

        ``whole``: the whole image is searched in any case, which the caller asks for once in :data:`EVERYWHERE` images.
        """
        last, found = self._last, None
        if last is not None and not whole:
            window = window_about(last.outlines_px, (image.shape[0], image.shape[1]))
            found = self._look(image, Near(window, shortest_side_px(last.outlines_px), last.again))
            if found.corners is None or len(found.outlines_px) < len(last.outlines_px):
                found = None
        if found is None:
            found = self._look(image, None)
        self._last = found if found.corners is not None else None
        return found

    def _look(self, image: npt.NDArray[np.generic], near: Near | None) -> ViewCorners:
        return view_corners(image, self._camera, self._view, self._view_T_camera, self._marker, near=near)


def shortest_side_px(outlines_px: FloatArray) -> float:
    """Of tags with these outlines (4 n, 2)."""
    tags = outlines_px.reshape(-1, 4, 2)
    return float(np.linalg.norm(tags - np.roll(tags, 1, axis=1), axis=2).min())


def window_about(outlines_px: FloatArray, shape: tuple[int, int]) -> Window:
    """Search window in an image of shape (h, w); starts where a pixel of every lower resolution does."""
    low, high = outlines_px.min(axis=0), outlines_px.max(axis=0)
    margin = MARGIN * float((high - low).max()) + MARGIN_PX
    left, top = (4 * int(max(0.0, value - margin) // 4) for value in low)
    right, bottom = (int(np.ceil(value + margin)) + 1 for value in high)
    return left, min(right, shape[1]), top, min(bottom, shape[0])
