"""Shows the endoscope's picture with the registration drawn on it, on a thread of its own: the loop never waits for it.

Each new frame is drawn with the state of the loop's step that used it, so that lines and picture belong together. Of
several that wait only the newest is drawn. A picture that is no longer new, since the camera is lost, is shown again
without lines, so that an old registration does not look like a present one.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Sequence, Set

import numpy as np

from fgreg.detection.frame_files import to_display
from fgreg.drivers.base import OverlayPicture, PictureSink
from fgreg.drivers.overlay_picture import OverlayState, overlay_picture
from fgreg.errors import FgregError, one_line
from fgreg.geometry.transforms import FloatArray, transform_points
from fgreg.live.recorder import Recorded
from fgreg.live.status import Status
from fgreg.live.viewer_feed import look_of
from fgreg.model.estimate import Verdict
from fgreg.model.events import PairEvent
from fgreg.model.measurements import Look
from fgreg.model.session_model import SessionModel
from fgreg.online.estimate import OnlineEstimate
from fgreg.viewer.endoscope_lines import Seen
from fgreg.viewer.scene import arc_strip_mm, image_depth_mm, nearest_on, plane_corners_mm, trus_T_plane

FRESH_S = 0.2
"""An older marker pose is not drawn."""
AGAIN_S = 0.5
"""Time between two showings of a picture that is no longer new."""
OLD = "the picture is old: the camera sends no new ones"


class _Pm:
    """A PM's newest look: where on its arc the beam came nearest."""

    def __init__(self, look: Look, camera_T_marker: FloatArray, epoch: int, used: bool) -> None:
        self.look, self.camera_T_marker, self.epoch, self.used = look, camera_T_marker, epoch, used
        self.trus_p: FloatArray | None = None

    def place(self, estimate: OnlineEstimate, marker_T_laser: FloatArray, model: SessionModel) -> None:
        """Compute its place again, if its camera epoch is the present one."""
        if estimate.trus_T_camera is None or estimate.epoch != self.epoch:
            return
        trus_T_laser = estimate.trus_T_camera @ self.camera_T_marker @ marker_T_laser
        origin, direction = trus_T_laser[:3, 3], trus_T_laser[:3, 2]
        along = nearest_on(arc_strip_mm(self.look, model.probe))(origin, direction)
        self.trus_p = None if along is None else origin + along * direction


class OverlayFeed:
    """Draws and sends pictures to the sinks; its owner closes those."""

    def __init__(self, model: SessionModel, sinks: Sequence[PictureSink]) -> None:
        if model.camera is None:
            raise ValueError("an overlay needs the endoscope's calibration")
        self._model, self._camera, self._sinks = model, model.camera.left, sinks
        self._corners = plane_corners_mm(model.probe, image_depth_mm(model.probe, model.targets_mm))
        self._lock = threading.Condition()
        self._status: Status | None = None
        self._ended = False
        self._losses: deque[tuple[int, str]] = deque(maxlen=64)
        self._pms: dict[int, _Pm] = {}
        self._placed: OnlineEstimate | None = None
        self._marker_T_laser: FloatArray | None = None
        self._drawn, self._drawn_s = -1, -math.inf
        self._live = [True] * len(sinks)
        self._thread = threading.Thread(target=self._run, name="overlay", daemon=True)
        self._thread.start()

    def taken(self, event: Recorded, estimate: OnlineEstimate | None, marker_T_laser: FloatArray | None) -> None:
        """An event was taken in (called on the recorder's thread)."""
        with self._lock:
            self._marker_T_laser, self._placed = marker_T_laser, None
            if not isinstance(event, PairEvent) or event.marker.camera_T_marker is None or estimate is None:
                return
            if (look := look_of(self._model, event.trus)) is not None:
                self._pms[event.pm] = _Pm(look, event.marker.camera_T_marker, estimate.epoch, estimate.used)

    def show(self, status: Status) -> None:
        """A step of the loop has ended."""
        with self._lock:
            self._status = status
            self._lock.notify()

    def losses(self) -> list[tuple[int, str]]:
        """The sinks that were lost since the last call, by their place, and why."""
        found = []
        while self._losses:
            found.append(self._losses.popleft())
        return found

    def close(self) -> None:
        """End the thread."""
        with self._lock:
            self._ended = True
            self._lock.notify()
        self._thread.join(2.0)

    def _run(self) -> None:
        while True:
            with self._lock:
                while self._status is None and not self._ended:
                    self._lock.wait()
                if self._ended:
                    return
                status, self._status = self._status, None
            if status is not None and self._is_due(status):
                self._draw(status)

    def _is_due(self, status: Status) -> bool:
        """Whether there is a picture to draw: a new one, or an old one that has not been shown as such lately."""
        frame = status.frame
        if frame is None:
            return False
        return frame.index != self._drawn or ("camera" in status.lost and status.now_s - self._drawn_s > AGAIN_S)

    def _draw(self, status: Status) -> None:
        frame = status.frame
        assert frame is not None
        self._drawn, self._drawn_s = frame.index, status.now_s
        taking = [n for n, sink in enumerate(self._sinks) if sink.connected or self._live[n]]
        if not taking:
            return
        try:
            image = overlay_picture(to_display(frame.left), self._camera, self.state(status))
        except Exception as error:  # one picture that cannot be drawn must not stop the display
            self._losses.extend((n, f"a picture cannot be drawn: {error}") for n in taking)
            return
        for n in taking:
            self._live[n] = self._sinks[n].connected  # once more after a loss, which is raised then
            try:
                self._sinks[n].send(OverlayPicture(frame.stamp, image, frame.index))
            except FgregError as error:
                self._losses.append((n, str(error)))
            except Exception as error:  # the thread has to go on, else an old picture looks like a present one
                self._losses.append((n, one_line(f"a picture cannot be shown: {type(error).__name__}: {error}", 200)))

    def state(self, status: Status) -> OverlayState:
        """What there is to draw."""
        estimate, tracking, model = status.recorder.estimate, status.tracking, self._model
        if estimate is None or estimate.trus_T_camera is None:
            return OverlayState(None, None, _nothing(), lost=status.lost)
        if status.verdict is Verdict.REFUSED or estimate.verdict is Verdict.REFUSED:
            why = next(iter(filter(None, (status.invalid, *estimate.reasons))), "")
            return OverlayState(Verdict.REFUSED, estimate.trus_T_camera, _nothing(), why=why, lost=status.lost)
        goal = None if tracking is None else tracking.stage_rad
        homed = status.plane is not None and status.plane.homed
        scan = status.plane.scan_rad if status.plane is not None and homed else None
        pms, unused = self._pm_places(estimate, status.recorder.excluded)
        goal_scan = None if goal is None else model.stage.scan_from_device(goal)
        seen = Seen(self._plane(scan), self._beam(status, estimate), pms, unused, self._plane(goal_scan))
        return OverlayState(
            estimate.verdict,
            estimate.trus_T_camera,
            seen,
            None if estimate.predicted_tre is None else estimate.predicted_tre.worst_mm,
            None if scan is None else math.degrees(model.stage.device_from_scan(scan)),
            None if goal is None else math.degrees(goal),
            None if tracking is None or tracking.sigma_rad is None else math.degrees(tracking.sigma_rad),
            hidden=OLD if "camera" in status.lost else "",
            no_goal="" if tracking is None else tracking.reason,
            lost=status.lost,
        )

    def _plane(self, scan_rad: float | None) -> FloatArray | None:
        return None if scan_rad is None else transform_points(trus_T_plane(scan_rad), self._corners)

    def _beam(self, status: Status, estimate: OnlineEstimate) -> FloatArray | None:
        """(2, 3) the beam up to the PM that is predicted for it; None without either."""
        pose, laser, tracking = status.pose, self._marker_T_laser, status.tracking
        if pose is None or laser is None or status.now_s - pose.t_s > FRESH_S or estimate.trus_T_camera is None:
            return None
        if tracking is None or tracking.lambda_mm is None:
            return None
        trus_T_laser = estimate.trus_T_camera @ pose.parent_T_child @ laser
        return transform_points(trus_T_laser, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, tracking.lambda_mm]]))

    def _pm_places(self, estimate: OnlineEstimate, excluded: Set[int]) -> tuple[FloatArray, FloatArray]:
        """The PMs that are used (n, 3) and those that are not (m, 3), or left out by hand."""
        with self._lock:
            pms, laser, placed = list(self._pms.items()), self._marker_T_laser, self._placed is estimate
            self._placed = estimate
        if not placed and laser is not None:
            for _, pm in pms:
                pm.place(estimate, laser, self._model)
        sides: tuple[list[FloatArray], list[FloatArray]] = ([], [])
        for number, pm in pms:
            if pm.trus_p is not None:
                sides[not pm.used or number in excluded].append(pm.trus_p)
        return np.reshape(np.array(sides[0]), (-1, 3)), np.reshape(np.array(sides[1]), (-1, 3))


def _nothing() -> Seen:
    return Seen(None, None, np.zeros((0, 3)), np.zeros((0, 3)))
