"""A live session's status as the overlay gets it, with the simulated room's truth as the estimate."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fgreg.drivers.base import StereoFrame, host_now
from fgreg.live.actions import RegistrationState, StageView
from fgreg.live.overlay_feed import OverlayFeed
from fgreg.live.recorder import RecorderState
from fgreg.live.status import Status
from fgreg.model.estimate import PredictedTre, TrackEstimate, Verdict
from fgreg.model.events import MarkerRecord, PairEvent, TrusRecord
from fgreg.model.session_model import SessionModel
from fgreg.model.time_sync import Stamp, TimedPose
from fgreg.online.estimate import OnlineEstimate
from fgreg.session.setup_reader import read_setup
from fgreg.simulation.documents import session_document
from fgreg.simulation.room import Room, room_config

BESIDE_RAD = math.radians(9.0)
"""The stage stands beside the plane in which the PM is."""


@dataclass(eq=False)
class RoomStatus:
    """A room at rest, and the status that a live session would have in it.

    Attributes:
        t: room time. frame: what the camera sees. estimate: the truth. pairs: an event for each PM.
    """

    model: SessionModel
    room: Room
    t: float
    frame: StereoFrame
    estimate: OnlineEstimate
    pairs: list[PairEvent]

    def fed(self, sinks: list[Any]) -> OverlayFeed:
        """A feed that has taken in the pairs."""
        feed = OverlayFeed(self.model, sinks)
        for pair in self.pairs:
            feed.taken(pair, self.estimate, self.room.marker_T_laser)
        return feed

    def at(self, now_s: float, frame: StereoFrame | None = None, **changes: Any) -> Status:
        """The status at a host time."""
        stage, goal = self.model.stage, self.room.plane_rad(self.t)
        lambda_mm = float(np.linalg.norm(self._beam()[1] - self._beam()[0]))
        tracking = TrackEstimate(0.0, stage.device_from_scan(goal), math.radians(0.4), lambda_mm, True)
        pose = TimedPose(now_s, self.room.camera_T_marker(self.t), np.eye(6))
        known = RegistrationState(self.estimate.verdict, registered=True)
        status = Status(
            now_s,
            0.0,
            "tracking",
            "",
            "",
            RecorderState(known, self.estimate),
            tracking,
            StageView(goal - BESIDE_RAD, False, True, now_s),
            "",
            (),
            pose,
            frame or self.frame,
        )
        return replace(status, **changes)

    def with_verdict(self, verdict: Verdict, now_s: float, **changes: Any) -> Status:
        """The status with another verdict."""
        estimate = replace(self.estimate, verdict=verdict, reasons=("because",))
        state = RecorderState(RegistrationState(verdict, registered=True), estimate)
        return self.at(now_s, **{"recorder": state, **changes})

    def _beam(self) -> tuple[Any, Any]:
        return (self.room.trus_T_marker(self.t) @ self.room.marker_T_laser)[:3, 3], self.room.spot_mm(self.t)


def room_status(width_px: int = 1280, pms: int = 5, *, rendered: bool = True) -> RoomStatus:
    """A room with some PMs behind it, the fibre at the last one; a grey ramp for a picture that is not rendered."""
    config = room_config(1, width_px, aims=0, bump_every_s=1e9)
    model = read_setup(session_document(config.scene), "session.yaml", "room", []).model
    assert model is not None
    room, pairs = Room(config), []
    t = 0.0
    for pm in range(pms):
        t = room.arrives_s() + 0.5
        spot, scan = room.spot_mm(t), room.plane_rad(t)
        range_mm = float(np.hypot(*spot[1:])) - model.probe.radius_mm
        marker = MarkerRecord(room.camera_T_marker(t), np.eye(6))
        trus = TrusRecord(math.degrees(model.stage.device_from_scan(scan)), float(spot[0]), range_mm)
        pairs.append(PairEvent(float(pm), 0, pm, marker, trus))
        if pm + 1 < pms:
            room.proceed(t)
    now = host_now()
    width, height = config.scene.camera.left.image_size
    ramp = np.broadcast_to(np.linspace(40.0, 90.0, width).astype(np.uint8), (height, width))
    frame = StereoFrame(Stamp(now, now), room.pictures(t, 0)[0] if rendered else ramp, None, 0)
    tre = PredictedTre(0.2, 0.3, 0.42)
    pose = room.trus_T_camera(t)
    estimate = OnlineEstimate(0.0, 0, pose, np.eye(6), tre, None, True, Verdict.OK, (), pms, pose, True)
    return RoomStatus(model, room, t, frame, estimate, pairs)
