"""Marker poses from the camera's frames, on the host's clock.

The marker is detected in the newest frame only; older frames are dropped and counted.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from fgreg.detection.corner_noise import CornerNoise, pool_corner_noise
from fgreg.detection.marker import ViewCorners, marker_from_views
from fgreg.detection.marker_roi import EVERYWHERE, MarkerRoi
from fgreg.detection.results import MarkerFit, NotFound, marker_covariance
from fgreg.drivers.base import StereoFrame
from fgreg.live.right_view_worker import RightViewWorker, right_roi
from fgreg.model.session_model import SessionModel
from fgreg.model.time_sync import DeviceClock, PoseHistory, TimedPose

POOL_EVERY, POOL_OVER = 15, 60
"""The corner noise is pooled again after every ``POOL_EVERY`` detections, over the last ``POOL_OVER``."""


@dataclass(frozen=True, slots=True, eq=False)
class WholeFrame:
    """A frame that was searched as a whole: host time of its exposure, pictures, and what either view shows."""

    t_s: float
    frame: StereoFrame
    left: ViewCorners
    right: ViewCorners | None


class MarkerTracker:
    """Detects the marker in each frame.

    Attributes:
        poses: recent ``camera_T_marker`` at host times.
        missing: why the marker was not found in the newest frame; empty if it was.
        newest: the newest frame.
        whole: the newest frame that was searched as a whole, once in some frames.
    """

    def __init__(self, model: SessionModel, latency_s: float = 0.0) -> None:
        if model.camera is None or model.marker is None:
            raise ValueError("the session has no camera or no marker")
        self._rig, self._marker = model.camera, model.marker
        rig = self._rig
        self._left = MarkerRoi(rig.left, 0, np.eye(4), self._marker)
        self._right = None if rig.right is None else right_roi(rig, self._marker)
        self._right_worker = RightViewWorker(rig, self._marker)
        self._clock = DeviceClock(latency_s)
        self._fits: deque[MarkerFit] = deque(maxlen=POOL_OVER)
        self._noise: CornerNoise = pool_corner_noise(())
        self._found = 0
        self.poses = PoseHistory()
        self.missing = ""
        self.newest: StereoFrame | None = None
        self.whole: WholeFrame | None = None
        self._frames = 0

    def detect(self, frame: StereoFrame) -> TimedPose | None:
        """The marker's pose at the frame's exposure; None if it is not found, and ``missing`` gives the reason."""
        t_s = self._clock.host_time(frame.stamp)
        fit = self._detect(frame, t_s)
        self.newest = frame
        if isinstance(fit, NotFound):
            self.missing = fit.reason
            return None
        self.missing = ""
        self._fits.append(fit)
        if self._found % POOL_EVERY == 0:
            self._noise = pool_corner_noise(f.pose for f in self._fits)
        self._found += 1
        pose = TimedPose(t_s, fit.camera_T_marker, marker_covariance(fit, self._noise))
        return pose if self.poses.add(pose) else None

    def _detect(self, frame: StereoFrame, t_s: float) -> MarkerFit | NotFound:
        """As :func:`fgreg.detection.marker.detect_marker`, with both views in parallel if the worker is ready."""
        right: ViewCorners | None = None
        whole = self._frames % EVERYWHERE == 0  # both views at once
        self._frames += 1
        in_worker = (
            frame.right is not None and self._right is not None and self._right_worker.submit(frame.right, whole=whole)
        )
        left = self._left.detect(frame.left, whole=whole)
        if frame.right is not None and self._right is not None:
            right = (self._right_worker.result() if in_worker else None) or self._right.detect(frame.right, whole=whole)
        if whole:
            self.whole = WholeFrame(t_s, frame, left, right)
        return marker_from_views(left, right, self._marker)

    def close(self) -> None:
        """End the right view's worker process."""
        self._right_worker.close()
