"""ROS 1 bags, and poses from the tree of transforms that ``/tf`` and ``/tf_static`` send."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgreg.convert.transform_tree import TransformTree
from fgreg.errors import InputError
from fgreg.geometry.transforms import exp_so3, make_transform
from tests import bags
from tests.test_convert_bags import convert, events, mapping, refused, room, setup

NONE, HALF = (0.0, 0.0, 0.0, 1.0), math.sqrt(0.5)


def test_a_ros_1_bag_becomes_the_same_session_as_its_ros_2_twin(tmp_path: Path) -> None:
    messages = room()
    new = bags.write_bag(tmp_path / "bag", messages)
    old = bags.write_ros1_bag(tmp_path / "bag.bag", messages, "BZ2")
    for name, path in (("new", new), ("old", old)):
        done = convert(path, tmp_path / name, "--setup", setup(tmp_path, camera=False))
        assert done.exit_code == 0, done.output
    assert events(tmp_path / "old")[1:] == events(tmp_path / "new")[1:]
    for file in sorted((tmp_path / "new" / "frames").iterdir()):
        assert (tmp_path / "old" / "frames" / file.name).read_bytes() == file.read_bytes()
    assert (tmp_path / "old/session.yaml").read_bytes() == (tmp_path / "new/session.yaml").read_bytes()


def test_a_bag_without_an_index_is_named_as_such(tmp_path: Path) -> None:
    path = bags.write_ros1_bag(tmp_path / "cut.bag", room())
    path.write_bytes(path.read_bytes()[:-3000])
    message = refused(path, tmp_path / "s", "--setup", setup(tmp_path))
    assert "a recording that cannot be read" in message
    assert "rosbag reindex" in message


def tree(camera: str = "optical") -> list[bags.Message]:
    """A camera 100 mm above the table that looks down, on a static mount; a marker that moves along the table's x; the
    probe's holder, and the probe that turns by 10 deg/s. Looks at 1.04 s and 2 s."""
    static = bags.tf(
        [
            (0.0, "table", "mount", (0, 0, 0.1), NONE),
            (0.0, "/mount", "/" + camera, (0, 0, 0), (1.0, 0.0, 0.0, 0.0)),  # half a turn about x
            (0.0, "table", "holder", (0.3, 0, 0), NONE),
        ]
    )
    messages: list[bags.Message] = [("/tf_static", 0.0, static)]
    for i in range(31):
        t = 0.1 * i
        turn = -math.radians(10.0 * t) / 2
        marker = (t, "table", "marker", (0.01 * t, 0.02, 0), (0, 0, HALF, HALF))
        probe = (t, "holder", "probe", (0, 0, 0), (math.sin(turn), 0, 0, math.cos(turn)))
        messages += [("/tf", t, bags.tf([marker, probe]))]
    for t in (1.04, 2.0):
        messages.append(("/fgreg/look", t, bags.point_stamped(t, (0.001, 0.0, 0.03))))
    return messages


FRAMES = {"marker": ["optical", "marker"], "scan": ["holder", "probe"]}


@pytest.mark.parametrize("ros", [1, 2])
def test_marker_and_stage_angle_come_through_the_tree_of_transforms(tmp_path: Path, ros: int) -> None:
    write: Any = bags.write_ros1_bag if ros == 1 else bags.write_bag
    path = write(tmp_path / "tree.bag" if ros == 1 else tmp_path / "tree", tree())
    done = convert(path, tmp_path / "s", "--setup", setup(tmp_path), "--map", mapping(tmp_path, tf=FRAMES))
    assert done.exit_code == 0, done.output
    first, second = events(tmp_path / "s")[1:]
    # By hand: the camera's y and z are the table's turned round; the marker is turned a quarter about the table's z.
    expected = np.array([[0, -1, 0, 10.4], [-1, 0, 0, -20], [0, 0, -1, 100], [0, 0, 0, 1.0]])
    np.testing.assert_allclose(first["marker"]["camera_T_marker"], expected, atol=1e-9)
    assert first["trus"]["scan_deg"] == pytest.approx(10.4, abs=1e-9)
    assert second["marker"]["camera_T_marker"][0][3] == pytest.approx(20.0)


def test_a_pose_is_taken_only_where_all_transforms_on_its_way_were_sent_around_it() -> None:
    poses = TransformTree("r")
    for i in range(5):
        poses.add(
            "world", "camera", 0.1 * i, make_transform(exp_so3(np.zeros(3)), np.array([i, 0.0, 0.0])), static=False
        )
    for t, x in ((0.05, 10.0), (0.15, 11.0), (0.95, 12.0)):
        poses.add("world", "marker", t, make_transform(np.eye(3), np.array([x, 0.0, 0.0])), static=False)
    found = poses.poses("camera", "marker", 0.11)
    assert [t for t, _ in found] == pytest.approx([0.05, 0.1, 0.15])
    np.testing.assert_allclose([pose[0, 3] for _, pose in found], [9.5, 9.5, 9.5], atol=1e-12)
    back = poses.poses("marker", "camera", 0.11)
    np.testing.assert_allclose([pose[0, 3] for _, pose in back], [-9.5, -9.5, -9.5], atol=1e-12)


@pytest.mark.parametrize(
    ("edges", "asked", "message"),
    [
        ([("w", "a"), ("w", "b")], ("a", "c"), "no frame c, expected one of a, b, w"),
        ([("w", "a"), ("v", "b")], ("a", "b"), r"not connected \(a < w; b < v\)"),
        ([("w", "a"), ("v", "a"), ("w", "b")], ("a", "b"), "w and v, both as its parent"),
        ([("a", "b"), ("b", "a")], ("a", "b"), "a circle of parents"),
    ],
)
def test_trees_that_are_none_are_refused(edges: list[tuple[str, str]], asked: tuple[str, str], message: str) -> None:
    poses = TransformTree("r")
    for parent, child in edges:
        poses.add(parent, child, 0.0, np.eye(4), static=False)
    with pytest.raises(InputError, match=message):
        poses.poses(*asked, 0.1)


def test_static_transforms_alone_and_two_sources_of_one_pose_are_refused(tmp_path: Path) -> None:
    path = bags.write_bag(tmp_path / "tree", tree())
    still = mapping(tmp_path, tf=FRAMES | {"marker": ["optical", "holder"]})
    assert "static transforms only" in refused(path, tmp_path / "s", "--setup", setup(tmp_path), "--map", still)
    both = mapping(tmp_path, tf=FRAMES, topics={"marker": "/marker"})
    assert "topics.marker" in refused(path, tmp_path / "s", "--setup", setup(tmp_path), "--map", both)
    one = mapping(tmp_path, tf={"marker": ["optical"]})
    assert "found 1 names, expected two" in refused(path, tmp_path / "s", "--setup", setup(tmp_path), "--map", one)
