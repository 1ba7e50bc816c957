"""``fgreg evaluate`` and ``fgreg advise`` as commands: output, files, exit status."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import re
import secrets
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from fgreg.cli import main
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["fgreg", *arguments])
    with pytest.raises(SystemExit) as end:
        main.main()
    code = end.value.code
    assert isinstance(code, int)
    return code


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sessions") / "eight"
    write_session(simulate(replace(PRESETS["first-hit"], name="eight", pairs=8), 2), folder)
    return folder


FAST = ("--subsets", "1", "--sizes", "6", "--folds", "2", "--no-leave-one-out", "--jobs", "1")


def test_tables_files_and_plots(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    table, plots = tmp_path / "all.csv", tmp_path / "plots"
    code = run(monkeypatch, "evaluate", str(session), *FAST, "--csv", str(table), "--plots", str(plots))
    assert code in (0, 1)
    text = capsys.readouterr().out
    for heading in ("Against the truth", "PMs held out", "number of pairs", "left out", "not a"):
        assert heading in text
    assert max(map(len, text.splitlines())) <= 80 or str(tmp_path) in text
    rows = list(csv.DictReader(table.read_text().splitlines()))
    quantities = {row["quantity"] for row in rows}
    assert {"tre_mean_mm", "pair_residual_mm", "nis", "moved_mm", "beam_angle_deg"} <= quantities
    assert all(float(row["value"]) is not None for row in rows)
    written = sorted(path.name for path in plots.iterdir())
    names = ["error-against-pairs", "held-out-pairs", "influence", "predicted-against-true", "tre"]
    assert written == [f"{name}.png" for name in names]
    assert all(path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 5000 for path in plots.iterdir())


def test_json_is_one_document(
    session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code = run(monkeypatch, "evaluate", str(session), *FAST, "--json")
    document = json.loads(capsys.readouterr().out)
    (found,) = document["sessions"]
    assert found["session"] == "eight"
    assert (code == 1) == (found["verdict"] == "refused")
    assert len(found["influence"]) == 8
    assert len(found["track_error_deg"]) == 4
    assert found["curve"][0]["pairs"] == 6


def test_svg_plots(session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(monkeypatch, "evaluate", str(session), *FAST, "-q", "--plots", str(tmp_path), "--plot-format", "svg")
    assert (tmp_path / "tre.svg").read_text().startswith("<?xml")


def test_sessions_of_one_name_are_distinguished(
    session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    few = ("--subsets", "0", "--folds", "0", "--no-leave-one-out", "--jobs", "1", "--json")
    run(monkeypatch, "evaluate", str(session), str(session.parent / "." / "eight"), *few)
    document = json.loads(capsys.readouterr().out)
    assert [found["session"] for found in document["sessions"]] == [str(session)] * 2
    assert document["together"]["tre_mm"]["count"] == 54


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--folds", "1"), "--folds"),
        (("--jobs", "0"), "--jobs"),
        (("--sizes", "4,x"), "--sizes"),
        (("--sizes", "2"), "--sizes"),
        (("--plot-format", "gif"), "--plot-format"),
    ],
)
def test_bad_options_are_one_line(
    arguments: tuple[str, ...],
    said: str,
    session: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(monkeypatch, "evaluate", str(session), *arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"fgreg: error: {said}")
    assert error.count("\n") == 1


def test_missing_session_and_unwritable_file(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "evaluate", str(tmp_path / "none")) == 2
    assert run(monkeypatch, "evaluate", str(session), *FAST, "--csv", str(tmp_path / "no" / "file.csv")) == 2
    assert "--csv" in capsys.readouterr().err


def test_a_missing_matplotlib_names_the_extra(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert run(monkeypatch, "evaluate", str(session), "--plots", str(tmp_path / "p")) == 2
    assert "fgreg[plots]" in capsys.readouterr().err


def test_advice_as_table_and_json(
    session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "advise", str(session), "--count", "3") == 0
    text = capsys.readouterr().out
    assert "Where the next shot helps most: eight" in text
    assert "beam leans" in text
    assert "two looks at each spot" in " ".join(text.split())
    assert len(re.findall(r"\d\.\d up\b", text)) == len(re.findall(r"\d\.\d down\b", text)) == 3
    assert run(monkeypatch, "advise", str(session), "--json", "-n", "2") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["pairs"] == 8
    # One figure under one name: the predicted TRE of the solve, of the advice, and with each pair.
    assert run(monkeypatch, "evaluate", str(session), "--json", "--folds", "0", "--subsets", "1", "-j", "1") == 0
    (found,) = json.loads(capsys.readouterr().out)["sessions"]
    mean = found["epochs"][0]["predicted_tre_mm"]["mean"]
    assert {document["expected_tre_mm"], *(i["expected_tre_mm"] for i in found["influence"])} == {mean}
    assert len(document["shots"]) == 2
    assert document["shots"][0]["expected_tre_mm"] < document["expected_tre_mm"]
    assert [look["sweep"] for look in document["shots"][0]["looks"]] == [1, -1]
    assert run(monkeypatch, "advise", str(session), "--json", "--one-look") == 0
    single = json.loads(capsys.readouterr().out)["shots"]
    assert all(len(shot["looks"]) == 1 for shot in single)
    assert document["shots"][0]["expected_tre_mm"] < single[0]["expected_tre_mm"]


def test_no_advice_without_a_registration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_session(simulate(replace(PRESETS["first-hit"], pairs=2), 1), tmp_path / "two")
    assert run(monkeypatch, "advise", str(tmp_path / "two")) == 1
    assert "no advice" in capsys.readouterr().err


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="processes are found by Linux's /proc")
def test_a_killed_evaluation_leaves_no_worker_process(pose_session: Path) -> None:
    mark = f"FGREG_TEST={secrets.token_hex(8)}"

    def marked() -> list[int]:
        found = []
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                if entry.name.isdigit() and mark.encode() in (entry / "environ").read_bytes():
                    state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
                    found += [int(entry.name)] if state != "Z" else []
        return found

    name, _, value = mark.partition("=")
    words = [sys.executable, "-m", "fgreg", "evaluate", str(pose_session), "--jobs", "2", "-q"]
    with subprocess.Popen(words, env={**os.environ, name: value}, stderr=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 60.0
        while len(marked()) < 3 and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        process.kill()
    deadline = time.monotonic() + 20.0
    while marked() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not marked()
