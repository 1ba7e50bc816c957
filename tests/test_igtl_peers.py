"""OpenIGTLink with an independent peer: Debian's example programs, compiled from their package against its C++ library.

They speak protocol 2, header version 1. Their handling of header version 2 is checked, too, since the option exists
for them.
"""

from __future__ import annotations

import re
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import pytest

from fgreg.drivers.base import DeviceLost, Registration, host_now
from fgreg.drivers.igtl import IgtlMotion, IgtlPhotoacoustic, IgtlReceiver, IgtlTransformSink
from fgreg.drivers.igtl_contents import Status, Text
from fgreg.drivers.tcp_link import Endpoint
from fgreg.geometry.transforms import exp_so3, make_transform
from fgreg.model.time_sync import Stamp
from tests.network_peers import collect, free_port, wait_for

pytest.importorskip("pyigtl", reason="pyigtl is not installed: pip install 'fgreg[igtl]'")

T = TypeVar("T")
EXAMPLES = Path("/usr/share/doc/openigtlink-examples/examples")
HEADERS = Path("/usr/include/openigtlink")
MATRIX = make_transform(exp_so3(np.array([0.3, -0.2, 1.1])), np.array([12.5, -30.0, 140.0]))
COMPILER = shutil.which("g++")
pytestmark = pytest.mark.skipif(
    COMPILER is None or not (EXAMPLES.is_dir() and HEADERS.is_dir()),
    reason="no independent OpenIGTLink peer (Debian: g++ libopenigtlink-dev openigtlink-examples)",
)


class Programs:
    """Example programs, compiled when first asked for, run, and ended."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._running: list[subprocess.Popen[str]] = []

    def start(self, source: str, *arguments: object) -> Path:
        """Run one; returns the file with what it prints."""
        program = self._folder / Path(source).name
        if not program.exists():
            command = [COMPILER, "-O0", "-w", f"-I{HEADERS}", EXAMPLES / f"{source}.cxx", "-o", program]
            subprocess.run([*map(str, command), "-lOpenIGTLink", "-lpthread"], check=True, timeout=120)
        printed = self._folder / f"{program.name}.{len(self._running)}.txt"
        with printed.open("w") as out:
            process = subprocess.Popen([program, *map(str, arguments)], stdout=out, stderr=out, text=True)
        self._running.append(process)
        return printed

    def end(self) -> None:
        for process in self._running:
            process.kill()
            process.wait()
        self._running.clear()


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Programs:
    return Programs(tmp_path_factory.mktemp("igtl"))


@pytest.fixture
def programs(compiled: Programs) -> Iterator[Programs]:
    yield compiled
    compiled.end()


def patient(poll: Callable[[], Sequence[T]]) -> Callable[[], Sequence[T]]:
    """Losses passed over: the program is not there yet, or has just been ended."""

    def poll_on() -> Sequence[T]:
        try:
            return poll()
        except DeviceLost:
            return []

    return poll_on


def printed_matrices(text: str) -> npt.NDArray[np.float64]:
    """Matrices as the library prints them: four lines of four numbers between lines of ``=``."""
    rows = re.findall(r"^(-?[\d.e+-]+, -?[\d.e+-]+, -?[\d.e+-]+, -?[\d.e+-]+)$", text, re.MULTILINE)
    return np.array([[float(value) for value in row.split(",")] for row in rows]).reshape(-1, 4, 4)


def test_every_transform_of_a_tracker_arrives_though_it_hangs_up_after_a_hundred(programs: Programs) -> None:
    port = free_port()
    source = IgtlMotion(Endpoint("127.0.0.1", port), "Tracker")
    try:
        printed = programs.start("Tracker/TrackerServer", port, 100)
        samples = collect(patient(source.poll), 130, 15.0)
        assert source.connected
        programs.end()
        wait_for(lambda: not source.connected)
        sent = printed_matrices(printed.read_text())[:130]
        found = np.array([sample.base_T_camera for sample in samples])[:130]
        assert len(sent) >= 100  # the last ones may not be printed yet
        np.testing.assert_allclose(found[: len(sent)], sent, atol=2e-3)  # printed with six digits
        assert source.rejected == 0
    finally:
        source.close()


@pytest.mark.parametrize(
    ("program", "kind"),
    [("TrackingData/TrackingDataServer", "TDATA"), ("QuaternionTrackingData/QuaternionTrackingDataServer", "QTDATA")],
)
def test_a_tracker_that_sends_when_asked_is_asked(programs: Programs, program: str, kind: str) -> None:
    port = free_port()
    source = IgtlMotion(Endpoint("127.0.0.1", port), "Channel 1", start=kind)
    try:
        programs.start(program, port)
        samples = collect(patient(source.poll), 10, 15.0)
        radii = [np.hypot(*sample.base_T_camera[:2, 3]) for sample in samples]
        np.testing.assert_allclose(radii, 50.0, atol=1e-3)
        assert source.rejected == 0
    finally:
        source.close()


def test_a_tracker_may_be_the_client(programs: Programs) -> None:
    source = IgtlMotion(Endpoint.listening(0), "Tracker")
    try:
        programs.start("Tracker/TrackerClient", "127.0.0.1", source.endpoint.port, 200)
        samples = collect(source.poll, 40, 15.0)
        steps = np.diff([sample.stamp.device_s for sample in samples])
        assert (steps > 0).all()
        assert abs(samples[-1].stamp.device_s - time.time()) < 5.0
        radii = [np.hypot(*sample.base_T_camera[:2, 3]) for sample in samples]
        np.testing.assert_allclose(radii, 50.0, atol=1e-3)
    finally:
        source.close()


def test_every_image_of_a_scanner_arrives_pixel_by_pixel(programs: Programs) -> None:
    port = free_port()
    source = IgtlPhotoacoustic(Endpoint("127.0.0.1", port), "ImagerClient")
    try:
        programs.start("Imager/ImagerServer", port, 200, EXAMPLES / "Imager/img")
        frames = collect(patient(source.poll), 100, 15.0)
        assert [frame.index for frame in frames[:100]] == list(range(100))
        for number, frame in enumerate(frames[:100]):
            raw = np.fromfile(EXAMPLES / f"Imager/img/igtlTestImage{number % 5 + 1}.raw", np.uint8)
            np.testing.assert_array_equal(frame.data, raw.reshape(256, 256))
        assert (source.rejected, source.dropped) == (0, 0)
    finally:
        source.close()


def test_texts_and_states_are_read(programs: Programs) -> None:
    port = free_port()
    texts = IgtlReceiver(Endpoint("127.0.0.1", port), [("STRING", "")])
    states = IgtlReceiver(Endpoint.listening(0), [("STATUS", "Device")])
    try:
        programs.start("String/StringServer", port, 100)
        found = [message.content for message in collect(patient(texts.poll), 5, 15.0)]
        words = ["OpenIGTLink", "Network", "Communication", "Protocol", "Image Guided Therapy"]
        assert found[:5] == [Text(word) for word in words]
        programs.start("Status/StatusClient", "127.0.0.1", states.endpoint.port)
        (status,) = collect(states.poll, 1, 15.0)
        assert status.content == Status(1, 128, "OK!", "This is a test to send status message.")
    finally:
        texts.close()
        states.close()


def registration(verdict: str) -> Registration:
    return Registration(Stamp(0.0, host_now()), verdict, MATRIX, np.eye(6), 0.2, 0.01, ("because",))


def test_a_receiver_reads_the_registration_and_no_matrix_while_it_is_refused(programs: Programs) -> None:
    sink = IgtlTransformSink(Endpoint.listening(0), header_version=1)
    try:
        printed = programs.start("Receiver/ReceiveClient", "127.0.0.1", sink.endpoint.port)
        wait_for(lambda: sink.connected, 15.0)
        for verdict in ("refused", "refused", "ok", "refused"):
            sink.send(registration(verdict))
            time.sleep(0.1)
        wait_for(lambda: printed.read_text().count("STATUS ==") == 4)
        received = printed.read_text()
        states = re.findall(r"Code +: (\d+)\n.*\n Error Name: (\w+)\n Status +: (\w+)", received)
        refused = ("13", "REFUSED", "because")
        assert states == [refused, refused, ("1", "OK", "because"), refused]
        matrices = printed_matrices(received)
        assert len(matrices) == 2  # CameraToTrus and PlaneToTrus, once
        np.testing.assert_allclose(matrices[0], MATRIX, atol=1e-3)
        np.testing.assert_allclose(matrices[1][:3, 2], [0.0, np.sin(0.2), np.cos(0.2)], atol=1e-5)
        assert received.count("Receiving STRING") == 4
    finally:
        sink.close()


def test_the_receiver_may_be_the_server(programs: Programs) -> None:
    port = free_port()
    sink = IgtlTransformSink(Endpoint("127.0.0.1", port), header_version=1)
    try:
        printed = programs.start("Receiver/ReceiveServer", port)
        wait_for(lambda: sink.connected, 15.0)
        with pytest.raises(DeviceLost, match=r"transform sink: .*Connection refused"):  # before it was there
            sink.send(registration("ok"))
        wait_for(lambda: len(printed_matrices(printed.read_text())) == 2)
        np.testing.assert_allclose(printed_matrices(printed.read_text())[0], MATRIX, atol=1e-3)
    finally:
        sink.close()


def test_a_receiver_of_protocol_2_takes_no_matrix_from_header_version_2(programs: Programs) -> None:
    sink = IgtlTransformSink(Endpoint.listening(0), header_version=2)
    try:
        printed = programs.start("Receiver/ReceiveClient", "127.0.0.1", sink.endpoint.port)
        wait_for(lambda: sink.connected, 15.0)
        for _ in range(5):
            sink.send(registration("ok"))
            time.sleep(0.05)
        wait_for(lambda: "Receiving :" in printed.read_text())
        assert len(printed_matrices(printed.read_text())) == 0
    finally:
        sink.close()


def test_a_receiver_that_stops_reading_and_dies_is_one_loss(programs: Programs) -> None:
    sink = IgtlTransformSink(Endpoint.listening(0), header_version=1)
    try:
        programs.start("Receiver/ReceiveClient", "127.0.0.1", sink.endpoint.port)
        wait_for(lambda: sink.connected, 15.0)
        programs.end()
        wait_for(lambda: not sink.connected)
        with pytest.raises(DeviceLost, match="hung up"):
            sink.send(registration("ok"))
        sink.send(registration("ok"))  # to no one, and no loss again
        assert not sink.connected
        with socket.create_connection(("127.0.0.1", sink.endpoint.port)):
            wait_for(lambda: sink.connected)
    finally:
        sink.close()
