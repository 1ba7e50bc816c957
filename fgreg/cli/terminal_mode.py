"""A terminal that shows nothing by itself and edits no lines, while a page of the program's stands on it."""

from __future__ import annotations

import contextlib
import os
from types import TracebackType
from typing import Any, Self

from fgreg.drivers.keyboard import in_foreground, standard_input

try:
    import termios
except ImportError:  # not on this system: the terminal stays as it is
    termios = None  # type: ignore[assignment]


class UneditedTerminal:
    """Standard input without echo and line editing; Ctrl-C and Ctrl-Z work as before. Nothing where it is no terminal.

    A shell changes the modes when the program is suspended, so :meth:`keep` is called now and then. Leaving discards
    what was typed and not read.
    """

    def __init__(self) -> None:
        fd = standard_input()
        self._fd = fd if fd is not None and termios is not None and os.isatty(fd) else None
        self._before: list[Any] | None = None

    def keep(self) -> None:
        """Set the modes, unless they are set; another job's terminal is left alone."""
        if self._fd is None or self._before is None or not in_foreground(self._fd):
            return
        try:
            modes = termios.tcgetattr(self._fd)
            if modes[3] & (termios.ECHO | termios.ICANON):
                modes[3] &= ~(termios.ECHO | termios.ICANON)
                termios.tcsetattr(self._fd, termios.TCSANOW, modes)
        except (OSError, termios.error):  # it has hung up
            self._fd = None

    def __enter__(self) -> Self:
        if self._fd is not None:
            try:
                self._before = termios.tcgetattr(self._fd)
            except (OSError, termios.error):
                self._fd = None
        self.keep()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._fd is not None and self._before is not None and in_foreground(self._fd):
            with contextlib.suppress(OSError, termios.error):
                termios.tcsetattr(self._fd, termios.TCSAFLUSH, self._before)
        self._before = None
