"""The operator at the terminal: commands as lines on standard input, messages through a given function.

A thread waits for lines and reads from the file descriptor, not through Python's buffers: these are locked while a
thread waits in them, and the program could not end.
"""

from __future__ import annotations

import os
import select
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from fgreg.drivers.base import CommandKind, DeviceLost, OperatorCommand, RefusedWord, host_now
from fgreg.drivers.line_editor import LineEditor
from fgreg.drivers.operator_words import MOST_AGE_S, asked, understand
from fgreg.drivers.word_queue import WordQueue
from fgreg.schema.limits import TYPED_LINE_BYTES

if TYPE_CHECKING:
    from fgreg.drivers.base import DriverContext, Operator
    from fgreg.drivers.options import NoOptions

BACKGROUND_S = 0.5
"""Time between checks for the foreground. A background program that reads from its terminal would be suspended."""


class KeyboardOperator:
    """An Operator (fgreg.drivers.base); ``operator_words`` defines the commands.

    The end of the input is no loss; no more commands come.

    Args:
        say: shows one line; also called from this driver's thread.
        fd: file descriptor to read from. Default: standard input.
        corners: columns and rows of the board's inner corners; aims at others are rejected with a message.
        typing: shows what has been typed of a line, where the terminal neither shows nor edits it; called from this
            driver's thread, once at the start.
    """

    def __init__(
        self,
        say: Callable[[str], None],
        fd: int | None = None,
        corners: tuple[int, int] | None = None,
        typing: Callable[[str], None] | None = None,
    ) -> None:
        self._say, self._corners, self._typing = say, corners, typing
        self._fd = standard_input() if fd is None else fd
        self._editor = None if typing is None or self._fd is None or not os.isatty(self._fd) else LineEditor()
        self._queue, self._open = WordQueue(), self._fd is not None
        self._said_s: float | None = None  # of the lines that are read now; None: just now
        self._wake, self._woken = os.pipe()  # ends, in this order: read, write
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="keyboard", daemon=True)
        self._thread.start()

    @property
    def name(self) -> str:
        """Name shown to the user."""
        return "keyboard"

    @property
    def connected(self) -> bool:
        """Whether more lines can come."""
        return self._open

    @property
    def dropped(self) -> int:
        """Number of commands dropped because they were not fetched in time."""
        return self._queue.dropped

    def poll(self) -> list[OperatorCommand | RefusedWord]:
        """Commands since the last call."""
        return self._queue.take()

    def tell(self, text: str, *, done: bool = False, wants: CommandKind | None = None) -> None:  # noqa: ARG002
        """Show a message as one line."""
        self._say(asked(text, wants))

    def close(self) -> None:
        """End the thread; the input stays open."""
        if self._closed:
            return
        self._closed = True
        os.write(self._woken, b"\0")
        self._thread.join(2.0)
        for end in (self._wake, self._woken):
            os.close(end)

    def _run(self) -> None:
        held, too_long = b"", False  # of a line that is too long the end is held, which may say stop
        if self._typing is not None:
            self._typing("")
        while self._open and not self._closed:
            data = self._new_data()
            if data is None:
                continue
            if self._editor is not None and self._typing is not None and data:
                for line in self._editor.feed(data):
                    self._take(line, len(line) > TYPED_LINE_BYTES)
                self._typing(self._editor.text)
                continue
            *lines, held = (held + data).split(b"\n")
            if not data:
                self._open = False
                lines, held = [held] if held else [], b""  # a last line without a newline; empty input is no line
            for line in lines:
                self._take(line, too_long or len(line) > TYPED_LINE_BYTES)
                too_long = False
            if len(held) > TYPED_LINE_BYTES:
                held, too_long = held[-TYPED_LINE_BYTES:], True

    def _new_data(self) -> bytes | None:
        """As :meth:`_read`. What came while this program was held up may have been typed when that began."""
        began_s = host_now()
        data = self._read(BACKGROUND_S)
        late = host_now() - began_s > BACKGROUND_S + MOST_AGE_S
        if late and data is None:
            data = self._read(0.0)
        self._said_s = began_s if late else None
        return data

    def _read(self, wait_s: float) -> bytes | None:
        """New bytes; empty at the end of the input; None if nothing came, or reading is not allowed now."""
        fd = self._fd
        if fd is None:
            return b""
        try:
            if not in_foreground(fd):
                select.select([self._wake], [], [], wait_s)
                return None
            ready, _, _ = select.select([fd, self._wake], [], [], wait_s)
            return os.read(fd, 4096) if fd in ready and in_foreground(fd) else None
        except (OSError, ValueError):  # the terminal hung up, or the file was closed
            return b""

    def _take(self, line: bytes, too_long: bool) -> None:
        command = understand(line.decode("utf-8", errors="replace"), self._corners)
        stops = isinstance(command, OperatorCommand) and command.kind is CommandKind.STOP
        if too_long and not stops:
            command = f"a line of more than {TYPED_LINE_BYTES} characters is not understood"
        if isinstance(command, str):
            self._say(command)
            return
        said_s = command.said_s if stops or self._said_s is None else self._said_s
        self._queue.put(replace(command, peer=self.name, said_s=said_s))


def standard_input() -> int | None:
    """File descriptor of standard input; None if there is none."""
    try:
        return sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):
        return None


def in_foreground(fd: int) -> bool:
    """Whether reading is allowed now: not if another job has the terminal."""
    try:
        return not os.isatty(fd) or os.tcgetpgrp(fd) == os.getpgrp()
    except OSError:  # a terminal that does not control this program, or has hung up: reading does no harm
        return True


def open_keyboard(context: DriverContext, _options: NoOptions) -> Operator:
    """The operator at the terminal."""
    return KeyboardOperator(context.say, corners=context.corners, typing=context.typing)


def ask_keyboard(_context: DriverContext, _options: NoOptions) -> str:
    """Describe standard input without reading. Raises DeviceLost if it is closed."""
    fd = standard_input()
    if fd is None:
        raise DeviceLost("standard input is closed")
    return "standard input, a terminal" if os.isatty(fd) else "standard input, not a terminal"
