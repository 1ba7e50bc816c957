"""Our own drivers pass the conformance kit, and the kit finds a driver that breaks a rule."""

from __future__ import annotations

import math
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fgreg.drivers import simulated, tcp_link
from fgreg.drivers.base import DeviceLost, PaFrame, Registration, host_now
from fgreg.drivers.bk_oem import BkOemScanner
from fgreg.drivers.endoscope import Endoscope, EndoscopeConfig, InputConfig
from fgreg.drivers.igtl import IgtlBmode, IgtlMotion, IgtlPhotoacoustic, IgtlTransformSink
from fgreg.drivers.igtl_overlay import IgtlPictureSink
from fgreg.drivers.operators import IgtlOperator
from fgreg.drivers.recorded_devices import Pace, RecordedMotion
from fgreg.drivers.simulated_stage import SimulatedStage
from fgreg.drivers.simulated_wire import WireClosed, receive, send
from fgreg.drivers.tcp_link import Endpoint
from fgreg.drivers.thorlabs_stage import open_stage
from fgreg.model.session_model import StageModel
from fgreg.model.time_sync import Stamp
from fgreg.simulation.config import default_stage
from fgreg.testing import drivers as kit
from fgreg.testing.drivers import Bench, NotConforming, check_driver
from tests.bk_emulator import Scanner, grabbed
from tests.cube_emulator import CubeEmulator
from tests.igtl_bytes import image_body, message, transform_body


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drivers look for their devices more often than outside of tests, and the kit listens for less time."""
    monkeypatch.setattr(tcp_link, "RETRY_S", 0.005)
    monkeypatch.setattr(simulated, "AGAIN_S", 0.01)
    monkeypatch.setattr(kit, "QUIET_S", 0.02)


class Server:
    """The other end of drivers that connect; at a socket file where one is named."""

    def __init__(self, file: Path | None = None) -> None:
        self._file, self._port, self.number = file, 0, 0
        self._peers: list[socket.socket] = []
        self.restore()

    @property
    def endpoint(self) -> Endpoint:
        return Endpoint("127.0.0.1", self._port)

    def restore(self) -> None:
        """Listen, at the same place as before."""
        if self._file is None:
            self._server = socket.create_server(("127.0.0.1", self._port))
            self._port = self._server.getsockname()[1]
        else:
            self._file.unlink(missing_ok=True)
            self._server = socket.socket(socket.AF_UNIX)
            self._server.bind(str(self._file))
            self._server.listen()
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def lose(self) -> None:
        """Hang up, and listen no more."""
        with suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._server.close()
        for peer in self._peers:
            with suppress(OSError):
                peer.shutdown(socket.SHUT_RDWR)
            peer.close()
        self._peers.clear()

    def _accept(self) -> None:
        with suppress(OSError, WireClosed):
            while True:
                peer, _ = self._server.accept()
                if self._file is not None:
                    receive(peer)  # which device of the room it is
                self._peers.append(peer)

    def each(self, what: Callable[[socket.socket], object]) -> None:
        """Call with all who are connected; those who are gone are forgotten."""
        for peer in self._peers[:]:
            try:
                what(peer)
            except (OSError, WireClosed):
                peer.close()
                self._peers.remove(peer)

    def send(self, data: bytes) -> None:
        """Send bytes to all."""
        self.each(lambda peer: peer.sendall(data))

    def numbered(self, make: Callable[[int], bytes]) -> Callable[[], None]:
        """Sends the next of what ``make`` makes of a number."""

        def send_next() -> None:
            self.number += 1
            self.send(make(self.number))

        return send_next


@pytest.fixture
def server() -> Iterator[Server]:
    made = Server()
    yield made
    made.lose()


PIXELS = np.arange(24, dtype=np.uint8).reshape(1, 4, 6)
MATRIX = np.array([[1.0, 0, 0, 10], [0, 0, -1, -20], [0, 1, 0, 150], [0, 0, 0, 1]])
HUGE = struct.pack(">H12s20sIIQQ", 1, b"IMAGE", b"Device", 0, 0, 1 << 62, 0)
IGTL: dict[str, tuple[Callable[[Endpoint], Any], Callable[[int], bytes], list[bytes]]] = {
    "photoacoustic": (
        lambda endpoint: IgtlPhotoacoustic(endpoint, "Device"),
        lambda number: message("IMAGE", "Device", image_body(PIXELS.astype(np.int16)), sent_s=100.0 + number / 30),
        [message("IMAGE", "Device", image_body(np.zeros((2, 4, 6), np.int16)))],
    ),
    "bmode": (
        lambda endpoint: IgtlBmode(endpoint, "Device"),
        lambda _number: message("IMAGE", "Device", image_body(PIXELS)),
        [message("IMAGE", "Device", image_body(PIXELS.astype(np.float32)))],
    ),
    "motion": (
        lambda endpoint: IgtlMotion(endpoint, "Device"),
        lambda number: message("TRANSFORM", "Device", transform_body(MATRIX), sent_s=100.0 + number / 30),
        [
            message("TRANSFORM", "Device", transform_body(np.diag([1.0, 1.0, 2.0, 1.0]))),
            message("TRANSFORM", "Device", transform_body(MATRIX * np.nan)),
        ],
    ),
    "operator": (
        lambda endpoint: IgtlOperator(endpoint, "Device"),
        lambda _number: message("STRING", "Device", struct.pack(">HH", 3, 4) + b"next"),
        [message("STRING", "Device", struct.pack(">HH", 3, 90) + b"ho"), message("STRING", "Device", b"\xff" * 9)],
    ),
}


@pytest.mark.parametrize("role", IGTL)
def test_openigtlink(role: str, server: Server) -> None:
    pytest.importorskip("pyigtl", reason="pyigtl is not installed: pip install 'fgreg[igtl]'")
    make, item, bad = IGTL[role]
    hostile = [HUGE, b"SSH-2.0-OpenSSH_9.2\r\n" * 4, np.random.default_rng(3).bytes(5000), item(0)[:-7] + item(0)]
    bench = Bench(
        lambda: make(server.endpoint),
        server.numbered(item),
        server.lose,
        server.restore,
        [lambda data=data: server.send(data) for data in [*bad, *hostile]],  # type: ignore[misc]
    )
    check_driver(role, bench)


@pytest.mark.parametrize(
    ("role", "make", "header"),
    [
        ("sinks", IgtlTransformSink, b"TRANSFORM\0\0\0CameraToTrus"),
        ("overlay", IgtlPictureSink, b"IMAGE\0\0\0\0\0\0\0Overlay"),
    ],
)
def test_an_openigtlink_sink(role: str, make: Callable[[Endpoint], Any], header: bytes, server: Server) -> None:
    pytest.importorskip("pyigtl", reason="pyigtl is not installed: pip install 'fgreg[igtl]'")
    read = bytearray()

    def received() -> int:
        def take(peer: socket.socket) -> None:
            peer.setblocking(False)
            with suppress(BlockingIOError):
                read.extend(peer.recv(1 << 20))

        server.each(take)
        return read.count(header)

    bench = Bench(lambda: make(server.endpoint), lose=server.lose, restore=server.restore, received=received)
    check_driver(role, bench)


SIMULATED: dict[str, tuple[Callable[[Path], Any], dict[str, Any], bytes]] = {
    "camera": (simulated.SimulatedCamera, {"shape": [4, 6]}, bytes(48)),
    "photoacoustic": (simulated.SimulatedProbe, {"shape": [4, 6]}, bytes(48)),
    "motion": (simulated.SimulatedMotion, {"pose": MATRIX.tolist()}, b""),
    "operator": (simulated.SimulatedOperator, {"says": "home"}, b""),
}


@pytest.mark.parametrize("role", SIMULATED)
def test_devices_of_the_simulated_room(role: str, tmp_path: Path) -> None:
    make, header, payload = SIMULATED[role]
    room = Server(tmp_path / "socket")

    def item() -> None:
        room.number += 1
        more = {"index": room.number, "device_s": room.number / 30}
        room.each(lambda peer: send(peer, {**header, **(more if role != "operator" else {})}, payload))

    wrong = {"index": "one", "shape": [7, 7, 7], "pose": [1.0], "says": "go", "device_s": None}
    bad = [lambda: room.each(lambda peer: send(peer, wrong, b"x")), lambda: room.send(b"\xff" * 64)]
    try:
        check_driver(role, Bench(lambda: make(tmp_path / "socket"), item, room.lose, room.restore, bad))
    finally:
        room.lose()


def test_a_recording(tmp_path: Path) -> None:
    bags = pytest.importorskip("tests.bags")
    messages = [("/ECM/measured_cp", t / 50, bags.pose_stamped(t / 50, (0.0, 0.0, 0.1))) for t in range(10)]
    messages.insert(4, ("/ECM/measured_cp", 0.07, bags.pose_stamped(0.07, (0, math.nan, 0))))
    path = bags.write_bag(tmp_path / "bag", messages)
    check_driver("motion", Bench(lambda: RecordedMotion(path, pace=Pace.of(path, 1.0))))


def test_a_bk_scanner(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp_link, "RETRY_S", 0.1)  # the emulator answers at once after it was switched off
    scanner = Scanner()
    picture = grabbed(PIXELS[0])

    def item() -> None:
        if scanner.grabbing:
            scanner.send(picture)

    bad = [lambda: scanner.send_raw(b"garbage"), lambda: scanner.send(picture[:-9])]
    try:
        bench = Bench(
            lambda: BkOemScanner(Endpoint("127.0.0.1", scanner.port)), item, scanner.hang_up, lambda: None, bad
        )
        check_driver("bmode", bench)
    finally:
        scanner.close()


def test_an_endoscope_of_a_played_folder(tmp_path: Path) -> None:
    for number in range(15):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((48, 64), number, np.uint8))
    (tmp_path / "7.png").write_bytes(b"no picture")
    config = EndoscopeConfig(InputConfig(str(tmp_path), fps=75.0))
    check_driver("camera", Bench(lambda: Endoscope(config)))


# The other way round, zero at 10 deg.
MODEL = StageModel(math.radians(2.0), (math.radians(-50.0), math.radians(70.0)), -1, math.radians(10.0))


def test_a_thorlabs_stage() -> None:
    pytest.importorskip("serial", reason="pyserial is not installed: pip install 'fgreg[stage]'")
    cubes = [CubeEmulator(device_deg=6.0)]

    def spoil(**what: Any) -> Callable[[], None]:
        return lambda: vars(cubes[-1]).update(what)

    bad = [spoil(garbage=b"\x91\x04\x0e\x00\x81\x50\x01"), spoil(garbage=b"\xff" * 37), spoil(drop=1), spoil(drop=0)]
    try:
        bench = Bench(
            lambda: open_stage(MODEL, port=cubes[-1].port),
            lose=lambda: cubes[-1].close(),
            restore=lambda: cubes.append(CubeEmulator()),
            bad=bad,
        )
        check_driver("stage", bench)
        assert cubes[0].complaints == cubes[1].complaints == []
    finally:
        cubes[-1].close()


def test_the_simulated_stage() -> None:
    made: list[SimulatedStage] = []

    def make() -> SimulatedStage:
        made.append(SimulatedStage(default_stage(), device_rad=0.2))
        return made[-1]

    def unplug() -> None:
        made[-1].wrong.lost = True

    check_driver("stage", Bench(make, lose=unplug, restore=lambda: None))


@dataclass
class Faulty:
    """A photoacoustic source with one fault, and the other end of its device."""

    fault: str = ""
    name: str = "faulty"
    connected: bool = True
    dropped: int = 0
    waiting: list[PaFrame] = field(default_factory=list)
    loss: bool = False
    calls: int = 0
    data: Any = field(default_factory=lambda: np.zeros((4, 6), np.int16))

    def send(self) -> None:
        if self.connected:
            self.calls += 1
            now, steps = host_now(), self.calls
            late = {"wall clock": time.time(), "host times run back": now - 0.01 * (steps % 2)}.get(self.fault, now)
            device_s = -steps if self.fault == "device times run back" else steps
            index = 0 if self.fault == "index" else steps
            if self.fault == "changed after":
                self.data[:] = steps
            data = self.data if self.fault == "changed after" else self.data.copy()
            self.waiting.append(PaFrame(Stamp(float(device_s), late), data, index))

    def bad(self) -> None:
        if self.fault == "KeyError":
            self.waiting.append(None)  # type: ignore[arg-type]

    def lose(self) -> None:
        self.connected, self.loss = self.fault == "connected is True", self.fault != "no loss"

    def restore(self) -> None:
        self.connected = self.fault != "no data after"

    def poll(self) -> list[PaFrame]:
        if self.fault == "calls wait":
            time.sleep(0.02)
        if self.loss:
            self.loss = self.fault == "raised 2 times"
            if self.loss:
                self.fault = "raised 2 times, as it was"
            raise DeviceLost("unplugged")
        found, self.waiting = self.waiting, []
        if None in found:
            raise KeyError("bad data")
        return found

    def close(self) -> None:
        """Nothing held."""


FAULTS = {
    "": "",
    "wall clock": "a host time",
    "host times run back": "",
    "device times run back": "",
    "index": "index 0 after 0",
    "changed after": "",
    "KeyError": "raised KeyError: 'bad data'",
    "connected is True": "",
    "no loss": "no loss was raised within 0.1 s",
    "raised 2 times": "a loss was raised 2 times",
    "no data after": "no data after the device was there again: 0 items within 0.1 s",
    "calls wait": "",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_the_kit_says_which_rule_is_broken(fault: str) -> None:
    source = Faulty(fault)
    lost_s, back_s = (0.1 if fault == "no loss" else 1.0), (0.1 if fault == "no data after" else 5.0)
    bench = Bench(lambda: source, source.send, source.lose, source.restore, [source.bad], lost_s=lost_s, back_s=back_s)
    if not fault:
        check_driver("photoacoustic", bench)
        return
    with pytest.raises(NotConforming, match=FAULTS[fault] or fault):
        check_driver("photoacoustic", bench)


def test_the_kit_finds_a_refused_registration_that_is_sent_and_a_stage_that_turns_by_itself() -> None:
    @dataclass
    class Careless(Faulty):
        sent: int = 0

        def send(self, _registration: Registration | None = None) -> None:
            self.sent += 1

    sink = Careless()
    with pytest.raises(NotConforming, match="a refused registration was sent as a transform"):
        check_driver("sinks", Bench(lambda: sink, received=lambda: sink.sent))

    def turning() -> SimulatedStage:
        stage = SimulatedStage(default_stage())
        stage.move_to(1.0, 0.1)
        return stage

    with pytest.raises(NotConforming, match="opening it moves it"):
        check_driver("stage", Bench(turning))
