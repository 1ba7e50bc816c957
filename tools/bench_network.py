"""Times network devices on loopback: from a sender in another process until the program has the message.

    python tools/bench_network.py [--seconds 10] [--rate 30]

Three rows: OpenIGTLink channel data (128 x 2048, 16 bit) as PhotoacousticSource, BK pictures (892 x 728) over OEM, and
the registration out to a plain receiver. Given are the time from sending to poll (or from send to reception), the share
of one core that the receiving process takes, messages lost, and growth of its memory. Targets: none lost, p99 at most
10 ms (a quarter of the 40 ms from frame to angle), at most a tenth of a core, no growth. Then the time until a lost
device is reported: target 1 s.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import resource
import socket
import struct
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from fgreg.drivers.base import DeviceLost, Registration, host_now
from fgreg.drivers.bk_oem import BkOemScanner
from fgreg.drivers.igtl import IgtlPhotoacoustic, IgtlTransformSink
from fgreg.drivers.igtl_messages import pack_image
from fgreg.drivers.tcp_link import Endpoint
from fgreg.model.time_sync import Stamp
from tests.bk_emulator import frame, grabbed

CHANNELS = (1, 128, 2048)
PICTURE = (728, 892)
POLL_S = 1e-3
WARM_UP = 10


def send_channels(server: socket.socket, seconds: float, rate_hz: float) -> None:
    """A scanner that stamps its messages with the host's clock; the time stamp is not part of the checksum."""
    pixels = np.random.default_rng(0).integers(-1000, 1000, CHANNELS, dtype=np.int16)
    packed = bytearray(pack_image("Image_Probe", pixels, 0.0))

    def block() -> bytes:
        now = time.monotonic()
        packed[34:42] = struct.pack(">II", int(now), int((now % 1.0) * 2**32))
        return bytes(packed)

    send_on(server, seconds, rate_hz, block)


def send_pictures(server: socket.socket, seconds: float, rate_hz: float) -> None:
    """A scanner that writes the time into the first eight pixels."""
    pixels = np.random.default_rng(0).integers(0, 256, PICTURE, dtype=np.uint8)
    rest = frame(grabbed(pixels))

    def block() -> bytes:
        first = pixels.copy()
        first.ravel()[:8] = np.frombuffer(struct.pack("<d", time.monotonic()), np.uint8)
        return frame(grabbed(first)[:64])[:-1] + rest[cut:]

    cut = len(frame(grabbed(pixels)[:64])) - 1  # escapes before that differ with the time, not after
    server_first = frame(b"DATA:US_WIN_SIZE %d,%d;" % PICTURE[::-1])
    send_on(server, seconds, rate_hz, block, server_first)


def send_on(
    server: socket.socket, seconds: float, rate_hz: float, block: Callable[[], bytes], first: bytes = b""
) -> None:
    """Blocks at a steady rate to every client."""
    peer, _ = server.accept()
    with peer:
        peer.sendall(first)
        start = time.monotonic()
        for number in range(int(seconds * rate_hz)):
            time.sleep(max(0.0, start + number / rate_hz - time.monotonic()))
            peer.sendall(block())
        time.sleep(1.0)


def report(what: str, delays_s: Sequence[float], lost: int, cpu_s: float, wall_s: float, grown_kb: int) -> None:
    """One row."""
    p50, p99, worst = np.percentile(1e3 * np.array(delays_s[WARM_UP:]), [50.0, 99.0, 100.0])
    print(
        f"{what:<34} p50 {p50:5.2f} ms  p99 {p99:5.2f} ms  max {worst:6.2f} ms  core {100 * cpu_s / wall_s:4.1f} %  "
        f"lost {lost}  memory {grown_kb:+d} kB"
    )


def receive(what: str, sender: Callable[..., None], options: Any, make: Callable[[Endpoint], Any], read: Any) -> None:
    """Run a sender in its own process, poll here."""
    server = socket.create_server(("127.0.0.1", 0))
    process = multiprocessing.get_context("fork").Process(target=sender, args=(server, options.seconds, options.rate))
    process.start()
    source = make(Endpoint("127.0.0.1", server.getsockname()[1]))
    server.close()
    count = int(options.seconds * options.rate)
    delays: list[float] = []
    grown, began, cpu = 0, time.monotonic(), time.process_time()
    while len(delays) < count and time.monotonic() - began < options.seconds + 5.0:
        for item in source.poll():
            delays.append(time.monotonic() - read(item))
            if len(delays) == count // 4:
                grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        time.sleep(POLL_S)
    cpu, wall = time.process_time() - cpu, time.monotonic() - began
    report(what, delays, count - len(delays), cpu, wall, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - grown)
    source.close()
    process.join()


def registrations(options: argparse.Namespace) -> None:
    """The other direction; this loop is the receiver, too."""
    sink = IgtlTransformSink(Endpoint.listening(0))
    delays, cpu, began = [], time.process_time(), time.monotonic()
    count = int(options.seconds * options.rate)
    with socket.create_connection(("127.0.0.1", sink.endpoint.port)) as peer:
        while not sink.connected:
            time.sleep(POLL_S)
        for number in range(count):
            time.sleep(max(0.0, began + number / options.rate - time.monotonic()))
            sent = time.monotonic()
            sink.send(Registration(Stamp(sent, host_now()), "ok", np.eye(4), np.eye(6), 0.1, 0.01, ("bench",)))
            peer.recv(1 << 16)
            delays.append(time.monotonic() - sent)
    wall = time.monotonic() - began
    report("registration out", delays, sink.dropped, time.process_time() - cpu, wall, 0)
    sink.close()


def losses() -> None:
    """Time from a closed or silent connection until poll raises, and from the return of the device until connected."""
    for what, silent in (("hangs up", False), ("falls silent", True)):
        said, back = [], []
        for _ in range(5):
            server = socket.create_server(("127.0.0.1", 0))
            source = IgtlPhotoacoustic(Endpoint("127.0.0.1", server.getsockname()[1]), "Image_Probe")
            peer, _ = server.accept()
            while not source.connected:
                time.sleep(POLL_S)
            began = time.monotonic()
            if not silent:
                peer.close()
            try:
                while True:
                    source.poll()
                    time.sleep(POLL_S)
            except DeviceLost:
                said.append(time.monotonic() - began)
            if not silent:
                peer, _ = server.accept()
            while not silent and not source.connected:
                time.sleep(POLL_S)
            back.append(time.monotonic() - began)
            for thing in (source, peer, server):
                thing.close()
        again = "" if silent else f", connected again after {max(back):.3f} s"
        print(f"device {what}: reported after {max(said):.3f} s at most{again}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each row (default 10)")
    parser.add_argument("--rate", type=float, default=30.0, help="messages per second (default 30)")
    options = parser.parse_args()
    print(f"{os.cpu_count()} cores, load {', '.join(f'{value:.1f}' for value in os.getloadavg())}")
    receive(
        "OpenIGTLink channels, 512 kB",
        send_channels,
        options,
        lambda endpoint: IgtlPhotoacoustic(endpoint, "Image_Probe"),
        lambda item: item.stamp.device_s,
    )
    receive(
        "BK pictures, 634 kB",
        send_pictures,
        options,
        BkOemScanner,
        lambda item: struct.unpack("<d", item.image.ravel()[:8].tobytes())[0],
    )
    registrations(options)
    losses()


if __name__ == "__main__":
    main()
