"""ROS 2 recordings played back as devices: CRTK poses in metres, raw and compressed images, damaged files."""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fgreg.drivers.base import DeviceLost, MotionSource, StereoCamera
from fgreg.drivers.recorded_devices import Pace, RecordedCamera, RecordedMotion
from fgreg.drivers.ros_messages import array_of, info_of, picture_of, pose_of, scan_deg_of
from fgreg.drivers.ros_recordings import Recording
from fgreg.errors import InputError, MissingExtraError
from tests import bags

FAST = 1000.0
HALF = math.sqrt(0.5)
# A quarter turn about x, y goes to z. By hand.
QUARTER_MM = np.array([[1.0, 0, 0, 10], [0, 0, -1, -20], [0, 1, 0, 150], [0, 0, 0, 1]])
QUARTER = (0.010, -0.020, 0.150, HALF, 0.0, 0.0, HALF)


def play(device: MotionSource | StereoCamera, limit_s: float = 5.0) -> list[Any]:
    """Everything until the end is reported."""
    out: list[Any] = []
    until = time.monotonic() + limit_s
    while time.monotonic() < until:
        try:
            out += device.poll()
        except DeviceLost:
            assert device.poll() == []
            assert not device.connected
            device.close()
            device.close()
            return out
        time.sleep(0.001)
    raise AssertionError("no end")


@pytest.mark.parametrize("kind", ["sqlite", "mcap", "mcap-file"])
@pytest.mark.parametrize("message", ["PoseStamped", "TransformStamped"])
def test_crtk_poses_of_the_endoscope_come_in_millimetres(tmp_path: Path, kind: str, message: str) -> None:
    make = bags.pose_stamped if message == "PoseStamped" else bags.transform_stamped
    poses = [
        ("/ECM/measured_cp", 0.01 * i, make(0.01 * i, (0.01 + 0.001 * i, -0.02, 0.15), QUARTER[3:])) for i in range(5)
    ]
    local = [("/ECM/local/measured_cp", 0.0, make(0.0, (9, 9, 9)))]
    folder = bags.write_bag(tmp_path / "bag", poses + local, mcap=kind != "sqlite")
    path = next(folder.glob("*.mcap")) if kind == "mcap-file" else folder
    samples = play(RecordedMotion(path, pace=Pace.of(path, FAST)))
    assert len(samples) == 5
    np.testing.assert_allclose(samples[0].base_T_camera, QUARTER_MM, atol=1e-12)
    assert samples[4].base_T_camera[0, 3] == pytest.approx(14.0)
    assert samples[1].stamp.device_s - bags.START_NS / 1e9 == pytest.approx(0.01, abs=1e-6)
    assert samples[0].stamp.host_s == pytest.approx(time.monotonic(), abs=5.0)


def test_a_file_of_the_mcap_library_with_messages_packed_by_hand_reads_the_same(tmp_path: Path) -> None:
    path = bags.write_mcap(
        tmp_path / "r.mcap", "/dvrk/ECM/measured_cp", [(0.0, QUARTER), (0.5, (0, 0, 0.1, 0, 0, 0, 1))]
    )
    samples = play(RecordedMotion(path, pace=Pace.of(path, FAST)))
    np.testing.assert_allclose(samples[0].base_T_camera, QUARTER_MM, atol=1e-12)
    assert samples[1].base_T_camera[2, 3] == pytest.approx(100.0)
    assert samples[1].stamp.device_s - samples[0].stamp.device_s == pytest.approx(0.5, abs=1e-6)


def test_a_camera_that_is_not_at_the_tip_is_carried_along_with_its_covariance(tmp_path: Path) -> None:
    # ROS: (x, y, z, turns) along the base's axes, m and rad. Only a turn about the base's x: 0.01 rad.
    covariance = np.zeros((6, 6))
    covariance[3, 3] = 1e-4
    message = bags.pose_with_covariance(0.0, (0, 0, 0), QUARTER[3:], covariance)
    path = bags.write_bag(tmp_path / "bag", [("/ecm", 0.0, message)])
    tip_T_camera = np.eye(4)
    tip_T_camera[:3, 3] = (0.0, 0.0, 30.0)
    [sample] = play(RecordedMotion(path, "/ecm", tip_T_camera, Pace.of(path, FAST)))
    # 30 mm along the tip's z is 30 mm along -y of the base.
    np.testing.assert_allclose(sample.base_T_camera[:3, 3], [0, -30, 0], atol=1e-12)
    # By finite differences: the camera's pose when the tip is turned by xi about the base's x (that is the tip's x).
    step = 1e-6
    turned = bags.pose_stamped(
        0.0, (0, 0, 0), (math.sin(math.pi / 4 + step / 2), 0, 0, math.cos(math.pi / 4 + step / 2))
    )
    moved = pose_of(turned)[0] @ tip_T_camera
    xi = (np.linalg.inv(sample.base_T_camera) @ moved - np.eye(4)) / step
    tangent = np.array([xi[2, 1], xi[0, 2], xi[1, 0], *xi[:3, 3]])
    np.testing.assert_allclose(sample.covariance, 1e-4 * np.outer(tangent, tangent), atol=1e-7)


def test_poses_that_are_none_are_left_out_and_counted(tmp_path: Path) -> None:
    messages = [
        ("/ECM/measured_cp", 0.0, bags.pose_stamped(0.0, (0, 0, 0), (0, 0, 0, 0))),
        ("/ECM/measured_cp", 0.1, bags.pose_stamped(0.1, (0, math.nan, 0))),
        ("/ECM/measured_cp", 0.2, bags.pose_stamped(0.2, (0, 0, 0.1))),
    ]
    path = bags.write_bag(tmp_path / "bag", messages)
    device = RecordedMotion(path, pace=Pace.of(path, FAST))
    assert len(play(device)) == 1
    assert device.dropped == 2


def test_samples_come_when_they_are_due_and_old_ones_are_dropped_where_not_fetched(tmp_path: Path) -> None:
    topic = "/ECM/measured_cp"
    path = bags.write_bag(
        tmp_path / "bag", [(topic, 0.01 * i, bags.pose_stamped(0.01 * i, (i, 0, 0))) for i in range(40)]
    )
    pace = Pace(bags.START_NS / 1e9, time.monotonic() + 100.0)
    early = RecordedMotion(path, pace=pace)
    assert early.poll() == []
    assert early.connected
    early.close()
    late = RecordedMotion(path, pace=Pace(bags.START_NS / 1e9, time.monotonic() - 100.0), room=8)
    found = late.poll()
    assert [round(sample.base_T_camera[0, 3] / 1000) for sample in found] == list(range(32, 40))
    assert late.dropped == 32
    late.close()


def test_a_joint_state_whose_names_and_positions_differ_in_number_is_named() -> None:
    message = bags.joint_state(0.0, ["inner", "outer"], [0.5])
    with pytest.raises(ValueError, match="1 positions of 2 joints"):
        scan_deg_of(message, "outer", "rad")


def shade(value: int) -> Any:
    return np.full((48, 64, 3), value, dtype=np.uint8)


def test_raw_and_compressed_images_come_as_stereo_frames_matched_by_their_headers(tmp_path: Path) -> None:
    messages: list[bags.Message] = []
    for i in range(6):
        t = i / 30
        messages.append(
            (
                "/davinci/left/image_raw",
                t,
                bags.image(t, "rgb8", shade(10 * i) + np.array([0, 1, 2], np.uint8), padding=6),
            )
        )
        if i != 3:  # lost on its way
            data = cv2.imencode(".png", shade(10 * i + 5))[1].tobytes()
            messages.append(("/davinci/right/image_raw/compressed", t + 0.02, bags.compressed(t + 0.002, data)))
    path = bags.write_bag(tmp_path / "bag", messages, mcap=True)
    device = RecordedCamera(path, pace=Pace.of(path, 5.0))
    frames = play(device)
    assert [frame.index for frame in frames] == [0, 1, 2, 4, 5]
    assert device.dropped == 1
    for frame in frames:
        assert frame.left[0, 0].tolist() == [10 * frame.index + 2, 10 * frame.index + 1, 10 * frame.index]  # BGR
        assert frame.right[0, 0].tolist() == [10 * frame.index + 5] * 3
        assert frame.left.shape == (48, 64, 3)


def test_deep_images_are_played_with_their_depth(tmp_path: Path) -> None:
    deep = np.arange(24, dtype=np.uint16).reshape(4, 6) * 170
    path = bags.write_bag(tmp_path / "bag", [("/left/image_raw", 0.0, bags.image(0.0, "mono16", deep))], mcap=True)
    (frame,) = play(RecordedCamera(path, pace=Pace.of(path, 5.0)))
    np.testing.assert_array_equal(frame.left, deep)


def test_the_unrectified_raw_topic_of_a_side_is_preferred_and_ambiguity_is_reported(tmp_path: Path) -> None:
    grey = bags.image(0.0, "mono8", np.zeros((4, 6), np.uint8))
    names = ["/rig/left/image_raw", "/rig/left/image_rect", "/rig/right/image_rect", "/leftover/image_raw"]
    with Recording(bags.write_bag(tmp_path / "a", [(name, 0.0, grey) for name in names])) as recording:
        assert recording.image_topic("left") == "/rig/left/image_raw"
        assert recording.image_topic("right") == "/rig/right/image_rect"
    path = bags.write_bag(tmp_path / "b", [(name, 0.0, grey) for name in ("/a/left/image_raw", "/b/left/image_raw")])
    with pytest.raises(InputError, match=r"left camera: found /a/left/image_raw, /b/left/image_raw, expected one"):
        RecordedCamera(path)


@pytest.mark.parametrize(("encoding", "channels"), [("mono8", 1), ("bgr8", 3), ("rgba8", 4), ("bayer_rggb8", 1)])
def test_image_encodings(encoding: str, channels: int) -> None:
    colours = {"mono8": [90], "bgr8": [1, 2, 3], "rgba8": [3, 2, 1, 255], "bayer_rggb8": [0]}[encoding]
    array = np.tile(np.array(colours, np.uint8), (8, 8, 1))
    if encoding.startswith("bayer"):  # red 200, green 100, blue 50
        array[0::2, 0::2], array[0::2, 1::2], array[1::2, 0::2], array[1::2, 1::2] = 200, 100, 100, 50
    picture = picture_of(bags.image(0.0, encoding, array if channels > 1 else array[..., 0], padding=3))
    expected = {"mono8": 90, "bgr8": [1, 2, 3], "rgba8": [1, 2, 3], "bayer_rggb8": [50, 100, 200]}[encoding]
    assert picture[4, 4].tolist() == expected


@pytest.mark.parametrize("big", [False, True])
def test_pictures_of_16_bits_keep_all_of_them(big: bool) -> None:
    ramp = np.arange(0, 48 * 80, 80, dtype=np.uint16).reshape(6, 8)
    np.testing.assert_array_equal(picture_of(bags.image(0.0, "mono16", ramp, padding=2, big=big)), ramp)
    colour = np.stack([ramp, ramp + 1, ramp + 2], axis=2)
    np.testing.assert_array_equal(picture_of(bags.image(0.0, "rgb16", colour, big=big)), colour[..., ::-1])
    png = cv2.imencode(".png", ramp)[1].tobytes()
    np.testing.assert_array_equal(picture_of(bags.compressed(0.0, png)), ramp)


@pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuyv", "yuv422_yuy2", "nv21", "nv12"])
def test_pictures_of_luma_and_chroma(encoding: str) -> None:
    # One colour by BT.601 in studio range: pure red is Y 82, U 90, V 240 (8 bits).
    y, u, v = 82, 90, 240
    if encoding.startswith("nv"):
        chroma = [v, u] if encoding == "nv21" else [u, v]
        message = bags.image(0.0, encoding, np.full((4, 8), y, np.uint8))
        message.data = np.concatenate([message.data, np.tile(np.array(chroma, np.uint8), 8)])
    else:
        words = [u, y, v, y] if encoding in ("yuv422", "uyvy") else [y, u, y, v]
        message = bags.image(0.0, encoding, np.tile(np.array(words, np.uint8).reshape(2, 2), (4, 4, 1)), padding=4)
    picture = picture_of(message)
    assert picture.shape == (4, 8, 3)
    assert np.abs(picture.astype(int) - [0, 0, 255]).max() <= 2


@pytest.mark.parametrize("big", [False, True])
def test_probe_frames_keep_their_numbers_in_either_byte_order(big: bool) -> None:
    data = np.arange(12, dtype=np.int16).reshape(3, 4) - 6
    found = array_of(bags.image(0.0, "16SC1", data, padding=2, big=big))
    np.testing.assert_array_equal(found, data)
    assert found.dtype == np.int16
    waves = np.linspace(-1, 1, 12, dtype=np.float32).reshape(3, 4)
    np.testing.assert_array_equal(array_of(bags.image(0.0, "32FC1", waves, big=big)), waves)
    np.testing.assert_array_equal(array_of(bags.multi_array(waves)), waves)


def test_messages_that_do_not_hold_what_they_say_are_reported() -> None:
    short = bags.image(0.0, "mono8", np.zeros((4, 4), np.uint8))
    short.data = short.data[:7]
    with pytest.raises(ValueError, match="7 bytes of 4 x 4 px"):
        picture_of(short)
    with pytest.raises(ValueError, match="encoded as nv24, which is none of mono8"):
        picture_of(bags.image(0.0, "nv24", np.zeros((4, 4), np.uint8)))
    with pytest.raises(ValueError, match="16 bytes of 4 x 6 px"):
        picture_of(bags.image(0.0, "nv21", np.zeros((4, 4), np.uint8)))
    with pytest.raises(ValueError, match="5 x 4 px, which are not even"):
        picture_of(bags.image(0.0, "yuyv", np.zeros((4, 5, 2), np.uint8)))
    with pytest.raises(ValueError, match="cannot be decoded"):
        picture_of(bags.compressed(0.0, b"nothing", "jpeg"))
    with pytest.raises(ValueError, match="two that fit"):
        array_of(bags.multi_array(np.zeros(4, np.float32)))


def test_stage_angles_of_joints_numbers_and_poses() -> None:
    joints = bags.joint_state(0.0, ["a", "stage"], [9.0, math.pi / 6])
    assert scan_deg_of(joints, "stage", "rad") == pytest.approx(30.0)
    with pytest.raises(ValueError, match="2 joints"):
        scan_deg_of(joints, None, "rad")
    with pytest.raises(ValueError, match="no joint other"):
        scan_deg_of(joints, "other", "rad")
    assert scan_deg_of(bags.number(-12.5), None, "deg") == -12.5
    # A probe turned by -0.2 rad about x: its z axis along (0, sin 0.2, cos 0.2).
    pose = bags.transform_stamped(0.0, (0, 0, 0), (math.sin(-0.1), 0, 0, math.cos(-0.1)))
    assert scan_deg_of(pose, None, "rad") == pytest.approx(math.degrees(0.2))
    with pytest.raises(ValueError, match="not about x"):
        scan_deg_of(bags.transform_stamped(0.0, (0, 0, 0), (0, math.sin(0.1), 0, math.cos(0.1))), None, "rad")


def test_camera_info_messages_are_the_files_of_the_same_name() -> None:
    k, r = [[50.0, 0, 32], [0, 50, 24], [0, 0, 1]], np.eye(3)
    p = [[50.0, 0, 32, -0.25], [0, 50, 24, 0], [0, 0, 1, 0]]
    info = info_of(bags.camera_info(0.0, k, [0.1, 0, 0, 0, 0], r, p), "here")
    assert info.image_size == (64, 48)
    np.testing.assert_array_equal(info.projection, p)
    message = bags.camera_info(0.0, k, [0.1, 0, 0, 0, 0], r, p)
    message.binning_x = 2
    with pytest.raises(InputError, match="here: binning_x: found 2"):
        info_of(message, "here")


@pytest.mark.parametrize("damage", ["empty", "text", "cut", "folder"])
def test_a_damaged_recording_is_one_line(tmp_path: Path, damage: str) -> None:
    path = bags.write_mcap(tmp_path / "r.mcap", "/ECM/measured_cp", [(0.1 * i, QUARTER) for i in range(50)])
    if damage == "empty":
        path.write_bytes(b"")
    elif damage == "text":
        path.write_text("no recording")
    elif damage == "cut":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    else:
        path = tmp_path
    with pytest.raises(InputError) as caught:
        RecordedMotion(path)
    assert str(caught.value).isprintable()
    assert str(path) in str(caught.value)


def test_a_topic_that_is_not_there_or_of_another_type_names_those_that_would_do(tmp_path: Path) -> None:
    messages = [("/PSM1/measured_cp", 0.0, bags.pose_stamped(0.0, (0, 0, 0))), ("/angle", 0.0, bags.number(1.0))]
    path = bags.write_bag(tmp_path / "bag", messages)
    with pytest.raises(InputError, match=r"/ECM/measured_cp: found no such topic.*there is /PSM1/measured_cp"):
        RecordedMotion(path)
    with pytest.raises(InputError, match=r"/angle: found std_msgs/msg/Float64"):
        RecordedMotion(path, "/angle")
    with pytest.raises(InputError, match="no images of a left camera"):
        RecordedCamera(path)


def test_without_rosbags_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'fgreg\[ros\]'"):
        Recording(tmp_path)


@pytest.mark.parametrize(
    ("usual", "other", "field"),
    [
        ("MSG: geometry_msgs/Point\nfloat64 x", "MSG: geometry_msgs/Point\nfloat64 X2", "geometry_msgs/msg/Point.x"),
        ("string frame_id", "string name", "std_msgs/msg/Header.frame_id"),
        ("geometry_msgs/Point position", "geometry_msgs/Point place", "geometry_msgs/msg/Pose.position"),
        ("float64 w", "string w", "geometry_msgs/msg/Quaternion.w"),
    ],
)
def test_a_definition_that_is_not_ros_own_is_one_line(tmp_path: Path, usual: str, other: str, field: str) -> None:
    assert bags.POSE_STAMPED.count(usual + "\n") == 1
    definition = bags.POSE_STAMPED.replace(usual + "\n", other + "\n")
    path = bags.write_mcap(tmp_path / "a.mcap", "/pose", [(0.0, (0, 0, 0, 0, 0, 0, 1))], definition)
    with Recording(path) as recording:
        (recorded,) = recording.messages(["/pose"])
        with pytest.raises(InputError, match=f"PoseStamped defined without the usual {field}, expected ROS's own"):
            recording.decode(recorded)
