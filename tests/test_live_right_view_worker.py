"""The right view in a process of its own: the same corners, and no frame is lost if it fails."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from fgreg.detection.marker import detect_marker, right_corners
from fgreg.detection.results import MarkerFit
from fgreg.drivers.base import StereoFrame
from fgreg.live.marker_tracker import MarkerTracker
from fgreg.live.right_view_worker import RightViewWorker
from fgreg.model.session_model import SessionModel
from fgreg.model.time_sync import Stamp
from fgreg.session.setup_reader import read_setup
from fgreg.simulation.documents import session_document
from fgreg.simulation.render import UInt8Image
from fgreg.simulation.room import Room, room_config

Pictures = tuple[UInt8Image, UInt8Image]


@pytest.fixture(scope="module")
def room() -> tuple[SessionModel, list[Pictures]]:
    config = room_config(3, 640, aims=0)
    model = read_setup(session_document(config.scene), "session.yaml", "room", []).model
    assert model is not None
    made = Room(config)
    return model, [made.pictures(0.1 * k, k) for k in range(3)]


@pytest.fixture
def worker(room: tuple[SessionModel, list[Pictures]]) -> Iterator[RightViewWorker]:
    model = room[0]
    assert model.camera is not None
    assert model.marker is not None
    found = RightViewWorker(model.camera, model.marker)
    try:
        yield found
    finally:
        found.close()


def ready(worker: RightViewWorker, image: UInt8Image) -> None:
    """Until it has processed a picture."""
    end = time.monotonic() + 60.0
    while not worker.submit(image):
        assert time.monotonic() < end
        time.sleep(0.02)


def seen_of(worker: RightViewWorker) -> object:
    """Its result, on a machine that may be busy."""
    process = worker._worker
    assert process is not None
    process.answer_s = 60.0
    reply = process.fetch(60.0)
    return None if reply is None else reply[0]


def test_it_detects_the_same_as_this_process(
    room: tuple[SessionModel, list[Pictures]], worker: RightViewWorker
) -> None:
    model, pictures = room
    assert model.camera is not None
    assert model.marker is not None
    for _, right in pictures:
        ready(worker, right)
        found = seen_of(worker)
        here = right_corners(right, model.camera, model.marker)
        assert found is not None
        assert here.corners is not None
        np.testing.assert_array_equal(found.corners.ideal_px, here.corners.ideal_px)  # type: ignore[attr-defined]
        np.testing.assert_array_equal(found.corners.covariance, here.corners.covariance)  # type: ignore[attr-defined]


def test_a_picture_without_a_marker_is_no_trouble(
    room: tuple[SessionModel, list[Pictures]], worker: RightViewWorker
) -> None:
    blank = np.full_like(room[1][0][1], 90)
    ready(worker, blank)
    found = seen_of(worker)
    assert found is not None
    assert found.corners is None  # type: ignore[attr-defined]


def test_another_size_of_pictures_starts_a_new_worker(
    room: tuple[SessionModel, list[Pictures]], worker: RightViewWorker
) -> None:
    right = room[1][0][1]
    ready(worker, right)
    assert seen_of(worker) is not None
    assert not worker.submit(np.ascontiguousarray(right[::2, ::2]))
    ready(worker, right)
    assert seen_of(worker) is not None


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_where_it_ends_or_hangs_frames_are_processed_here_and_another_takes_over(
    room: tuple[SessionModel, list[Pictures]], how: signal.Signals
) -> None:
    model, pictures = room
    assert model.camera is not None
    assert model.marker is not None
    marker_tracker = MarkerTracker(model)
    frames = 0

    def see() -> None:
        nonlocal frames
        left, right = pictures[frames % len(pictures)]
        frames += 1
        pose = marker_tracker.detect(StereoFrame(Stamp(frames / 30.0, frames / 30.0), left, right, frames))
        expected = detect_marker(left, right, model.camera, model.marker)  # type: ignore[arg-type]
        assert isinstance(expected, MarkerFit)
        assert pose is not None
        np.testing.assert_allclose(pose.parent_T_child, expected.camera_T_marker, atol=1e-12)

    def until(condition: Callable[[], bool]) -> None:
        end = time.monotonic() + 60.0
        while not condition():
            assert time.monotonic() < end
            see()

    try:
        until(lambda: (worker := marker_tracker._right_worker._worker) is not None and worker.ready)
        worker = marker_tracker._right_worker._worker
        assert worker is not None
        pid = worker.pid
        assert pid is not None
        os.kill(pid, how)
        see()
        see()
        until(lambda: worker.ready and worker.pid != pid)
        see()
    finally:
        marker_tracker.close()
    assert not worker.alive
