"""Detects the marker in the right view in a worker process, while the caller processes the left view.

Detection in both views takes one processor for most of a frame's interval, and in parallel half of that. If the process
has not started or has ended, the caller processes both views itself while a new process starts. Pictures are passed in
shared memory: a colour picture of 1920 x 1080 px takes 0.1 ms that way, and 20 ms through a pipe.
"""

from __future__ import annotations

from functools import partial
from multiprocessing.sharedctypes import RawArray
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.detection.marker import ViewCorners
from fgreg.detection.marker_roi import MarkerRoi
from fgreg.model.camera_model import StereoRig
from fgreg.model.session_model import MarkerModel
from fgreg.workers.worker_process import Work, WorkerProcess

ANSWER_S = 0.3
"""A process that takes longer counts as hung; on a busy machine detection takes a third of this."""

Shape = tuple[tuple[int, ...], str, bool]
"""Shape and data type of a picture, and whether the whole of it is to be searched."""


class RightViewWorker:
    """One worker process for the right view; for one thread.

    Args:
        rig, marker: of the session.
    """

    def __init__(self, rig: StereoRig, marker: MarkerModel) -> None:
        self._rig, self._marker = rig, marker
        self._worker: WorkerProcess[Shape, ViewCorners] | None = None
        self._picture: Any = None

    def submit(self, image: npt.NDArray[np.generic], *, whole: bool = False) -> bool:
        """Hand over a right picture; False if no process is ready for it."""
        if self._worker is None or len(self._picture) != image.nbytes:
            self._start(image.nbytes)
            return False
        self._worker.fetch()  # discard a late result of an earlier picture
        if self._worker.busy or not self._worker.ready:
            return False
        np.frombuffer(self._picture, image.dtype).reshape(image.shape)[...] = image
        self._worker.send((image.shape, image.dtype.str, whole))
        return True

    def result(self) -> ViewCorners | None:
        """Corners in the picture that was handed over; None if there is no result in time or the process failed."""
        reply = None if self._worker is None else self._worker.fetch(ANSWER_S)
        return None if reply is None else reply[0]

    def _start(self, size: int) -> None:
        self.close()
        self._picture = RawArray("B", size)
        self._worker = WorkerProcess(
            _looking,
            self._picture,
            self._rig,
            self._marker,
            name="fgreg-rightview",
            what="the right view's process",
            niceness=0,
            answer_s=ANSWER_S,
            end_s=0.0,
        )

    def close(self) -> None:
        """End the worker process."""
        if self._worker is not None:
            self._worker.close()
            self._worker = None


def right_roi(rig: StereoRig, marker: MarkerModel) -> MarkerRoi:
    """Marker detector of the right view. Raises ValueError if the rig has no right camera."""
    if rig.right is None or rig.right_T_left is None:
        raise ValueError("a right frame, but the rig has no right camera")
    return MarkerRoi(rig.right, 1, rig.right_T_left, marker)


def _looking(picture: Any, rig: StereoRig, marker: MarkerModel) -> Work[Shape, ViewCorners]:
    """The process's work. If it raises, the caller meets the same error when it processes the picture itself."""
    return partial(_look, picture, right_roi(rig, marker))


def _look(picture: Any, roi: MarkerRoi, shape: Shape) -> ViewCorners:
    size, kind, whole = shape
    return roi.detect(np.frombuffer(picture, np.dtype(kind)).reshape(size), whole=whole)
