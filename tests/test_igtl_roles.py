"""OpenIGTLink devices in their roles: no pulse lost, no refused registration sent, losses reported once."""

from __future__ import annotations

import json
import math
import socket
import struct
import time
from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt
import pytest

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
from fgreg.drivers.igtl_messages import Status, Text
from fgreg.drivers.igtl_registration import DeviceNames
from fgreg.drivers.tcp_link import Endpoint
from fgreg.errors import InputError
from fgreg.geometry.transforms import exp_so3, make_transform
from fgreg.model.time_sync import Stamp
from tests.igtl_bytes import Told, image_body, message, read_matrix, read_messages, transform_body
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
            assert (source.rejected, source.last_rejection) == (1, "US: not a single slice")
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
            with pytest.raises(DeviceLost, match=r"nothing received for 0\.8 s"):
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


def test_texts_and_states_come_in_order(scanner: tuple[socket.socket, Endpoint]) -> None:
    server, endpoint = scanner
    receiver = IgtlReceiver(endpoint)
    try:
        peer, _ = server.accept()
        with peer:
            peer.sendall(message("STRING", "Depth", struct.pack(">HH", 3, 2) + b"50"))
            peer.sendall(message("STATUS", "US", struct.pack(">Hq20s", 7, 0, b"LOST") + b"probe\0"))
            contents = [found.content for found in collect(receiver.poll, 2)]
            assert contents == [Text("50"), Status(7, 0, "LOST", "probe")]
    finally:
        receiver.close()


def ok(scan_rad: float | None = math.radians(12.4), verdict: str = "ok") -> Registration:
    stamp = Stamp(5.0, host_now())
    stage_rad = None if scan_rad is None else 0.09 - scan_rad  # one that counts the other way, from elsewhere
    return Registration(stamp, verdict, MATRIX, COVARIANCE, scan_rad, math.radians(0.5), ("all good",), stage_rad)


def refused(matrix: npt.NDArray[np.float64] | None = None) -> Registration:
    return Registration(Stamp(5.0, host_now()), "refused", matrix, COVARIANCE, 0.1, 0.1, ("too few pairs: 3",))


@pytest.fixture
def sink_and_receiver() -> Iterator[tuple[IgtlTransformSink, Callable[[int], list[Told]]]]:
    sink = IgtlTransformSink(Endpoint.listening(0))
    with socket.create_connection(("127.0.0.1", sink.endpoint.port)) as peer:
        wait_for(lambda: sink.connected)

        def receive(count: int) -> list[Told]:
            data = b""
            peer.settimeout(5.0)
            while True:
                data += peer.recv(1 << 16)
                try:
                    found = read_messages(data)
                except (AssertionError, struct.error):
                    continue  # not complete yet; the timeout ends a stream that never is
                if len(found) >= count:
                    assert len(found) == count
                    return found

        yield sink, receive
    sink.close()


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
