"""The right view is looked into by a worker process, while the left one is looked into here.

A stereo frame takes a processor most of the time until the next one comes: two of them are done in half of that. Where
the process is not there (yet, or any more), the caller looks into both views itself; another one is started meanwhile.
Pictures go there through shared memory: one of 1920 x 1080 pixels in colour takes 0.1 ms that way, 20 ms by a pipe.
"""

from __future__ import annotations

from functools import partial
from multiprocessing.sharedctypes import RawArray
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.detection.marker import ViewCorners
from fgreg.detection.marker_roi import MarkerRoi
from fgreg.model.session_model import MarkerModel, StereoRig
from fgreg.workers.worker_process import Work, WorkerProcess

ANSWER_S = 0.3
"""An answer that takes longer does not come: a busy machine takes a third of that."""

Shape = tuple[tuple[int, ...], str]
"""Of a picture, and its kind of numbers."""


class RightViewWorker:
    """One process at a time; for one thread.

    Args:
        rig, marker: of the session.
    """

    def __init__(self, rig: StereoRig, marker: MarkerModel) -> None:
        self._rig, self._marker = rig, marker
        self._worker: WorkerProcess[Shape, ViewCorners] | None = None
        self._picture: Any = None

    def look(self, image: npt.NDArray[np.generic]) -> bool:
        """Hand over a right picture; False where no process is there to look at it."""
        if self._worker is None or len(self._picture) != image.nbytes:
            self._start(image.nbytes)
            return False
        self._worker.fetch()  # a late answer, to another picture
        if self._worker.busy or not self._worker.ready:
            return False
        np.frombuffer(self._picture, image.dtype).reshape(image.shape)[...] = image
        self._worker.send((image.shape, image.dtype.str))
        return True

    def seen(self) -> ViewCorners | None:
        """What is in the picture that was handed over; None where no answer comes, or the picture is none."""
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
        """End the process."""
        if self._worker is not None:
            self._worker.close()
            self._worker = None


def right_roi(rig: StereoRig, marker: MarkerModel) -> MarkerRoi:
    """For the right view. Raises ValueError where the rig has none."""
    if rig.right is None or rig.right_T_left is None:
        raise ValueError("a right frame, but the rig has no right camera")
    return MarkerRoi(rig.right, 1, rig.right_T_left, marker)


def _looking(picture: Any, rig: StereoRig, marker: MarkerModel) -> Work[Shape, ViewCorners]:
    """The process's work. What it raises at a picture the caller meets as well, and says so."""
    return partial(_look, picture, right_roi(rig, marker))


def _look(picture: Any, watch: MarkerRoi, shape: Shape) -> ViewCorners:
    size, kind = shape
    return watch.see(np.frombuffer(picture, np.dtype(kind)).reshape(size))


__all__ = ["RightViewWorker", "right_roi"]
