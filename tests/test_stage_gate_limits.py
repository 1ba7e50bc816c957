"""Each limit of the gate on both sides: exactly at it a motion is allowed, just beyond it is not, with its figure."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from fgreg.errors import FgregError
from fgreg.model.session_model import StageModel
from fgreg.model.time_sync import Stamp
from fgreg.schema.problems import FieldError
from fgreg.stage.interface import StageStatus
from fgreg.stage.limits import LIMITS as KEYS
from fgreg.stage.limits import MotionKind, MotionLimits
from fgreg.stage.messages import Action, Arrived, Beat, Command, Drive, Halt, Refusal, Request, Reset, Stop
from fgreg.stage.safety_gate import Gate

# The plane's -60 to 40 deg are the device's 70 to -30, its zero at 10 deg. Times are powers of two, and so exact.
STAGE = StageModel(math.radians(2.0), (math.radians(-30.0), math.radians(70.0)), -1, math.radians(10.0))
DEFAULTS = MotionLimits.of_session(STAGE, sweep_rad=(math.radians(-35.0), math.radians(30.0)))
LIMITS = replace(
    DEFAULTS,
    command_age_s=0.25,
    status_age_s=0.5,
    clock_gap_s=1.0,
    request_s=4.0,
    marker_age_s=0.125,
    track_sigma_rad=2.0**-5,
)
NOW, BIT = 128.0, 2.0**-20


def status(t: float, deg: float, velocity_deg: float = 0.0, **changes: Any) -> StageStatus:
    at_rest = StageStatus(Stamp(t, t), math.radians(deg), math.radians(velocity_deg), False, False, True)
    return replace(at_rest, **changes)


def ready(kind: MotionKind, deg: float = 0.0, at: float = NOW, **changes: Any) -> Gate:
    """A gate at whose stage all is well, and of which this kind of motion was requested."""
    gate = Gate(LIMITS)
    assert gate.tick(at, status(at, deg, **changes)) == []
    assert gate.handle(Beat(at, at, "ok"), at) == []
    assert gate.handle(Request(at, kind, "pedal"), at) == []
    return gate


def order(gate: Gate, kind: MotionKind, deg: float | None, now: float = NOW, **changes: Any) -> str:
    """Why a command is refused; empty where it gets out."""
    scan = None if deg is None else math.radians(deg)
    command = Command(now, 7, kind, scan, math.radians(10.0), 0.01, "test")
    (action,) = gate.handle(replace(command, **changes), now)
    if isinstance(action, Drive):
        assert (action.scan_rad, action.number) == (scan, 7)
        return ""
    assert isinstance(action, Refusal)
    return action.reason.removeprefix(f"{kind} refused: ")


def halted(actions: list[Action]) -> str:
    return "; ".join(action.reason for action in actions if isinstance(action, Halt))


def test_defaults_are_those_of_the_documentation() -> None:
    in_degrees = ("home_speed", "search_speed", "track_speed", "track_sigma", "tolerance", "deceleration")
    found = DEFAULTS.document()
    degrees = [math.degrees(next(v for k, v in found.items() if k.startswith(name))) for name in in_degrees]
    assert degrees == pytest.approx([10.0, 10.0, 10.0, 2.0, 0.5, 20.0])
    seconds = ("heartbeat_s", "step_heartbeat_s", "command_age_s", "status_age_s", "clock_gap_s", "marker_age_s")
    assert [found[name] for name in seconds] == [0.25, 1.0, 0.2, 0.3, 0.5, 0.2]
    assert [found[name] for name in ("request_s", "stop_s", "slack_s", "overspeed")] == [600.0, 1.5, 3.0, 1.25]
    assert [DEFAULTS.heartbeat(kind) for kind in (*MotionKind, None)] == [1.0, 1.0, 0.25, 1.0]
    assert math.degrees(DEFAULTS.homing_travel()) == pytest.approx(100.0)
    assert replace(DEFAULTS, home_travel_rad=1.0).homing_travel() == 1.0
    # by hand: 0.1 s for the driver's call, 10 deg/s at 5 deg/s^2, 0.3 s for a status
    assert DEFAULTS.standing_s() == 1.5
    assert replace(DEFAULTS, deceleration_rad_s2=math.radians(5.0)).standing_s() == pytest.approx(2.4)


@pytest.mark.parametrize(
    ("key", "good", "bad"),
    [
        ("home_speed_deg_s", 30.0, 30.1),
        ("search_speed_deg_s", 0.1, 0.0),
        ("track_sigma_deg", 10.0, 10.1),
        ("track_sigma_deg", 0.1, 0.0),
        ("marker_age_s", 0.2, 0.21),
        ("marker_age_s", 0.01, 0.0),
        ("request_s", 1.0, 0.9),
        ("request_s", 3600.0, 3601.0),
    ],
)
def test_what_a_configuration_may_set(key: str, good: float, bad: float) -> None:
    MotionLimits.of_session(STAGE, **KEYS.read({key: good}))
    with pytest.raises(FieldError):
        KEYS.read({key: bad})


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        *(
            ({name: 0.0}, name)
            for name in DEFAULTS.document()
            if name not in ("stage", "sweep_rad", "home_travel_rad", "overspeed")
        ),
        ({"tolerance_rad": math.nan}, "tolerance_rad is nan"),
        ({"heartbeat_s": math.inf}, "heartbeat_s is inf"),
        ({"stage": StageModel(0.1, (0.5, 1.0)), "sweep_rad": (0.6, 0.9)}, "zero position"),
        ({"overspeed": 1.0}, "overspeed is 1.0"),
        ({"overspeed": 2.01}, "overspeed is 2.01"),
        ({"home_travel_rad": 0.0}, "home_travel_rad is 0.0"),
        ({"sweep_rad": (-1.5, 0.0)}, "the sweep range -85.9 to 0.0 deg leaves"),
        ({"sweep_rad": (0.0, 1.5)}, "leaves the stage's limits"),
        ({"sweep_rad": (0.1, 0.1)}, "the lower end"),
    ],
)
def test_limits_that_are_no_limits_are_refused(changes: dict[str, Any], says: str) -> None:
    with pytest.raises((ValueError, FgregError), match=says):
        replace(DEFAULTS, **changes)
    assert replace(DEFAULTS, overspeed=2.0).overspeed == 2.0


def test_angles_inside_the_limits_and_the_sweep() -> None:
    half = math.radians(0.5)
    for deg, inside, nearly in ((40.0, True, True), (40.1, False, True), (40.6, False, False)):
        assert (DEFAULTS.inside(math.radians(deg)), DEFAULTS.inside(math.radians(deg), half)) == (inside, nearly)
    for deg, inside, nearly in ((-60.0, True, True), (-60.4, False, True), (-60.6, False, False)):
        assert (DEFAULTS.inside(math.radians(deg)), DEFAULTS.inside(math.radians(deg), half)) == (inside, nearly)
    for deg, inside, nearly in ((30.0, True, True), (30.4, False, True), (30.6, False, False), (-35.0, True, True)):
        assert (DEFAULTS.in_sweep(math.radians(deg)), DEFAULTS.in_sweep(math.radians(deg), half)) == (inside, nearly)
    for deg, nearly in ((-35.4, True), (-35.6, False)):
        assert DEFAULTS.in_sweep(math.radians(deg), half) is nearly
        assert not DEFAULTS.in_sweep(math.radians(deg))


SEARCH, TRACK, HOME = MotionKind.SEARCH, MotionKind.TRACK, MotionKind.HOME


@pytest.mark.parametrize(
    ("kind", "deg", "changes", "says"),
    [
        (SEARCH, 5.0, {"sent_s": NOW - 0.25}, ""),
        (SEARCH, 5.0, {"sent_s": NOW - 0.251}, "251 ms on its way, at most 250 allowed"),
        (SEARCH, 5.0, {"sent_s": NOW + 0.0009}, ""),
        (SEARCH, 5.0, {"sent_s": NOW + 0.0011}, "from the future"),
        (SEARCH, 5.0, {"speed_rad_s": math.radians(10.1)}, "speed 10.1 deg/s, expected above 0, at most 10.0 deg/s"),
        (SEARCH, 5.0, {"speed_rad_s": 0.0}, "speed 0.0 deg/s"),
        (SEARCH, 5.0, {"sigma_rad": None}, ""),
        (SEARCH, 30.1, {}, "target 30.1 deg is outside the sweep range"),
        (TRACK, 30.1, {}, ""),
        (TRACK, 40.1, {}, "target 40.1 deg is outside the stage's limits"),
        (TRACK, 5.0, {"sigma_rad": 2.0**-5}, ""),
        (TRACK, 5.0, {"sigma_rad": 0.0}, ""),
        (TRACK, 5.0, {"sigma_rad": 2.0**-5 + BIT}, "1 sigma of the angle is 1.79 deg, at most 1.79 deg allowed"),
        (TRACK, 5.0, {"sigma_rad": None}, "1 sigma of the angle is none"),
        (HOME, None, {}, ""),
    ],
)
def test_commands(kind: MotionKind, deg: float | None, changes: dict[str, Any], says: str) -> None:
    reason = order(ready(kind), kind, deg, **changes)
    assert says in reason
    assert bool(reason) == bool(says)


@pytest.mark.parametrize(
    ("kind", "deg", "changes", "says"),
    [
        (TRACK, 40.4, {}, ""),
        (TRACK, 40.6, {}, "the stage stands at 40.6 deg, outside its limits"),
        (SEARCH, 30.4, {}, ""),
        (SEARCH, 30.6, {}, "present angle 30.6 deg is outside the sweep range"),
        (SEARCH, -35.6, {}, "present angle -35.6 deg"),
        (SEARCH, 0.0, {"homed": False}, "the stage is not homed"),
        (SEARCH, 0.0, {"fault": "overload"}, "overload"),
        (HOME, 0.0, {"homed": False}, ""),
        (HOME, 50.0, {"homed": False}, ""),
    ],
)
def test_where_the_stage_stands(kind: MotionKind, deg: float, changes: dict[str, Any], says: str) -> None:
    reason = order(ready(kind, deg, **changes), kind, None if kind is HOME else 5.0)
    assert says in reason
    assert bool(reason) == bool(says)


@pytest.mark.parametrize(
    ("marker_s", "registration", "says"),
    [
        (NOW - 0.125, "ok", ""),
        (NOW - 0.125, "warning", ""),
        (NOW - 0.126, "ok", "the marker is 126 ms old, at most 125 ms allowed"),
        (NOW + 0.0009, "ok", ""),
        (NOW + 0.0011, "ok", "the marker is from the future"),
        (None, "ok", "no marker detected"),
        (NOW, "refused", "the registration is refused"),
        (NOW, None, "there is no current registration"),
    ],
)
def test_what_tracking_needs_when_it_begins_and_while_it_turns(
    marker_s: float | None, registration: str | None, says: str
) -> None:
    gate = ready(TRACK)
    gate.handle(Beat(NOW, marker_s, registration), NOW)
    reason = order(gate, TRACK, 5.0)
    assert says in reason
    assert bool(reason) == bool(says)
    gate = ready(TRACK)
    assert order(gate, TRACK, 5.0) == ""
    assert halted(gate.handle(Beat(NOW, marker_s, registration), NOW)) == (says and f"tracking held: {reason}")
    assert gate.requested is TRACK


@pytest.mark.parametrize(
    ("later_s", "says"),
    [(0.5, ""), (0.5 + BIT, "the stage is silent"), (1.0 + BIT, "latched: the clock jumped by 1.000 s")],
)
def test_age_of_a_status_and_gap_of_the_clock(later_s: float, says: str) -> None:
    gate, now = ready(SEARCH), NOW + later_s
    gate.handle(Beat(now, now, "ok"), now)
    reason = order(gate, SEARCH, 5.0, now)
    assert says in reason
    assert bool(reason) == bool(says)
    gate = ready(SEARCH)
    assert order(gate, SEARCH, 5.0) == ""
    assert says.removeprefix("latched: ") in halted(gate.handle(Beat(now, now, "ok"), now))
    assert (gate.latched is None) == (not says)


@pytest.mark.parametrize(("kind", "limit_s"), [(TRACK, 0.25), (SEARCH, 1.0), (HOME, 1.0), (None, 1.0)])
def test_heartbeats(kind: MotionKind | None, limit_s: float) -> None:
    gate = ready(kind or SEARCH)
    gate.limits = replace(LIMITS, marker_age_s=0.5)
    if kind is not None:
        assert order(gate, kind, None if kind is HOME else 5.0) == ""
    turning = {"moving": kind is not None, "homing": kind is HOME}
    for now in (NOW + 0.5 * limit_s, NOW + limit_s):
        assert gate.tick(now, status(now, 0.1, **turning)) == []
    found = gate.tick(now + BIT, None)
    assert found == [Halt("the main program's heartbeat is missing", latched=False)]
    assert (gate.moving, gate.requested) == (None, None)


def test_a_request_lasts_as_long_as_it_is_said() -> None:
    for last, says in ((NOW + 4.0, ""), (NOW + 4.0 + BIT, "has not asked to search")):
        gate = ready(SEARCH)
        for now in (*(NOW + 0.5 * k for k in range(1, 8)), last):
            gate.handle(Beat(now, now, "ok"), now)
            gate.tick(now, status(now, 0.0))
        assert says in order(gate, SEARCH, 5.0, last)
        assert (gate.moving is SEARCH) == (not says)


@pytest.mark.parametrize(
    ("deg", "velocity_deg", "says"),
    [
        (4.9, 12.9, ""),
        (4.9, 13.1, "the stage turns at 13.1 deg/s: too fast"),
        (0.0, -13.1, "the stage turns at 13.1 deg/s: too fast"),
        (6.7, 0.0, ""),  # 12.5 deg/s for 0.5 s, and 0.5 deg
        (6.8, 0.0, "the stage turned by 6.8 deg in 500 ms"),
        (-0.4, 0.0, ""),
        (-0.6, 0.0, "the stage is at -0.6 deg, off its way"),
        (math.nan, 0.0, "the stage reports no angle"),
        (0.0, math.inf, "the stage reports no angle"),
    ],
)
def test_a_motion_under_way(deg: float, velocity_deg: float, says: str) -> None:
    gate = ready(SEARCH)
    assert order(gate, SEARCH, 20.0) == ""
    now = NOW + 0.5
    found = halted(gate.tick(now, status(now, deg, velocity_deg, moving=True)))
    assert says in found
    assert bool(found) == bool(says)
    assert (gate.latched is None) == (not says)


def test_a_motion_beyond_its_target() -> None:
    for deg, says in ((5.4, ""), (5.6, "the stage is at 5.6 deg, off its way")):
        gate = ready(SEARCH)
        assert order(gate, SEARCH, 5.0) == ""
        assert says in halted(gate.tick(NOW + 0.5, status(NOW + 0.5, deg, moving=True)))
        assert (gate.latched is None) == (not says)


@pytest.mark.parametrize(("braked_s", "reach_deg"), [(0.05, 3.5), (0.5, 0.3), (1.5, 0.0)])
def test_way_that_a_stop_leaves_to_brake(braked_s: float, reach_deg: float) -> None:
    """By hand, at 10, 2 and 0 deg/s and 20 deg/s^2: 0.1 s for the driver's call, and what the brakes need."""
    for beyond, says in ((0.4, ""), (0.6, "off its way")):
        gate, now = ready(SEARCH), NOW + 0.5
        assert order(gate, SEARCH, 20.0) == ""
        assert gate.tick(now, status(now, 5.0, moving=True)) == []
        gate.handle(Stop(now, False, "test"), now)
        for _ in range(2):
            now += 0.5 * braked_s
            assert gate.tick(now, status(now, 5.0, moving=braked_s < 1.0)) == []
        gate.handle(Beat(now, now, "ok"), now)
        gate.handle(Request(now, SEARCH, "pedal"), now)
        assert order(gate, SEARCH, 0.0, now) == ""
        now += 0.5
        assert says in halted(gate.tick(now, status(now, 5.0 + reach_deg + beyond, moving=True)))
        assert (gate.latched is None) == (not says)


def test_a_stage_that_brakes_outside_its_limits() -> None:
    for homed, says in ((False, ""), (True, "the stage is at 48.8 deg, outside its limits")):
        gate, now = ready(HOME, 50.0, homed=False), NOW + 0.25
        assert order(gate, HOME, None) == ""
        assert gate.tick(now, status(now, 49.0, moving=True, homing=True, homed=False)) == []
        gate.handle(Stop(now, False, "test"), now)
        now += 0.25
        assert halted(gate.tick(now, status(now, 48.8, moving=True, homed=homed))) == says


def run_until(gate: Gate, deg: float, moving: bool, most_s: float) -> tuple[float, list[Action]]:
    """Statuses of a stage that stays there, each 2^-6 s: how long until the gate does something, and what."""
    for k in range(1, int(64 * most_s)):
        now = NOW + k / 64.0
        actions = [*gate.handle(Beat(now, now, "ok"), now), *gate.tick(now, status(now, deg, moving=moving))]
        if actions:
            return now - NOW, actions
    return math.inf, []


def test_a_motion_ends_when_the_stage_says_so_or_its_time_is_over() -> None:
    late = replace(LIMITS, request_s=60.0)
    for start, target, moving, after_s, what in (
        (0.0, 0.4, False, 0.3, Arrived(7)),  # it was there, and has had time to begin
        (0.0, 5.0, False, 1.5, Halt("the stage stopped by itself at 0.0 deg", latched=False)),
        (
            0.0,
            5.0,
            True,
            3.75,
            Halt("the motion takes longer than it can", latched=True),
        ),  # 1.5 x 5 deg at 10 deg/s, 3 s
    ):
        gate = ready(SEARCH, start)
        gate.limits = late
        assert order(gate, SEARCH, target) == ""
        took, actions = run_until(gate, start, moving, 9.0)
        assert actions == [what]
        assert after_s < took <= after_s + 2.0 / 64.0
        assert gate.moving is None


def test_a_short_motion_that_was_seen_ends_at_once() -> None:
    gate = ready(SEARCH)
    assert order(gate, SEARCH, 0.4) == ""
    assert gate.tick(NOW + 0.05, status(NOW + 0.05, 0.2, moving=True)) == []
    assert gate.tick(NOW + 0.1, status(NOW + 0.1, 0.4)) == [Arrived(7)]


def test_a_reset_waits_for_a_stage_that_strayed() -> None:
    gate = ready(SEARCH)
    now = NOW
    for deg, says in ((0.9, ""), (1.1, "the stage says that it stands, and turned by 1.1 deg")):
        now += 0.25
        assert halted(gate.tick(now, status(now, deg))) == says
    strayed = now
    while True:
        now += 0.25
        gate.tick(now, status(now, 1.1))
        gate.handle(Beat(now, now, "ok"), now)
        refused = gate.handle(Reset(now, "nurse"), now)
        assert bool(refused) == (now - strayed <= LIMITS.standing_s())
        if not refused:
            return
        assert refused == [Refusal("reset refused: the stage still moves")]
