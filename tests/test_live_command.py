"""``fgreg live`` with the simulated room, in real time: it ends cleanly also on a busy machine."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from fgreg.cli import main
from fgreg.model.events import StageEvent
from fgreg.session.session_reader import read_session

PATIENCE_S = 120.0


def start(folder: Path, *words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", "import sys; from fgreg.cli.main import main; sys.exit(main())", "live"]
    return subprocess.Popen(
        [*command, "--out", os.fspath(folder), "--no-viewer", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


def wait_for(folder: Path, text: str, process: subprocess.Popen[str]) -> str:
    """Until the session's events hold a text; the events then. A busy machine may take its time."""
    end = time.monotonic() + PATIENCE_S
    path = folder / "events.jsonl"
    while time.monotonic() < end and process.poll() is None:
        if path.is_file() and text in (found := path.read_text()):
            return found
        time.sleep(0.2)
    process.kill()
    out, err = process.communicate()
    raise AssertionError(f"{text!r} did not come within {PATIENCE_S} s: {out[-2000:]} {err[-2000:]}")


def children(process: subprocess.Popen[str], words: str) -> list[int]:
    """Processes that it started whose command line or name has these words."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rsplit(")", 1)[1].split()[1])
            shown = (folder / "cmdline").read_text() + (folder / "comm").read_text()
            if parent == process.pid and words in shown:
                found.append(int(folder.name))
        except (OSError, ValueError):
            continue
    return found


def descendants(process: subprocess.Popen[str]) -> set[int]:
    """Processes that it started, and those that they did."""
    parents: dict[int, int] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, ValueError):
            parents[int(folder.name)] = int((folder / "stat").read_text().rsplit(")", 1)[1].split()[1])
    found, more = set[int](), {process.pid}
    while more := {pid for pid, parent in parents.items() if parent in more}:
        found |= more
    return found


def wait_for_word(process: subprocess.Popen[str], text: str) -> None:
    """Until it has printed a text."""
    if process.stdout is None:
        raise AssertionError("no pipe")
    patience = threading.Timer(PATIENCE_S, process.kill)
    patience.start()
    try:
        if not any(text in line for line in process.stdout):
            raise AssertionError(f"it ended, or {PATIENCE_S} s went by, before it printed {text!r}")
    finally:
        patience.cancel()


@pytest.mark.parametrize("phase", ["starting the registration", "opening the devices", "aim at corner", "ending"])
def test_ctrl_c_in_any_phase_leaves_a_session_and_no_process(tmp_path: Path, phase: str) -> None:
    folder = tmp_path / "session"
    process = start(folder, "--aims", "3", "--bump-every", "inf", "--certify")
    if phase == "ending":  # it is interrupted twice: the second time while all of it is solved, or just before
        wait_for(folder, '"aim"', process)
        process.send_signal(signal.SIGINT)
    wait_for_word(process, phase)
    if phase == "aim at corner":
        wait_for(folder, "request home", process)
    mine = descendants(process)
    assert mine
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode in ((0, 1, 130) if phase != "aim at corner" else (0, 1)), err
    assert "Traceback" not in err
    end = time.monotonic() + PATIENCE_S
    while (left := {pid for pid in mine if Path(f"/proc/{pid}").exists()}) and time.monotonic() < end:
        time.sleep(0.2)
    assert not left
    if phase != "starting the registration":  # else there may be no event yet
        session = read_session(folder)
        assert not session.warnings
        assert (folder / "result.yaml").is_file() or process.returncode == 130
    if phase == "aim at corner":
        assert "from frame to angle" in out
        orders = [json.loads(line) for line in (folder / "stage-orders.log").read_text().splitlines()]
        assert orders[-1]["command"] == "stop"
        commands = {event.command.split()[0] for event in session.events if isinstance(event, StageEvent)}
        assert {"request", "home"} <= commands <= {"request", "home", "search", "track", "stop", "emergency", "reset"}


def test_a_room_that_is_gone_is_said_and_the_session_survives(tmp_path: Path) -> None:
    folder = tmp_path / "session"
    process = start(folder, "--width", "320", "--aims", "0", "--bump-every", "inf")
    wait_for(folder, "request home", process)
    (room,) = children(process, "fgreg-room")
    os.kill(room, signal.SIGKILL)
    wait_for(folder, "camera lost", process)
    wait_for(folder, "stage", process)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60.0)
    assert process.returncode in (0, 1), err
    read_session(folder)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--duration", "-1"), "--duration"),
        (("--aims", "-2"), "--aims"),
        (("--bump-every", "0"), "--bump-every"),
        (("--bump-every", "0.5"), "--bump-every"),
        (("--limit-mm", "0"), "--limit-mm"),
        (("--seed", "-1"), "--seed"),
        (("--seed", "99999999999"), "--seed"),
        (("--width", "10"), "--width"),
        (("room.yaml", "--seed", "1"), "--seed"),
        (("room.yaml", "--limit-mm", "1"), "--limit-mm"),
        (("room.yaml", "--width", "640"), "--width"),
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
        main.main()
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
        main.main()
    assert end.value.code == 2
    assert "a folder that is not empty" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]
