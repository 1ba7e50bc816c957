"""The marker's detection in worker processes: the same poses, nothing waits, and a worker that fails is replaced."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Iterator

import numpy as np
import pytest

from fgreg.detection.marker import marker_from_views
from fgreg.detection.results import MarkerFit
from fgreg.drivers.base import StereoFrame
from fgreg.live import view_worker
from fgreg.live.marker_tracker import MarkerTracker
from fgreg.live.view_worker import view_roi
from fgreg.model.session_model import SessionModel
from fgreg.model.time_sync import Stamp, TimedPose
from fgreg.session.setup_reader import read_setup
from fgreg.simulation.documents import session_document
from fgreg.simulation.render import UInt8Image
from fgreg.simulation.room import Room, room_config
from fgreg.workers import worker_process

Pictures = tuple[UInt8Image, UInt8Image]


@pytest.fixture(scope="module")
def room() -> tuple[SessionModel, list[Pictures]]:
    config = room_config(3, 640, aims=0)
    model = read_setup(session_document(config.scene), "session.yaml", "room", []).model
    assert model is not None
    made = Room(config)
    return model, [made.pictures(0.1 * k, k) for k in range(3)]


@pytest.fixture
def tracker(room: tuple[SessionModel, list[Pictures]]) -> Iterator[MarkerTracker]:
    found = MarkerTracker(room[0])
    try:
        yield found
    finally:
        found.close()


class Seeing:
    """Hands frames to a tracker one by one."""

    def __init__(self, tracker: MarkerTracker) -> None:
        self.tracker, self.frames = tracker, 0

    def see(self, left: UInt8Image, right: UInt8Image) -> TimedPose | None:
        """The pose in this frame, None where there is none; one that is lost with a process is handed over again."""
        end = time.monotonic() + 60.0
        while True:
            self.frames += 1
            stamp = Stamp(self.frames / 30.0, self.frames / 30.0)
            self.tracker.add(StereoFrame(stamp, left, right, self.frames))
            while not self.tracker.poll():
                assert time.monotonic() < end
                time.sleep(0.002)
            if "process" not in self.tracker.missing:
                return None if self.tracker.missing else self.tracker.poses.newest()


def test_a_picture_from_before_a_move_is_no_place_at_rest_of_static_tags(
    room: tuple[SessionModel, list[Pictures]], tracker: MarkerTracker
) -> None:
    tracker.begin_again(math.inf)
    assert Seeing(tracker).see(*room[1][0]) is None
    assert tracker.processed == 1
    assert tracker.whole is None


def test_frames_give_the_pose_of_both_views_or_the_reason_without_a_wait(
    room: tuple[SessionModel, list[Pictures]], tracker: MarkerTracker
) -> None:
    model, pictures = room
    assert model.camera is not None
    assert model.marker is not None
    seeing, here = Seeing(tracker), [view_roi(model.camera, model.marker, side) for side in range(2)]
    compared: MarkerFit | None = None
    for left, right in pictures:
        pose = seeing.see(left, right)
        views = [roi.detect(image, whole=compared is None) for roi, image in zip(here, (left, right), strict=True)]
        expected = marker_from_views(views[0], views[1], model.marker, compared)
        assert isinstance(expected, MarkerFit)
        compared = expected if expected.pose.clearance is not None else compared
        assert pose is not None
        np.testing.assert_allclose(pose.parent_T_child, expected.camera_T_marker, atol=1e-12)
    blank = np.full_like(pictures[0][0], 90)
    assert seeing.see(blank, blank) is None
    assert tracker.missing
    for number in range(3):  # the newest waits, the one before is dropped
        stamp = Stamp(9.0 + number, 9.0 + number)
        tracker.add(StereoFrame(stamp, *pictures[0], 100 + number))
    began = time.monotonic()
    tracker.poll()
    assert time.monotonic() - began < 0.5
    assert tracker.dropped >= 1
    small = [np.ascontiguousarray(side[::2, ::2]) for side in pictures[0]]
    assert Seeing(tracker).see(small[0], small[1]) is None or tracker.newest is not None  # new processes for the size
    assert tracker.newest is not None


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_view_whose_process_ends_or_hangs_is_reported_and_another_takes_over(
    room: tuple[SessionModel, list[Pictures]],
    tracker: MarkerTracker,
    how: signal.Signals,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(worker_process, "SLOW_S", 0.1)
    monkeypatch.setattr(view_worker, "ANSWER_S", 0.5)
    seeing, (left, right) = Seeing(tracker), room[1][0]
    assert seeing.see(left, right) is not None
    process = tracker._workers[0]._worker
    assert process is not None
    pid = process.pid
    assert pid is not None
    os.kill(pid, how)
    tracker.add(StereoFrame(Stamp(90.0, 90.0), left, right, 90))
    troubles = set()
    end = time.monotonic() + 60.0
    while not tracker.poll():
        assert time.monotonic() < end
        troubles.add(tracker.trouble)
        time.sleep(0.01)
    assert any(troubles) or "the left view's process has ended" in tracker.missing
    seeing.frames = 3000
    assert seeing.see(left, right) is not None
    assert process.pid != pid
