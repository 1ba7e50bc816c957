"""The commands as a user types them: output, exit status, and what is left on disk."""

from __future__ import annotations

import json
import sys
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

from fgreg import __version__
from fgreg.cli.main import main
from fgreg.session.result_file import read_result
from fgreg.simulation.presets import PRESETS


def _run(monkeypatch: pytest.MonkeyPatch, *words: str | Path) -> int:
    monkeypatch.setattr(sys, "argv", ["fgreg", *(str(word) for word in words)])
    with pytest.raises(SystemExit) as exit_:
        main()
    code = exit_.value.code
    assert isinstance(code, int)
    return code


def test_solve_writes_a_result_and_reports_it(
    pose_session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(monkeypatch, "solve", pose_session) == 0
    out = capsys.readouterr().out
    for word in (
        "Registration trus_T_camera",
        "Laser line",
        "predicted TRE",
        "Pairs: 20 of 20",
        "Tracks",
        "result.yaml",
    ):
        assert word in out
    result = read_result(pose_session / "result.yaml")
    assert len(result.pairs) == 20
    assert len(result.tracks) == 4
    assert result.epochs[0].trus_T_camera is not None
    files = {name: (pose_session / name).read_bytes() for name in ("session.yaml", "events.jsonl")}
    assert result.inputs == {name: sha256(content).hexdigest() for name, content in files.items()}


def test_json_is_one_document_with_the_results_names(
    pose_session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(monkeypatch, "solve", pose_session, "--json", "--out", pose_session.parent / "r.yaml") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["verdict"] in ("ok", "warning")
    assert np.array(document["epochs"][0]["trus_T_camera"]).shape == (4, 4)
    assert not (pose_session / "result.yaml").exists()
    assert (pose_session.parent / "r.yaml").exists()


def test_a_refused_session_exits_with_1_and_still_writes_its_result(
    pose_session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = (pose_session / "events.jsonl").read_text().splitlines(keepends=True)
    kept = [line for line in lines if '"type": "pair"' not in line]
    pairs = [line for line in lines if '"type": "pair"' in line][:4]
    (pose_session / "events.jsonl").write_text("".join(sorted(kept + pairs, key=lambda v: json.loads(v)["t"])))
    assert _run(monkeypatch, "solve", pose_session) == 1
    assert "REFUSED" in capsys.readouterr().out
    assert read_result(pose_session / "result.yaml").verdict.value == "refused"


def test_bad_input_is_one_line_and_leaves_the_older_result(
    pose_session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(monkeypatch, "solve", pose_session, "-q") == 0
    older = (pose_session / "result.yaml").read_bytes()
    text = (pose_session / "session.yaml").read_text()
    (pose_session / "session.yaml").write_text(text.replace("radius_mm", "radius_cm"))
    assert _run(monkeypatch, "solve", pose_session) == 2
    error = capsys.readouterr().err
    assert error.startswith("fgreg: error: session.yaml: probe")
    assert error.count("\n") == 1
    assert (pose_session / "result.yaml").read_bytes() == older


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (("--rrd", "nowhere/a.rrd"), "--rrd: nowhere: found no such folder"),
        (("--rrd", "S/events.jsonl"), "--rrd: S/events.jsonl: found the name of a session's own file"),
        (("--rrd", "S/result.yaml"), "--rrd: found S/result.yaml, where the result goes"),
        (("--out", "S/frames"), "S/frames: found a folder"),
        ((), ""),
    ],
)
def test_an_older_result_stays_until_there_is_a_new_one(
    words: tuple[str, ...],
    found: str,
    pose_session: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    older = "format: fgreg-result/1\n"
    (pose_session / "result.yaml").write_text(older)
    (pose_session / "frames").mkdir()
    (tmp_path / "S").symlink_to(pose_session)
    monkeypatch.chdir(tmp_path)
    for command in ("solve", "replay"):
        monkeypatch.setattr(f"fgreg.pipeline.{command}.extract_measurements", interrupt)
        assert _run(monkeypatch, command, "S", *words, "-q") == (2 if words else 130)
        assert found in capsys.readouterr().err
        assert (pose_session / "result.yaml").read_text() == older
    assert sorted(path.name for path in pose_session.iterdir()) == [
        *("events.jsonl", "frames", "ground_truth.yaml", "result.yaml", "session.yaml"),
    ]


def test_check_reports_all_problems_at_once(
    pose_session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(monkeypatch, "check", pose_session) == 0
    assert "no problems" in capsys.readouterr().out
    text = (pose_session / "session.yaml").read_text()
    (pose_session / "session.yaml").write_text(text.replace("radius_mm", "radius_cm").replace("pitch_mm", "pitch"))
    with (pose_session / "events.jsonl").open("a") as file:
        file.write('{"type": "nonsense", "t": 1e6}\n')
    assert _run(monkeypatch, "check", pose_session) == 2
    lines = capsys.readouterr().err.splitlines()
    assert all(line.startswith("fgreg: error: ") for line in lines)
    assert any("radius_cm" in line for line in lines)
    assert any("pitch" in line for line in lines)
    assert any("events.jsonl: line" in line for line in lines)
    assert _run(monkeypatch, "check", pose_session, "--json") == 2
    assert len(json.loads(capsys.readouterr().out)["problems"]) == len(lines)


@pytest.mark.parametrize(
    "words",
    [
        ("solve",),
        ("solve", "/nowhere/at/all"),
        ("solve", "x", "--bogus"),
        ("solve", "x", "--limit-mm", "abc"),
        ("simulate", "x", "--preset", "nonsense"),
        ("simulate",),
        ("simulate", "x", "--seed", "-1"),
        ("bogus",),
        ("check", "/nowhere/at/all"),
    ],
)
def test_wrong_words_are_one_line_and_exit_status_2(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert _run(monkeypatch, *words) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("fgreg: error: ")
    assert captured.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_help_usage_and_completion_are_those_of_a_command_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(monkeypatch, "evaluate", "-h") == 0
    assert capsys.readouterr().out.startswith("Usage: fgreg evaluate [OPTIONS] {SESSION}...\n")
    assert _run(monkeypatch, "solve", "--limt", "3") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("fgreg: error: No such option: --limt")
    assert line.endswith("(usage: fgreg solve [OPTIONS] {SESSION}; help: fgreg solve -h)")
    for name, value in {
        "_FGREG_COMPLETE": "complete_bash",
        "COMP_WORDS": "fgreg solve --lim",
        "COMP_CWORD": "2",
    }.items():
        monkeypatch.setenv(name, value)
    assert _run(monkeypatch) == 0
    assert capsys.readouterr().out.strip() == "--limit-mm"


@pytest.mark.parametrize("limit", ["0", "-1", "nan", "inf"])
def test_a_limit_has_to_be_a_length(
    limit: str, pose_session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(monkeypatch, "solve", pose_session, "--limit-mm", limit) == 2
    assert "--limit-mm" in capsys.readouterr().err


def test_simulated_sessions_are_the_same_for_the_same_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b"):
        assert _run(monkeypatch, "simulate", tmp_path / name, "--preset", "paper", "--seed", "5", "-q") == 0
    assert _run(monkeypatch, "simulate", tmp_path / "c", "--preset", "paper", "--seed", "6", "-q") == 0
    for file in ("session.yaml", "events.jsonl", "ground_truth.yaml"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    assert (tmp_path / "a" / "events.jsonl").read_bytes() != (tmp_path / "c" / "events.jsonl").read_bytes()


def test_simulate_does_not_write_over_anything_unasked(
    pose_session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (pose_session / "events.jsonl").read_bytes()
    assert _run(monkeypatch, "simulate", pose_session, "--preset", "paper") == 2
    assert "--overwrite" in capsys.readouterr().err
    assert (pose_session / "events.jsonl").read_bytes() == before


def test_presets_are_listed_and_the_version_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(monkeypatch, "simulate", "--list") == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(PRESETS)
    assert _run(monkeypatch, "--version") == 0
    assert __version__ in capsys.readouterr().out
