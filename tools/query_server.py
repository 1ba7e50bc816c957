"""A process that answers tracking queries from the shared snapshot while the estimate's process is busy.

Native calls of the estimate's updates hold their interpreter's lock, so other threads of that process wait. A client of
this server waits for one round trip over a local socket. A camera loop that is a process of its own needs no server: it
holds a :class:`fgreg.online.shared_snapshot.SnapshotReader` and calls :func:`fgreg.tracking.query.track` itself.
"""

from __future__ import annotations

import contextlib
import math
import secrets
import shutil
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing import AuthenticationError
from multiprocessing.connection import Client, Connection, Listener
from pathlib import Path
from types import TracebackType
from typing import Any

from fgreg.model.estimate import TrackEstimate
from fgreg.model.measurements import Track
from fgreg.online.shared_snapshot import NoSnapshotError, SnapshotReader
from fgreg.tracking.query import track
from fgreg.workers.worker_process import Work, WorkerProcess
from query_codec import QueryError, decode_answer, decode_query, encode_answer, encode_error, encode_query

START_S = 30.0
"""Longest time until the process has started."""
_KEY_BYTES = 32


@dataclass(frozen=True, slots=True)
class QueryAddress:
    """Address and key of a server, for processes that may send queries."""

    path: str
    key: bytes

    def __repr__(self) -> str:
        return f"QueryAddress({self.path!r})"


class QueryClient:
    """Sends queries to a server. Threads may share one and then take turns; one client each is faster.

    Raises:
        OSError: there is no such server. multiprocessing.AuthenticationError: the key is wrong.
    """

    def __init__(self, address: QueryAddress) -> None:
        self._connection = Client(address.path, family="AF_UNIX", authkey=address.key)
        self._turn = threading.Lock()
        self._age_s = float("nan")

    @property
    def age_s(self) -> float:
        """Age of the snapshot that the last answer came from."""
        return self._age_s

    def track(self, query: Track) -> TrackEstimate:
        """The answer to a query, as of :func:`fgreg.tracking.query.track`.

        Raises:
            QueryError: the server could not process it. EOFError, OSError: the server has ended.
        """
        message = encode_query(query)
        with self._turn:
            self._connection.send_bytes(message)
            data = self._connection.recv_bytes()
        answer, self._age_s = decode_answer(data)
        return answer

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def __enter__(self) -> QueryClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


class QueryServer:
    """Starts the process; use it as a context manager, or call :meth:`close`.

    It ends with the process that started it, also if that is killed.

    Args:
        name: of the shared snapshot.

    Raises:
        RuntimeError: the process did not start.
    """

    def __init__(self, name: str) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="fgreg-"))  # of mode 0700
        self.address = QueryAddress(str(self._folder / "queries"), secrets.token_bytes(_KEY_BYTES))
        self._worker: WorkerProcess[None, None] = WorkerProcess(
            _serving,
            name,
            self.address,
            name="fgreg-queries",
            what="the query process",
            niceness=0,
            start_s=START_S,
            restart=False,
        )
        self._worker.send(None)  # answered when it has started
        self._worker.fetch(math.inf)
        if self._worker.failure:
            self.close()
            raise RuntimeError(f"no queries can be answered: {self._worker.failure}")

    @property
    def pid(self) -> int | None:
        """Of the process."""
        return self._worker.pid

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._worker.alive

    def client(self) -> QueryClient:
        """A new client in this process; others make theirs of ``address``."""
        return QueryClient(self.address)

    def close(self) -> None:
        """End the process; clients find their connection closed."""
        self._worker.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> QueryServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


@contextlib.contextmanager
def _serving(name: str, address: QueryAddress) -> Iterator[Work[None, None]]:
    """Serve in the process: one thread per client, each with a reader of its own. The worker itself has no work."""
    reader = SnapshotReader(name)
    with Listener(address.path, family="AF_UNIX", backlog=16, authkey=address.key) as listener:
        threading.Thread(target=_accept, args=(listener, reader), daemon=True).start()
        yield lambda _: None
    shutil.rmtree(Path(address.path).parent, ignore_errors=True)


def _accept(listener: Listener, reader: SnapshotReader) -> None:
    while True:
        try:
            connection = listener.accept()
        except (OSError, EOFError, AuthenticationError):
            time.sleep(0.01)  # a client that left meanwhile or has no key, or no more connections
            continue
        threading.Thread(target=_answer, args=(connection, reader.clone()), daemon=True).start()


def _answer(connection: Connection[Any, Any], reader: SnapshotReader) -> None:
    """Answer one client until it disconnects."""
    with connection, contextlib.suppress(OSError, EOFError):
        while True:
            connection.send_bytes(_reply(connection.recv_bytes(), reader))


def _reply(message: bytes, reader: SnapshotReader) -> bytes:
    try:
        received = reader.read()
        return encode_answer(track(decode_query(message), received.snapshot), received.age_s)
    except (QueryError, NoSnapshotError) as error:
        return encode_error(str(error))
    except Exception as error:  # a defect, or an unforeseen query: the next one is still answered
        return encode_error(f"{type(error).__name__}: {error}")
