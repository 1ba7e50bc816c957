"""How late stereo frames of ROS 2 topics are, and whether any is lost: JPEGs over Zenoh, decoded beside ``poll``.

A process of its own sends pairs of JPEGs at a fixed rate through a router on loopback. Times are from the arrival of
the later picture of a pair at this process to the frame in ``poll``'s answer: with decoding, and without it.

    nice python tools/bench_ros2.py [--seconds 20] [--rate 30] [--width 1280] [--height 720]
"""

from __future__ import annotations

import argparse
import os
import socket
import subprocess
import sys
import threading
import time
from collections import defaultdict
from typing import Any

import cv2
import numpy as np

from fgreg.drivers import ros2, ros2_messages
from fgreg.drivers.base import DeviceLost, host_now
from fgreg.drivers.options import Ros2CameraOptions
from fgreg.drivers.ros_messages import picture_of

LEFT, RIGHT = "rig/left/image_raw/compressed", "rig/right/image_raw/compressed"


def send(port: int, seconds: float, rate: float, width: int, height: int) -> None:
    """The other process: router and publisher."""
    import zenoh  # type: ignore[import-untyped, unused-ignore]

    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{port}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("transport/shared_memory/enabled", "false")
    session: Any = zenoh.open(config)
    random = np.random.default_rng(1)
    coarse = random.integers(0, 255, (height // 8, width // 8, 3), np.uint8)
    picture = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    data = np.frombuffer(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes(), np.uint8)
    kind = f"sensor_msgs::msg::dds_::CompressedImage_/{ros2_messages.hash_of(ros2_messages.COMPRESSED)}"
    publishers = [session.declare_publisher(f"0/{topic}/{kind}") for topic in (LEFT, RIGHT)]
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    sys.stdin.readline()
    begin, number = time.monotonic(), 0
    while number < seconds * rate:
        time.sleep(max(0.0, begin + number / rate - time.monotonic()))
        header = ros2_messages.header(1000.0 + number / rate)
        message = ros2_messages.make(ros2_messages.COMPRESSED, header=header, format="jpeg", data=data)
        block = ros2_messages.encode(message)
        for publisher in publishers:
            publisher.put(block)
        number += 1
    sys.stdout.write(f"{number} {data.size}\n")
    sys.stdout.flush()
    time.sleep(1.0)
    session.close()


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--seconds", type=float, default=20.0)
    arguments.add_argument("--rate", type=float, default=30.0)
    arguments.add_argument("--width", type=int, default=1280)
    arguments.add_argument("--height", type=int, default=720)
    arguments.add_argument("--send", type=int, default=0, help=argparse.SUPPRESS)
    given = arguments.parse_args()
    if given.send:
        send(given.send, given.seconds, given.rate, given.width, given.height)
        return
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    sender = subprocess.Popen(
        [sys.executable, __file__, f"--send={port}", *sys.argv[1:]],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert sender.stdout is not None
    assert sender.stdin is not None
    sender.stdout.readline()
    decoding: dict[int, float] = defaultdict(float)
    arrived: dict[int, float] = defaultdict(float)
    lock = threading.Lock()

    def timed_picture(message: Any) -> Any:
        began = time.perf_counter()
        picture = picture_of(message)
        key = round((message.header.stamp.sec + message.header.stamp.nanosec / 1e9) * given.rate)
        with lock:
            decoding[key] = max(decoding[key], time.perf_counter() - began)
        return picture

    vars(ros2)["picture_of"] = timed_picture
    options = Ros2CameraOptions(
        left=f"/{LEFT}", right=f"/{RIGHT}", router=f"tcp/127.0.0.1:{port}", through="zenoh", max_gap_s=0.4 / given.rate
    )
    camera = ros2.Ros2Camera(options)
    for topic in camera._inputs:
        take = topic._item  # type: ignore[attr-defined]

        def item(message: Any, value: Any, host_s: float, index: int, take: Any = take) -> Any:
            made = take(message, value, host_s, index)
            with lock:
                key = round(made.stamp.device_s * given.rate)
                arrived[key] = max(arrived[key], host_s)
            return made

        topic._item = item  # type: ignore[attr-defined]
    time.sleep(0.5)
    sender.stdin.write("go\n")
    sender.stdin.flush()
    whole, without, frames, pairs = [], [], 0, 0
    end = time.monotonic() + given.seconds + 0.6
    while time.monotonic() < end:
        try:
            found = camera.poll()
        except DeviceLost:
            found = []
        now = host_now()
        for frame in found:
            key = round(frame.stamp.device_s * given.rate)
            frames, pairs = frames + 1, pairs + (frame.right is not None)
            whole.append(1e3 * (now - arrived[key]))
            without.append(max(0.0, whole[-1] - 1e3 * decoding[key]))
        time.sleep(0.002)
    sent, size = (int(word) for word in sender.stdout.readline().split())
    print(f"{sent} pairs of {given.width} x {given.height} px sent at {given.rate:g}/s, {size / 1e3:.0f} kB each")
    print(f"{frames} frames came, {pairs} of them pairs; counted as dropped: {camera.dropped} pictures")
    for label, values in (
        ("arrival to poll without decoding", without),
        ("decoding, the slower of both", [1e3 * value for value in decoding.values()]),
        ("arrival to poll with decoding", whole),
    ):
        p50, p99 = np.percentile(values, [50, 99])
        print(f"{label}: p50 {p50:.1f} ms, p99 {p99:.1f} ms, longest {max(values):.1f} ms")
    print("load average: " + ", ".join(f"{value:.1f}" for value in os.getloadavg()) + f" on {os.cpu_count()} cores")
    camera.close()
    sender.wait()


if __name__ == "__main__":
    main()
