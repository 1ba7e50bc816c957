"""``fgreg replay``: the recorded session event by event, the same result as a solve, and what is left on disk."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgreg.cli import main
from fgreg.errors import EventRefused, InputError
from fgreg.model.events import PairEvent, TrackEvent
from fgreg.model.session_model import NoiseModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.estimate import OnlineEstimate
from fgreg.online.events import OnlineEvent
from fgreg.online.live_session import Engine, MakeEngine, online_engine
from fgreg.pipeline.replay import ReplayRequest, ReplayStep, quantiles, replay_session
from fgreg.pipeline.solve import SolveRequest, solve_session
from fgreg.session.result_file import read_result
from fgreg.session.session_reader import read_session
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session
from fgreg.viewer.spawn import ViewerError, spawn_viewer
from tests.recordings import read_recording, transform_of, views

FAST = SolveConfig(posterior_effective=60.0, posterior_samples=600)


@pytest.fixture
def make_engine() -> MakeEngine:
    return online_engine


@pytest.fixture(scope="module")
def _short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sessions") / "short"
    config = replace(PRESETS["first-hit"], aims=8, pairs=9, tracks_heard=1, tracks_silent=1)
    write_session(simulate(replace(config, noise=NoiseModel(aim_mm=(0.3, 0.3, 0.1))), 2), folder)
    return folder


@pytest.fixture
def short(_short: Path, tmp_path: Path) -> Path:
    """A copy of a pose-level session with 8 aims, 9 first-hit pairs and 2 tracks."""
    import shutil

    return Path(shutil.copytree(_short, tmp_path / "short"))


def run(monkeypatch: pytest.MonkeyPatch, make_engine: MakeEngine, *words: str | Path) -> int:
    monkeypatch.setattr("fgreg.pipeline.replay.online_engine", make_engine)
    monkeypatch.setattr(sys, "argv", ["fgreg", "replay", *(str(word) for word in words)])
    with pytest.raises(SystemExit) as end:
        main.main()
    code = end.value.code
    assert isinstance(code, int)
    return code


def test_the_final_result_is_that_of_a_solve_with_timing_and_causal_answers(
    short: Path, tmp_path: Path, make_engine: MakeEngine
) -> None:
    steps: list[ReplayStep] = []
    replayed = replay_session(ReplayRequest(short), FAST, on_step=steps.append, make_engine=make_engine)
    solve_session(SolveRequest(short, tmp_path / "solved.yaml"), FAST)
    ours, solved = read_result(short / "result.yaml"), read_result(tmp_path / "solved.yaml")
    assert (ours.verdict, ours.reasons, len(ours.pairs)) == (solved.verdict, solved.reasons, len(solved.pairs))
    for a, b in zip(ours.epochs, solved.epochs, strict=True):
        assert a.trus_T_camera is not None
        assert b.trus_T_camera is not None
        np.testing.assert_allclose(a.trus_T_camera, b.trus_T_camera, atol=1e-9)
        assert a.predicted_tre == b.predicted_tre
    assert ours.timing is not None
    assert ours.timing.add is not None
    assert ours.timing.track is not None
    assert 0 < ours.timing.add.p50 <= ours.timing.add.p99 <= ours.timing.add.max
    assert solved.timing is None
    assert [track.causal for track in ours.tracks] == [True] * 2
    assert [track.causal for track in solved.tracks] == [False] * 2
    assert [step.done for step in steps] == list(range(1, 8 + 9 + 2 + 1))
    settled = replayed.settled
    assert settled is not None
    assert settled.trus_T_camera is not None
    last = replayed.solved.estimate.epochs[-1].trus_T_camera
    assert last is not None
    np.testing.assert_allclose(settled.trus_T_camera, last, atol=1e-6)


def test_queries_are_answered_from_what_was_known_at_their_time(
    short: Path, tmp_path: Path, make_engine: MakeEngine
) -> None:
    events = [json.loads(line) for line in (short / "events.jsonl").read_text().splitlines()]
    pairs = [event for event in events if event["type"] == "pair"]
    query = next(event for event in events if event["type"] == "track" and ("trus" in event or "looks" in event))
    early, late = {**query, "t": pairs[2]["t"]}, {**query, "t": pairs[7]["t"]}
    events = [event for event in events if event["type"] != "track"]
    events.insert(events.index(pairs[2]) + 1, early)
    events.insert(events.index(pairs[7]) + 1, late)
    path = short / "events.jsonl"
    path.write_text("".join(json.dumps(event) + "\n" for event in events))
    whole = replay_session(ReplayRequest(short), FAST, make_engine=make_engine).solved.estimate.tracks
    assert whole[0].stage_rad is None
    assert whole[0].reason
    assert whole[1].stage_rad is not None
    # What comes after a query cannot matter to it.
    path.write_text("".join(json.dumps(event) + "\n" for event in events[: events.index(late) + 1]))
    cut = replay_session(ReplayRequest(short), FAST, make_engine=make_engine).solved.estimate.tracks
    assert cut[0].stage_rad is None
    # Not bit by bit: rounding depends on where arrays lie in memory.
    assert cut[1].stage_rad == pytest.approx(whole[1].stage_rad, rel=0, abs=1e-9)
    assert cut[1].sigma_rad == pytest.approx(whole[1].sigma_rad, rel=1e-9)


def test_a_reported_move_of_the_camera_begins_an_epoch(tmp_path: Path, make_engine: MakeEngine) -> None:
    folder = tmp_path / "moved"
    write_session(simulate(replace(PRESETS["camera-move"], aims=6, pairs=12), 3), folder)
    steps: list[ReplayStep] = []
    report = replay_session(ReplayRequest(folder), FAST, on_step=steps.append, make_engine=make_engine).solved
    assert [epoch.index for epoch in report.estimate.epochs] == [0, 1]
    known = [step.estimate.epoch for step in steps if step.estimate is not None]
    assert sorted(known) == known
    assert set(known) == {0, 1}
    solved = solve_session(SolveRequest(folder, tmp_path / "solved.yaml"), FAST).estimate
    for a, b in zip(report.estimate.epochs, solved.epochs, strict=True):
        assert a.trus_T_camera is not None
        assert b.trus_T_camera is not None
        np.testing.assert_allclose(a.trus_T_camera, b.trus_T_camera, atol=1e-9)


class Picky:
    """An engine that refuses one pair."""

    def __init__(self, engine: Engine, refused_t: float) -> None:
        self._engine, self._refused_t = engine, refused_t

    def __getattr__(self, name: str) -> object:
        return getattr(self._engine, name)

    def add(self, event: OnlineEvent) -> OnlineEstimate:
        if event.t == self._refused_t:
            raise EventRefused("no place for it")
        return self._engine.add(event)


def test_a_pair_that_the_engine_refuses_is_listed_with_its_reason(short: Path, make_engine: MakeEngine) -> None:
    pair = next(event for event in read_session(short).events if isinstance(event, PairEvent))
    steps: list[ReplayStep] = []
    report = replay_session(
        ReplayRequest(short),
        FAST,
        on_step=steps.append,
        make_engine=lambda *setting: Picky(make_engine(*setting), pair.t),  # type: ignore[arg-type]
    )
    assert [step.event.t for step in steps if step.refused] == [pair.t]
    assert [(p.t, p.used) for p in report.solved.estimate.pairs if not p.used] == [(pair.t, False)]
    assert "no place" in report.solved.estimate.pairs[0].reason


def test_lines_report_the_estimate_after_each_event(
    short: Path, make_engine: MakeEngine, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, make_engine, short) == 0
    captured = capsys.readouterr()
    lines = captured.out.splitlines()
    assert captured.err == ""
    for word in ("event", "epoch", "pairs", "NIS", "95 % mm", "verdict"):
        assert word in lines[0]
    assert [line for line in lines if "aim" in line and "none yet" in line]
    rows = [line.split() for line in lines if " pair, PM " in line]
    assert [row[3] for row in rows] == [str(i) for i in range(9)]
    known = [row[4:] for row in rows if row[-1] != "yet"]
    assert [row[:2] for row in known] == [["0", str(i)] for i in range(10 - len(known), 10)]
    assert all(float(row[3]) > 0 and row[4] in ("ok", "warning", "refused") for row in known)
    assert sum("track: stage to" in line for line in lines) == 2
    assert max(map(len, lines[:30])) <= 80
    assert "Taking in an event: median" in captured.out
    assert "result.yaml" in captured.out


def test_json_is_one_document_with_timing(
    short: Path,
    tmp_path: Path,
    make_engine: MakeEngine,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(monkeypatch, make_engine, short, "--json", "--out", tmp_path / "r.yaml") == 0
    document = json.loads(capsys.readouterr().out)
    assert set(document["timing_ms"]["add"]) == {"p50", "p99", "max"}
    assert document["tracks"][0]["causal"] is True
    assert not (short / "result.yaml").exists()
    assert read_result(tmp_path / "r.yaml").timing is not None


def test_the_sound_speed_is_estimated_where_asked_as_a_solve_does(
    short: Path, tmp_path: Path, make_engine: MakeEngine, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(monkeypatch, make_engine, short, "--estimate", "sound_speed", "-q", "--out", tmp_path / "r.yaml") == 0
    config = SolveConfig(estimate_sound_speed=True)
    solved = solve_session(SolveRequest(short, tmp_path / "s.yaml"), config).estimate.epochs[0]
    held = solve_session(SolveRequest(short, tmp_path / "h.yaml")).estimate.epochs[0]
    replayed = read_result(tmp_path / "r.yaml").epochs[0]
    assert replayed.trus_T_camera is not None
    assert solved.trus_T_camera is not None
    assert held.trus_T_camera is not None
    np.testing.assert_allclose(replayed.trus_T_camera, solved.trus_T_camera, atol=1e-4)
    assert np.abs(solved.trus_T_camera - held.trus_T_camera).max() > 0.01


def test_a_refused_session_exits_with_1(
    short: Path, make_engine: MakeEngine, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    events = (short / "events.jsonl").read_text().splitlines(keepends=True)
    pairs = [line for line in events if '"pair"' in line]
    (short / "events.jsonl").write_text("".join(line for line in events if line not in pairs[3:]))
    assert run(monkeypatch, make_engine, short) == 1
    assert "REFUSED" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--speed", "fast"), "--speed"),
        (("--speed", "0"), "--speed"),
        (("--speed", "inf"), "--speed"),
        (("--limit-mm", "-1"), "--limit-mm"),
        (("--estimate", "probe_radius"), "expected sound_speed"),
        (("--rrd", "/nowhere/x.rrd"), "/nowhere"),
        (("--out", "/nowhere/x.yaml"), "/nowhere"),
    ],
)
def test_mistakes_are_one_line_and_leave_no_result(
    words: tuple[str, ...],
    message: str,
    short: Path,
    make_engine: MakeEngine,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(monkeypatch, make_engine, short, *words) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("fgreg: error: ")
    assert captured.err.count("\n") == 1
    assert message in captured.err
    assert not (short / "result.yaml").exists()


def test_an_older_result_survives_a_bad_session(short: Path, make_engine: MakeEngine) -> None:
    (short / "result.yaml").write_text("format: fgreg-result/1\n")
    with (short / "events.jsonl").open("a") as file:
        file.write('{"type": "pair", "t": 1e6}\n')
    with pytest.raises(InputError, match=r"events\.jsonl: line"):
        replay_session(ReplayRequest(short), FAST, make_engine=make_engine)
    assert (short / "result.yaml").read_text() == "format: fgreg-result/1\n"


def test_speed_keeps_the_recorded_pace(short: Path, make_engine: MakeEngine) -> None:
    times = [event.t for event in read_session(short).events]
    speed = (times[-1] - times[0]) / 1.5
    at: list[float] = []
    replay_session(
        ReplayRequest(short, speed=speed), FAST, on_step=lambda _: at.append(time.monotonic()), make_engine=make_engine
    )
    due = [(t - times[0]) / speed for t in times]
    late = [moment - at[0] - wanted for moment, wanted in zip(at, due, strict=True)]
    assert min(late[1:]) > -0.05  # never ahead; how late depends on the machine


def test_the_recording_shows_the_registration_as_it_moves(short: Path, tmp_path: Path, make_engine: MakeEngine) -> None:
    steps: list[ReplayStep] = []
    rrd = tmp_path / "moving.rrd"
    replay_session(ReplayRequest(short, rrd=rrd), FAST, on_step=steps.append, make_engine=make_engine)
    found = read_recording(rrd)
    cameras = {row.shot: row for row in found["/world/camera"]}
    drawn = 0
    for number, step in enumerate(steps):
        if step.estimate is not None and step.estimate.trus_T_camera is not None:
            np.testing.assert_allclose(transform_of(cameras[number]), step.estimate.trus_T_camera, atol=1e-4)
            drawn += 1
    assert drawn >= 5 + 2  # five pairs with an estimate, and the queries after them
    pages = [row.values["TextDocument:text"][0] for row in found["/summary"] if row.shot is not None]
    assert "No registration yet" in pages[0]
    assert any("the probe may be turned" in page or "look first" in page for page in pages[-2:])
    assert {"online/predicted_worst_mm", "online/nis", "online/pairs"} <= {origin.lstrip("/") for origin in views(rrd)}
    assert sum(entity.startswith("/world/looks/") for entity in found) == 9


def test_without_a_screen_or_viewer_live_is_one_clear_error(tmp_path: Path) -> None:
    viewer = tmp_path / "rerun"
    viewer.write_text("#!/bin/sh\necho 'Error: no display was found' >&2\nexit 1\n")
    viewer.chmod(0o755)
    with pytest.raises(ViewerError, match=r"no display was found.*--rrd FILE"):
        spawn_viewer(viewer)
    viewer.chmod(0o644)
    with pytest.raises(ViewerError, match=r"cannot be started|ended at once"):
        spawn_viewer(tmp_path / "none")


def test_quantiles() -> None:
    found = quantiles([*range(101)])
    assert found is not None
    assert (found.p50, found.p99, found.max) == (50.0, 99.0, 100.0)
    assert quantiles([]) is None


def test_a_query_whose_marker_is_not_found_has_a_reason(raw_session: Path, make_engine: MakeEngine) -> None:
    event = next(event for event in read_session(raw_session).events if isinstance(event, TrackEvent))
    assert event.marker.left is not None
    dark = next(e for e in read_session(raw_session).events if isinstance(e, TrackEvent)).marker
    import cv2

    for path in (dark.left, dark.right):
        if path is not None:
            picture = cv2.imread(str(path))
            assert picture is not None
            cv2.imwrite(str(path), np.zeros_like(picture))
    tracks = replay_session(ReplayRequest(raw_session), FAST, make_engine=make_engine).solved.estimate.tracks
    assert tracks[0].stage_rad is None
    assert tracks[0].reason
    assert tracks[0].causal
