"""Calibration shots: marker and board in one picture, exposed after the word."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future

import numpy as np

from fgreg.detection.board import detect_board
from fgreg.detection.corner_noise import pool_corner_noise
from fgreg.detection.results import BoardFit, NotFound, board_corner
from fgreg.drivers.base import host_now
from fgreg.live.actions import Tell
from fgreg.live.marker_tracker import MarkerTracker
from fgreg.live.pa_worker import Locator
from fgreg.model.events import AimEvent, MarkerRecord
from fgreg.model.session_model import SessionModel
from fgreg.model.time_sync import TimedPose

AIM_S, NO_FRAME_S = 0.3, 3.0
"""An aim is given up once a picture that came this long after it shows no marker, or none came for the second."""
BOARD_S = 30.0
"""An aim is given up once its board was looked for this long: the process may never be able to start."""


class AimTaker:
    """Takes one calibration shot at a time.

    Args:
        model: session model. tracker: has the newest picture and pose. locator: looks for the board.
        tell: shows a message. hand_over: records the shot. session_t: session time of a host time.
    """

    def __init__(
        self,
        model: SessionModel,
        tracker: MarkerTracker,
        locator: Locator,
        tell: Callable[[Tell], None],
        hand_over: Callable[[AimEvent], None],
        session_t: Callable[[float], float],
    ) -> None:
        self._model, self._tracker, self._locator = model, tracker, locator
        self._tell, self._hand_over, self._t = tell, hand_over, session_t
        self._wanted: tuple[tuple[int, int], float] | None = None  # the corner, and when it was asked for
        self._aiming: tuple[tuple[int, int], TimedPose, Future[BoardFit | NotFound]] | None = None

    def aim(self, corner: tuple[int, int]) -> None:
        """Want a calibration shot: marker and board in one picture, from after the word.

        The newest picture that was processed may show the fibre on its way, where the machine is slow.
        """
        if self._model.camera is None or self._model.board is None:
            self._tell(Tell("no aim: session.yaml has no board"))
        elif self._aiming is None and self._wanted is None:  # else one is under way
            self._wanted = (corner, host_now())

    def _begin(self) -> None:
        """Look for the board in the first picture with the marker that was exposed after the aim was asked for."""
        if self._wanted is None:
            return
        (corner, asked_s), tracker, now = self._wanted, self._tracker, host_now()
        frame, pose, rig, board = tracker.newest, tracker.poses.newest(), self._model.camera, self._model.board
        shown = frame is not None and not tracker.missing and pose is not None and pose.t_s >= asked_s
        if shown and frame is not None and pose is not None and rig is not None and board is not None:
            found = self._locator.run(detect_board, frame.left, frame.right, rig, board)
            self._aiming, self._wanted = (corner, pose, found), None
        elif (missing := frame is not None and frame.stamp.host_s > asked_s + AIM_S) or now - asked_s > NO_FRAME_S:
            self._wanted = None
            why = tracker.missing if missing and tracker.missing else "no frame"
            self._tell(Tell(f"no aim: the marker is not seen ({why})"))

    def step(self) -> None:
        """Record the pending calibration shot once its board has been detected."""
        self._begin()
        if self._aiming is None:
            return
        corner, pose, found = self._aiming
        if not found.done():
            if host_now() - pose.t_s > BOARD_S:
                self._aiming = None
                found.cancel()
                self._tell(Tell(f"no aim: the search for the board took over {BOARD_S:.0f} s"))
            return
        self._aiming = None
        board = self._model.board
        try:
            fit = found.result()
        except Exception as error:  # a fault of one picture; the next may be good
            self._tell(Tell(f"no aim: {error}"))
            return
        if board is None or not (0 <= corner[0] < board.columns and 0 <= corner[1] < board.rows):
            self._tell(Tell(f"no aim: the board has no inner corner {corner[0]}, {corner[1]}"))
            return
        if not isinstance(fit, BoardFit):
            self._tell(Tell(f"no aim: {fit.reason}"))
            return
        spot, covariance = board_corner(fit, corner[0], corner[1], pool_corner_noise([fit.pose]))
        turn = fit.camera_T_board[:3, :3]
        covariance = covariance + turn @ np.diag(np.square(self._model.noise.aim_mm)) @ turn.T
        marker = MarkerRecord(pose.parent_T_child, pose.covariance)
        self._hand_over(AimEvent(self._t(pose.t_s), 0, marker, spot, covariance))
        self._tell(Tell(f"aim at corner {corner[0]}, {corner[1]} taken", done=True))
