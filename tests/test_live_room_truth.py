"""The ground truth of a session from the simulated room: each epoch's pose is the camera's at its end."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from fgreg.drivers.simulated import ask_truth
from fgreg.drivers.simulated_room import RoomServer
from fgreg.errors import FgregError
from fgreg.live.launch import make_folder, setup_text
from fgreg.live.room_truth import write_room_truth
from fgreg.model.events import CameraMovedEvent, Event, MarkerRecord, PairEvent, TrusRecord
from fgreg.session.journal import Journal
from fgreg.session.session_reader import check_session, read_ground_truth
from fgreg.session.yaml_loader import load_yaml
from fgreg.simulation.documents import session_document
from fgreg.simulation.room import Room, room_config

SETUP = setup_text(session_document(room_config(1, 320, aims=0).scene))


def pair(t: float, pm: int) -> PairEvent:
    pose = np.eye(4)
    pose[2, 3] = 100.0
    return PairEvent(t, 0, pm, MarkerRecord(pose), TrusRecord(0.0, 1.0, 30.0))


def record(folder: Path, events: list[Event]) -> None:
    make_folder(folder, SETUP)
    with Journal.open(folder) as journal:
        for event in events:
            journal.append(event)


def room_with_bumps(*at_s: float) -> Room:
    room = Room(room_config(1, 320, aims=0, bump_every_s=float("inf")))
    for t in at_s:
        room.bump(t)
    return room


def test_an_epoch_has_the_pose_of_its_last_pair_whether_a_move_was_noticed_or_not(tmp_path: Path) -> None:
    room = room_with_bumps(5.0, 20.0)
    moved = CameraMovedEvent(12.0, 0, detected=True, since_t=8.0)
    record(tmp_path, [pair(1.0, 0), pair(3.0, 1), pair(8.0, 2), pair(12.0, 3), moved, pair(30.0, 4)])
    write_room_truth(room.truth_at, tmp_path, 0.0, -1.0)
    truth = read_ground_truth(tmp_path)
    assert truth is not None
    np.testing.assert_allclose(truth.trus_T_camera, [room.trus_T_camera(3.0), room.trus_T_camera(30.0)], atol=1e-8)
    assert np.abs(truth.trus_T_camera[0] - truth.trus_T_camera[1]).max() > 0.01
    assert truth.marker_T_laser is not None
    np.testing.assert_allclose(truth.marker_T_laser, room.marker_T_laser, atol=1e-8)
    assert sorted(truth.trus_p_pm_mm) == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(truth.trus_p_pm_mm[4], room.spot_mm(30.0), atol=1e-8)
    assert load_yaml(tmp_path / "ground_truth.yaml", "ground_truth.yaml")["x_moved_s"] == [5.0, 20.0]
    assert check_session(tmp_path) == ([], [])


def test_a_session_that_goes_on_in_another_room_keeps_the_truth_of_its_epochs(tmp_path: Path) -> None:
    first, second = room_with_bumps(5.0), room_with_bumps(2.0)
    record(tmp_path, [pair(1.0, 0), CameraMovedEvent(6.0, 0), pair(7.0, 1)])
    write_room_truth(first.truth_at, tmp_path, 0.0, -1.0)
    record(tmp_path, [CameraMovedEvent(9.0, 0), pair(10.0, 2)])
    write_room_truth(second.truth_at, tmp_path, -8.0, 7.0)  # whose clock began at the session's 8 s
    truth = read_ground_truth(tmp_path)
    assert truth is not None
    expected = [first.trus_T_camera(1.0), first.trus_T_camera(7.0), second.trus_T_camera(2.0)]
    np.testing.assert_allclose(truth.trus_T_camera, expected, atol=1e-8)
    (tmp_path / "ground_truth.yaml").unlink()
    with pytest.raises(FgregError, match="first 2 camera epochs"):
        write_room_truth(second.truth_at, tmp_path, -8.0, 7.0)
    assert not (tmp_path / "ground_truth.yaml").exists()


def test_the_room_sends_it_over_its_socket_in_host_time(tmp_path: Path) -> None:
    room = room_with_bumps(0.1)
    server = RoomServer(room, tmp_path / "socket")
    began = time.monotonic()
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        truth = ask_truth(tmp_path / "socket", [began + 0.05, began + 9.0], [began + 9.0])
    finally:
        server.stop()
        thread.join()
    np.testing.assert_allclose(truth["trus_T_camera"][1], room.trus_T_camera(9.0))
    assert np.shape(truth["spots_mm"]) == (1, 3)
    assert abs(truth["moved_s"][0] - (began + 0.1)) < 5.0
    with pytest.raises(FgregError, match="does not send its ground truth"):
        ask_truth(tmp_path / "nowhere", [0.0], [])


def test_the_surgeon_aims_in_another_way_where_aims_have_no_effect(tmp_path: Path) -> None:
    room = Room(room_config(1, 320, aims=2, bump_every_s=float("inf")))
    server = RoomServer(room, tmp_path / "socket")
    server.stop()
    server.run()  # ends at once, and releases the socket
    first, seen = room.place, [room.place]
    for step in range(400):
        server._live(0.05 * step)
        if room.place is not seen[-1]:
            seen.append(room.place)
    assert first.corner is not None
    assert len(seen) >= 2
    assert all(place.corner is not None for place in seen)  # still aims: none of the session's is used up
    assert not np.allclose(seen[1].trus_T_marker, first.trus_T_marker)
    assert room.proceed(20.0) is room._aims[1]
