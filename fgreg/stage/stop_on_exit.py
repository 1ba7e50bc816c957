"""Stops all stages when this program ends: by Ctrl-C, by an uncaught exception, or normally."""

from __future__ import annotations

import atexit
import signal
import sys
import threading
from types import FrameType, TracebackType
from typing import Protocol


class Guarded(Protocol):
    """A link to a stage."""

    def press(self) -> None:
        """Emergency stop; takes no lock, never raises."""

    def close(self) -> None:
        """Close the link, which stops the stage."""


_links: tuple[Guarded, ...] = ()
"""The open links; replaced, never changed, so that a signal handler can iterate over it at any time."""
_GUARDED = threading.Lock()
_guards_set = False


def release(link: Guarded) -> None:
    """Remove a link that is being closed."""
    global _links
    with _GUARDED:
        _links = tuple(other for other in _links if other is not link)


def emergency_stop_all(_reason: str = "") -> None:
    """Emergency stop of every stage of this program; takes no lock, writes no log, never raises.

    A program that sets a handler of its own for SIGINT after opening a link calls this from it.
    """
    for link in _links:
        link.press()


def add(link: Guarded) -> None:
    """Have the stage stopped on Ctrl-C, on an uncaught exception of any thread, and at the interpreter's end."""
    global _guards_set, _links
    with _GUARDED:
        _links = (*_links, link)
        if _guards_set:
            return
        _guards_set = True
    atexit.register(_at_exit)
    main_hook, thread_hook = sys.excepthook, threading.excepthook

    def on_crash(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        emergency_stop_all()
        main_hook(kind, error, trace)

    def on_thread_crash(crash: threading.ExceptHookArgs) -> None:
        emergency_stop_all()
        thread_hook(crash)

    sys.excepthook, threading.excepthook = on_crash, on_thread_crash
    if threading.current_thread() is threading.main_thread():
        _guard_interrupt()


def _guard_interrupt() -> None:
    before = signal.getsignal(signal.SIGINT)

    def on_interrupt(number: int, frame: FrameType | None) -> None:
        emergency_stop_all()
        if callable(before):
            before(number, frame)

    if callable(before):
        signal.signal(signal.SIGINT, on_interrupt)


def _at_exit() -> None:
    emergency_stop_all()
    for link in _links:
        link.close()
