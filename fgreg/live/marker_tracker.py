"""Marker poses from the camera's frames, on the host's clock.

The views are processed by workers (fgreg.live.view_worker), one frame at a time: the newest waits, older ones are
dropped and counted. So the frame rate follows from what the machine can do, and a slow one does not delay the loop.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from fgreg.detection.corner_noise import CornerNoise, pool_corner_noise
from fgreg.detection.marker import ViewCorners, marker_from_views
from fgreg.detection.marker_roi import EVERYWHERE
from fgreg.detection.results import MarkerFit, NotFound, marker_covariance
from fgreg.drivers.base import StereoFrame, host_now
from fgreg.live.view_worker import ViewWorker
from fgreg.model.session_model import SessionModel
from fgreg.model.time_sync import DeviceClock, PoseHistory, TimedPose

POOL_EVERY, POOL_OVER = 15, 60
"""The corner noise is pooled again after every ``POOL_EVERY`` detections, over the last ``POOL_OVER``."""
WHOLE_S = 0.5
"""Where there are static tags, a whole image is searched at least this often: the stage waits for what it shows."""
LEAVES = 1.25
"""The next frame begins no sooner than this many times what the last one took: on a slow machine the registration and
the locator need a processor, too."""


@dataclass(frozen=True, slots=True, eq=False)
class WholeFrame:
    """A frame that was searched as a whole: host time of its exposure, pictures, and what either view shows."""

    t_s: float
    frame: StereoFrame
    left: ViewCorners
    right: ViewCorners | None


class MarkerTracker:
    """Detects the marker, one frame after another.

    Attributes:
        poses: recent ``camera_T_marker`` at host times.
        missing: why the marker was not found in the newest frame; empty if it was.
        newest: the newest frame that was processed. took_s: the time that it took.
        whole: the newest frame that was searched as a whole, once in some frames.
        processed, dropped: number of frames processed, and of frames dropped for newer ones.
    """

    def __init__(self, model: SessionModel, latency_s: float = 0.0) -> None:
        if model.camera is None or model.marker is None:
            raise ValueError("the session has no camera or no marker")
        self._marker, self._whole_every_s = model.marker, WHOLE_S if model.static_tags else math.inf
        sides = 1 if model.camera.right is None else 2
        self._workers = [ViewWorker(model.camera, model.marker, side) for side in range(sides)]
        self._clock = DeviceClock(latency_s)
        self._fits: deque[MarkerFit] = deque(maxlen=POOL_OVER)
        self._noise: CornerNoise = pool_corner_noise(())
        self._found = 0
        self._compared: MarkerFit | None = None  # the newest fit in which both poses of a flat marker were compared
        self._waiting: StereoFrame | None = None
        self._flying: tuple[StereoFrame, float] | None = None  # the frame in hand, its exposure's host time
        self._searches_whole, self._whole_s = False, -math.inf  # the frame in hand; when the last such one began
        self._views: list[tuple[ViewCorners | None] | None] = []
        self._began_s, self._next_s, self._from_s = 0.0, -math.inf, -math.inf
        self.poses = PoseHistory()
        self.missing = ""
        self.newest: StereoFrame | None = None
        self.whole: WholeFrame | None = None
        self._begun = 0  # number of frames handed to the workers
        self.took_s = 0.0
        self.processed = self.dropped = 0

    @property
    def trouble(self) -> str:
        """What is wrong with the workers; empty if they answer."""
        return next((worker.trouble for worker in self._workers if worker.trouble), "")

    def add(self, frame: StereoFrame) -> None:
        """Take in a frame; one that still waits is dropped for it."""
        self._clock.host_time(frame.stamp)
        self.dropped += self._waiting is not None
        self._waiting = frame
        self._begin()

    def poll(self) -> bool:
        """Take in results and begin with the next frame, without waiting; whether a frame was processed.

        Its pose is then the last of ``poses``, or ``missing`` gives the reason why there is none.
        """
        done = self._flying is not None and self._take()
        self._begin()
        return done

    def begin_again(self, now_s: float) -> None:
        """The camera has moved: drop the poses, those in frames exposed before ``now_s`` too that are still in hand."""
        self.poses.clear()
        self._from_s = now_s

    def search_whole(self) -> None:
        """The next frame is searched as a whole."""
        self._whole_s = -math.inf

    def _begin(self) -> None:
        """Hand the waiting frame to the workers, if they are free."""
        frame, now_s = self._waiting, host_now()
        if frame is None or self._flying is not None or now_s < self._next_s:
            return
        pictures = [frame.left] if frame.right is None or len(self._workers) == 1 else [frame.left, frame.right]
        # Each view is asked, so that all processes start at once.
        ready = [worker.ready(picture) for worker, picture in zip(self._workers, pictures, strict=False)]
        if not all(ready):
            return
        self._searches_whole = self._begun % EVERYWHERE == 0 or now_s - self._whole_s >= self._whole_every_s
        self._whole_s = now_s if self._searches_whole else self._whole_s
        for worker, picture in zip(self._workers, pictures, strict=False):
            worker.submit(picture, whole=self._searches_whole)  # both views at once
        self._begun += 1
        self._flying, self._waiting = (frame, self._clock.host_time(frame.stamp)), None
        self._views, self._began_s = [None] * len(pictures), now_s

    def _take(self) -> bool:
        """Take in the views of the frame in hand; whether all are there, or one is lost."""
        if self._flying is None:
            return False
        for side, worker in enumerate(self._workers[: len(self._views)]):
            if self._views[side] is None:
                self._views[side] = worker.result()
        if any(view is None for view in self._views):
            return False
        (frame, t_s), self._flying = self._flying, None
        views = [view[0] for view in self._views if view is not None]
        self.took_s = host_now() - self._began_s
        self._next_s = self._began_s + LEAVES * self.took_s
        self.newest = frame
        self.processed += 1
        left = views[0]
        if left is None or any(view is None for view in views):
            lost = next(worker for worker, view in zip(self._workers, views, strict=False) if view is None)
            self.missing = lost.failure or "the picture's process was replaced"
            return True
        right = views[1] if len(views) > 1 else None
        if self._searches_whole and t_s >= self._from_s:
            self.whole = WholeFrame(t_s, frame, left, right)
            self._compared = None
        fit = marker_from_views(left, right, self._marker, self._compared)
        if isinstance(fit, NotFound):
            self.missing = fit.reason
            return True
        if fit.pose.clearance is not None:
            self._compared = fit
        if t_s < self._from_s:  # it would be in another camera frame
            self.missing = "the picture is from before the camera's move ended"
            return True
        self.missing = ""
        self._fits.append(fit)
        if self._found % POOL_EVERY == 0:
            self._noise = pool_corner_noise(f.pose for f in self._fits)
        self._found += 1
        self.poses.add(TimedPose(t_s, fit.camera_T_marker, marker_covariance(fit, self._noise)))
        return True

    def close(self) -> None:
        """End the worker processes."""
        for worker in self._workers:
            worker.close()
