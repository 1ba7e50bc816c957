"""What each kind of event makes of a state: one pair more, one aim more, a camera that moved, a fresh registration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.config import SolveConfig
from fgreg.errors import EstimationError
from fgreg.frames import make_transform
from fgreg.graph.explicit_values import laser_chart
from fgreg.graph.packing import PackedProblem
from fgreg.graph.shared_state import SharedState, nominal_frame
from fgreg.measurements import Aim, EpochStart, Measurements, Pair
from fgreg.online.shared import Layout, small_step
from fgreg.online.state import (
    RECENT,
    STEP,
    WINDOW,
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
    relaxed,
    shelved,
    sigma_distance,
    summary,
    with_common,
    without_label,
)
from fgreg.online.store import MeasurementStore
from fgreg.online.summary import Shelf, carried_over, chunk_of, joined, make_chunk, settled
from fgreg.online.window import Bundle, Change, Group, Window, open_window, prepare
from fgreg.registration import Registration, register
from fgreg.robust import AIM_LIMIT, innovations_of, junk_p_of, pm_degrees_of_freedom, pm_limits

FIRST_PAIRS = 8
"""Up to so many pairs of an epoch every event starts from a registration of its own, with a search for all minima."""
FEW_PAIRS = 40
"""Up to so many, who counts is settled by a registration whenever a PM is in that should be out, or the reverse."""
ALL_PAIRS = 120
"""Sessions of more pairs are not registered as a whole again: the epoch that lasts, and the last pairs before it."""
EARLIER_PAIRS = 60
AIMS_IN_CHUNK = 64
VISIT, VISIT_EARLIER = 8, 64
"""A full chunk is linearised anew and its PMs judged every so many events; one of the earlier epochs."""


@dataclass(frozen=True, slots=True, eq=False)
class Tools:
    """What an update works with: the setting, the configuration of registrations, what is stored."""

    setting: Setting
    config: SolveConfig
    store: MeasurementStore


def epoch_of(state: State, place: int) -> int:
    """The epoch of a pair."""
    return max(k for k, data in enumerate(state.epochs) if data.first <= place)


def all_measurements(state: State, store: MeasurementStore) -> Measurements:
    """Everything that came, with the epochs as they are now known."""
    firsts = [data.first for data in state.epochs] + [state.pairs]
    pairs = [
        store.pair(place, k)
        for k, (first, end) in enumerate(zip(firsts[:-1], firsts[1:], strict=True))
        for place in range(first, end)
    ]
    return Measurements(tuple(store.aims), tuple(pairs), tuple(data.start for data in state.epochs))


# --- a registration from no guess -----------------------------------------------------------------------------------


def registered(state: State, tools: Tools, pair: Pair | None = None, aim: Aim | None = None) -> State:
    """The state from a registration of the measurements so far and one more, which the counts do not hold yet.

    All of them, or where there are many the epoch that lasts and the last pairs before it; what is known of earlier
    epochs then stays as it is.
    """
    store, new = tools.store, [] if pair is None else [pair]
    first, pairs = state.now.first, state.pairs
    whole = state.layout is None or pairs <= ALL_PAIRS
    begin = 0 if whole else max(0, first - EARLIER_PAIRS)
    places = [*range(begin, pairs), *range(pairs, pairs + len(new))]
    taken = [store.pair(place, epoch_of(state, place)) for place in range(begin, pairs)]
    taken += [replace(p, epoch=state.epoch) for p in new]
    aims = (*store.aims, *([] if aim is None else [aim]))
    measurements = Measurements(aims, tuple(taken), tuple(data.start for data in state.epochs))
    after = replace(state, pairs=pairs + len(new), aims=len(aims), window=None, is_open=True, odd=frozenset())
    try:
        found = register(measurements, tools.setting.model, tools.config, tools.setting.sound_speed)
    except EstimationError as error:
        return replace(after, why_none=str(error))
    if state.epoch not in found.epochs:
        count = len({p.pm for p in taken if p.epoch == state.epoch})
        text = f"{count} pairs are too few for a registration: take at least {tools.config.min_pairs}"
        return replace(after, why_none=text)
    return _from_registration(after, found, measurements, places, aims, tools, whole=whole)


def _from_registration(
    state: State,
    found: Registration,
    measurements: Measurements,
    places: Sequence[int],
    aims: Sequence[Aim],
    tools: Tools,
    *,
    whole: bool,
) -> State:
    setting, optimum = tools.setting, found.optimum.state
    columns = setting.columns
    if whole or state.layout is None:
        state = replace(state, layout=Layout(columns, optimum.marker_T_nominal[0].copy()))
    else:
        optimum = _in_chart(optimum, state.layout)
    layout = state.layout
    if layout is None:
        raise ValueError("no shared variables")
    bundles = _bundles(found, measurements, places)
    at_epoch = {k: _one_epoch(optimum, found.epochs.index(k)) for k in found.epochs}
    here = at_epoch[state.epoch]
    if whole:
        epochs = []
        for k, data in enumerate(state.epochs):
            if k < state.epoch and k in at_epoch:
                shelf = shelved(Shelf(), bundles[k], at_epoch[k], setting)
                data = replace(data, shelf=shelf, state=at_epoch[k])
            epochs.append(data)
        state = replace(state, epochs=tuple(epochs))
    mine = bundles[state.epoch]
    recent = max(0, len(mine) - (WINDOW - STEP))
    shelf = shelved(Shelf(), mine[:recent], here, setting)
    state = replace(
        state.with_now(shelf=shelf, state=here),
        aim_chunks=_aim_chunks(aims, [bool(k) for k in found.shots.aim_kept], here, setting),
        is_open=state.epoch in found.ambiguous,
        why_none="",
    )
    state = replace(state, passed=passed_from(state.epochs, here, columns)[0])
    groups, numbers = [], 0
    for bundle in mine[recent:]:
        groups.append(Group(bundle, prepare(bundle.pairs, layout, here, state.epoch, setting.model, numbers)))
        numbers += len(bundle.pairs)
    state, window = opened(state, groups, here, numbers, setting)
    state = replace(state.with_now(state=window.state), window=window)
    return replace(state, odd=odd_ones(state, setting))


def _one_epoch(state: SharedState, place: int) -> SharedState:
    """The shared variables with one of the registrations."""
    return replace(
        state,
        rotation=state.rotation[:, place : place + 1].copy(),
        translation_mm=state.translation_mm[:, place : place + 1].copy(),
    )


def _in_chart(state: SharedState, layout: Layout) -> SharedState:
    """The state with its beam in another chart."""
    marker_T_laser = nominal_frame(state.beam_origin()[0], state.beam_direction()[0])
    chart, _ = laser_chart(marker_T_laser, layout.marker_T_nominal)
    return replace(state, beam=chart[None], marker_T_nominal=layout.marker_T_nominal[None])


def _bundles(found: Registration, measurements: Measurements, places: Sequence[int]) -> dict[int, list[Bundle]]:
    """The looks by PM and epoch, with what the registration keeps; looks it split off as junk are PMs of their own."""
    shots = found.shots
    taken = [(place, pair) for place, pair in zip(places, measurements.pairs, strict=True) if pair.epoch in found.epochs]
    looks: dict[tuple[int, int], list[tuple[int, Pair]]] = {}
    kept: dict[int, bool] = {}
    for (place, pair), pm in zip(taken, shots.problem.look_pm.tolist(), strict=True):
        label = shots.problem.pms[pm]
        kept[label] = bool(shots.pm_kept[pm])
        looks.setdefault((pair.epoch, label), []).append((place, pair))
    out: dict[int, list[Bundle]] = {epoch: [] for epoch in found.epochs}
    for (epoch, label), mine in looks.items():
        out[epoch].append(Bundle(label, tuple(p for p, _ in mine), tuple(pair for _, pair in mine), kept[label]))
    return out


def _aim_chunks(aims: Sequence[Aim], kept: Sequence[bool], at: SharedState, setting: Setting) -> tuple:  # type: ignore[type-arg]
    chunks = []
    for first in range(0, len(aims), AIMS_IN_CHUNK):
        rows = range(first, min(first + AIMS_IN_CHUNK, len(aims)))
        problem = setting.pack([aims[i] for i in rows], ())
        chunks.append(make_chunk(np.array(rows), problem, np.array([kept[i] for i in rows]), at)[0])
    return tuple(chunks)


# --- one pair more --------------------------------------------------------------------------------------------------


def with_pair(state: State, pair: Pair, tools: Tools) -> State:
    """The state with one pair more."""
    window, layout, setting = state.window, state.layout, tools.setting
    place = state.pairs
    if window is None or layout is None:
        found = registered(state, tools, pair)
        return replace(found, nis=None, used=_is_kept(found, place), recent=())
    before = window
    earlier = tuple(p for p in tools.store.looks_at(pair.pm) if p >= state.now.first)
    bundle = Bundle(
        pair.pm,
        (*earlier, place),
        (*(tools.store.pair(p, state.epoch, pair.pm) for p in earlier), replace(pair, epoch=state.epoch)),
        kept=True,
    )
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
    limit = limit_of(len(prepared.rows), kept, every)
    fits = nis <= limit
    state = replace(state, pairs=place + 1)
    recent = Recent(place, prepared.quadratic, before.state, before.covariance, nis, fits)
    forget = () if same is None else (same.label,)
    group = Group(replace(bundle, kept=fits), prepared)
    change = Change(take_in=(group,) if fits else (), set_aside=() if fits else (group,), forget=forget)
    few = state.epoch_pairs <= FEW_PAIRS
    state, gone = popped(state, window, setting)
    if gone:
        # What is shelved leaves the window in the same update in which the summary takes it up.
        change = replace(change, forget=(*change.forget, *gone))
    elif not few:
        state, visited = visited_chunks(state, window, setting)
        gone = (0,) if visited else ()
    if gone:
        change = replace(change, summary=summary(state, window.state, setting))
    window = replace(window, numbers=numbers)
    state, window = relaxed(state, window, change, setting, refresh=few)
    state = replace(
        state.with_now(state=window.state),
        window=window,
        recent=(*state.recent[-(RECENT - 1) :], recent),
        nis=nis,
        used=fits,
    )
    if few:
        odd = odd_ones(state, setting)
        if state.epoch_pairs <= FIRST_PAIRS or state.is_open or not odd <= state.odd:
            found = registered(replace(state, pairs=place), tools, pair)
            return replace(found, nis=nis, used=_is_kept(found, place), recent=state.recent)
        return replace(state, odd=odd)
    if state.steps % VISIT == 3:
        state = _toggled(state, setting)
    return state


def open_window_again(state: State, window: Window, setting: Setting) -> Window:
    """The window with a summary from which a PM was taken."""
    return relaxed(state, window, Change(summary=summary(state, window.state, setting)), setting, refresh=False)[1]


def _is_kept(state: State, place: int) -> bool:
    """Whether the pair at a place counts; only the window is looked at, where the last pairs are."""
    groups = state.window.groups if state.window is not None else ()
    return any(group.kept and place in group.bundle.places for group in groups)


def odd_ones(state: State, setting: Setting) -> frozenset[int]:
    """Labels of the epoch's PMs that count though they deviate, or do not though they fit."""
    window = state.window
    if window is None:
        return frozenset()
    problem: PackedProblem | None = None
    kept: list[bool] = []
    for chunk in state.now.shelf.chunks:
        problem = chunk.problem if problem is None else joined(problem, chunk.problem)
        kept.extend(chunk.kept.tolist())
    pairs = [replace(pair, pm=g.label, epoch=0) for g in window.groups for pair in g.bundle.pairs]
    if pairs:
        mine = setting.pack((), pairs)
        problem = mine if problem is None else joined(problem, mine)
        kept.extend(group.kept for group in window.groups)
    if problem is None:
        return frozenset()
    counted = np.array(kept)
    parts = settled(problem, window.state)
    found = innovations_of(parts.pm, np.linalg.inv(window.covariance), counted)
    limits = pm_limits(problem, junk_p_of(*counts(state)))
    known = np.isfinite(found)
    odd = known & (counted == (found > limits))
    return frozenset(label for label, is_odd in zip(problem.pms, odd, strict=True) if is_odd)


# --- many pairs: who counts, and old linearisation points, a bounded piece at a time --------------------------------


def visited_chunks(state: State, window: Window, setting: Setting) -> tuple[State, bool]:
    """Linearise one full chunk anew and judge its PMs, where it is time; whether that was done."""
    columns, shelf = setting.columns, state.now.shelf
    turn = state.steps // VISIT
    if state.steps % VISIT == 0 and shelf.full:
        place = turn % len(shelf.full)
        chunk = shelf.full[place]
        parts = settled(chunk.problem, window.state, chunk.private)
        found = innovations_of(parts.pm, np.linalg.inv(window.covariance), chunk.kept)
        limits = pm_limits(chunk.problem, junk_p_of(*counts(state)))
        kept = np.where(np.isfinite(found), found <= limits, chunk.kept)
        new = chunk_of(chunk.places, chunk.problem, kept, window.state, parts)
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


def _toggled(state: State, setting: Setting) -> State:
    """The window's pairs judged anew: at most one that deviates goes out, at most one that fits comes in."""
    window, layout = state.window, state.layout
    if window is None or layout is None or not window.groups:
        return state
    found = _window_innovations(window.groups, window, setting)
    kept, every = counts(state)
    out, back = None, None
    for group, value in zip(window.groups, found, strict=True):
        fits = value <= limit_of(len(group.prepared.rows), kept, every)
        if group.kept and not fits and out is None:
            out = group
        if not group.kept and fits and back is None:
            back = group
    if out is None and back is None:
        return state
    taken: tuple[Group, ...] = ()
    numbers = window.numbers
    if back is not None:
        fresh = prepare(back.bundle.pairs, layout, window.state, state.epoch, setting.model, numbers)
        numbers += len(back.bundle.pairs)
        taken = (Group(replace(back.bundle, kept=True), fresh),)
    change = Change(take_in=taken, leave_out=() if out is None else (out.label,))
    state, window = relaxed(state, replace(window, numbers=numbers), change, setting, refresh=False)
    return replace(state.with_now(state=window.state), window=window)


def _window_innovations(groups: Sequence[Group], window: Window, setting: Setting) -> list[float]:
    """Innovations of the window's PMs by their rows; a PM that counts is predicted without itself, in closed form."""
    out = []
    root = np.linalg.cholesky(window.covariance)
    for group in groups:
        prepared = group.prepared
        if prepared.far:
            out.append(prepared.quadratic.cost)
            continue
        step = small_step(prepared.state, window.state, setting.columns)
        residual = prepared.residual + prepared.rows @ step
        seen = prepared.rows @ root
        # |r|^2 + g' (H -+ A)^-1 g with A = rows' rows, g = rows' r, written in the few rows (Woodbury).
        spread = np.eye(len(seen)) + (-1.0 if group.kept else 1.0) * (seen @ seen.T)
        out.append(float(residual @ np.linalg.solve(spread, residual)))
    return out


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
    parts = settled(problem, window.state)
    alone = np.zeros(1, dtype=bool)
    found = innovations_of(parts.aim, np.linalg.inv(window.covariance), alone)
    kept = np.array([bool(found[0] <= AIM_LIMIT)])
    chunks = list(state.aim_chunks)
    new = chunk_of(np.array([state.aims]), problem, kept, window.state, parts)
    if chunks and len(chunks[-1].kept) < AIMS_IN_CHUNK:
        last = chunks[-1]
        places = np.concatenate([last.places, new.places])
        every = [*tools.store.aims, aim]
        problem = setting.pack([every[i] for i in places.tolist()], ())
        chunks[-1] = make_chunk(places, problem, np.concatenate([last.kept, kept]), window.state)[0]
    else:
        chunks.append(new)
    state = replace(state, aims=state.aims + 1, aim_chunks=tuple(chunks))
    change = Change(summary=summary(state, window.state, setting))
    state, window = relaxed(state, window, change, setting, refresh=False)
    return replace(state.with_now(state=window.state), window=window)


def with_move(state: State, start: EpochStart, tools: Tools, last: int = 0) -> State:
    """The state with a new epoch, to which the last so many pairs belong already.

    A measured motion ties the new registration to the old, which is then known at once; else it is free.
    """
    setting = tools.setting
    state = replace(state, nis=None, used=False, recent=(), odd=frozenset())
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
    tied = start.motion_known and window is not None
    new = EpochData(start, first)
    state = replace(state, epochs=(*state.epochs, new), why_none="the camera has moved: take pairs")
    if common is None or state.layout is None:
        return registered(state, tools) if last else state
    there = carried_over(common, start)
    state = replace(state, passed=passed_from(state.epochs, there, setting.columns)[0])
    if last:
        return registered(state, tools)
    if tied:
        window = open_window((), summary(state, there, setting), state.layout, state.epoch, 0)
        if sigma_distance(there, window.state, window.covariance, setting.columns) > 0.0:
            state = replace(state, passed=passed_from(state.epochs, window.state, setting.columns)[0])
        return replace(state.with_now(state=window.state), window=window, why_none="", is_open=False)
    return state


def _without_last(state: State, first: int, tools: Tools) -> State:
    """The state as if the epoch had ended before the pair at ``first``: what came later is taken out of it."""
    window, layout, setting = state.window, state.layout, tools.setting
    if window is None or layout is None:
        return state
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


def _places_by_label(problem: PackedProblem, places: np.ndarray) -> list[tuple[int, list[int]]]:  # type: ignore[type-arg]
    out: dict[int, list[int]] = {}
    for pm, place in zip(problem.look_pm.tolist(), places.tolist(), strict=True):
        out.setdefault(problem.pms[pm], []).append(place)
    return list(out.items())


def equations(problem: PackedProblem) -> int:
    """Equations that a chunk's shots leave over."""
    return int(pm_degrees_of_freedom(problem).sum()) + 2 * len(problem.aims.rotation)
