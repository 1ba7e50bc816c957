"""The endoscope's driver on real videos, folders, and a stream that is cut off, falls silent and comes back."""

from __future__ import annotations

import http.server
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from fgreg.drivers.base import DeviceLost, StereoCamera, StereoFrame
from fgreg.drivers.endoscope import Endoscope, EndoscopeConfig, InputConfig, Layout, video_devices
from fgreg.drivers.interlacing import Fields
from fgreg.drivers.stereo_matching import StereoMatcher
from fgreg.drivers.video_input import SILENCE_S, Grabbed, Timing, VideoInput
from fgreg.errors import InputError
from fgreg.model.time_sync import Stamp
from fgreg.testing.drivers import Bench, check_driver

Picture = npt.NDArray[np.uint8]


def shade(value: int, size: tuple[int, int] = (64, 48)) -> Picture:
    return np.full((size[1], size[0], 3), value, dtype=np.uint8)


def video(path: Path, pictures: list[Picture], fps: float = 50.0) -> str:
    """A video as OpenCV's writer makes it (motion JPEG)."""
    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, (width, height))
    assert writer.isOpened()
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return str(path)


def collect(
    endoscope: StereoCamera,
    enough: Callable[[list[StereoFrame], list[str]], bool],
    limit_s: float = 8.0,
    pause_s: float = 0.003,
) -> Any:
    """Polls as a live loop does, until there is enough: frames, and losses in words."""
    frames: list[StereoFrame] = []
    losses: list[str] = []
    until = time.monotonic() + limit_s
    while not enough(frames, losses):
        assert time.monotonic() < until, (len(frames), losses)
        try:
            frames += endoscope.poll()
        except DeviceLost as error:
            losses.append(str(error))
        time.sleep(pause_s)
    if losses:
        frames += endoscope.poll()  # what came with the last loss
    return frames, losses


def test_two_video_files_come_out_as_stereo_frames_with_their_own_times_and_end_with_one_loss_each(
    tmp_path: Path,
) -> None:
    left = video(tmp_path / "l.avi", [shade(10 * i) for i in range(10)])
    right = video(tmp_path / "r.avi", [shade(10 * i + 5) for i in range(10)])
    endoscope = Endoscope(EndoscopeConfig(InputConfig(left), InputConfig(right), Layout.SEPARATE))
    try:
        frames, losses = collect(endoscope, lambda _, losses: len(losses) == 2)
        assert [frame.index for frame in frames] == list(range(10))
        for i, frame in enumerate(frames):
            assert frame.right is not None
            assert float(frame.left.mean()) == pytest.approx(10 * i, abs=2)
            assert float(frame.right.mean()) == pytest.approx(10 * i + 5, abs=2)
            assert frame.stamp.device_s == pytest.approx(i / 50.0)
        # Played at their own pace: the last one does not come before nine periods have passed.
        assert frames[-1].stamp.host_s - frames[0].stamp.host_s >= 8.5 / 50.0
        assert all("played to its end" in loss for loss in losses)
        assert endoscope.ended
        assert not endoscope.connected
        assert endoscope.poll() == []
    finally:
        endoscope.close()
        endoscope.close()


@pytest.mark.parametrize("layout", [Layout.SIDE_BY_SIDE, Layout.TOP_BOTTOM])
@pytest.mark.parametrize("swap", [False, True])
def test_frames_that_hold_both_views_are_halved(tmp_path: Path, layout: Layout, swap: bool) -> None:
    axis = 1 if layout is Layout.SIDE_BY_SIDE else 0
    path = video(tmp_path / "v.avi", [np.concatenate([shade(40), shade(200)], axis=axis)] * 3)
    endoscope = Endoscope(EndoscopeConfig(InputConfig(path), layout=layout, swap=swap))
    try:
        frames, _ = collect(endoscope, lambda frames, _: len(frames) == 3)
    finally:
        endoscope.close()
    right = frames[0].right
    assert right is not None
    assert frames[0].left.shape == right.shape == (48, 64, 3)
    means = [float(frames[0].left.mean()), float(right.mean())]
    assert means == pytest.approx([200, 40] if swap else [40, 200], abs=4)


def test_a_layout_that_does_not_fit_the_frames_is_reported(tmp_path: Path) -> None:
    for number, width in enumerate((65, 65, *[64] * 30)):
        cv2.imwrite(str(tmp_path / f"{number:02d}.png"), shade(3, (width, 48)))
    endoscope = Endoscope(EndoscopeConfig(InputConfig(str(tmp_path)), layout=Layout.SIDE_BY_SIDE))
    try:
        connected: list[bool] = []

        def enough(frames: list[StereoFrame], losses: list[str]) -> bool:
            if len(losses) == 1 and not frames:
                connected.append(endoscope.connected)
            return bool(frames)

        frames, losses = collect(endoscope, enough)
    finally:
        endoscope.close()
    assert frames[0].left.shape[:2] == (48, 32)
    (misfit,) = [loss for loss in losses if "65 x 48 px, expected frames that can be halved" in loss]
    assert misfit == losses[0]
    assert not connected[0]
    assert endoscope.dropped == 2


def test_interlaced_frames_give_two_half_height_pictures_half_a_period_apart(tmp_path: Path) -> None:
    for i in range(4):
        frame = shade(20)
        frame[1::2] = 220
        cv2.imwrite(str(tmp_path / f"frame_{i:03d}.png"), frame)
    endoscope = Endoscope(EndoscopeConfig(InputConfig(str(tmp_path), fps=25.0), fields=Fields.BOTH))
    try:
        frames, _ = collect(endoscope, lambda frames, _: len(frames) == 8)
    finally:
        endoscope.close()
    assert [frame.left.shape for frame in frames] == [(24, 64, 3)] * 8
    assert [int(frame.left[5, 5, 0]) for frame in frames[:2]] == [20, 220]
    assert [frame.index for frame in frames] == list(range(8))
    times = [frame.stamp.device_s for frame in frames[2:]]
    np.testing.assert_allclose(np.diff(times), 0.02, atol=1e-9)


def test_a_picture_missing_in_one_folder_does_not_shift_the_others(tmp_path: Path) -> None:
    for side, offset in (("left", 0), ("right", 100)):
        (tmp_path / side).mkdir()
        for i in range(8, 13):  # 8 to 12: names without leading zeros, which sort wrongly as texts
            if (side, i) != ("right", 10):
                cv2.imwrite(str(tmp_path / side / f"img{i}.png"), shade(offset + i))
    (tmp_path / "left" / "notes.txt").write_text("no picture")
    left, right = (InputConfig(str(tmp_path / side / "*.png"), fps=50.0) for side in ("left", "right"))
    endoscope = Endoscope(EndoscopeConfig(left, right, Layout.SEPARATE, max_gap_s=0.009))
    try:
        frames, _ = collect(endoscope, lambda _, losses: len(losses) == 2)
    finally:
        endoscope.close()
    pairs = [(int(frame.left.mean()), int(frame.right.mean())) for frame in frames if frame.right is not None]
    assert pairs == [(8, 108), (9, 109), (11, 111), (12, 112)]
    assert endoscope.dropped == 1


def test_a_looped_folder_goes_on_with_times_that_only_increase(tmp_path: Path) -> None:
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"{i}.png"), shade(i))
    endoscope = Endoscope(EndoscopeConfig(InputConfig(str(tmp_path), fps=100.0, loop=True)))
    try:
        frames, losses = collect(endoscope, lambda frames, _: len(frames) >= 8)
    finally:
        endoscope.close()
    assert losses == []
    assert [int(frame.left.mean()) for frame in frames[:8]] == [0, 1, 2, 0, 1, 2, 0, 1]
    np.testing.assert_allclose(np.diff([frame.stamp.device_s for frame in frames[:8]]), 0.01, atol=1e-9)


def test_frames_not_fetched_are_dropped_oldest_first_and_counted(tmp_path: Path) -> None:
    for i in range(30):
        cv2.imwrite(str(tmp_path / f"{i}.png"), shade(i))
    endoscope = Endoscope(EndoscopeConfig(InputConfig(str(tmp_path), fps=500.0), queue=4))
    try:
        until = time.monotonic() + 5.0
        while not endoscope.ended and time.monotonic() < until:
            time.sleep(0.01)
        frames = endoscope.poll()
    finally:
        endoscope.close()
    assert [frame.index for frame in frames] == [26, 27, 28, 29]
    assert endoscope.dropped == 26


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("nowhere.avi", r"nowhere\.avi: found nothing, expected a video device"),
        ("empty", "found no pictures, expected files that end in"),
        ("text.avi", "found a file that FFMPEG cannot read"),
        ("nowhere/*.png", "found no such folder"),
    ],
)
def test_an_invalid_source_is_reported_at_once(tmp_path: Path, source: str, message: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.avi").write_text("no video")
    with pytest.raises(InputError, match=message):
        Endoscope(EndoscopeConfig(InputConfig(str(tmp_path / source))))


def test_a_video_of_frames_too_large_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = video(tmp_path / "a.avi", [shade(1)])
    monkeypatch.setattr("fgreg.drivers.endoscope.PICTURE_PIXELS", 64 * 48 - 1)
    with pytest.raises(InputError, match="frames of 64 x 48 px, more than 3071"):
        Endoscope(EndoscopeConfig(InputConfig(source)))


def test_a_device_that_was_never_there_is_lost_within_a_second_and_closing_does_not_wait() -> None:
    endoscope = Endoscope(EndoscopeConfig(InputConfig("/dev/video4711", silence_s=0.4)))
    began = time.monotonic()
    _, losses = collect(endoscope, lambda _, losses: bool(losses))
    assert time.monotonic() - began < 1.0
    assert losses == ["endoscope: video input /dev/video4711: it could not be opened"]
    endoscope.close()
    assert time.monotonic() - began < 2.0


class Camera(http.server.BaseHTTPRequestHandler):
    """A network camera: motion JPEG over HTTP, as the server's ``mode`` says."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        server: Any = self.server
        try:
            for i in itertools.count():
                if server.mode == "gone":
                    return
                if server.mode == "sending":
                    data = cv2.imencode(".jpg", shade(i % 250))[1].tobytes()
                    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                    self.wfile.write(head.encode() + data + b"\r\n")
                time.sleep(0.02)
        except OSError:
            return

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing on standard error."""


@pytest.fixture
def camera() -> Iterator[Any]:
    server: Any = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Camera)
    server.daemon_threads = True
    server.mode = "sending"
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    yield server
    server.mode = "gone"
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize("failure", ["gone", "silent"])
def test_a_stream_that_stops_is_reported_within_a_second_and_comes_back_by_itself(camera: Any, failure: str) -> None:
    assert SILENCE_S < 0.8  # the default leaves the live loop a fifth of a second
    config = EndoscopeConfig(InputConfig(f"http://127.0.0.1:{camera.server_address[1]}/video.mjpg", silence_s=0.4))

    def mode(name: str) -> Callable[[], None]:
        return lambda: setattr(camera, "mode", name)

    check_driver("camera", Bench(lambda: Endoscope(config), lose=mode(failure), restore=mode("sending")))


def test_where_the_right_camera_is_lost_the_left_one_goes_on_alone_until_it_is_back(
    tmp_path: Path, camera: Any
) -> None:
    for i in range(4):
        cv2.imwrite(str(tmp_path / f"{i}.png"), shade(50 + i))
    left = InputConfig(str(tmp_path), fps=50.0, loop=True)
    right = InputConfig(f"http://127.0.0.1:{camera.server_address[1]}/video.mjpg")
    endoscope = Endoscope(EndoscopeConfig(left, right, Layout.SEPARATE))
    try:
        collect(endoscope, lambda frames, _: sum(frame.right is not None for frame in frames) > 5)
        camera.mode = "gone"
        # The loss is reported also to a loop so slow that there are frames at every call.
        _, losses = collect(endoscope, lambda _, losses: bool(losses), pause_s=0.06)
        assert "the left camera goes on alone" in losses[0]
        alone, _ = collect(endoscope, lambda frames, _: len(frames) > 5)
        assert all(frame.right is None for frame in alone[-3:])
        camera.mode = "sending"
        collect(endoscope, lambda frames, _: any(frame.right is not None for frame in frames[-3:]))
        assert endoscope.connected
    finally:
        endoscope.close()


class Scripted:
    """A scripted capture: pictures with positions, then nothing more."""

    def __init__(self, positions_s: list[float]) -> None:
        self.positions_s, self.next = positions_s, 0

    def isOpened(self) -> bool:
        return True

    def read(self) -> tuple[bool, Any]:
        time.sleep(0.002)
        self.next += 1
        return self.next <= len(self.positions_s), shade(self.next)

    def get(self, property_id: int, /) -> float:
        known = property_id == cv2.CAP_PROP_POS_MSEC and self.next <= len(self.positions_s)
        return 1000.0 * self.positions_s[self.next - 1] if known else 0.0

    def release(self) -> None:
        """Nothing held."""


def grabbed_of(captures: list[Scripted | None], timing: Timing, count: int) -> list[Grabbed]:
    waiting = iter(captures)
    device = VideoInput("scripted", lambda: next(waiting, None), timing, queue=64)
    found: list[Grabbed] = []
    until = time.monotonic() + 5.0
    while len(found) < count and time.monotonic() < until:
        try:
            found += device.poll()
        except DeviceLost:
            continue
        time.sleep(0.002)
    device.close()
    return found


def test_device_times_are_the_captures_less_the_delay_and_the_hosts_where_they_do_not_advance() -> None:
    found = grabbed_of([Scripted([100.0, 100.04, 100.04, 100.12])], Timing(delay_s=0.01), 4)
    assert [g.stamp.device_s for g in found[:2]] == pytest.approx([99.99, 100.03])
    assert found[2].stamp.device_s == pytest.approx(found[2].stamp.host_s - 0.01)
    assert found[3].stamp.device_s == pytest.approx(found[3].stamp.host_s - 0.01)


def test_a_device_plugged_in_again_has_its_own_clock_again() -> None:
    captures = [Scripted([100.0, 100.04]), None, Scripted([3.0, 3.04])]
    found = grabbed_of(captures, Timing(), 4)
    assert [g.stamp.device_s for g in found] == pytest.approx([100.0, 100.04, 3.0, 3.04])
    assert [g.index for g in found] == [0, 1, 2, 3]


def test_a_capture_that_raises_is_opened_again() -> None:
    attempts = iter([RuntimeError("busy"), None])

    def opening() -> Scripted:
        error = next(attempts)
        if error is not None:
            raise error
        return Scripted([0.0, 0.1])

    device = VideoInput("raising", opening, Timing(), queue=4)
    found: list[Grabbed] = []
    until = time.monotonic() + 5.0
    while not found and time.monotonic() < until:
        found += device.poll()
        time.sleep(0.005)
    device.close()
    assert found


def test_video_devices_are_listed_by_number_with_their_drivers_names(tmp_path: Path) -> None:
    for name, label in (("video10", "Capture B\n"), ("video2", "Capture A\n"), ("video3", None)):
        (tmp_path / name).mkdir()
        if label is not None:
            (tmp_path / name / "name").write_text(label)
    assert video_devices(tmp_path) == [("/dev/video2", "Capture A"), ("/dev/video3", ""), ("/dev/video10", "Capture B")]
    assert video_devices(tmp_path / "none") == []


def at(*times_s: float) -> list[Grabbed]:
    return [Grabbed(Stamp(t, t), shade(0, (2, 2)), i) for i, t in enumerate(times_s)]


def matched(matcher: StereoMatcher, left: list[Grabbed], right: list[Grabbed], **more: Any) -> list[Any]:
    pairs = matcher.take(left, right, **more)
    return [(a.stamp.device_s, None if b is None else b.stamp.device_s) for a, b in pairs]


def test_each_left_frame_gets_its_nearest_right_one_once() -> None:
    matcher = StereoMatcher(0.02, lambda g: g.stamp.device_s)
    assert matched(matcher, at(0.000, 0.033), at(0.004)) == [(0.0, 0.004)]
    # 0.033 waits: a nearer right frame may still come.
    assert matched(matcher, [], at(0.037)) == [(0.033, 0.037)]
    # A right frame lost on its way: that left frame has no partner within the gap.
    assert matched(matcher, at(0.067, 0.100), at(0.104)) == [(0.1, 0.104)]
    assert matcher.dropped == 1


def test_a_right_camera_twice_as_fast_loses_every_other_frame() -> None:
    matcher = StereoMatcher(0.02, lambda g: g.stamp.device_s)
    right = at(*(0.0167 * k for k in range(12)))
    pairs = matched(matcher, at(*(0.0333 * k for k in range(5))), right)
    assert [round(b / 0.0167) for _, b in pairs] == [0, 2, 4, 6, 8]
    assert matcher.dropped == 4


def test_without_a_right_camera_left_frames_go_out_alone_and_waiting_is_bounded() -> None:
    matcher = StereoMatcher(0.02, lambda g: g.stamp.device_s, room=3)
    assert matched(matcher, at(0.0, 0.033, 0.067, 0.1, 0.133), []) == []
    assert matcher.dropped == 2
    assert matched(matcher, [], at(0.068), right_expected=False) == [(0.067, 0.068), (0.1, None), (0.133, None)]
