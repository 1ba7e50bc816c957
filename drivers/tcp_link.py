"""TCP to a device in a thread of its own, with bounded memory and time whatever the other side sends.

One class for both ends. As a client it connects, and reconnects after a loss; as a server it accepts a few peers.
Incoming bytes go through a decoder (one for each peer) into a queue that keeps the newest messages. Outgoing data are
one block of bytes per peer at a time; a block that a slow peer has not begun to take is replaced by the newer one. No
peer can end the thread: a broken stream, or a stall within a message or a block, ends only that peer's connection.

Losses are those of peers. A peer is *known* once it has sent a message (where the link only sends: taken a block). The
loss of a known peer is always reported, and peers that are not known do not make up for it: only their first message
does. The loss of another peer is reported if no one else is there. After a loss nothing more is reported until a peer
is there again: one that sends a message, or that stays for STAYED_S where it may be silent. So a peer that accepts and
hangs up at once is lost once, however often it is tried.
"""

from __future__ import annotations

import contextlib
import errno
import os
import selectors
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic

from fgreg.drivers.stream_decoder import Decoder, Item, Rejections, StreamBroken
from fgreg.errors import InputError, one_line

CHUNK_BYTES = 1 << 18
TICK_S = 0.05
"""The thread checks its time limits at least this often."""
RETRY_S, CONNECT_S = 0.5, 2.0
"""Time between two attempts to connect, and the longest time of one."""
MESSAGE_S = 5.0
"""Time after its first byte within which a message has to be complete, or a block taken."""
STAYED_S = 1.0
"""After a loss a peer that may be silent counts as there once it has stayed for this long."""
KEPT_S = 2.0
"""A block that was offered longer ago is not given to a later peer, nor to one that asks: its source has stopped."""
MAX_PEERS = 8
MAX_REPLIES = 16
"""Largest number of replies that wait for one peer; the rest is left out."""
QUEUE_ITEMS, QUEUE_BYTES = 256, 128 << 20


@dataclass(frozen=True, slots=True)
class Endpoint:
    """An address to connect to or to listen at.

    Listening is on loopback unless another address is given; port 0 takes a free port.
    """

    host: str
    port: int
    listen: bool = False

    def __post_init__(self) -> None:
        if not self.host or not self.host.isprintable() or " " in self.host:
            raise InputError("address", repr(self.host), "a host name or an IP address")
        if not (0 if self.listen else 1) <= self.port <= 65535:
            raise InputError("port", str(self.port), "a number from 1 to 65535")

    @classmethod
    def listening(cls, port: int, bind: str = "127.0.0.1") -> Endpoint:
        """A server; ``bind="0.0.0.0"`` lets other machines connect, and the protocols have no passwords."""
        return cls(bind, port, listen=True)

    def __str__(self) -> str:
        return f"{'listening on ' if self.listen else ''}{self.host}:{self.port}"


@dataclass(slots=True, eq=False)
class _Peer(Generic[Item]):
    socket: socket.socket
    decoder: Decoder[Item]
    connecting: bool
    since_s: float  # when connecting began, then when it was established
    heard_s: float = 0.0  # last message, or when it was established
    there: bool = False  # counts as the device being there
    known: bool = False  # has sent a message; where the link only sends: taken a block
    passed_over: bool = False  # was idle when another was lost: only a message makes it count as there
    partial_since_s: float | None = None
    block: memoryview = field(default_factory=lambda: memoryview(b""))  # being sent
    block_since_s: float = 0.0
    replies: deque[bytes] = field(default_factory=deque)
    next_block: bytes | None = None

    @property
    def name(self) -> str:
        return self.decoder.rejections.peer


class TcpLink(Generic[Item]):
    """A connection that is kept alive.

    Args:
        endpoint: the other side, or where to listen.
        decoder: makes a peer's decoder, which counts the messages it leaves out in the given Rejections; their ``peer``
            is the peer's name.
        greeting: sent to every new peer first.
        farewell: sent on close, as far as the peer takes it at once.
        keep_latest: the link only sends: a new peer gets the block that was offered last, unless that is KEPT_S ago.
        silent_s: a peer that sends no message for this long counts as lost; None if it may be silent.
        chunk_bytes: read of a peer before the next one's turn.

    Raises:
        InputError: listening at this address is not possible.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        decoder: Callable[[Rejections], Decoder[Item]],
        *,
        greeting: bytes = b"",
        farewell: bytes = b"",
        keep_latest: bool = False,
        silent_s: float | None = None,
        chunk_bytes: int = CHUNK_BYTES,
    ) -> None:
        self._chunk_bytes = chunk_bytes
        self._decoder, self._greeting, self._farewell = decoder, greeting, farewell
        self._keep_latest, self._silent_s = keep_latest, silent_s
        self._endpoint = endpoint
        self.rejections = Rejections()
        self._lock = threading.Lock()
        self._items: deque[Item] = deque()
        self._bytes = 0
        self._dropped = 0
        self._latest: bytes | None = None
        self._latest_s = 0.0
        self._offered: bytes | None = None
        self._losses: deque[str] = deque(maxlen=MAX_PEERS)
        self._there = False
        # The rest is the thread's own.
        self._peers: list[_Peer[Item]] = []
        self._gone = False  # a loss was reported, and no one has been there since
        self._next_try_s = 0.0
        self._server = self._listen() if endpoint.listen else None
        self._selector = selectors.DefaultSelector()
        self._wake, self._woken = socket.socketpair()
        for end in (self._wake, self._woken):
            end.setblocking(False)
        self._selector.register(self._woken, selectors.EVENT_READ)
        if self._server is not None:
            self._selector.register(self._server, selectors.EVENT_READ)
        self._stop = False
        self._thread = threading.Thread(target=self._run, name=f"tcp {endpoint}", daemon=True)
        self._thread.start()

    @property
    def endpoint(self) -> Endpoint:
        """As given, with the actual port."""
        return self._endpoint

    @property
    def connected(self) -> bool:
        """Whether the other end is connected and not silent."""
        return self._there

    @property
    def dropped(self) -> int:
        """Number of messages not fetched in time and of blocks not taken in time."""
        return self._dropped

    def poll(self) -> list[Item]:
        """Messages since the last call, oldest first; never waits."""
        with self._lock:
            items = list(self._items)
            self._items.clear()
            self._bytes = 0
        return items

    def take_loss(self) -> str | None:
        """Why a peer was lost, once for each loss, oldest first; None if there was no other since the last call."""
        with self._lock:
            return self._losses.popleft() if self._losses else None

    def offer(self, block: bytes, latest: bytes | None = None) -> None:
        """Queue a block for every peer; never waits. ``latest``: what a later peer gets instead of it."""
        with self._lock:
            self._offered = block
            if self._keep_latest:
                self._latest, self._latest_s = block if latest is None else latest, time.monotonic()
        self._wake_up()

    def close(self) -> None:
        """End the thread and all connections."""
        self._stop = True
        self._wake_up()
        self._thread.join(timeout=2.0 * CONNECT_S)

    def _wake_up(self) -> None:
        with contextlib.suppress(OSError):  # full: it wakes up anyway; closed: the thread has ended
            self._wake.send(b"\0")

    # What follows runs in the thread, but for _listen.

    def _listen(self) -> socket.socket:
        where = self._endpoint
        try:
            family = socket.getaddrinfo(where.host, where.port, type=socket.SOCK_STREAM)[0][0]
            server = socket.create_server((where.host, where.port), family=family, backlog=64)
        except OSError as error:
            raise InputError(str(where), _text(error), "a free port of an address of this machine") from error
        server.setblocking(False)
        self._endpoint = Endpoint(where.host, server.getsockname()[1], listen=True)
        return server

    def _run(self) -> None:
        try:
            while not self._stop:
                now = time.monotonic()
                if self._server is None and not self._peers and now >= self._next_try_s:
                    self._connect(now)
                for key, events in self._selector.select(TICK_S):
                    if key.fileobj is self._woken:
                        with contextlib.suppress(OSError):
                            self._woken.recv(4096)
                    elif key.fileobj is self._server:
                        self._accept()
                    else:
                        self._serve(key.data, events)
                self._distribute()
                self._expire(time.monotonic())
        finally:
            self._shut()

    def _connect(self, now: float) -> None:
        self._next_try_s = now + RETRY_S
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(
                self._endpoint.host, self._endpoint.port, type=socket.SOCK_STREAM
            )[0]
            connection = socket.socket(family, kind, protocol)
        except OSError as error:
            self._report(f"{self._endpoint}: {_text(error)}")
            return
        connection.setblocking(False)
        result = connection.connect_ex(address)
        peer = self._new_peer(connection, str(self._endpoint), connecting=True)
        if result not in (0, errno.EINPROGRESS):
            self._hang_up(peer, os.strerror(result))

    def _accept(self) -> None:
        assert self._server is not None
        try:
            connection, address = self._server.accept()
        except OSError:
            time.sleep(TICK_S)  # gone before it was taken in, or no room for more files: not at full speed then
            return
        name = f"{address[0]}:{address[1]}"
        if len(self._peers) >= MAX_PEERS:
            idle = [peer for peer in self._peers if not peer.known]
            if not idle:
                self.rejections.add(f"{name}: turned away, since {MAX_PEERS} peers are in use")
                connection.close()
                return
            self.rejections.add(f"{idle[0].name}: was idle and made room for {name}")
            self._hang_up(idle[0], f"was idle and made room for {name}")
        connection.setblocking(False)
        peer = self._new_peer(connection, name, connecting=False)
        try:
            self._greet(peer)
        except OSError as error:
            self._hang_up(peer, _text(error))

    def _new_peer(self, connection: socket.socket, name: str, connecting: bool) -> _Peer[Item]:
        decoder = self._decoder(Rejections(peer=name, link=self.rejections))
        peer = _Peer(connection, decoder, connecting, time.monotonic())
        self._peers.append(peer)
        self._selector.register(connection, selectors.EVENT_READ | selectors.EVENT_WRITE, peer)
        return peer

    def _greet(self, peer: _Peer[Item]) -> None:
        """The connection is established."""
        peer.connecting = False
        with contextlib.suppress(OSError):
            peer.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            peer.socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for option, value in (("TCP_KEEPIDLE", 1), ("TCP_KEEPINTVL", 1), ("TCP_KEEPCNT", 3)):
                if hasattr(socket, option):  # a pulled cable shows after 4 s
                    peer.socket.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
            if self._keep_latest and hasattr(
                socket, "TCP_NOTSENT_LOWAT"
            ):  # else old blocks wait in the system's buffer
                peer.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, CHUNK_BYTES)
        with self._lock:
            fresh = self._offered is None and time.monotonic() - self._latest_s <= KEPT_S
            latest = self._latest if fresh else None  # what is offered now is about to be sent to all
        peer.since_s = peer.heard_s = time.monotonic()
        if not self._gone:
            self._is_there(peer)
        first = self._greeting + (latest or b"")
        if first:
            peer.next_block = first
        self._write(peer)

    def _serve(self, peer: _Peer[Item], events: int) -> None:
        if peer not in self._peers:
            return  # hung up by an event before this one
        try:
            if peer.connecting:
                failed = peer.socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
                if failed:
                    raise StreamBroken(os.strerror(failed))
                if peer.socket.getsockname() == peer.socket.getpeername():
                    raise StreamBroken("no one listens there")  # the system connected the socket to itself
                self._greet(peer)
                return
            if events & selectors.EVENT_READ:
                self._read(peer)
            if peer.replies or events & selectors.EVENT_WRITE:
                self._write(peer)
        except (OSError, StreamBroken) as error:
            self._hang_up(peer, _text(error))
        except Exception as error:  # a decoder that fails on hostile bytes must not take the others with it
            peer.decoder.rejections.add(repr(error))
            self._hang_up(peer, repr(error))

    def _read(self, peer: _Peer[Item]) -> None:
        try:
            data = peer.socket.recv(self._chunk_bytes)
        except BlockingIOError:
            return
        if not data:
            inside = " in the middle of a message" if peer.decoder.partial else ""
            raise StreamBroken(f"the other side hung up{inside}")
        now, before = time.monotonic(), peer.decoder.completed
        try:
            items = peer.decoder.feed(data, now)
        except StreamBroken as error:
            peer.decoder.rejections.add(str(error))
            raise
        if not peer.decoder.partial:
            peer.partial_since_s = None
        elif peer.decoder.completed > before or peer.partial_since_s is None:
            peer.partial_since_s = now
        for reply in peer.decoder.replies:
            if len(peer.replies) < MAX_REPLIES:
                peer.replies.append(reply)
            else:
                peer.decoder.rejections.add(f"asks while {MAX_REPLIES} answers wait for it")
        peer.decoder.replies.clear()
        if items:
            peer.heard_s, peer.known = now, True
            self._is_there(peer)
            self._take_in(items)

    def _take_in(self, items: list[Item]) -> None:
        with self._lock:
            for item in items:
                self._items.append(item)
                self._bytes += item.nbytes
            while len(self._items) > QUEUE_ITEMS or (self._bytes > QUEUE_BYTES and len(self._items) > 1):
                self._bytes -= self._items.popleft().nbytes
                self._dropped += 1

    def _write(self, peer: _Peer[Item]) -> None:
        while True:
            if not peer.block:
                if peer.replies:
                    peer.block = memoryview(peer.replies.popleft())
                elif peer.next_block is not None:
                    peer.block, peer.next_block = memoryview(peer.next_block), None
                else:
                    self._selector.modify(peer.socket, selectors.EVENT_READ, peer)
                    return
                peer.block_since_s = time.monotonic()
            try:
                sent = peer.socket.send(peer.block)
            except BlockingIOError:
                self._selector.modify(peer.socket, selectors.EVENT_READ | selectors.EVENT_WRITE, peer)
                return
            peer.block = peer.block[sent:]
            peer.known |= self._keep_latest and not peer.block

    def _distribute(self) -> None:
        with self._lock:
            block, self._offered = self._offered, None
        if block is None:
            return
        for peer in list(self._peers):
            if peer.connecting:
                continue
            self._dropped += peer.next_block is not None
            peer.next_block = block
            try:
                self._write(peer)
            except OSError as error:
                self._hang_up(peer, _text(error))

    def _expire(self, now: float) -> None:
        for peer in list(self._peers):
            if peer.connecting:
                if now - peer.since_s > CONNECT_S:
                    self._hang_up(peer, f"no answer for {CONNECT_S:g} s")
            elif peer.partial_since_s is not None and now - peer.partial_since_s > MESSAGE_S:
                self._hang_up(peer, f"a message was not complete after {MESSAGE_S:g} s")
            elif peer.block and now - peer.block_since_s > MESSAGE_S:
                self._hang_up(peer, f"did not take what was sent for {MESSAGE_S:g} s")
            elif peer.there and self._silent_s is not None and now - peer.heard_s > self._silent_s:
                peer.there = False
                self._lost(peer, f"nothing received for {self._silent_s:g} s{peer.decoder.instead}")
            elif not (peer.there or peer.passed_over) and self._silent_s is None and now - peer.since_s > STAYED_S:
                self._is_there(peer)

    def _hang_up(self, peer: _Peer[Item], reason: str) -> None:
        self._peers.remove(peer)
        self._selector.unregister(peer.socket)
        peer.socket.close()
        if peer.there:
            self._lost(peer, reason)
        elif self._server is None:
            self._report(f"{peer.name}: {reason}")

    def _is_there(self, peer: _Peer[Item]) -> None:
        peer.there = self._there = True
        self._gone = False

    def _lost(self, peer: _Peer[Item], reason: str) -> None:
        """A peer that was there is gone or silent."""
        others = [other for other in self._peers if other.there and other is not peer]
        if peer.known and not self._keep_latest:
            for other in others:
                other.there, other.passed_over = other.known, not other.known
            others = [other for other in others if other.there]
        self._there = bool(others)
        if peer.known or not others:
            self._report(f"{peer.name}: {reason}")

    def _report(self, loss: str) -> None:
        """Report a loss, once until someone is there again, however many attempts to connect fail after it.

        A client also reports that it could not connect in the first place; a server waits for its first peer.
        """
        if not self._gone:
            with self._lock:
                self._losses.append(one_line(loss, 200))
        self._gone = not self._there

    def _shut(self) -> None:
        for peer in self._peers:
            with contextlib.suppress(OSError):
                if self._farewell and not peer.connecting and not peer.block:
                    peer.socket.send(self._farewell)
                    peer.socket.shutdown(socket.SHUT_WR)
                    while peer.socket.recv(CHUNK_BYTES):  # closed with bytes unread, it would take the farewell along
                        pass
            peer.socket.close()
        self._there = False
        for end in (self._server, self._wake, self._woken):
            if end is not None:
                end.close()
        self._selector.close()


def _text(error: Exception) -> str:
    """The error's text, without its number."""
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)
