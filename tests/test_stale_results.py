"""A result names what it was made from, so that one of other events, frames or constants is not taken for today's."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from fgreg.cli.main import main
from fgreg.convert.export import WRITERS
from fgreg.model.estimate import RESULT
from fgreg.session.input_hashes import changed_inputs, read_with_hashes
from fgreg.session.result_file import read_result, write_result
from tests import session_files


def command(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    monkeypatch.setattr(sys, "argv", ["fgreg", *map(str, words)])
    with pytest.raises(SystemExit) as exit_:
        main()
    assert isinstance(exit_.value.code, int)
    return exit_.value.code


@pytest.fixture
def solved(tmp_path: Path) -> Path:
    """A session with frames and a result of it as it is."""
    folder = session_files.write(tmp_path / "s")
    session_files.write_frames(folder)
    session, inputs = read_with_hashes(folder)
    write_result(
        replace(RESULT.read(session_files.result()), inputs=inputs), session.model, folder / "result.yaml", "1"
    )
    return folder


def test_inputs_are_the_hashes_of_the_files_and_of_the_frames_in_order(solved: Path) -> None:
    def sha(data: bytes) -> str:
        return hashlib.sha256(data).hexdigest()

    _, inputs = read_with_hashes(solved)
    assert {
        name: sha((solved / name).read_bytes()) for name in ("session.yaml", "events.jsonl")
    }.items() <= inputs.items()
    frames = {name: sha((solved / "frames" / name).read_bytes()) for name in ("a.png", "b.png", "c.npy")}
    named = [name for line in (solved / "events.jsonl").read_text().splitlines() for name in _frames_in(line)]
    assert len(named) > 3
    assert inputs["frames"] == sha("".join(frames[name] for name in named).encode())
    assert read_result(solved / "result.yaml").inputs == inputs
    (solved / "frames" / "a.png").unlink()  # recorded poses need no frames
    assert changed_inputs(solved, inputs) == ["frames"]
    assert len(read_with_hashes(solved)[1]) == 3


def _frames_in(line: str) -> list[str]:
    """Names of the frames in a line, in the order of its text."""
    return [part.split('"')[0] for part in line.split("frames/")[1:]]


def _append(path: Path, data: bytes) -> None:
    path.write_bytes(path.read_bytes() + data)


CHANGES: list[tuple[str, Callable[[Path], object]]] = [
    ("session.yaml", lambda s: _append(s / "session.yaml", b"# touched\n")),
    ("session.yaml", lambda s: (s / "session.yaml").write_text("format: none")),
    ("events.jsonl", lambda s: _append(s / "events.jsonl", b'{"type": "note", "t": 1e6, "text": "later"}\n')),
    ("frames", lambda s: _append(s / "frames" / "c.npy", b"\0")),
]


@pytest.mark.parametrize(("name", "change"), CHANGES)
def test_a_stale_result_is_told_by_check_and_refused_unless_forced(
    name: str,
    change: Callable[[Path], object],
    solved: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = solved.parent / "out"
    assert command(monkeypatch, "convert", solved, out.with_suffix(".json")) == 0
    assert command(monkeypatch, "check", solved) == 0
    assert "a stale result" not in (found := capsys.readouterr()).out + found.err
    change(solved)
    told = f"a stale result: {name} changed since it was made"
    command(monkeypatch, "check", solved)
    assert told in capsys.readouterr().err
    assert command(monkeypatch, "evaluate", solved) == 2
    assert told in capsys.readouterr().err
    for suffix in WRITERS if name == "frames" else [".json"]:
        path = out.with_suffix(suffix)
        assert command(monkeypatch, "convert", solved, path, "--overwrite") == 2
        assert told in capsys.readouterr().err
        assert path.exists() == (suffix == ".json")
        assert command(monkeypatch, "convert", solved, path, "--overwrite", "--force") == 0
        assert "STALE and marked as such" in capsys.readouterr().out
        assert told in path.read_text()
        assert command(monkeypatch, "convert", solved, path, "--overwrite", "--force") == 0  # its own older file


def test_whether_a_result_without_inputs_is_stale_cannot_be_told(
    solved: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = solved / "result.yaml"
    write_result(replace(read_result(path), inputs={}), read_with_hashes(solved)[0].model, path, "0.2")
    assert "inputs" not in path.read_text()
    assert command(monkeypatch, "check", solved) == 0
    assert "inputs: found none" in capsys.readouterr().err
    assert command(monkeypatch, "convert", solved, solved.parent / "r.xml") == 0
    assert "cannot be told" in capsys.readouterr().err
