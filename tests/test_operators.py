"""Operators: what is understood, a stop that always gets through, inputs that end, hang up or belong to another job."""

from __future__ import annotations

import os
import pty
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fgreg.drivers import keyboard
from fgreg.drivers.base import CommandKind, DeviceLost, Operator, OperatorCommand, RefusedWord, host_now
from fgreg.drivers.keyboard import KeyboardOperator
from fgreg.drivers.line_editor import LineEditor
from fgreg.drivers.operator_words import AFTER, EXPECTED, LETTERS, MOST_AGE_S, asked, in_force, understand
from fgreg.drivers.operators import IgtlOperator, Operators
from fgreg.drivers.peer_words import PeerWords
from fgreg.drivers.tcp_link import Endpoint
from fgreg.drivers.word_keys import sign
from fgreg.drivers.word_queue import MOST_WAITING, WordQueue
from fgreg.live.heard_words import HeardWords
from fgreg.schema.limits import TYPED_LINE_BYTES
from tests.igtl_bytes import message, read_messages
from tests.network_peers import collect, wait_for

OTHERWISE = (*AFTER, CommandKind.RESET)
KEY = b"an operator's key of 32 bytes or more"


@pytest.mark.parametrize("said", [said for said in CommandKind if said not in OTHERWISE])
def test_each_word_and_its_letter_are_understood_in_any_case(said: CommandKind) -> None:
    letter = next(letter for letter, meant in LETTERS.items() if meant is said)
    for line in (said.value, said.value.upper(), letter, f"  {letter} \r"):
        assert understand(line) == OperatorCommand(said)


def test_a_reset_has_to_be_said_in_full() -> None:
    assert understand(" Reset ") == OperatorCommand(CommandKind.RESET)
    assert CommandKind.RESET not in LETTERS.values()
    assert isinstance(understand("res"), str)
    assert isinstance(understand("reset the stage"), str)
    assert understand("reset, no: stop") == OperatorCommand(CommandKind.STOP)
    assert asked("the stage is latched", CommandKind.RESET) == "the stage is latched: say reset"


@pytest.mark.parametrize("line", ["aim 3 2", "a 3 2", "aim 3,2", "AIM 3, 2"])
def test_an_aim_names_its_corner(line: str) -> None:
    assert understand(line, (9, 6)) == OperatorCommand(CommandKind.AIM, (3, 2))


@pytest.mark.parametrize(
    "line", ["check 640 350.5 600 351 -3.25 31", "c 640, 350.5, 600, 351, -3.25, 31", "p 640 350.5 600 351 -3.25 31"]
)
def test_a_check_and_a_point_name_their_pixels_and_their_place_in_the_plane(line: str) -> None:
    point = (640.0, 350.5, 600.0, 351.0, -3.25, 31.0)
    kind = CommandKind.CHECK if line.startswith("c") else CommandKind.POINT
    assert understand(line) == OperatorCommand(kind, point=point)


@pytest.mark.parametrize(("line", "kind"), [("exclude 3", CommandKind.EXCLUDE), ("I 12", CommandKind.INCLUDE)])
def test_a_choice_names_its_pm(line: str, kind: CommandKind) -> None:
    assert understand(line) == OperatorCommand(kind, pm=int(line.split()[1]))


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("aim", "aim COLUMN ROW"),
        ("aim 3", "aim COLUMN ROW"),
        ("aim 3 2 1", "aim COLUMN ROW"),
        ("aim -1 2", "aim COLUMN ROW"),
        ("aim 3.0 2", "aim COLUMN ROW"),
        ("aim 9 2", "columns 0 to 8, rows 0 to 5"),
        ("aim 3 6", "columns 0 to 8, rows 0 to 5"),
        ("check 1 2 3 4 5", "check U V U V X RANGE"),
        ("c 1 2 3 4 5 x", "check U V U V X RANGE"),
        ("point 1 2 3", "a point is said as point U V U V X RANGE"),
        ("exclude", "exclude PM"),
        ("include 1 2", "include PM"),
        ("exclude PM", "exclude PM"),
        ("verify now", "verify takes nothing after it"),
        ("serch", EXPECTED),
        ("search the left side", "search takes nothing after it"),
        ("\x1b[A", "'\\x1b[a]'"[:6]),
    ],
)
def test_what_is_not_understood_is_answered_with_what_is_expected(line: str, expected: str) -> None:
    answer = understand(line, (9, 6))
    assert isinstance(answer, str)
    assert expected.lower() in answer.lower()
    assert answer.isprintable()


@pytest.mark.parametrize(
    "line", ["", "   ", "\r", "stop", "STOP!", "x", "please stop", "stop the stage, now", "nonstop"]
)
def test_a_stop_need_not_be_spelt(line: str) -> None:
    assert understand(line) == OperatorCommand(CommandKind.STOP)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(line=st.text(max_size=60))
def test_any_line_is_a_command_or_a_printable_answer(line: str) -> None:
    found = understand(line, (9, 6))
    assert isinstance(found, OperatorCommand) or (found.isprintable() and len(found) < 300)


class Typed:
    """A keyboard operator on a pipe or another input."""

    def __init__(self, corners: tuple[int, int] | None = None) -> None:
        self.messages: list[str] = []
        self.read_end, self.write_end = os.pipe()
        self.operator = KeyboardOperator(self.messages.append, self.read_end, corners)

    def type(self, data: bytes) -> None:
        os.write(self.write_end, data)

    def hang_up(self) -> None:
        os.close(self.write_end)
        self.write_end = -1


@pytest.fixture
def typed() -> Iterator[Typed]:
    made = Typed((9, 6))
    try:
        yield made
    finally:
        made.operator.close()
        os.close(made.read_end)
        if made.write_end >= 0:
            os.close(made.write_end)


def test_lines_come_as_commands_in_order_however_they_are_cut(typed: Typed) -> None:
    operator: Operator = typed.operator
    assert operator.poll() == []
    for piece in (b"ho", b"me\naim 3", b" 2\nregi", b"ster\n\n", b"s\n"):
        typed.type(piece)
        time.sleep(0.01)
    said = [
        RefusedWord(CommandKind.HOME, "keyboard", "a stop came after it: say it again"),
        OperatorCommand(CommandKind.AIM, (3, 2)),
        OperatorCommand(CommandKind.REGISTER),
        OperatorCommand(CommandKind.STOP),
    ]
    assert collect(operator.poll, 5) == [*said, OperatorCommand(CommandKind.SEARCH)]
    assert operator.poll() == []
    assert (operator.connected, operator.dropped, typed.messages) == (True, 0, [])


def test_unknown_words_are_answered_and_the_next_line_works(typed: Typed) -> None:
    typed.type(b"aim 9 9\ngo\n\xff\xfe\nnext\n")
    assert collect(typed.operator.poll, 1) == [OperatorCommand(CommandKind.NEXT)]
    assert len(typed.messages) == 3
    assert "columns 0 to 8" in typed.messages[0]
    assert "'go' is not understood" in typed.messages[1]


def test_the_end_of_the_input_is_no_loss_and_its_last_line_counts(typed: Typed) -> None:
    typed.type(b"moved\nstop")
    typed.hang_up()
    assert collect(typed.operator.poll, 2) == [OperatorCommand(CommandKind.MOVED), OperatorCommand(CommandKind.STOP)]
    wait_for(lambda: not typed.operator.connected)
    assert typed.operator.poll() == []  # an end is no empty line
    assert typed.messages == []


def test_a_line_without_end_is_bounded_and_what_follows_it_works(typed: Typed) -> None:
    for _ in range(20):
        typed.type(b"a" * TYPED_LINE_BYTES)
    typed.type(b"\nfollow\n")
    assert collect(typed.operator.poll, 1) == [OperatorCommand(CommandKind.FOLLOW)]
    assert typed.messages == [f"a line of more than {TYPED_LINE_BYTES} characters is not understood"]
    # Something lay on the keyboard, and then came a stop.
    typed.type(b"a" * 3 * TYPED_LINE_BYTES + b"stop\n")
    assert collect(typed.operator.poll, 1) == [OperatorCommand(CommandKind.STOP)]
    assert understand(LineEditor().feed(b"a" * 3 * TYPED_LINE_BYTES + b"stop\r")[0].decode()) == OperatorCommand(
        CommandKind.STOP
    )


def test_what_was_typed_while_the_program_was_held_up_is_as_old_as_that(
    typed: Typed, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter(range(10**6))
    monkeypatch.setattr(keyboard, "host_now", lambda: host_now() + 2.0 * next(clock))  # each call 2 s after the last
    typed.type(b"moved\n")  # the read that is under way began before
    collect(typed.operator.poll, 1)
    typed.type(b"home\n")
    (home,) = collect(typed.operator.poll, 1)
    assert isinstance(home, OperatorCommand)
    assert home.said_s > host_now() + 1.0  # by that clock, which is ahead
    assert in_force([home], home.said_s + 2.0)[0] == []


def test_commands_not_fetched_are_dropped_oldest_first_but_never_a_stop(typed: Typed) -> None:
    typed.type(b"stop\n" + b"next\n" * (MOST_WAITING + 10) + b"home\n")
    wait_for(lambda: typed.operator.dropped == 11)
    commands = typed.operator.poll()
    assert len(commands) == MOST_WAITING + 1
    assert (commands[0], commands[-1]) == (OperatorCommand(CommandKind.STOP), OperatorCommand(CommandKind.HOME))


def test_a_message_is_one_line_with_the_command_that_is_wanted(typed: Typed) -> None:
    typed.operator.tell("the stage has to find\nits zero", wants=CommandKind.HOME)
    typed.operator.tell("registered", done=True)
    assert typed.messages == ["the stage has to find\\nits zero: say home (h)", "registered"]


def test_closing_does_not_wait_for_a_line_and_may_be_done_twice(typed: Typed) -> None:
    began = time.monotonic()
    typed.operator.close()
    typed.operator.close()
    assert time.monotonic() - began < 0.3
    typed.type(b"home\n")  # stays for whoever has the input next
    assert select.select([typed.read_end], [], [], 0)[0]


def test_a_terminal_is_read_until_it_hangs_up_and_that_is_the_end_of_the_input() -> None:
    ours, theirs = pty.openpty()
    operator = KeyboardOperator(lambda _: None, theirs)
    try:
        os.write(ours, b"home\n")  # not this program's own terminal, but one that can be read
        assert collect(operator.poll, 1) == [OperatorCommand(CommandKind.HOME)]
        assert operator.connected
        os.close(ours)
        wait_for(lambda: not operator.connected)
        assert operator.poll() == []
    finally:
        operator.close()
        os.close(theirs)


BACKGROUND = """
import os, sys, time
from fgreg.drivers.keyboard import KeyboardOperator
os.setpgid(0, 0)  # another job than the one in the terminal's foreground
operator = KeyboardOperator(lambda _: None)
time.sleep(1.2)
print("went on", operator.poll(), operator.connected)
operator.close()
"""


def test_in_the_background_the_program_is_not_stopped_by_its_terminal(tmp_path: Path) -> None:
    script = tmp_path / "background.py"
    script.write_text(BACKGROUND)
    child, terminal = pty.fork()
    if child == 0:  # pragma: no cover
        done = subprocess.run([sys.executable, str(script)], timeout=30, check=False, stdout=subprocess.PIPE)
        os.write(1, done.stdout)
        os._exit(0)
    try:
        os.write(terminal, b"stop\n")
        said, end = b"", time.monotonic() + 30.0
        while b"True" not in said and time.monotonic() < end and select.select([terminal], [], [], 30.0)[0]:
            said += os.read(terminal, 1024)
    finally:
        os.close(terminal)
        os.waitpid(child, 0)
    assert b"went on [] True" in said


@pytest.fixture
def switch() -> Iterator[tuple[IgtlOperator, socket.socket]]:
    pytest.importorskip("pyigtl", reason="pyigtl is not installed: pip install 'fgreg[igtl]'")
    operator = IgtlOperator(Endpoint.listening(0), "FootSwitch", words=PeerWords(corners=(9, 6), key=KEY))
    peer = socket.create_connection(("127.0.0.1", operator.endpoint.port), timeout=5.0)
    try:
        with peer:
            yield operator, peer
    finally:
        operator.close()


def words(text: str, device: str = "FootSwitch") -> bytes:
    data = text.encode()
    return message("STRING", device, (3).to_bytes(2, "big") + len(data).to_bytes(2, "big") + data)


def signed(word: str) -> bytes:
    return words(sign(word, KEY, time.time_ns(), time.time()))


def received(peer: socket.socket) -> str:
    data = b""
    while len(data) < 58 or len(data) < 58 + int.from_bytes(data[42:50], "big"):
        data += peer.recv(65536)
    (only,) = read_messages(data)
    assert (only.kind, only.device) == ("STRING", "OperatorTold")
    return only.content[4:].decode("ascii")


def test_texts_of_a_device_are_commands_and_others_are_not(switch: tuple[IgtlOperator, socket.socket]) -> None:
    operator, peer = switch
    peer.sendall(signed("search") + words("stop", "Someone") + signed("aim 1 5"))
    found = collect(operator.poll, 2)
    peer.sendall(words("stop"))
    assert found + collect(operator.poll, 1) == [
        OperatorCommand(CommandKind.SEARCH),
        OperatorCommand(CommandKind.AIM, (1, 5)),
        OperatorCommand(CommandKind.STOP),
    ]


def test_a_peer_gets_messages_and_replies(switch: tuple[IgtlOperator, socket.socket]) -> None:
    operator, peer = switch
    wait_for(lambda: operator.connected)
    operator.tell("the stage is ready to follow the beam", wants=CommandKind.FOLLOW)
    assert received(peer) == "the stage is ready to follow the beam: say follow (f)"
    peer.sendall(words("go"))
    wait_for(lambda: operator.poll() or operator.rejected)
    assert "'go' is not understood" in received(peer)
    assert operator.rejected == 1


def test_a_stop_does_not_wait_for_the_words_of_another_peer(
    switch: tuple[IgtlOperator, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    operator, peer = switch
    taken, both_sent = list[str](), threading.Event()

    def take(_words: PeerWords, line: str, *_: object) -> str:
        both_sent.wait(5.0)
        taken.append(line)
        return "no"

    monkeypatch.setattr(PeerWords, "take", take)
    with socket.create_connection(("127.0.0.1", operator.endpoint.port), timeout=5.0) as other:
        other.sendall(words("go") * 500)
        peer.sendall(words("stop"))
        time.sleep(0.05)
        both_sent.set()
        wait_for(lambda: len(taken) == 501)
    assert taken.index("stop") < 100


def test_several_operators_are_one_and_a_loss_delays_no_stop(
    typed: Typed, switch: tuple[IgtlOperator, socket.socket]
) -> None:
    foot, peer = switch
    both: Operator = Operators([typed.operator, foot])
    wait_for(lambda: both.connected)
    typed.type(b"home\n")
    peer.sendall(signed("search"))
    found = collect(both.poll, 2)
    said = {word.kind: word.peer for word in found if isinstance(word, OperatorCommand)}
    assert said.keys() == {CommandKind.HOME, CommandKind.SEARCH}
    assert said[CommandKind.HOME] == "keyboard" != said[CommandKind.SEARCH] != ""
    both.tell("registered")
    assert received(peer) == "registered"
    assert typed.messages == ["registered"]
    peer.close()
    wait_for(lambda: not foot.connected)
    typed.type(b"\n")
    wait_for(lambda: typed.operator._queue._words)
    assert both.poll() == [OperatorCommand(CommandKind.STOP)]
    with pytest.raises(DeviceLost, match="operator"):
        both.poll()
    assert both.poll() == []
    assert not both.connected


@pytest.mark.parametrize("before", [b"", b"next"])
def test_a_stop_with_400_words_after_it_in_one_burst_is_the_first_word(
    switch: tuple[IgtlOperator, socket.socket], before: bytes
) -> None:
    operator, peer = switch
    wait_for(lambda: operator.connected)
    counter = time.time_ns()
    many = b"".join(words(sign("moved", KEY, counter + i, time.time())) for i in range(400))
    early = words(sign("search", KEY, counter - 1, time.time())) if before else b""
    peer.sendall(early + words("stop") + many)
    wait_for(lambda: operator.dropped >= 400 - MOST_WAITING)
    found, refused = in_force(operator.poll(), host_now())
    assert not refused
    assert found[0] == OperatorCommand(CommandKind.STOP)
    assert len(found) == 1 + MOST_WAITING
    assert {command.kind for command in found[1:]} == {CommandKind.MOVED}
    assert operator.connected


def test_a_stop_cancels_the_motions_asked_for_before_it_and_nothing_else() -> None:
    queue = WordQueue()
    for kind in (CommandKind.SEARCH, CommandKind.MOVED, CommandKind.STOP, CommandKind.STOP, CommandKind.FOLLOW):
        queue.put(OperatorCommand(kind, said_s=100.0))
    kept, refused = in_force(queue.take(), 100.1)
    assert [command.kind for command in kept] == [CommandKind.STOP, CommandKind.MOVED, CommandKind.FOLLOW]
    assert [word.text for word in refused] == [
        "search from the operator is refused: a stop came after it: say it again"
    ]
    # Of another operator: what was said before the stop is cancelled in whatever order the two are asked.
    words = [OperatorCommand(CommandKind.STOP, said_s=100.0), OperatorCommand(CommandKind.HOME, said_s=99.9)]
    assert in_force(words, 100.1)[0] == words[:1]
    # The same of a word that was under way when the stop came.
    heard = HeardWords()
    heard.add(words[:1])
    assert heard.take(100.1) == (words[0],)
    heard.add(words[1:])
    assert heard.take(100.2) == ()
    assert heard.refused == "home from the operator is refused: a stop came after it: say it again"
    heard.add([OperatorCommand(CommandKind.HOME, said_s=100.2)])
    assert len(heard.take(100.3)) == 1


@pytest.mark.parametrize("kind", CommandKind)
def test_a_word_older_than_half_a_second_is_refused_but_a_stop_is_not(kind: CommandKind) -> None:
    late = OperatorCommand(kind, said_s=host_now() - 1.01 * MOST_AGE_S, peer="foot switch")
    kept, refused = in_force([late], host_now())
    assert len(kept) == (kind is CommandKind.STOP)
    assert ["foot switch" in word.text and "0.5 s old" in word.text for word in refused] == [True] * (1 - len(kept))
