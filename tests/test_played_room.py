"""A room whose pictures were rendered beforehand: the picture shown is that of the poses at that time."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fgreg.detection.marker import detect_marker
from fgreg.detection.results import MarkerFit
from fgreg.geometry.transforms import log_so3
from fgreg.simulation.room import RoomConfig, room_config
from played_room import FRAME_RATE, LOOP_S, Making, PlayedRoom, make_pictures

SPOTS, LAPS, AIMS = 2, 2, 1


def config() -> RoomConfig:
    return room_config(3, 320, aims=AIMS)


def go_through(room: PlayedRoom, places: int) -> list[float]:
    """When the fibre came to rest at each place; the surgeon is asked at odd moments."""
    out, t = [], 0.0
    for k in range(places):
        room.proceed(t + 0.13 + 0.31 * (k % 3))
        t = room.arrives_s()
        out.append(t)
    return out


def test_the_list_goes_through_the_spots_in_laps_with_the_camera_here_and_there_and_begins_again() -> None:
    room = PlayedRoom(config(), SPOTS, LAPS)
    first = len(room.stations) - 2 * SPOTS * LAPS
    assert first == AIMS
    places = [id(station.held.place) for station in room.stations[first:]]
    here, there = places[: SPOTS * LAPS], places[SPOTS * LAPS :]
    assert here == here[:SPOTS] * LAPS
    assert there == there[:SPOTS] * LAPS
    assert not set(here) & set(there)
    assert [station.next for station in room.stations] == [*range(1, len(room.stations)), first]
    go_through(room, AIMS + 2 * SPOTS * LAPS * 2)
    assert len(room.moved_s) == 4
    camera = [room.trus_T_camera(t + 1.0) for t in room.moved_s]
    np.testing.assert_array_equal(camera[0], camera[2])
    np.testing.assert_array_equal(camera[1], camera[3])
    assert np.abs(camera[0] - camera[1]).max() > 1e-3


def test_while_it_is_held_the_marker_does_the_same_again_and_again() -> None:
    room = PlayedRoom(config(), SPOTS, LAPS)
    (at,) = go_through(room, 1)
    times = at + np.linspace(0.0, LOOP_S, 50)
    first = np.stack([room.camera_T_marker(t) for t in times])
    later = np.stack([room.camera_T_marker(t + 7 * LOOP_S) for t in times])
    np.testing.assert_allclose(later, first, rtol=0, atol=1e-9)
    assert np.ptp(first[:, :3, 3], axis=0).max() > 0.01


def test_no_picture_is_of_another_moment() -> None:
    """At every frame of a whole round, the clip's motion is the room's."""
    room = PlayedRoom(config(), SPOTS, LAPS)
    still = PlayedRoom(config(), SPOTS, LAPS)
    t, k, seen = 0.0, 0, set()
    for _ in range(AIMS + 2 * SPOTS * LAPS + 1):
        asked = room.arrives_s() + 0.2
        while t < asked:
            clip, at = room.shown(t)
            seen.add((clip.first, at))
            still._travels, still._cameras = [clip.travel], [clip.camera]
            there = still.camera_T_marker(at / FRAME_RATE)
            np.testing.assert_allclose(there, room.camera_T_marker(t), rtol=0, atol=1e-9)
            k += 1
            t = k / FRAME_RATE
        room.proceed(asked)
    assert len(seen) > 0.6 * room.frames


def test_the_marker_is_found_where_it_is_in_the_pictures_of_the_file(tmp_path: Path) -> None:
    wanted = room_config(3, 640, aims=0)
    making = Making(wanted, 1, 1, tmp_path / "room.raw")
    room = making.room()
    pictures = making.file(room, "w+")
    times = [0.3 * LOOP_S, 1.3 * LOOP_S, 2.0 * LOOP_S]
    room.proceed(0.5 * LOOP_S)  # a bump first, then the way to the other spot
    for t in times:
        clip, at = room.shown(t)
        pictures[clip.first + at] = np.stack(room.made(clip, at))
    room.show(pictures)
    marks = []
    for t in times:
        fit = detect_marker(*room.pictures(t, 0), wanted.scene.camera, wanted.scene.marker)
        assert isinstance(fit, MarkerFit), t
        truth = room.camera_T_marker(t)
        assert np.linalg.norm(fit.camera_T_marker[:3, 3] - truth[:3, 3]) < 0.5
        assert np.linalg.norm(log_so3(truth[:3, :3].T @ fit.camera_T_marker[:3, :3])) < 0.02
        marks.append(truth)
    assert np.linalg.norm(marks[2][:3, 3] - marks[0][:3, 3]) > 1.0


def test_a_file_is_used_again_and_one_of_another_room_is_not(tmp_path: Path) -> None:
    making = Making(room_config(3, 160, aims=0), 1, 1, tmp_path / "room.raw")
    room = making.room()
    making.file(room, "w+")
    assert make_pictures(making, 1), "all black"
    assert not make_pictures(making, 1)
    clip = room.clips()[-1]
    at = clip.frames // 2
    np.testing.assert_array_equal(making.file(room, "r")[clip.first + at], np.stack(room.made(clip, at)))


def test_pictures_of_another_size_are_not_shown() -> None:
    room = PlayedRoom(config(), 1, 1)
    with pytest.raises(ValueError, match="expected"):
        room.show(np.zeros((3, 2, 8, 8), dtype=np.uint8))
    with pytest.raises(ValueError, match="at least one"):
        PlayedRoom(config(), 0)
    assert math.isinf(room.config.bump_every_s)
