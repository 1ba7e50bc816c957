"""The right view is looked into by a process of its own, while the left one is looked into here.

A stereo frame takes a processor most of the time until the next one comes: two of them are done in half of that. Where
the process is not there (yet, or any more), the caller looks into both views itself; another one is started meanwhile.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from multiprocessing.sharedctypes import RawArray
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.detection.marker import ViewCorners
from fgreg.detection.view_watch import ViewWatch
from fgreg.models import MarkerModel, StereoRig

PATIENCE_S = 0.3
"""An answer that takes longer does not come: a busy machine takes a third of that."""


class SecondEye:
    """One process at a time; for one thread.

    Args:
        rig, marker: of the session.
    """

    def __init__(self, rig: StereoRig, marker: MarkerModel) -> None:
        self._rig, self._marker = rig, marker
        self._context = multiprocessing.get_context("spawn")
        self._process: BaseProcess | None = None
        self._connection: Connection[Any, Any] | None = None
        self._picture: Any = None
        self._ready = False

    def look(self, image: npt.NDArray[np.generic]) -> bool:
        """Hand over a right picture; False where nobody is there to look at it."""
        if self._connection is None or len(self._picture) != image.nbytes:
            self._begin(image.nbytes)
            return False
        try:
            if not self._ready and self._connection.poll():
                self._ready = bool(self._connection.recv())
            if not self._ready:
                return False
            np.frombuffer(self._picture, image.dtype).reshape(image.shape)[...] = image
            self._connection.send((image.shape, image.dtype.str))
        except (EOFError, OSError):
            self._end()
            return False
        return True

    def seen(self) -> ViewCorners | None:
        """What is in the picture that was handed over; None where no answer comes, or the picture is none."""
        if self._connection is None:
            return None
        with contextlib.suppress(EOFError, OSError):
            if self._connection.poll(PATIENCE_S):
                found = self._connection.recv()
                return found if isinstance(found, ViewCorners) else None
        self._end()
        return None

    def _begin(self, size: int) -> None:
        self._end()
        self._picture = RawArray("B", size)
        self._connection, theirs = self._context.Pipe()
        self._process = self._context.Process(
            target=_look, args=(theirs, self._picture, self._rig, self._marker), name="second eye", daemon=True
        )
        self._process.start()
        theirs.close()

    def _end(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        if self._process is not None:
            self._process.kill()  # it holds nothing
            self._process.join()
            self._process = None
        self._ready = False

    def close(self) -> None:
        """End the process."""
        self._end()


def right_watch(rig: StereoRig, marker: MarkerModel) -> ViewWatch:
    """For the right view. Raises ValueError where the rig has none."""
    if rig.right is None or rig.right_T_left is None:
        raise ValueError("a right frame, but the rig has no right camera")
    return ViewWatch(rig.right, 1, rig.right_T_left, marker)


def _look(connection: Connection[Any, Any], picture: Any, rig: StereoRig, marker: MarkerModel) -> None:
    """The process, until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the main program's business
    watch = right_watch(rig, marker)
    with contextlib.suppress(EOFError, OSError):
        connection.send(True)
        while True:
            shape, kind = connection.recv()
            image = np.frombuffer(picture, np.dtype(kind)).reshape(shape)
            try:
                found: ViewCorners | None = watch.see(image)
            except Exception:  # the caller meets it as well, and says so
                found = None
            connection.send(found)


__all__ = ["SecondEye", "right_watch"]
