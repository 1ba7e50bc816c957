"""ROS 2, live: against a peer by other packages' keys, tokens and messages; by ``rclpy`` against a stand-in."""

from __future__ import annotations

import importlib
import json
import math
import sys
import threading
import time
import types
from collections.abc import Callable, Iterator
from typing import Any, cast

import cv2
import numpy as np
import pytest

from fgreg.drivers import ros2_messages, ros2_stage
from fgreg.drivers.base import (
    CommandKind,
    DeviceLost,
    DriverContext,
    OperatorCommand,
    OverlayPicture,
    RefusedWord,
    Registration,
    host_now,
)
from fgreg.drivers.options import (
    Ros2CameraOptions,
    Ros2MotionOptions,
    Ros2OperatorOptions,
    Ros2OverlayOptions,
    Ros2SinkOptions,
    Ros2StageOptions,
)
from fgreg.drivers.peer_words import PeerWords
from fgreg.drivers.ros2 import WORDS, Ros2Camera, Ros2Motion, Ros2Operator, Ros2Sink, check_motion
from fgreg.drivers.ros2_overlay import Ros2PictureSink
from fgreg.drivers.ros2_stream import MOST_LOSSES, Topic
from fgreg.drivers.ros2_transport import open_transport
from fgreg.geometry.transforms import as_float_array
from fgreg.model.session_model import StageModel
from fgreg.model.time_sync import Stamp
from fgreg.stage.client import Report, StageLink
from fgreg.stage.interface import StageLost
from fgreg.stage.limits import MotionKind, MotionLimits
from fgreg.testing import drivers as kit
from fgreg.testing.drivers import Bench, check_driver

REASON = "no ROS 2 peer: pip install 'fgreg[ros2]' pyzeros"
for needed in ("rosbags", "zenoh", "pyzeros", "ros2_pyterfaces"):
    pytest.importorskip(needed, reason=REASON)
ros2_peer = importlib.import_module("tests.ros2_peer")
Peer, stamped = ros2_peer.Peer, ros2_peer.stamped

ECM, LEFT, RIGHT = "/ECM/measured_cp", "/rig/left/image_raw/compressed", "/rig/right/image_raw/compressed"


@pytest.fixture
def peer() -> Iterator[Any]:
    made = Peer()
    yield made
    made.lose()


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kit, "QUIET_S", 0.02)
    monkeypatch.setattr("fgreg.drivers.ros2_transport.RETRY_MS", 20)


def way(peer: Any) -> dict[str, Any]:
    return {"through": "zenoh", "router": peer.router}


def pose(x_m: float = 0.1, turned: bool = True) -> Any:
    """At (x, -0.02, 0.15) m, turned by 90 deg about x."""
    message = ros2_peer.PoseStamped()
    position, turn = message.pose.position, message.pose.orientation
    position.x, position.y, position.z = x_m, -0.02, 0.15
    turn.x = turn.w = math.sqrt(0.5)
    return message


def jpeg(level: int, shape: tuple[int, int] = (24, 32)) -> Any:
    done, data = cv2.imencode(".jpg", np.full(shape, level, np.uint8))
    assert done
    return ros2_peer.CompressedImage(format="jpeg", data=data.ravel().tolist())


def collect(poll: Callable[[], Any], least: int, send: Callable[[], object] = lambda: None, most_s: float = 5.0) -> Any:
    """Items until there are some; what is raised goes on."""
    found: list[Any] = []
    until = time.monotonic() + most_s
    while len(found) < least:
        assert time.monotonic() < until, f"{len(found)} items of {least}"
        send()
        found += poll()
        time.sleep(0.005)
    return found


def lost(poll: Callable[[], Any], send: Callable[[], object] = lambda: None) -> str:
    """The text of the next loss."""
    until = time.monotonic() + 5.0
    while time.monotonic() < until:
        send()
        try:
            poll()
        except DeviceLost as error:
            return str(error)
        time.sleep(0.005)
    raise AssertionError("no loss was raised")


def test_sources_conform_and_survive_the_restart_of_their_peer(peer: Any) -> None:
    numbers = iter(range(10**6))
    sends: dict[str, tuple[Callable[[], Any], str, Callable[[float], Any]]] = {
        "motion": (lambda: Ros2Motion(Ros2MotionOptions(**way(peer))), ECM, lambda t: stamped(pose(), t)),
        "camera": (lambda: Ros2Camera(Ros2CameraOptions(left=LEFT, **way(peer))), LEFT, lambda t: stamped(jpeg(9), t)),
        "operator": (
            lambda: Ros2Operator(Ros2OperatorOptions(**way(peer))),
            "/fgreg/operator",
            lambda _t: ros2_peer.String(data="home"),
        ),
    }
    for role, (make, topic, message) in sends.items():
        empty = type(message(0.0))

        def spoilt(data: bytes, topic: str = topic, empty: Any = empty) -> Callable[[], None]:
            return lambda: peer.send(topic, empty(), data)

        bad = [spoilt(b""), spoilt(b"\xff" * 40), spoilt(b"\0\1\0\0" + b"\xff" * 8)]
        bad.append(lambda topic=topic: peer.send(topic, ros2_peer.JointState()))  # type: ignore[misc]
        if role == "motion":
            bad.append(lambda: peer.send(ECM, stamped(ros2_peer.PoseStamped(), time.time())))  # no rotation at all
        send = lambda topic=topic, message=message: peer.send(topic, message(100.0 + next(numbers) / 30))  # noqa: E731
        check_driver(role, Bench(make, send, peer.lose, peer.restore, bad))


def test_metres_become_millimetres_and_a_quaternion_a_rotation(peer: Any) -> None:
    motion = Ros2Motion(Ros2MotionOptions(tip_T_camera=as_float_array(np.diag([1.0, -1, -1, 1])), **way(peer)))
    try:
        (sample, *_) = collect(motion.poll, 1, lambda: peer.send(ECM, stamped(pose(), 1234.5)))
    finally:
        motion.close()
    assert sample.stamp.device_s == 1234.5
    # Rx(90 deg) = [[1, 0, 0], [0, 0, -1], [0, 1, 0]], times diag(1, -1, -1) from the right.
    expected = [[1, 0, 0, 100.0], [0, 0, 1, -20.0], [0, -1, 0, 150.0], [0, 0, 0, 1]]
    assert sample.base_T_camera == pytest.approx(np.array(expected), abs=1e-9)


def test_a_silent_topic_and_one_of_another_type_are_lost_once_and_named(peer: Any) -> None:
    motion = Ros2Motion(Ros2MotionOptions(silent_s=0.25, **way(peer)))
    try:
        collect(motion.poll, 1, lambda: peer.send(ECM, stamped(pose(), time.time())))
        assert lost(motion.poll) == "motion source: /ECM/measured_cp: no message for 0.25 s"
        assert not motion.connected
        joints = ros2_peer.JointState()
        time.sleep(0.3)
        peer.send(ECM, joints)
        assert not motion.poll()  # lost already: not said again
        assert collect(motion.poll, 1, lambda: peer.send(ECM, stamped(pose(), time.time())))
        why = lost(motion.poll, lambda: peer.send(ECM, joints))
        assert why.endswith("left out: messages of sensor_msgs/msg/JointState, expected geometry_msgs/msg/PoseStamped")
        collect(motion.poll, 1, lambda: peer.send(ECM, stamped(pose(), time.time())))
        peer.leave(ECM)
        assert lost(motion.poll).endswith("no one publishes on it any more")
    finally:
        motion.close()


def test_a_clock_that_was_set_back_is_a_loss_and_an_overtaken_message_is_left_out(peer: Any) -> None:
    motion = Ros2Motion(Ros2MotionOptions(**way(peer)))
    times = iter([100.0, 100.1, 100.05, 100.2, 40.0, 40.1])
    try:
        collect(motion.poll, 1, lambda: peer.send(ECM, stamped(pose(), 99.0)))
        seen: list[float] = []
        losses: list[str] = []
        until = time.monotonic() + 5.0
        while len(seen) < 5 and time.monotonic() < until:
            if (t := next(times, None)) is not None:
                peer.send(ECM, stamped(pose(), t))
            time.sleep(0.02)
            try:
                seen += [sample.stamp.device_s for sample in motion.poll() if sample.stamp.device_s != 99.0]
            except DeviceLost as error:
                losses.append(str(error))
        assert seen == pytest.approx([100.0, 100.1, 100.2, 40.0, 40.1])
        assert losses == ["motion source: /ECM/measured_cp: its clock went back by 60.2 s"]
        assert motion.rejected == 1
    finally:
        motion.close()


def test_two_pictures_are_one_frame_by_their_stamps_and_the_left_goes_on_alone(peer: Any) -> None:
    said: list[str] = []
    names: dict[str, Any] = {"left": LEFT, "right": RIGHT, "info": "/rig/left/camera_info", "silence_s": 0.3}
    camera = Ros2Camera(Ros2CameraOptions(**names, **way(peer)), DriverContext(said.append))
    numbers = iter(range(1000))

    def send(right: bool = True) -> None:
        t = 100.0 + next(numbers) / 30
        if right:
            peer.send(RIGHT, stamped(jpeg(200), t + 0.001))
        peer.send(LEFT, stamped(jpeg(50), t))
        info = ros2_peer.CameraInfo(width=1280, height=720, distortion_model="plumb_bob")
        info.k[:] = [1100.5, 0, 640, 0, 1101.5, 360, 0, 0, 1]
        peer.send("/rig/left/camera_info", info)

    try:
        frames = collect(camera.poll, 3, send)
        assert all(abs(int(f.left[5, 5]) - 50) < 3 and abs(int(f.right[5, 5]) - 200) < 3 for f in frames)
        assert said == [
            "CameraInfo of the left camera: 1280 x 720 px, focal lengths 1100.5 and 1101.5 px, centre 640.0, 360.0 px; "
            "the registration uses those of session.yaml"
        ]
        assert lost(camera.poll, lambda: send(right=False)).endswith("; the left camera goes on alone")
        frames = collect(camera.poll, 20, lambda: send(right=False))
        assert frames[-1].right is None
    finally:
        camera.close()


def edge(parent: str, child: str, z_m: float, t: float) -> Any:
    message = ros2_peer.TransformStamped(child_frame_id=child)
    message.transform.translation.z, message.transform.rotation.w = z_m, 1.0
    return stamped(message, t, parent)


def test_tf_goes_over_static_edges_and_a_cycle_is_no_way() -> None:
    tree = ros2_messages.FrameTree("base", "tip")
    assert not tree.take([edge("base", "arm", 0.1, 1.0)])
    assert not tree.take([edge("arm", "arm2", 0.2, 1.0)])
    ((message, found),) = tree.take([edge("arm2", "tip", 0.05, 2.0)])
    assert message.header.stamp.sec == 2
    assert found[:3, 3] == pytest.approx([0, 0, 350.0])
    assert len(tree.take([edge("base", "arm", 0.3, 3.0)])) == 1  # that one moves too
    assert not tree.take([edge("elsewhere", "other", 0.3, 3.0)])
    assert not tree.take([edge("tip", "base", 0.3, 3.0)])
    with pytest.raises(ValueError, match="base and tip have to be named"):
        check_motion(Ros2MotionOptions(topic="/tf"))


def registration(verdict: str, position: float = 100.0) -> Registration:
    matrix = np.array([[1.0, 0, 0, position], [0, 0, -1, -20], [0, 1, 0, 150], [0, 0, 0, 1]])
    covariance = np.diag([1e-4, 2e-4, 3e-4, 4.0, 5.0, 6.0])
    stamp = Stamp(host_now(), host_now())
    return Registration(stamp, verdict, as_float_array(matrix), as_float_array(covariance), 0.1, 0.01, ("why",), 0.2)


def test_a_sink_publishes_metres_with_covariance_and_never_a_refused_registration(peer: Any) -> None:
    peer.listen("/tf", ros2_peer.TFMessage)
    peer.listen("/fgreg/verdict", ros2_peer.String)
    peer.listen("/fgreg/registration", ros2_peer.PoseWithCovarianceStamped)
    got = peer.received
    sink = Ros2Sink(Ros2SinkOptions(**way(peer)))
    try:
        topics = "/tf", "/fgreg/registration", "/fgreg/verdict"
        collect(lambda: min((got[each] for each in topics), key=len), 1, lambda: sink.send(registration("warning")))
        (transform,) = got["/tf"][-1].transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("trus", "camera")
        assert abs(transform.header.stamp.sec - time.time()) < 60
        where, turn = transform.transform.translation, transform.transform.rotation
        assert (where.x, where.y, where.z) == pytest.approx((0.1, -0.02, 0.15))
        assert abs(turn.x) == pytest.approx(math.sqrt(0.5))
        # Right tangent to the parent's axes by Rx(90 deg): y and z change places. mm^2 become m^2.
        covariance = np.array(got["/fgreg/registration"][-1].pose.covariance).reshape(6, 6)
        assert np.diag(covariance) == pytest.approx([4e-6, 6e-6, 5e-6, 1e-4, 3e-4, 2e-4])
        said = json.loads(got["/fgreg/verdict"][-1].data)
        assert (said["verdict"], said["reasons"]) == ("warning", ["why"])
        assert said["plane_deg"] == pytest.approx(math.degrees(0.1))

        def refusals(reason: str) -> list[Any]:
            said = [json.loads(message.data) for message in got["/fgreg/verdict"]]
            return [each for each in said if each["verdict"] == "refused" and reason in each["reasons"]]

        # What one connection sends arrives in its order: after a refusal nothing from before it is on its way.
        collect(lambda: refusals("why"), 1, lambda: sink.send(registration("refused")))
        counts = len(got["/tf"]), len(got["/fgreg/registration"])
        bent = Registration(Stamp(1.0, host_now()), "ok", as_float_array(np.diag([2.0, 1, 1, 1])), None)
        collect(lambda: refusals("the transform is not rigid"), 1, lambda: sink.send(bent))
        assert counts == (len(got["/tf"]), len(got["/fgreg/registration"]))
    finally:
        sink.close()
    check_driver(
        "sinks",
        Bench(
            lambda: Ros2Sink(Ros2SinkOptions(**way(peer))),
            lose=peer.lose,
            restore=peer.restore,
            received=lambda: len(got["/tf"]),
        ),
    )


def test_a_static_transform_reaches_who_listens_later(peer: Any) -> None:
    sink = Ros2Sink(Ros2SinkOptions(static=True, **way(peer)))
    late, latest = (open_transport(Ros2MotionOptions(**way(peer)), ros2_messages.hash_of) for _ in range(2))
    got: list[Any] = []
    try:
        sink.send(registration("ok"))
        late.subscribe("/tf_static", ros2_messages.TF, lambda data, kind, _t: got.append((data, kind)), latched=True)
        (data, kind), *_ = collect(lambda: got, 1)
        assert ros2_messages.decode(data, kind).transforms[0].transform.translation.x == 0.1
        # Refused: who listens only now gets no transform, until there is one again.
        sink.send(registration("refused"))
        got.clear()
        latest.subscribe("/tf_static", ros2_messages.TF, lambda *_: got.append("old"), latched=True)
        time.sleep(0.2)
        assert not got
        sink.send(registration("ok"))
        assert "old" in collect(lambda: got, 2)
    finally:
        for transport in (late, latest, sink):
            transport.close()


class Fed:
    """A connection whose messages the test sends."""

    def subscribe(self, _topic: str, _kind: str, take: Any, _latched: bool, _depth: int) -> None:
        self.take = take

    def publishers(self, _topic: str) -> int:
        return 1


def test_no_message_ends_a_topic_and_losses_that_wait_are_bounded() -> None:
    fed, texts = cast("Any", Fed()), iter(range(10**6))

    def read(message: Any) -> list[Any]:
        if message.data == "bad":
            raise KeyError("of a parser")
        return [(stamped(ros2_peer.JointState(), 1000.0 - 10.0 * next(texts)), message.data)]

    topic = Topic(fed, "/words", ros2_messages.TEXT, read, None)
    try:
        for word in ("bad", *["good"] * 40):
            fed.take(ros2_messages.text(word), ros2_messages.TEXT, host_now())
        collect(lambda: list(topic._items), 1)
        collect(lambda: [0] * (topic.dropped == 39), 1)
        assert (topic.rejections.count, len(topic._losses)) == (1, MOST_LOSSES)
    finally:
        topic.close()


@pytest.mark.parametrize("topic", ["/fgreg/overlay", "/fgreg/overlay/compressed"])
def test_the_overlay_is_an_image_topic(peer: Any, topic: str) -> None:
    kind = ros2_peer.CompressedImage if topic.endswith("compressed") else ros2_peer.Image
    peer.listen(topic, kind)
    sink = Ros2PictureSink(Ros2OverlayOptions(**way(peer), topic=topic))
    image = np.zeros((48, 64, 3), np.uint8)
    image[:24, :32] = 250, 20, 20  # blue
    try:
        got = collect(
            lambda: peer.received[topic], 1, lambda: sink.send(OverlayPicture(Stamp(1.0, host_now()), image, 0))
        )
        assert abs(got[0].header.stamp.sec - time.time()) < 60
        data = np.array(list(got[0].data), np.uint8)
        if kind is ros2_peer.Image:
            assert (got[0].encoding, got[0].step) == ("bgr8", 192)
            found = data.reshape(got[0].height, got[0].width, 3)
        else:
            found = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
        assert np.abs(found[12, 16].astype(float) - (250, 20, 20)).max() < 12
        assert found[40, 50].max() < 12
    finally:
        sink.close()


def test_words_are_commands_and_answers_go_back(peer: Any) -> None:
    peer.listen("/fgreg/operator_told", ros2_peer.String)
    operator = Ros2Operator(Ros2OperatorOptions(**way(peer)), PeerWords(corners=(8, 5)))
    try:
        (command, *_) = collect(operator.poll, 1, lambda: peer.send("/fgreg/operator", ros2_peer.String(data="stop")))
        assert command.kind is CommandKind.STOP
        told = peer.received["/fgreg/operator_told"]
        collect(lambda: told, 1, lambda: operator.tell("hold still", wants=CommandKind.NEXT))
        assert told[-1].data == "hold still: say next (n)"
        peer.send("/fgreg/operator", ros2_peer.String(data="aim 9 9"))
        collect(lambda: [t for t in told if "no corner 9 9" in t.data], 1, operator.poll)
        peer.send("/fgreg/operator", ros2_peer.String(data="home"))
        (refused, *_) = collect(operator.poll, 1)
        assert isinstance(refused, RefusedWord)
        assert "a peer with a key" in told[-1].data
        peer.send("/fgreg/operator", ros2_peer.String(data="stop"))
        for _ in range(400):
            peer.send("/fgreg/operator", ros2_peer.String(data="next"))
        deadline = time.monotonic() + 10.0
        while operator.dropped < 336 and time.monotonic() < deadline:
            time.sleep(0.01)
        words = operator.poll()
        assert sum(isinstance(word, OperatorCommand) and word.kind is CommandKind.STOP for word in words) == 1
        assert operator.dropped == 400 - (len(words) - 1)
    finally:
        operator.close()


class CrtkStage:
    """A node with one joint (rad), which publishes by itself and obeys ``move_jp`` and ``state_command``."""

    def __init__(self, peer: Any) -> None:
        self.peer, self.orders, self.speed = peer, list[str](), math.radians(8.0)
        self.position, self.goal, self.state = 0.3, 0.3, "ENABLED"
        self.homed, self.velocity, self.silent = True, 0.0, False
        peer.listen("/probe/move_jp", ros2_peer.JointState)
        peer.listen("/probe/state_command", ros2_peer.StringStamped)
        peer.on_message = self.take
        self._publish(False)  # pyzeros makes publishers in the main thread only
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def take(self, topic: str, message: Any) -> None:
        if topic.endswith("move_jp"):
            self.orders.append(f"move {list(message.name)} {message.position[0]:.2f}")
            if self.state == "ENABLED":
                self.goal = message.position[0]
            return
        self.orders.append(message.string)
        if message.string == "pause":
            self.state, self.goal = "PAUSED", self.position
        elif message.string == "resume":
            self.state = "ENABLED"
        elif message.string == "home" and self.state == "ENABLED":
            self.homed, self.goal = False, 0.0

    def close(self) -> None:
        self._end.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._end.wait(0.01):
            way = self.goal - self.position
            step = min(abs(way), self.speed * 0.01)
            self.position += math.copysign(step, way)
            self.homed = self.homed or self.position == 0.0
            busy = self.position != self.goal
            if not self.silent:
                self._publish(busy)

    def _publish(self, busy: bool) -> None:
        joint = ros2_peer.JointState(name=["turn"], position=[self.position], velocity=[0.0], effort=[])
        state = ros2_peer.OperatingState(state=self.state, is_homed=self.homed, is_busy=busy)
        self.peer.send("/probe/operating_state", state)
        self.peer.send("/probe/measured_js", stamped(joint, time.time()))


MODEL = StageModel(math.radians(2.0), (math.radians(-50.0), math.radians(70.0)), -1, math.radians(10.0))


@pytest.fixture
def probe(peer: Any) -> Iterator[CrtkStage]:
    made = CrtkStage(peer)
    yield made
    made.close()


def test_a_crtk_stage_conforms(peer: Any, probe: CrtkStage) -> None:
    options = {"namespace": "/probe", **way(peer)}

    def silent(is_silent: bool) -> Callable[[], None]:
        return lambda: vars(probe).update(silent=is_silent)

    odd = ros2_peer.JointState(name=["a", "b"], position=[1.0, 2.0], velocity=[], effort=[])
    bad = [
        lambda: peer.send("/probe/measured_js", odd),
        lambda: peer.send("/probe/measured_js", odd, b"\xff" * 30),
        lambda: peer.send("/probe/operating_state", ros2_peer.String(data="x")),
    ]
    check_driver(
        "stage",
        Bench(lambda: ros2_stage.open_stage(MODEL, **options), lose=silent(True), restore=silent(False), bad=bad),
    )
    # Plane angle 0.5 rad beyond the first one; direction -1: the joint goes down from about 0 by 0.5 rad.
    end = time.monotonic() + 5.0  # on a busy machine the orders arrive late
    while not any(order.startswith("move ['turn'] -0.") for order in probe.orders):
        assert time.monotonic() < end, probe.orders
        time.sleep(0.01)
    assert "home" in probe.orders
    assert ros2_stage.ask_stage(DriverContext(print), Ros2StageOptions(**options)).startswith("stands at ")


def test_a_crtk_stage_that_falls_silent_is_told_to_stop(peer: Any, probe: CrtkStage) -> None:
    stage = ros2_stage.open_stage(MODEL, namespace="/probe", **way(peer))
    try:
        stage.move_to(MODEL.scan_from_device(math.radians(60.0)), math.radians(8.0))
        collect(lambda: [0] * (probe.goal > 1.0), 1)
        probe.silent = True  # it goes on turning
        with pytest.raises(StageLost, match="said nothing"):
            collect(list[Any], 1, stage.status)
    finally:
        stage.close()  # as the watchdog does
    collect(lambda: [0] * (probe.state == "PAUSED"), 1)


def test_the_watchdog_stops_a_crtk_stage_whose_main_program_is_silent(peer: Any, probe: CrtkStage) -> None:
    limits = MotionLimits.of_session(MODEL, search_speed_rad_s=math.radians(10.0))
    options = {"namespace": "/probe", **way(peer)}
    reports: list[Report] = []
    with StageLink.open("fgreg.drivers.ros2_stage:open_stage", options, limits, lambda _record: None) as link:

        def beat(until: Callable[[], object], most_s: float = 8.0) -> None:
            end = time.monotonic() + most_s
            while not until():
                assert time.monotonic() < end, [report.reason for report in reports]
                link.beat(time.monotonic(), "ok")
                reports.extend(link.poll())
                time.sleep(0.02)

        beat(lambda: link.view and link.view.status is not None and not link.view.status.moving)
        link.request(MotionKind.SEARCH, "test")
        link.search_to(MODEL.scan_from_device(math.radians(60.0)), "a long way")
        beat(lambda: probe.goal > 1.0)
        probe.orders.clear()
        deadline = time.monotonic() + 3.0  # no heartbeat from here on
        while probe.state != "PAUSED":
            assert time.monotonic() < deadline
            time.sleep(0.01)
        # The last order to move may have been on its way.
        assert next(order for order in probe.orders if not order.startswith("move")) == "pause"
        stood = probe.position
        time.sleep(0.1)
        assert probe.position == stood < math.radians(60.0)


def rclpy_stand_in(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[Any]]:
    """Modules with rclpy's documented names; what is published on a topic is taken by its raw subscribers."""
    calls: dict[str, list[Any]] = {"published": [], "subscribed": [], "made": []}

    class Node:
        def create_subscription(self, kind: Any, topic: str, callback: Any, profile: Any, *, raw: bool) -> None:
            assert raw
            calls["subscribed"].append((kind.__name__, topic, callback, profile))

        def create_publisher(self, kind: Any, topic: str, profile: Any) -> Any:
            assert profile.reliability == "RELIABLE"
            sent = types.SimpleNamespace()
            sent.publish = lambda data: calls["published"].append((kind.__name__, topic, data))
            calls["made"].append(sent)
            return sent

        def destroy_publisher(self, publisher: Any) -> None:
            calls["made"].remove(publisher)

        def count_publishers(self, _topic: str) -> int:
            return 1

        def count_subscribers(self, _topic: str) -> int:
            return 1

        def destroy_node(self) -> None:
            calls["published"].append("destroyed")

    class Executor:
        def __init__(self, **_: Any) -> None:
            self.node = None

        def add_node(self, node: Any) -> None:
            self.node = node

        def spin_once(self, **_: float) -> None:
            time.sleep(0.005)

        def shutdown(self, **_: float) -> None:
            return

    modules: dict[str, dict[str, Any]] = {
        "rclpy": {
            "init": lambda **_: None,
            "create_node": lambda _name, **_: Node(),
            "shutdown": lambda **_: None,
        },
        "rclpy.qos": {
            "QoSProfile": types.SimpleNamespace,
            "ReliabilityPolicy": types.SimpleNamespace(RELIABLE="RELIABLE", BEST_EFFORT="BEST_EFFORT"),
            "DurabilityPolicy": types.SimpleNamespace(TRANSIENT_LOCAL="TRANSIENT_LOCAL", VOLATILE="VOLATILE"),
        },
        "rclpy.executors": {"SingleThreadedExecutor": Executor},
        "rclpy.context": {"Context": object},
        "geometry_msgs.msg": {"PoseStamped": type("PoseStamped", (), {})},
        "std_msgs.msg": {"String": type("String", (), {})},
    }
    for name, content in modules.items():
        module = types.ModuleType(name)
        module.__spec__ = types.SimpleNamespace(name=name)  # type: ignore[assignment]
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    return calls


def test_the_way_by_rclpy_takes_and_gives_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = rclpy_stand_in(monkeypatch)
    motion = Ros2Motion(Ros2MotionOptions())  # rclpy, since it can be imported
    (kind, topic, take, profile) = calls["subscribed"][0]
    assert (kind, topic, profile.reliability) == ("PoseStamped", ECM, "BEST_EFFORT")
    take(stamped(pose(), 12.0).serialize())
    (sample, *_) = collect(motion.poll, 1)
    assert sample.base_T_camera[0, 3] == pytest.approx(100.0)
    motion.close()
    assert calls["published"] == ["destroyed"]
    operator = Ros2Operator(Ros2OperatorOptions())
    assert calls["subscribed"][-1][3].depth == WORDS, "words after a stop would push it out"
    operator.tell("hold still")
    assert calls["published"][-1] == ("String", "/fgreg/operator_told", ros2_messages.text("hold still"))
    calls["made"][0].publish = lambda _data: 1 / 0
    operator.tell("a link that fails does not end the session")
    operator.close()
    transport = open_transport(Ros2OperatorOptions(), ros2_messages.hash_of)
    send = transport.publisher("/kept", ros2_messages.TEXT, latched=True)
    kept = calls["made"][-1]
    send(None)
    assert kept not in calls["made"], "a publisher keeps what it has published"
    send(ros2_messages.text("new"))
    calls["made"][-1].publish = lambda _data: 1 / 0
    with pytest.raises(DeviceLost, match="/kept: the link takes no message"):
        send(b"")
    transport.close()
