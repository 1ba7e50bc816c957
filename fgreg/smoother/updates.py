"""Updates of a state: by one more pair, aim or known point, by a camera move."""

from __future__ import annotations

import math
from dataclasses import replace

from fgreg.graph.packing import tells_of_constants
from fgreg.graph.shared_state import Quadratic, SharedState
from fgreg.model.measurements import Aim, EpochStart, KnownPoint, Pair
from fgreg.smoother.innovation import aim_fits, innovation, limit_of, sigma_distance
from fgreg.smoother.isam_window import ActiveWindow, Change, Group, free_number, open_active_window, prepare, updated
from fgreg.smoother.marginal_prior import carried_over, has_moved
from fgreg.smoother.shared_variables import Layout
from fgreg.smoother.state import Epoch, Setting, Shot, State, carried_prior, finished_prior, own_prior, total_prior

MOST, LEAVE = 32, 16
"""Largest number of PMs in the active window, and how many of the oldest leave it together when it is full."""
FIRST_PAIRS = 10
"""Up to this number of pairs of an epoch the full solve runs at each pair, and an update may diverge."""
MOST_UPDATES = 8
SETTLED_SIGMA = 0.05
"""Updates are repeated until the estimate moves by less, in its own standard deviations."""


def with_pair(state: State, pair: Pair, setting: Setting) -> State:
    """The state with one more pair, which is an inlier where its innovation is within the limit.

    Where it is not, and its look has other positions, the first of them that is within the limit is taken.

    Where there is no registration yet the pair is only added. Where it contradicts the others so much that no
    registration is left, the epoch has none until it is registered again.

    Raises:
        ArithmeticError: a result that is not finite, or a system that is undetermined, though there are many pairs.
        RuntimeError: another failure of GTSAM.
    """
    shot = Shot(replace(pair, epoch=state.epoch), pair.look, pair.pm, inlier=False)
    joined = replace(state, shots=(*state.shots, shot), nis=None, used=False)
    if state.active_window is None or state.layout is None:
        return joined
    try:
        first = _one_more(joined, state.active_window, state.layout, setting)
        if first.used:
            return first
        for look in pair.look.elsewhere():
            moved = replace(shot, pair=replace(shot.pair, look=look))
            other = _one_more(replace(joined, shots=(*state.shots, moved)), state.active_window, state.layout, setting)
            if other.used:
                return other
        return first
    except ArithmeticError as error:  # full steps may diverge among few pairs that contradict each other
        if sum(other.inlier for other in state.current) > FIRST_PAIRS:
            raise
        return replace(joined, active_window=None, why_none=f"the pairs contradict each other ({error})")


def _one_more(state: State, active: ActiveWindow, layout: Layout, setting: Setting) -> State:
    """:func:`with_pair` where there is a registration; the pair is the state's last shot, an outlier up to now."""
    before, place = state, len(state.shots) - 1
    label = state.shots[-1].label
    places = [state.now.first + i for i, other in enumerate(state.current) if other.label == label]
    if label in state.marginalised:  # a new look at a marginalised PM: all its looks return to the active window
        state = replace(state, marginalised=state.marginalised - {label})
        state = replace(state, older=own_prior(state, state.marginalised, active.state, setting))
        change = Change(prior=total_prior(state, active.state, setting))
        state = settled(state, active, layout, change, setting)
        active = _active_window(state)
    pairs = tuple(replace(state.shots[p].pair, pm=label) for p in places)
    number = free_number(active.groups, len(pairs))
    prepared = prepare(pairs, layout, active.state, state.epoch, setting.model, number)
    same = next((group for group in active.groups if group.label == label), None)
    known = None if same is None else same.prepared.quadratic.at(active.state, layout.columns)
    nis = innovation(prepared, active.covariance, known)
    inliers, count = state.counts()
    fits = nis <= limit_of(len(prepared.rows), inliers + (same is None), count)
    if not fits:
        # The full solve decides which of several looks at a PM is the outlier; until then it is the last one.
        rejected = _split_off(before, place) if any(before.shots[p].inlier for p in places) else before
        return replace(rejected, nis=nis, used=False)
    state = replace(state, nis=nis, used=True)
    shots = list(state.shots)
    for p in places:
        shots[p] = replace(shots[p], inlier=True)
    state = replace(state, shots=tuple(shots))
    change = Change((Group(label, tuple(places), pairs, prepared),), () if same is None else (label,))
    state, change = _marginalised(state, active, change, setting)
    if change.prior is None and tells_of_constants(state.shots[-1].pair):
        change = replace(change, prior=total_prior(state, active.state, setting))
    return settled(state, active, layout, change, setting)


def _split_off(state: State, place: int) -> State:
    """The state in which a look is a PM of its own, an outlier."""
    spare = min(0, *(shot.label for shot in state.shots)) - 1
    shots = list(state.shots)
    shots[place] = replace(shots[place], label=spare, inlier=False)
    return replace(state, shots=tuple(shots))


def _active_window(state: State) -> ActiveWindow:
    if state.active_window is None:
        raise ValueError("there is no registration")
    return state.active_window


def _marginalised(state: State, active: ActiveWindow, change: Change, setting: Setting) -> tuple[State, Change]:
    """Move the oldest PMs to the marginal prior where the active window is full, as part of the given change."""
    stay = [group for group in active.groups if group.label not in change.remove]
    if len(stay) < MOST:
        return state, change
    oldest = frozenset(group.label for group in stay[:LEAVE])
    marginalised = state.marginalised | oldest
    older = own_prior(state, marginalised, active.state, setting)
    state = replace(state, older=older, marginalised=marginalised)
    prior = total_prior(state, active.state, setting)
    return state, replace(change, remove=(*change.remove, *oldest), prior=prior)


def settled(
    state: State, active: ActiveWindow, layout: Layout, change: Change, setting: Setting, limit: float = SETTLED_SIGMA
) -> State:
    """Update the active window until the estimate converges; the marginal prior is linearised again where needed.

    Raises:
        ArithmeticError: an indeterminate system, or a result that is not finite.
        RuntimeError: another failure of GTSAM.
    """
    for _ in range(MOST_UPDATES):
        before = active.state
        active = updated(active, change, layout)
        state, again = _relinearised(state, active.state, setting)
        if not again and sigma_distance(before, active.state, active.covariance, setting.columns) < limit:
            break
        change = Change(prior=total_prior(state, active.state, setting)) if again else Change()
    now = replace(state.now, state=active.state, covariance=active.covariance)
    return replace(state, active_window=active, epochs=(*state.epochs[:-1], now))


def _relinearised(state: State, at: SharedState, setting: Setting) -> tuple[State, bool]:
    """The state with those parts of its marginal prior linearised again whose linearisation point is too far away."""
    again = False
    if state.carried is not None and has_moved(state.carried, at, setting.empty):
        state, again = carried_prior(state, at, setting), True
    if state.older is not None and has_moved(state.older, at, setting.empty):
        state, again = replace(state, older=own_prior(state, state.marginalised, at, setting)), True
    return state, again


def with_aim(state: State, aim: Aim, setting: Setting) -> State:
    """The state with one more calibration shot, which is an inlier where it fits the estimate."""
    active, layout = state.active_window, state.layout
    fits = active is None or aim_fits(aim, active, setting)
    aims, inlier = (*state.aims, aim), (*state.aim_inlier, fits)
    state = replace(state, aims=aims, aim_inlier=inlier, nis=None, used=False)
    if active is None or layout is None or not fits:
        return state
    state = carried_prior(state, active.state, setting)
    change = Change(prior=total_prior(state, active.state, setting))
    return settled(state, active, layout, change, setting)


def with_point(state: State, point: KnownPoint, setting: Setting) -> State:
    """The state with one more known point, which belongs to the current epoch."""
    points = (*state.points, replace(point, epoch=state.epoch))
    state, active, layout = replace(state, points=points, nis=None, used=False), state.active_window, state.layout
    if active is None or layout is None:
        return state
    state = carried_prior(state, active.state, setting)
    return settled(state, active, layout, Change(prior=total_prior(state, active.state, setting)), setting)


def with_move(
    state: State, start: EpochStart, setting: Setting, last: int = 0, points_since: float = math.inf
) -> State:
    """The state with a new epoch, to which the ``last`` pairs, and known points from a time on, belong already.

    With a measured motion the new epoch has a registration at once, from the motion prior between the epochs. Without
    one, and where pairs change their epoch, the epoch has none until it is registered.

    Raises:
        ValueError: they are not all of the current epoch.
    """
    first = len(state.shots) - last
    if not 0 <= last <= state.epoch_pairs:
        raise ValueError(f"the last {last} pairs are not all of the current epoch")
    ended = state.now if state.active_window is not None else replace(state.now, state=None, covariance=None)
    shots = list(state.shots)
    for place in range(first, len(shots)):
        pair = replace(shots[place].as_measured, epoch=state.epoch + 1)
        shots[place] = Shot(pair, pair.look, pair.pm, inlier=False)
    points = [
        replace(point, epoch=state.epoch + 1) if point.epoch == state.epoch and point.t >= points_since else point
        for point in state.points
    ]
    moved = replace(
        state,
        epochs=(*state.epochs[:-1], ended, Epoch(start, first)),
        shots=tuple(shots),
        points=tuple(points),
        active_window=None,
        finished=None,
        carried=None,
        older=None,
        marginalised=frozenset(),
        why_none="the camera has moved: take pairs",
        nis=None,
        used=False,
    )
    return moved if last else with_motion_prior(moved, setting)


def without_move(state: State) -> State:
    """The state without its last camera move: the current epoch's pairs are of the epoch before, not yet registered."""
    first = state.now.first
    shots = [replace(shot, pair=replace(shot.pair, epoch=state.epoch - 1)) for shot in state.shots[first:]]
    return replace(
        state,
        epochs=state.epochs[:-1],
        shots=(*state.shots[:first], *shots),
        points=tuple(replace(point, epoch=min(point.epoch, state.epoch - 1)) for point in state.points),
        active_window=None,
        why_none="",
    )


def with_motion_prior(state: State, setting: Setting) -> State:
    """The state whose current epoch, which has no pairs yet, is registered by the measured motion at its start.

    It is unchanged where there is no such motion, or where the epoch before the motion has no registration, or one that
    the motion does not determine.
    """
    start, layout = state.now.start, state.layout
    old = state.epochs[start.old(state.epoch)] if start.motion_known and state.epoch else None
    if old is None or old.state is None or layout is None:
        return state
    at = carried_over(old.state, start)
    try:
        found = carried_prior(state, at, setting)
        active = open_active_window((), total_prior(found, at, setting), layout, state.epoch)
    except ArithmeticError:  # the move is taken in all the same
        return state
    # The motion leads from each of the old epoch's minima to one of this epoch.
    now = replace(found.now, state=active.state, covariance=active.covariance, is_open=old.is_open)
    return replace(found, active_window=active, epochs=(*found.epochs[:-1], now), why_none="")


def with_motion(state: State, start: EpochStart, setting: Setting) -> State:
    """The state with a motion prior between the current epoch and an earlier one, known only after the epoch's start.

    The motion is not used where the epoch that it is counted from has no registration.
    """
    now = replace(state.now, start=start)
    state = replace(state, epochs=(*state.epochs[:-1], now), finished=None, nis=None, used=False)
    active, layout = state.active_window, state.layout
    if active is None or layout is None:
        return state if state.epoch_pairs else with_motion_prior(state, setting)
    state = carried_prior(state, active.state, setting)
    return settled(state, active, layout, Change(prior=total_prior(state, active.state, setting)), setting)


def finished_prior_at_start(state: State, setting: Setting) -> Quadratic | None:
    """The prior from the earlier epochs, linearised where the current epoch began, whatever its own pairs say.

    None where no earlier epoch is registered.

    Raises:
        ArithmeticError: a number is not finite.
    """
    start, old = state.now.start, state.epochs[state.now.start.old(state.epoch)]
    known = next((epoch.state for epoch in reversed(state.epochs[:-1]) if epoch.state is not None), None)
    if known is None or state.layout is None:
        return None
    if start.motion_known and old.state is not None:
        known = carried_over(old.state, start)
    return finished_prior(replace(state, finished=None), known, setting).finished
