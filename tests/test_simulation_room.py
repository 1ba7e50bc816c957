"""The simulated operating room: where things are as time goes on, and what is taken in."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fgreg.detection.marker import detect_marker
from fgreg.detection.photoacoustic import locate_in_frame
from fgreg.detection.results import MarkerFit, PaFind
from fgreg.geometry.transforms import is_rigid
from fgreg.simulation.room import BUMP_S, Room, room_config


@pytest.fixture(scope="module")
def room() -> Room:
    """At its first spot on tissue, 5 s in."""
    room = Room(room_config(3, aims=2, bump_every_s=math.inf))
    room.proceed(1.0)
    room.proceed(4.0)
    return room


def test_the_same_seed_is_the_same_room() -> None:
    rooms = [Room(room_config(5, aims=1)) for _ in range(2)]
    for room in rooms:
        room.proceed(2.0)
        room.proceed(6.0)
    first, second = (room.camera_T_marker(9.0) for room in rooms)
    np.testing.assert_array_equal(first, second)
    assert np.abs(Room(room_config(6, aims=1)).camera_T_marker(9.0) - first).max() > 1e-3


def test_aims_come_first_each_at_a_corner_of_a_board() -> None:
    room = Room(room_config(3, aims=3, bump_every_s=math.inf))
    for number in range(3):
        board, corner = room.place.trus_T_board, room.place.corner
        assert board is not None
        assert corner is not None
        t = room.arrives_s() + 0.5
        laser = room.trus_T_marker(t) @ room.marker_T_laser
        square = room.config.scene.board.square_mm
        at = (board @ np.array([corner[0] * square, corner[1] * square, 0.0, 1.0]))[:3]
        off = np.cross(at - laser[:3, 3], laser[:3, 2])
        assert np.linalg.norm(off) < 1.5, f"aim {number} passes its corner"  # 0.3 mm a side, and the tremor
        room.proceed(t)
    assert room.place.corner is None


def test_the_marker_travels_smoothly_and_then_stays(room: Room) -> None:
    times = np.arange(4.0, room.arrives_s() + 1.0, 0.01)
    poses = np.stack([room.trus_T_marker(t) for t in times])
    assert all(is_rigid(pose) for pose in poses)
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / 0.01
    assert speed.max() < 120.0
    still = poses[times > room.arrives_s()]
    assert np.ptp(still[:, :3, 3], axis=0).max() < 0.3


def test_the_beam_ends_on_the_tissue(room: Room) -> None:
    t = room.arrives_s() + 0.3
    spot = room.spot_mm(t)
    angle = np.arctan2(spot[1], spot[2])
    surface = room.scene.tissue.point(np.array(spot[0]), angle)
    assert np.linalg.norm(spot - surface) < 0.01
    laser = room.trus_T_marker(t) @ room.marker_T_laser
    assert np.linalg.norm(np.cross(spot - laser[:3, 3], laser[:3, 2])) < 1e-6
    assert room.plane_rad(t) == pytest.approx(angle)


def test_camera_and_probe_find_what_is_there(room: Room) -> None:
    t = room.arrives_s() + 0.3
    scene = room.config.scene
    left, right = room.pictures(t, 7)
    found = detect_marker(left, right, scene.camera, scene.marker)
    assert isinstance(found, MarkerFit)
    np.testing.assert_allclose(found.camera_T_marker[:3, 3], room.camera_T_marker(t)[:3, 3], atol=0.1)
    plane = room.plane_rad(t)
    heard = locate_in_frame(room.channel_data(t, plane, 7), scene.probe)
    aside = locate_in_frame(room.channel_data(t, plane + math.radians(6.0), 7), scene.probe)
    assert isinstance(heard, PaFind)
    assert isinstance(aside, PaFind)
    spot = room.spot_mm(t)
    assert heard.x_mm == pytest.approx(spot[0], abs=0.1)
    assert heard.range_mm == pytest.approx(math.hypot(spot[1], spot[2]) - scene.probe.radius_mm, abs=0.1)
    assert 0.35 < aside.amplitude / heard.amplitude < 0.75  # half at the window's edge


def test_a_bump_moves_the_camera_and_nothing_else() -> None:
    room = Room(room_config(4, aims=0, bump_every_s=math.inf))
    before, marker = room.trus_T_camera(1.0), room.trus_T_marker(3.0)
    room.bump(2.0)
    np.testing.assert_array_equal(room.trus_T_camera(1.9), before)
    np.testing.assert_array_equal(room.trus_T_marker(3.0), marker)
    after = room.trus_T_camera(2.0 + BUMP_S)
    assert np.abs(after - before).max() > 0.1
    assert is_rigid(after)
    np.testing.assert_array_equal(room.trus_T_camera(30.0), after)
    np.testing.assert_array_equal(room.trus_T_camera(2.0), before)


def test_bumps_come_about_as_often_as_asked() -> None:
    room = Room(room_config(4, aims=0, bump_every_s=5.0))
    room.proceed(0.5)
    for t in np.arange(0.0, 200.0, 0.5):
        room.pass_to(float(t))
    assert 25 <= len(room.moved_s) <= 60
    assert np.diff(room.moved_s).min() >= 2.0


@pytest.mark.parametrize(("changes", "named"), [({"aims": -1}, "aims"), ({"bump_every_s": 0.0}, "bump_every_s")])
def test_what_cannot_be_is_refused(changes: dict[str, float], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        replace(room_config(1), **changes)  # type: ignore[arg-type]


def test_a_probe_without_channel_data_is_refused() -> None:
    config = room_config(1)
    with pytest.raises(ValueError, match="channel data"):
        replace(config, scene=replace(config.scene, frames=False, probe=replace(config.scene.probe, channels=None)))
