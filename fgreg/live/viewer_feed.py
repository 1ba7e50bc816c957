"""Shows a live session in Rerun: each event with the estimate after it, and between events the state of tracking."""

from __future__ import annotations

import math
import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fgreg.drivers.base import StereoFrame
from fgreg.geometry.transforms import FloatArray, as_float_array
from fgreg.live.recorder import Recorded
from fgreg.live.status import Status
from fgreg.model.estimate import Verdict
from fgreg.model.events import AimEvent, NoteEvent, PairEvent, TrusRecord
from fgreg.model.measurements import Aim, Look, MarkerObservation, Pair, Track
from fgreg.model.session_model import SessionModel, StageModel
from fgreg.online.estimate import OnlineEstimate
from fgreg.viewer.null_viewer import NullViewer, open_viewer
from fgreg.viewer.scene import ShotKind
from fgreg.viewer.spawn import spawn_viewer
from fgreg.viewer.status_line import Now

if TYPE_CHECKING:
    from fgreg.viewer.recording import Viewer

LOOK_S, SLOW_LOOK_S = 0.5, 2.0
"""Time between two drawings of the tracking state, and on a slow machine: drawing takes time from the loop."""
FRESH_S = 0.5
"""An older marker pose is not drawn."""
WAITING = 64
"""Largest number of drawings that wait."""
INSTEAD = (
    "with --no-viewer the session is shown in the terminal only; --no-viewer --rrd FILE records what it would show"
)


class ViewerFeed:
    """A session's display; this one shows nothing."""

    def session(self, model: SessionModel, limit_mm: float) -> None:
        """The session begins; ``limit_mm``: of the predicted error."""

    def taken(self, event: Recorded, estimate: OnlineEstimate | None, marker_T_laser: FloatArray | None) -> None:
        """An event was taken in (called on the recorder's thread)."""

    def status(self, status: Status) -> None:
        """A step of the loop has ended."""


@dataclass(frozen=True, slots=True, eq=False)
class _Drawing:
    """One drawing: an event, or the state of tracking."""

    t: float
    shot: Aim | Pair | Track | None
    note: str
    estimate: OnlineEstimate | None
    frame: StereoFrame | None
    status: Status | None
    ended: bool = False


class RerunFeed(ViewerFeed):
    """Draws on a thread of its own; if it cannot keep up, the oldest drawings are left out.

    Attributes:
        left_out: number of drawings left out.
    """

    def __init__(self, viewer: Viewer | NullViewer) -> None:
        self._viewer = viewer
        self._model: SessionModel | None = None
        self._waiting: queue.Queue[_Drawing | None] = queue.Queue(WAITING)
        self._status: Status | None = None
        self._beam: FloatArray | None = None
        self._looked_s, self._number, self._marker = -math.inf, 0, 0
        self._thread = threading.Thread(target=self._run, name="feed", daemon=True)
        self.left_out = 0

    def session(self, model: SessionModel, limit_mm: float) -> None:
        """The session begins."""
        self._model = model
        self._viewer.session(model, limit_mm)
        self._thread.start()

    def taken(self, event: Recorded, estimate: OnlineEstimate | None, marker_T_laser: FloatArray | None) -> None:
        """Draw an event."""
        self._beam = marker_T_laser
        shot: Aim | Pair | None = None
        note = type(event).__name__.removesuffix("Event").lower()
        if isinstance(event, AimEvent | PairEvent) and event.marker.camera_T_marker is not None:
            marker = self._observation(event.marker.camera_T_marker, event.marker.covariance)
            if isinstance(event, AimEvent) and event.camera_p_spot_mm is not None:
                shot = Aim(event.t, marker, event.camera_p_spot_mm, np.eye(3))
            elif isinstance(event, PairEvent):
                shot = self._pair(event, marker, 0 if estimate is None else estimate.epoch)
                note = f"pair, PM {event.pm}"
        if isinstance(event, NoteEvent):
            note = event.text
        status = self._status
        self._put(_Drawing(event.t, shot, note, estimate, _frame(status), status))

    def status(self, status: Status) -> None:
        """Store the newest status; draw it every ``LOOK_S``, or ``SLOW_LOOK_S`` while the machine is slow."""
        self._status = status
        if status.now_s - self._looked_s < (SLOW_LOOK_S if status.slow else LOOK_S):
            return
        self._looked_s = status.now_s
        self._put(self._look(status))

    def _look(self, status: Status, *, ended: bool = False) -> _Drawing:
        track, pose = None, status.pose
        if pose is not None and status.now_s - pose.t_s < FRESH_S:
            marker = self._observation(pose.parent_T_child, pose.covariance)
            track = Track(status.t, status.recorder.registration.epoch, marker, ())
        return _Drawing(status.t, track, "", status.recorder.estimate, _frame(status), status, ended)

    def close(self) -> None:
        """Draw what waits and the end of the session, then end the thread."""
        if self._thread.is_alive():
            if self._status is not None:
                self._put(self._look(self._status, ended=True))
            self._waiting.put(None)
            self._thread.join(10.0)

    def _observation(self, pose: FloatArray, covariance: FloatArray | None) -> MarkerObservation:
        self._marker += 1
        spread = np.eye(6) if covariance is None else covariance
        return MarkerObservation(as_float_array(pose, 4, 4), as_float_array(spread, 6, 6), self._marker)

    def _pair(self, event: PairEvent, marker: MarkerObservation, epoch: int) -> Pair | None:
        look = None if self._model is None else look_of(self._model, event.trus)
        return None if look is None else Pair(event.t, event.pm, epoch, marker, look)

    def _put(self, drawing: _Drawing) -> None:
        while True:
            try:
                self._waiting.put_nowait(drawing)
                return
            except queue.Full:
                try:
                    self._waiting.get_nowait()
                except queue.Empty:
                    continue
                self.left_out += 1

    def _run(self) -> None:
        while (drawing := self._waiting.get()) is not None:
            try:
                self._draw(drawing)
            except Exception:  # one failed drawing must not stop the display
                self.left_out += 1

    def _draw(self, drawing: _Drawing) -> None:
        from fgreg.detection.frame_files import to_display  # loads OpenCV
        from fgreg.viewer.live import ViewerUpdate  # loads Rerun

        estimate, number, status, model = drawing.estimate, self._number, drawing.status, self._model
        invalid, slow = ("", "") if status is None else (status.invalid, status.slow)
        reasons = () if estimate is None else (invalid, *estimate.reasons)
        if model is None:
            raise AssertionError("the session comes first")
        self._number += 1
        if drawing.frame is not None:
            kind: ShotKind = "track"
            if isinstance(drawing.shot, Aim | Pair):
                kind = "aim" if isinstance(drawing.shot, Aim) else "pair"
            right = None if kind == "track" else drawing.frame.right  # one view is enough between events
            shown = to_display(drawing.frame.left), None if right is None else to_display(right)
            self._viewer.shot_images(drawing.t, kind, number, *shown, passing=kind == "track")
        self._viewer.bmode(drawing.t, number, None if status is None else status.bmode)
        self._viewer.update(
            ViewerUpdate(
                t=drawing.t,
                number=number,
                shot=drawing.shot,
                note=drawing.note,
                trus_T_camera=None if estimate is None else estimate.trus_T_camera,
                covariance=None if estimate is None else estimate.covariance,
                marker_T_laser=self._beam,
                tre=None if estimate is None or invalid else estimate.predicted_tre,
                verdict=Verdict.REFUSED if estimate is None or invalid else estimate.verdict,
                reasons=tuple(filter(None, (slow, *reasons))),
                pairs=0 if estimate is None else estimate.pairs,
                nis=estimate.nis if estimate is not None and isinstance(drawing.shot, Pair) else None,
                used=estimate is not None and estimate.used,
                answer=None if status is None or not isinstance(drawing.shot, Track) else status.tracking,
                now=None if status is None else now_of(status, model.stage, ended=drawing.ended),
                epoch=0 if estimate is None else estimate.epoch,
            )
        )


def look_of(model: SessionModel, trus: TrusRecord) -> Look | None:
    """A recorded look; None where nothing was detected."""
    if trus.x_mm is None or trus.range_mm is None:
        return None
    scan = model.stage.scan_from_device(math.radians(trus.scan_deg))
    spread = np.eye(2) if trus.covariance is None else trus.covariance
    sweep = model.stage.direction * trus.sweep
    return Look(scan, model.noise.scan_rad, trus.x_mm, trus.range_mm, spread, sweep, trus.amplitude)


def now_of(status: Status, stage: StageModel, *, ended: bool = False) -> Now:
    """Content of the viewer's status line."""
    plane, tracking = status.plane, status.tracking
    goal = None if tracking is None else tracking.stage_rad
    return Now(
        status.stage,
        status.task,
        status.text,
        status.lost,
        None if plane is None else plane.scan_rad,
        plane is not None and plane.homed,
        plane is not None and plane.moving,
        status.latched,
        None if goal is None else stage.scan_from_device(goal),
        None if tracking is None else tracking.sigma_rad,
        "" if tracking is None or status.verdict is Verdict.REFUSED else tracking.reason,
        ended,
    )


def _frame(status: Status | None) -> StereoFrame | None:
    """The newest frame; None if the camera is lost."""
    return None if status is None or "camera" in status.lost else status.frame


@contextmanager
def viewer_feed(rrd: Path | None, name: str, *, live: bool, say: Callable[[str], None]) -> Iterator[ViewerFeed]:
    """A feed that records to ``rrd`` if given and shows in a viewer if ``live``; the null feed if neither.

    Raises:
        ViewerError: there is no viewer, or no screen for it.
        InputError: the recording cannot be written there.
    """
    if rrd is None and not live:
        yield ViewerFeed()
        return
    url = None
    if live:
        say("starting the viewer")
        url = spawn_viewer(instead=INSTEAD)
    with open_viewer(rrd, name, url) as viewer:
        feed = RerunFeed(viewer)
        try:
            yield feed
        finally:
            feed.close()
