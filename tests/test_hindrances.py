"""A session without pairs says what kept it from taking any: stops of the stage, a machine that was too slow."""

from __future__ import annotations

from pathlib import Path

from fgreg.model.events import NoteEvent
from fgreg.model.hindrances import hindrances
from fgreg.pipeline.solve import SolveRequest, solve_session
from tests.session_files import events, setup, write, write_frames

SLOW = "this machine is too slow to register: 2 of 30 frames/s used"


def reasons(folder: Path, *, pairs: bool) -> tuple[str, ...]:
    """Of a session whose homing was stopped twice and a search once, on a slow machine."""
    stage = [
        ("home", "asked for by the operator"),
        ("stop", "the main program's heartbeat is missing"),
        ("home", "asked for by the operator"),
        ("stop", "the main program's heartbeat is missing"),
        ("search", "sweep, position 1"),
        ("stop", "the operator has stopped the stage"),
        ("stop", "the stage is silent"),
    ]
    log = [event for event in events() if pairs and event["type"] in ("aim", "pair")]
    last = max((event["t"] for event in log), default=0.0)
    log += [{"type": "stage", "t": last + 1.0, "command": command, "reason": reason} for command, reason in stage]
    log.append({"type": "note", "t": last + 2.0, "text": SLOW})
    write(folder, setup(), log)
    write_frames(folder)
    return solve_session(SolveRequest(folder)).estimate.reasons


def test_a_session_without_pairs_names_the_stops_and_the_machine_and_not_the_number_of_pairs(tmp_path: Path) -> None:
    found = reasons(tmp_path, pairs=False)
    assert found[:3] == (
        "homing was stopped on the way 2 times: the main program's heartbeat is missing",
        "a search was stopped on the way once: the stage is silent",
        SLOW,
    )
    assert not any("take at least" in reason for reason in found)


def test_a_session_with_few_pairs_names_them_as_well(tmp_path: Path) -> None:
    found = reasons(tmp_path, pairs=True)
    assert found[0].startswith("homing was stopped")
    assert len(found) > 3  # the registration's own


def test_a_machine_that_became_fast_enough_is_no_cause() -> None:
    slow = NoteEvent(1.0, 0, SLOW)
    assert hindrances([slow]) == (SLOW,)
    for text in (
        "this machine: 30 of 30 frames/s used: fast enough again",
        "this machine is too slow to follow the beam, but registers: 9 of 30 frames/s used",
    ):
        assert hindrances([slow, NoteEvent(2.0, 0, text)]) == ()
    few = "the camera sends too few frames to register: 1 of 1 frames/s used"
    assert hindrances([slow, NoteEvent(2.0, 0, few)]) == (few,)
