"""``fgreg live`` with the simulated room, in real time: whatever the machine is busy with, it ends cleanly."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fgreg import cli
from fgreg.events import AimEvent, StageEvent
from fgreg.session.reading import read_session

PATIENCE_S = 120.0


def start(folder: Path, *words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", "import sys; from fgreg.cli import main; sys.exit(main())", "live"]
    return subprocess.Popen(
        [*command, "--out", os.fspath(folder), "--no-viewer", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


def wait_for_aims(folder: Path, count: int, process: subprocess.Popen[str]) -> None:
    end = time.monotonic() + PATIENCE_S
    path = folder / "events.jsonl"
    while time.monotonic() < end and process.poll() is None:
        if path.is_file() and path.read_text().count('"type": "aim"') + path.read_text().count('"type":"aim"') >= count:
            return
        time.sleep(0.2)
    process.kill()
    out, err = process.communicate()
    raise AssertionError(f"no {count} aims within {PATIENCE_S} s: {out[-2000:]} {err[-2000:]}")


def test_ctrl_c_ends_it_with_the_session_complete(tmp_path: Path) -> None:
    folder = tmp_path / "session"
    process = start(folder, "--aims", "3", "--bump-every", "inf")
    wait_for_aims(folder, 2, process)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60.0)
    assert process.returncode in (0, 1), err
    assert "Traceback" not in err
    session = read_session(folder)
    assert not session.warnings
    assert sum(isinstance(event, AimEvent) for event in session.events) >= 2
    assert (folder / "result.yaml").is_file()
    assert "from frame to angle" in out
    orders = [json.loads(line) for line in (folder / "stage-orders.log").read_text().splitlines()]
    assert orders[-1]["command"] == "stop"
    told = {event.command.split()[0] for event in session.events if isinstance(event, StageEvent)}
    assert told <= {"request", "home", "search", "track", "stop", "emergency", "reset"}


def test_a_killed_room_is_said_and_the_session_survives(tmp_path: Path) -> None:
    folder = tmp_path / "session"
    process = start(folder, "--aims", "2", "--bump-every", "inf")
    wait_for_aims(folder, 1, process)
    children = subprocess.run(["pgrep", "-P", str(process.pid), "-f", "simulated_room"], capture_output=True, text=True)
    for child in children.stdout.split():
        os.kill(int(child), signal.SIGKILL)
    end = time.monotonic() + 30.0
    path = folder / "events.jsonl"
    while "lost" not in path.read_text() and time.monotonic() < end:
        time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60.0)
    assert process.returncode in (0, 1), err
    text = path.read_text()
    assert "camera lost" in text
    assert "stage lost" in text or "stage stopped" in text
    read_session(folder)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--duration", "-1"), "--duration"),
        (("--aims", "-2"), "--aims"),
        (("--bump-every", "0"), "--bump-every"),
        (("--limit-mm", "0"), "--limit-mm"),
    ],
)
def test_mistakes_are_one_line_and_make_no_session(
    words: tuple[str, ...],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "session"
    monkeypatch.setattr(sys, "argv", ["fgreg", "live", "--no-viewer", "--out", os.fspath(folder), *words])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("fgreg: error: ")
    assert error.count("\n") == 1
    assert message in error
    assert not folder.exists()


def test_a_folder_with_something_else_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "letter.txt").write_text("dear")
    monkeypatch.setattr(sys, "argv", ["fgreg", "live", "--no-viewer", "--out", os.fspath(tmp_path), "--duration", "1"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    assert "a folder that is not empty" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]
