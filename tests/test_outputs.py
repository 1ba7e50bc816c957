"""Outputs replace only their older selves, in one step; what an interrupted run leaves is found and can be restored."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from fgreg.cli.main import main
from fgreg.errors import InputError
from fgreg.output import session_folder
from fgreg.output.atomic_file import FileKind, NewFile, check_outputs, write_file
from fgreg.output.leftovers import leftovers
from fgreg.output.session_folder import check_folder, new_session
from fgreg.session.journal import Journal
from fgreg.session.session_reader import read_session
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session
from tests import session_files

NOTE = FileKind("a note", (b"note: ",))
FOREIGN = {
    **{"notes.txt": b"precious", "frames/unnamed.png": b"raw", "deep/er/scan.dcm": b"DICM"},
    "deep/own.npy": b"by its other name",
}


def contents(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def command(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    monkeypatch.setattr(sys, "argv", ["fgreg", *map(str, words)])
    with pytest.raises(SystemExit) as exit_:
        main()
    assert isinstance(exit_.value.code, int)
    return exit_.value.code


@pytest.fixture
def older(tmp_path: Path) -> Path:
    """A session with frames, an older result, and files that are not its own."""
    folder = session_files.write(tmp_path / "s")
    session_files.write_frames(folder)
    (folder / "result.yaml").write_text("format: fgreg-result/1\n")
    for name, content in FOREIGN.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    (folder / "link").symlink_to("deep")
    (folder / "deep" / "own.npy").write_bytes(b"by its other name")
    with (folder / "events.jsonl").open("a") as file:
        file.write(
            '{"type": "note", "t": 1e6, "text": "n", "x_": {"frame": "link/own.npy", "left": "../outside.png"}}\n'
        )
    (tmp_path / "outside.png").write_bytes(b"kept")
    return folder


def overwrite(folder: Path) -> None:
    write_session(simulate(replace(PRESETS["paper"], pairs=3), 1), folder, overwrite=True)


def test_files_are_told_by_their_content(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_file(path, "note: 1", NOTE)
    write_file(path, "note: 2", NOTE)
    path.with_name("b.txt").write_text("mine")
    with pytest.raises(InputError, match="a file that is not a note"):
        write_file(path.with_name("b.txt"), "note: 3", NOTE)
    with pytest.raises(InputError, match=r"--b: found .*where --a goes"):
        check_outputs([("--a", path, NOTE), ("--b", tmp_path / "." / "a.txt", NOTE)])
    assert contents(tmp_path) == {"a.txt": b"note: 2", "b.txt": b"mine"}


def test_evaluate_refuses_what_is_not_its_own_before_it_works(
    older: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(older.parent)
    monkeypatch.setattr("fgreg.cli.evaluate.read_case", lambda *_: pytest.fail("it has begun"))
    for option, name, found in (
        ("--csv", "events.jsonl", "the name of a session's own file"),
        ("--csv", "notes.txt", "not a table of fgreg evaluate"),
        ("--csv", "nowhere/a.csv", "no such folder"),
        ("--plots", "notes.txt", "where no file can be made"),
    ):
        assert command(monkeypatch, "evaluate", older, option, older / name) == 2
        assert found in capsys.readouterr().err
    (older / "tre.png").write_bytes(b"\x89PNG\r\n\x1a\n of another program")
    assert command(monkeypatch, "evaluate", older, "--plots", older) == 2
    assert "not a plot of fgreg" in capsys.readouterr().err
    (older / "tre.png").unlink()
    assert contents(older.parent) == before


@pytest.mark.parametrize("exchange", [True, False])
def test_overwriting_replaces_the_sessions_own_files_and_no_others(
    exchange: bool, older: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not exchange:
        monkeypatch.setattr(session_folder, "_exchange", lambda *_: False)
    overwrite(older)
    found = contents(older)
    assert {name: found[name] for name in FOREIGN} == FOREIGN
    assert set(found) - set(FOREIGN) == {"session.yaml", "events.jsonl", "ground_truth.yaml"}
    assert (older / "link").readlink() == Path("deep")
    assert read_session(older).model.name == "paper"
    assert sorted(path.name for path in older.parent.iterdir()) == ["outside.png", "s"]


def test_a_file_that_is_not_the_sessions_is_not_replaced_by_a_new_one(older: Path) -> None:
    (older / "ground_truth.yaml").unlink(missing_ok=True)
    (older / "ground_truth.yaml").mkdir()
    (older / "ground_truth.yaml" / "mine").write_text("kept")
    before = contents(older)
    with pytest.raises(InputError, match=r"ground_truth\.yaml/mine: found a file that the older session does not name"):
        overwrite(older)
    assert contents(older) == before


def test_a_pipe_in_the_place_of_events_is_refused_and_not_waited_for(older: Path) -> None:
    (older / "events.jsonl").unlink()
    os.mkfifo(older / "events.jsonl")
    with pytest.raises(InputError, match=r"events\.jsonl: found a file that the older session does not name"):
        overwrite(older)


@pytest.mark.parametrize("words", [("simulate",), ("convert", "SHOTS", "--setup")])
def test_a_session_that_is_recorded_is_never_replaced(
    words: tuple[str, ...], older: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shots = older.parent / "shots.csv"
    shots.write_text("t,type\n")
    (older / "events.jsonl").write_text("")
    out = [older] if words[0] == "simulate" else [older / "session.yaml", older]
    with Journal.open(older):
        before = contents(older)
        assert command(monkeypatch, *(shots if w == "SHOTS" else w for w in words), *out, "--overwrite") == 2
        assert "that another program is recording" in capsys.readouterr().err
        assert contents(older) == before
    with new_session(older, overwrite=True), pytest.raises(Exception, match="another program is recording"):
        Journal.open(older)


def test_an_empty_folder_stays_the_same_folder(tmp_path: Path) -> None:
    (tmp_path / "s").mkdir()
    before = (tmp_path / "s").stat().st_ino
    write_session(simulate(PRESETS["paper"], 1), tmp_path / "s")
    assert (tmp_path / "s").stat().st_ino == before
    assert len(contents(tmp_path)) == 3
    for place, found in ((tmp_path / "s", "not empty"), (tmp_path / "s" / "session.yaml" / "x", "cannot be written")):
        with pytest.raises(InputError, match=found):
            check_folder(place)


def killed(script: str, *words: object) -> None:
    """Run a script that ends itself by SIGKILL."""
    run = [sys.executable, "-c", "import os, sys\nfrom pathlib import Path\n" + script, *map(str, words)]
    assert subprocess.run(run, check=False).returncode == -signal.SIGKILL


KILLS: list[tuple[str, Callable[[Path], Path]]] = [
    # Between the two renames of a system that cannot exchange names: nothing is at the place.
    (
        "from fgreg.output import session_folder as s\n"
        "real = Path.rename\n"
        "s._exchange = lambda *_: False\n"
        "Path.rename = lambda a, b: (real(a, b), os.kill(os.getpid(), 9) if b.name.endswith('.older') else None)[0]\n",
        lambda folder: next(folder.parent.glob(".s.*.older")),
    ),
    # After the exchange, before the foreign files have gone over.
    (
        "from fgreg.output import session_folder as s\n"
        "real = s._exchange\n"
        "s._exchange = lambda a, b: real(a, b) and os.kill(os.getpid(), 9)\n",
        lambda folder: next(folder.parent.glob(".s.*.swap")),
    ),
]


@pytest.mark.parametrize(("script", "left"), KILLS, ids=["renames", "exchange"])
def test_a_kill_while_a_session_is_replaced_loses_nothing_and_says_how_to_restore_it(
    script: str,
    left: Callable[[Path], Path],
    older: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = contents(older)
    new = (
        "with s.new_session(Path(sys.argv[1]), overwrite=True) as part:\n    (part / 'session.yaml').write_text('x')\n"
    )
    killed(script + new, older)
    kept = left(older)
    assert contents(kept) == before
    assert command(monkeypatch, "solve", older) == 2
    assert str(kept) in (told := capsys.readouterr().err)
    move = next(text for text in leftovers(older) if str(kept) in text).split("restore it")[1].split("mv ")[1]
    assert "(with deep/er/scan.dcm, which is not the session's, and others: keep that)" in told
    if older.exists():
        older.rename(older.with_name("aside"))
    subprocess.run(["mv", *shlex.split(move.split(";")[0])], check=True)
    assert contents(older) == before


def test_what_is_not_complete_is_named_and_what_is_being_written_is_not(
    older: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = older / "r.txt"
    new = NewFile(path, NOTE)
    assert leftovers(path) == leftovers(older) == []
    new.drop()
    killed(
        "from fgreg.output.atomic_file import FileKind, NewFile\n"
        "NewFile(Path(sys.argv[1]), FileKind('a note', (b'note',))); os.kill(os.getpid(), 9)",
        path,
    )
    (told,) = leftovers(path)
    assert "did not complete r.txt; delete it" in told
    assert command(monkeypatch, "check", older, "--json") == 0
    assert told in json.loads(capsys.readouterr().out)["warnings"]
    next(older.glob(".r.txt.*.part")).unlink()
    assert leftovers(older) == []
