"""Checks of events before they reach the graph."""

from __future__ import annotations

import math

from fgreg.errors import EventRefused
from fgreg.model.measurement_checks import motion_problem, pose_problem, problem_of
from fgreg.model.measurements import Aim, KnownPoint, Pair
from fgreg.online.events import CameraMoved, LoopClosed, OnlineEvent, StaticTags


def check(event: OnlineEvent, after: float) -> None:
    """Check an event: its numbers (fgreg.model.measurement_checks), and a time that does not go back.

    ``after``: time (s) of the last event.

    Raises:
        EventRefused: with the first fault found.
    """
    if not isinstance(event, Aim | Pair | KnownPoint | CameraMoved | StaticTags | LoopClosed):
        raise EventRefused(f"a {type(event).__name__} is not an event of a registration")
    if not math.isfinite(event.t):
        raise EventRefused(f"its time is {event.t}, expected a number")
    if event.t < after:
        raise EventRefused(f"its time is {event.t} s, before the last event's {after} s")
    if (problem := _problem(event)) is not None:
        raise EventRefused(problem)


def _problem(event: OnlineEvent) -> str | None:
    if isinstance(event, Aim | Pair | KnownPoint):
        return problem_of(event)
    if isinstance(event, CameraMoved):
        return motion_problem(event.camera_new_T_camera_old, event.covariance)
    if isinstance(event, StaticTags):
        for tag, pose in event.camera_T_tag.items():
            if tag not in event.covariance:
                return f"tag {tag} has no covariance"
            if (problem := pose_problem(f"camera_T_tag of tag {tag}", pose, event.covariance[tag])) is not None:
                return problem
    return None
