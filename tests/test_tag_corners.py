"""Static tags by their places in the picture: bumps are seen in the next frame, noise and a touched tag are no bump."""

from __future__ import annotations

import numpy as np
import pytest

from fgreg.camera_moves.tag_corners import FIRST_FRAMES, LIMIT_RAD, TagCorners
from fgreg.geometry.transforms import FloatArray, exp_so3, make_transform

FOCAL_PX = 600.0
SQUARE = np.array([[-10.0, 10.0, 0.0], [10.0, 10.0, 0.0], [10.0, -10.0, 0.0], [-10.0, -10.0, 0.0]])
PLACES = {1: np.array([-30.0, -10.0, 110.0]), 2: np.array([25.0, -20.0, 100.0]), 3: np.array([0.0, 30.0, 120.0])}


class Views:
    """Two views, 5 mm apart, of tags that a moved camera sees elsewhere."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(2)
        self.camera_T_room = np.eye(4)
        self.pushed = {number: np.zeros(3) for number in PLACES}
        self.shown = set(PLACES)
        self.corners = TagCorners((FOCAL_PX, FOCAL_PX))

    def frame(self, noise_px: float = 0.3) -> bool | None:
        views = []
        for side in range(2):
            seen: dict[int, FloatArray] = {}
            for number in self.shown:
                points = PLACES[number] + self.pushed[number] + SQUARE
                points = points @ self.camera_T_room[:3, :3].T + self.camera_T_room[:3, 3] - [5.0 * side, 0.0, 0.0]
                seen[number] = FOCAL_PX * points[:, :2] / points[:, 2:] + noise_px * self.rng.normal(size=(4, 2))
            views.append(seen)
        return self.corners.at_rest(views)


@pytest.fixture
def views() -> Views:
    made = Views()
    assert [made.frame() for _ in range(FIRST_FRAMES)] == [None] * FIRST_FRAMES
    return made


def test_tags_that_stand_are_at_rest_for_an_hour_of_frames(views: Views) -> None:
    assert all(views.frame() for _ in range(5_400))


def test_a_slow_drift_of_the_holder_is_left_to_the_poses(views: Views) -> None:
    drift = make_transform(np.eye(3), np.array([0.05 / 90.0, 0.0, 0.0]))  # mm a frame, 90 frames a minute
    for _ in range(15 * 90):
        views.camera_T_room = views.camera_T_room @ drift
        assert views.frame()
    views.camera_T_room = views.camera_T_room @ make_transform(np.eye(3), np.array([0.6, 0.0, 0.0]))
    assert [views.frame() for _ in range(10)] == [False] * 10


@pytest.mark.parametrize(
    "motion",
    [
        make_transform(np.eye(3), np.array([0.6, 0.0, 0.0])),
        make_transform(np.eye(3), np.array([0.0, -0.6, 0.0])),
        make_transform(np.eye(3), np.array([0.0, 0.0, 3.0])),
        make_transform(exp_so3(np.array([0.006, 0.0, 0.0])), np.zeros(3)),
        make_transform(exp_so3(np.array([0.0, 0.0, 0.02])), np.zeros(3)),
    ],
)
def test_a_moved_camera_is_seen_in_each_frame_until_it_is_back(views: Views, motion: FloatArray) -> None:
    views.camera_T_room = motion
    assert [views.frame() for _ in range(50)] == [False] * 50
    views.camera_T_room = np.eye(4)
    assert views.frame()


def test_the_limit_is_an_angle_of_the_view(views: Views) -> None:
    for share, at_rest in ((0.8, True), (1.2, False)):
        views.camera_T_room = make_transform(exp_so3(np.array([0.0, share * LIMIT_RAD, 0.0])), np.zeros(3))
        assert views.frame(noise_px=0.0) is at_rest


def test_one_of_three_tags_that_is_touched_is_no_move_and_one_of_two_tells_nothing(views: Views) -> None:
    views.pushed[2] = np.array([4.0, 0.0, 0.0])
    assert views.frame()
    views.shown.remove(3)
    assert views.frame() is None


def test_a_tag_that_comes_into_view_after_a_move_is_not_learnt_in_its_place(views: Views) -> None:
    views.corners.begin_again()
    views.shown = {1}
    for _ in range(FIRST_FRAMES):
        views.frame()
    views.camera_T_room = make_transform(np.eye(3), np.array([5.0, 0.0, 0.0]))
    views.shown = set(PLACES)
    assert [views.frame() for _ in range(2 * FIRST_FRAMES)] == [False] * (2 * FIRST_FRAMES)


def test_where_all_known_tags_are_out_of_view_no_other_is_learnt(views: Views) -> None:
    views.corners.begin_again()
    views.shown = {1}
    assert [views.frame() for _ in range(FIRST_FRAMES + 1)] == [None] * FIRST_FRAMES + [True]
    views.shown = {2, 3}
    assert [views.frame() for _ in range(2 * FIRST_FRAMES)] == [None] * (2 * FIRST_FRAMES)


def test_without_a_known_tag_in_view_nothing_is_said(views: Views) -> None:
    views.shown = set()
    assert views.frame() is None
    views.corners.begin_again()
    views.shown = set(PLACES)
    assert views.frame() is None
