"""The state after an event of any kind."""

from __future__ import annotations

from dataclasses import replace

from fgreg.camera_moves.loop_closure import back_to
from fgreg.camera_moves.static_tags import TagsAtRest, TagsMoved
from fgreg.errors import EventRefused
from fgreg.model.measurement_checks import of_earlier_epoch
from fgreg.model.measurements import Aim, EpochStart, KnownPoint, Pair, observation
from fgreg.online.cases import LEAST_PMS
from fgreg.online.events import CameraMoved, LoopClosed, OnlineEvent
from fgreg.smoother.state import Setting, State
from fgreg.smoother.updates import with_aim, with_motion, with_move, with_pair, with_point


def next_state(
    state: State,
    event: OnlineEvent,
    found: TagsMoved | TagsAtRest | None,
    setting: Setting,
    *,
    noticed: bool,
    restoring: bool,
) -> State:
    """The state with one more event.

    Args:
        state: before it.
        event: what came.
        found: what static tags show, where the event is a frame of them.
        setting: of the session.
        noticed: whether the current epoch began with a move that was detected.
        restoring: whether events of a recorded session are taken in again; only then loops are closed by events.

    Raises:
        EventRefused: a pair whose marker was seen before the camera moved, or a loop that cannot be closed here.
        ArithmeticError, RuntimeError: as of fgreg.smoother.updates.
    """
    if isinstance(event, Pair):
        if any(observation(shot.pair) == observation(event) for shot in state.shots[: state.now.first]):
            raise EventRefused(of_earlier_epoch(event.pm))
        return with_pair(state, event, setting)
    if isinstance(event, Aim):
        return with_aim(state, event, setting)
    if isinstance(event, KnownPoint):
        return with_point(state, event, setting)
    if isinstance(event, CameraMoved):
        start = EpochStart(event.t, event.camera_new_T_camera_old, event.covariance)
        if event.since_t is not None:
            last, since_t = _pairs_since(state, event.since_t), event.since_t
            return with_move(state, replace(start, t=since_t), setting, last, since_t)
        if noticed and state.epoch_pms < LEAST_PMS:
            # This may be the move that was detected, or another one, so the measured motion cannot be used.
            start = EpochStart(event.t)
        return with_move(state, start, setting)
    if isinstance(found, TagsMoved):
        last = _pairs_since(state, found.since_t)
        return with_move(state, EpochStart(found.since_t), setting, last, found.since_t)
    if isinstance(found, TagsAtRest):
        start = EpochStart(state.now.start.t, found.camera_new_T_camera_old, found.covariance)
        return with_motion(state, start, setting)
    if isinstance(event, LoopClosed):
        if not restoring or event.epoch != state.epoch or not event.to < event.epoch:
            raise EventRefused(f"it closes a loop from epoch {event.epoch} to {event.to} in epoch {state.epoch}")
        return with_motion(state, back_to(state.now.start, event.to), setting)
    return replace(state, nis=None, used=False)


def _pairs_since(state: State, t: float) -> int:
    """Number of the epoch's last pairs that were taken at ``t`` or later, after the camera had moved.

    Looks that share the marker observation of an earlier one belong to its epoch, whenever their pulse came.
    """
    shots = state.current
    last = sum(shot.pair.t >= t for shot in shots)
    before = {observation(shot.pair) for shot in shots[: len(shots) - last]}
    while last and observation(shots[-last].pair) in before:
        last -= 1
    return last
