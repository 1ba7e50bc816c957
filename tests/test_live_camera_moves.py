"""The live loop while the camera moves: nothing that depends on its old pose is followed, paired or sent."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from fgreg.cli.live_display import status_line
from fgreg.detection.results import MarkerFit
from fgreg.drivers.base import CommandKind, MotionSample, OperatorCommand, PaFrame, Registration, StereoFrame, host_now
from fgreg.errors import EventRefused, FgregError, JournalError
from fgreg.geometry.transforms import FloatArray, make_transform
from fgreg.live import aims, marker_tracker
from fgreg.live.loop import SEND_S, LiveLoop
from fgreg.live.marker_tracker import MarkerTracker
from fgreg.live.pulse_locator import PulseLocator
from fgreg.live.recorder import Recorder
from fgreg.live.scope_holder import HolderMove
from fgreg.live.status import Devices
from fgreg.live.workflow import Workflow, WorkflowSettings
from fgreg.model.estimate import Verdict
from fgreg.model.events import CameraMovedEvent
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.time_sync import Stamp, TimedPose
from fgreg.online.engine import OnlineRegistration
from fgreg.online.live_session import LiveSession
from fgreg.online.shared_snapshot import Received
from fgreg.session.session_reader import read_session
from fgreg.simulation.documents import session_document
from fgreg.simulation.room import Room, room_config
from fgreg.stage.client import Report, StageView
from fgreg.stage.interface import StageStatus
from fgreg.stage.limits import MotionKind

MOVED = make_transform(np.eye(3), np.array([6.0, 0.0, 0.0]))


class Device:
    """A device that sends what it is given."""

    def __init__(self, name: str) -> None:
        self.name, self.connected, self.dropped = name, True, 0
        self.waiting: list[Any] = []
        self.messages: list[str] = []
        self.sent: list[Registration] = []

    def poll(self) -> Sequence[Any]:
        found, self.waiting = self.waiting, []
        return found

    def tell(self, text: str, *, done: bool = False, wants: CommandKind | None = None) -> None:
        self.messages.append(f"{text} {done} {wants}")

    def send(self, registration: Registration) -> None:
        self.sent.append(registration)

    def close(self) -> None:
        self.connected = False


class Link:
    """A stage that has been homed and may follow; ``beats``: registrations it was sent, ``orders`` to follow."""

    def __init__(self) -> None:
        self.beats: list[str | None] = []
        self.orders: list[float] = []

    @property
    def link(self) -> Link:
        return self

    @property
    def view(self) -> StageView:
        now = host_now()
        status = StageStatus(Stamp(now, now), 0.0, 0.0, moving=False, homed=True, homing=False, fault="")
        return StageView(now, True, status, None, MotionKind.TRACK, None)

    def poll(self) -> list[Report]:
        return []

    def beat(self, _marker_s: float | None, registration: str | None) -> None:
        self.beats.append(registration)

    def track_to(self, scan_rad: float, _sigma_rad: float, _reason: str) -> None:
        self.orders.append(scan_rad)

    def stop(self, _reason: str) -> None:
        raise AssertionError("a reported move needs no stop: the gate holds what follows")


class Stand:
    """A loop at a session that is registered and follows; the marker is where the session's last query had it."""

    def __init__(self, session: LiveSession, engine: OnlineRegistration, model: SessionModel) -> None:
        self.session = session
        self.camera, self.probe, self.operator, self.arm, self.sink = (
            Device(name) for name in ("camera", "probe", "operator", "arm", "sink")
        )
        self.link = Link()
        self.recorder = Recorder(session)
        devices: Any = Devices(self.camera, self.probe, self.operator, motion=self.arm, sinks=(self.sink,))
        devices.stage = self.link
        workflow = Workflow(model, WorkflowSettings(aims=0, pms=1, most_pms=1, hearing_threshold=0.1))

        class Reader:
            def read(self) -> Received:
                return Received(engine.snapshot(), 1, 0.0, 0.0, False)

        reader: Any = Reader()
        self.loop = LiveLoop(model, devices, self.recorder, reader, workflow, host_now() - 1000.0)
        self.marker = session.measurements().pairs[-1].marker.camera_T_marker
        self.base_T_camera: FloatArray = np.eye(4)

    def turn(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Steps of the loop with a pose and a sample of the holder in each."""
        end = host_now() + seconds
        while host_now() < end and not until():
            now = host_now()
            self.loop.marker_tracker.newest = StereoFrame(Stamp(now, now), np.zeros((2, 2), np.uint8), None, 0)
            self.loop.marker_tracker.poses.add(TimedPose(now, self.marker, 1e-6 * np.eye(6)))
            self.arm.waiting.append(MotionSample(Stamp(now, now), self.base_T_camera))
            self.loop.turn()
            time.sleep(0.02)

    def moves(self) -> list[CameraMovedEvent]:
        return [e for e in read_session(self.session.journal.folder).events if isinstance(e, CameraMovedEvent)]


@contextmanager
def standing(folder: Path) -> Iterator[Stand]:
    setup = yaml.safe_load((folder / "session.yaml").read_text())
    document = session_document(room_config(1).scene)
    setup |= {key: document[key] for key in ("camera", "marker", "board")}
    setup["probe"]["channels"] = document["probe"]["channels"]
    (folder / "session.yaml").write_text(yaml.safe_dump(setup))
    engines: list[OnlineRegistration] = []

    def make(model: SessionModel, config: SolveConfig) -> OnlineRegistration:
        engines.append(OnlineRegistration(model, config))
        return engines[-1]

    with LiveSession.open(folder, make_engine=make, late=True) as session:
        stand = Stand(session, engines[-1], session.journal.model)
        try:
            yield stand
        finally:
            stand.recorder.close()
            stand.loop.close()


@pytest.fixture
def stand(pose_session: Path) -> Iterator[Stand]:
    with standing(pose_session) as found:
        found.turn(1.0)
        assert found.link.beats[-1] in ("ok", "warning")
        yield found


def test_a_move_by_the_arm_holds_everything_and_then_ties_the_epochs(stand: Stand) -> None:
    epoch = stand.recorder.state.registration.epoch
    stand.base_T_camera = MOVED
    stand.turn(0.1)
    assert stand.link.beats[-1] is None
    shown = stand.loop.status()
    assert shown.tracking is None
    assert shown.verdict is Verdict.REFUSED
    assert "moving" in shown.reasons[0]
    assert "REFUSED" in status_line(shown).upper()
    assert any("the camera moves" in text for text in stand.operator.messages)
    orders = len(stand.link.orders)
    stand.turn(0.25)
    assert len(stand.link.orders) == orders
    stand.turn(5.0, lambda: stand.recorder.state.registration.epoch > epoch and stand.link.beats[-1] is not None)
    (move,) = stand.moves()
    assert move.camera_new_T_camera_old is not None
    assert np.allclose(move.camera_new_T_camera_old, np.linalg.inv(MOVED), atol=1e-9)
    assert stand.recorder.state.registration.registered
    assert not stand.recorder.state.camera_moving


class Tags:
    """In place of the loop's static tags."""

    def __init__(self) -> None:
        self.moving_since_s: float | None = None
        self.ended: HolderMove | None = None
        self.begun_again, self.in_doubt, self.reported = 0, False, False

    def note_epoch(self, _number: int, _now_s: float, *, waits: bool) -> None:
        pass

    def take_report(self, _now_s: float) -> bool:
        self.reported = self.moving_since_s is not None
        return self.reported

    def step(self, _whole: object, _now_s: float, *, with_board: bool) -> HolderMove | None:  # noqa: ARG002
        if self.ended is not None:
            self.moving_since_s, self.reported = None, False
        ended, self.ended = self.ended, None
        return ended

    def still_until_s(self) -> float:
        return float("inf")

    def news(self) -> list[str]:
        return []

    def begin_again(self) -> None:
        self.begun_again += 1


def test_a_move_that_tags_and_arm_show_is_one_move_as_the_tags_measured_it(stand: Stand) -> None:
    tags = Tags()
    stand.loop._static_tags = tags  # type: ignore[assignment]
    epoch, since_s = stand.recorder.state.registration.epoch, host_now()
    tags.moving_since_s = since_s
    stand.base_T_camera = MOVED
    stand.turn(0.7)
    assert stand.link.beats[-1] is None
    assert not stand.moves(), "the arm is at rest again, the tags are not"
    stand.operator.waiting.append(OperatorCommand(CommandKind.MOVED))
    stand.turn(0.05)
    assert any("the static tags measure the move" in text for text in stand.operator.messages)
    measured = np.linalg.inv(MOVED) @ make_transform(np.eye(3), np.array([0.1, 0.0, 0.0]))
    tags.ended = HolderMove(since_s, measured, 1e-4 * np.eye(6))
    stand.turn(5.0, lambda: stand.recorder.state.registration.epoch > epoch and stand.link.beats[-1] is not None)
    (move,) = stand.moves()
    assert move.detected
    assert move.since_t == pytest.approx(stand.loop._t(since_s))
    assert move.camera_new_T_camera_old is not None
    assert np.allclose(move.camera_new_T_camera_old, measured)
    assert stand.recorder.state.registration.registered
    assert tags.begun_again == 0, "the tags' new poses are the reference of the new epoch"


def test_nothing_is_sent_or_lost_once_a_move_is_reported(stand: Stand, monkeypatch: pytest.MonkeyPatch) -> None:
    tags, since_s = Tags(), host_now()
    stand.loop._static_tags = tags  # type: ignore[assignment]

    def take_report(now_s: float) -> bool:
        tags.moving_since_s, tags.reported = now_s, True
        return True

    monkeypatch.setattr(tags, "take_report", take_report)
    monkeypatch.setattr("fgreg.live.loop.SEND_S", 0.0)
    stand.operator.waiting.append(OperatorCommand(CommandKind.MOVED))
    sent = len(stand.sink.sent)
    stand.turn(0.3)
    after = {registration.verdict for registration in stand.sink.sent[sent:]}
    assert after == {"refused"}, "in the step of the word already"
    command = OperatorCommand(CommandKind.CHECK, point=(100.0, 100.0, 90.0, 100.0, 0.0, 30.0))
    stand.operator.waiting.append(command)
    stand.turn(0.1)
    assert any("no check: the camera moves" in text for text in stand.operator.messages)
    assert not stand.moves()
    stand.loop.close()  # before the tags have measured it
    stand.recorder.close()
    tags.reported = False
    (move,) = stand.moves()
    assert move.camera_new_T_camera_old is None
    assert move.t >= stand.loop._t(since_s)


def test_what_is_sent_without_an_estimate_or_meanwhile_is_refused(
    stand: Stand, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert stand.sink.sent
    last, stage = stand.sink.sent[-1], stand.session.journal.model.stage
    assert last.trus_T_camera is not None
    if last.scan_rad is not None:
        assert last.stage_rad == pytest.approx(stage.device_from_scan(last.scan_rad))
    with monkeypatch.context() as context:
        context.setattr(Recorder, "state", replace(stand.recorder.state, estimate=None))
        stand.loop.marker_tracker.poses.clear()  # as after a move, with the marker out of view
        time.sleep(SEND_S)
        stand.loop.turn()
    last = stand.sink.sent[-1]
    assert (last.verdict, last.trus_T_camera, last.reasons) == ("refused", None, ("there is no registration",))
    stand.base_T_camera = MOVED
    stand.turn(0.1)
    sent = len(stand.sink.sent)
    stand.turn(0.25)
    assert len(stand.sink.sent) > sent
    for registration in stand.sink.sent[sent:]:
        assert registration.verdict == "refused"
        assert registration.trus_T_camera is None
        assert registration.scan_rad is None
        assert "moving" in registration.reasons[0]


def test_a_move_that_the_operator_reports_invalidates_until_it_is_in_the_estimate(
    stand: Stand, monkeypatch: pytest.MonkeyPatch
) -> None:
    add = stand.session.add

    def slowly(event: Any) -> Any:
        time.sleep(0.4)
        return add(event)

    monkeypatch.setattr(stand.session, "add", slowly)
    stand.operator.waiting.append(OperatorCommand(CommandKind.MOVED))
    stand.turn(0.1)
    beats = len(stand.link.beats)
    stand.turn(0.2)
    assert set(stand.link.beats[beats:]) == {None}
    stand.turn(2.0, lambda: not stand.recorder.state.camera_moving)
    assert len(stand.moves()) == 1


def refusing_moves(stand: Stand, monkeypatch: pytest.MonkeyPatch, error: FgregError) -> list[bool]:
    """Moves are not taken in while the list's entry is true."""
    add, refuses = stand.session.add, [True]

    def refusing(event: Any) -> Any:
        if refuses[0]:
            raise error
        return add(event)

    monkeypatch.setattr(stand.session, "add", refusing)
    return refuses


def test_a_move_that_the_disk_refuses_holds_until_it_is_recorded(stand: Stand, monkeypatch: pytest.MonkeyPatch) -> None:
    full = refusing_moves(stand, monkeypatch, JournalError("events.jsonl", "no space left", "room for events"))
    stand.base_T_camera = MOVED
    stand.turn(10.0, lambda: "no space left" in stand.recorder.state.trouble)
    assert stand.recorder.state.camera_moving
    assert stand.link.beats[-1] is None
    full[0] = False
    stand.turn(10.0, lambda: not stand.recorder.state.camera_moving)
    (move,) = stand.moves()
    assert move.camera_new_T_camera_old is not None


def test_a_move_that_is_not_taken_in_invalidates_and_the_next_one_gives_no_motion_prior(
    stand: Stand, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuses = refusing_moves(stand, monkeypatch, EventRefused("of no use"))
    stand.base_T_camera = MOVED
    stand.turn(10.0, lambda: stand.recorder.state.refused > 0)
    assert stand.recorder.state.camera_moving
    assert stand.link.beats[-1] is None
    refuses[0] = False
    stand.base_T_camera = MOVED @ MOVED
    stand.turn(10.0, lambda: bool(stand.moves()) and not stand.recorder.state.camera_moving)
    (move,) = stand.moves()
    assert move.camera_new_T_camera_old is None
    assert stand.recorder.state.registration.verdict is Verdict.REFUSED


def test_latencies_move_pulses_and_pictures_apart(stand: Stand) -> None:
    model = stand.session.journal.model
    pulse_locator, marker_tracker = PulseLocator(model, latency_s=0.01), MarkerTracker(model, latency_s=0.08)
    now = host_now()
    try:
        pulse_locator.wanted = False
        pulse_locator.add_frames([PaFrame(Stamp(now, now), np.zeros((1, 1), np.int16), 0)])
        (pulse,) = pulse_locator.complete_pulses(now + 1.0, marker_tracker.poses)
        assert pulse.pulse_s == pytest.approx(now - 0.01)
    finally:
        pulse_locator.close()
    rig = model.camera
    assert rig is not None
    width, height = rig.left.image_size
    blank = np.zeros((height, width), np.uint8)
    poses: list[float] = []

    class History:
        def add(self, pose: TimedPose) -> bool:
            poses.append(pose.t_s)
            return True

    marker_tracker.poses = History()  # type: ignore[assignment]
    config = room_config(1)
    left, right = Room(config).pictures(0.0, 0)
    end = time.monotonic() + 60.0
    try:
        for number, (first, second) in enumerate([(blank, blank), (left, right)]):
            marker_tracker.add(StereoFrame(Stamp(now, now), first, second, number))
            while not marker_tracker.poll():
                assert time.monotonic() < end
                time.sleep(0.01)
            assert bool(marker_tracker.missing) is (number == 0)
    finally:
        marker_tracker.close()
    assert poses == [pytest.approx(now - 0.08)]


def test_an_aim_is_taken_from_a_picture_exposed_after_the_word(stand: Stand, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[object] = []

    def run(_work: object, left: object, *_arguments: object) -> Future[object]:
        taken.append(left)
        return Future()

    monkeypatch.setattr(stand.loop.pulse_locator.locator, "run", run)
    tracker, now = stand.loop.marker_tracker, host_now()

    def show(t_s: float) -> StereoFrame:
        tracker.newest = StereoFrame(Stamp(t_s, t_s), np.zeros((2, 2), np.uint8), None, 0)
        tracker.poses.add(TimedPose(t_s, stand.marker, 1e-6 * np.eye(6)))
        stand.loop._aims.step()
        return tracker.newest

    show(now - 0.3)  # processed late on a slow machine: the fibre may have been on its way
    stand.loop._aims.aim((1, 1))
    stand.loop._aims.step()
    assert taken == []
    newest = show(host_now() + 0.01)
    assert taken == [newest.left]
    told: list[str] = []
    monkeypatch.setattr(stand.loop._aims, "_tell", lambda tell: told.append(tell.text))
    later = host_now() + aims.BOARD_S + 1.0
    monkeypatch.setattr(aims, "host_now", lambda: later)
    stand.loop._aims.step()  # the board's process does not come to an end, or to a start
    assert told == ["no aim: the search for the board took over 30 s"]
    assert stand.loop._aims._aiming is None


def test_a_frame_in_hand_when_the_camera_has_moved_gives_no_pose(stand: Stand, monkeypatch: pytest.MonkeyPatch) -> None:
    tracker, now = stand.loop.marker_tracker, host_now()
    found = MarkerFit(SimpleNamespace(camera_T_body=stand.marker, clearance=None), ())  # type: ignore[arg-type]

    def process(t_s: float) -> None:
        tracker._flying = StereoFrame(Stamp(t_s, t_s), np.zeros((2, 2), np.uint8), None, 0), t_s
        tracker._views = [(object(),)]  # type: ignore[list-item]
        assert tracker.poll()

    monkeypatch.setattr(marker_tracker, "marker_from_views", lambda *_: found)
    monkeypatch.setattr(marker_tracker, "marker_covariance", lambda *_: np.eye(6))
    monkeypatch.setattr(marker_tracker, "pool_corner_noise", lambda _: None)
    process(now - 0.5)
    assert tracker.poses.newest() is not None
    tracker.begin_again(now)
    process(now - 0.3)
    assert tracker.poses.newest() is None
    assert "from before the camera's move" in tracker.missing
    process(now + 0.1)
    assert tracker.poses.newest() is not None
