"""Camera moves that static tags show, in the live frames: board and tags that stay in view while the camera stands.

The marker's detector searches the whole picture once in some frames, and finds the tags in it on the way. Their poses
are fitted in the locator's worker process, at a share :data:`SHARE` of one processor at most, so that a slow machine
looks less often. A move is under way from the alarm until the camera is at rest again; it is then known with its
covariance, against the poses kept for this epoch. Tags that do not stand still are reported and no longer used: they
must not divide the session into epochs for ever.

Poses take their time. So each searched frame is first tested by where the tags are in the picture
(fgreg.camera_moves.tag_corners): the stage follows a marker only as far as such a frame shows the tags in their place.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np

from fgreg.camera_moves.static_tags import (
    TagFrame,
    TagMonitor,
    TagsAtRest,
    TagSettings,
    TagsMoved,
    monitored,
    move_covariance,
    observed,
    turn_rad,
)
from fgreg.camera_moves.tag_corners import TagCorners
from fgreg.camera_moves.view_shift import view_shift_mm
from fgreg.detection.corners import grey
from fgreg.detection.static_tags import BOARD, StaticView, static_poses
from fgreg.drivers.base import CommandKind
from fgreg.drivers.operator_words import spelt
from fgreg.geometry.transforms import FloatArray
from fgreg.live.marker_tracker import WholeFrame
from fgreg.live.pa_worker import Locator
from fgreg.live.scope_holder import HolderMove
from fgreg.model.session_model import SessionModel

SETTINGS = TagSettings(windows=(2, 6), least_mm=0.3)
SHARE = 0.06
"""Largest share of one processor's time."""
EVERY_S, MOST_S = 0.6, 3.0
"""Least and largest time between two frames while the camera stands; while it moves each frame counts."""
BOARD_EVERY_S = 10.0
"""Time between two frames in which a board that was not in view is looked for."""
UNREST_S = 12.0
"""A move that has not ended after this long, or of which no pose has come, ends with an unknown motion."""
MOST_ALARMS, ALARMS_S = 20, 300.0
"""More alarms in this time than a bumped scope and tags that are covered now and then give: they are not static."""
UNSEEN_S = 3.0
"""Once no tag was seen for this long the operator is told."""
UNSEEN = (
    "no static tag is in view: a camera move would not show, so the stage does not follow; if the camera was moved, "
    f"say {spelt(CommandKind.MOVED)}"
)
SHIFTED_FRAMES = 2
"""Frames in a row with the tags out of their place, from which on the camera counts as moving."""
BACK_SHARE = 0.5
"""Share of the least move below which the camera is back where it was; a holder that drifts is not."""
BACK = "the camera is back where it was, by the static tags"
NOT_SEEN = "the static tags show no camera move: as one was reported, the registration starts again"
UNSTEADY, APART = 12, 6
"""Frames after which a tag without a steady pose, or one that goes its own way, is no longer used."""


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """A frame under way: host times of its exposure and of its start, whether the board was asked for, its poses."""

    t_s: float
    began_s: float
    board: bool
    poses: Future[dict[int, tuple[FloatArray, FloatArray]]]


class StaticTags:
    """Looks for static tags, and for the camera's moves against them.

    Args:
        model: of the session.
        locator: whose process fits the poses.

    Attributes:
        frames: in which a tag was found. next_s: host time from which the next one is looked at.
        reported: whether the operator has reported the move that has not ended.
    """

    def __init__(self, model: SessionModel, locator: Locator) -> None:
        self._model, self._locator = model, locator
        self._tags = {tag.id: tag for tag in model.static_tags}
        self._board = model.board
        self._monitor = TagMonitor()
        self._job: _Job | None = None
        self._board_s = -np.inf
        self._newest: WholeFrame | None = None  # searched for tags
        self._given: WholeFrame | None = None  # the last one that came
        self._unrest_s = 0.0  # of the alarm; while the tags are only out of their place, of the newest poses of them
        self._alarms: deque[float] = deque(maxlen=MOST_ALARMS + 1)
        self._apart: Counter[int] = Counter()
        self._disagree = 0
        self._news: list[str] = []
        self._corners = TagCorners(_focal_px(model))
        self._rest_s = self._seen_s = -np.inf  # newest frames: with the tags in their place, with any of them
        self._shifted: list[float] = []  # host times of frames since then with the tags elsewhere
        self._fitted = 0  # number of those whose poses are known
        self._alarm_since_s: float | None = None
        self._unseen = False  # no tag is in view, and the operator was told
        self._rested_s = self._split_s = -np.inf  # last frame at rest before the alarm; see note_epoch
        self._epoch, self._waited = 0, True
        self.frames, self.reported = 0, False
        self.next_s = -np.inf

    @property
    def in_use(self) -> frozenset[int]:
        """Numbers of the tags that are looked for."""
        return frozenset(self._tags) | (frozenset() if self._board is None else {BOARD})

    @property
    def moving_since_s(self) -> float | None:
        """Host time of the first frame after a move that has not ended; None while the camera stands."""
        if self._alarm_since_s is not None:
            return self._alarm_since_s
        return self._shifted[0] if len(self._shifted) >= SHIFTED_FRAMES else None

    @property
    def in_doubt(self) -> bool:
        """Whether the last frame alone shows the tags out of their place, so that another one is wanted at once."""
        return 0 < len(self._shifted) < SHIFTED_FRAMES

    def still_until_s(self) -> float:
        """Host time of the newest frame that shows the tags in their place; infinite where none is known yet.

        Tags that are out of view show nothing, but may be so because the camera has moved.
        """
        return self._rest_s if self._tags and np.isfinite(self._seen_s) else np.inf

    def news(self) -> list[str]:
        """Messages about tags since the last call."""
        news, self._news = self._news, []
        return news

    def begin_again(self) -> None:
        """The camera has moved, as others tell: where the tags are is learnt again, from the frames to come."""
        self._monitor, self._alarm_since_s, self.reported = TagMonitor(), None, False
        self._job, self._newest = None, self._given
        self._learn_corners()
        self._apart.clear()
        self._disagree = 0

    def note_epoch(self, number: int, now_s: float, *, waits: bool) -> None:
        """Take in the registration's camera epoch; ``waits``: for a recorded move, which begins the next one.

        An epoch without one began where the pairs showed a move. If no frame has shown the tags in their place since,
        as they were out of view, what they measure next may be that move: it is no motion from the epoch that it began.
        """
        waited, self._waited = self._waited or waits, waits
        if number != self._epoch and not waited:
            self._split_s = now_s
        self._epoch = number

    def take_report(self, now_s: float) -> bool:
        """The operator reports a camera move: whether the tags measure it, for :meth:`step` to return at the rest."""
        if self._alarm_since_s is None:
            if now_s - self._seen_s > UNSEEN_S or not self._monitor.detector.means:
                return False
            self._alarm_since_s, self._unrest_s = self._shifted[0] if self._shifted else self._rest_s, now_s
            self._monitor, self._rested_s = TagMonitor(before=self._monitor.detector.means), self._rest_s
            self._job, self._newest, self.next_s = None, self._given, now_s
            self._learn_corners()
        self.reported = True
        return True

    def step(self, whole: WholeFrame | None, now_s: float, *, with_board: bool) -> HolderMove | None:
        """Take in the newest frame that was searched as a whole; the move that has just ended, or None.

        ``with_board``: whether the board lies still now, which it does not while the laser is aimed at it.
        """
        before_s = self.moving_since_s
        if whole is not None and whole is not self._given:
            self._given = whole
            self._test_corners(whole, now_s)
        move = self._take(now_s)
        since_s = self.moving_since_s
        if before_s is None and since_s is not None and self._too_often(now_s):
            return HolderMove(since_s, None, None)
        if since_s is not None and now_s - self._unrest_s > UNREST_S:
            move = HolderMove(since_s, None, None, self.reported)
            self.begin_again()
        if self.in_use and self._job is None and whole is not None and whole is not self._newest:
            board = with_board and self._board is not None and now_s >= self._board_s
            if now_s >= self.next_s and not self._locator.busy and (self._in_view(whole) or board):
                self._newest = whole
                self._submit(whole, now_s, board)
        unseen = bool(self._tags) and np.isfinite(self._seen_s) and now_s - self._seen_s > UNSEEN_S
        if unseen and not self._unseen:
            self._news.append(UNSEEN)
        self._unseen = unseen
        return move

    def _test_corners(self, whole: WholeFrame, now_s: float) -> None:
        """Whether the tags that are known to stand still are where they were in the picture."""
        steady = self._monitor.detector.means
        views = [
            {tag.id: tag.corners_px for tag in view.others or () if tag.id in self._tags and tag.id in steady}
            for view in ([whole.left] if whole.right is None else [whole.left, whole.right])
        ]
        if self._alarm_since_s is not None or not any(views):
            return
        at_rest = self._corners.at_rest(views)
        if at_rest is None:
            return
        self._seen_s = now_s
        if at_rest:
            if self.moving_since_s is not None:
                self._news.append(BACK)
            self._rest_s, self._fitted = whole.t_s, 0
            self._shifted.clear()
        else:
            self._unrest_s = self._unrest_s if self._shifted else now_s
            self._shifted.append(whole.t_s)
            self.next_s = now_s  # their poses are wanted at once

    def _learn_corners(self) -> None:
        self._corners.begin_again()
        self._rest_s = self._seen_s = -np.inf
        self._shifted.clear()
        self._fitted = 0

    def _in_view(self, whole: WholeFrame) -> bool:
        views = [whole.left] + ([] if whole.right is None else [whole.right])
        shown = [{tag.id for tag in view.others or ()} for view in views]
        return bool(set(self._tags).intersection(*shown))

    def _submit(self, whole: WholeFrame, now_s: float, board: bool) -> None:
        pictures = [(whole.frame.left, whole.left)]
        if whole.frame.right is not None and whole.right is not None:
            pictures.append((whole.frame.right, whole.right))
        views = tuple(
            (grey(picture), tuple(tag for tag in view.others or () if tag.id in self._tags))
            for picture, view in pictures
        )
        rig, marker = self._model.camera, self._model.marker
        if rig is None or marker is None:
            raise AssertionError("the live loop needs a camera and a marker")
        view = StaticView(views, rig, marker.dictionary, tuple(self._tags.values()), self._board if board else None)
        self._job = _Job(whole.t_s, now_s, board, self._locator.run(static_poses, view))

    def _take(self, now_s: float) -> HolderMove | None:
        """Take in the poses of a frame, once they are there."""
        if self._job is None or not self._job.poses.done():
            return None
        job, self._job = self._job, None
        try:
            poses = job.poses.result()
        except Exception as error:  # a fault of one picture; the next may be good
            self._news.append(f"static tags: {error}")
            poses = {}
        if self.moving_since_s is None:
            self.next_s = now_s + min(max(EVERY_S, (now_s - job.began_s) / SHARE), MOST_S)
        if job.board and BOARD not in poses:
            self._board_s = now_s + BOARD_EVERY_S
        if not poses:
            return None
        self.frames += 1
        if self._shifted and job.t_s >= self._shifted[0]:
            self._fitted, self._unrest_s = self._fitted + 1, now_s
        frame = observed(poses)
        self._monitor, found = monitored(self._monitor, job.t_s, frame, SETTINGS)
        if isinstance(found, TagsMoved):
            self._alarm_since_s, self._unrest_s = self._shifted[0] if self._shifted else found.since_t, now_s
            self._rested_s = self._rest_s
            self._learn_corners()
            return None
        if isinstance(found, TagsAtRest):
            return self._at_rest(found)
        if self._fitted > max(SETTINGS.windows):  # shifted a little, which their poses do not call a move
            self._news += [] if self.moving_since_s is None else [BACK]
            self._learn_corners()
        self._check_tags(frame)
        return None

    def _too_often(self, now_s: float) -> bool:
        """Count one more move; whether there are too many, so that the tags are no longer used."""
        self._alarms.append(now_s)
        if len(self._alarms) <= MOST_ALARMS or now_s - self._alarms[0] > ALARMS_S:
            return False
        self._tags.clear()
        self._board = None
        self.begin_again()
        self._news.append(
            f"the static tags moved {len(self._alarms)} times in {ALARMS_S / 60.0:.0f} minutes: they are not fixed, or "
            "the endoscope is not held. They are not used any more"
        )
        return True

    def _at_rest(self, found: TagsAtRest) -> HolderMove | None:
        since_s, self._alarm_since_s = self._alarm_since_s, None
        reported, self.reported = self.reported, False
        motion = found.camera_new_T_camera_old
        shift_mm = view_shift_mm(motion)
        if since_s is None:
            raise AssertionError("a rest without a move")
        by_noise = reported and found.chi2 <= SETTINGS.threshold  # else what was seen on the way is a move already
        if by_noise or shift_mm < BACK_SHARE * SETTINGS.least_mm:
            self._news.append(NOT_SEEN if reported else BACK)
            # The operator's word stands: what has moved may be something else than the camera against these tags.
            return HolderMove(since_s, None, None, reported) if reported else None
        self._news.append(
            "the static tags show that the camera has moved: "
            f"{shift_mm:.1f} mm and {math.degrees(turn_rad(motion)):.1f} deg"
        )
        if self._rested_s < self._split_s:
            return HolderMove(since_s, None, None, reported)
        return HolderMove(since_s, motion, move_covariance(motion, found.covariance), reported)

    def _check_tags(self, frame: TagFrame) -> None:
        """Leave out tags that do not stand still, or that go their own way."""
        detector, last = self._monitor.detector, self._monitor.last
        apart = () if last is None or last.motion is None else last.motion.apart
        for number in frame.camera_T_tag:
            self._apart[number] = self._apart[number] + 1 if number in apart else 0
            seen = sum(number in kept.camera_T_tag for kept in detector.reference)
            if seen >= UNSTEADY and number not in detector.means:
                self._leave_out(number, "does not stand still")
            elif self._apart[number] >= APART:
                self._leave_out(number, "has moved by itself")
        both = set(detector.means).intersection(frame.camera_T_tag)
        disagree = last is not None and last.motion is None and len(both) > 1
        self._disagree = self._disagree + 1 if disagree else 0
        if self._disagree >= APART:
            self.begin_again()
            self._news.append("the static tags contradict each other: where they are is learnt again")

    def _leave_out(self, number: int, why: str) -> None:
        self._tags.pop(number, None)
        if number == BOARD:
            self._board = None
        name = "the board" if number == BOARD else f"static tag {number}"
        self._news.append(f"{name} {why}: it is not used to look for camera moves")


def _focal_px(model: SessionModel) -> tuple[float, ...]:
    """Focal length of each view."""
    rig = model.camera
    cameras = [] if rig is None else [rig.left, *([] if rig.right is None else [rig.right])]
    return tuple(float(camera.matrix[0, 0]) for camera in cameras)
