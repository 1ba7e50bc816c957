"""What a machine can do is measured before anything moves; too slow a one is named as the cause, with what to lower."""

from __future__ import annotations

import pytest

from fgreg.drivers.base import CommandKind, OperatorCommand
from fgreg.live.actions import Action, Ask, Inputs, RegistrationState, StageView, Tell
from fgreg.live.pace import MEASURE_S, NO_CAMERA_S, SAY_S, Pace
from fgreg.live.workflow import Workflow, WorkflowSettings
from fgreg.model.time_sync import PoseHistory
from fgreg.session.setup_reader import read_setup
from fgreg.simulation.documents import session_document
from fgreg.simulation.room import room_config
from fgreg.stage.limits import MotionKind


def run(
    pace: Pace, begin_s: float, seconds: float, hz: float, latency_s: float = 0.03, step_s: float = 0.02
) -> list[str]:
    """Let a camera send 30 frames a second, of which ``hz`` are processed; all messages."""
    said, next_frame = [], begin_s
    for k in range(round(seconds / step_s)):
        now = begin_s + step_s * k
        pace.arrived(now, 1)
        if now >= next_frame:
            next_frame += 1.0 / hz
            pace.frame(now, latency_s)
        pace.step(now)
        said += pace.news(now)
    return said


def test_a_fast_machine_is_said_once_and_may_home_after_the_measurement() -> None:
    pace = Pace(0.0)
    assert run(pace, 0.0, MEASURE_S - 0.1, 30.0) == []
    assert "being measured" in pace.not_yet(MEASURE_S - 0.1)
    (text,) = run(pace, MEASURE_S - 0.1, 20.0, 30.0)
    assert text.startswith("this machine: 30 of 50 frames/s used, 30 ms from frame to angle")
    assert (pace.not_yet(30.0), pace.slow) == ("", "")


@pytest.mark.parametrize(
    ("hz", "latency_s", "step_s", "says", "homes"),
    [
        (2.0, 0.3, 0.02, "this machine is too slow to register: 2 of 50 frames/s used", False),
        (10.0, 0.1, 0.5, "this machine is too slow to register", False),  # the loop stalls
        (10.0, 0.3, 0.02, "this machine is too slow to follow the beam, but registers", True),
        (5.0, 0.1, 0.02, "this machine is slow, and registers with few frames", True),
    ],
)
def test_a_slow_machine_is_the_cause_and_may_home_where_it_registers(
    hz: float, latency_s: float, step_s: float, says: str, homes: bool
) -> None:
    pace = Pace(0.0)
    (text,) = run(pace, 0.0, 20.0, hz, latency_s, step_s)
    assert text.startswith(says)
    assert "lower the camera's picture size" in text
    assert pace.slow.startswith(says)
    assert (pace.not_yet(20.0) == "") is homes


def frames(pace: Pace, begin_s: float, seconds: float, *, sent_hz: float, used: bool) -> list[str]:
    """Let a camera send frames of which all are processed or none, with a step of the loop each 0.05 s."""
    said = []
    for k in range(round(seconds / 0.05)):
        now = begin_s + 0.05 * k
        if k % round(20.0 / sent_hz) == 0:
            pace.arrived(now, 1)
            if used:
                pace.frame(now, 0.05)
        pace.step(now)
        said += pace.news(now)
    return said


def test_a_machine_that_processes_no_frame_any_more_is_too_slow() -> None:
    pace = Pace(0.0)
    frames(pace, 0.0, 10.0, sent_hz=20.0, used=True)
    assert pace.not_yet(10.0) == ""
    said = frames(pace, 10.0, SAY_S + 10.0, sent_hz=20.0, used=False)
    assert said[-1].startswith("this machine is too slow to register: 0 of 20 frames/s used, longest step 50 ms")
    assert pace.not_yet(50.0) == pace.slow


@pytest.mark.parametrize(
    ("hz", "says", "homes"),
    [(2.0, "the camera sends too few frames to register: 2 of 2", False), (5.0, "the camera sends few frames", True)],
)
def test_a_camera_that_sends_few_frames_is_not_called_a_slow_machine(hz: float, says: str, homes: bool) -> None:
    pace = Pace(0.0)
    (text,) = frames(pace, 0.0, 20.0, sent_hz=hz, used=True)
    assert text.startswith(says)
    assert text.endswith("raise the camera's frame rate")
    assert (pace.not_yet(20.0) == "") is homes


def test_frames_from_before_the_first_one_that_was_processed_are_not_counted() -> None:
    pace = Pace(0.0)
    frames(pace, 0.0, 4.0, sent_hz=20.0, used=False)  # the processes start
    (text,) = frames(pace, 4.0, MEASURE_S + 0.1, sent_hz=20.0, used=True)
    assert text.startswith("this machine: 20 of 20 frames/s used")


def test_once_the_load_is_gone_it_homes_and_says_so() -> None:
    pace = Pace(0.0)
    run(pace, 0.0, 10.0, 2.0)
    assert pace.not_yet(10.0)
    assert any("fast enough again" in text for text in run(pace, 10.0, SAY_S + 10.0, 30.0))
    assert pace.not_yet(SAY_S + 20.0) == ""


def test_without_a_camera_the_stage_may_be_homed_in_the_end() -> None:
    pace = Pace(0.0)
    assert pace.not_yet(1.0)
    assert pace.not_yet(NO_CAMERA_S + 0.1) == ""


def test_the_stage_is_not_homed_before_the_machine_may_and_the_operator_is_told_why() -> None:
    model = read_setup(session_document(room_config(1).scene), "session.yaml", "room", []).model
    assert model is not None
    workflow = Workflow(model, WorkflowSettings(aims=0, hearing_threshold=1.0))

    def step(now_s: float, *words: CommandKind) -> tuple[Action, ...]:
        commands = tuple(OperatorCommand(word) for word in words)
        stage = StageView(0.0, False, False, now_s)
        return workflow.step(Inputs(now_s, PoseHistory(), stage, (), commands, RegistrationState(), None, 0))

    workflow.not_yet = "this machine is too slow to register: 1 of 30 frames/s used"
    assert step(1.0) == (Tell(f"the stage is not homed: {workflow.not_yet}"),)
    assert step(2.0) == ()  # said once in a while
    assert step(3.0, CommandKind.HOME) == (Tell(f"not homed: {workflow.not_yet}", answer=True),)
    workflow.not_yet = ""
    (asked,) = step(4.0)
    assert isinstance(asked, Tell)
    assert asked.wants is CommandKind.HOME
    assert step(5.0, CommandKind.HOME) == (Ask(MotionKind.HOME),)
