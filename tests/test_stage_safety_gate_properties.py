"""No sequence of commands, faults and clock jumps makes the gate allow an illegal motion."""

from __future__ import annotations

import math
from collections.abc import Iterable

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from fgreg.model.session_model import StageModel
from fgreg.model.time_sync import Stamp
from fgreg.stage.interface import StageStatus
from fgreg.stage.limits import MotionKind, MotionLimits
from fgreg.stage.messages import Action, Arrived, Beat, Command, Drive, Halt, Message, Request, Reset, Stop
from fgreg.stage.safety_gate import Gate
from tests.stage_oracle import LIMITS_DEG, SPEED_DEG_S, SWEEP_DEG, Oracle

# Wired the other way round, zero at 10 deg: the plane's -60 to 40 deg are the device's 70 to -30.
STAGE = StageModel(math.radians(2.0), (math.radians(-30.0), math.radians(70.0)), -1, math.radians(10.0))
LIMITS = MotionLimits(
    STAGE,
    (math.radians(SWEEP_DEG[0]), math.radians(SWEEP_DEG[1])),
    home_speed_rad_s=math.radians(SPEED_DEG_S["home"]),
    search_speed_rad_s=math.radians(SPEED_DEG_S["search"]),
    track_speed_rad_s=math.radians(SPEED_DEG_S["track"]),
)
KINDS = st.sampled_from(list(MotionKind))
ANGLES = st.one_of(
    st.floats(-70.0, 50.0),
    st.sampled_from([*LIMITS_DEG, *SWEEP_DEG, 0.0, -35.1, 30.1, 40.01, -60.01, 1e9, math.nan, math.inf]),
)
SPEEDS = st.one_of(st.floats(0.1, 13.0), st.sampled_from([8.0, 10.0, 12.0, 0.0, -1.0, math.nan, math.inf]))
STANDS = st.sampled_from([0.0, -34.9, 29.9, 10.0])
TARGETS = st.sampled_from([0.0, -35.0, 30.0, -20.0, 20.0])
Table = dict[str, float | None]
STANDS_BADLY: Table = {"stands out": 40.6, "stands below": -60.6, "stands out of the sweep": 30.6, "stands at 38": 38.0}
TARGETS_BADLY: Table = {
    **{"target 40.1": 40.1, "target -60.1": -60.1, "target 70": 70.0, "target 30.1": 30.1, "target -35.1": -35.1},
    **{"target nan": math.nan, "target inf": math.inf, "target 40": 40.0, "target -60": -60.0},
}
MARKERS: Table = {"marker old": 0.201, "marker older": 0.35, "marker ahead": -0.05, "no marker": None}
VERDICTS = {"refused": "refused", "no registration": None, "odd verdict": "perhaps"}
BAD_SPEEDS: Table = {"too fast": 12.5, "bit too fast": 10.01, "bit faster": 8.01, "no speed": math.nan, "back": -3.0}
SIGMAS: Table = {"sigma": 2.01, "no sigma": None, "sigma nan": math.nan, "sigma below 0": -0.1}
AGES: Table = {"late": 0.21, "later": 3.0, "ahead": -0.1}
FAULTS = [
    *("not homed", "another request", "stopped", "emergency", "clock back", "clock ahead", "clock back, old beats"),
    *("fault", "requested again", "heartbeat gap", "silent", "old beat after", "beat again", "home with target"),
    *("twice", "0.3 s", "unwatched", "unheard", "turned by hand"),
    *(*STANDS_BADLY, *TARGETS_BADLY, *MARKERS, *VERDICTS, *BAD_SPEEDS, *SIGMAS, *AGES),
]
DISTURBANCES = [
    *("silent", "zero lost", "out of limits", "heartbeat from ahead", "no marker", "marker old", "marker ahead"),
    *("refused", "no registration", "no beat", "none", "request"),
]


class GateMachine(RuleBasedStateMachine):
    """A stage that follows the gate, a main program that sends anything, and a clock that jumps."""

    def __init__(self) -> None:
        super().__init__()
        self.gate, self.oracle = Gate(LIMITS), Oracle()
        self.now = 1000.0
        self.angle, self.homed, self.silent, self.runaway = 0.0, False, False, 1.0
        self.driving: Drive | None = None
        self.number = 0

    @initialize(homed=st.booleans(), angle=st.sampled_from([0.0, -34.0, 29.0, 36.0, 39.9, -50.0]))
    def start(self, homed: bool, angle: float) -> None:
        self.homed, self.angle = homed, angle
        self._tick()
        self._live()

    # -- the world

    def _status(self) -> StageStatus:
        moving = self.driving is not None
        homing = self.driving is not None and self.driving.kind is MotionKind.HOME
        stamp = Stamp(self.now, self.now)
        return StageStatus(stamp, math.radians(self.angle), 0.0, moving, homing, self.homed and not homing)

    def _take(self, actions: Iterable[Action], command: Command | None = None) -> None:
        for action in actions:
            match action:
                case Drive():
                    assert command is not None, "a motion that nobody commanded"
                    assert action.number == command.number
                    assert (action.kind, action.scan_rad) == (command.kind, command.scan_rad)
                    assert action.speed_rad_s <= command.speed_rad_s
                    target = None if action.scan_rad is None else math.degrees(action.scan_rad)
                    sigma = None if command.sigma_rad is None else math.degrees(command.sigma_rad)
                    speed = math.degrees(action.speed_rad_s)
                    why = self.oracle.drive_is_legal(self.now, str(action.kind), target, speed, command.sent_s, sigma)
                    assert not why, f"{action} got out: {why}"
                    self.oracle.note(self.now, f"drive {action.kind}")
                    self.driving = action
                case Halt() | Arrived():
                    if self.driving is not None:
                        self.oracle.note(self.now, "rest")
                    self.driving = None
                case _:
                    pass

    def _tick(self) -> None:
        if self.driving is not None:
            target = 0.0 if self.driving.scan_rad is None else math.degrees(self.driving.scan_rad)
            way = math.copysign(min(0.02 * 5.0, abs(target - self.angle)), target - self.angle)
            self.angle += self.runaway * way
        if not self.oracle.alive(self.now):
            self.oracle.note(self.now, "silence")
        if self.silent:
            self._take(self.gate.tick(self.now, None))
            return
        status = self._status()
        details = {"at": self.now, "angle": self.angle, "homed": status.homed, "moving": status.moving}
        self.oracle.note(self.now, "status", **details)
        self._take(self.gate.tick(self.now, status))
        if self.driving is not None and self.driving.kind is MotionKind.HOME and abs(self.angle) < 1e-9:
            self.homed = True

    def _live(self, marker: float | None = 0.03, registration: str | None = "ok") -> None:
        self._beat(0.0, marker, registration)
        self.now += 0.02
        self._tick()

    def _send(self, message: Message) -> None:
        if not self.oracle.alive(self.now):
            self.oracle.note(self.now, "silence")
        self._take(self.gate.handle(message, self.now), message if isinstance(message, Command) else None)

    def _beat(self, delay: float, marker_age: float | None, registration: str | None) -> None:
        marker = None if marker_age is None else self.now - marker_age
        sent = self.now - delay
        if delay < -1e-3:
            self.oracle.note(self.now, "fault")  # and worth nothing as a beat
        else:
            self.oracle.note(self.now, "beat", sent=sent, marker=marker, registration=registration)
        self._send(Beat(sent, marker, registration))

    # -- what may happen

    @rule(steps=st.integers(1, 12), registration=st.sampled_from(["ok", "ok", "warning", "refused", None]))
    def live(self, steps: int, registration: str | None) -> None:
        for _ in range(steps):
            self._live(registration=registration)

    @rule(dt=st.floats(0.001, 0.45))
    def pass_time(self, dt: float) -> None:
        self.now += dt
        self._tick()

    @rule(
        delay=st.sampled_from([0.0, 0.1, 0.24, 0.3, 2.0, -0.5]),
        marker=st.one_of(st.none(), st.sampled_from([0.0, 0.19, 0.21, 1.0, -0.1])),
        registration=st.sampled_from(["ok", "warning", "refused", "", None]),
    )
    def beat(self, delay: float, marker: float | None, registration: str | None) -> None:
        self._beat(delay, marker, registration)

    @rule(kind=KINDS)
    def request(self, kind: MotionKind) -> None:
        self._live()
        self.oracle.note(self.now, "request", kind=str(kind))
        self._send(Request(self.now, kind, "operator"))

    @rule(
        kind=KINDS,
        to=st.one_of(st.none(), ANGLES),
        speed=SPEEDS,
        sigma=st.one_of(st.none(), st.sampled_from([0.0, 0.5, 1.99, 2.01, math.nan, -1.0])),
        age=st.sampled_from([0.0, 0.0, 0.0, 0.1, 0.21, 5.0, -0.1]),
    )
    def command(self, kind: MotionKind, to: float | None, speed: float, sigma: float | None, age: float) -> None:
        self.number += 1
        scan = None if to is None else math.radians(to)
        sigma_rad = None if sigma is None else math.radians(sigma)
        self._send(Command(self.now - age, self.number, kind, scan, math.radians(speed), sigma_rad, "test"))

    def _recover(self, kind: MotionKind, at: float, homed: bool = True) -> None:
        """Everything in order, and motion of a kind requested."""
        self.silent, self.runaway, self.homed, self.angle = False, 1.0, homed, at
        self._send(Stop(self.now, False, "test"))
        self.oracle.note(self.now, "stop")
        for _ in range(6):  # until a stage that was turned by somebody has stood for long enough
            self.now += 0.4
            self._tick()
        self.reset()
        self.request(kind)

    @rule(kind=KINDS, at=STANDS, to=TARGETS, faults=st.sets(st.sampled_from(FAULTS), max_size=2))
    def nearly_good_command(self, kind: MotionKind, at: float, to: float, faults: set[str]) -> None:
        """All as it should be, but for up to two things."""

        def pick(table: Table, otherwise: float | None) -> float | None:
            return next((table[fault] for fault in sorted(faults) if fault in table), otherwise)

        self._recover(kind, pick(STANDS_BADLY, at) or 0.0, "not homed" not in faults)
        if "another request" in faults:
            self.request(next(other for other in MotionKind if other is not kind))
        if "stopped" in faults:
            self.stop(False)
        if "emergency" in faults:
            self.stop(True)
        if "turned by hand" in faults:
            self.somebody_turns_the_stage(self.angle + 1.5)
        if "clock back" in faults:
            self.clock_jumps(-0.01)
            self._live()
        if "clock ahead" in faults:
            self.clock_jumps(0.6)
            self._live()
        if "clock back, old beats" in faults:
            self.clock_jumps(-0.01)
        if "heartbeat gap" in faults:
            for _ in range(15 if kind is MotionKind.TRACK else 55):
                self.now += 0.02
                self._tick()
            self._live()
        if "fault" in faults:
            self.watchdog_finds_a_fault()
        if "requested again" in faults:  # but not reset
            self.request(kind)
        if "silent" in faults:
            self.silent = True
        verdict = next((VERDICTS[fault] for fault in sorted(faults) if fault in VERDICTS), "ok")
        self._beat(0.0, pick(MARKERS, 0.02), verdict)
        if "old beat after" in faults:
            self._beat(0.24, 0.0, "ok")
        if "0.3 s" in faults:
            for _ in range(15):
                self.now += 0.021
                self._beat(0.0, pick(MARKERS, 0.02), verdict)
                self._tick()
        if "unwatched" in faults:
            self.now += 0.31
        if "unheard" in faults:  # the heartbeat is too old, the status is not, and no tick has noticed
            self.now += 0.27
        if "beat again" in faults:
            self._beat(0.0, 0.02, "ok")
        target = None if kind is MotionKind.HOME else pick(TARGETS_BADLY, to)
        if "home with target" in faults:
            target = 0.0
        self.command(kind, target, pick(BAD_SPEEDS, 5.0) or 0.0, pick(SIGMAS, 0.5), pick(AGES, 0.0) or 0.0)
        if "twice" in faults:
            self.command(kind, target, 5.0, 0.5, 0.0)

    @rule(kind=KINDS, to=st.floats(-35.0, 30.0), disturbance=st.sampled_from(DISTURBANCES), before=st.integers(0, 6))
    def motion_is_disturbed(self, kind: MotionKind, to: float, disturbance: str, before: int) -> None:
        """One thing goes wrong while a motion is under way."""
        self._recover(kind, -20.0)
        self.command(kind, None if kind is MotionKind.HOME else to, 5.0, 0.5, 0.0)
        assert self.driving is not None
        for _ in range(before):
            self._live()
            self.motion_under_way_is_legal()
        if disturbance == "silent":
            self.silent = True
        if disturbance == "zero lost":
            self.homed = False
        if disturbance == "out of limits":
            self.angle = 40.6
        if disturbance == "heartbeat from ahead":
            self._beat(-0.4, 0.0, "ok")
        if disturbance == "request":
            self.request(MotionKind.TRACK)
        marker = {"no marker": None, "marker old": 0.21, "marker ahead": -0.05}.get(disturbance, 0.03)
        registration = {"refused": "refused", "no registration": None}.get(disturbance, "ok")
        for _ in range(60 if disturbance == "no beat" else 20):
            if disturbance == "no beat":
                self.now += 0.02
                self._tick()
            else:
                self._live(marker, registration)
            self.motion_under_way_is_legal()

    @rule(emergency=st.booleans())
    def stop(self, emergency: bool) -> None:
        self._send(Stop(self.now, emergency, "test"))
        self.oracle.note(self.now, "emergency" if emergency else "stop")

    @rule()
    def reset(self) -> None:
        self._live()
        self.oracle.note(self.now, "reset")
        self._send(Reset(self.now, "operator"))

    @rule(jump=st.one_of(st.floats(-50.0, -1e-6), st.floats(0.51, 500.0)))
    def clock_jumps(self, jump: float) -> None:
        self.now += jump
        self.oracle.note(self.now, "clock jump")
        self._tick()

    @rule()
    def clock_shows_nothing(self) -> None:
        self.oracle.note(self.now, "clock jump")
        self._take(self.gate.tick(math.nan, None))

    @rule()
    def watchdog_finds_a_fault(self) -> None:
        self.oracle.note(self.now, "fault")
        self._take(self.gate.fault("test", self.now))

    @rule(silent=st.booleans())
    def stage_falls_silent(self, silent: bool) -> None:
        self.silent = silent

    @rule(runaway=st.sampled_from([1.0, 1.0, -1.0, 20.0]))
    def stage_runs_away(self, runaway: float) -> None:
        self.runaway = runaway

    @precondition(lambda self: self.driving is not None)
    @rule()
    def stage_loses_its_zero(self) -> None:
        self.homed = False

    @rule(angle=st.sampled_from([0.0, 35.0, 40.4, 45.0, -60.4, -70.0, 10.0]))
    def somebody_turns_the_stage(self, angle: float) -> None:
        self.angle = angle
        self._tick()

    # -- what must hold

    @invariant()
    def motion_under_way_is_legal(self) -> None:
        self._take(self.gate.tick(self.now, None))
        if self.driving is not None:
            why = self.oracle.may_go_on(self.now, str(self.driving.kind))
            assert not why, f"{self.driving} goes on: {why}"
        assert (self.driving is None) == (self.gate.moving is None)


def _machine() -> GateMachine:
    machine = GateMachine()
    machine.start(True, 0.0)
    return machine


@pytest.mark.parametrize("kind", list(MotionKind))
def test_good_command_gets_out_and_one_fault_or_two_let_no_illegal_one_out(kind: MotionKind) -> None:
    machine = _machine()
    machine.nearly_good_command(kind, 0.0, 20.0, set())
    assert machine.driving is not None
    troubles = [
        "emergency",
        "fault",
        "turned by hand",
        "clock back",
        "clock ahead",
        "clock back, old beats",
        "stopped",
        "heartbeat gap",
    ]
    pairs = [{trouble, more} for trouble in troubles for more in ("requested again", "beat again")]
    pairs += [{"unwatched", "beat again"}, {"silent", "0.3 s"}, {"marker old", "old beat after"}]
    for faults in [*({fault} for fault in FAULTS), *pairs]:
        machine = _machine()
        machine.nearly_good_command(kind, 10.0, -20.0, faults)
        machine.motion_under_way_is_legal()


@pytest.mark.parametrize("kind", list(MotionKind))
@pytest.mark.parametrize("disturbance", DISTURBANCES)
def test_motion_that_is_disturbed_is_stopped(kind: MotionKind, disturbance: str) -> None:
    for before in (0, 1, 5):
        machine = _machine()
        machine.motion_is_disturbed(kind, 25.0, disturbance, before)
        assert (machine.driving is None) == (machine.gate.moving is None)


GateMachine.TestCase.settings = settings(
    max_examples=200,
    stateful_step_count=25,
    deadline=None,
    derandomize=True,
    suppress_health_check=list(HealthCheck),
)
TestGate = GateMachine.TestCase
