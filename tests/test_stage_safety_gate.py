"""The gate allows legal motion, and stops it for each possible fault, with the reason."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fgreg.drivers.simulated_stage import SimulatedStage
from fgreg.model.session_model import StageModel
from fgreg.model.time_sync import Stamp
from fgreg.search.detection_model import DetectionModel
from fgreg.search.planner import Found, SearchPlanner, Turn
from fgreg.stage.interface import StageStatus
from fgreg.stage.limits import MotionKind, MotionLimits
from fgreg.stage.messages import (
    Action,
    Arrived,
    Beat,
    Command,
    Drive,
    Halt,
    Refusal,
    Request,
    Reset,
    Stop,
)
from fgreg.stage.safety_gate import Gate
from tests.forward import make_session

STAGE = StageModel(math.radians(2.0), (math.radians(-30.0), math.radians(70.0)), -1, math.radians(10.0))
LIMITS = MotionLimits.of_session(STAGE, sweep_rad=(math.radians(-35.0), math.radians(30.0)))


@dataclass
class _Room:
    """A gate with a simulated stage behind it and a main program that beats."""

    gate: Gate
    stage: SimulatedStage
    now: float = 50.0
    marker_s: float | None = 50.0
    registration: str | None = "ok"
    beating: bool = True
    hearing: bool = True
    number: int = 0
    limits: MotionLimits = LIMITS
    delay: int = 0  # ticks by which the status is older than the gate's clock
    heard: list[StageStatus] = field(default_factory=list)

    def status(self) -> StageStatus:
        self.heard.append(self.stage.status())
        return self.heard[max(0, len(self.heard) - 1 - self.delay)]

    def do(self, actions: list[Action]) -> list[Action]:
        for action in actions:
            match action:
                case Drive() if action.scan_rad is None:
                    self.stage.home(action.speed_rad_s)
                case Drive():
                    assert action.scan_rad is not None
                    self.stage.move_to(action.scan_rad, action.speed_rad_s)
                case Halt():
                    self.stage.stop()
        return actions

    def run(self, seconds: float, marker: bool = True) -> list[Action]:
        """Advance the time by ticks; the gate's actions."""
        actions = []
        for _ in range(round(seconds / 0.02)):
            self.now += 0.02
            if marker:
                self.marker_s = self.now - 0.03
            if self.beating:
                actions += self.do(self.gate.handle(Beat(self.now, self.marker_s, self.registration), self.now))
            actions += self.do(self.gate.tick(self.now, self.status() if self.hearing else None))
        return actions

    def request(self, kind: MotionKind) -> list[Action]:
        return self.do(self.gate.handle(Request(self.now, kind, "pedal"), self.now))

    def command(
        self, kind: MotionKind, deg: float | None, speed_deg_s: float = 10.0, sigma_deg: float = 0.5
    ) -> list[Action]:
        self.number += 1
        scan = None if deg is None else math.radians(deg)
        speed, sigma = math.radians(speed_deg_s), math.radians(sigma_deg)
        return self.do(self.gate.handle(Command(self.now, self.number, kind, scan, speed, sigma, "test"), self.now))

    def go(self, kind: MotionKind, deg: float | None, **more: float) -> list[Action]:
        assert self.request(kind) == []
        return self.command(kind, deg, **more)


def _room(homed: bool = True, device_deg: float = 10.0, limits: MotionLimits = LIMITS) -> _Room:
    stage = SimulatedStage(STAGE, device_rad=math.radians(device_deg), homed=homed)
    room = _Room(Gate(limits), stage, limits=limits)
    stage._clock, stage._at = (lambda: room.now), room.now
    room.run(0.1)
    return room


def _halts(actions: list[Action]) -> list[str]:
    return [action.reason for action in actions if isinstance(action, Halt)]


def _refusal(actions: list[Action]) -> str:
    """The reason of the only action: a refusal."""
    (only,) = actions
    assert isinstance(only, Refusal)
    return only.reason


def test_homing_then_search_then_tracking_all_arrive() -> None:
    room = _room(homed=False, device_deg=25.0)
    assert isinstance(room.go(MotionKind.HOME, None)[0], Drive)
    assert Arrived(1) in room.run(5.0)
    assert math.degrees(room.stage.status().scan_rad) == pytest.approx(10.0, abs=1e-3)  # device 0, zero at 10, reversed
    assert isinstance(room.go(MotionKind.SEARCH, -30.0)[0], Drive)
    assert Arrived(2) in room.run(6.0)
    assert math.degrees(room.stage.device_rad) == pytest.approx(40.0, abs=1e-3)
    assert isinstance(room.go(MotionKind.TRACK, 35.0)[0], Drive)
    assert Arrived(3) in room.run(8.0)
    assert math.degrees(room.stage.status().scan_rad) == pytest.approx(35.0, abs=1e-3)
    assert room.gate.latched is None


def test_tracking_may_be_retargeted_while_it_turns_and_turned_about() -> None:
    room = _room()
    room.go(MotionKind.TRACK, 30.0)
    for target in (25.0, -20.0, -19.5, 10.0, 10.3, 10.0):
        assert not _halts(room.run(0.7))
        assert isinstance(room.command(MotionKind.TRACK, target)[0], Drive), target
    assert Arrived(room.number) in room.run(5.0)
    assert room.gate.latched is None


def test_held_tracking_goes_on_when_the_marker_is_back_even_the_other_way() -> None:
    room = _room()
    room.go(MotionKind.TRACK, 30.0)
    room.run(1.0)
    assert any("tracking held: the marker is" in reason for reason in _halts(room.run(0.4, marker=False)))
    assert "the marker is" in _refusal(room.command(MotionKind.TRACK, 30.0))
    room.run(0.02)
    assert isinstance(room.command(MotionKind.TRACK, -10.0)[0], Drive)
    assert Arrived(room.number) in room.run(6.0)
    assert room.gate.latched is None


@pytest.mark.parametrize("delay", [0, 3, 10])
@pytest.mark.parametrize("between_s", [0.0, 0.1, 0.5])
def test_search_asked_for_while_tracking_turns_about_without_a_latch(delay: int, between_s: float) -> None:
    fast = replace(LIMITS, track_speed_rad_s=math.radians(20.0), search_speed_rad_s=math.radians(5.0))
    room = _room(limits=fast)
    room.delay = delay
    room.go(MotionKind.TRACK, 35.0, speed_deg_s=20.0)
    assert not _halts(room.run(1.2))
    before = math.degrees(room.stage.status().scan_rad)
    assert room.request(MotionKind.SEARCH) == [Halt("the operator asked to search", latched=False)]
    room.run(between_s)
    assert isinstance(room.command(MotionKind.SEARCH, before - 10.0, speed_deg_s=5.0)[0], Drive)
    furthest = before
    for _ in range(400):
        assert not _halts(room.run(0.02)), room.gate.latched
        furthest = max(furthest, math.degrees(room.stage.status().scan_rad))
        if room.gate.moving is None:
            break
    assert furthest > before + 5.0  # that is what its brakes need
    assert math.degrees(room.stage.status().scan_rad) == pytest.approx(before - 10.0, abs=0.1)


@settings(max_examples=60, derandomize=True, deadline=None)
@given(
    st.integers(0, 12),
    st.lists(st.tuples(st.floats(-55.0, 38.0), st.floats(5.0, 20.0), st.integers(1, 60)), min_size=2, max_size=8),
    st.floats(20.0, 400.0),
)
def test_good_stage_is_never_latched_however_it_is_turned_about(
    delay: int, orders: list[tuple[float, float, int]], acceleration: float
) -> None:
    room = _room(limits=replace(LIMITS, track_speed_rad_s=math.radians(20.0)))
    room.stage._acceleration, room.delay = math.radians(acceleration), delay
    room.request(MotionKind.TRACK)
    for target, speed, ticks in orders:
        assert isinstance(room.command(MotionKind.TRACK, target, speed_deg_s=speed)[0], Drive)
        room.run(0.02 * ticks)
        if ticks % 5 == 0:  # the marker is hidden for a moment
            room.run(0.3, marker=False)
            room.run(0.02)
        assert room.gate.latched is None


@pytest.mark.parametrize("delay", [0, 5])
def test_stage_that_goes_on_where_it_should_turn_about_is_found_within_its_brakes_way(delay: int) -> None:
    """The distance already turned does not matter: the remaining reach counts."""
    room = _room()
    room.delay = delay
    room.go(MotionKind.TRACK, -50.0)
    room.run(4.0)
    room.command(MotionKind.TRACK, 38.0)
    room.run(2.0)
    turned = math.degrees(room.stage.status().scan_rad)
    room.command(MotionKind.TRACK, turned + 15.0)
    room.stage.wrong.reversed = True
    while room.gate.latched is None:
        assert math.degrees(room.stage.status().scan_rad) > turned - 25.0
        room.run(0.02)
    assert "off its way" in room.gate.latched
    reach = math.degrees(LIMITS.reach_rad(math.radians(10.0), 0.02 * delay))
    late = 10.0 * 0.02 * (2 * delay + 2)  # what it had turned since its status, and turns before the next shows it
    assert turned - math.degrees(room.stage.status().scan_rad) < reach + 0.5 + late


def test_reach_is_what_is_turned_before_the_order_and_what_the_brakes_need() -> None:
    limits = replace(LIMITS, deceleration_rad_s2=math.radians(20.0))
    # by hand: 20 deg/s for 0.05 s of status and 0.1 s of the driver's call, then 20^2 / (2 * 20)
    assert math.degrees(limits.reach_rad(math.radians(20.0), 0.05)) == pytest.approx(3.0 + 10.0)
    assert limits.reach_rad(0.0, 0.3) == 0.0


def test_tracking_that_cannot_go_on_stops_and_does_not_search() -> None:
    room = _room()
    room.go(MotionKind.TRACK, 30.0)
    room.run(0.5)
    room.registration = "refused"
    actions = room.run(3.0)
    assert _halts(actions) == ["tracking held: the registration is refused"]
    assert not [action for action in actions if isinstance(action, Drive)]
    assert "the operator has not asked to search" in _refusal(room.command(MotionKind.SEARCH, 0.0))


@pytest.mark.parametrize(
    ("kind", "deg", "more", "says"),
    [
        (MotionKind.TRACK, 40.5, {}, "outside the stage's limits"),
        (MotionKind.TRACK, -60.5, {}, "outside the stage's limits"),
        (MotionKind.SEARCH, 31.0, {}, "outside the sweep range"),
        (MotionKind.SEARCH, math.nan, {}, "no target"),
        (MotionKind.SEARCH, None, {}, "no target"),
        (MotionKind.HOME, 3.0, {}, "homing has no target"),
        (MotionKind.TRACK, 3.0, {"speed_deg_s": 10.1}, "speed 10.1 deg/s"),
        (MotionKind.TRACK, 3.0, {"speed_deg_s": -1.0}, "speed -1.0 deg/s"),
        (MotionKind.TRACK, 3.0, {"speed_deg_s": math.nan}, "speed nan"),
        (MotionKind.TRACK, 3.0, {"sigma_deg": 2.1}, "angle is 2.10 deg"),
        (MotionKind.TRACK, 3.0, {"sigma_deg": math.nan}, "angle is nan"),
    ],
)
def test_order_that_is_not_allowed_is_refused_with_the_reason(
    kind: MotionKind, deg: float | None, more: dict[str, float], says: str
) -> None:
    assert says in _refusal(_room().go(kind, deg, **more))


def test_without_the_operator_nothing_moves_and_one_request_serves_one_kind() -> None:
    room = _room()
    for kind in MotionKind:
        assert "the operator has not asked" in _refusal(room.command(kind, None if kind is MotionKind.HOME else 0.0))
    room.request(MotionKind.SEARCH)
    assert "the operator has not asked to track" in _refusal(room.command(MotionKind.TRACK, 0.0))
    assert isinstance(room.go(MotionKind.HOME, None)[0], Drive)
    room.run(5.0)
    assert "the operator has not asked to home" in _refusal(room.command(MotionKind.HOME, None))


def test_request_runs_out() -> None:
    room = _room(limits=replace(LIMITS, request_s=2.0))
    room.go(MotionKind.TRACK, 40.0, speed_deg_s=5.0)
    assert "the operator's request has run out" in _halts(room.run(3.0))


def test_not_homed_stage_neither_searches_nor_tracks() -> None:
    room = _room(homed=False)
    assert "not homed" in _refusal(room.go(MotionKind.SEARCH, 0.0))
    assert "not homed" in _refusal(room.go(MotionKind.TRACK, 0.0))


@pytest.mark.parametrize(("kind", "limit_s"), [(MotionKind.TRACK, 0.25), (MotionKind.SEARCH, 1.0)])
def test_stalled_main_program_stops_the_stage_and_needs_a_new_request(kind: MotionKind, limit_s: float) -> None:
    room = _room()
    room.go(kind, 30.0)
    room.run(0.5)
    room.beating = False
    began = room.now
    while "the main program's heartbeat is missing" not in _halts(room.run(0.02)):
        assert room.now - began <= limit_s + 0.041
    assert room.now - began > limit_s
    room.run(2.0)
    assert not room.stage.status().moving
    room.beating = True
    room.run(0.1)
    assert "the operator has not asked" in _refusal(room.command(MotionKind.SEARCH, 0.0))
    assert isinstance(room.go(MotionKind.SEARCH, 0.0)[0], Drive)


def test_messages_queued_during_a_stall_are_no_heartbeats() -> None:
    room = _room()
    room.request(MotionKind.SEARCH)
    late = Command(room.now, 9, MotionKind.SEARCH, 0.1, 0.1, None, "before the stall")
    beats = [Beat(room.now + 0.02 * i, room.now, "ok") for i in range(5)]
    room.beating = False
    room.run(1.1)
    for beat in beats:
        room.do(room.gate.handle(beat, room.now))
    assert "the operator has not asked" in _refusal(room.do(room.gate.handle(late, room.now)))
    room.beating = True
    room.run(0.02)
    room.request(MotionKind.SEARCH)
    assert "on its way" in _refusal(room.do(room.gate.handle(late, room.now)))


@pytest.mark.parametrize(
    ("happens", "says"),
    [
        (lambda room: room.do(room.gate.handle(Stop(room.now, True, "button"), room.now)), "emergency stop: button"),
        (lambda room: room.do(room.gate.tick(room.now - 0.01, None)), "the clock went back by 0.010 s"),
        (lambda room: room.do(room.gate.tick(room.now + 0.6, None)), "the clock jumped by 0.600 s"),
        (lambda room: room.do(room.gate.tick(math.nan, None)), "the clock shows no time"),
        (lambda room: room.do(room.gate.fault("unplugged", room.now)), "unplugged"),
        (lambda room: room.do(room.gate.handle(Beat(room.now + 1.0), room.now)), "heartbeat from the future"),
    ],
)
def test_trouble_latches_until_the_operator_resets(happens: Any, says: str) -> None:
    room = _room()
    room.go(MotionKind.SEARCH, 30.0)
    room.run(0.5)
    actions = happens(room)
    assert says in _halts(actions)[0]
    assert actions[-1] == Halt(_halts(actions)[-1], latched=True)
    room.run(3.0)
    assert not room.stage.status().moving
    assert "latched" in _refusal(room.request(MotionKind.SEARCH))
    assert "latched" in _refusal(room.command(MotionKind.SEARCH, 0.0))
    assert room.gate.handle(Reset(room.now, "nurse"), room.now) == []
    assert isinstance(room.go(MotionKind.SEARCH, 0.0)[0], Drive)
    assert Arrived(room.number) in room.run(6.0)


def test_reset_is_refused_while_the_stage_moves_or_is_silent() -> None:
    room = _room()
    room.go(MotionKind.SEARCH, 30.0)
    room.run(1.0)
    room.do(room.gate.fault("test", room.now))
    room.run(0.1)
    assert "still moves" in _refusal(room.gate.handle(Reset(room.now, "nurse"), room.now))
    room.run(2.0)
    room.hearing = False
    room.run(0.4)
    assert "the stage is silent" in _refusal(room.gate.handle(Reset(room.now, "nurse"), room.now))


@pytest.mark.parametrize(
    ("wrong", "value", "says"),
    [
        ("speed_factor", 2.5, "too fast"),
        ("reversed", True, "off its way"),
        ("frozen", True, "silent"),
    ],
)
def test_stage_that_misbehaves_is_stopped_and_latched(wrong: str, value: Any, says: str) -> None:
    room = _room()
    setattr(room.stage.wrong, wrong, value)
    room.go(MotionKind.SEARCH, 25.0)
    reasons = _halts(room.run(2.0))
    assert reasons
    assert says in reasons[0]
    assert room.gate.latched is not None


def test_reset_without_a_heartbeat_is_refused() -> None:
    room = _room()
    room.do(room.gate.fault("test", room.now))
    room.beating = False
    room.run(1.1)
    assert "heartbeat is missing" in _refusal(room.gate.handle(Reset(room.now, "nurse"), room.now))


def test_stage_that_leaps_within_its_way_is_stopped() -> None:
    room = _room()
    room.go(MotionKind.SEARCH, 25.0)
    room.run(0.5)
    room.stage.device_rad -= math.radians(3.0)
    assert "the stage turned by 3." in _halts(room.run(0.04))[0]


def test_status_that_arrives_late_is_not_a_leap() -> None:
    room = _room()
    room.go(MotionKind.SEARCH, 25.0)
    room.run(1.0)
    angle = room.stage.status().scan_rad
    late = room.now + 0.1  # the angle was read 0.1 s before its status arrived; the next one arrives at once
    speed = math.copysign(math.radians(10.0), math.radians(25.0) - angle)
    status = replace(room.stage.status(), scan_rad=angle, stamp=Stamp(late, late))
    assert room.gate.tick(late, status) == []
    after = replace(status, scan_rad=angle + 0.102 * speed, stamp=Stamp(late + 0.002, late + 0.002))
    assert room.gate.tick(late + 0.002, after) == []
    then = replace(after, scan_rad=angle + 0.3 * speed, stamp=Stamp(late + 0.004, late + 0.004))
    assert "the stage turned by 2.0 deg in 4 ms" in _halts(room.gate.tick(late + 0.004, then))[0]


def test_stage_that_creeps_is_stopped_in_the_end() -> None:
    room = _room()
    room.stage.wrong.speed_factor = 0.05
    room.go(MotionKind.SEARCH, 25.0)
    assert _halts(room.run(8.0))[0] == "the motion takes longer than it can"
    assert room.gate.latched is not None


def test_status_of_another_clock_latches_and_an_old_one_is_passed_over() -> None:
    room = _room()
    newest = room.stage.status()
    earlier = Stamp(newest.stamp.host_s - 0.1, newest.stamp.host_s - 0.1)
    assert room.gate.tick(room.now, replace(newest, stamp=earlier, homed=False, moving=True)) == []
    assert isinstance(room.go(MotionKind.SEARCH, 25.0)[0], Drive)  # by the newer one, which was homed
    later = Stamp(room.now + 0.1, room.now + 0.1)
    assert _halts(room.do(room.gate.tick(room.now, replace(newest, stamp=later)))) == [
        "a status from the future: the clocks disagree"
    ]


def test_silent_stage_is_stopped() -> None:
    room = _room()
    room.go(MotionKind.SEARCH, 30.0)
    room.run(0.5)
    room.hearing = False
    assert _halts(room.run(0.5))[0] == "the stage is silent"


def test_stage_that_does_not_stop_gets_the_order_again_and_again() -> None:
    room = _room()
    room.go(MotionKind.SEARCH, 30.0, speed_deg_s=5.0)
    room.run(0.5)
    room.stage.wrong.deaf = True
    room.do(room.gate.handle(Stop(room.now, False, "test"), room.now))
    assert len(_halts(room.run(3.0))) > 20
    assert room.gate.latched == "the stage moves without a command"


def test_stage_that_is_turned_by_its_own_knob_is_stopped() -> None:
    room = _room()
    room.stage.move_to(math.radians(20.0), math.radians(3.0))
    assert _halts(room.run(0.1))[0] == "the stage moves without a command"


def test_stage_that_says_it_stands_and_goes_on_is_latched_stopped_again_and_not_reset_before_it_stands() -> None:
    room = _room()
    room.stage.wrong.says_it_stands = True
    room.go(MotionKind.SEARCH, 30.0, speed_deg_s=5.0)
    room.run(0.2)
    room.stage.wrong.deaf = True
    stopped = room.now
    room.do(room.gate.handle(Stop(room.now, False, "test"), room.now))
    while room.gate.latched is None:
        room.run(0.02)
        assert room.now - stopped < LIMITS.standing_s() + 0.3  # 1 deg at 5 deg/s, and two statuses
    assert "the stage says that it stands, and turned by 1." in room.gate.latched
    assert len(_halts(room.run(1.0))) >= 3  # again at each further degree
    assert "still moves" in _refusal(room.gate.handle(Reset(room.now, "nurse"), room.now))
    room.stage.wrong.deaf = False
    room.do(room.gate.fault("test", room.now))
    room.run(LIMITS.standing_s() + 0.5)
    assert room.gate.handle(Reset(room.now, "nurse"), room.now) == []
    assert room.run(2.0) == []


@pytest.mark.parametrize("after", ["start", "arrival", "stop"])
def test_stage_that_creeps_away_while_it_says_it_stands_is_latched(after: str) -> None:
    room = _room()
    if after != "start":
        room.go(MotionKind.SEARCH, 2.0)
        room.run(0.4 if after == "stop" else 1.5)
        room.do(room.gate.handle(Stop(room.now, False, "test"), room.now))
        room.run(0.1 if after == "arrival" else 2.0)
    room.stage.wrong.says_it_stands = True
    stood = math.degrees(room.stage.device_rad)
    room.stage.move_to(LIMITS.stage.scan_from_device(math.radians(stood + 30.0)), math.radians(0.5))
    while room.gate.latched is None:
        room.do(room.gate.handle(Stop(room.now, False, "again"), room.now))  # a stop gives it no time to move
        room.stage.move_to(LIMITS.stage.scan_from_device(math.radians(stood + 30.0)), math.radians(0.5))
        room.run(0.02)
        assert math.degrees(room.stage.device_rad) < stood + 1.1
    assert "turned by 1.0 deg" in room.gate.latched


@settings(max_examples=60, derandomize=True, deadline=None)
@given(st.integers(0, 14), st.floats(10.0, 20.0), st.floats(20.0, 400.0), st.integers(5, 80))
def test_brakes_of_a_stage_that_says_it_stands_are_no_straying_however_late_its_statuses_come(
    lateness: int, speed: float, acceleration: float, ticks: int
) -> None:
    """A status is stamped when it arrives; its angle was read up to 0.3 s before, after the last one had arrived."""
    room = _room(limits=replace(LIMITS, track_speed_rad_s=math.radians(20.0)))
    room.stage._acceleration = math.radians(acceleration)
    room.go(MotionKind.TRACK, -50.0, speed_deg_s=speed)
    room.run(0.02 * ticks)
    for _ in range(40):  # the first of them is of a motion
        read = [replace(room.stage.status(), moving=False)]
        room.hearing = False
        room.do(room.gate.handle(Stop(room.now, False, "test"), room.now))
        room.run(0.02 * (lateness + 1))
        late = replace(read[0], stamp=Stamp(room.now, room.now))
        room.do(room.gate.tick(room.now, late))
    assert room.gate.latched is None


def test_stage_whose_zero_is_lost_at_rest_is_not_taken_for_one_that_turned() -> None:
    room = _room()
    room.stage._offset, room.stage._homed = math.radians(20.0), False  # its power was off
    assert room.run(1.0) == []
    assert "not homed" in _refusal(room.go(MotionKind.SEARCH, 0.0))


def test_stage_that_stops_by_itself_ends_the_request() -> None:
    room = _room()
    room.go(MotionKind.SEARCH, 30.0)
    room.run(0.5)
    room.stage.stop()
    assert "stopped by itself" in _halts(room.run(3.0))[0]
    assert room.gate.latched is None
    assert room.gate.requested is None


def test_homing_that_finds_no_zero_within_the_limits_span_is_stopped() -> None:
    room = _room(homed=False, device_deg=200.0)
    room.go(MotionKind.HOME, None)
    assert "zero position not found within 100 deg" in _halts(room.run(15.0))[0]
    assert abs(math.degrees(room.stage.device_rad) - 200.0) < 104.0


@pytest.mark.parametrize("pm_deg", [-33.0, -8.0, 28.0])
def test_whole_search_passes_the_gate(pm_deg: float) -> None:
    room = _room()
    low, high = LIMITS.sweep_rad
    planner = SearchPlanner(
        DetectionModel.of_session(make_session(curve=True).probe.sensitivity, 1.0),
        low,
        high,
        room.stage.status().scan_rad,
    )
    room.request(MotionKind.SEARCH)
    while isinstance(step := planner.next(), Turn):
        assert isinstance(room.command(MotionKind.SEARCH, math.degrees(step.scan_rad))[0], Drive)
        assert Arrived(room.number) in room.run(8.0)
        stands = room.stage.status().scan_rad
        amplitude = 4.0 * 2.0 ** (-(((math.degrees(stands) - pm_deg) / 6.0) ** 2))
        planner.add_look(stands, amplitude if amplitude >= 1.0 else None)
    assert isinstance(step, Found)
    assert math.degrees(step.scan_rad) == pytest.approx(pm_deg, abs=0.5)
