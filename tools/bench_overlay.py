"""Latency of the overlay over OpenIGTLink, from a frame's arrival to the whole picture at a receiver.

    python tools/bench_overlay.py [--seconds 20] [--width 1280] [--rate 30]   the simulated room, all lines drawn
    python tools/bench_overlay.py --connect 18946 --seconds 60                a running ``fgreg live`` with an overlay

The receiver is a process of its own that takes every picture, checks its checksum and makes an array of it. Messages
carry the time of the frame's arrival, and both processes have the clock of one machine.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import sys
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from fgreg.drivers.base import StereoFrame, host_now
from fgreg.drivers.igtl import IgtlReceiver
from fgreg.drivers.igtl_overlay import IgtlPictureSink
from fgreg.drivers.tcp_link import Endpoint
from fgreg.model.time_sync import Stamp
from tests.overlay_status import room_status


def receive(port: int, seconds: float, to: Connection) -> None:
    """Latencies (ms) of the pictures that come within a time."""
    receiver = IgtlReceiver(Endpoint("127.0.0.1", port), [("IMAGE", "")])
    latencies: list[float] = []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        came = [message for message in receiver.poll() if message.sent_s is not None]
        apart = time.time() - time.monotonic()  # of the two clocks
        latencies += [1e3 * (message.host_s + apart - (message.sent_s or 0.0)) for message in came]
        time.sleep(0.001)
    receiver.close()
    to.send(latencies)


def frames(rate: float, seconds: float) -> Iterator[int]:
    """Numbers, at a rate."""
    begin = time.monotonic()
    for number in range(int(rate * seconds)):
        time.sleep(max(0.0, begin + number / rate - time.monotonic()))
        yield number


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--connect", type=int, metavar="PORT")
    options = parser.parse_args()
    ours, theirs = multiprocessing.Pipe()
    sent, cpu_ms = 0, math.nan
    if options.connect:
        receive(options.connect, options.seconds, theirs)
    else:
        status = room_status(options.width)
        sink = IgtlPictureSink(Endpoint.listening(0))
        feed = status.fed([sink])
        spawn = multiprocessing.get_context("spawn")
        child = spawn.Process(target=receive, args=(sink.endpoint.port, options.seconds + 5.0, theirs))
        child.start()
        while not sink.connected:
            time.sleep(0.01)
        begin = time.process_time()
        for number in frames(options.rate, options.seconds):
            now = host_now()
            left = status.frame.left.copy()
            feed.show(status.at(now, StereoFrame(Stamp(now, now), left, None, number)))
            sent += 1
        cpu_ms = 1e3 * (time.process_time() - begin) / sent
    latencies = np.array(ours.recv())
    if not options.connect:
        feed.close()
        sink.close()
        child.join()
    p50, p99, most = np.percentile(latencies, (50, 99, 100)) if latencies.size else (math.nan,) * 3
    print(f"{len(latencies)} pictures received{f' of {sent} frames' if sent else ''}")
    print(f"frame's arrival to picture at the receiver: median {p50:.1f}, 99 % {p99:.1f}, longest {most:.1f} ms")
    if sent:
        print(f"{cpu_ms:.1f} ms of processor time a frame")
    print(f"load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")


if __name__ == "__main__":
    main()
