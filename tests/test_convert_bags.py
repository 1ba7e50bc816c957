"""ROS 2 recordings as sessions: what is put together by time, camera moves by the ECM, frames, and what is left out."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from fgreg.cli.main import app
from fgreg.convert.bag import read_bag
from fgreg.convert.mapping import read_mapping
from fgreg.errors import FgregError
from fgreg.geometry.quaternions import quaternion_from_rotation
from fgreg.pipeline.solve import SolveRequest, solve_session
from fgreg.session.session_reader import read_session
from tests import bags, session_files

RUNNER = CliRunner()


def convert(*words: object) -> Any:
    return RUNNER.invoke(app, ["convert", *map(str, words)])


def refused(*words: object) -> str:
    done = convert(*words)
    assert isinstance(done.exception, FgregError), done.output
    assert str(done.exception).isprintable()
    return str(done.exception)


def events(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "events.jsonl").read_text(encoding="utf-8").splitlines()]


def setup(folder: Path, camera: bool = True) -> Path:
    data = session_files.setup()
    data["probe"]["image"] = {"pixel_mm": [0.1, 0.2], "origin_mm": [1.0, -20.0]}
    if camera:
        data["camera"]["image_size"] = [64, 48]
    else:
        del data["camera"]
    path = folder / "setup.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return path


def mapping(folder: Path, **content: Any) -> Path:
    path = folder / "map.yaml"
    path.write_text(yaml.safe_dump({"format": "fgreg-mapping/1", **content}), encoding="utf-8")
    return path


def pose_message(t: float, matrix: Any) -> Any:
    matrix = np.array(matrix)
    return bags.pose_stamped(t, matrix[:3, 3] / 1000.0, quaternion_from_rotation(matrix[:3, :3]))


def test_a_session_recorded_on_ros_topics_comes_back_and_is_solved_the_same(pose_session: Path, tmp_path: Path) -> None:
    recorded = events(pose_session)
    messages: list[bags.Message] = []
    for event in recorded:
        t = event["t"]
        times = (t - 0.02, t + 0.02)  # the marker stands still around each shot
        messages += [("/fgreg/marker", at, pose_message(at, event["marker"]["camera_T_marker"])) for at in times]
        scan = event.get("trus", event).get("scan_deg", 0.0)
        messages.append(("/fgreg/scan", t - 0.01, bags.joint_state(t - 0.01, ["stage"], [math.radians(scan)])))
        messages.append(("/fgreg/scan", t + 0.01, bags.joint_state(t + 0.01, ["stage"], [math.radians(scan)])))
        if "trus" in event:
            look = bags.point_stamped(t, (event["trus"]["x_mm"] / 1000.0, 0.0, event["trus"]["range_mm"] / 1000.0))
            messages.append(("/fgreg/look", t, look))
        mark: dict[str, Any] = {key: event[key] for key in ("type", "pm", "camera_p_spot_mm") if key in event}
        if sweep := event.get("trus", {}).get("sweep"):
            mark["sweep"] = sweep
        messages.append(("/fgreg/mark", t, bags.text(json.dumps(mark))))
    path = bags.write_bag(tmp_path / "bag", messages, mcap=True)
    done = convert(path, tmp_path / "out", "--setup", pose_session)
    assert done.exit_code == 0, done.output
    assert "12 aim, 20 pair, 4 track" in done.stdout
    before = read_session(pose_session).events
    after = read_session(tmp_path / "out").events[1:]
    for old, new in zip(before, after, strict=True):
        assert type(old) is type(new)
    found = [event for event in events(tmp_path / "out") if event["type"] != "note"]
    for was, now in zip(recorded, found, strict=True):
        np.testing.assert_allclose(now["marker"]["camera_T_marker"], was["marker"]["camera_T_marker"], atol=1e-6)
        assert ("trus" in now) == ("trus" in was)
        if was["type"] == "track" and "trus" not in was:
            assert now["scan_deg"] == pytest.approx(was["scan_deg"])
        if "trus" in was:
            assert now["trus"]["range_mm"] == pytest.approx(was["trus"]["range_mm"], abs=1e-6)
            assert now["trus"]["scan_deg"] == pytest.approx(was["trus"]["scan_deg"], abs=1e-6)
            assert now["trus"].get("sweep") == was["trus"].get("sweep")
            assert now.get("pm") == was.get("pm")
    first = solve_session(SolveRequest(pose_session, tmp_path / "a.yaml")).estimate.epochs[-1].trus_T_camera
    again = solve_session(SolveRequest(tmp_path / "out")).estimate.epochs[-1].trus_T_camera
    assert first is not None
    assert again is not None
    np.testing.assert_allclose(again, first, atol=1e-3)


def room(**left_out: bool) -> list[bags.Message]:
    """Two looks by the probe's channel data at 1 and 2 s, stereo images at 10 frames/s, the stage turning 10 deg/s."""
    rng = np.random.default_rng(3)
    messages: list[bags.Message] = []
    k, r = [[60.0, 0, 32], [0, 60, 24], [0, 0, 1]], np.eye(3)
    for side, p3 in (("left", 0.0), ("right", -0.3)):
        p = [[60.0, 0, 32, p3], [0, 60, 24, 0], [0, 0, 1, 0]]
        messages.append((f"/rig/{side}/camera_info", 0.0, bags.camera_info(0.0, k, np.zeros(5), r, p)))
    for i in range(31):
        t = 0.1 * i
        grey = np.full((48, 64), i, np.uint8)
        messages.append(("/rig/left/image_raw", t, bags.image(t, "mono8", grey)))
        data = cv2.imencode(".png", grey + 100)[1].tobytes()
        messages.append(("/rig/right/image_raw/compressed", t, bags.compressed(t, data)))
        if not left_out.get("scan"):
            messages.append(("/fgreg/scan", t, bags.number(10.0 * t)))
    for t in (1.04, 2.0):
        waves = rng.normal(size=(128, 20)).astype(np.float32)
        messages.append(("/fgreg/frame", t, bags.image(t, "32FC1", waves)))
    return messages


def test_looks_by_frames_get_the_nearest_images_and_the_angle_in_between(tmp_path: Path) -> None:
    path = bags.write_bag(tmp_path / "bag", room())
    done = convert(path, tmp_path / "s", "--setup", setup(tmp_path, camera=False))
    assert done.exit_code == 0, done.output
    note, first, second = events(tmp_path / "s")
    assert "converted from recording bag" in note["text"]
    assert [first["pm"], second["pm"]] == [0, 1]
    # The recording starts 5 ms after the first stamp; the angle has no stamp, so it is as late as its recording.
    assert first["t"] == 1.035
    assert first["trus"]["scan_deg"] == pytest.approx(10.35)
    left = cv2.imread(str(tmp_path / "s" / first["marker"]["left"]), cv2.IMREAD_GRAYSCALE)
    right = cv2.imread(str(tmp_path / "s" / first["marker"]["right"]), cv2.IMREAD_GRAYSCALE)
    assert left is not None
    assert right is not None
    assert (left[0, 0], right[0, 0]) == (10, 110)
    assert np.load(tmp_path / "s" / second["trus"]["frame"]).dtype == np.float32
    assert len(list((tmp_path / "s" / "frames").iterdir())) == 6
    camera = read_session(tmp_path / "s").model.camera
    assert camera is not None
    assert camera.right_T_left is not None
    assert camera.right_T_left[0, 3] == pytest.approx(-5.0)


def test_looks_without_a_stage_angle_or_images_near_them_are_left_out_and_reported(tmp_path: Path) -> None:
    messages = [m for m in room() if not (m[0].startswith("/rig") and "image" in m[0] and m[1] > 1.5)]
    path = bags.write_bag(tmp_path / "bag", messages)
    done = convert(path, tmp_path / "s", "--setup", setup(tmp_path))
    assert done.exit_code == 0, done.output
    assert "1 pair" in done.stdout
    assert "look at 1.995 s is left out: the nearest left image is 0.500 s away, at most 0.1 s allowed" in done.stderr
    assert "look at 1.995 s is left out" in events(tmp_path / "s")[0]["text"]


def test_of_positions_and_frames_only_one_is_taken(tmp_path: Path) -> None:
    messages = [*room(), ("/fgreg/look", 1.04, bags.point_stamped(1.04, (0.001, 0.0, 0.030)))]
    path, where = bags.write_bag(tmp_path / "bag", messages), setup(tmp_path)
    assert convert(path, tmp_path / "a", "--setup", where).exit_code == 0
    assert all("frame" in event["trus"] for event in events(tmp_path / "a")[1:])
    looks_only = mapping(tmp_path, topics={"look": "/fgreg/look"})
    assert convert(path, tmp_path / "b", "--setup", where, "--map", looks_only).exit_code == 0
    assert [event["trus"]["range_mm"] for event in events(tmp_path / "b")[1:]] == [30.0]
    both = mapping(tmp_path, topics={"look": "/fgreg/look", "frame": "/fgreg/frame"})
    assert "found look and frame, both" in refused(path, tmp_path / "c", "--setup", where, "--map", both)


def test_consecutive_looks_are_at_one_pm_where_the_mapping_says_so(tmp_path: Path) -> None:
    path = bags.write_bag(tmp_path / "bag", room())
    done = convert(path, tmp_path / "s", "--setup", setup(tmp_path), "--map", mapping(tmp_path, same_pm_s=1.0))
    assert done.exit_code == 0, done.output
    assert [event["pm"] for event in events(tmp_path / "s")[1:]] == [0, 0]


def test_the_endoscope_holders_motion_becomes_a_camera_move_before_the_shot(tmp_path: Path) -> None:
    messages = room()
    for i in range(31):
        t = 0.1 * i
        # Still until 1.5 s (0.3 mm of play), then 20 mm along the base's y with a quarter turn about z.
        moved = t > 1.5
        turn = (0, 0, math.sqrt(0.5), math.sqrt(0.5)) if moved else (0, 0, 0, 1)
        messages.append(("/ECM/measured_cp", t, bags.pose_stamped(t, (0.0003 * (i % 2), 0.02 * moved, 0.1), turn)))
    path = bags.write_bag(tmp_path / "bag", messages)
    done = convert(path, tmp_path / "s", "--setup", setup(tmp_path))
    assert done.exit_code == 0, done.output
    _, first, moved_event, second = events(tmp_path / "s")
    assert [first["type"], moved_event["type"], second["type"]] == ["pair", "camera_moved", "pair"]
    # By hand: the old camera's origin is 20 mm along -y of the base, that is -x of the new camera turned by a quarter.
    new_T_old = np.array(moved_event["camera_new_T_camera_old"])
    np.testing.assert_allclose(new_T_old[:3, 3], [-20, 0, 0], atol=0.35)
    np.testing.assert_allclose(new_T_old[:3, :3], np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]), atol=1e-6)
    assert moved_event["covariance"][3][3] == 1.0
    far = mapping(tmp_path, camera_moved={"mm": 50.0, "deg": 120.0})
    assert convert(path, tmp_path / "t", "--setup", setup(tmp_path), "--map", far).exit_code == 0
    assert [event["type"] for event in events(tmp_path / "t")[1:]] == ["pair", "pair"]


def test_aims_at_board_corners_take_images_even_where_poses_are_recorded(tmp_path: Path) -> None:
    messages = [m for m in room() if m[0] != "/fgreg/frame"]
    messages += [("/m", 0.05 * i, bags.transform_stamped(0.05 * i, (0, 0, 0.1 + 0.005 * i))) for i in range(61)]
    messages.append(("/fgreg/mark", 1.04, bags.text('{"type": "aim", "corner": [2, 3]}')))
    path = bags.write_bag(tmp_path / "bag", messages)
    wanted = mapping(tmp_path, topics={"marker": "/m"}, clock="recorder")
    done = convert(path, tmp_path / "s", "--setup", setup(tmp_path), "--map", wanted)
    assert done.exit_code == 0, done.output
    aim = events(tmp_path / "s")[1]
    assert set(aim["marker"]) == {"camera_T_marker", "left", "right"}
    assert aim["marker"]["camera_T_marker"][2][3] == pytest.approx(204.0)  # between 200 and 205


def test_what_a_recording_lacks_is_reported_with_its_content(tmp_path: Path) -> None:
    where = setup(tmp_path)
    only = bags.write_bag(tmp_path / "a", [("/PSM1/measured_cp", 0.0, bags.pose_stamped(0.0, (0, 0, 0)))])
    message = refused(only, tmp_path / "s", "--setup", where)
    assert "/PSM1/measured_cp (PoseStamped)" in message
    assert "topics.look, topics.frame, topics.mark" in message
    no_scan = bags.write_bag(tmp_path / "b", room(scan=True))
    assert "expected the stage's angle (topics.scan)" in refused(no_scan, tmp_path / "s", "--setup", where)
    wrong = mapping(tmp_path, topics={"scan": "/rig/left/image_raw"})
    message = refused(no_scan, tmp_path / "s", "--setup", where, "--map", wrong)
    assert "/rig/left/image_raw: found sensor_msgs/msg/Image, expected topics.scan" in message
    bad = bags.write_bag(tmp_path / "c", [*room(), ("/fgreg/mark", 1.0, bags.text("pair 3"))])
    assert "/fgreg/mark: message 0: found pair 3, expected a JSON object" in refused(
        bad, tmp_path / "s", "--setup", where
    )
    odd = bags.write_bag(tmp_path / "d", [*room(), ("/fgreg/mark", 1.0, bags.text('{"type": "pair", "pm": "x"}'))])
    assert "d: mark at 1.000 s: pm: found 'x'" in refused(odd, tmp_path / "s", "--setup", where)
    assert not (tmp_path / "s").exists()
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_a_file_that_is_no_recording_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + b"\1" * 100)
    assert str(path) in refused(path, tmp_path / "s", "--setup", setup(tmp_path))


def shots(frame: str = "camera", late_s: float = 0.0, scale: float = 1.0) -> list[bags.Message]:
    """Two looks with poses and angles near them: the marker's poses stated in ``frame``, by a clock that is late."""
    messages: list[bags.Message] = []
    for t in (1.0, 2.0):
        for at in (t - 0.02, t + 0.02):
            pose = bags.pose_stamped(at - late_s, (0.0, 0.0, 0.1 * scale))
            messages.append(("/fgreg/marker", at, in_frame(pose, frame)))
            messages.append(("/fgreg/scan", at, bags.joint_state(at, ["stage"], [0.1 * t])))
        messages.append(("/fgreg/look", t, bags.point_stamped(t, (0.001, 0.0, 0.030))))
    return messages


def in_frame(message: Any, frame: str) -> Any:
    return dataclasses.replace(message, header=dataclasses.replace(message.header, frame_id=frame))


def held(topic: str, metres: float = 0.02) -> list[bags.Message]:
    """Poses of the holder, which moves at 1.5 s."""
    times = [0.1 * i for i in range(31)]
    return [(topic, t, bags.pose_stamped(t, (metres * (t > 1.5), 0.0, 0.1))) for t in times]


def kinds(tmp_path: Path, messages: list[bags.Message], **wanted: Any) -> tuple[list[str], str]:
    """Types of the events that a recording becomes, and what is told and left out."""
    path = bags.write_bag(tmp_path / f"bag{len(list(tmp_path.iterdir()))}", messages, mcap=True)
    imported = read_bag(path, read_mapping(mapping(tmp_path, **wanted)))
    return [draft.document["type"] for draft in imported.drafts], "; ".join([*imported.told, *imported.left_out])


def test_the_cameras_motion_is_the_ecms_and_never_a_setup_joints(tmp_path: Path) -> None:
    moved, still = ["pair", "camera_moved", "pair"], ["pair", "pair"]
    both = [*held("/ECM/measured_cp"), *held("/SUJ/ECM/measured_cp", 0.0), *held("/ECM/local/measured_cp", 0.0)]
    assert kinds(tmp_path, [*shots(), *both]) == (moved, "")
    found, told = kinds(tmp_path, [*shots(), *held("/SUJ/ECM/measured_cp")])
    assert found == still
    assert "camera moves are not known: there is no ECM/measured_cp, and of the ECM only /SUJ/ECM/measured_cp" in told
    found, told = kinds(tmp_path, [*shots(), *held("/SUJ/ECM/measured_cp")], topics={"ecm": "/SUJ/ECM/measured_cp"})
    assert found == moved
    assert "a setup joint's pose does not have the arm's own motion" in told
    found, told = kinds(tmp_path, [*shots(), *held("/dvrk/ECM/position_cartesian_current")])
    assert found == moved
    assert "taken from /dvrk/ECM/position_cartesian_current, the older name of measured_cp" in told
    two = bags.write_bag(tmp_path / "two", [*shots(), *held("/ECM/measured_cp"), *held("/sim/ECM/measured_cp")])
    message = refused(two, tmp_path / "x", "--setup", setup(tmp_path))
    assert "the endoscope's pose: found /ECM/measured_cp, /sim/ECM/measured_cp, expected one, named" in message
    found, told = kinds(tmp_path, [*shots(), *held("/ECM/measured_cp")[:12]])
    assert "1 events have no pose of the endoscope's holder near them" in told


def test_a_recording_of_the_ecm_and_its_setup_joint_keeps_the_camera_move(tmp_path: Path) -> None:
    case = Path(__file__).parents[2] / "shared" / "cases" / "exchange" / "ecm_suj_mcap"
    if not case.exists():
        pytest.skip("no ../shared/cases")
    assert convert(case, tmp_path / "s", "--setup", setup(tmp_path)).exit_code == 0
    found = events(tmp_path / "s")[1:]
    assert [event["type"] for event in found] == ["pair", "pair", "camera_moved", "pair", "pair"]
    assert np.array(found[2]["camera_new_T_camera_old"])[:3, 3].tolist() == pytest.approx([-20.0, 0.0, 0.0])


def test_frames_units_and_stamps_that_contradict_each_other_are_told_or_refused(tmp_path: Path) -> None:
    assert kinds(tmp_path, shots())[1] == ""
    assert "'world', which is no camera's" in kinds(tmp_path, shots("world"))[1]
    left = bags.image(1.0, "mono8", np.zeros((48, 64), np.uint8))
    seen = [("/rig/left/image_raw", t, in_frame(left, "left_optical")) for t in (1.0, 2.0)]
    assert "the left camera's images in 'left_optical'" in kinds(tmp_path, [*shots(), *seen])[1]
    other = ("/fgreg/marker", 1.5, in_frame(bags.pose_stamped(1.5, (0, 0, 0.3)), "tracker"))
    assert "1 messages on /fgreg/marker are not used: tracker is another frame" in kinds(tmp_path, [*shots(), other])[1]
    assert "stamps on /fgreg/marker are 2.0" in kinds(tmp_path, shots(late_s=2.0), max_gap_s=3.0)[1]
    unstamped = [(name, t, dataclasses.replace(m, header=bags.header(-1.7e9))) for name, t, m in shots()]
    assert "4 of 4 messages on /fgreg/marker have no stamp" in kinds(tmp_path, unstamped)[1]
    backwards = ("/fgreg/marker", 2.1, in_frame(bags.pose_stamped(0.9, (0, 0, 0.1)), "camera"))
    assert "stamps on /fgreg/marker go back 1 times" in kinds(tmp_path, [*shots(), backwards])[1]
    small = [m for m in shots() if m[0] != "/fgreg/scan"]
    small += [("/fgreg/scan", t, bags.number(0.1 * t)) for t in (0.98, 1.02, 1.98, 2.02)]
    assert "scan.unit: rad in the mapping, if they are radians" in kinds(tmp_path, small)[1]
    where = setup(tmp_path)
    millimetres = bags.write_bag(tmp_path / "mm", shots(scale=1000.0))
    assert "found distances of 100 m, expected metres" in refused(millimetres, tmp_path / "x", "--setup", where)
    degrees = [m for m in shots() if m[0] != "/fgreg/scan"]
    degrees += [("/fgreg/scan", t, bags.joint_state(t, ["stage"], [30.0 * t])) for t in (0.98, 1.02, 1.98, 2.02)]
    message = refused(bags.write_bag(tmp_path / "deg", degrees), tmp_path / "x", "--setup", where)
    assert "expected radians; or scan.unit: deg in the mapping" in message


def mcap_of(path: Path, messages: list[bags.Message], defined: bool = True, **options: Any) -> Path:
    """An MCAP file of the mcap library, with its options, and its schemas' texts or none."""
    writer_module = pytest.importorskip("mcap.writer", reason="mcap is not installed")
    with path.open("wb") as file:
        writer = writer_module.Writer(file, **options)
        writer.start(profile="ros2", library="test")
        channels: dict[str, int] = {}
        for topic, t, message in sorted(messages, key=lambda m: m[1]):
            kind = message.__msgtype__
            if topic not in channels:
                text = bags.STORE.generate_msgdef(kind)[0] if defined or "Pose" not in kind else ""
                schema = writer.register_schema(kind, "ros2msg" if text else "", text.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            ns = bags.START_NS + round(t * 1e9)
            data = bytes(bags.STORE.serialize_cdr(message, kind))
            writer.add_message(channels[topic], log_time=ns, data=data, publish_time=ns)
        writer.finish()
    return path


def test_mcap_files_of_other_writers_are_read_or_refused_by_what_they_lack(tmp_path: Path) -> None:
    writer_module = pytest.importorskip("mcap.writer", reason="mcap is not installed")
    where, messages = setup(tmp_path), [*shots(), *held("/ECM/measured_cp")]
    bare = {"use_statistics": False, "use_summary_offsets": False, "repeat_schemas": False, "repeat_channels": False}
    layouts: dict[str, dict[str, Any]] = {
        "zstd": {"compression": writer_module.CompressionType.ZSTD},
        "no summary": {"index_types": writer_module.IndexType.NONE, **bare},
        "some undefined": {"defined": False},
    }
    for name, options in layouts.items():
        path = mcap_of(tmp_path / f"{name}.mcap", messages, **options)
        done = convert(path, tmp_path / name, "--setup", where)
        assert done.exit_code == 0, (name, done.exception, done.output)
        assert [event["type"] for event in events(tmp_path / name)[1:]] == ["pair", "camera_moved", "pair"], name
    chunks_only = mcap_of(tmp_path / "c.mcap", messages, index_types=writer_module.IndexType.CHUNK)
    assert "found no messages, expected" in refused(chunks_only, tmp_path / "x", "--setup", where)
    assert not (tmp_path / "x").exists()


def test_messages_compressed_one_by_one_are_named_where_their_metadata_are_gone(tmp_path: Path) -> None:
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    writer = rosbag2.Writer(tmp_path / "bag", version=9, storage_plugin=rosbag2.StoragePlugin.SQLITE3)
    writer.set_compression(rosbag2.CompressionMode.MESSAGE, rosbag2.CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, t, message in shots():
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=bags.STORE)
            data = bags.STORE.serialize_cdr(message, kind)
            writer.write(connections[topic], bags.START_NS + round(t * 1e9), data)
    assert convert(tmp_path / "bag", tmp_path / "s", "--setup", setup(tmp_path)).exit_code == 0
    message = refused(next((tmp_path / "bag").glob("*.db3")), tmp_path / "t", "--setup", setup(tmp_path))
    assert "found messages that are compressed one by one (zstd), expected the whole folder" in message
