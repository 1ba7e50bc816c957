"""Detects the marker in one view of the camera in a worker process: the loop that gives the heartbeat never does it.

Pictures are passed in shared memory: a colour picture of 1920 x 1080 px takes 0.1 ms that way, and 20 ms through a
pipe. A process that has ended or hangs is replaced; the picture in hand is then lost, and the next ones are skipped
until the new process has started.
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

ANSWER_S, WORK_S = 1.0, 10.0
"""A process that makes no progress for this long hangs; detection takes some hundredths of a second of its time."""
NICENESS = 3
"""Below the loop that gives the heartbeat, above the registration and its full solve."""
VIEWS = ("left", "right")

Shape = tuple[tuple[int, ...], str, bool]
"""Shape and data type of a picture, and whether the whole of it is to be searched."""


class ViewWorker:
    """One worker process for one view; for one thread.

    Args:
        rig, marker: of the session.
        view: 0 for left, 1 for right.
    """

    def __init__(self, rig: StereoRig, marker: MarkerModel, view: int) -> None:
        self._rig, self._marker, self._view = rig, marker, view
        self._worker: WorkerProcess[Shape, ViewCorners] | None = None
        self._picture: Any = None

    @property
    def trouble(self) -> str:
        """What is wrong with the process; empty if it answers or starts."""
        return "" if self._worker is None else self._worker.trouble

    @property
    def failure(self) -> str:
        """Why the last picture gave no result; empty if it did."""
        return "" if self._worker is None else self._worker.failure

    def ready(self, image: npt.NDArray[np.generic]) -> bool:
        """Whether a process is ready for such a picture; it is started where there is none."""
        if self._worker is None or len(self._picture) != image.nbytes:
            self._start(image.nbytes)
            return False
        self._worker.check()
        self._worker.fetch()  # discard a result that was given up
        return self._worker.ready and not self._worker.busy

    def submit(self, image: npt.NDArray[np.generic], *, whole: bool = False) -> None:
        """Hand over a picture, once :meth:`ready`."""
        if self._worker is None:
            raise RuntimeError("no process is ready for the picture")
        np.frombuffer(self._picture, image.dtype).reshape(image.shape)[...] = image
        self._worker.send((image.shape, image.dtype.str, whole))

    def result(self) -> tuple[ViewCorners | None] | None:
        """Corners in the picture that was handed over, as a tuple of one; (None,) if it is lost; None if it is not
        processed yet."""
        return (None,) if self._worker is None else self._worker.fetch()

    def _start(self, size: int) -> None:
        self.close()
        self._picture = RawArray("B", size)
        side = VIEWS[self._view]
        self._worker = WorkerProcess(
            _looking,
            self._picture,
            self._rig,
            self._marker,
            self._view,
            name=f"fgreg-{side}view",
            what=f"the {side} view's process",
            niceness=NICENESS,
            answer_s=ANSWER_S,
            work_s=WORK_S,
            end_s=0.0,
        )

    def close(self) -> None:
        """End the worker process."""
        if self._worker is not None:
            self._worker.close()
            self._worker = None


def view_roi(rig: StereoRig, marker: MarkerModel, view: int) -> MarkerRoi:
    """Marker detector of a view. Raises ValueError if the rig has no such camera."""
    if view == 0:
        return MarkerRoi(rig.left, 0, np.eye(4), marker)
    if rig.right is None or rig.right_T_left is None:
        raise ValueError("a right frame, but the rig has no right camera")
    return MarkerRoi(rig.right, 1, rig.right_T_left, marker)


def _looking(picture: Any, rig: StereoRig, marker: MarkerModel, view: int) -> Work[Shape, ViewCorners]:
    """The process's work."""
    return partial(_look, picture, view_roi(rig, marker, view))


def _look(picture: Any, roi: MarkerRoi, shape: Shape) -> ViewCorners:
    size, kind, whole = shape
    return roi.detect(np.frombuffer(picture, np.dtype(kind)).reshape(size), whole=whole)
