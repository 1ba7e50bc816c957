"""Start the incremental estimate from a registration of all measurements: its optimum and its inliers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.graph.scaled_inverse import inverse_hessian
from fgreg.graph.shared_state import Quadratic, SharedState, one_epoch
from fgreg.model.measurements import Look, Measurements
from fgreg.registration.register import Registration, labels_and_inliers
from fgreg.smoother.innovation import sigma_distance
from fgreg.smoother.isam_window import ActiveWindow, Change, Group, free_number, open_active_window, prepare
from fgreg.smoother.shared_variables import Layout
from fgreg.smoother.state import Epoch, Setting, Shot, State, carried_prior, looks_by_pm, own_prior, total_prior
from fgreg.smoother.updates import LEAVE, MOST, settled, with_aim, with_pair

SAME_SIGMA = 0.02
"""Largest distance of two estimates, in their standard deviations, that count as the same."""
UNDETERMINED = "these pairs leave the registration undetermined: take more"


@dataclass(frozen=True, slots=True, eq=False)
class Initial:
    """Result of a registration of all measurements up to an event, or of the current epoch's.

    Attributes:
        epochs: numbers of the solved ones.
        state: their registrations with the common variables (one hypothesis); covariance: (D, D).
        first: place of the first pair in the session's order; not 0 where earlier epochs were a prior, and stay.
        looks: of the pairs from there on, in the position that was taken.
        labels, inlier: of the same pairs, as of :class:`fgreg.smoother.state.Shot`. aim_inlier: of all aims.
        ambiguous: epochs that are: two minima fit equally well.
        fits: whether every PM is an inlier within its limit.
    """

    epochs: tuple[int, ...]
    state: SharedState
    covariance: FloatArray
    first: int
    looks: tuple[Look, ...]
    labels: tuple[int, ...]
    inlier: tuple[bool, ...]
    aim_inlier: tuple[bool, ...]
    ambiguous: tuple[int, ...]
    fits: bool


def initial_of(found: Registration, measurements: Measurements, first: int = 0) -> Initial:
    """The part of a registration that the incremental estimate needs.

    ``measurements``: what was registered. ``first``: place of their first pair.
    """
    shots = found.shots
    labels, inlier = labels_and_inliers(found, measurements)
    return Initial(
        found.epochs,
        found.optimum.state,
        found.covariance,
        first,
        found.looks_of(measurements),
        labels,
        inlier,
        tuple(bool(kept) for kept in shots.aim_inlier),
        found.ambiguous,
        bool(shots.pm_inlier.all() and not shots.pm_beyond_limit.any()),
    )


def initialised(state: State, found: Initial, setting: Setting) -> State:
    """The state with a registration of its measurements taken over; later shots are added to it.

    The state is unchanged where inliers and estimate are the same.
    """
    count, aims = found.first + len(found.labels), len(found.aim_inlier)
    if count == len(state.shots) and aims == len(state.aims) and _is_same(state, found, setting):
        epochs = enumerate(state.epochs)
        return replace(state, epochs=tuple(replace(e, is_open=_is_open(k, e, found)) for k, e in epochs))
    later, later_aims = state.shots[count:], state.aims[aims:]
    nis = state.nis
    state = _taken_over(replace(state, shots=state.shots[:count], aims=state.aims[:aims]), found, setting)
    for aim in later_aims:
        state = with_aim(state, aim, setting)
    for shot in later:
        state = with_pair(state, shot.as_measured, setting)
    used = bool(state.shots) and state.shots[-1].inlier and nis is not None
    return replace(state, nis=nis, used=used)


def _is_same(state: State, found: Initial, setting: Setting) -> bool:
    active, layout = state.active_window, state.layout
    if active is None or layout is None or state.epoch not in found.epochs:
        return False
    mine = tuple((shot.label, shot.inlier, _place(shot.pair.look)) for shot in state.shots[found.first :])
    places = map(_place, found.looks)
    if mine != tuple(zip(found.labels, found.inlier, places, strict=True)) or state.aim_inlier != found.aim_inlier:
        return False
    there = _here(found, state)
    there = layout.in_chart(there)
    return sigma_distance(there, active.state, active.covariance, setting.columns) < SAME_SIGMA


def _place(look: Look) -> tuple[float, float]:
    return look.x_mm, look.range_mm


def _is_open(k: int, epoch: Epoch, found: Initial) -> bool:
    """Whether an epoch is ambiguous after a registration: unchanged where it was not solved but a prior."""
    return k in found.ambiguous if k in found.epochs or not found.first else epoch.is_open


def _here(found: Initial, state: State) -> SharedState:
    """The registration of the current epoch."""
    return one_epoch(found.state, found.epochs.index(state.epoch))


def _taken_over(state: State, found: Initial, setting: Setting) -> State:
    """The state at a registration of exactly its measurements."""
    layout = Layout(setting.columns, found.state.marker_T_nominal[0].copy())
    solved = tuple(
        Shot(replace(shot.pair, look=look), shot.measured, label, inlier)
        for shot, look, label, inlier in zip(
            state.shots[found.first :], found.looks, found.labels, found.inlier, strict=True
        )
    )
    epochs = list(state.epochs)
    common = slice(6 * len(found.epochs), None)
    for k, epoch in enumerate(epochs):
        if k not in found.epochs:
            if not found.first or k == state.epoch:
                epochs[k] = replace(epoch, state=None, covariance=None, is_open=False)
            continue
        place = found.epochs.index(k)
        columns = np.r_[6 * place : 6 * place + 6, np.arange(len(found.covariance))[common]]
        covariance = found.covariance[np.ix_(columns, columns)]
        is_open = _is_open(k, epoch, found)
        epochs[k] = replace(epoch, state=one_epoch(found.state, place), covariance=covariance, is_open=is_open)
    state = replace(
        state,
        epochs=tuple(epochs),
        aim_inlier=found.aim_inlier,
        shots=state.shots[: found.first] + solved,
        layout=layout,
        active_window=None,
        finished=state.finished if found.first else None,
        why_none="",
    )
    if state.epoch not in found.epochs:
        return replace(state, why_none="its pairs do not determine it: take more pairs")
    here = _here(found, state)
    state = carried_prior(state, here, setting)
    looks = looks_by_pm([shot for shot in state.current if shot.inlier])
    labels = [label for _, label in looks]
    recent = labels if len(labels) < MOST else labels[-LEAVE:]
    try:
        opened = _opened(state, recent, here, layout, setting)
        stays = (
            opened.active_window is not None
            and sigma_distance(here, opened.active_window.state, opened.active_window.covariance, setting.columns)
            < SAME_SIGMA
        )
    except (ArithmeticError, RuntimeError):
        stays = False
    if stays:
        return opened
    # Among few pairs that contradict each other full Gauss-Newton steps diverge from the optimum that damped steps
    # found. The optimum is used: all pairs are marginalised there, and the active window starts empty.
    older = frozenset(shot.label for shot in state.current if shot.inlier)
    carried, covariance = state.carried, state.now.covariance
    assert carried is not None
    assert covariance is not None
    information = inverse_hessian(covariance)
    if information is None:
        return replace(state, why_none=UNDETERMINED)
    rest = Quadratic(here, 0.0, -carried.gradient, information - carried.hessian)
    state = replace(state, marginalised=older, older=rest)
    try:
        return _with_active_window(
            state, open_active_window((), total_prior(state, here, setting), layout, state.epoch)
        )
    except ArithmeticError:  # possible with three pairs
        return replace(state, why_none=UNDETERMINED)


def _with_active_window(state: State, active: ActiveWindow) -> State:
    now = replace(state.now, state=active.state, covariance=active.covariance)
    return replace(state, active_window=active, epochs=(*state.epochs[:-1], now))


def _opened(state: State, recent: list[int], here: SharedState, layout: Layout, setting: Setting) -> State:
    """The state with an active window of the ``recent`` PMs; all other inliers are marginalised."""
    looks = looks_by_pm(state.current, state.now.first)
    inliers = {shot.label for shot in state.current if shot.inlier}
    older = frozenset(inliers - set(recent))
    state = replace(state, marginalised=older, older=own_prior(state, older, here, setting))
    groups: list[Group] = []
    for label in recent:
        places = tuple(looks[state.epoch, label])
        pairs = tuple(replace(state.shots[place].pair, pm=label) for place in places)
        number = free_number(groups, len(pairs))
        prepared = prepare(pairs, layout, here, state.epoch, setting.model, number)
        groups.append(Group(label, places, pairs, prepared))
    active = open_active_window(groups, total_prior(state, here, setting), layout, state.epoch)
    return settled(state, active, layout, Change(), setting)
