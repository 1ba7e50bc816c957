"""A state from no guess: the batch registration of the measurements so far, taken over as chunks and a window."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from fgreg.config import SolveConfig
from fgreg.errors import EstimationError
from fgreg.graph.explicit_values import laser_chart
from fgreg.graph.shared_state import SharedState, nominal_frame
from fgreg.measurements import Aim, Measurements, Pair
from fgreg.online.shared import Layout, Quadratic
from fgreg.online.state import (
    STEP,
    WINDOW,
    Setting,
    State,
    kept_by_place,
    opened,
    passed_from,
    shelved,
    sigma_distance,
    summary,
)
from fgreg.online.store import MeasurementStore
from fgreg.online.summary import Chunk, Shelf, make_chunk
from fgreg.online.window import Bundle, Group, open_window, prepare
from fgreg.registration import EpochSearch, Minimum, Registration, register, register_near

ALL_PAIRS = 120
"""Sessions of more pairs are not registered as a whole again: the epoch that lasts, and the last pairs before it."""
EARLIER_PAIRS = 60
LEAST_PMS = 3
"""What an epoch takes to be registered at all."""
AIMS_IN_CHUNK = 64
STAYS_SIGMA = 0.02
"""A window that was opened at an optimum has to come to rest no farther from it."""


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
    pairs = [store.pair(place, k) for k, (first, end) in enumerate(pairwise(firsts)) for place in range(first, end)]
    return Measurements(tuple(store.aims), tuple(pairs), tuple(data.start for data in state.epochs))


# --- a registration from no guess -----------------------------------------------------------------------------------


def registered(state: State, tools: Tools, pair: Pair | None = None, aim: Aim | None = None) -> State:
    """The state from a registration of the measurements so far and one more, which the counts do not hold yet.

    All of them, or where there are many the epoch that lasts and the last pairs before it; what is known of earlier
    epochs then stays as it is.
    """
    taken = _taken(state, tools, pair, aim)
    after = replace(taken.after, window=None, is_open=True)
    try:
        found = register(
            taken.measurements, tools.setting.model, tools.config, tools.setting.sound_speed, _known(state, taken)
        )
    except EstimationError as error:
        return replace(after, why_none=str(error))
    if state.epoch not in found.epochs:
        count = len({p.pm for p in taken.measurements.pairs if p.epoch == state.epoch})
        text = f"{count} pairs are too few for a registration: take at least {tools.config.min_pairs}"
        return replace(after, why_none=text)
    after = replace(after, is_open=state.epoch in found.ambiguous)
    return _from_registration(after, found, taken, tools)


def _known(state: State, taken: _Taken) -> dict[int, EpochSearch]:
    """Earlier epochs that are not registered as a whole again: only the one that lasts is searched for minima."""
    if taken.whole:
        return {}
    # Theirs are all on the shelf; the window, which may hold the new pair already, is of the epoch that lasts.
    kept = kept_by_place(replace(state, window=None, pairs=state.pairs + 1))
    mine: dict[int, list[tuple[int, bool]]] = {}
    for place, pair in zip(taken.places, taken.measurements.pairs, strict=True):
        if pair.epoch != state.epoch:
            mine.setdefault(pair.epoch, []).append((pair.pm, bool(kept[place])))
    out = {}
    for epoch, pairs in mine.items():
        there = state.epochs[epoch].state
        if there is not None and len({pm for pm, _ in pairs}) >= LEAST_PMS:
            out[epoch] = EpochSearch((Minimum(0.0, there),), None, clean=all(counts for _, counts in pairs))
    return out


def settled_anew(state: State, tools: Tools, pair: Pair) -> State | None:
    """:func:`registered` near the present estimate, without a search; None where it leads to nothing.

    ``state`` holds the pair already; it comes back as it is where the same PMs count and the optimum is the same.
    """
    before = replace(state, pairs=state.pairs - 1)
    taken = _taken(before, tools, pair, None)
    epochs = sorted({p.epoch for p in taken.measurements.pairs})
    start = _start(state, epochs)
    if start is None:
        return None
    setting = tools.setting
    try:
        found = register_near(taken.measurements, setting.model, tools.config, start, epochs, setting.sound_speed)
    except EstimationError:
        return None
    if _is_same(state, found, taken, epochs):
        return state
    return _from_registration(replace(taken.after, window=None), found, taken, tools)


def _is_same(state: State, found: Registration, taken: _Taken, epochs: Sequence[int]) -> bool:
    """Whether a registration is what the state is already: the same shots count, and the estimate is the same."""
    window, shots = state.window, found.shots
    if window is None or state.layout is None:
        return False
    solved = np.isin([pair.epoch for pair in taken.measurements.pairs], epochs)
    kept = kept_by_place(state)[list(taken.places)][solved]
    if not np.array_equal(kept, shots.pm_kept[shots.problem.look_pm]):
        return False
    aims = [chunk.kept for chunk in state.aim_chunks]
    if not np.array_equal(np.concatenate(aims) if aims else np.zeros(0, dtype=bool), shots.aim_kept):
        return False
    there = _in_chart(_one_epoch(found.optimum.state, len(epochs) - 1), state.layout)
    return sigma_distance(there, window.state, window.covariance, state.layout.columns) < STAYS_SIGMA


def _start(state: State, epochs: Sequence[int]) -> SharedState | None:
    """The present estimate with the registrations of some epochs; None where one of them has none."""
    if state.window is None:
        return None
    now = state.window.state
    each = [now if k == state.epoch else state.epochs[k].state for k in epochs]
    known = [one for one in each if one is not None]
    if len(known) < len(each):
        return None
    return replace(
        now,
        rotation=np.concatenate([one.rotation for one in known], axis=1),
        translation_mm=np.concatenate([one.translation_mm for one in known], axis=1),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Taken:
    """What a registration is made of.

    Attributes:
        measurements: with the pairs at ``places`` of the session's order.
        whole: whether those are all there are.
        after: the state with their counts.
    """

    measurements: Measurements
    places: tuple[int, ...]
    whole: bool
    after: State


def _taken(state: State, tools: Tools, pair: Pair | None, aim: Aim | None) -> _Taken:
    store, new = tools.store, [] if pair is None else [pair]
    first, pairs = state.now.first, state.pairs
    whole = state.layout is None or pairs <= ALL_PAIRS
    begin = 0 if whole else max(0, first - EARLIER_PAIRS)
    old = [*_tied_to(state, begin), *range(begin, pairs)]
    places = [*old, *range(pairs, pairs + len(new))]
    taken = [store.pair(place, epoch_of(state, place)) for place in old]
    taken += [replace(p, epoch=state.epoch) for p in new]
    aims = (*store.aims, *([] if aim is None else [aim]))
    measurements = Measurements(aims, tuple(taken), tuple(data.start for data in state.epochs))
    after = replace(state, pairs=pairs + len(new), aims=len(aims))
    return _Taken(measurements, tuple(places), whole, after)


def _tied_to(state: State, before: int) -> range:
    """Last pairs of the epoch that the one that lasts is tied to, where they are among those before a place."""
    start = state.now.start
    if start.after is None or not start.motion_known:
        return range(0)
    end = state.epochs[start.after + 1].first
    return range(max(state.epochs[start.after].first, end - EARLIER_PAIRS), end) if end <= before else range(0)


def _from_registration(
    state: State,
    found: Registration,
    taken: _Taken,
    tools: Tools,
) -> State:
    setting, optimum, whole = tools.setting, found.optimum.state, taken.whole
    columns = setting.columns
    if whole or state.layout is None:
        state = replace(state, layout=Layout(columns, optimum.marker_T_nominal[0].copy()))
    else:
        optimum = _in_chart(optimum, state.layout)
    layout = state.layout
    if layout is None:
        raise ValueError("no shared variables")
    bundles = _bundles(found, taken.measurements, taken.places)
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
        aim_chunks=_aim_chunks(taken.measurements.aims, [bool(k) for k in found.shots.aim_kept], here, setting),
        why_none="",
    )
    state = replace(state, passed=passed_from(state.epochs, here, columns)[0])
    groups, numbers = [], 0
    for bundle in mine[recent:]:
        groups.append(Group(bundle, prepare(bundle.pairs, layout, here, state.epoch, setting.model, numbers)))
        numbers += len(bundle.pairs)
    try:
        after, window = opened(state, groups, here, numbers, setting)
        stays = sigma_distance(here, window.state, window.covariance, columns) < STAYS_SIGMA
    except (ArithmeticError, RuntimeError):
        stays = False
    if not stays:
        # Among few pairs that contradict each other, full Gauss-Newton steps lead away from the optimum that damped
        # ones found. The optimum stands: all pairs are summed up at it, and the window starts empty.
        try:
            after = state.with_now(shelf=shelved(Shelf(), mine, here, setting))
            known = _at_rest(found, state.epoch, here) if whole else summary(after, here, setting)
            window = open_window((), known, layout, state.epoch, numbers)
        except RuntimeError:  # GTSAM's word for a system that is indeterminate, as three pairs can leave it
            return replace(state, why_none="these pairs leave the registration undetermined: take more")
    return replace(after.with_now(state=window.state), window=window)


def _at_rest(found: Registration, epoch: int, here: SharedState) -> Quadratic:
    """What a registration says about the shared variables of one of its epochs, at its optimum."""
    place, count = found.epochs.index(epoch), len(found.epochs)
    mine = np.r_[6 * place : 6 * place + 6, 6 * count : len(found.covariance)]
    covariance = found.covariance[np.ix_(mine, mine)]
    scale = 1.0 / np.sqrt(np.diag(covariance))
    information = np.linalg.inv(covariance * np.outer(scale, scale)) * np.outer(scale, scale)
    cost = float(found.optimum.evaluation.cost[0])
    return Quadratic(here, cost, np.zeros(len(mine)), np.asarray(0.5 * (information + information.T)))


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
    taken = [
        (place, pair) for place, pair in zip(places, measurements.pairs, strict=True) if pair.epoch in found.epochs
    ]
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


def _aim_chunks(aims: Sequence[Aim], kept: Sequence[bool], at: SharedState, setting: Setting) -> tuple[Chunk, ...]:
    chunks = []
    for first in range(0, len(aims), AIMS_IN_CHUNK):
        rows = range(first, min(first + AIMS_IN_CHUNK, len(aims)))
        problem = setting.pack([aims[i] for i in rows], ())
        chunks.append(make_chunk(np.array(rows), problem, np.array([kept[i] for i in rows]), at))
    return tuple(chunks)
