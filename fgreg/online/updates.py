"""What each kind of event makes of a state: one pair more, one aim more, a camera that moved, a fresh registration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fgreg.frames import IntArray
from fgreg.graph.packing import PackedProblem
from fgreg.measurements import Aim, EpochStart, Pair
from fgreg.online.restart import AIMS_IN_CHUNK, ALL_PAIRS, Tools, registered, settled_anew
from fgreg.online.shared import Layout
from fgreg.online.sorting import (
    flipped_while_odd,
    has_junk,
    information,
    is_apart,
    odd_ones,
    one_look_apart,
    toggled,
)
from fgreg.online.state import (
    NEAR_PAIRS,
    NOTHING,
    RECENT,
    SETTLED_FEW,
    SETTLED_MANY,
    SETTLED_NEAR,
    EpochData,
    Recent,
    Setting,
    State,
    again,
    counts,
    innovation,
    limit_of,
    opened,
    passed_from,
    popped,
    refreshed,
    relaxed,
    shelved,
    summary,
    with_common,
    without_label,
)
from fgreg.online.summary import carried_over, chunk_of, make_chunk
from fgreg.online.summary import settled as settled_parts
from fgreg.online.window import Bundle, Change, Group, Window, free_number, open_window, prepare
from fgreg.robust import AIM_LIMIT, innovations_of, limits_among

FIRST_PAIRS = 8
"""Up to so many pairs of an epoch every event starts from a registration of its own, with a search for all minima."""
FEW_PAIRS = 40
"""Up to so many, who counts is settled by a registration whenever a pair deviates, or a PM is in that should be out."""
JUDGED_PAIRS = 80
"""Up to so many, where there is junk, who counts is settled anew near the estimate when a PM is in or out wrongly."""
VISIT, VISIT_EARLIER = 8, 64
"""A chunk is linearised anew and its PMs judged every so many events; one of the earlier epochs."""


# --- one pair more --------------------------------------------------------------------------------------------------


def with_pair(state: State, pair: Pair, tools: Tools) -> State:
    """The state with one pair more."""
    place = state.pairs
    if state.window is None or state.layout is None:
        found = registered(state, tools, pair)
        return replace(found, nis=None, used=is_kept(found, place), recent=())
    try:
        return _one_more(state, state.window, state.layout, pair, tools)
    except ArithmeticError:
        if state.epoch_pairs >= JUDGED_PAIRS:
            raise
    # Among few pairs that contradict each other full steps may lead anywhere: begin anew, with damped ones.
    found = registered(state, tools, pair)
    return replace(found, nis=None, used=is_kept(found, place))


def _one_more(state: State, window: Window, layout: Layout, pair: Pair, tools: Tools) -> State:
    """:func:`with_pair` where there is a registration to begin with."""
    setting, place = tools.setting, state.pairs
    before = window
    earlier = [p for p in tools.store.looks_at(pair.pm, state.now.first) if not is_apart(state, p, pair.pm)]
    bundle = Bundle(
        pair.pm,
        (*earlier, place),
        (*(tools.store.pair(p, state.epoch, pair.pm) for p in earlier), replace(pair, epoch=state.epoch)),
        kept=True,
    )
    # One more than its looks: where one of them turns out to be junk, that one is a PM of its own.
    window = replace(window, numbers=free_number(window.groups, len(bundle.pairs) + 1))
    prepared = prepare(bundle.pairs, layout, window.state, state.epoch, setting.model, window.numbers)
    numbers = window.numbers + len(bundle.pairs)
    same = next((group for group in window.groups if group.label == pair.pm), None)
    if earlier and same is None:
        shelf = without_label(state.now.shelf, pair.pm, window.state, setting.columns)
        state = state.with_now(shelf=shelf)
        window = open_window_again(state, window, setting)
    known = same.prepared.quadratic.at(window.state, layout.columns) if same is not None and same.kept else None
    nis = innovation(prepared, window.covariance, known)
    kept, every = counts(state)
    limit = limit_of(len(prepared.rows), kept + (same is None or not same.kept), every + (same is None))
    fits = nis <= limit
    group = Group(replace(bundle, kept=fits), prepared)
    change = Change(take_in=(group,) if fits else (), set_aside=() if fits else (group,))
    apart = None if fits or not earlier else one_look_apart(state, bundle, layout, window, tools, known)
    if apart is not None:
        group, junk = apart
        numbers += 1
        change = Change(take_in=(group,), set_aside=(junk,))
        fits, prepared = place in group.bundle.places, group.prepared
    state = replace(state, pairs=place + 1)
    recent = Recent(place, prepared.quadratic, before.state, before.covariance, nis, fits)
    if same is not None:
        change = replace(change, forget=(same.label,))
    few, near = state.epoch_pairs <= FEW_PAIRS, state.epoch_pairs <= NEAR_PAIRS
    settled = SETTLED_FEW if few else SETTLED_NEAR if near else SETTLED_MANY
    # Looks that the new one is summed up with do not go onto the shelf beside.
    others = replace(window, groups=tuple(group for group in window.groups if group is not same))
    state, gone = popped(state, others, setting)
    if gone:
        if near:
            state = refreshed(state, window.state, setting)
        # What is shelved leaves the window in the same update in which the summary takes it up.
        change = replace(change, forget=(*change.forget, *gone))
    elif not few:
        state, visited = visited_chunks(state, window, setting)
        gone = (0,) if visited else ()
    if gone:
        change = replace(change, summary=summary(state, window.state, setting))
    window = replace(window, numbers=numbers)
    state, window = relaxed(state, window, change, setting, settled, near=near)
    state = replace(
        state.with_now(state=window.state),
        window=window,
        recent=(*state.recent[-(RECENT - 1) :], recent),
        nis=nis,
        used=fits,
    )
    if few:
        first = pms_in_epoch(state) <= FIRST_PAIRS or state.is_open
        if first or nis > limit or odd_ones(state, setting):
            found = registered(replace(state, pairs=place), tools, pair)
            return replace(found, nis=nis, used=is_kept(found, place), recent=state.recent)
        return _judged_anew(state, pair, tools) if has_junk(state) else state
    if near and has_junk(state):
        if state.epoch_pairs > JUDGED_PAIRS:
            return flipped_while_odd(state, setting)
        return _judged_anew(state, pair, tools) if odd_ones(state, setting) else state
    if state.steps % VISIT == 3:
        state = toggled(state, setting)
    return state


def _judged_anew(state: State, pair: Pair, tools: Tools) -> State:
    """The state with its last pair, after who counts was settled anew by what the batch solve settles it by."""
    found = settled_anew(state, tools, pair)
    if found is None or found.window is None:
        return state
    return replace(found, nis=state.nis, used=is_kept(found, state.pairs - 1), recent=state.recent)


def pms_in_epoch(state: State) -> int:
    """PMs of the epoch that lasts."""
    groups = state.window.groups if state.window is not None else ()
    return len(groups) + state.now.shelf.counts[1]


def open_window_again(state: State, window: Window, setting: Setting) -> Window:
    """The window with a summary from which a PM was taken."""
    change = Change(summary=summary(state, window.state, setting))
    try:
        return relaxed(state, window, change, setting)[1]
    except RuntimeError as error:  # GTSAM's word for a system that is indeterminate
        raise ArithmeticError("without one of its PMs the registration is not determined") from error


def is_kept(state: State, place: int) -> bool:
    """Whether the pair at a place counts: in the window, or among what is summed up last."""
    groups = state.window.groups if state.window is not None else ()
    for group in groups:
        if place in group.bundle.places:
            return group.kept
    chunks = state.now.shelf.chunks
    if not chunks or state.window is None:
        return False
    found = np.flatnonzero(chunks[-1].places == place)
    return bool(len(found) and chunks[-1].kept[chunks[-1].problem.look_pm[found[0]]])


# --- many pairs: who counts, and old linearisation points, a bounded piece at a time --------------------------------


def visited_chunks(state: State, window: Window, setting: Setting) -> tuple[State, bool]:
    """Linearise one chunk anew and judge its PMs, where it is time; whether that was done."""
    columns, shelf = setting.columns, state.now.shelf
    turn = state.steps // VISIT
    if state.steps % VISIT == 0 and shelf.chunks:
        place = turn % len(shelf.chunks)
        chunk = shelf.chunks[place]
        parts = settled_parts(chunk.problem, window.state, chunk.private, rounds=1)
        found = innovations_of(parts.pm, information(window), chunk.kept)
        limits = limits_among(chunk.problem, chunk.kept, *counts(state))
        kept = np.where(np.isfinite(found), found <= limits, chunk.kept)
        new = chunk_of(chunk.places, chunk.problem, kept, window.state, parts)
        if place == len(shelf.full):
            return state.with_now(shelf=replace(shelf, open=new)), True
        return state.with_now(shelf=shelf.with_full(place, new, columns)), True
    if state.steps % VISIT_EARLIER == 2 and state.epoch:
        return _visit_earlier(state, window, setting), True
    if state.steps % VISIT_EARLIER == 6 and state.aim_chunks:
        chunks = list(state.aim_chunks)
        place = (state.steps // VISIT_EARLIER) % len(chunks)
        chunks[place] = again(chunks[place], window.state)
        return replace(state, aim_chunks=tuple(chunks)), True
    return state, False


def _visit_earlier(state: State, window: Window, setting: Setting) -> State:
    """Linearise one chunk of an earlier epoch anew, at that epoch's registration given what is known now."""
    columns = setting.columns
    epochs = list(state.epochs)
    turn = state.steps // VISIT_EARLIER
    known = [k for k, data in enumerate(epochs[:-1]) if data.state is not None and data.shelf.chunks]
    if not known:
        return state
    k = known[turn % len(known)]
    _, eliminated = passed_from(epochs, window.state, columns)
    elimination = eliminated[k]
    if elimination is None:
        return state
    # The chain's own linearisation points have the common variables of now, so later registrations stand still.
    step = np.zeros(columns.size)
    step[:6] = elimination.offset
    here = with_common(elimination.state.retract(step[None], columns), window.state)
    shelf = epochs[k].shelf
    places = len(shelf.full) + (shelf.open is not None)
    place = (turn // len(known)) % places
    if place < len(shelf.full):
        shelf = shelf.with_full(place, again(shelf.full[place], here), columns)
    elif shelf.open is not None:
        shelf = replace(shelf, open=again(shelf.open, here))
    epochs[k] = replace(epochs[k], shelf=shelf, state=here)
    return replace(state, epochs=tuple(epochs), passed=passed_from(epochs, window.state, columns)[0])


# --- aims, moves ----------------------------------------------------------------------------------------------------


def with_aim(state: State, aim: Aim, tools: Tools) -> State:
    """The state with one calibration shot more."""
    window, setting = state.window, tools.setting
    state = replace(state, nis=None, used=False)
    if window is None or state.layout is None:
        return registered(state, tools, aim=aim) if state.pairs else replace(state, aims=state.aims + 1)
    if state.epoch_pairs <= FEW_PAIRS and state.pairs <= ALL_PAIRS:
        return registered(state, tools, aim=aim)
    problem = setting.pack([aim], ())
    parts = settled_parts(problem, window.state)
    alone = np.zeros(1, dtype=bool)
    found = innovations_of(parts.aim, information(window), alone)
    kept = np.array([bool(found[0] <= AIM_LIMIT)])
    chunks = list(state.aim_chunks)
    new = chunk_of(np.array([state.aims]), problem, kept, window.state, parts)
    if chunks and len(chunks[-1].kept) < AIMS_IN_CHUNK:
        last = chunks[-1]
        places = np.concatenate([last.places, new.places])
        every = [*tools.store.aims, aim]
        problem = setting.pack([every[i] for i in places.tolist()], ())
        chunks[-1] = make_chunk(places, problem, np.concatenate([last.kept, kept]), window.state)
    else:
        chunks.append(new)
    state = replace(state, aims=state.aims + 1, aim_chunks=tuple(chunks))
    change = Change(summary=summary(state, window.state, setting))
    state, window = relaxed(state, window, change, setting)
    return replace(state.with_now(state=window.state), window=window)


def with_move(state: State, start: EpochStart, tools: Tools, last: int = 0) -> State:
    """The state with a new epoch, to which the last so many pairs belong already.

    A measured motion ties the new registration to the old, which is then known at once; else it is free.
    """
    setting = tools.setting
    state = replace(state, nis=None, used=False, recent=())
    first = state.pairs - last
    if first < state.now.first:
        raise ValueError(f"the last {last} pairs are not all of the epoch that lasts")
    if last:
        state = _without_last(state, first, tools)
    window = state.window
    state = replace(state, is_open=True, window=None)
    common = window.state if window is not None else None
    if window is not None:
        shelf = shelved(state.now.shelf, [group.bundle for group in window.groups], window.state, setting)
        state = state.with_now(shelf=shelf, state=window.state)
    else:
        common = next((data.state for data in reversed(state.epochs) if data.state is not None), None)
    tied, layout = start.motion_known and window is not None, state.layout
    new = EpochData(start, first)
    state = replace(state, epochs=(*state.epochs, new), why_none="the camera has moved: take pairs")
    if common is None or layout is None:
        return registered(state, tools) if last else state
    there = carried_over(common, start)
    state = replace(state, passed=passed_from(state.epochs, there, setting.columns)[0])
    if last:
        return registered(state, tools)
    if tied:
        window = open_window((), summary(state, there, setting), layout, state.epoch, 0)
        return replace(state.with_now(state=window.state), window=window, why_none="", is_open=False)
    return state


def _without_last(state: State, first: int, tools: Tools) -> State:
    """The state as if the epoch had ended before the pair at ``first``: what came later is taken out of it."""
    window, layout, setting = state.window, state.layout, tools.setting
    if window is None or layout is None:
        return state
    left = {tools.store.number(place) for place in range(state.now.first, first)}
    if len(left) < tools.config.min_pairs and not state.now.start.motion_known:
        # What was known was of both sides of the move, and these are too few to know a registration by themselves.
        return replace(state.with_now(shelf=NOTHING, state=None), window=None)
    columns, shelf = setting.columns, state.now.shelf
    for chunk in state.now.shelf.chunks:
        late = {label for label, places in _places_by_label(chunk.problem, chunk.places) if max(places) >= first}
        for label in late:
            shelf = without_label(shelf, label, window.state, columns)
    groups = tuple(group for group in window.groups if max(group.bundle.places) < first)
    state = state.with_now(shelf=shelf)
    fresh, numbers = [], 0
    for group in groups:
        prepared = prepare(group.bundle.pairs, layout, window.state, state.epoch, setting.model, numbers)
        fresh.append(Group(group.bundle, prepared))
        numbers += len(group.bundle.pairs)
    state, window = opened(state, fresh, window.state, numbers, setting)
    return replace(state.with_now(state=window.state), window=window)


def _places_by_label(problem: PackedProblem, places: IntArray) -> list[tuple[int, list[int]]]:
    out: dict[int, list[int]] = {}
    for pm, place in zip(problem.look_pm.tolist(), places.tolist(), strict=True):
        out.setdefault(problem.pms[pm], []).append(place)
    return list(out.items())
