"""The live loop: frames and pulses in, events and orders out, once per frame.

One turn: the newest frame -> the marker's pose -> where to turn (from the shared snapshot, which never waits) -> what
the conductor asks for -> the stage's watchdog, the recorder, the operator. All devices are polled; none can hold it up.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from fgreg.detection.board import BoardFit, board_corner, detect_board
from fgreg.detection.joint import NotFound
from fgreg.detection.noise import pool_corner_noise
from fgreg.drivers.base import (
    Command,
    DeviceLost,
    MotionSource,
    Operator,
    PhotoacousticSource,
    Registration,
    StereoCamera,
    StereoFrame,
    TransformSink,
    host_now,
)
from fgreg.errors import FgregError
from fgreg.estimate import TrackEstimate, Verdict
from fgreg.events import AimEvent, CameraMovedEvent, MarkerRecord, NoteEvent, PairEvent, TrusRecord
from fgreg.measurements import MarkerObservation, Track
from fgreg.models import SessionModel
from fgreg.motion.device import StageError
from fgreg.motion.limits import MotionKind
from fgreg.motion.link import Report, StageLink
from fgreg.online.shared_snapshot import NoSnapshotError
from fgreg.operation.conductor import Conductor
from fgreg.operation.recorder import Recorder, RecorderState
from fgreg.operation.senses import Ears, Eyes
from fgreg.operation.spots import one_spot
from fgreg.operation.view import (
    Action,
    Ask,
    Follow,
    Halt,
    Heard,
    StageView,
    Sweep,
    TakeAim,
    TakeMove,
    TakePairs,
    Tell,
    View,
)
from fgreg.pairing import TimedPose
from fgreg.tracking import Snapshot, fast_track

IDLE_S = 0.002
"""Between looks for a frame."""
STEP_S = 0.02
"""Without frames the rest goes on at this pace."""
AGAIN_RAD, AGAIN_S = math.radians(0.1), 0.5
"""An order to follow is repeated once the goal has moved by so much, or after so long."""
SEND_S = 0.2
"""Between sendings of the registration where nothing has changed."""
START_S = 5.0
"""So long devices may take to send for the first time."""
LATENCIES = 100_000


class Snapshots(Protocol):
    """Where the estimate's snapshots come from."""

    def snapshot(self) -> Snapshot:
        """The latest; raises NoSnapshotError where there is none yet."""


@dataclass(slots=True, eq=False)
class Devices:
    """What is connected: one device a role, any number of sinks."""

    camera: StereoCamera
    probe: PhotoacousticSource
    operator: Operator
    stage: StageLink | None = None
    motion: MotionSource | None = None
    sinks: Sequence[TransformSink] = ()

    def roles(self) -> dict[str, Any]:
        """Those that can be lost, by role."""
        found: dict[str, Any] = {"camera": self.camera, "probe": self.probe, "operator": self.operator}
        if self.motion is not None:
            found["motion"] = self.motion
        for number, sink in enumerate(self.sinks):
            found[f"sink {number + 1}"] = sink
        return found

    def close(self) -> None:
        """Let go of all, the stage first."""
        if self.stage is not None:
            self.stage.close()
        for device in self.roles().values():
            device.close()


@dataclass(slots=True, eq=False)
class Figures:
    """What the loop measures of itself.

    Attributes:
        latency_ms: from a frame's arrival to its order, or to the knowledge that there is none.
        frames, skipped: frames looked into, and dropped for newer ones here.
        found: frames in which the marker was found. pulses: taken in. orders: sent to the stage.
    """

    latency_ms: deque[float] = field(default_factory=lambda: deque(maxlen=LATENCIES))
    frames: int = 0
    skipped: int = 0
    found: int = 0
    pulses: int = 0
    orders: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Status:
    """The session at one moment, for whoever shows it.

    Attributes:
        now_s: host time. stage: how far it has come. text: last told to the operator.
        answer: where to turn for the newest pose. plane: the stage. lost: devices that are gone, by role.
        pose, frame: newest.
    """

    now_s: float
    stage: str
    text: str
    recorder: RecorderState
    answer: TrackEstimate | None
    plane: StageView | None
    latched: str
    lost: tuple[str, ...]
    pose: TimedPose | None
    frame: StereoFrame | None


class LiveLoop:
    """Conducts a session with devices.

    Args:
        model: of the session.
        devices: connected; closed by whoever made them.
        recorder: of the session.
        reader: of the estimate's snapshots.
        conductor: what happens next.
        start_s: host time of session time 0.
    """

    def __init__(
        self,
        model: SessionModel,
        devices: Devices,
        recorder: Recorder,
        reader: Snapshots,
        conductor: Conductor,
        start_s: float,
    ) -> None:
        self._model, self._devices, self._recorder, self._reader = model, devices, recorder, reader
        self._conductor, self._start_s = conductor, start_s
        self.eyes, self.ears = Eyes(model), Ears(model)
        self.figures = Figures()
        self._lost: dict[str, str] = {}
        self._seen: set[str] = set()
        self._began_s = host_now()
        self._commands: list[Command] = []
        self._text, self._number = "", 0
        self._followed: tuple[float, float] = (math.nan, -math.inf)
        self._sent_s, self._stepped_s = -math.inf, -math.inf
        self._snapshot: Snapshot | None = None
        self._answer: TrackEstimate | None = None
        self._worker = ThreadPoolExecutor(1, "board")
        self._aiming: tuple[tuple[int, int], TimedPose, Future[BoardFit | NotFound]] | None = None

    def run(self, going: Callable[[], bool], on_status: Callable[[Status], None] | None = None) -> None:
        """While ``going``."""
        while going():
            if not self.turn():
                time.sleep(IDLE_S)
            if on_status is not None:
                on_status(self.status())

    def turn(self) -> bool:
        """One turn; whether there was anything to do."""
        frames = self._poll("camera", self._devices.camera)
        now = host_now()
        if not frames and now - self._stepped_s < STEP_S:
            return False
        pose = self._look(frames)
        self._listen()
        self._stage_reports()
        self._answer = self._where_to(pose)
        self._stepped_s = now
        self._beat()
        for action in self._conductor.step(self._view(now)):
            self._do(action)
        self._take_aim()
        if frames:
            self.figures.latency_ms.append(1e3 * (host_now() - frames[-1].stamp.host_s))
        self._send(now)
        self._health()
        return True

    def status(self) -> Status:
        """The session now."""
        link = self._devices.stage
        view = None if link is None else link.view
        return Status(
            host_now(),
            self._conductor.stage,
            self._text,
            self._recorder.state,
            self._answer,
            self._plane(),
            "" if view is None or view.latched is None else view.latched,
            tuple(self._lost),
            self.eyes.poses.newest(),
            self.eyes.newest,
        )

    def close(self) -> None:
        """End what the loop has started itself."""
        self.ears.close()
        self._worker.shutdown(wait=False, cancel_futures=True)

    # --- in ---------------------------------------------------------------------------------------------------------

    def _poll(self, role: str, device: Any) -> Sequence[Any]:
        try:
            return device.poll()  # type: ignore[no-any-return]
        except DeviceLost as error:
            self._is_lost(role, str(error))
            return ()

    def _look(self, frames: Sequence[StereoFrame]) -> TimedPose | None:
        if not frames:
            return None
        self.figures.frames += 1
        self.figures.skipped += len(frames) - 1
        pose = self.eyes.see(frames[-1])
        self.figures.found += pose is not None
        return pose

    def _listen(self) -> None:
        self.ears.listening = self._conductor.stage != "calibrating"
        pulses = self._poll("probe", self._devices.probe)
        self.figures.pulses += len(pulses)
        self.ears.hear(pulses)
        self._commands += self._poll("operator", self._devices.operator)

    def _stage_reports(self) -> None:
        link = self._devices.stage
        if link is None:
            return
        try:
            for report in link.poll():
                self._reported(report)
        except StageError as error:
            self._is_lost("stage", str(error))
            return
        view = link.view
        if view is None or not view.connected or view.status is None:
            if "stage" in self._seen or host_now() - self._began_s > START_S:
                self._is_lost("stage", "the stage is not there")
            return
        self._seen.add("stage")
        self.ears.plane(view.status.stamp.host_s, view.status.scan_rad, view.status.moving)

    def _reported(self, report: Report) -> None:
        if report.what in ("stopped", "trouble", "refused"):
            self._tell(Tell(f"stage {report.what}: {report.reason}"))

    def _where_to(self, pose: TimedPose | None) -> TrackEstimate | None:
        """Where to turn for a new pose, else for the last one as long as that is new enough to matter."""
        if pose is None:
            newest = self.eyes.poses.newest()
            return self._answer if newest is not None and host_now() - newest.t_s < 0.2 else None
        try:
            self._snapshot = self._reader.snapshot()
        except NoSnapshotError:
            return None
        if not self._snapshot.epochs:
            return None
        self._number += 1
        plane = self._plane()
        query = Track(
            self._t(pose.t_s),
            self._snapshot.epochs[-1].number,
            MarkerObservation(pose.parent_T_child, pose.covariance, self._number),
            (),
            0.0 if plane is None else plane.scan_rad,
        )
        return fast_track(query, self._snapshot)

    def _plane(self) -> StageView | None:
        link = self._devices.stage
        view = None if link is None else link.view
        if view is None or view.status is None or not view.connected:
            return None
        status = view.status
        return StageView(status.scan_rad, status.moving, status.homed, status.stamp.host_s, view.requested)

    def _view(self, now: float) -> View:
        commands, self._commands = tuple(self._commands), []
        state = self._recorder.state
        return View(
            now,
            self.eyes.poses,
            self._plane(),
            self.ears.heard(now, self.eyes.poses),
            commands,
            state.known,
            self._answer,
            state.aims,
        )

    # --- out --------------------------------------------------------------------------------------------------------

    def _t(self, host_s: float) -> float:
        """Session time."""
        return max(0.0, host_s - self._start_s)

    def _verdict(self) -> Verdict | None:
        """Of the registration that holds now; None where there is none."""
        known = self._recorder.state.known
        return known.verdict if known.registered else None

    def _beat(self) -> None:
        link = self._devices.stage
        if link is not None:
            newest, verdict = self.eyes.poses.newest(), self._verdict()
            try:
                link.beat(None if newest is None else newest.t_s, None if verdict is None else verdict.value)
            except StageError as error:
                self._is_lost("stage", str(error))

    def _do(self, action: Action) -> None:
        match action:
            case Ask() | Sweep() | Follow() | Halt():
                self._order(action)
            case TakeAim(corner):
                self._aim(corner)
            case TakePairs(pm, looks):
                spot = one_spot(looks)
                for look in spot.looks:
                    self._pair(pm, spot.marker, look)
            case TakeMove():
                self._recorder.hand_over(CameraMovedEvent(self._t(host_now()), 0))
            case Tell():
                self._tell(action)

    def _order(self, action: Ask | Sweep | Follow | Halt) -> None:
        link = self._devices.stage
        if link is None:
            return
        try:
            match action:
                case Ask(kind):
                    link.request(kind, "operator")
                    if kind is MotionKind.HOME:
                        link.home("asked for by the operator")
                case Sweep(scan_rad, reason):
                    link.search_to(scan_rad, reason)
                case Follow(scan_rad, sigma_rad, _, reason):
                    goal, at_s = self._followed
                    now = host_now()
                    if abs(scan_rad - goal) < AGAIN_RAD and now - at_s < AGAIN_S:
                        return
                    self._followed = (scan_rad, now)
                    link.track_to(scan_rad, sigma_rad, reason)
                case Halt(reason):
                    link.stop(reason)
        except StageError as error:
            self._is_lost("stage", str(error))
        except FgregError as error:  # it could not be recorded, and so was not sent
            self._tell(Tell(str(error)))
        else:
            self.figures.orders += 1

    def _tell(self, tell: Tell) -> None:
        self._text = tell.text
        self._devices.operator.tell(tell.text, done=tell.done, wants=tell.wants)

    def _aim(self, corner: tuple[int, int]) -> None:
        """A calibration shot from the newest frame: marker and board in the same picture."""
        frame, pose, rig, board = self.eyes.newest, self.eyes.poses.newest(), self._model.camera, self._model.board
        if frame is None or pose is None or self.eyes.missing:
            self._tell(Tell(f"no aim: the marker is not seen ({self.eyes.missing or 'no frame'})"))
            return
        if rig is None or board is None:
            self._tell(Tell("no aim: session.yaml has no board"))
            return
        if self._aiming is None:  # else one is being looked at
            found = self._worker.submit(detect_board, frame.left, frame.right, rig, board)
            self._aiming = (corner, pose, found)

    def _take_aim(self) -> None:
        """The calibration shot whose board was being looked for, once it is found."""
        if self._aiming is None or not self._aiming[2].done():
            return
        (corner, pose, found), self._aiming = self._aiming, None
        board = self._model.board
        try:
            fit = found.result()
        except Exception as error:  # of one picture: the next one may be as it should
            self._tell(Tell(f"no aim: {error}"))
            return
        if board is None or not (0 <= corner[0] < board.columns and 0 <= corner[1] < board.rows):
            self._tell(Tell(f"no aim: the board has no inner corner {corner[0]}, {corner[1]}"))
            return
        if not isinstance(fit, BoardFit):
            self._tell(Tell(f"no aim: {fit.reason}"))
            return
        spot, covariance = board_corner(fit, corner[0], corner[1], pool_corner_noise([fit.pose]))
        turn = fit.camera_T_board[:3, :3]
        covariance = covariance + turn @ np.diag(np.square(self._model.noise.aim_mm)) @ turn.T
        marker = MarkerRecord(pose.parent_T_child, pose.covariance)
        self._recorder.hand_over(AimEvent(self._t(pose.t_s), 0, marker, spot, covariance))
        self._tell(Tell(f"aim at corner {corner[0]}, {corner[1]} taken", done=True))

    def _pair(self, pm: int, pose: TimedPose, look: Heard) -> None:
        if look.scan_rad is None:
            raise AssertionError("a look that cannot be paired")
        device = math.degrees(self._model.stage.device_from_scan(look.scan_rad))
        trus = TrusRecord(device, look.x_mm, look.range_mm, look.covariance, look.amplitude, 0)
        marker = MarkerRecord(pose.parent_T_child, pose.covariance)
        self._recorder.hand_over(PairEvent(self._t(look.pulse_s), 0, pm, marker, trus))

    def _send(self, now: float) -> None:
        """The registration, to whoever wants it."""
        if not self._devices.sinks or now - self._sent_s < SEND_S:
            return
        self._sent_s = now
        estimate, newest = self._recorder.state.estimate, self.eyes.poses.newest()
        stamp = None if self.eyes.newest is None else self.eyes.newest.stamp
        if estimate is None or stamp is None or newest is None:
            return
        refused = estimate.verdict is Verdict.REFUSED
        answer = None if refused else self._answer
        plane = None if answer is None or answer.stage_rad is None else answer.stage_rad
        registration = Registration(
            stamp,
            estimate.verdict.value,
            None if refused else estimate.trus_T_camera,
            None if refused else estimate.covariance,
            None if plane is None else self._model.stage.scan_from_device(plane),
            None if answer is None else answer.sigma_rad,
            estimate.reasons,
        )
        for number, sink in enumerate(self._devices.sinks):
            try:
                sink.send(registration)
            except DeviceLost as error:
                self._is_lost(f"sink {number + 1}", str(error))

    # --- devices that come and go -----------------------------------------------------------------------------------

    def _is_lost(self, role: str, reason: str) -> None:
        if role not in self._lost:
            self._lost[role] = reason
            self._note(f"{role} lost: {reason}")

    def _health(self) -> None:
        for role, device in self._devices.roles().items():
            if role in self._lost and device.connected:
                del self._lost[role]
                self._note(f"{role} is back")
            elif role not in self._lost and role in ("camera", "probe"):
                if device.connected:
                    self._seen.add(role)
                elif role in self._seen or host_now() - self._began_s > START_S:
                    self._is_lost(role, f"{device.name} does not answer")
        plane = self._plane()
        if "stage" in self._lost and plane is not None:
            del self._lost["stage"]
            self._note("stage is back")

    def _note(self, text: str) -> None:
        self._tell(Tell(text))
        self._recorder.hand_over(NoteEvent(self._t(host_now()), 0, text))


__all__ = ["Devices", "Figures", "LiveLoop", "Status"]
