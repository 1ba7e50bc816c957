"""OpenIGTLink devices in their roles: no pulse lost, no refused registration sent, losses reported once."""

from __future__ import annotations

import contextlib
import json
import math
import socket
import struct
import time
from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt
import pytest

from fgreg.drivers import igtl
from fgreg.drivers.base import (
    BmodeSource,
    DeviceLost,
    MotionSource,
    PhotoacousticSource,
    Registration,
    TransformSink,
    host_now,
)
from fgreg.drivers.igtl import IgtlBmode, IgtlMotion, IgtlPhotoacoustic, IgtlReceiver, IgtlTransformSink
from fgreg.drivers.igtl_contents import Status, Text
from fgreg.drivers.igtl_registration import DeviceNames
from fgreg.drivers.tcp_link import Endpoint
from fgreg.errors import InputError
from fgreg.geometry.transforms import exp_so3, make_transform
from fgreg.model.time_sync import Stamp
from tests.igtl_bytes import Told, image_body, message, read_matrix, read_message, read_messages, transform_body
from tests.network_peers import collect, serve, wait_for

pytest.importorskip("pyigtl", reason="pyigtl is not installed: pip install 'fgreg[igtl]'")

MATRIX = make_transform(exp_so3(np.array([0.3, -0.2, 1.1])), np.array([12.5, -30.0, 140.0]))
COVARIANCE = np.diag([1e-6, 2e-6, 3e-6, 0.1, 0.2, 0.3])


@pytest.fixture
def scanner() -> Iterator[tuple[socket.socket, Endpoint]]:
    server, port = serve()
    with server:
        yield server, Endpoint("127.0.0.1", port)


def image(number: int, device: str = "Image_Probe") -> bytes:
    return message("IMAGE", device, image_body(np.full((1, 4, 6), number, np.int16)), sent_s=100.0 + number / 30)


def test_every_pulse_arrives_in_order_with_both_times(scanner: tuple[socket.socket, Endpoint]) -> None:
    server, endpoint = scanner
    source: PhotoacousticSource = IgtlPhotoacoustic(endpoint, "Image_Probe")
    try:
        peer, _ = server.accept()
        with peer:
            began = host_now()
            for number in range(200):  # a burst: all are there before the first poll
                peer.sendall(image(number) + message("TRANSFORM", "ProbeToTracker", transform_body(MATRIX)))
            frames = collect(source.poll, 200)
            assert [frame.index for frame in frames] == list(range(200))
            assert [int(frame.data[0, 0]) for frame in frames] == list(range(200))
            assert frames[0].data.shape == (4, 6)
            assert frames[0].data.dtype == np.int16
            assert frames[30].stamp.device_s == pytest.approx(101.0)
            assert began <= frames[0].stamp.host_s <= frames[-1].stamp.host_s <= host_now()
            assert (source.connected, source.dropped) == (True, 0)
    finally:
        source.close()


def test_rows_may_be_the_senders_columns_and_volumes_are_left_out(scanner: tuple[socket.socket, Endpoint]) -> None:
    server, endpoint = scanner
    source = IgtlPhotoacoustic(endpoint, "US", transposed=True)
    try:
        peer, _ = server.accept()
        with peer:
            pixels = np.arange(24, dtype=np.float32).reshape(1, 4, 6)
            peer.sendall(message("IMAGE", "US", image_body(np.zeros((2, 4, 6), np.float32))))
            peer.sendall(message("IMAGE", "US", image_body(pixels)))
            (frame,) = collect(source.poll, 1)
            np.testing.assert_array_equal(frame.data, pixels[0].T)
            assert frame.index == 1
            assert frame.stamp.device_s == frame.stamp.host_s  # the sender gave no time
            why = f"{endpoint}: US: not a single slice"
            assert (source.rejected, source.last_rejection) == (1, why)
    finally:
        source.close()


def test_a_stream_that_stops_is_lost_and_back_with_its_next_message(scanner: tuple[socket.socket, Endpoint]) -> None:
    server, endpoint = scanner
    source = IgtlPhotoacoustic(endpoint, "Image_Probe")
    try:
        peer, _ = server.accept()
        with peer:
            peer.sendall(image(0))
            collect(source.poll, 1)
            peer.sendall(message("TRANSFORM", "ProbeToTracker", transform_body(MATRIX)))  # does not count
            began = time.monotonic()
            told = r"nothing received for 0\.8 s; it sends TRANSFORM ProbeToTracker"
            with pytest.raises(DeviceLost, match=told):
                wait_for(source.poll)
            assert time.monotonic() - began >= 0.7
            peer.sendall(image(1))
            (frame,) = collect(source.poll, 1)
            assert (frame.index, source.connected) == (1, True)
    finally:
        source.close()


def test_motion_is_the_matrix_or_its_inverse_and_invalid_ones_are_left_out() -> None:
    straight: MotionSource = IgtlMotion(Endpoint.listening(0), "CameraToBase")
    inverted = IgtlMotion(Endpoint.listening(0), "BaseToCamera", inverted=True)
    try:
        for source, device in ((straight, "CameraToBase"), (inverted, "BaseToCamera")):
            assert isinstance(source, IgtlMotion)
            with socket.create_connection(("127.0.0.1", source.endpoint.port)) as peer:
                body = transform_body(MATRIX)
                peer.sendall(message("TRANSFORM", device, body, 2, {"TransformStatus": "MISSING"}))
                peer.sendall(message("TRANSFORM", device, transform_body(np.diag([1.0, 1.0, 2.0, 1.0]))))
                peer.sendall(message("TRANSFORM", device, body, 2, {"TransformStatus": "OK"}, 50.0))
                (sample,) = collect(source.poll, 1)
                expected = MATRIX if device == "CameraToBase" else np.linalg.inv(MATRIX)
                np.testing.assert_allclose(sample.base_T_camera, expected, atol=2e-5)
                rotation = sample.base_T_camera[:3, :3]
                np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
                assert (sample.stamp.device_s, source.rejected) == (50.0, 2)
    finally:
        straight.close()
        inverted.close()


def test_b_mode_pictures_bring_their_pixel_size(scanner: tuple[socket.socket, Endpoint]) -> None:
    server, endpoint = scanner
    source: BmodeSource = IgtlBmode(endpoint, "US")
    try:
        peer, _ = server.accept()
        with peer:
            peer.sendall(message("IMAGE", "US", image_body(np.zeros((1, 4, 6), np.float32))))
            peer.sendall(message("IMAGE", "US", image_body(np.full((1, 4, 6), 7, np.uint8), (0.2, 0.1, 1.0))))
            (frame,) = collect(source.poll, 1)
            assert frame.image.shape == (4, 6)
            assert frame.pixel_mm == pytest.approx((0.1, 0.2))
    finally:
        source.close()


def test_motion_comes_in_any_message_with_poses_once_asked_for(scanner: tuple[socket.socket, Endpoint]) -> None:
    server, endpoint = scanner
    source = IgtlMotion(endpoint, "CameraToBase", start="QTDATA")
    turn, at = (0.0, 0.0, math.sin(0.2), math.cos(0.2)), (10.0, -20.0, 30.0)
    expected = make_transform(exp_so3(np.array([0.0, 0.0, 0.4])), np.array(at))

    def tracked(name: str, kind: int, values: tuple[float, ...]) -> bytes:
        return struct.pack(f">20sBB{len(values)}f", name.encode(), kind, 0, *values)

    matrix = struct.unpack(">12f", transform_body(expected))
    bodies = {
        "POSITION": struct.pack(">7f", *at, *turn),
        "TDATA": tracked("Other", 3, matrix) + tracked("CameraToBase", 2, matrix),
        "QTDATA": tracked("CameraToBase", 1, (*at, *(0.88 * x for x in turn))) + tracked("Other", 2, (*at, *turn)),
        "TRANSFORM": transform_body(expected),
    }
    try:
        peer, _ = server.accept()
        with peer:
            asked = read_message(peer.recv(1000))
            assert (asked.kind, asked.content) == ("STT_QTDATA", struct.pack(">i", 20) + bytes(32))
            wrong = tracked("CameraToBase", 4, matrix) + tracked("CameraToBase", 2, (math.nan, *matrix[1:]))
            peer.sendall(message("TDATA", "Tracker", wrong[:70]) + message("TDATA", "Tracker", wrong[70:]))
            peer.sendall(message("POSITION", "CameraToBase", bytes(12)) + message("RTS_QTDATA", "Tracker", b"\0"))
            for kind, body in bodies.items():
                device = "Tracker" if kind.endswith("TDATA") else "CameraToBase"
                peer.sendall(message(kind, device, body, sent_s=50.0))
            samples = collect(source.poll, len(bodies))
            assert len(samples) == len(bodies)
            for sample in samples:
                np.testing.assert_allclose(sample.base_T_camera, expected, atol=1e-5)
            assert source.rejected == 3
            peer.sendall(message("RTS_QTDATA", "Tracker", b"\1"))
            wait_for(lambda: source.rejected == 4)
            assert source.last_rejection == f"{endpoint}: RTS_QTDATA: it does not start the stream it was asked for"
    finally:
        source.close()


def test_a_pulse_in_parts_is_one_frame_once_all_of_them_are_there(scanner: tuple[socket.socket, Endpoint]) -> None:
    server, endpoint = scanner
    source = IgtlPhotoacoustic(endpoint, "US")
    pixels = np.arange(24, dtype=np.int16).reshape(1, 4, 6)

    def part(rows: slice, columns: slice, sent_s: float) -> bytes:
        start = (0, rows.start, columns.start)
        body = image_body(pixels[:, rows, columns], size=(1, 4, 6), start=start)
        return message("IMAGE", "US", body, sent_s=sent_s)

    upper, left, right = slice(0, 2), slice(0, 3), slice(3, 6)
    lower = slice(2, 4)
    try:
        peer, _ = server.accept()
        with peer:
            peer.sendall(part(upper, left, 1.0) + part(upper, right, 1.0))  # the rest of it is lost
            for rows, columns in ((lower, right), (upper, left), (upper, right), (lower, left)):
                peer.sendall(part(rows, columns, 2.0))
            beyond = image_body(pixels, size=(1, 4, 6), start=(0, 0, 1))
            huge = image_body(pixels[:, :1, :1], size=(65535, 65535, 65535))
            peer.sendall(message("IMAGE", "US", beyond) + message("IMAGE", "US", huge))
            peer.sendall(message("IMAGE", "US", image_body(pixels), sent_s=3.0))
            frames = collect(source.poll, 2)
            assert [(frame.stamp.device_s, frame.index) for frame in frames] == [(2.0, 0), (3.0, 3)]
            np.testing.assert_array_equal(frames[0].data, pixels[0])
            assert source.rejected == 3
    finally:
        source.close()


def test_what_is_wrong_is_said_with_the_peers_name() -> None:
    source = IgtlMotion(Endpoint.listening(0), "CameraToBase")
    try:
        with socket.create_connection(("127.0.0.1", source.endpoint.port)) as peer:
            name = "{}:{}".format(*peer.getsockname())
            body = transform_body(MATRIX)
            wrong = {
                "TRANSFORM CameraToBase: wrong checksum": message("TRANSFORM", "CameraToBase", body, checksum=1),
                "STRING CameraToBase: not a type that is read here": message("STRING", "CameraToBase", b"\0\3\0\0"),
                "CameraToBase: status MISSING": message(
                    "TRANSFORM", "CameraToBase", body, 2, {"TransformStatus": "MISSING"}
                ),
                "header version 7: not OpenIGTLink": message("TRANSFORM", "CameraToBase", body, 7),
            }
            for count, (why, data) in enumerate(wrong.items(), 1):
                peer.sendall(data)
                with contextlib.suppress(DeviceLost):  # the unknown version ends the connection
                    wait_for(lambda count=count: source.poll() or source.rejected == count)  # type: ignore[misc]
                assert (source.rejected, source.last_rejection) == (count, f"{name}: {why}")
    finally:
        source.close()


def test_texts_and_states_come_in_order(scanner: tuple[socket.socket, Endpoint]) -> None:
    server, endpoint = scanner
    receiver = IgtlReceiver(endpoint)
    try:
        peer, _ = server.accept()
        with peer:
            peer.sendall(message("STRING", "Depth", struct.pack(">HH", 3, 2) + b"50"))
            peer.sendall(message("STATUS", "US", struct.pack(">Hq20s", 7, 0, b"LOST") + b"probe\0"))
            found = collect(receiver.poll, 2)
            assert [each.content for each in found] == [Text("50"), Status(7, 0, "LOST", "probe")]
            assert {each.peer for each in found} == {str(endpoint)}
    finally:
        receiver.close()


def ok(scan_rad: float | None = math.radians(12.4), verdict: str = "ok") -> Registration:
    stamp = Stamp(5.0, host_now())
    stage_rad = None if scan_rad is None else 0.09 - scan_rad  # one that counts the other way, from elsewhere
    return Registration(stamp, verdict, MATRIX, COVARIANCE, scan_rad, math.radians(0.5), ("all good",), stage_rad)


def refused(matrix: npt.NDArray[np.float64] | None = None) -> Registration:
    return Registration(Stamp(5.0, host_now()), "refused", matrix, COVARIANCE, 0.1, 0.1, ("too few pairs: 3",))


@pytest.fixture
def sink() -> Iterator[IgtlTransformSink]:
    made = IgtlTransformSink(Endpoint.listening(0))
    yield made
    made.close()


@pytest.fixture
def asker(sink: IgtlTransformSink) -> Iterator[socket.socket]:
    with socket.create_connection(("127.0.0.1", sink.endpoint.port)) as peer:
        yield peer


@pytest.fixture
def sink_and_receiver(
    sink: IgtlTransformSink, asker: socket.socket
) -> tuple[IgtlTransformSink, Callable[[int], list[Told]]]:
    wait_for(lambda: sink.connected)

    def receive(count: int) -> list[Told]:
        data = b""
        asker.settimeout(5.0)
        while True:
            data += asker.recv(1 << 16)
            try:
                found = read_messages(data)
            except (AssertionError, struct.error):
                continue  # not complete yet; the timeout ends a stream that never is
            if len(found) >= count:
                assert len(found) == count
                return found

    return sink, receive


def test_a_valid_registration_goes_out_with_its_covariance_and_angle(
    sink_and_receiver: tuple[IgtlTransformSink, Callable[[int], list[Told]]],
) -> None:
    sink: TransformSink = sink_and_receiver[0]
    before = time.time()
    sink.send(ok())
    status, verdict, transform, plane = sink_and_receiver[1](4)
    assert [m.kind for m in (status, verdict, transform, plane)] == ["STATUS", "STRING", "TRANSFORM", "TRANSFORM"]
    assert (transform.device, transform.version) == ("CameraToTrus", 2)
    np.testing.assert_allclose(read_matrix(transform.content), MATRIX, atol=1e-5)
    assert transform.metadata["TransformStatus"] == "OK"
    covariance = np.array([float(value) for value in transform.metadata["Covariance"].split()]).reshape(6, 6)
    np.testing.assert_allclose(covariance, COVARIANCE, rtol=1e-8)
    assert before - 0.1 < transform.sent_s < time.time() + 0.1
    assert struct.unpack(">Hq20s", status.content[:30]) == (1, 0, b"OK".ljust(20, b"\0"))
    received = json.loads(verdict.content[4:])
    stage_deg = pytest.approx(math.degrees(0.09) - 12.4)
    angles = {"stage_deg": stage_deg, "plane_deg": pytest.approx(12.4), "sigma_deg": pytest.approx(0.5)}
    assert received == {"verdict": "ok", **angles, "reasons": ["all good"]}
    turned = read_matrix(plane.content) @ [0.0, 0.0, 1.0, 0.0]  # the image plane's z axis
    angle = math.radians(12.4)
    np.testing.assert_allclose(turned, [0.0, math.sin(angle), math.cos(angle), 0.0], atol=1e-6)
    assert float(plane.metadata["PlaneDeg"]) == pytest.approx(12.4)
    assert float(plane.metadata["StageDeg"]) == stage_deg


def test_a_warning_is_usable_and_says_so(
    sink_and_receiver: tuple[IgtlTransformSink, Callable[[int], list[Told]]],
) -> None:
    sink, receive = sink_and_receiver
    sink.send(ok(scan_rad=None, verdict="warning"))
    status, _, transform = receive(3)
    assert transform.metadata["Verdict"] == "warning"
    assert status.content[10:17] == b"WARNING"


def test_queries_are_answered_with_the_registration_or_why_not(
    sink_and_receiver: tuple[IgtlTransformSink, Callable[[int], list[Told]]],
    asker: socket.socket,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sink, receive = sink_and_receiver

    def ask(kind: str, device: str = "", checksum: int | None = None) -> None:
        asker.sendall(message(kind, device, b"", checksum=checksum))

    def code(told: Told) -> int:
        assert told.kind == "STATUS"
        return int(struct.unpack(">H", told.content[:2])[0])

    ask("GET_TRANS")
    assert code(*receive(1)) == 13  # there is none yet
    sink.send(ok())
    receive(4)
    ask("GET_TRANSFOR")  # as cut to the 12 bytes of a type
    ask("GET_TRANS", "PlaneToTrus")
    ask("GET_STATUS")
    ask("GET_TRANS", "ToolToTrus")
    ask("GET_POINT")
    registration, plane, status, unknown, unread = receive(5)
    np.testing.assert_allclose(read_matrix(registration.content), MATRIX, atol=1e-5)
    assert (plane.device, status.device, code(status)) == ("PlaneToTrus", "RegistrationStatus", 1)
    assert (code(unknown), code(unread)) == (4, 12)
    with monkeypatch.context() as context:  # who sends the registration has stopped: it is no answer any more
        context.setattr("fgreg.drivers.igtl_decoder.KEPT_S", -1.0)
        ask("GET_TRANS")
        assert code(*receive(1)) == 13
    ask("STT_TRANS")
    ask("STT_TDATA", "Tool")
    ask("GET_CAPABIL")
    yes, no, able = receive(3)
    assert [(told.kind, told.content) for told in (yes, no)] == [("RTS_TRANSFOR", b"\0"), ("RTS_TDATA", b"\1")]
    assert (able.kind, no.device) == ("CAPABILITY", "Tool")
    assert b"GET_TRANS\0\0\0" in [able.content[at : at + 12] for at in range(0, len(able.content), 12)]
    sink.send(refused(MATRIX))
    receive(2)
    ask("GET_TRANS", "CameraToTrus")
    assert code(*receive(1)) == 13
    ask("GET_STATUS", checksum=1)
    wait_for(lambda: sink.rejected == 1)


def test_the_state_is_no_longer_sent_once_refused_as_a_watchdog_of_slicer_needs_it(
    sink_and_receiver: tuple[IgtlTransformSink, Callable[[int], list[Told]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    sink, receive = sink_and_receiver
    sink.send(ok(scan_rad=None))
    assert [told.kind for told in receive(3)] == ["STATUS", "STRING", "TRANSFORM"]
    sink.send(refused())
    assert [told.kind for told in receive(2)] == ["STATUS", "STRING"]
    monkeypatch.setattr(igtl, "REFUSED_SAID_S", 0.0)
    sink.send(refused())
    assert [told.kind for told in receive(1)] == ["STRING"]
    with socket.create_connection(("127.0.0.1", sink.endpoint.port), timeout=5.0) as late:
        assert [told.kind for told in read_messages(late.recv(1 << 16))] == ["STATUS", "STRING"]
        sink.send(ok(scan_rad=None))
        assert [told.kind for told in receive(3)] == ["STATUS", "STRING", "TRANSFORM"]


@pytest.mark.parametrize(
    "registration",
    [
        refused(),
        refused(MATRIX),  # its best estimate is there, and must not get out
        Registration(Stamp(0.0, 0.0), "ok", None, None),
        Registration(Stamp(0.0, 0.0), "ok", np.diag([1.0, 1.0, 2.0, 1.0]), None),
        Registration(Stamp(0.0, 0.0), "warning", MATRIX * np.nan, None, 0.2),
        Registration(Stamp(0.0, 0.0), "unheard of", MATRIX, None, 0.2),
    ],
)
@pytest.mark.parametrize("version", [1, 2])
def test_a_refused_registration_is_never_a_transform(registration: Registration, version: int) -> None:
    sink = IgtlTransformSink(Endpoint.listening(0), header_version=version)
    try:
        sink.send(registration)
        with socket.create_connection(("127.0.0.1", sink.endpoint.port)) as peer:
            wait_for(lambda: sink.connected)
            time.sleep(0.1)
            peer.settimeout(2.0)
            status, verdict = read_messages(peer.recv(1 << 16))
            assert (status.kind, verdict.kind) == ("STATUS", "STRING")
            code, _, error = struct.unpack(">Hq20s", status.content[:30])
            assert (code, error.rstrip(b"\0")) == (13, b"REFUSED")
            received = json.loads(verdict.content[4:])
            assert (received["verdict"], received["stage_deg"], received["sigma_deg"]) == ("refused", None, None)
            assert status.metadata.get("TransformStatus") == ("INVALID" if version == 2 else None)
    finally:
        sink.close()


def test_reasons_of_any_length_and_script_go_out_as_ascii(
    sink_and_receiver: tuple[IgtlTransformSink, Callable[[int], list[Told]]],
) -> None:
    sink, receive = sink_and_receiver
    reasons = ("σ = 3°\n", *["x" * 100_000, "🙂" * 3000] * 4)
    sink.send(Registration(Stamp(0.0, 0.0), "refused", None, None, reasons=reasons))
    status, verdict = receive(2)
    assert status.content[30:].startswith(b"\\u03c3 = 3\\xb0\n; xxx")
    assert len(status.content) < 10_000
    assert json.loads(verdict.content[4:])["reasons"][0] == "σ = 3°\n"


def test_names_and_versions_are_checked_before_anything_is_opened() -> None:
    somewhere = Endpoint.listening(0)
    for wrong in (
        lambda: DeviceNames(registration="CameraToTransrectalUltrasound"),
        lambda: IgtlPhotoacoustic(somewhere, "Image_Probe_Of_The_Scanner"),
        lambda: IgtlMotion(somewhere, ""),
        lambda: IgtlBmode(somewhere, "é"),
        lambda: IgtlReceiver(somewhere, [("STRING", "x" * 21)]),
    ):
        with pytest.raises(InputError, match="1 to 20 printable ASCII characters"):
            wrong()
    with pytest.raises(InputError, match="found 3, expected 1 or 2"):
        IgtlTransformSink(somewhere, header_version=3)
