"""The live loop: frames and pulses in, events and stage orders out, once per frame.

One step: newest marker pose -> angle to turn to (from the shared snapshot, which is read without waiting) -> actions of
the workflow -> stage watchdog, recorder, operator. The loop polls all devices; none of them can block it. What takes
processor time, above all the marker's detection, runs in worker processes of lower priority: a step takes some
milliseconds, so that its heartbeat comes also from a machine that others keep busy.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Protocol

from fgreg.camera_moves.validity import Validity
from fgreg.drivers.base import BmodeFrame, CommandKind, DeviceLost, host_now
from fgreg.drivers.operator_words import asked
from fgreg.live.actions import (
    Action,
    Ask,
    Follow,
    Halt,
    Inputs,
    LocatedPulse,
    Release,
    Sweep,
    TakeAim,
    TakeChoice,
    TakeMove,
    TakePairs,
    TakePoint,
    TakeVerify,
    Tell,
)
from fgreg.live.aims import AimTaker
from fgreg.live.device_health import Health, Pictures, Source
from fgreg.live.heard_words import HeardWords
from fgreg.live.marker_tracker import MarkerTracker
from fgreg.live.merge_looks import one_spot
from fgreg.live.overlay_feed import OverlayFeed
from fgreg.live.pace import Pace
from fgreg.live.pulse_locator import PulseLocator
from fgreg.live.recorder import Recorder
from fgreg.live.scope_holder import Holder, HolderMove, HolderSettings
from fgreg.live.sent_registration import sent_registration
from fgreg.live.shots import move_event, pair_events, point_event, query_event
from fgreg.live.stage_commands import Steering
from fgreg.live.static_tags import StaticTags
from fgreg.live.status import Devices, Figures, Status
from fgreg.live.verification import LiveVerification
from fgreg.live.workflow import Stage, Workflow
from fgreg.model.estimate import TrackEstimate, Verdict
from fgreg.model.events import (
    CameraMovedEvent,
    CheckEvent,
    ExcludeEvent,
    IncludeEvent,
    NoteEvent,
    PointEvent,
)
from fgreg.model.measurements import MarkerObservation, Track
from fgreg.model.session_model import SessionModel
from fgreg.model.time_sync import Latencies, TimedPose
from fgreg.online.shared_snapshot import NoSnapshotError, Received
from fgreg.schema.problems import numbers_text
from fgreg.tracking.query import track
from fgreg.tracking.snapshot import Snapshot

IDLE_S, SLOW_IDLE_S = 0.002, 0.01
"""Time between two polls for a frame, and on a slow machine: each poll competes with the threads of devices."""
STEP_S = 0.02
"""Time between two steps of the loop while no frames come."""
SEND_S = 0.2
"""Time between two messages with the registration."""
STALE_S = 3.0
"""An engine that has been silent for this long hangs, and camera moves would go undetected. The first pairs of an epoch
may take a second on a busy machine."""
SENDERS = ("camera", "probe", "motion", "bmode")
"""Roles of devices that send without being asked."""


class Snapshots(Protocol):
    """Source of the estimate's snapshots."""

    def read(self) -> Received:
        """The latest snapshot; ``closed`` if no more will come. Raises NoSnapshotError if there is none yet."""


class LiveLoop:
    """Runs a session with devices.

    Args:
        model: session model.
        devices: connected devices; their owner closes them.
        recorder: of the session.
        reader: of the estimate's snapshots.
        workflow: decides what happens next.
        start_s: host time of session time 0.
        holder: accuracy of the endoscope's holder, if there is one (``devices.motion``).
        latencies: of the devices.
        overlay: shows ``devices.overlay`` the pictures; None without one.
    """

    def __init__(
        self,
        model: SessionModel,
        devices: Devices,
        recorder: Recorder,
        reader: Snapshots,
        workflow: Workflow,
        start_s: float,
        holder: HolderSettings | None = None,
        latencies: Latencies | None = None,
        overlay: OverlayFeed | None = None,
    ) -> None:
        self._model, self._devices, self._recorder, self._reader = model, devices, recorder, reader
        self._workflow, self._start_s, self._overlay = workflow, start_s, overlay
        latencies = latencies or Latencies()
        self.marker_tracker, self.pulse_locator = (
            MarkerTracker(model, latencies.camera_s),
            PulseLocator(model, latencies.pulse_s),
        )
        self._holder = Holder(holder or HolderSettings(), latencies.holder_s)
        self._static_tags = StaticTags(model, self.pulse_locator.locator)
        self._by_holder: list[HolderMove] = []  # moves that have ended, not recorded yet
        self._by_tags: HolderMove | None = None
        self._camera_moving_s: float | None = None
        self.figures = Figures()
        self._began_s = host_now()
        self._health, self._pictures = Health(), Pictures(model.camera)
        self._sources = {
            role: Source(device, self._began_s, sends=role in SENDERS) for role, device in devices.roles().items()
        }
        self._steering = Steering(devices.stage, self._health, lambda text: self._news(Tell(text)), self._began_s)
        self._words = HeardWords()
        self._verification = LiveVerification(model, self.pulse_locator.locator)
        self._aims = AimTaker(
            model, self.marker_tracker, self.pulse_locator.locator, self._tell, recorder.hand_over, self._t
        )
        self._text, self._task, self._number, self._unshown = "", "", 0, 0
        self._pace = Pace(self._began_s)
        self._unused = 0  # frames that were older than another, repeated, or of another size
        self._bmode: BmodeFrame | None = None
        self._sent_s, self._stepped_s = -math.inf, -math.inf
        self._sent = False  # whether the sinks have got anything
        self._snapshot: Snapshot | None = None
        self._tracking: TrackEstimate | None = None

    def run(self, going: Callable[[], bool], on_status: Callable[[Status], None] | None = None) -> None:
        """Step while ``going`` returns True."""
        while going():
            if not self.turn():
                time.sleep(SLOW_IDLE_S if self._pace.slow else IDLE_S)
            elif on_status is not None:
                on_status(self.status())

    def turn(self) -> bool:
        """One step; whether there was anything to do."""
        self._take_frames()
        processed = self.marker_tracker.poll()
        now = host_now()
        if not processed and now - self._stepped_s < STEP_S:
            return False
        self._pace.step(now)
        pose = self._processed() if processed else None
        self._take_pulses()
        self._show()
        self._follow_camera()
        if (plane := self._steering.poll()) is not None:
            self.pulse_locator.plane(plane.at_s, plane.scan_rad, plane.moving)
        self._tracking = self._track_beam(pose)
        self._stepped_s = now
        self._say_pace(now)
        newest, verdict = self.marker_tracker.poses.newest(), self._verdict()
        self._steering.beat(None if newest is None else newest.t_s, None if verdict is None else verdict.value)
        for action in self._workflow.step(self._inputs(now)):
            self._do(action)
        self._aims.step()
        self._take_verification()
        if processed and self.marker_tracker.newest is not None:
            latency_s = host_now() - self.marker_tracker.newest.stamp.host_s
            self.figures.latency_ms.append(1e3 * latency_s)
            self._pace.frame(now, latency_s)
        self._send(now)
        if self._overlay is not None:
            self._overlay.show(self.status())
        self._check_devices(host_now())
        if text := self._words.news(host_now()):
            self._note(text)
        return True

    def _say_pace(self, now: float) -> None:
        """Say what this machine can do before anything moves, and what is too slow; hold the stage until then."""
        for text in () if self.marker_tracker.trouble else self._pace.news(now):  # a dead process is not a slow machine
            self._note(text)
        self._workflow.not_yet = self._pace.not_yet(now)

    @property
    def lost(self) -> Mapping[str, str]:
        """Why each lost device is lost, by role."""
        return self._health.lost

    def status(self) -> Status:
        """Current status of the session."""
        return Status(
            now := host_now(),
            self._t(now),
            self._workflow.stage,
            self._text,
            self._task,
            self._recorder.state,
            self._tracking,
            self._steering.view,
            self._steering.latched,
            tuple(self._health.lost),
            self.marker_tracker.poses.newest(),
            self.marker_tracker.newest,
            self._bmode,
            self._invalid(),
            self._words.last,
            self._words.refused,
            self._pace.slow,
        )

    def close(self) -> None:
        """End the worker processes; pairs that still wait, and a reported move without its motion, are recorded."""
        for pairs in self._workflow.still_held():
            self._do(pairs)
        if self._static_tags.reported:
            self._recorder.hand_over(CameraMovedEvent(self._t(host_now()), 0))
        self.marker_tracker.close()
        self.pulse_locator.close()

    # --- in ---------------------------------------------------------------------------------------------------------

    def _take_frames(self) -> None:
        frames = self._sources["camera"].poll()
        if not frames:
            return
        now = host_now()
        new = self._pictures.is_new(frames[-1], now)
        self._pace.arrived(now, len(frames))
        self._unused += len(frames) - new
        if new:
            self.marker_tracker.add(frames[-1])
        self.figures.skipped = self._unused + self.marker_tracker.dropped

    def _processed(self) -> TimedPose | None:
        """The pose in the frame that was processed last; None if the marker was not found."""
        self.figures.frames += 1
        if self.marker_tracker.missing:
            return None
        self.figures.found += 1
        return self.marker_tracker.poses.newest()

    def _take_pulses(self) -> None:
        self.pulse_locator.wanted = self._workflow.wants_pulses
        pulses = self._sources["probe"].poll()
        self.figures.pulses += len(pulses)
        self.pulse_locator.add_frames(pulses)
        self._words.add(self._sources["operator"].poll())

    def _show(self) -> None:
        """Take the newest B-mode picture, which is only displayed."""
        device = self._devices.bmode
        if device is None:
            return
        pictures = self._sources["bmode"].poll()
        if pictures:
            self.figures.pictures += len(pictures)
            self._unshown += len(pictures) - 1
            self._bmode = pictures[-1]
        elif not device.connected:
            self._bmode = None  # an old picture must not look like a new one
        self.figures.unshown = self._unshown + device.dropped

    def _follow_camera(self) -> None:
        """Update since when the camera has been moving: by its holder, the static tags, and the recorded moves."""
        now = host_now()
        if self._devices.motion is not None:
            move = self._holder.take(self._sources["motion"].poll(), now)
            self._by_holder += [] if move is None else [move]
        aiming, state = self._workflow.stage is Stage.AIMING, self._recorder.state
        self._static_tags.note_epoch(state.registration.epoch, now, waits=state.camera_moving)
        move = self._static_tags.step(self.marker_tracker.whole, now, with_board=not aiming)
        if self._static_tags.in_doubt:
            self.marker_tracker.search_whole()
        if move is not None and (first := self._by_tags) is not None:  # the second one alone is not the motion
            move = HolderMove(first.since_s, None, None, first.reported or move.reported)
        self._by_tags = move or self._by_tags
        for text in self._static_tags.news():
            self._note(text)
        if (self._by_tags or self._by_holder) and self._move_under_way_s() is None:
            self._record_move(now)
        self._find_moving(now)

    def _move_under_way_s(self) -> float | None:
        """Host time since which the holder or the static tags show a move that has not ended; None at rest."""
        since_s = self._holder.moving_since_s, self._static_tags.moving_since_s
        return min((t for t in since_s if t is not None), default=None)

    def _find_moving(self, now: float) -> None:
        """Update since when the registration is invalid for a camera move."""
        since_s = self._move_under_way_s()
        if since_s is None and self._recorder.state.camera_moving:
            since_s = now if self._camera_moving_s is None else self._camera_moving_s
        if since_s is not None and self._camera_moving_s is None:
            self._tell(Tell("the camera moves: the registration is invalid until it rests and is registered again"))
            if self._verification.forget():
                self._news(Tell("the verification ends without a result: the camera moves"))
        self._camera_moving_s = since_s

    def _record_move(self, now: float) -> None:
        """Record the move that has ended."""
        by_tags, by_holder = self._by_tags, self._by_holder
        self._by_tags, self._by_holder = None, []
        if by_tags is None:
            self._static_tags.begin_again()
        self._recorder.hand_over(move_event(self._t(now), by_tags, by_holder, self._t))
        self.marker_tracker.begin_again(now)

    def _take_report(self, now: float) -> None:
        """Take in that the operator reports a camera move: nothing counts from now on until it is in the estimate."""
        if self._static_tags.take_report(now):
            self._news(Tell("the static tags measure the move: it is recorded once the camera rests"))
        else:
            self._static_tags.begin_again()
            self._recorder.hand_over(CameraMovedEvent(self._t(now), 0))
        self._find_moving(now)
        self._tracking = None

    def _track_beam(self, pose: TimedPose | None) -> TrackEstimate | None:
        """Tracking result for the new pose; without one the last result, as long as its pose is recent."""
        try:
            received = self._reader.read()
        except NoSnapshotError:
            return None
        self._snapshot = received.snapshot
        stale = received.silent_s > STALE_S or received.closed
        begins_again = self._recorder.state.choosing  # its process is replaced by another
        self._health.found("registration", "its process has ended or hangs" if stale and not begins_again else "")
        if stale or self._camera_moving_s is not None or self._recorder.state.choosing:
            return None
        if pose is None:
            newest = self.marker_tracker.poses.newest()
            return self._tracking if newest is not None and host_now() - newest.t_s < 0.2 else None
        if self._snapshot is None or not self._snapshot.epochs:
            return None
        self._number += 1
        plane = self._steering.view
        query = Track(
            self._t(pose.t_s),
            self._snapshot.epochs[-1].number,
            MarkerObservation(pose.parent_T_child, pose.covariance, self._number),
            (),
            0.0 if plane is None else plane.scan_rad,
        )
        return track(query, self._snapshot)

    def _inputs(self, now: float) -> Inputs:
        commands, state = self._words.take(host_now()), self._recorder.state
        return Inputs(
            now,
            self.marker_tracker.poses,
            self._steering.view,
            self.pulse_locator.complete_pulses(now, self.marker_tracker.poses),
            commands,
            state.registration,
            self._tracking,
            state.aims,
            self._camera_moving_s,
            self._static_tags.still_until_s(),
            -math.inf if self.marker_tracker.newest is None else self.marker_tracker.newest.stamp.host_s,
        )

    # --- out --------------------------------------------------------------------------------------------------------

    def _t(self, host_s: float) -> float:
        """Session time."""
        return max(0.0, host_s - self._start_s)

    def _verdict(self) -> Verdict | None:
        """Verdict of the registration; None if there is no valid one."""
        registration = self._recorder.state.registration
        return registration.verdict if registration.registered and not self._invalid() else None

    def _invalid(self) -> str:
        """Why the registration is invalid; empty if it is valid."""
        if (lost := self._health.lost.get("registration")) is not None:
            return f"the registration is lost: {lost}"
        if self._recorder.state.choosing:
            return "shots were left out or taken back by hand, and it is not solved again yet"
        return "" if self._camera_moving_s is None else "the camera is moving, or its move is not in the estimate yet"

    def _do(self, action: Action) -> None:
        match action:
            case Ask() | Sweep() | Follow() | Halt() | Release():
                self.figures.orders += self._steering.order(action)
            case TakeAim(corner):
                self._aims.aim(corner)
            case TakePoint():
                self._take_point(action)
            case TakePairs(pm, looks):
                for event in pair_events(pm, one_spot(looks), self._start_s, self._model.stage):
                    self._recorder.hand_over(event)
            case TakeVerify(number, count, looks):
                self._verify(number, count, looks)
            case TakeChoice(pm, include, by):
                self._choose(pm, by, include=include)
            case TakeMove():
                self._take_report(host_now())
            case Tell():
                (self._news if action.answer else self._tell)(action)

    def _tell(self, tell: Tell) -> None:
        self._task = asked(tell.text, tell.wants)
        self._news(tell)

    def _news(self, tell: Tell) -> None:
        """A message that asks nothing of the operator; the last task stays in force."""
        self._text = asked(tell.text, tell.wants)
        self._devices.operator.tell(tell.text, done=tell.done, wants=tell.wants)

    def _take_point(self, action: TakePoint) -> None:
        """Record a check, or a known point."""
        kind = PointEvent if action.kind is CommandKind.POINT else CheckEvent
        event = point_event(kind, self._t(host_now()), action.point, action.scan_rad, self._model)
        if isinstance(event, str):
            self._news(Tell(f"no {action.kind}: {event}"))
            return
        self._recorder.hand_over(event)
        self._news(Tell(f"{action.kind} taken", done=True))

    def _choose(self, pm: int, by: str, *, include: bool) -> None:
        """Record that a PM is left out by hand, or counts again."""
        state = self._recorder.state
        there = state.excluded if include else state.pms - state.excluded
        if pm not in there:
            word, which = ("include", "that are left out") if include else ("exclude", "that count")
            self._news(Tell(f"no {word}: the PMs {which}: {numbers_text(there)}"))
            return
        kind = IncludeEvent if include else ExcludeEvent
        self._recorder.hand_over(kind(self._t(host_now()), 0, pm, reason="said in the live session", by=by))
        effect = "counts again" if include else "is left out by hand"
        self._news(Tell(f"PM {pm} {effect}: the registration is solved again"))

    def _verify(self, number: int, count: int, looks: tuple[LocatedPulse, ...]) -> None:
        """Record looks at a new PM beside the estimate, and compare the registration with them after the last."""
        events = pair_events(number, one_spot(looks), self._start_s, self._model.stage)
        self._recorder.hand_over(query_event(events))
        self._verification.add(number, events)
        if number + 1 == count and self._snapshot is not None:
            self._verification.compare(self._snapshot, self._recorder.config)

    def _take_verification(self) -> None:
        found = self._verification.result()
        if found is not None:
            text, validity = found
            self._recorder.hand_over(NoteEvent(self._t(host_now()), 0, text))
            self._tell(Tell(text, wants=CommandKind.MOVED if validity is Validity.MOVED else None))

    def _send(self, now: float) -> None:
        """Send the registration to the sinks."""
        if not self._devices.sinks or now - self._sent_s < SEND_S:
            return
        self._sent_s = now
        estimate, newest = self._recorder.state.estimate, self.marker_tracker.poses.newest()
        stamp = None if self.marker_tracker.newest is None else self.marker_tracker.newest.stamp
        begins = not self._sent and (estimate is None or newest is None)
        if stamp is None or begins:  # whoever has got a registration has to hear that there is none any more
            return
        self._sent = True
        registration = sent_registration(stamp, estimate, self._invalid(), self._tracking, self._model.stage)
        for number, sink in enumerate(self._devices.sinks):
            try:
                sink.send(registration)
            except DeviceLost as error:
                self._sources[f"sink {number + 1}"].failed(str(error))

    def _check_devices(self, now: float) -> None:
        """Update which devices are lost; report and note each change."""
        health, state, steering = self._health, self._recorder.state, self._steering
        for number, loss in [] if self._overlay is None else self._overlay.losses():
            self._sources[f"overlay {number + 1}"].failed(loss)
        for role, source in self._sources.items():
            trouble = source.trouble(now)
            health.found(role, trouble or (self._pictures.trouble(now) if role == "camera" else ""))
            if left_out := source.left_out(now):
                self._note(f"{role}: {left_out}")
        health.found("locator", self.pulse_locator.trouble)
        health.found("marker detection", self.marker_tracker.trouble)
        if "recording" in health.lost and not (state.blocked or state.waiting):
            steering.unwritten = ""  # the note about it has been written
        health.found("recording", state.blocked or steering.unwritten)
        for text in health.news():
            self._note(text)

    def _note(self, text: str) -> None:
        self._news(Tell(text))
        self._recorder.hand_over(NoteEvent(self._t(host_now()), 0, text))
