"""A child process that works on one request after another; one that ends or hangs is reported and replaced.

Written on multiprocessing. pebble kills a process whose task is overdue, loky replaces one that has died, but both
then run the next task in a new process, and say nothing of it. A worker that keeps state from one request to the next,
as the registration does, must not go on like that. Nor do they notice a process that hangs while it is idle.
"""

from __future__ import annotations

import os
import signal
import socket
import struct
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from enum import Enum, auto
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar, cast

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess

NICENESS = 5
"""A worker gives way to its owner by so much; the processes that a worker starts give way to it in turn."""
START_S = 60.0
ANSWER_S = 120.0
"""A start, or an answer, that takes longer does not come."""
END_S = 0.5
"""A closed worker may finish its request for so long."""
RESTART_S = 1.0
"""Between two starts: a worker that cannot start must not keep a processor busy."""
PING_S = 0.2
"""An idle worker is asked whether it is there after so long."""
IDLE_S = 0.1
"""Between calls of the work's ``idle``."""
TRANSFER_S = 1.0
"""A worker that takes or gives nothing of a message for so long hangs."""

Request = TypeVar("Request")
Answer = TypeVar("Answer")
Request_contra = TypeVar("Request_contra", contravariant=True)
Answer_co = TypeVar("Answer_co", covariant=True)


class Work(Protocol[Request_contra, Answer_co]):
    """What a worker does with a request. If it has a method ``idle``, that runs every 0.1 s while no request waits."""

    def __call__(self, request: Request_contra, /) -> Answer_co: ...


class _Message(Enum):
    """A request to the worker and its answer have the same kind."""

    READY = auto()
    PING = auto()
    REQUEST = auto()
    FAILED = auto()
    BROKEN = auto()


class WorkerProcess(Generic[Request, Answer]):
    """One child process. For one thread at a time. Close it when it is no longer needed.

    The process is seen to have ended, or to hang, in :meth:`send`, :meth:`fetch` and :meth:`check`; each of them starts
    the next one where that is due. A request that was under way is lost: ``failure`` tells, and the owner may send it
    again. One that had not been handed over yet goes to the next process. Ctrl-C does not reach a worker.

    Args:
        make: called in the child with ``arguments`` at each start. Returns the work, or a context manager that gives it
            and is left when the worker is closed. A function of a module.
        name: of the process. what: it is, in messages, e.g. ``the full solve's process``.
        niceness: added to the owner's.
        start_s, answer_s, end_s: longest start, answer and end; after these the process is killed.
        slow_s: an answer that takes longer is reported as trouble; None for ``answer_s``.
        restart: start another process where one has ended; without it every request fails from then on.
        daemon: False where the work starts processes itself.

    Attributes:
        failure: what went wrong with the last request; empty where it was answered.
        lost: whether the last request failed because its process has ended or was killed.
        trouble: what is wrong with the process now; empty where it answers.
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
        slow_s: float | None = None,
        end_s: float = END_S,
        restart: bool = True,
        daemon: bool = True,
    ) -> None:
        self._make, self._arguments, self._name, self._what = make, arguments, name, what
        self._niceness, self._restart, self._daemon = niceness, restart, daemon
        self.start_s, self.answer_s, self.slow_s, self._end_s = start_s, answer_s, slow_s or answer_s, end_s
        self.failure, self.lost, self.trouble = "", False, ""
        self._process: BaseProcess | None = None
        self._connection: Connection[Any, Any] | None = None
        self._awaited: _Message | None = None  # the one message that has not been answered, sent at _sent_s
        self._sent_s = self._heard_s = self._started_s = 0.0
        self._waiting: tuple[Request] | None = None  # to be handed over
        self._reply: tuple[Answer | None] | None = None
        self._start()

    @property
    def busy(self) -> bool:
        """Whether a request waits or is under way."""
        return self._waiting is not None or self._awaited is _Message.REQUEST

    @property
    def ready(self) -> bool:
        """Whether the process has started and answered up to now."""
        return self._connection is not None and self._awaited is not _Message.READY

    @property
    def alive(self) -> bool:
        """Whether the process runs. From any thread."""
        process = self._process
        return process is not None and process.is_alive()

    @property
    def pid(self) -> int | None:
        """Of the process; None where there is none."""
        return None if self._process is None else self._process.pid

    def send(self, request: Request) -> None:
        """Hand over a request, as soon as the process is ready for it.

        Raises:
            RuntimeError: the worker is busy.
        """
        if self.busy:
            raise RuntimeError(f"{self._what} is busy")
        self._waiting = (request,)
        self._advance(0.0)

    def fetch(self, wait_s: float = 0.0) -> tuple[Answer | None] | None:
        """The answer that has come back, None in it where the request failed; None where nothing has come.

        Args:
            wait_s: wait for it, no longer than this.
        """
        until = time.monotonic() + wait_s
        self._advance(0.0)
        while self.busy and (left_s := until - time.monotonic()) > 0.0:
            self._advance(left_s)
        reply, self._reply = self._reply, None
        return reply

    def check(self) -> None:
        """See that the process is there, also where it has nothing to do. Call it often."""
        self._advance(0.0)
        if self._awaited is None and time.monotonic() - self._heard_s > PING_S:
            self._post(_Message.PING, None)

    def close(self) -> None:
        """End the process."""
        self._restart, self._waiting = False, None
        self._end(self._end_s)
        self.trouble = "it is closed"

    def _start(self) -> None:
        import multiprocessing  # not before it is needed: it takes a cold start's time
        from multiprocessing import resource_tracker

        self._started_s = self._sent_s = time.monotonic()
        context = multiprocessing.get_context("spawn")  # a fork would inherit the threads of libraries in any state
        # The child begins with Ctrl-C blocked: its owner ends it. The resource tracker's start would unblock it again.
        resource_tracker.ensure_running()
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            ours, theirs = context.Pipe()
            with theirs:
                arguments = (theirs, self._niceness, self._make, self._arguments)
                process = context.Process(target=_serve, args=arguments, name=self._name, daemon=self._daemon)
                process.start()
        except OSError as error:
            self.trouble = f"it cannot be started: {error}"
            return
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        _limit_transfers(ours)
        self._process, self._connection, self._awaited = process, ours, _Message.READY

    def _advance(self, wait_s: float) -> None:
        """Take in what the process has sent, hand over what waits, and see whether it has ended or hangs."""
        now_s = time.monotonic()
        if self._connection is None:
            if not self._restart:
                self._fail()
            elif now_s - self._started_s >= RESTART_S:
                self._start()
            else:
                time.sleep(min(wait_s, PING_S))
            return
        limit_s = self.start_s if self._awaited is _Message.READY else self.answer_s
        left_s = 0.0 if self._awaited is None else max(0.0, self._sent_s + limit_s - now_s)
        try:
            if self._connection.poll(min(wait_s, left_s)):
                self._take(*self._received(self._connection))
        except (EOFError, OSError) as error:
            self._lose(_ended(error))
        if self._connection is None:
            return
        if self._awaited is None:
            if self._waiting is not None:
                (request,), self._waiting = self._waiting, None
                self._post(_Message.REQUEST, request)
            return
        waited_s = time.monotonic() - self._sent_s
        if waited_s >= limit_s:
            self._lose(f"has not answered for {waited_s:.1f} s")
        elif waited_s > self.slow_s and self._awaited is not _Message.READY:
            self.trouble = f"it has not answered for {waited_s:.1f} s"

    @staticmethod
    def _received(connection: Connection[Any, Any]) -> tuple[_Message, Any]:
        """Raises EOFError, OSError where the process has ended."""
        try:
            return cast("tuple[_Message, Any]", connection.recv())
        except (EOFError, OSError):
            raise
        except Exception as error:  # an answer that cannot be made out of what came
            return _Message.FAILED, f"{type(error).__name__}: {error}"

    def _take(self, kind: _Message, value: Any) -> None:
        if kind is _Message.BROKEN:
            self._lose(value)
            return
        if kind in (_Message.REQUEST, _Message.FAILED):
            failed = kind is _Message.FAILED
            self._reply = (None,) if failed else (value,)
            self.failure, self.lost = value if failed else "", False
        self._awaited, self._heard_s, self.trouble = None, time.monotonic(), ""

    def _post(self, kind: _Message, request: Request | None) -> None:
        """To a process that waits for it."""
        if self._connection is None:
            return
        self._awaited, self._sent_s = kind, time.monotonic()
        try:
            self._connection.send((kind, request))
        except OSError as error:
            self._lose(_ended(error))
        except BaseException:  # a request that cannot be sent is the caller's defect
            self._awaited = None
            raise

    def _lose(self, why: str) -> None:
        """The process is no longer there, or is to be killed."""
        self.trouble = f"it {why}"
        if self._awaited is _Message.REQUEST or (self._waiting is not None and not self._restart):
            self._fail()
        self._end(0.0)

    def _fail(self) -> None:
        """The request is lost with the process."""
        if self.busy:
            self.failure, self.lost, self._reply = self._what + self.trouble.removeprefix("it"), True, (None,)
            self._awaited = self._waiting = None

    def _end(self, patience_s: float) -> None:
        self._awaited = None
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        if self._process is not None:
            if patience_s > 0.0:
                self._process.join(patience_s)
            self._process.kill()
            self._process.join()
            self._process = None


def _limit_transfers(connection: Connection[Any, Any]) -> None:
    """A process that hangs in the middle of a message raises BlockingIOError here after :data:`TRANSFER_S`."""
    with socket.socket(fileno=os.dup(connection.fileno())) as end:
        for option in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):
            end.setsockopt(socket.SOL_SOCKET, option, struct.pack("ll", int(TRANSFER_S), 0))


def _ended(error: Exception) -> str:
    return f"hangs in a message for {TRANSFER_S:.0f} s" if isinstance(error, BlockingIOError) else "has ended"


def _serve(
    connection: Connection[Any, Any], niceness: int, make: Callable[..., Any], arguments: tuple[Any, ...]
) -> None:
    """The child, until the owner closes the connection, or ends."""
    os.nice(niceness)
    try:
        made = make(*arguments)
        context = made if isinstance(made, AbstractContextManager) else nullcontext(made)
        with context as work, suppress(EOFError, OSError):
            connection.send((_Message.READY, None))
            _answer(connection, work)
    except Exception as error:
        with suppress(OSError):
            connection.send((_Message.BROKEN, f"has ended ({type(error).__name__}: {error})"))


def _answer(connection: Connection[Any, Any], work: Any) -> None:
    """Raises EOFError, OSError when the owner is gone."""
    idle = getattr(work, "idle", None)
    while True:
        while idle is not None and not connection.poll(IDLE_S):
            idle()
        kind, request = connection.recv()
        if kind is _Message.PING:
            connection.send((_Message.PING, None))
            continue
        try:
            answer = (_Message.REQUEST, work(request))
        except Exception as error:  # one request's: the next one may be answered
            answer = (_Message.FAILED, f"{type(error).__name__}: {error}")
        try:
            connection.send(answer)
        except (EOFError, OSError):
            raise
        except Exception as error:  # an answer that cannot be sent
            connection.send((_Message.FAILED, f"{type(error).__name__}: {error}"))


__all__ = ["WorkerProcess"]
