"""Static tags in live frames: a bumped camera is held and measured; tags that are not static are no longer used."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fgreg.camera_moves.recorded_tags import with_tag_moves
from fgreg.camera_moves.static_tags import TagMonitor, TagsAtRest, TagsMoved
from fgreg.detection.events_to_measurements import number_epochs
from fgreg.detection.marker import ViewCorners
from fgreg.detection.static_tags import BOARD, StaticView, static_poses, static_tag_fits, tags_beside
from fgreg.detection.tags import FoundTag
from fgreg.drivers.base import StereoFrame
from fgreg.geometry.transforms import FloatArray, exp_so3, inverse, log_so3, make_transform
from fgreg.live import static_tags
from fgreg.live.launch import setup_text
from fgreg.live.marker_tracker import WholeFrame
from fgreg.live.scope_holder import HolderMove
from fgreg.live.shots import move_event
from fgreg.live.static_tags import MOST_ALARMS, SHIFTED_FRAMES, UNREST_S, UNSEEN_S, StaticTags
from fgreg.model.events import CameraMovedEvent
from fgreg.model.session_model import SessionModel
from fgreg.model.time_sync import Stamp
from fgreg.session.session_reader import read_session
from fgreg.session.setup_reader import read_setup
from fgreg.simulation.documents import session_document
from fgreg.simulation.room import Room, RoomConfig, room_config

SIGMA = np.array([0.0005] * 3 + [0.03] * 3)
BUMP = make_transform(exp_so3(np.array([0.0, 0.01, 0.0])), np.array([1.0, -0.5, 0.5]))


def of_room(config: RoomConfig) -> SessionModel:
    model = read_setup(session_document(config.scene), "session.yaml", "room", []).model
    assert model is not None
    return model


def _corners_px(camera_T_tag: FloatArray) -> FloatArray:
    """Corners (4, 2) of a tag of 20 mm in a camera of 300 px focal length."""
    square = np.array([[-10.0, 10.0, 0.0], [10.0, 10.0, 0.0], [10.0, -10.0, 0.0], [-10.0, -10.0, 0.0]])
    points = square @ camera_T_tag[:3, :3].T + camera_T_tag[:3, 3]
    return np.asarray(160.0 + 300.0 * points[:, :2] / points[:, 2:])


class Pictures:
    """Whole frames whose tags have given poses with noise; the worker process is this one, and takes no time."""

    busy = False

    def __init__(self, model: SessionModel) -> None:
        self.rng, self.now_s = np.random.default_rng(1), 0.0
        self.poses: dict[int, FloatArray] = {
            tag.id: make_transform(np.eye(3), np.array([30.0 * tag.id - 60.0, 10.0 * tag.id, 120.0]))
            for tag in model.static_tags
        }
        self.tags, self.told = StaticTags(model, self), list[str]()  # type: ignore[arg-type]

    def run(self, work: Callable[..., Any], *arguments: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(work(*arguments))
        return done

    def seen(self, _view: object) -> Mapping[int, tuple[FloatArray, FloatArray]]:
        noise = {number: SIGMA * self.rng.normal(size=6) for number in self.poses}
        return {
            number: (pose @ make_transform(exp_so3(noise[number][:3]), noise[number][3:]), np.diag(SIGMA**2))
            for number, pose in self.poses.items()
            if number in self.tags.in_use
        }

    def frames(self, count: int, moved: Callable[[float], None] = lambda _t: None) -> HolderMove | None:
        """More frames, 0.7 s apart; the move that has ended in them."""
        ended = None
        picture = np.zeros((2, 2), np.uint8)
        for _ in range(count):
            self.now_s += 0.7
            moved(self.now_s)
            found = tuple(FoundTag(number, _corners_px(pose)) for number, pose in self.poses.items())
            view = ViewCorners(None, (), (), np.zeros((0, 2)), found)
            frame = StereoFrame(Stamp(self.now_s, self.now_s), picture, picture, 0)
            for whole in (WholeFrame(self.now_s, frame, view, view), None):
                ended = self.tags.step(whole, self.now_s, with_board=False) or ended
            self.told += self.tags.news()
        return ended

    def bump(self, motion: FloatArray = BUMP) -> None:
        self.poses = {number: motion @ pose for number, pose in self.poses.items()}


@pytest.fixture
def pictures(monkeypatch: pytest.MonkeyPatch) -> Pictures:
    made = Pictures(of_room(room_config(1, 320, static_tags=3)))
    monkeypatch.setattr(static_tags, "static_poses", made.seen)
    return made


def test_a_bump_is_noticed_within_two_frames_and_measured_once_the_camera_rests(pictures: Pictures) -> None:
    assert pictures.frames(30) is None
    assert pictures.tags.moving_since_s is None
    at = pictures.now_s
    pictures.bump()
    pictures.frames(2)
    assert pictures.tags.moving_since_s is not None
    assert at < pictures.tags.moving_since_s <= at + 1.5
    move = pictures.frames(8)
    assert move is not None
    assert move.camera_new_T_camera_old is not None
    assert move.covariance is not None
    off = inverse(BUMP) @ move.camera_new_T_camera_old
    error = np.concatenate([log_so3(off[:3, :3]), off[:3, 3]])
    assert error @ np.linalg.solve(move.covariance, error) < 16.8  # 99 % of 6 degrees of freedom
    assert pictures.tags.moving_since_s is None
    assert any("has moved" in text for text in pictures.told)
    assert pictures.frames(30) is None, "the new epoch has a reference of its own"


def test_the_marker_is_followed_as_far_as_a_frame_shows_the_tags_in_their_place(pictures: Pictures) -> None:
    assert pictures.tags.still_until_s() == math.inf, "nothing is known of the tags yet"
    pictures.frames(30)
    assert pictures.tags.still_until_s() == pictures.now_s
    rested_s = pictures.now_s
    pictures.bump()
    pictures.frames(1)
    assert pictures.tags.still_until_s() == rested_s
    assert pictures.tags.moving_since_s is None, "one frame may be wrong"
    assert pictures.tags.in_doubt, "another one is searched at once"
    pictures.bump(inverse(BUMP))
    pictures.frames(1)
    assert pictures.tags.still_until_s() == pictures.now_s
    pictures.poses.clear()
    pictures.frames(1)
    assert pictures.tags.still_until_s() == pictures.now_s - 0.7
    pictures.frames(math.ceil(2.0 * UNSEEN_S / 0.7))
    assert pictures.tags.still_until_s() < pictures.now_s - UNSEEN_S, (
        "tags out of view may be so since the camera moved"
    )
    assert len([text for text in pictures.told if "no static tag is in view" in text]) == 1
    pictures.tags.begin_again()
    assert pictures.tags.still_until_s() == math.inf, "the operator has said that it moved"


def test_a_shift_that_the_poses_do_not_call_a_move_ends(pictures: Pictures, monkeypatch: pytest.MonkeyPatch) -> None:
    pictures.frames(30)
    with monkeypatch.context() as context:  # the pictures show a shift that the poses do not have
        context.setattr(Pictures, "bump", lambda *_: None)
        context.setattr("tests.test_live_static_tags._corners_px", lambda _: np.full((4, 2), 90.0))
        assert pictures.frames(SHIFTED_FRAMES) is None
        assert pictures.tags.moving_since_s is not None
        assert pictures.frames(12) is None
        assert pictures.tags.moving_since_s is None
        assert pictures.told == [static_tags.BACK]
        assert pictures.tags.still_until_s() == pictures.now_s


@pytest.mark.parametrize(("shift_mm", "recorded"), [(0.1, False), (0.25, True)])
def test_a_drift_that_raised_an_alarm_is_recorded_also_where_its_mean_is_less(
    pictures: Pictures, monkeypatch: pytest.MonkeyPatch, shift_mm: float, recorded: bool
) -> None:
    pictures.frames(1)
    motion = make_transform(np.eye(3), np.array([shift_mm, 0.0, 0.0]))
    found = iter([TagsMoved(pictures.now_s), TagsAtRest(motion, np.diag(SIGMA**2), 50.0)])
    monkeypatch.setattr(static_tags, "monitored", lambda *_: (TagMonitor(), next(found)))
    move = pictures.frames(2)
    assert (move is not None) is recorded
    assert (static_tags.BACK in pictures.told) is not recorded


def test_slow_poses_do_not_make_a_small_shift_a_move(pictures: Pictures, monkeypatch: pytest.MonkeyPatch) -> None:
    pictures.frames(30)
    monkeypatch.setattr("tests.test_live_static_tags._corners_px", lambda _: np.full((4, 2), 90.0))
    for _ in range(math.ceil(2.0 * UNREST_S / 2.1)):  # the locator is free in one of three frames
        for busy in (True, True, False):
            pictures.busy = busy
            assert pictures.frames(1) is None
    assert pictures.tags.moving_since_s is None


def test_tags_that_shift_again_and_again_are_no_longer_used(
    pictures: Pictures, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures.frames(30)
    for _ in range(MOST_ALARMS + 1):  # by what their poses do not call a move
        with monkeypatch.context() as context:
            context.setattr("tests.test_live_static_tags._corners_px", lambda _: np.full((4, 2), 90.0))
            pictures.frames(SHIFTED_FRAMES)
        pictures.frames(2)
    assert not pictures.tags.in_use
    assert pictures.told.count(static_tags.BACK) == MOST_ALARMS


def test_a_shift_without_poses_becomes_a_move_of_unknown_motion(
    pictures: Pictures, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures.frames(30)
    pictures.bump()
    with monkeypatch.context() as context:
        context.setattr(static_tags, "static_poses", lambda _: {})
        ended = pictures.frames(math.ceil(UNREST_S / 0.7) + 3)
    assert ended is not None
    assert ended.camera_new_T_camera_old is None


def test_a_frame_from_before_a_reported_move_is_no_reference_of_the_new_epoch(
    pictures: Pictures, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures.frames(20)
    under_way: Future[Any] = Future()
    with monkeypatch.context() as context:
        context.setattr(Pictures, "run", lambda *_: under_way)
        pictures.frames(1)
    before = pictures.seen(None)
    pictures.tags.begin_again()
    pictures.bump()
    under_way.set_result(before)
    assert pictures.frames(20) is None
    assert pictures.tags.moving_since_s is None


def test_a_reported_move_is_measured_by_tags_in_view(pictures: Pictures) -> None:
    assert not pictures.tags.take_report(0.0), "nothing is known of the tags yet"
    pictures.frames(20)
    rested_s = pictures.now_s
    pictures.bump()
    assert pictures.tags.take_report(pictures.now_s)
    assert pictures.tags.moving_since_s == rested_s, "at once"
    move = pictures.frames(8)
    assert move is not None
    assert move.since_s == rested_s
    assert move.camera_new_T_camera_old is not None
    np.testing.assert_allclose(move.camera_new_T_camera_old, BUMP, atol=0.5)
    assert pictures.frames(30) is None


def test_a_reported_move_that_the_tags_do_not_show_starts_the_registration_again(pictures: Pictures) -> None:
    pictures.frames(20)
    assert pictures.tags.take_report(pictures.now_s)
    move = pictures.frames(8)
    assert move is not None
    assert move.camera_new_T_camera_old is None
    assert any("show no camera move" in text for text in pictures.told)
    event = move_event(pictures.now_s, move, [], lambda host_s: host_s)
    assert not event.detected, "it was reported, and nothing was measured"
    assert pictures.tags.moving_since_s is None
    assert pictures.frames(30) is None


def test_noise_is_no_measurement_of_a_reported_move(pictures: Pictures, monkeypatch: pytest.MonkeyPatch) -> None:
    pictures.frames(20)
    assert pictures.tags.take_report(pictures.now_s)
    by_noise = TagsAtRest(make_transform(np.eye(3), np.array([0.25, 0.0, 0.0])), np.diag(SIGMA**2), 0.6)
    monkeypatch.setattr(static_tags, "monitored", lambda *_: (TagMonitor(), by_noise))
    move = pictures.frames(1)
    assert move is not None
    assert move.camera_new_T_camera_old is None


@pytest.mark.parametrize("frames", [SHIFTED_FRAMES, SHIFTED_FRAMES + 2])
def test_a_move_reported_while_the_tags_shift_is_not_lost_where_they_come_back(
    pictures: Pictures, monkeypatch: pytest.MonkeyPatch, frames: int
) -> None:
    pictures.frames(20)
    with monkeypatch.context() as context:
        if frames == SHIFTED_FRAMES:  # no pose calls it a move yet
            context.setattr(static_tags, "static_poses", lambda _: {})
        pictures.bump()
        pictures.frames(frames)
    since_s = pictures.tags.moving_since_s
    assert since_s is not None
    assert pictures.tags.take_report(pictures.now_s)
    assert pictures.tags.moving_since_s == since_s
    pictures.bump(inverse(BUMP))
    move = pictures.frames(12)
    assert move is not None
    assert move.camera_new_T_camera_old is None


@pytest.mark.parametrize(
    ("waits", "seen_again", "known"), [(False, False, False), (True, False, True), (False, True, True)]
)
def test_a_move_that_the_pairs_showed_while_no_tag_was_in_view_is_not_measured_again(
    pictures: Pictures, waits: bool, seen_again: bool, known: bool
) -> None:
    pictures.tags.note_epoch(0, 0.0, waits=False)
    pictures.frames(20)
    poses = pictures.poses
    if not seen_again:
        pictures.bump()
    moved, pictures.poses = pictures.poses, {}
    pictures.frames(10)
    pictures.tags.note_epoch(0, pictures.now_s, waits=waits)
    pictures.tags.note_epoch(1, pictures.now_s, waits=False)
    pictures.frames(10)
    pictures.poses = moved
    if seen_again:  # where they were: what comes then is another move
        assert poses is moved
        pictures.frames(3)
        pictures.bump()
    move = pictures.frames(10)
    assert move is not None
    assert (move.camera_new_T_camera_old is not None) is known


def test_a_reported_move_out_of_the_tags_view_is_not_measured(pictures: Pictures) -> None:
    pictures.frames(20)
    assert not pictures.tags.take_report(pictures.now_s + UNSEEN_S + 1.0)
    assert pictures.tags.moving_since_s is None


def test_a_camera_that_comes_back_has_not_moved(pictures: Pictures) -> None:
    pictures.frames(20)
    pictures.bump()
    pictures.frames(2)
    assert pictures.tags.moving_since_s is not None
    pictures.bump(inverse(BUMP))
    assert pictures.frames(8) is None
    assert pictures.tags.moving_since_s is None


def test_a_move_without_a_rest_ends_with_an_unknown_motion(pictures: Pictures) -> None:
    pictures.frames(20)
    ended = pictures.frames(math.ceil(UNREST_S / 0.7) + 3, lambda _t: pictures.bump())
    assert ended is not None
    assert ended.camera_new_T_camera_old is None


def test_a_tag_that_moves_by_itself_is_left_out_and_the_others_go_on(pictures: Pictures) -> None:
    pictures.frames(20)
    pictures.poses[2] = BUMP @ pictures.poses[2]
    assert pictures.frames(10) is None
    assert [text for text in pictures.told if "static tag 2 has moved by itself" in text]
    pictures.bump()
    assert pictures.frames(10) is not None


def test_a_tag_that_breathes_is_never_used(pictures: Pictures) -> None:
    still = pictures.poses[1].copy()

    def breathe(t_s: float) -> None:
        pictures.poses = {1: still.copy()}
        pictures.poses[1][2, 3] += 3.0 * math.sin(2.0 * math.pi * t_s / 4.3)

    assert pictures.frames(40, breathe) is None
    assert pictures.tags.moving_since_s is None
    assert [text for text in pictures.told if "static tag 1 does not stand still" in text]


def test_tags_that_move_again_and_again_are_no_longer_used(pictures: Pictures) -> None:
    pictures.frames(20)
    moves = 0
    for _ in range(MOST_ALARMS + 3):
        pictures.bump()
        moves += pictures.frames(14) is not None
    assert moves == MOST_ALARMS + 1
    assert [text for text in pictures.told if "they are not fixed" in text]
    assert not pictures.tags.in_use


def test_a_session_without_static_tags_looks_for_its_board_alone() -> None:
    room = Room(room_config(4, 640, aims=2, bump_every_s=math.inf))
    model = of_room(room.config)
    assert model.camera is not None
    assert model.marker is not None
    assert model.static_tags == ()
    views = tuple((picture, ()) for picture in room.pictures(0.0, 0))
    for board, found in ((model.board, {BOARD}), (None, set())):
        view = StaticView(views, model.camera, model.marker.dictionary, (), board)
        assert set(static_poses(view)) == found


def test_static_tags_are_found_in_pictures_of_the_room() -> None:
    room = Room(room_config(4, 640, aims=0, bump_every_s=math.inf, static_tags=3))
    model = of_room(room.config)
    assert model.camera is not None
    assert model.marker is not None
    views = [
        (picture, tags_beside(picture, model.camera, view, model.marker))
        for view, picture in enumerate(room.pictures(0.0, 0))
    ]
    fits = static_tag_fits(views, model.camera, model.marker.dictionary, model.static_tags)
    assert sorted(fits) == [1, 2, 3]
    camera_T_trus = inverse(room.trus_T_camera(0.0))
    for number, true in room.trus_T_tags(0.0).items():
        off = inverse(camera_T_trus @ true) @ fits[number].camera_T_marker
        assert np.linalg.norm(off[:3, 3]) < 0.15
        assert np.linalg.norm(log_so3(off[:3, :3])) < 0.02


def test_static_tags_in_recorded_frames_divide_the_session_where_the_camera_moved(tmp_path: Path) -> None:
    room = Room(room_config(4, 480, aims=0, bump_every_s=math.inf, static_tags=3))
    (tmp_path / "session.yaml").write_text(setup_text(session_document(room.config.scene)))
    (tmp_path / "frames").mkdir()
    lines = []
    for number in range(5):
        if number == 3:
            room.bump(3.0)
        for side, picture in zip(("left", "right"), room.pictures(number + 0.9, number), strict=True):
            assert cv2.imwrite(str(tmp_path / "frames" / f"{side}{number}.png"), picture)
        marker = {side: f"frames/{side}{number}.png" for side in ("left", "right")}
        trus = {"scan_deg": 0.0, "x_mm": 1.0, "range_mm": 30.0}
        lines.append({"type": "pair", "t": number + 0.9, "pm": number, "marker": marker, "trus": trus})
    (tmp_path / "events.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    session = read_session(tmp_path)
    found = with_tag_moves(session)
    (move,) = [event for event in found.events if isinstance(event, CameraMovedEvent)]
    assert found.events.index(move) == 3
    assert move.detected
    true = inverse(room.trus_T_camera(9.0)) @ room.trus_T_camera(0.0)
    assert move.camera_new_T_camera_old is not None
    off = inverse(true) @ move.camera_new_T_camera_old
    assert np.linalg.norm(off[:3, 3]) < 0.5
    assert "before line 4" in found.warnings[-1]
    starts, epoch_of = number_epochs(found.events)
    assert len(starts) == 2
    assert epoch_of == (0, 0, 0, 1, 1, 1)
    assert with_tag_moves(found) is found, "moves that a recording has are not looked for again"


@pytest.mark.parametrize(
    ("tags", "found"),
    [
        ([{"id": 0, "size_mm": 20.0}], "a tag of the marker"),
        ([{"id": 7, "size_mm": 20.0}, {"id": 7, "size_mm": 20.0}], "a static tag before it"),
        ([{"id": 50, "size_mm": 20.0}], "50"),
    ],
)
def test_static_tags_have_ids_of_their_own(tags: list[dict[str, object]], found: str) -> None:
    problems: list[Any] = []
    read_setup(session_document(room_config(1).scene) | {"static_tags": tags}, "session.yaml", "room", problems)
    assert len(problems) == 1
    assert "static_tags[" in str(problems[0])
    assert found in str(problems[0])
