"""Helpers for tests of network drivers: waiting, and a peer that is a plain socket."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

T = TypeVar("T")


def wait_for(condition: Callable[[], object], limit_s: float = 5.0) -> None:
    """Wait until the condition holds; fails after the limit."""
    end = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.002)


def collect(poll: Callable[[], Sequence[T]], count: int, limit_s: float = 5.0) -> list[T]:
    """At least ``count`` things from a poll function."""
    found: list[T] = []

    def enough() -> bool:
        found.extend(poll())
        return len(found) >= count

    wait_for(enough, limit_s)
    return found


def serve() -> tuple[socket.socket, int]:
    """A listening socket on a free port of loopback."""
    server = socket.create_server(("127.0.0.1", 0))
    server.settimeout(5.0)
    return server, server.getsockname()[1]


def free_port() -> int:
    """A port where no one listens."""
    server, port = serve()
    server.close()
    return port


def hung_up(peer: socket.socket, limit_s: float = 5.0) -> bool:
    """Whether the other side ends the connection within the limit."""
    peer.settimeout(limit_s)
    try:
        while peer.recv(1 << 16):
            pass
    except TimeoutError:
        return False
    except OSError:
        return True
    return True
