"""The operator at the terminal: lines on standard input, answers by whoever shows text.

A thread waits for lines and reads them by the file's descriptor, past Python's own buffers: those are locked while a
thread waits in them, and a program could not end then.
"""

from __future__ import annotations

import os
import select
import sys
import threading
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from fgreg.drivers.base import CommandKind, DeviceLost, OperatorCommand
from fgreg.drivers.operator_words import asked, understand

if TYPE_CHECKING:
    from fgreg.drivers.base import DriverContext, Operator
    from fgreg.drivers.options import NoOptions

MOST_WAITING = 64
MAX_LINE_BYTES = 1000
BACKGROUND_S = 0.5
"""A program in the background may not read from its terminal: it would be stopped, and the stage with it."""


class KeyboardOperator:
    """An Operator (fgreg.drivers.base): see ``operator_words`` for what it understands.

    At the end of the input nothing more comes; that is no loss.

    Args:
        say: shows one line; called from this driver's thread, too.
        fd: to read from. Default: standard input.
        corners: columns and rows of the board's inner corners; aims at others are answered.
    """

    def __init__(
        self, say: Callable[[str], None], fd: int | None = None, corners: tuple[int, int] | None = None
    ) -> None:
        self._say, self._corners = say, corners
        self._fd = standard_input() if fd is None else fd
        self._waiting: deque[OperatorCommand] = deque()
        self._lock = threading.Lock()
        self._dropped, self._open = 0, self._fd is not None
        self._wake, self._woken = os.pipe()  # ends, in this order: read, write
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="keyboard", daemon=True)
        self._thread.start()

    @property
    def name(self) -> str:
        """What the user calls it."""
        return "keyboard"

    @property
    def connected(self) -> bool:
        """Whether lines can still come."""
        return self._open

    @property
    def dropped(self) -> int:
        """Commands dropped because nobody fetched them in time."""
        return self._dropped

    def poll(self) -> list[OperatorCommand]:
        """What was said since the last call."""
        with self._lock:
            commands = list(self._waiting)
            self._waiting.clear()
        return commands

    def tell(self, text: str, *, done: bool = False, wants: CommandKind | None = None) -> None:  # noqa: ARG002
        """One line."""
        self._say(asked(text, wants))

    def close(self) -> None:
        """End the thread; the input stays open, it is not ours."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        os.write(self._woken, b"\0")
        self._thread.join(2.0)
        for end in (self._wake, self._woken):
            os.close(end)

    def _run(self) -> None:
        held, too_long = b"", False
        while self._open and not self._closed:
            data = self._read()
            if data is None:
                continue
            *lines, held = (held + data).split(b"\n")
            if not data:
                self._open = False
                lines, held = [held] if held else [], b""  # a last line without an end; nothing is no empty line
            for line in lines:
                self._take(line, too_long or len(line) > MAX_LINE_BYTES)
                too_long = False
            if len(held) > MAX_LINE_BYTES:
                held, too_long = b"", True

    def _read(self) -> bytes | None:
        """What is there; nothing at the end of the input; None where it was not waited for, or not allowed."""
        fd = self._fd
        if fd is None:
            return b""
        try:
            if not _in_foreground(fd):
                select.select([self._wake], [], [], BACKGROUND_S)
                return None
            ready, _, _ = select.select([fd, self._wake], [], [], BACKGROUND_S)
            return os.read(fd, 4096) if fd in ready and _in_foreground(fd) else None
        except (OSError, ValueError):  # the terminal hung up, or the file was closed
            return b""

    def _take(self, line: bytes, too_long: bool) -> None:
        if too_long:
            self._say(f"a line of more than {MAX_LINE_BYTES} characters is not understood")
            return
        command = understand(line.decode("utf-8", errors="replace"), self._corners)
        if isinstance(command, str):
            self._say(command)
            return
        with self._lock:
            self._waiting.append(command)
            while len(self._waiting) > MOST_WAITING:
                # The oldest goes, but never a stop.
                old = next((c for c in self._waiting if c.kind is not CommandKind.STOP), self._waiting[0])
                self._waiting.remove(old)
                self._dropped += 1


def standard_input() -> int | None:
    """Its descriptor; None where there is none."""
    try:
        return sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):
        return None


def _in_foreground(fd: int) -> bool:
    """Whether reading is allowed now: not from the terminal of another job."""
    try:
        return not os.isatty(fd) or os.tcgetpgrp(fd) == os.getpgrp()
    except OSError:  # a terminal that does not control this program, or has hung up: reading does no harm
        return True


def open_keyboard(context: DriverContext, _options: NoOptions) -> Operator:
    """Whoever sits at the terminal."""
    return KeyboardOperator(context.say, corners=context.corners)


def ask_keyboard(_context: DriverContext, _options: NoOptions) -> str:
    """What standard input is; nothing is read. Raises DeviceLost where it is closed."""
    fd = standard_input()
    if fd is None:
        raise DeviceLost("standard input is closed")
    return "standard input, a terminal" if os.isatty(fd) else "standard input, not a terminal"
