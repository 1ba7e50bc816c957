"""A child process that works on one request after another; one that ends or hangs is reported and replaced.

Written on multiprocessing. pebble kills a process whose task is overdue, loky replaces one that has died, but both
then run the next task in a new process without a report. That is wrong for a worker that keeps state between requests,
as the registration does. Nor do they detect a process that hangs while it is idle.
"""

from __future__ import annotations

import errno
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

from fgreg.workers.memory import keep_freed_memory
from fgreg.workers.progress import LOOK_S, Progress

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from types import FrameType

NICENESS = 5
"""Added to the owner's niceness, so that a worker gives way to its owner, and its own workers to it."""
START_S, ANSWER_S, END_S = 60.0, 120.0, 0.5
"""Default limits of start, answer and end: of the time without progress (fgreg.workers.progress)."""
UNKNOWN_S = 10.0
"""Least limit where the system does not tell what a process does (macOS): a slow one looks as one that hangs."""
KILL_S = 1.0
"""Longest wait for a killed process: one that waits for a disk that does not answer goes on until it does."""
WORK_S = 300.0
"""Default of the most processor time for one answer: more is an endless loop."""
SLOW_S = 2.0
"""A process without progress for longer, although an answer is due, is reported as trouble."""
RESTART_S = 1.0
"""Time between two starts: a worker that cannot start must not keep a processor busy."""
PING_S = 0.2
"""Time between two pings of an idle worker."""
IDLE_S = 0.1
"""Time between two calls of the work's ``idle``."""

Request = TypeVar("Request")
Answer = TypeVar("Answer")
Work = Callable[[Request], Answer]
Kind = Literal["ready", "ping", "request", "failed", "broken"]
"""Kind of a message. To the process: ping, request. From it: their answers, ``ready`` to work, a ``failed`` request,
and ``broken`` with the reason why it ends. The message None ends the process."""


class WorkerProcess(Generic[Request, Answer]):
    """One child process. For one thread at a time. Close it when it is no longer needed.

    :meth:`send`, :meth:`fetch` and :meth:`check` detect a process that has ended or hangs, and start the next one if
    that is due. The request under way is then lost: ``failure`` gives the reason, and the owner may send it again. A
    request that is still waiting goes to the next process. Ctrl-C does not reach a worker.

    Args:
        make: called in the child with ``arguments`` at each start; a function of a module. Returns the work: a function
            of a request, or a context manager that gives one and is left when the worker is closed. If the work has a
            method ``idle``, that is called every 0.1 s while no request comes.
        name: of the process; top shows its first 15 letters. what: its name in messages: ``the full solve's process``.
        niceness: added to the owner's.
        start_s, answer_s: longest time without progress before its start and an answer; then the process is killed.
            A process that computes, or waits for a processor, is slow and not dead.
        work_s: most processor time for its start or an answer; then the process is killed as well.
        end_s: longest end.
        restart: whether to start another process after one has ended; if not, every request fails from then on.
        daemon: False if the work starts processes itself.

    Attributes:
        failure: why the last request failed; empty if it was answered.
        lost: whether the last request failed because its process has ended or was killed.
        trouble: what is wrong with the process now; empty if it answers.
    """

    def __init__(
        self,
        make: Callable[..., Work[Request, Answer] | AbstractContextManager[Work[Request, Answer]]],
        *arguments: Any,
        name: str,
        what: str,
        niceness: int = NICENESS,
        start_s: float = START_S,
        answer_s: float = ANSWER_S,
        end_s: float = END_S,
        work_s: float = WORK_S,
        restart: bool = True,
        daemon: bool = True,
    ) -> None:
        self._make, self._arguments, self._name, self._what = make, arguments, name, what
        self._niceness, self._restart, self._daemon = niceness, restart, daemon
        self.start_s, self.answer_s, self._end_s, self._work_s = start_s, answer_s, end_s, work_s
        self.failure, self.lost, self.trouble = "", False, ""
        self._child: _Child | None = None
        self._progress: Progress | None = None  # of the child
        self._worked_s = 0.0  # its processor time at _sent_s
        self._awaited: Kind | None = None  # the one message that has not been answered, sent at _sent_s
        self._sent_s = self._received_s = self._started_s = 0.0
        self._waiting: tuple[Request] | None = None  # to be handed over
        self._reply: tuple[Answer | None] | None = None
        self._start()

    @property
    def busy(self) -> bool:
        """Whether a request waits or is under way."""
        return self._waiting is not None or self._awaited == "request"

    @property
    def ready(self) -> bool:
        """Whether the process has started, and is not known to have ended."""
        return self._child is not None and self._awaited != "ready"

    @property
    def alive(self) -> bool:
        """Whether the process runs. From any thread."""
        child = self._child
        return child is not None and child.process.is_alive()

    @property
    def pid(self) -> int | None:
        """Id of the process; None if there is none."""
        return None if self._child is None else self._child.process.pid

    def send(self, request: Request) -> None:
        """Hand over a request; it waits until the process is ready.

        Raises:
            RuntimeError: the worker is busy.
        """
        if self.busy:
            raise RuntimeError(f"{self._what} is busy")
        self._waiting = (request,)
        self._advance(0.0)

    def fetch(self, wait_s: float = 0.0) -> tuple[Answer | None] | None:
        """The answer as a tuple of one, (None,) if the request failed; None if there is no answer yet.

        Args:
            wait_s: longest wait for it.
        """
        until = time.monotonic() + wait_s
        self._advance(0.0)
        while self.busy and (left_s := until - time.monotonic()) > 0.0:
            self._advance(left_s)
        reply, self._reply = self._reply, None
        return reply

    def check(self) -> None:
        """Check that the process is alive, also while it is idle. Call it often."""
        self._advance(0.0)
        if self._child is not None and self._awaited is None and time.monotonic() - self._received_s > PING_S:
            self._post(self._child, "ping", None)

    def answers(self, wait_s: float) -> bool:
        """Whether the idle process answers a ping within ``wait_s``."""
        self._advance(0.0)
        if self._child is not None and self._awaited is None:
            self._post(self._child, "ping", None)
        until = time.monotonic() + wait_s
        while self._awaited is not None and (left_s := until - time.monotonic()) > 0.0:
            self._advance(left_s)
        return self._child is not None and self._awaited is None

    def close(self) -> None:
        """End the process."""
        self._close(self._end_s)

    def kill(self) -> None:
        """End the process at once."""
        self._close(0.0)

    def _close(self, patience_s: float) -> None:
        self._restart, self._waiting = False, None
        self._end(patience_s)
        self.trouble = "it is closed"

    def _start(self) -> None:
        self._started_s = self._sent_s = time.monotonic()
        arguments = (self._niceness, self._make, self._arguments)
        try:
            self._child = _Child(arguments, self._name, self._daemon)
        except OSError as error:
            self.trouble = f"it cannot be started: {error}"
        else:
            self._progress, self._worked_s = Progress(self._child.process.pid or 0), 0.0
            self._awaited = "ready"

    def _advance(self, wait_s: float) -> None:
        """Take in the process's messages, hand over a waiting request, and detect whether it has ended or hangs."""
        now_s, child = time.monotonic(), self._child
        if child is None:
            if not self._restart:
                self._fail()
            elif now_s - self._started_s >= RESTART_S:
                self._start()
            else:
                time.sleep(min(wait_s, PING_S))
            return
        try:
            if child.connection.poll(0.0 if self._awaited is None else min(wait_s, LOOK_S)):
                self._take(*child.connection.recv())
        except (EOFError, OSError):
            self._lose("has ended")
        if self._child is None:
            return
        if self._awaited is None:
            if self._waiting is not None:
                (request,), self._waiting = self._waiting, None
                self._post(child, "request", request)
            return
        self._judge()

    def _judge(self) -> None:
        """Whether the process hangs although an answer is due, or works on it without end."""
        if self._progress is None or self._awaited is None:
            return
        limit_s = self.start_s if self._awaited == "ready" else self.answer_s
        if not self._progress.known:
            limit_s = max(limit_s, UNKNOWN_S)
        stuck_s = min(time.monotonic() - self._sent_s, self._progress.idle_s())
        if stuck_s >= limit_s:
            self._lose(f"has not answered for {stuck_s:.1f} s")
        elif self._progress.worked_s - self._worked_s > self._work_s:
            self._lose(f"has worked for {self._work_s:g} s without an answer")
        elif self._awaited != "ready":
            self.trouble = f"it has not answered for {stuck_s:.1f} s" if stuck_s > SLOW_S else ""

    def _take(self, kind: Kind, value: Any) -> None:
        if kind == "broken":
            self._lose(value)
            return
        if kind in ("request", "failed"):
            failed = kind == "failed"
            self._reply = (None,) if failed else (value,)
            self.failure, self.lost = value if failed else "", False
        self._awaited, self._received_s, self.trouble = None, time.monotonic(), ""

    def _post(self, child: _Child, kind: Kind, request: Request | None) -> None:
        """Send a message to an idle process."""
        child.send((kind, request))
        self._awaited, self._sent_s = kind, time.monotonic()
        if self._progress is not None:
            self._progress.idle_s()
            self._worked_s = self._progress.worked_s

    def _lose(self, why: str) -> None:
        """The process has ended or has to be killed."""
        self.trouble = f"it {why}"
        if self._awaited == "request" or (self._waiting is not None and not self._restart):
            self._fail()
        self._end(0.0)

    def _fail(self) -> None:
        """The request is lost with the process."""
        if self.busy:
            self.failure, self.lost, self._reply = self._what + self.trouble.removeprefix("it"), True, (None,)
            self._awaited = self._waiting = None

    def _end(self, patience_s: float) -> None:
        if self._child is not None:
            self._child.end(patience_s)
        self._child = self._awaited = self._progress = None


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Ctrl-C takes effect when the block ends: a process that is half started would end with a traceback.

    The mask of one thread is not enough: the signal may reach another thread, and is then handled in the main one.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return
    held: list[FrameType | None] = []
    signal.signal(signal.SIGINT, lambda _number, frame: held.append(frame))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if held:
        before(signal.SIGINT, held[0])


class _Child:
    """A process, its connection, and a thread that writes to it, so that a process that does not read blocks nothing.

    Raises:
        OSError: the process cannot be started.
    """

    def __init__(self, arguments: tuple[Any, ...], name: str, daemon: bool) -> None:
        import multiprocessing  # imported late to keep the cold start short
        from multiprocessing import resource_tracker

        context = multiprocessing.get_context("spawn")  # a fork would inherit the threads of libraries in any state
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, *arguments), name=name, daemon=daemon)
        # The process starts with SIGINT blocked: its owner ends it. The tracker's start would unblock it again.
        resource_tracker.ensure_running()
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            with theirs, _interrupts_held():
                self.process.start()
        except OSError:
            self.connection.close()
            raise
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        self._messages: SimpleQueue[memoryview | None] = SimpleQueue()
        self._writer = threading.Thread(target=self._write, name=f"to {name}", daemon=True)
        try:
            self._writer.start()
        except RuntimeError as error:  # the system gives no more threads
            self.process.kill()
            self.process.join(KILL_S)
            self.connection.close()
            raise OSError(errno.EAGAIN, str(error)) from error

    def _write(self) -> None:
        with suppress(OSError):  # of a process that has ended
            while (message := self._messages.get()) is not None:
                self.connection.send_bytes(message)

    def send(self, message: object) -> None:
        """Queue a message. Raises what pickling it raises."""
        from multiprocessing.reduction import ForkingPickler

        self._messages.put(ForkingPickler.dumps(message))

    def end(self, patience_s: float) -> None:
        """Ask the process to end, then kill it."""
        self.send(None)
        self.process.join(patience_s)
        self.process.kill()
        self.process.join(KILL_S)
        self._messages.put(None)
        self._writer.join(KILL_S)
        self.connection.close()


def _serve(
    connection: Connection[Any, Any], niceness: int, make: Callable[..., Any], arguments: tuple[Any, ...]
) -> None:
    """Main function of the child; returns when the owner closes the connection or ends."""
    import multiprocessing

    os.nice(niceness)
    keep_freed_memory()
    with suppress(OSError):  # where top and ps have the name from
        Path("/proc/self/comm").write_text(multiprocessing.current_process().name)
    try:
        made = make(*arguments)
        context = made if isinstance(made, AbstractContextManager) else nullcontext(made)
        with context as work, suppress(EOFError, OSError):
            connection.send(("ready", None))
            _answer(connection, work)
    except Exception as error:
        with suppress(OSError):
            connection.send(("broken", f"has ended ({type(error).__name__}: {error})"))


def _answer(connection: Connection[Any, Any], work: Any) -> None:
    """Answer requests until the owner sends None. Raises EOFError, OSError if the owner has ended."""
    idle = getattr(work, "idle", None)
    while True:
        while idle is not None and not connection.poll(IDLE_S):
            idle()
        message = connection.recv()
        if message is None:
            return
        kind, request = message
        if kind == "ping":
            connection.send(("ping", None))
            continue
        try:
            answer = ("request", work(request))
        except Exception as error:  # a fault of one request; the next may be answered
            answer = ("failed", f"{type(error).__name__}: {error}")
        connection.send(answer)
