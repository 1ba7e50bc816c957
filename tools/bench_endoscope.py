"""What the endoscope's driver costs: two inputs of 1280 x 720 px at 30 frames/s, played from motion JPEG files.

Prints, beside its target: pairs delivered, frames dropped, the time from a frame's arrival to the moment a polling
loop has the pair, the time until a lost device is reported, processor time for each pair, and the cost of rectification
and field separation alone. The wait of the polling loop (2 ms) is part of the latency.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from fgreg.drivers.base import DeviceLost, host_now
from fgreg.drivers.endoscope import Endoscope, EndoscopeConfig, InputConfig, Layout
from fgreg.drivers.interlacing import Fields, split
from fgreg.drivers.rectification import rectification
from fgreg.geometry.transforms import as_float_array, exp_so3, make_transform
from fgreg.model.camera_model import CameraModel, StereoRig

SIZE, FPS, POLL_S = (1280, 720), 30.0, 0.002


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0, help="of playing")
    seconds = parser.parse_args().seconds
    with tempfile.TemporaryDirectory() as name:
        files = [_video(Path(name) / f"{side}.avi", seed) for seed, side in enumerate(("left", "right"))]
        _play(files, seconds)
    _loss()
    _pictures()


def _video(path: Path, seed: int) -> str:
    """Two seconds of smooth texture that moves: about what a JPEG of tissue weighs."""
    rng = np.random.default_rng(seed)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8), (0, 0), 3.0)
    texture = cv2.normalize(texture, texture.copy(), 0, 255, cv2.NORM_MINMAX)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), FPS, SIZE)
    for i in range(60):
        writer.write(np.roll(texture, 4 * i, axis=1))
    writer.release()
    return str(path)


def _play(files: list[str], seconds: float) -> None:
    left, right = (InputConfig(file, loop=True) for file in files)
    endoscope = Endoscope(EndoscopeConfig(left, right, Layout.SEPARATE))
    while not endoscope.poll():
        time.sleep(POLL_S)
    used, began, late = _processor_s(), host_now(), list[float]()
    while host_now() - began < seconds:
        now = host_now()
        late += [now - frame.stamp.host_s for frame in endoscope.poll() if frame.right is not None]
        time.sleep(POLL_S)
    spent, elapsed = _processor_s() - used, host_now() - began
    endoscope.close()
    p50, p99 = (1e3 * float(np.percentile(late, q)) for q in (50, 99))
    print(f"pairs {len(late)} of {FPS * elapsed:.0f} in {elapsed:.1f} s, dropped {endoscope.dropped} (target: 0)")
    print(f"arrival of the left frame to its pair: p50 {p50:.1f} ms, p99 {p99:.1f} ms (a part of 40 and 100 ms)")
    print(f"processor {1e3 * spent / max(1, len(late)):.1f} ms for each pair, decoding both pictures included")


def _loss() -> None:
    began = host_now()
    endoscope = Endoscope(EndoscopeConfig(InputConfig("/dev/video4711")))
    try:
        while True:
            endoscope.poll()
            time.sleep(0.033)
    except DeviceLost:
        print(f"a device that is not there is reported after {host_now() - began:.2f} s (target: 1 s)")
    finally:
        endoscope.close()


def _pictures() -> None:
    camera = CameraModel(
        SIZE, as_float_array([[1000, 0, 640], [0, 1000, 360], [0, 0, 1]]), as_float_array([-0.2] + [0] * 4)
    )
    turn = exp_so3(as_float_array([0.01, 0.02, 0.0]))
    rig = StereoRig(camera, camera, as_float_array(make_transform(turn, np.array([-5.0, 0.0, 0.0]))))
    found = rectification(rig)
    picture = np.random.default_rng(1).integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
    for what, work in (
        ("rectify two pictures", lambda: (found.left(picture), found.right(picture))),
        ("both fields of two frames", lambda: (split(picture, Fields.BOTH), split(picture, Fields.BOTH))),
    ):
        times = []
        for _ in range(20):
            began = time.perf_counter()
            work()
            times.append(time.perf_counter() - began)
        print(f"{what}: {1e3 * float(np.median(times)):.1f} ms")


def _processor_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    main()
