"""A link to a device outlives whatever the other side does, in bounded memory and time."""

from __future__ import annotations

import re
import socket
import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from fgreg.drivers import tcp_link
from fgreg.drivers.stream_decoder import Decoder, Rejections, StreamBroken
from fgreg.drivers.tcp_link import Endpoint, TcpLink
from fgreg.errors import InputError
from tests.network_peers import collect, free_port, hung_up, serve, wait_for


@dataclass(frozen=True)
class Line:
    text: bytes

    @property
    def nbytes(self) -> int:
        return len(self.text)


class Lines(Decoder[Line]):
    """Lines; one that says ``broken`` or ``bug`` raises, ``?`` is answered, and those with ``-`` are not taken."""

    def __init__(self, rejections: Rejections) -> None:
        super().__init__(rejections)
        self._rest = b""

    @property
    def partial(self) -> bool:
        return bool(self._rest)

    def feed(self, data: bytes, host_s: float) -> list[Line]:
        assert host_s <= time.monotonic()
        *lines, self._rest = (self._rest + data).split(b"\n")
        if b"broken" in lines:
            raise StreamBroken("a broken line")
        if b"bug" in lines:
            raise KeyError("a defect of the decoder")
        self.completed += len(lines)
        self.replies += [b"!\n" for line in lines if line == b"?"]
        return [Line(line) for line in lines if line[:1] not in (b"-", b"?")]


@pytest.fixture
def server() -> Iterator[TcpLink[Line]]:
    link = TcpLink(Endpoint.listening(0), Lines)
    yield link
    link.close()


def connect(link: TcpLink[Line]) -> socket.socket:
    return socket.create_connection(("127.0.0.1", link.endpoint.port))


def test_a_server_is_on_loopback_unless_set_otherwise(server: TcpLink[Line]) -> None:
    assert server.endpoint.host == "127.0.0.1"
    with pytest.raises(OSError, match=r"refused|unreachable"):
        socket.create_connection(("127.0.0.2", server.endpoint.port), timeout=1.0)


def test_a_taken_port_and_a_bad_address_are_one_line(server: TcpLink[Line]) -> None:
    with pytest.raises(InputError, match=r"listening on 127\.0\.0\.1:\d+: found .*in use"):
        TcpLink(server.endpoint, Lines)
    with pytest.raises(InputError, match="found 70000, expected a number"):
        Endpoint("127.0.0.1", 70000)
    with pytest.raises(InputError, match="expected a host name"):
        Endpoint("", 18944)


def test_a_client_without_a_peer_reports_it_once_and_connects_when_there_is_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tcp_link, "RETRY_S", 0.05)
    port = free_port()
    link = TcpLink(Endpoint("127.0.0.1", port), Lines)
    try:
        losses: list[str] = []

        def said() -> bool:
            loss = link.take_loss()
            losses.extend([loss] if loss else [])
            return bool(losses)

        wait_for(said)
        assert losses == [f"127.0.0.1:{port}: Connection refused"]
        time.sleep(2.5 * tcp_link.RETRY_S)
        assert link.take_loss() is None
        assert not link.connected
        with socket.create_server(("127.0.0.1", port)) as device:
            peer, _ = device.accept()
            with peer:
                peer.sendall(b"hello\n")
                assert collect(link.poll, 1) == [Line(b"hello")]
                assert link.connected
    finally:
        link.close()


def test_a_device_that_restarts_is_lost_once_and_found_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp_link, "RETRY_S", 0.05)
    device, port = serve()
    link = TcpLink(Endpoint("127.0.0.1", port), Lines)
    try:
        with device:
            for round_number in range(3):
                peer, _ = device.accept()
                peer.sendall(b"%d\ncut off" % round_number)
                assert collect(link.poll, 1) == [Line(b"%d" % round_number)]
                peer.close()
                wait_for(lambda: not link.connected)
                assert link.take_loss() == f"127.0.0.1:{port}: the other side hung up in the middle of a message"
                assert link.take_loss() is None
    finally:
        link.close()


def test_a_broken_stream_or_a_failing_decoder_ends_that_peer_only(server: TcpLink[Line]) -> None:
    with connect(server) as good, connect(server) as bad, connect(server) as worse:
        bad.sendall(b"broken\n")
        worse.sendall(b"bug\n")
        assert hung_up(bad)
        assert hung_up(worse)
        assert server.rejections.count == 2
        assert re.fullmatch(r"127\.0\.0\.1:\d+: (KeyError.*a defect.*|a broken line)", server.rejections.last)
        good.sendall(b"still here\n")
        assert collect(server.poll, 1) == [Line(b"still here")]
        assert server.connected


def test_a_sender_that_trickles_is_hung_up(server: TcpLink[Line], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp_link, "MESSAGE_S", 0.3)
    with connect(server) as slow, connect(server) as good:
        done = threading.Event()

        def trickle() -> None:
            try:
                while not done.wait(0.02):
                    slow.sendall(b"x")
            except OSError:
                pass

        thread = threading.Thread(target=trickle)
        thread.start()
        assert hung_up(slow, 2.0)
        done.set()
        thread.join()
        for _ in range(20):  # as slow, but each message is complete in time
            good.sendall(b"line\n")
            time.sleep(0.02)
        assert len(collect(server.poll, 20)) == 20


def test_a_receiver_that_does_not_read_gets_the_newest_and_then_nothing(
    server: TcpLink[Line], monkeypatch: pytest.MonkeyPatch
) -> None:
    with connect(server) as lazy:
        wait_for(lambda: server.connected)
        blocks = [bytes([65 + number]) * (4 << 20) for number in range(10)]
        for block in blocks:  # never waits, or the test would hang here
            server.offer(block)
            time.sleep(0.02)
        wait_for(lambda: server.dropped >= 6)
        received = bytearray()
        lazy.settimeout(2.0)
        while received[-1:] != b"J" or len(received) % (4 << 20):
            received += lazy.recv(1 << 20)
        whole = [bytes(received[start : start + (4 << 20)]) for start in range(0, len(received), 4 << 20)]
        assert all(block in blocks for block in whole)
        assert whole[-1] == blocks[-1]
        assert len(whole) + server.dropped == len(blocks)
        monkeypatch.setattr(tcp_link, "MESSAGE_S", 0.2)
        server.offer(bytes(64 << 20))
        wait_for(lambda: not server.connected)
    assert "did not take what was sent" in str(server.take_loss())


def test_messages_not_fetched_are_dropped_oldest_first_and_counted(
    server: TcpLink[Line], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tcp_link, "QUEUE_ITEMS", 10)
    with connect(server) as peer:
        peer.sendall(b"".join(b"%d\n" % number for number in range(100)))
        wait_for(lambda: server.dropped == 90)
        assert server.poll() == [Line(b"%d" % number) for number in range(90, 100)]
        monkeypatch.setattr(tcp_link, "QUEUE_BYTES", 250)
        peer.sendall(b"".join(b"%d" % number * 100 + b"\n" for number in range(5)))
        wait_for(lambda: server.dropped == 93)
        assert [line.text[:1] for line in server.poll()] == [b"3", b"4"]


def test_a_silent_device_is_lost_once_and_back_with_its_next_message() -> None:
    link = TcpLink(Endpoint.listening(0), Lines, silent_s=0.2)
    try:
        assert link.take_loss() is None
        with connect(link) as peer:
            peer.sendall(b"a\n")
            collect(link.poll, 1)
            wait_for(lambda: not link.connected)
            assert "nothing received for 0.2 s" in str(link.take_loss())
            time.sleep(0.3)
            assert link.take_loss() is None
            peer.sendall(b"b\n")
            assert collect(link.poll, 1) == [Line(b"b")]
            assert link.connected
    finally:
        link.close()


def test_an_idle_peer_neither_hides_a_loss_nor_makes_up_for_it(
    server: TcpLink[Line], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tcp_link, "STAYED_S", 0.05)
    with connect(server) as idle:
        sender = connect(server)
        sender.sendall(b"a\n")
        collect(server.poll, 1)
        name = "{}:{}".format(*sender.getsockname())
        sender.close()
        wait_for(lambda: not server.connected)
        assert server.take_loss() == f"{name}: the other side hung up"
        time.sleep(0.15)
        assert not server.connected
        idle.sendall(b"b\n")
        assert collect(server.poll, 1) == [Line(b"b")]
        assert server.connected
    wait_for(lambda: not server.connected)
    assert "hung up" in str(server.take_loss())
    with connect(server):  # a new one that may be silent counts once it has stayed
        wait_for(lambda: server.connected)


def test_a_peer_that_accepts_and_hangs_up_at_once_is_lost_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp_link, "RETRY_S", 0.02)
    device, port = serve()
    link = TcpLink(Endpoint("127.0.0.1", port), Lines)
    try:
        with device:
            for _ in range(5):
                device.accept()[0].close()
            peer, _ = device.accept()
            wait_for(lambda: not link.connected)
            assert link.take_loss() == f"127.0.0.1:{port}: the other side hung up"
            with peer:
                assert link.take_loss() is None
                peer.sendall(b"a\n")
                assert collect(link.poll, 1) == [Line(b"a")]
                assert link.connected
            wait_for(lambda: not link.connected)
            assert link.take_loss() is not None  # it had been there
    finally:
        link.close()


def test_a_stream_of_messages_that_are_not_taken_is_healthy(
    server: TcpLink[Line], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tcp_link, "MESSAGE_S", 0.1)
    with connect(server) as peer:
        for _ in range(30):  # the next one has always begun
            peer.sendall(b"- not taken\n- not ")
            peer.sendall(b"taken\n- not")
            time.sleep(0.01)
        peer.sendall(b"\nx\n")
        assert collect(server.poll, 1) == [Line(b"x")]


def test_a_question_is_answered_to_who_asked_while_it_goes_on_sending(server: TcpLink[Line]) -> None:
    with connect(server) as asks, connect(server) as other:
        asks.sendall(b"?\n" * 3)
        answers = b""
        while len(answers) < 6:
            answers += asks.recv(100)
        assert answers == b"!\n" * 3
        other.settimeout(0.05)
        with pytest.raises(TimeoutError):
            other.recv(100)
        asks.sendall(b"?\n" * 40)
        wait_for(lambda: server.rejections.count == 40 - tcp_link.MAX_REPLIES)


def test_a_late_receiver_gets_what_was_offered_last_unless_that_is_old(monkeypatch: pytest.MonkeyPatch) -> None:
    link = TcpLink(Endpoint.listening(0), Lines, greeting=b"hello ", keep_latest=True)
    try:
        link.offer(b"old")
        link.offer(b"new")
        with connect(link) as peer:
            heard = b""
            while len(heard) < 9 and (more := peer.recv(100)):
                heard += more
            assert heard == b"hello new"
        monkeypatch.setattr(tcp_link, "KEPT_S", -1.0)
        with connect(link) as peer:
            assert peer.recv(100) == b"hello "
            link.close()
            assert peer.recv(100) == b""
    finally:
        link.close()


def test_idle_peers_make_room_and_those_in_use_do_not(server: TcpLink[Line]) -> None:
    peers = [connect(server) for _ in range(tcp_link.MAX_PEERS)]
    try:
        for peer in peers[1:]:
            peer.sendall(b"x\n")
        collect(server.poll, len(peers) - 1)
        with connect(server) as one_more:
            one_more.sendall(b"y\n")
            assert collect(server.poll, 1) == [Line(b"y")]
            assert hung_up(peers[0])
            with connect(server) as too_many:
                assert hung_up(too_many)
                turned_away = f"127.0.0.1:{too_many.getsockname()[1]}: turned away, since 8 peers are in use"
            assert server.rejections.last == turned_away
            assert server.take_loss() is None
        peers[1].sendall(b"x\n")
        assert collect(server.poll, 1) == [Line(b"x")]
    finally:
        for peer in peers:
            peer.close()


def test_peers_that_reset_at_once_do_not_end_the_server() -> None:
    link = TcpLink(Endpoint.listening(0), Lines, keep_latest=True)
    try:
        link.offer(bytes(1 << 20))
        for _ in range(50):
            peer = connect(link)
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            peer.close()
        with connect(link) as good:
            good.sendall(b"x\n")
            assert collect(link.poll, 1) == [Line(b"x")]
    finally:
        link.close()


def test_close_may_be_repeated_and_leaves_no_thread() -> None:
    before = threading.active_count()
    link = TcpLink(Endpoint("127.0.0.1", free_port()), Lines)
    link.close()
    link.close()
    link.offer(b"x")
    assert link.poll() == []
    assert threading.active_count() == before
