"""Who counts among the PMs of the epoch that lasts: judged by innovation, in the window and on the shelf alike."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import replace

import numpy as np

from fgreg.frames import FloatArray
from fgreg.graph.packing import PackedProblem
from fgreg.online.restart import Tools
from fgreg.online.shared import Layout, Quadratic, small_step
from fgreg.online.state import (
    Setting,
    State,
    counts,
    innovation,
    limit_of,
    relaxed,
    summary,
)
from fgreg.online.summary import joined, make_chunk
from fgreg.online.summary import settled as settled_parts
from fgreg.online.window import Bundle, Change, Group, Window, free_number, prepare
from fgreg.robust import innovations_of, limits_among

JUNK_PMS = 2
"""There is junk where so many PMs of the epoch do not count: one of a thousand good ones does not, either."""
MOST_FLIPS, FLIP_ROUNDS = 4, 4


def has_junk(state: State) -> bool:
    """Whether some PMs of the epoch that lasts do not count."""
    groups = state.window.groups if state.window is not None else ()
    out = sum(not group.kept for group in groups) + sum(len(c.kept) - c.count for c in state.now.shelf.chunks)
    return out >= JUNK_PMS


def information(window: Window) -> FloatArray:
    return np.asarray(np.linalg.inv(window.covariance), dtype=np.float64)


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
    parts = settled_parts(problem, window.state)
    found = innovations_of(parts.pm, information(window), counted)
    limits = limits_among(problem, counted, *counts(state))
    known = np.isfinite(found)
    odd = known & (counted == (found > limits))
    return frozenset(label for label, is_odd in zip(problem.pms, odd, strict=True) if is_odd)


def toggled(state: State, setting: Setting) -> State:
    """The window's pairs judged anew: at most one that deviates goes out, at most one that fits comes in."""
    window = state.window
    if window is None or not window.groups:
        return state
    found = _window_innovations(window.groups, window, setting)
    kept, every = counts(state)
    out, back = None, None
    for group, value in zip(window.groups, found, strict=True):
        fits = value <= limit_of(len(group.prepared.rows), kept + (not group.kept), every)
        if group.kept and not fits and out is None:
            out = group
        if not group.kept and fits and back is None:
            back = group
    labels = {group.label for group in (out, back) if group is not None}
    return _flipped(state, window, labels, setting) if labels else state


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


def flipped_while_odd(state: State, setting: Setting) -> State:
    """The epoch's PMs judged anew, those that deviate out and those that fit in, until none is odd.

    A few at a time, and at last only in: one that is in when out, and out when in, counts, as in fgreg.robust.
    """
    for turn in range(FLIP_ROUNDS):
        window = state.window
        odd = odd_ones(state, setting)
        if turn >= FLIP_ROUNDS // 2:
            odd -= _counting(state)
        if window is None or not odd:
            break
        state = _flipped(state, window, set(sorted(odd)[:MOST_FLIPS]), setting, near=True)
    return state


def _counting(state: State) -> frozenset[int]:
    """Labels of the epoch's PMs that count."""
    groups = state.window.groups if state.window is not None else ()
    found = {group.label for group in groups if group.kept}
    for chunk in state.now.shelf.chunks:
        found.update(label for label, kept in zip(chunk.problem.pms, chunk.kept.tolist(), strict=True) if kept)
    return frozenset(found)


def _flipped(state: State, window: Window, labels: Set[int], setting: Setting, *, near: bool = False) -> State:
    """The state in which those of some PMs of the epoch that count no longer do, and the others do."""
    layout, columns = state.layout, setting.columns
    if layout is None:
        raise ValueError("no shared variables yet")
    shelf, changed = state.now.shelf, False
    for place, chunk in enumerate(shelf.chunks):
        mine = np.isin(chunk.problem.pms, list(labels))
        if mine.any():
            new = make_chunk(chunk.places, chunk.problem, chunk.kept ^ mine, window.state, chunk.private, rounds=1)
            full = place < len(shelf.full)
            shelf = shelf.with_full(place, new, columns) if full else replace(shelf, open=new)
            changed = True
    state = state.with_now(shelf=shelf)
    taken: list[Group] = []
    coming = sum(len(group.bundle.pairs) for group in window.groups if group.label in labels and not group.kept)
    numbers = free_number(window.groups, coming)
    for group in window.groups:
        if group.label in labels and not group.kept:
            fresh = prepare(group.bundle.pairs, layout, window.state, state.epoch, setting.model, numbers)
            numbers += len(group.bundle.pairs)
            taken.append(Group(replace(group.bundle, kept=True), fresh))
    change = Change(
        take_in=tuple(taken),
        leave_out=tuple(group.label for group in window.groups if group.label in labels and group.kept),
        summary=summary(state, window.state, setting) if changed else None,
    )
    state, window = relaxed(state, replace(window, numbers=numbers), change, setting, near=near)
    return replace(state.with_now(state=window.state), window=window)


def is_apart(state: State, place: int, label: int) -> bool:
    """Whether a look at a PM was split off from it as junk."""
    for group in state.window.groups if state.window is not None else ():
        if place in group.bundle.places:
            return group.label != label
    for chunk in state.now.shelf.chunks:
        found = np.flatnonzero(chunk.places == place)
        if len(found):
            return bool(chunk.problem.pms[chunk.problem.look_pm[found[0]]] != label)
    return False


def one_look_apart(
    state: State, bundle: Bundle, layout: Layout, window: Window, tools: Tools, known: Quadratic | None
) -> tuple[Group, Group] | None:
    """Looks at a PM that do not fit together, without the one that is junk, and that one as a PM of its own.

    Only where leaving out one look, and no other one, makes the rest fit, as in the batch solve; None else.
    """
    kept, every = counts(state)
    first, model = window.numbers, tools.setting.model
    fitting: list[tuple[int, Group]] = []
    for left in range(len(bundle.pairs)):
        rest = Bundle(
            bundle.label,
            bundle.places[:left] + bundle.places[left + 1 :],
            bundle.pairs[:left] + bundle.pairs[left + 1 :],
            kept=True,
        )
        prepared = prepare(rest.pairs, layout, window.state, state.epoch, model, first)
        limit = limit_of(len(prepared.rows), kept + (known is None), every)
        if innovation(prepared, window.covariance, known) <= limit:
            fitting.append((left, Group(rest, prepared)))
    if len(fitting) != 1:
        return None
    left, group = fitting[0]
    first += len(bundle.pairs)
    labels = [0, *(g.label for g in window.groups), *(min(c.problem.pms) for c in state.now.shelf.chunks)]
    alone = Bundle(min(labels) - 1, (bundle.places[left],), (bundle.pairs[left],), kept=False)
    return group, Group(alone, prepare(alone.pairs, layout, window.state, state.epoch, model, first))
