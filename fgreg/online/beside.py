"""Work in a process beside the engine: a case goes there, an answer comes back, and no event waits for either."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, Generic, TypeVar

BEHIND = 5
"""By so much the processes beside stand back: behind the engine, which stands back as much behind the camera's loop."""

Case = TypeVar("Case")
Answer = TypeVar("Answer")


def _serve(connection: Connection[Any, Any], work: Callable[[Any], Any]) -> None:
    """Work on what comes until the other end closes."""
    os.nice(BEHIND)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main program ends it, in its own time
    while True:
        try:
            case = connection.recv()
        except (EOFError, OSError):
            return
        if case is None:
            return
        try:
            found = (work(case), "")
        except Exception as error:  # the work's defects must not end the session's estimate
            found = (None, f"{type(error).__name__}: {error}")
        try:
            connection.send(found)
        except (BrokenPipeError, OSError):
            return


class Beside(Generic[Case, Answer]):
    """One process that works on one case after another.

    Args:
        work: on a case, never None; a function of a module, or a ``functools.partial`` of one.
        name: of the process. what: it is, in messages.

    Attributes:
        busy: whether a case is under way.
        failure: what went wrong with the last one, empty where nothing did.
    """

    def __init__(self, work: Callable[[Case], Answer], name: str, what: str) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, work), name=name, daemon=True)
        self._process.start()
        theirs.close()
        self._what = what
        self.busy, self.failure = False, ""

    def send(self, case: Case) -> bool:
        """Hand over a case; whether it is under way now. Not to be called while ``busy``."""
        try:
            if not self._process.is_alive():
                raise EOFError
            self._connection.send(case)
        except (EOFError, OSError):
            self.failure = f"{self._what} has ended"
            return False
        self.busy = True
        return True

    def fetch(self) -> tuple[Answer | None] | None:
        """The answer that has come back, None in it where the work failed; None where nothing has come."""
        try:
            if not (self.busy and self._connection.poll()):
                return None
            found, self.failure = self._connection.recv()
        except (EOFError, OSError):
            self.busy, self.failure = False, f"{self._what} has ended"
            return None
        self.busy = False
        return (found,)

    def close(self) -> None:
        """End the process."""
        with suppress(OSError):
            self._connection.send(None)
        self._connection.close()
        self._process.join(timeout=0.5)
        if self._process.is_alive():
            self._process.terminate()
            self._process.join()
