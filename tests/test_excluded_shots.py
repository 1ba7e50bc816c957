"""Shots that are left out by hand count nowhere, are never lost, and the verdict says that they are missing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import fgreg
from fgreg.cli.main import app, main
from fgreg.model.estimate import PairEstimate, Verdict
from fgreg.model.events import AimEvent, PairEvent, TrackEvent
from fgreg.model.excluded_shots import excluded_shots
from fgreg.model.solve_config import SolveConfig
from fgreg.online.live_session import LiveSession
from fgreg.pipeline.exclude import ShotNames, without_shots
from fgreg.pipeline.replay import ReplayRequest, replay_session
from fgreg.session.result_file import read_result
from fgreg.session.session_reader import read_session
from tests.batch_engine import BatchEngine
from tests.test_live_session import same

FAST = SolveConfig(limit_mm=10.0, posterior_effective=60.0, posterior_samples=600)


def _lines(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]


def _append(folder: Path, *events: dict[str, Any]) -> None:
    with (folder / "events.jsonl").open("a") as file:
        file.writelines(json.dumps({"t": 1e4, **event}) + "\n" for event in events)


def _said(pairs: tuple[PairEstimate, ...]) -> dict[int, str]:
    return {pair.pm: pair.reason for pair in pairs if not pair.used}


def test_what_an_option_leaves_out_is_as_if_it_had_never_been_taken(pose_session: Path, tmp_path: Path) -> None:
    report = fgreg.solve(pose_session, out=tmp_path / "out.yaml", without_pms=[3, 7], without_aims=[2])
    estimate = read_result(tmp_path / "out.yaml")
    aim = [event for event in read_session(pose_session).events if isinstance(event, AimEvent)][2]
    gone = [
        e for e in _lines(pose_session) if e.get("pm") not in (3, 7) and not (e["type"] == "aim" and e["t"] == aim.t)
    ]
    (pose_session / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in gone))
    short = fgreg.solve(pose_session).estimate
    for left, right in zip(estimate.epochs, short.epochs, strict=True):
        assert left.trus_T_camera is not None
        assert right.trus_T_camera is not None
        np.testing.assert_allclose(left.trus_T_camera, right.trus_T_camera, atol=1e-6)
        assert left.predicted_tre is not None
        assert right.predicted_tre is not None
        assert left.predicted_tre.worst_mm == pytest.approx(right.predicted_tre.worst_mm, abs=1e-6)
    assert [reason for reason in estimate.reasons if "left out by hand" not in reason] == list(short.reasons)
    assert [(shot.type, shot.pm, shot.aim) for shot in estimate.excluded] == [
        ("aim", None, 2),
        ("pair", 3, None),
        ("pair", 7, None),
    ]
    assert _said(estimate.pairs) == dict.fromkeys((3, 7), "left out by hand: option --without-pm")
    assert report.estimate.aims[2].reason == "left out by hand: option --without-aim"


def test_a_verdict_without_contrary_evidence_is_never_ok(pose_session: Path) -> None:
    """The camera moves after 12 of 20 pairs; with the others left out all tests pass, and the verdict says why."""
    events = _lines(pose_session)
    for event in [e for e in events if e["type"] == "pair"][12:]:
        event["marker"]["camera_T_marker"][0][3] += 15.0
    (pose_session / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events))
    estimate = fgreg.solve(pose_session, without_pms=range(12, 20)).estimate
    assert estimate.verdict is not Verdict.OK
    (said,) = [reason for reason in estimate.reasons if "by hand" in reason]
    assert said.startswith("8 of 32 shots were left out by hand (PM 12 to 19)")
    assert "no test has seen what is left out" in said


def test_a_replay_leaves_out_from_the_event_on(pose_session: Path, tmp_path: Path) -> None:
    """A query before the event is answered with the shot, one after it without, as they were while it was recorded."""
    events = _lines(pose_session)
    query = next(event for event in events if event["type"] == "track")
    events = [event for event in events if event["type"] != "track"][: 12 + 10]
    later = {"t": events[-1]["t"]}
    asked = [{**query, **later}, {"type": "exclude", "pm": 9, **later}, {**query, **later}]
    again = [{"type": "include", "pm": 9, **later}, {**query, **later}]
    (pose_session / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in [*events, *asked, *again]))
    report = replay_session(ReplayRequest(pose_session, tmp_path / "out.yaml"), FAST, make_engine=BatchEngine)
    before, without, after = report.solved.estimate.tracks
    assert before.stage_rad is not None
    assert without.stage_rad is not None
    assert abs(without.stage_rad - before.stage_rad) > 1e-6
    assert after.stage_rad == pytest.approx(before.stage_rad, abs=1e-9)


def test_a_session_being_recorded_goes_on_without_what_is_left_out(pose_session: Path) -> None:
    events = [event for event in read_session(pose_session).events if isinstance(event, AimEvent | PairEvent)][:21]
    (pose_session / "events.jsonl").unlink()
    with LiveSession.open(pose_session, make_engine=BatchEngine) as live:
        for event in events[:-1]:
            live.add(event)
        whole = live.measurements()
        out = live.add(fgreg.ExcludeEvent(live.journal.last_t or 0.0, 0, pm=4, reason="bumped"))
        assert out is not None
        assert out.verdict is not Verdict.OK
        assert [reason for reason in out.reasons if reason.startswith("1 of 20 shots was left out by hand (PM 4)")]
        live.add(events[-1])
        found, estimate = live.measurements(), live.estimate
    assert {pair.pm for pair in whole.pairs} - {pair.pm for pair in found.pairs} == {4}
    assert len(found.pairs) == 8
    with LiveSession.open(pose_session, make_engine=BatchEngine) as live:
        same(live.estimate, estimate)
        assert live.estimate is not None
        assert estimate is not None
        assert live.estimate.reasons == estimate.reasons
        back = live.add(fgreg.IncludeEvent(live.journal.last_t or 0.0, 0, pm=4))
        assert back is not None
        assert not [reason for reason in back.reasons if "by hand" in reason]
        assert len(live.measurements().pairs) == 9


def test_the_commands_record_who_and_why_and_delete_nothing(pose_session: Path) -> None:
    recorded = (pose_session / "events.jsonl").read_bytes()
    run = CliRunner()
    said = run.invoke(
        app, ["exclude", str(pose_session), "--pm", "3, 7", "--aim", "2", "--reason", "bumped", "--by", "A. N."]
    )
    assert said.exit_code == 0
    assert "PM 3 at" in said.output
    assert "left out by hand: bumped (A. N.)" in said.output
    assert (pose_session / "events.jsonl").read_bytes().startswith(recorded)
    assert run.invoke(app, ["include", str(pose_session), "--pm", "7"]).exit_code == 0
    solved = run.invoke(app, ["solve", str(pose_session)])
    assert "aim 2, " in solved.output
    assert "not used: left out by hand: bumped (A. N.)" in " ".join(solved.output.split())
    assert [(shot.pm, shot.aim, shot.by) for shot in read_result(pose_session / "result.yaml").excluded] == [
        (None, 2, "A. N."),
        (3, None, "A. N."),
    ]
    assert sum(isinstance(event, TrackEvent) for event in read_session(pose_session).events) == 4


def test_what_an_event_says_cannot_steer_the_terminal(pose_session: Path, tmp_path: Path) -> None:
    spaced = pose_session.rename(tmp_path / "a session")
    run = CliRunner()
    said = run.invoke(app, ["exclude", str(spaced), "--pm", "3", "--by", "A\x1b[2J\u202e"])
    assert f"fgreg solve '{spaced}'" in said.output
    checked = run.invoke(app, ["check", str(spaced)])
    assert r"left out by hand (A\x1b[2J\u202e)" in checked.output
    assert all(line.isprintable() for line in (said.output + checked.output).splitlines())


def test_a_registration_without_shots_is_verified_as_it_is(pose_session: Path, tmp_path: Path) -> None:
    events = _lines(pose_session)
    new = [event for event in events if event.get("pm", 0) >= 16]
    kept = [event for event in events if event not in new and event["type"] != "track"]
    (pose_session / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in kept))
    limit = SolveConfig(limit_mm=10.0)
    assert fgreg.solve(pose_session, limit, without_pms=[3], without_aims=[2]).estimate.verdict is Verdict.WARNING
    choice = {"type": "exclude", "t": new[-1]["t"], "pm": 18, "reason": "bumped"}
    (tmp_path / "new.jsonl").write_text("".join(json.dumps(event) + "\n" for event in [*new, choice]))
    found = fgreg.verify(pose_session, tmp_path / "new.jsonl", limit)
    assert [shot.pm for shot in found.verification.shots] == [16, 17, 19]
    assert [(shot.pm, shot.reason) for shot in found.unused] == [(18, "left out by hand: bumped")]
    said = CliRunner().invoke(app, ["verify", str(pose_session), str(tmp_path / "new.jsonl"), "--limit-mm", "10"])
    assert "the registration's own verdict is warning: look first" in " ".join(said.output.split())


WRONG = {
    "--without-pm: found 99, expected a PM of the session: 0 to 19": ["solve", "--without-pm", "3,99"],
    "--without-aim: found 12, expected an aim of the session, counted from 0: 0 to 11": [
        "solve",
        "--without-aim",
        "12",
    ],
    "--without-point: found 0, expected a known point of the session, counted from 0: none": [
        "solve",
        "--without-point",
        "0",
    ],
    "--without-pm: found 3-7, expected numbers with commas between": ["solve", "--without-pm", "3-7"],
    "--pm: found 99, expected a PM of the session": ["exclude", "--pm", "3,99"],
    "--pm: found 3, expected a PM that is left out: none": ["include", "--pm", "3"],
    "--pm, --aim and --point: found nothing": ["exclude"],
    "--without-pm: found nothing, expected numbers with commas": ["solve", "--without-pm", ""],
    "--aim: found 1,,2, expected numbers with commas": ["exclude", "--aim", "1,,2"],
}


@pytest.mark.parametrize("message", WRONG)
def test_a_shot_that_is_not_there_is_one_line_and_changes_nothing(
    message: str, pose_session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.read_bytes() for path in pose_session.rglob("*") if path.is_file()}
    command, *options = WRONG[message]
    monkeypatch.setattr("sys.argv", ["fgreg", command, str(pose_session), *options])
    with pytest.raises(SystemExit) as ended:
        main()
    (line,) = capsys.readouterr().err.splitlines()
    assert (ended.value.code, message in line) == (2, True), line
    assert {path: path.read_bytes() for path in pose_session.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("event", "message"),
    [
        ({"type": "exclude", "pm": 20}, "pm: found 20, expected the PM of an earlier pair: 0 to 19"),
        ({"type": "include", "line": 33}, "line: found 33, expected the line of an earlier aim, pair or point"),
        ({"type": "exclude", "pm": 3, "line": 4}, "found both, expected pm or line"),
    ],
)
def test_a_recorded_choice_of_a_shot_that_is_not_there_is_an_error_with_its_line(
    event: dict[str, Any], message: str, pose_session: Path
) -> None:
    _append(pose_session, event)
    with pytest.raises(fgreg.InputError, match=r"events.jsonl: line \d+: .*" + message.replace("(", r"\(")):
        read_session(pose_session)


def test_a_pm_that_is_looked_at_again_counts_again(pose_session: Path) -> None:
    look = next(event for event in _lines(pose_session) if event.get("pm") == 5)
    _append(pose_session, {"type": "exclude", "pm": 5}, {**look, "t": 1e4})
    (left,) = excluded_shots(read_session(pose_session).events).values()
    assert (left.pm, left.t, left.text) == (5, look["t"], "left out by hand")


def test_what_is_left_out_twice_keeps_its_reason(pose_session: Path) -> None:
    why = {"type": "exclude", "pm": 5, "reason": "bumped", "by": "A. N."}
    _append(pose_session, why, {"type": "exclude", "pm": 5})
    twice = without_shots(read_session(pose_session), ShotNames((5, 6), (2,)), "--without-")
    assert [(shot.pm, shot.aim, shot.reason, shot.by) for shot in excluded_shots(twice.events).values()] == [
        (None, 2, "option --without-aim", ""),
        (5, None, "bumped", "A. N."),
        (6, None, "option --without-pm", ""),
    ]
    _append(pose_session, {**why, "reason": "blood on the tag"})
    (left,) = excluded_shots(read_session(pose_session).events).values()
    assert left.reason == "blood on the tag"


def test_a_recorded_shot_or_check_that_was_refused_leaves_no_ok(pose_session: Path) -> None:
    assert fgreg.solve(pose_session, FAST).estimate.verdict is Verdict.OK
    lines = _lines(pose_session)
    (first, *_) = [number for number, event in enumerate(lines, 1) if event["type"] == "pair"]
    check = {"type": "check", "t": 1e4, "camera_p_mm": [0.0, 0.0, 150.0], "trus_p_mm": [0.0, 0.0, 60.0]}
    refusals = [
        {"type": "refused", "event": {"type": kind, "line": line}, "reason": "a crash"}
        for kind, line in (("pair", first), ("check", len(lines) + 1))
    ]
    _append(pose_session, check, *refusals)
    solved = fgreg.solve(pose_session, FAST).estimate
    assert solved.verdict is Verdict.WARNING
    said = "`refused` events take out recorded shots, checks or camera moves (2; the first: a crash)"
    assert [reason for reason in solved.reasons if reason.startswith(said)]
    with LiveSession.open(pose_session, config=FAST) as live:
        assert live.estimate is not None
        assert live.estimate.verdict is Verdict.WARNING
        assert any(reason.startswith(said) for reason in live.estimate.reasons)


def test_a_torn_last_line_is_told_and_kept_when_a_shot_is_left_out(
    pose_session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with (pose_session / "events.jsonl").open("a") as file:
        file.write('{"t": 1e4, "type": "pa')
    monkeypatch.setattr("sys.argv", ["fgreg", "exclude", str(pose_session), "--pm", "3"])
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr()
    assert (ended.value.code, "the last line was cut short; its 22 bytes are kept in events.jsonl.cut" in said.err) == (
        0,
        True,
    )
    assert "PM 3 at " in said.out
