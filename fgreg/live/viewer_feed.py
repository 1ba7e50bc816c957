"""Shows a live session in Rerun: each event with what is known after it, and between them where the stage follows."""

from __future__ import annotations

import math
import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from fgreg.drivers.base import StereoFrame
from fgreg.geometry.transforms import FloatArray, as_float_array
from fgreg.live.recorder import Recorded
from fgreg.live.status import Status
from fgreg.model.estimate import Verdict
from fgreg.model.events import AimEvent, NoteEvent, PairEvent
from fgreg.model.measurements import Aim, Look, MarkerObservation, Pair, Track
from fgreg.model.session_model import SessionModel, StageModel
from fgreg.online.estimate import OnlineEstimate
from fgreg.viewer.null_viewer import NullViewer, open_viewer
from fgreg.viewer.recording import Moment, Viewer
from fgreg.viewer.scene import ShotKind
from fgreg.viewer.spawn import spawn_viewer
from fgreg.viewer.status_line import Now

LOOK_S = 0.5
"""Between pictures of the following stage: drawing takes time that the loop wants."""
FRESH_S = 0.5
"""A marker seen longer ago is not where it was."""
WAITING = 64
INSTEAD = (
    "with --no-viewer the session is shown in the terminal only; --no-viewer --rrd FILE records what it would show"
)


class ViewerFeed(Protocol):
    """What a live session tells whoever shows it."""

    def session(self, model: SessionModel) -> None:
        """The session begins."""

    def taken(self, event: Recorded, estimate: OnlineEstimate | None, marker_T_laser: FloatArray | None) -> None:
        """An event was taken in (told on the recorder's thread)."""

    def status(self, status: Status) -> None:
        """A turn of the loop has ended."""


class NullFeed:
    """Shows nothing."""

    def session(self, model: SessionModel) -> None:
        """Nothing is drawn."""

    def taken(self, event: Recorded, estimate: OnlineEstimate | None, marker_T_laser: FloatArray | None) -> None:
        """Nothing is drawn."""

    def status(self, status: Status) -> None:
        """Nothing is drawn."""


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Something to be drawn: an event, or a look at the following stage."""

    t: float
    shot: Aim | Pair | Track | None
    note: str
    estimate: OnlineEstimate | None
    frame: StereoFrame | None
    status: Status | None
    ended: bool = False


class RerunFeed:
    """Draws on a thread of its own; where that cannot keep up, what is oldest is left out: it is only a view."""

    def __init__(self, viewer: Viewer | NullViewer) -> None:
        self._viewer = viewer
        self._model: SessionModel | None = None
        self._waiting: queue.Queue[_Seen | None] = queue.Queue(WAITING)
        self._status: Status | None = None
        self._beam: FloatArray | None = None
        self._looked_s, self._number, self._marker = -math.inf, 0, 0
        self._thread = threading.Thread(target=self._run, name="feed", daemon=True)
        self.left_out = 0

    def session(self, model: SessionModel) -> None:
        """The session begins."""
        self._model = model
        self._viewer.session(model)
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
        self._put(_Seen(event.t, shot, note, estimate, _frame(status), status))

    def status(self, status: Status) -> None:
        """Remember the newest pictures; now and then draw how things stand."""
        self._status = status
        if status.now_s - self._looked_s < LOOK_S:
            return
        self._looked_s = status.now_s
        self._put(self._look(status))

    def _look(self, status: Status, *, ended: bool = False) -> _Seen:
        track, pose = None, status.pose
        if pose is not None and status.now_s - pose.t_s < FRESH_S:
            marker = self._observation(pose.parent_T_child, pose.covariance)
            track = Track(status.t, status.recorder.known.epoch, marker, ())
        return _Seen(status.t, track, "", status.recorder.estimate, _frame(status), status, ended)

    def close(self) -> None:
        """Draw what waits and that it is over, then end."""
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
        model, trus = self._model, event.trus
        if model is None or trus.x_mm is None or trus.range_mm is None:
            return None
        scan = model.stage.scan_from_device(math.radians(trus.scan_deg))
        spread = np.eye(2) if trus.covariance is None else trus.covariance
        look = Look(scan, model.noise.scan_rad, trus.x_mm, trus.range_mm, spread, trus.sweep, trus.amplitude)
        return Pair(event.t, event.pm, epoch, marker, look)

    def _put(self, seen: _Seen) -> None:
        while True:
            try:
                self._waiting.put_nowait(seen)
                return
            except queue.Full:
                try:
                    self._waiting.get_nowait()
                except queue.Empty:
                    continue
                self.left_out += 1

    def _run(self) -> None:
        while (seen := self._waiting.get()) is not None:
            try:
                self._draw(seen)
            except Exception:  # one picture that cannot be drawn must not freeze the view
                self.left_out += 1

    def _draw(self, seen: _Seen) -> None:
        known, number, status, model = seen.estimate, self._number, seen.status, self._model
        invalid = "" if status is None else status.invalid
        if model is None:
            raise AssertionError("the session comes first")
        self._number += 1
        if seen.frame is not None:
            kind: ShotKind = "track"
            if isinstance(seen.shot, Aim | Pair):
                kind = "aim" if isinstance(seen.shot, Aim) else "pair"
            right = None if kind == "track" else seen.frame.right  # of all the looks between, one view is enough
            self._viewer.shot_images(seen.t, kind, number, seen.frame.left, right)
        self._viewer.bmode(seen.t, number, None if status is None else status.bmode)
        self._viewer.moment(
            Moment(
                t=seen.t,
                number=number,
                shot=seen.shot,
                note=seen.note,
                trus_T_camera=None if known is None else known.trus_T_camera,
                covariance=None if known is None else known.covariance,
                marker_T_laser=self._beam,
                tre=None if known is None or invalid else known.predicted_tre,
                verdict=Verdict.REFUSED if known is None or invalid else known.verdict,
                reasons=() if known is None else tuple(filter(None, (invalid, *known.reasons))),
                pairs=0 if known is None else known.pairs,
                nis=known.nis if known is not None and isinstance(seen.shot, Pair) else None,
                used=known is not None and known.used,
                answer=None if status is None or not isinstance(seen.shot, Track) else status.answer,
                now=None if status is None else now_of(status, model.stage, ended=seen.ended),
                epoch=0 if known is None else known.epoch,
            )
        )


def now_of(status: Status, stage: StageModel, *, ended: bool = False) -> Now:
    """What has to be seen at a glance of a moment."""
    plane, answer = status.plane, status.answer
    told = None if answer is None else answer.stage_rad
    return Now(
        status.stage,
        status.task,
        status.text,
        status.lost,
        None if plane is None else plane.scan_rad,
        plane is not None and plane.homed,
        plane is not None and plane.moving,
        status.latched,
        None if told is None else stage.scan_from_device(told),
        None if answer is None else answer.sigma_rad,
        "" if answer is None or status.verdict is Verdict.REFUSED else answer.reason,
        ended,
    )


def _frame(status: Status | None) -> StereoFrame | None:
    """The newest picture; none where its camera is gone."""
    return None if status is None or "camera" in status.lost else status.frame


@contextmanager
def viewer_feed(rrd: Path | None, name: str, *, live: bool, say: Callable[[str], None]) -> Iterator[ViewerFeed]:
    """A feed that records to ``rrd`` and, where ``live``, shows in a viewer; the null one where neither.

    Raises:
        ViewerError: there is no viewer, or no screen for it.
        InputError: the recording cannot be written there.
    """
    if rrd is None and not live:
        yield NullFeed()
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
