"""OpenIGTLink with pyigtl's own server and client as peers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from fgreg.drivers.base import PaFrame, Registration, host_now
from fgreg.drivers.igtl import IgtlPhotoacoustic, IgtlTransformSink
from fgreg.drivers.tcp_link import Endpoint
from fgreg.geometry.transforms import exp_so3, make_transform
from fgreg.model.time_sync import Stamp
from tests.network_peers import collect, free_port, wait_for

pyigtl = pytest.importorskip("pyigtl", reason="pyigtl is not installed: pip install 'fgreg[igtl]'")

MATRIX = make_transform(exp_so3(np.array([0.3, -0.2, 1.1])), np.array([12.5, -30.0, 140.0]))


def test_its_server_sends_images_which_are_pulses() -> None:
    port = free_port()
    server = pyigtl.OpenIGTLinkServer(port=port, local_server=True)
    source = IgtlPhotoacoustic(Endpoint("127.0.0.1", port), "Probe")
    pixels = np.arange(24, dtype=np.int16).reshape(1, 4, 6)

    def poll() -> Sequence[PaFrame]:
        server.send_message(pyigtl.TransformMessage(MATRIX, device_name="ProbeToTracker"))
        server.send_message(pyigtl.ImageMessage(pixels, device_name="Probe"))
        return source.poll()

    try:
        wait_for(server.is_connected)
        for frame in collect(poll, 3):
            np.testing.assert_array_equal(frame.data, pixels[0])
        assert source.rejected == 0
    finally:
        source.close()
        server.stop()


def test_its_client_receives_a_registration_and_no_refused_one() -> None:
    sink = IgtlTransformSink(Endpoint.listening(0))
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", sink.endpoint.port)

    def send(verdict: str) -> None:
        sink.send(Registration(Stamp(0.0, host_now()), verdict, MATRIX, None, reasons=("because",)))

    try:
        wait_for(lambda: sink.connected, 10.0)
        send("refused")
        verdict = client.wait_for_message("RegistrationVerdict", timeout=5.0)
        assert '"verdict": "refused"' in verdict.string
        assert client.wait_for_message("CameraToTrus", timeout=0.1) is None
        send("ok")
        found = client.wait_for_message("CameraToTrus", timeout=5.0)
        np.testing.assert_allclose(found.matrix, MATRIX, atol=1e-4)
        assert found.metadata["TransformStatus"] == "OK"
    finally:
        client.stop()
        sink.close()
