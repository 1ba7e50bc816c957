"""The page of ``fgreg live`` on a real terminal (tmux): nothing on it is overwritten, and what is typed arrives."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from fgreg.drivers.line_editor import LineEditor

SESSION = """
import time
from fgreg.cli.live_display import LiveDisplay
from fgreg.drivers.base import CommandKind
from fgreg.drivers.keyboard import KeyboardOperator
from fgreg.drivers.operator_words import asked
from fgreg.live.actions import RegistrationState, StageView
from fgreg.live.recorder import RecorderState
from fgreg.live.status import Figures, Status
from fgreg.simulation.config import default_stage

display = LiveDisplay()
display.say("starting")
with display:
    operator = KeyboardOperator(display.say, typing=display.typing)
    display.say("recording to FOLDER", lasting=True)
    task = asked("the stage has to turn in search of PMs", CommandKind.SEARCH)
    operator.tell("the stage has to turn in search of PMs", wants=CommandKind.SEARCH)
    now, end = 0.0, time.monotonic() + 60.0
    heard = ""
    while heard != "stop" and time.monotonic() < end:
        for command in operator.poll():
            heard = command.kind.value
            operator.tell(f"{heard} is obeyed")
        now += 0.3
        plane, state = StageView(0.1, False, True, now), RecorderState(RegistrationState())
        said = heard and f"{heard} from keyboard"
        shown = Status(now, now, "registering", task, task, state, None, plane, "", (), None, None, heard=said)
        display.show(Figures(frames=int(now)), default_stage(), shown)
        print("a library prints this") if int(now) == 2 else None
        time.sleep(0.02)
    operator.close()
print("over")
"""


class Terminal:
    """A tmux session with one window of 80 x 30."""

    def __init__(self, socket: str, command: str) -> None:
        self._tmux = ["tmux", "-L", socket, "-f", os.devnull]
        self.run("new-session", "-d", "-x", "80", "-y", "30", "sh")
        self.run("set-option", "-g", "remain-on-exit", "on")
        self.type(command)
        self.key("Enter")

    def run(self, *words: str) -> str:
        return subprocess.run([*self._tmux, *words], check=True, capture_output=True, text=True, timeout=10).stdout

    def type(self, text: str) -> None:
        self.run("send-keys", "-l", text)

    def key(self, name: str) -> None:
        self.run("send-keys", name)

    def wait(self, *texts: str) -> str:
        """Until the screen has all these texts, however wide its columns are; the screen then."""
        end = time.monotonic() + 30.0
        while not all(text in " ".join((screen := self.run("capture-pane", "-p")).split()) for text in texts):
            assert time.monotonic() < end, screen
            time.sleep(0.05)
        return screen

    def close(self) -> None:
        self.run("kill-server")


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[Terminal]:
    if shutil.which("tmux") is None:
        pytest.skip("tmux is not installed")
    script = tmp_path / "session.py"
    script.write_text(SESSION)
    command = f"PYTHONPATH={Path(__file__).parents[1]} TERM=screen clear; {sys.executable} {script}"
    opened = Terminal(f"fgreg-{os.getpid()}", f"export PYTHONPATH={Path(__file__).parents[1]}; {command}")
    try:
        yield opened
    finally:
        opened.close()


def test_the_page_shows_prompt_answers_keys_and_the_typed_word_and_nothing_is_overwritten(terminal: Terminal) -> None:
    terminal.wait("next the stage has to turn in search of PMs: say search (s)", "your word _")
    terminal.type("serch")
    terminal.wait("your word serch_")
    terminal.key("Enter")
    terminal.wait("'serch' is not understood", "your word _")
    terminal.type("seax")
    terminal.key("BSpace")
    terminal.key("Left")
    terminal.type("rch")
    terminal.key("Enter")
    screen = terminal.wait("search is obeyed", "heard search from keyboard", "recording to FOLDER")
    lines = screen.splitlines()
    (first,) = [
        i for i, line in enumerate(lines) if "fgreg live" in line and "─" in line
    ]  # one page, not parts of many
    (last,) = [i for i, line in enumerate(lines) if "Ctrl-C ends the session" in line]
    assert all(line.startswith("│") and line.rstrip().endswith("│") for line in lines[first + 1 : last]), screen
    assert lines[last].startswith("╰")
    assert sum("'serch' is not understood" in line for line in lines) == 1
    assert sum("say search (s)" in line for line in lines) == 2  # what is next, and when it was said
    assert "stop (x, or an empty line)" in " ".join(screen.replace("│", " ").split())
    terminal.key("Enter")  # an empty line is a stop
    terminal.wait("over")
    terminal.type("echo shown by the terminal again")
    screen = terminal.wait("echo shown by the terminal again")
    assert "fgreg live" not in screen
    assert "recording to FOLDER" in screen


@pytest.mark.parametrize(
    ("typed", "lines", "left"),
    [
        (b"search\rstop\n", [b"search", b"stop"], ""),
        (b"sx\x7f\x08search", [], "search"),
        ("ä\x7fb".encode(), [], "b"),
        (b"home\x15next", [], "next"),
        (b"aim 3 2\x17 4", [], "aim 3  4"),
        (b"a\x1b[A\x1bOP\x1b[1;5Db\x1bxc\n", [b"abc"], ""),
        (b"\x04\x00\tq", [], "q"),
        (b"\x1b[\nx", [b""], "x"),
    ],
)
def test_a_line_can_be_corrected_before_it_counts(typed: bytes, lines: list[bytes], left: str) -> None:
    whole, byte_by_byte = LineEditor(), LineEditor()
    assert whole.feed(typed) == lines
    assert [line for byte in typed for line in byte_by_byte.feed(bytes([byte]))] == lines
    assert whole.text == byte_by_byte.text == left
