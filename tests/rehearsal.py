"""A session in a simulated room in simulated time: no processes, no pictures, observations with known noise.

The static tags of the room, if it has any, are seen by their corners and poses with noise of their own.
"""

from __future__ import annotations

import math
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fgreg.detection.marker import ViewCorners
from fgreg.detection.marker_roi import EVERYWHERE
from fgreg.detection.tags import FoundTag
from fgreg.drivers.base import CommandKind, OperatorCommand, StereoFrame
from fgreg.drivers.simulated_stage import SimulatedStage
from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray, as_float_array, exp_so3, inverse, make_transform
from fgreg.live.actions import (
    Action,
    Ask,
    Follow,
    Halt,
    Inputs,
    LocatedPulse,
    RegistrationState,
    Release,
    StageView,
    Sweep,
    TakeAim,
    TakeMove,
    TakePairs,
    TakePoint,
    Tell,
)
from fgreg.live.marker_tracker import WholeFrame
from fgreg.live.merge_looks import one_spot
from fgreg.live.shots import move_event
from fgreg.live.static_tags import StaticTags
from fgreg.live.workflow import Workflow, WorkflowSettings
from fgreg.model.measurements import Aim, Look, MarkerObservation, Pair, Track
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.time_sync import PairRefused, PoseHistory, Stamp, TimedPose
from fgreg.online.engine import OnlineRegistration
from fgreg.online.events import CameraMoved
from fgreg.session.setup_reader import read_setup
from fgreg.simulation.documents import session_document
from fgreg.simulation.room import Room
from fgreg.stage.limits import MotionKind

SIGMA_RAD, SIGMA_MM = 0.003, np.array([0.05, 0.05, 0.2])
PULSE_S = 0.1
TRACK_SIGMA_RAD = math.radians(2.0)
TAG_SIGMA_RAD, TAG_SIGMA_MM, CORNER_PX = 0.0005, 0.03, 0.3


class SeenTags:
    """Static tags of a room as its camera sees them, in place of the pictures and of the process that fits poses."""

    busy = False

    def __init__(self, room: Room, rng: np.random.Generator) -> None:
        self._room, self._rng, self._now_s = room, rng, 0.0

    def whole(self, now_s: float) -> WholeFrame:
        """A frame searched as a whole: the corners (px) of the tags that are in the picture."""
        self._now_s = now_s
        rig = self._room.config.scene.camera
        sides = [(rig.left, np.eye(4))]
        if rig.right is not None and rig.right_T_left is not None:
            sides.append((rig.right, rig.right_T_left))
        views = []
        for camera, view_T_camera in sides:
            found = []
            for tag in self._room.config.scene.static_tags:
                half = 0.5 * tag.size_mm
                square = np.array([[-half, half], [half, half], [half, -half], [-half, -half]])
                pose = view_T_camera @ self._poses()[tag.id]
                points = np.column_stack([square, np.zeros(4)]) @ pose[:3, :3].T + pose[:3, 3]
                pixels = points @ camera.matrix.T
                corners = pixels[:, :2] / pixels[:, 2:] + CORNER_PX * self._rng.standard_normal((4, 2))
                if np.all(points[:, 2] > 0) and np.all((corners > 0) & (corners < camera.image_size)):
                    found.append(FoundTag(tag.id, corners))
            views.append(ViewCorners(None, (), (), np.zeros((0, 2)), tuple(found)))
        picture = np.zeros((2, 2), np.uint8)
        frame = StereoFrame(Stamp(now_s, now_s), picture, picture if len(views) > 1 else None, 0)
        return WholeFrame(now_s, frame, views[0], views[1] if len(views) > 1 else None)

    def _poses(self) -> dict[int, FloatArray]:
        camera_T_trus = inverse(self._room.trus_T_camera(self._now_s))
        return {tag: np.asarray(camera_T_trus @ pose) for tag, pose in self._room.trus_T_tags(self._now_s).items()}

    def run(self, _work: object, view: Any) -> Future[Any]:
        """Poses with noise, and its covariance, of the tags in the frame."""
        seen = set.intersection(*({tag.id for tag in tags} for _, tags in view.views))
        sigma = np.array([TAG_SIGMA_RAD] * 3 + [TAG_SIGMA_MM] * 3)
        done: Future[Any] = Future()
        noise = {tag: sigma * self._rng.standard_normal(6) for tag in seen}
        done.set_result(
            {
                tag: (pose @ make_transform(exp_so3(noise[tag][:3]), noise[tag][3:]), np.diag(sigma**2))
                for tag, pose in self._poses().items()
                if tag in seen
            }
        )
        return done


@dataclass(eq=False)
class Rehearsal:
    """One session; :meth:`run` advances the time.

    Attributes:
        obliging: whether the operator gives the commands that are asked for.
        frame_s: interval of the pictures.
        no_source_from_s: from this time the probe detects nothing. no_marker_from_s: the camera sees no marker.
        no_picture_from_s: no picture is looked at.
        latched: why the stage may not move, as from the safety gate; a release clears it.
        messages: all messages to the operator, with their times. actions: all other actions.
        begun_mm: error of the registration and its prediction when the stage began to follow; set by the test.
        errors_deg: error of the plane's angle at the end of each hold while the stage follows.
    """

    room: Room
    threshold: float = 0.45
    obliging: bool = True
    frame_s: float = 1.0 / 30.0
    no_source_from_s: float = math.inf
    no_marker_from_s: float = math.inf
    no_picture_from_s: float = math.inf
    latched: str = ""
    now_s: float = 0.0
    messages: list[tuple[float, Tell]] = field(default_factory=list)
    actions: list[tuple[float, Action]] = field(default_factory=list)
    errors_deg: list[float] = field(default_factory=list)
    begun_mm: tuple[float, float] = (math.inf, 0.0)

    def __post_init__(self) -> None:
        config = self.room.config.scene
        problems: list[InputError] = []
        model = read_setup(session_document(config), "session.yaml", "room", problems).model
        assert model is not None, problems
        self.model: SessionModel = model
        self.stage = SimulatedStage(self.model.stage, device_rad=math.radians(20.0), clock=lambda: self.now_s)
        self.engine = OnlineRegistration(self.model, SolveConfig())
        settings = WorkflowSettings(aims=self.room.config.aims, hearing_threshold=self.threshold)
        self.workflow = Workflow(self.model, settings)
        self.poses = PoseHistory()
        self.requested: MotionKind | None = None
        self._rng = np.random.default_rng(self.room.config.seed)
        self._said: list[OperatorCommand] = []
        self._aimed_s, self._next_pulse, self._number, self._aims = -math.inf, 0.0, 0, 0
        self._noted_s, self._frames = -math.inf, 0
        self._seen = SeenTags(self.room, np.random.default_rng((self.room.config.seed, 12)))
        self._tags = StaticTags(self.model, self._seen) if config.static_tags else None  # type: ignore[arg-type]

    def run(self, seconds: float) -> None:
        """Advance the time."""
        end = self.now_s + seconds
        while self.now_s < end:
            self._frame()

    def say(self, kind: CommandKind) -> None:
        """A word of the operator."""
        self._said.append(OperatorCommand(kind))

    def _frame(self) -> None:
        self.now_s += self.frame_s
        room, now = self.room, self.now_s
        room.pass_to(now)
        if self._tags is not None:
            self._follow_camera(self._tags)
        if now < min(self.no_marker_from_s, self.no_picture_from_s):
            self.poses.add(self._observed(now))
        status = self.stage.status()
        heard = []
        while self._next_pulse <= now - self.frame_s:  # the poses about it are there
            heard.append(self._pulse(self._next_pulse, status.moving))
            self._next_pulse += PULSE_S
        estimate = self.engine.estimate
        answer = None
        newest = self.poses.newest()
        if newest is not None and estimate.trus_T_camera is not None:
            answer = self.engine.track(Track(now, estimate.epoch, self._marker(newest), (), status.scan_rad))
        place = room.place
        if place.corner is not None and self._aimed_s < room.arrives_s() < now - 0.5:
            self._aimed_s = now
            self._said.append(OperatorCommand(CommandKind.AIM, place.corner))
        view = Inputs(
            now,
            self.poses,
            StageView(status.scan_rad, status.moving, status.homed, now, self.requested, self.latched),
            tuple(heard),
            tuple(self._said),
            RegistrationState(
                estimate.verdict,
                estimate.reasons,
                estimate.epoch,
                estimate.pairs,
                estimate.trus_T_camera is not None,
            ),
            answer,
            self._aims,
            None if self._tags is None else self._tags.moving_since_s,
            math.inf if self._tags is None else self._tags.still_until_s(),
            min(now, self.no_picture_from_s),
        )
        self._said = []
        for action in self.workflow.step(view):
            self._do(action)
        resting = now - room.arrives_s()
        answered = answer is not None and answer.stage_rad is not None
        if resting > 5.0 and self._noted_s < room.arrives_s() and self.requested is MotionKind.TRACK and answered:
            self._noted_s = now
            if answer is not None and answer.sigma_rad is not None and answer.sigma_rad < TRACK_SIGMA_RAD:
                self.errors_deg.append(math.degrees(abs(status.scan_rad - room.plane_rad(now))))
            room.proceed(now)

    def _follow_camera(self, tags: StaticTags) -> None:
        """What the static tags show of the camera, in the frames that are searched as a whole."""
        self._frames += 1
        whole = self._seen.whole(self.now_s) if self._frames % EVERYWHERE == 0 or tags.in_doubt else None
        move = tags.step(whole, self.now_s, with_board=False)
        self.messages += [(self.now_s, Tell(text)) for text in tags.news()]
        if move is not None:
            told = move_event(self.now_s, move, [], lambda host_s: host_s)
            motion, covariance = told.camera_new_T_camera_old, told.covariance
            self.engine.add(CameraMoved(told.t, motion, covariance, told.detected, told.since_t))
            self.poses.clear()

    def _do(self, action: Action) -> None:
        if not isinstance(action, Tell):
            self.actions.append((self.now_s, action))
        match action:
            case Ask(kind):
                self.requested = kind
                if kind is MotionKind.HOME:
                    self.stage.home(math.radians(10.0))
                    self.requested = None
            case Sweep(scan_rad):
                assert self.requested is MotionKind.SEARCH
                self.stage.move_to(scan_rad, math.radians(20.0))
            case Follow(scan_rad):
                assert self.requested is MotionKind.TRACK
                self.stage.move_to(scan_rad, math.radians(20.0))
            case Halt():
                self.requested = None
                self.stage.stop()
            case Release():
                self.latched = ""
            case TakeAim():
                self._aim()
            case TakeMove():
                if self._tags is None or not self._tags.take_report(self.now_s):
                    self.engine.add(CameraMoved(self.now_s))
                    if self._tags is not None:
                        self._tags.begin_again()
            case TakePoint():
                raise AssertionError("no one measured a point")
            case TakePairs(pm, looks):
                spot = one_spot(looks)
                for look in spot.looks:
                    self._pair(pm, spot.marker, look)
            case Tell():
                self.messages.append((self.now_s, action))
                if action.wants is not None and self.obliging:
                    self._said.append(OperatorCommand(action.wants))
                if action.done:
                    self.room.proceed(self.now_s)

    def _observed(self, t_s: float) -> TimedPose:
        true = self.room.camera_T_marker(t_s)
        turn = exp_so3(SIGMA_RAD * self._rng.standard_normal(3))
        pose = make_transform(true[:3, :3] @ turn, true[:3, 3] + SIGMA_MM * self._rng.standard_normal(3))
        about = true[:3, :3].T @ np.diag(SIGMA_MM**2) @ true[:3, :3]
        covariance = np.zeros((6, 6))
        covariance[:3, :3], covariance[3:, 3:] = SIGMA_RAD**2 * np.eye(3), about
        return TimedPose(t_s, pose, as_float_array(covariance, 6, 6))

    def _pulse(self, t_s: float, moving: bool) -> LocatedPulse:
        room, config, rng = self.room, self.room.config.scene, self._rng
        scan = self.stage.model.scan_from_device(self.stage.device_rad)
        source = room.spot_mm(t_s)
        marker, unpaired = None, ""
        try:
            marker = self.poses.at(t_s)
        except PairRefused as error:
            unpaired = str(error)
        radius = config.probe.radius_mm
        distance = math.hypot(source[1] - radius * math.sin(scan), source[2] - radius * math.cos(scan))
        width = math.radians(6.0) + room.scene.window_edge_rad
        amplitude = float(config.elevation.amplitude(room.plane_rad(t_s) - scan, width))
        amplitude *= math.exp(0.05 * rng.standard_normal())
        where = None if moving else scan + config.noise.scan_rad * rng.standard_normal()
        if not self.workflow.wants_pulses:  # then it is not processed (fgreg.live.pulse_locator)
            return LocatedPulse(t_s, None, marker, unpaired)
        if amplitude < self.threshold or t_s >= self.no_source_from_s:
            return LocatedPulse(t_s, where, marker, unpaired)
        x = float(source[0]) + config.noise.lateral_mm * rng.standard_normal()
        covariance = np.diag([config.noise.lateral_mm**2, config.noise.range_mm**2])
        distance += config.noise.range_mm * rng.standard_normal()
        return LocatedPulse(t_s, where, marker, unpaired, x, distance, covariance, amplitude)

    def _observation(self, pm: int, pose: TimedPose) -> MarkerObservation:
        """One observation per PM."""
        return MarkerObservation(
            as_float_array(pose.parent_T_child, 4, 4), as_float_array(pose.covariance, 6, 6), 1_000_000 + pm
        )

    def _marker(self, pose: TimedPose) -> MarkerObservation:
        self._number += 1
        return MarkerObservation(
            as_float_array(pose.parent_T_child, 4, 4), as_float_array(pose.covariance, 6, 6), self._number
        )

    def _aim(self) -> None:
        newest, place = self.poses.newest(), self.room.place
        assert newest is not None
        assert place.corner is not None
        assert place.trus_T_board is not None
        square = self.room.config.scene.board.square_mm
        spot = place.trus_T_board @ np.array([place.corner[0] * square, place.corner[1] * square, 0.0, 1.0])
        camera_p = (np.linalg.inv(self.room.trus_T_camera(self.now_s)) @ spot)[:3]
        self.engine.add(Aim(self.now_s, self._marker(newest), camera_p, 0.3**2 * np.eye(3)))
        self._aims += 1
        self.room.proceed(self.now_s)

    def _pair(self, pm: int, pose: TimedPose, look: LocatedPulse) -> None:
        assert look.scan_rad is not None
        assert look.x_mm is not None
        assert look.range_mm is not None
        assert look.covariance is not None
        noise = self.model.noise
        made = Look(
            look.scan_rad, noise.scan_rad, look.x_mm, look.range_mm, look.covariance, look.sweep, look.amplitude
        )
        self.engine.add(Pair(self.now_s, pm, 0, self._observation(pm, pose), made))

    def error_mm(self) -> float:
        """Largest error of the registration at the targets; infinite without one."""
        estimate = self.engine.estimate
        if estimate.trus_T_camera is None:
            return math.inf
        targets: FloatArray = np.column_stack([self.model.targets_mm, np.ones(len(self.model.targets_mm))])
        wrong = estimate.trus_T_camera @ np.linalg.inv(self.room.trus_T_camera(self.now_s))
        return float(np.linalg.norm((targets @ wrong.T - targets)[:, :3], axis=1).max())
