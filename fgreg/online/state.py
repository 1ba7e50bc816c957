"""The engine's state as a value, and how one pair more, or a fresh registration, makes the next one of it.

Nothing here changes a state: an update that fails on its way leaves the one before as it was.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg.lapack import dposv
from scipy.special import chdtri

from fgreg.config import SolveConfig
from fgreg.frames import BoolArray, FloatArray
from fgreg.graph.columns import Columns
from fgreg.graph.explicit import Variable
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced_blocks import PrivateState, initial_private
from fgreg.graph.shared_state import SharedState
from fgreg.measurements import Aim, EpochStart, Measurements, Pair
from fgreg.models import SessionModel
from fgreg.online.shared import Layout, Quadratic, small_step
from fgreg.online.summary import (
    CHUNK,
    Chunk,
    Elimination,
    Shelf,
    carried_over,
    joined,
    joined_private,
    make_chunk,
    passed_on,
    summed,
    with_more,
    without_pms,
    without_priors,
)
from fgreg.online.window import Bundle, Change, Group, Prepared, Window, open_window, updated
from fgreg.registration import SoundSpeedPrior, pack_session
from fgreg.robust import junk_p_of

NOTHING = Shelf()
WINDOW, STEP = 17, 9
"""Most groups in the window, and how many of the oldest go into the summary at once when one more comes. No multiple of
the events between other work (fgreg.online.updates), which would always have to stand back at the same places."""
NEAR_PAIRS = 160
"""Up to so many pairs of an epoch, its chunks and the aims are linearised anew whenever the estimate moves much or more
pairs join them, and where there is junk all PMs are judged after every pair."""
RECENT = 24
"""How many pairs' quadratics are kept for tests on the last ones."""
MOST_UPDATES = 8
SETTLED_FEW, SETTLED_NEAR, SETTLED_MANY = 0.05, 0.4, 0.3
"""Updates are repeated until the estimate moves by less, in its own standard deviations. What then is left is of second
order, and falls with the number of pairs: with few, chunks are linearised anew on the way."""


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """What does not change: the session's set-up, the configuration, what is known of the sound speed.

    ``empty``: a problem of no shots, for its columns and priors.
    """

    model: SessionModel
    config: SolveConfig
    sound_speed: SoundSpeedPrior | None
    empty: PackedProblem

    @property
    def columns(self) -> Columns:
        """Of the shared variables of one epoch."""
        return self.empty.columns

    def pack(self, aims: Sequence[Aim], pairs: Sequence[Pair]) -> PackedProblem:
        """Shots of one epoch as arrays, without priors, and with the windows as Gaussians."""
        one = Measurements(tuple(aims), tuple(pairs), (EpochStart(0.0),))
        return without_priors(pack_session(one, self.model, self.config, self.sound_speed))


def make_setting(model: SessionModel, config: SolveConfig, sound_speed: SoundSpeedPrior | None) -> Setting:
    """The setting of a session.

    Raises:
        ValueError: the configuration makes the probe's radius a variable, which the graph's factors do not know.
    """
    if config.estimate_radius:
        raise ValueError("estimate_radius is set; online registration holds the probe's radius as the session gives it")
    gaussian = replace(config, window_shape=False)
    empty = pack_session(Measurements((), (), (EpochStart(0.0),)), model, gaussian, sound_speed)
    return Setting(model, gaussian, sound_speed, empty)


@dataclass(frozen=True, slots=True, eq=False)
class Recent:
    """One of the last pairs: what it says, and what was known of the shared variables before it.

    Attributes:
        place: of the pair in the session's order.
        quadratic: of its PM on the shared variables, about its own state.
        state, covariance: the Gaussian of the shared variables before the pair was added.
        nis, used: as in the estimate.
    """

    place: int
    quadratic: Quadratic
    state: SharedState
    covariance: FloatArray
    nis: float
    used: bool


@dataclass(frozen=True, slots=True, eq=False)
class EpochData:
    """One camera epoch.

    Attributes:
        start: with the measured motion, where there is one.
        first: place of its first pair in the session's order.
        shelf: what is summed up of it.
        state: shared variables when last looked at; None where it was never registered.
    """

    start: EpochStart
    first: int
    shelf: Shelf = NOTHING
    state: SharedState | None = None


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """All that the incremental estimate is.

    Attributes:
        epochs: the last one lasts.
        pairs, aims: how many came so far.
        layout: None until a first registration.
        aim_chunks: calibration shots.
        passed: what the epochs before say about this one's shared variables.
        window: None where the epoch has no registration (yet).
        why_none: the reason, then.
        is_open: two minima cannot be told apart.
        recent: oldest first.
        steps: events since the start, which the spreading of work goes by.
        nis, used: of the last event, where it was a pair.
        effort: since the last rest (fgreg.online.rest).
    """

    epochs: tuple[EpochData, ...]
    pairs: int = 0
    aims: int = 0
    layout: Layout | None = None
    aim_chunks: tuple[Chunk, ...] = ()
    passed: Quadratic | None = None
    window: Window | None = None
    why_none: str = ""
    is_open: bool = False
    recent: tuple[Recent, ...] = ()
    steps: int = 0
    nis: float | None = None
    used: bool = False
    effort: int = 0

    @property
    def epoch(self) -> int:
        """Index of the epoch that lasts."""
        return len(self.epochs) - 1

    @property
    def now(self) -> EpochData:
        """The epoch that lasts."""
        return self.epochs[-1]

    @property
    def epoch_pairs(self) -> int:
        """Pairs taken in the epoch that lasts."""
        return self.pairs - self.now.first

    def with_now(self, **changes: object) -> State:
        """With other values in the epoch that lasts."""
        return replace(self, epochs=(*self.epochs[:-1], replace(self.now, **changes)))  # type: ignore[arg-type]


# --- what is known beside the window --------------------------------------------------------------------------------


def summary(state: State, at: SharedState, setting: Setting) -> Quadratic:
    """Everything but the window's pairs: priors, aims, earlier epochs, older pairs; about a state."""
    columns = setting.columns
    found = state.now.shelf.about(at, columns).plus(_priors(at, setting))
    others = [chunk.quadratic for chunk in state.aim_chunks]
    if state.passed is not None:
        others.append(state.passed)
    return found.plus(summed(others, at, columns))


def _priors(at: SharedState, setting: Setting) -> Quadratic:
    problem = setting.empty
    columns, information = problem.columns, problem.prior_information
    deviation = np.zeros(columns.size)
    deviation[columns.edge] = at.edge_rad[0]
    if columns.bias is not None:
        deviation[columns.bias : columns.bias + 3] = at.bias_mm[0]
    if columns.sound_speed is not None:
        deviation[columns.sound_speed] = at.sound_speed_ratio[0] - problem.sound_speed_mean
    pull = information * deviation
    return Quadratic(at, float(pull @ deviation), pull, np.diag(information))


def passed_from(
    epochs: Sequence[EpochData], common: SharedState, columns: Columns
) -> tuple[Quadratic | None, tuple[Elimination | None, ...]]:
    """What all epochs but the last say about the last one's shared variables; ``common`` is its state.

    Also each epoch's registration given what follows.
    """
    last = len(epochs) - 1
    passed: dict[int, Quadratic] = {}
    eliminated: list[Elimination | None] = []
    # Each passes on what it knows to the last one that its registration is tied to, or to the next.
    tied = {data.start.old(k): k for k, data in enumerate(epochs) if k and data.start.motion_known}
    for k, data in enumerate(epochs[:-1]):
        told = passed.get(k)
        if data.state is None:  # what was passed on to it speaks of the common variables alone
            if told is not None:
                _pass(passed, k + 1, told, columns)
            eliminated.append(None)
            continue
        to = tied.get(k, k + 1)
        start = epochs[to].start if k in tied else EpochStart(epochs[to].start.t)
        here, state = with_common(data.state, common), epochs[to].state
        known = data.shelf.about(here, columns)
        if told is not None:
            known = known.plus(told.at(here, columns))
        there = common if to == last else with_common(state, common) if state else carried_over(here, start)
        more, elimination = passed_on(known, start, there, columns)
        _pass(passed, to, more, columns)
        eliminated.append(elimination)
    return passed.get(last), tuple(eliminated)


def _pass(passed: dict[int, Quadratic], to: int, more: Quadratic, columns: Columns) -> None:
    passed[to] = more if to not in passed else passed[to].at(more.state, columns).plus(more)


def with_common(state: SharedState, common: SharedState) -> SharedState:
    """Another epoch's registration with the common variables of ``common``."""
    return replace(common, rotation=state.rotation, translation_mm=state.translation_mm)


def sigma_distance(first: SharedState, second: SharedState, covariance: FloatArray, columns: Columns) -> float:
    """Mahalanobis distance of two states near each other."""
    scale = np.sqrt(covariance.diagonal())
    step = small_step(first, second, columns) / scale
    correlation = covariance / scale / scale[:, None]
    _, along, failed = dposv(correlation, step, lower=1)
    square = float(step @ (along if failed == 0 else np.linalg.solve(correlation, step)))
    return math.sqrt(max(square, 0.0))


# --- groups into chunks ---------------------------------------------------------------------------------------------


def shelved(
    shelf: Shelf,
    groups: Sequence[Bundle],
    at: SharedState,
    setting: Setting,
    points: Sequence[FloatArray] | None = None,
) -> Shelf:
    """The shelf with more PMs, the open chunk filled first.

    ``points``: of the PMs (3,) at that state; only what comes to the open chunk is then linearised there, else all.
    """
    left = list(groups)
    while left:
        before = shelf.open
        room = CHUNK - (len(before.problem.pms) if before is not None else 0)
        now, left = left[:room], left[room:]
        pairs = [replace(pair, pm=group.label, epoch=0) for group in now for pair in group.pairs]
        places = np.array([place for group in now for place in group.places], dtype=np.int64)
        problem, kept = setting.pack((), pairs), np.array([group.kept for group in now])
        private: PrivateState | None = None
        if points is not None:
            start = replace(initial_private(problem, at), trus_p_pm=np.array(points[: len(now)])[None])
            points = points[len(now) :]
            more = make_chunk(places, problem, kept, at, start, rounds=1)
            whole = more if before is None else with_more(before, more, setting.columns)
            shelf = shelf.with_open(whole, setting.columns)
            continue
        if before is not None:
            private = joined_private(before.private, initial_private(problem, at))
            problem, places = joined(before.problem, problem), np.concatenate([before.places, places])
            kept = np.concatenate([before.kept, kept])
        shelf = shelf.with_open(make_chunk(places, problem, kept, at, private), setting.columns)
    return shelf


def without_label(shelf: Shelf, label: int, at: SharedState, columns: Columns) -> Shelf:
    """The shelf without one PM, where it has it."""

    def less(chunk: Chunk) -> Chunk | None:
        place = chunk.problem.pms.index(label)
        problem, looks, _ = without_pms(chunk.problem, np.array([place]))
        if not len(problem.pms):
            return None
        return make_chunk(chunk.places[looks], problem, np.delete(chunk.kept, place), at)

    if shelf.open is not None and label in shelf.open.problem.pms:
        return replace(shelf, open=less(shelf.open))
    for i, chunk in enumerate(shelf.full):
        if label in chunk.problem.pms:
            smaller = less(chunk)
            if smaller is not None:
                return shelf.with_full(i, smaller, columns)
    return shelf


# --- one more pair --------------------------------------------------------------------------------------------------


def counts(state: State) -> tuple[int, int]:
    """PMs that are kept, and all, over the epochs that have a registration."""
    tallies = [data.shelf.counts for data in state.epochs]
    kept, every = sum(tally[0] for tally in tallies), sum(tally[1] for tally in tallies)
    groups = state.window.groups if state.window is not None else ()
    return kept + sum(group.kept for group in groups), every + len(groups)


def kept_by_place(state: State) -> BoolArray:
    """(P,) whether each pair counts, in the session's order."""
    out = np.zeros(state.pairs, dtype=bool)
    for data in state.epochs:
        for chunk in data.shelf.chunks:
            out[chunk.places] = chunk.kept[chunk.problem.look_pm]
    for group in state.window.groups if state.window is not None else ():
        out[list(group.bundle.places)] = group.kept
    return out


def limit_of(degrees_of_freedom: int, kept: int, count: int) -> float:
    """Chi square beyond which a PM is junk, as in fgreg.robust: where ``kept`` of ``count`` count, it among them."""
    return float(chdtri(max(degrees_of_freedom, 1), junk_p_of(kept, count)))


def innovation(prepared: Prepared, covariance: FloatArray, before: Quadratic | None = None) -> float:
    """Squared deviation of a PM from what the others predict, over its predicted covariance.

    Args:
        prepared: at the present estimate, which is the optimum of the others and, where given, of ``before``.
        covariance: (D, D) of the present estimate.
        before: what the same PM says in the present estimate, about the same state.
    """
    if prepared.far:
        return prepared.quadratic.cost
    rows, residual = prepared.rows, prepared.residual
    if before is None:
        spread = np.eye(len(rows)) + rows @ covariance @ rows.T
        return float(residual @ np.linalg.solve(spread, residual))
    rest = np.linalg.inv(covariance) - before.hessian
    own = prepared.quadratic
    both = own.gradient - before.gradient
    joint = own.cost - float(both @ np.linalg.solve(rest + own.hessian, both))
    return joint + float(before.gradient @ np.linalg.solve(rest, before.gradient))


def popped(state: State, window: Window, setting: Setting) -> tuple[State, tuple[int, ...]]:
    """The state with the window's oldest groups shelved, where the window is full; and their labels."""
    if len(window.groups) < WINDOW:
        return state, ()
    oldest = window.groups[:STEP]
    points = None
    if state.epoch_pairs > NEAR_PAIRS and all(group.kept for group in oldest):
        keys = [Variable.trus_p_pm.key(group.prepared.first) for group in oldest]
        points = [window.isam.calculateEstimatePoint3(key) for key in keys]
    shelf = shelved(state.now.shelf, [group.bundle for group in oldest], window.state, setting, points)
    return state.with_now(shelf=shelf), tuple(group.label for group in oldest)


def relaxed(
    state: State, window: Window, change: Change, setting: Setting, settled: float = SETTLED_MANY, *, near: bool = False
) -> tuple[State, Window]:
    """Update the window until the estimate stands still.

    Args:
        state, window, change, setting: of the update.
        settled: movement, in sigma, at which it does.
        near: the epoch's chunks and the aims are linearised at every new estimate, else left where they are.
    """
    layout = state.layout
    if layout is None:
        raise ValueError("no shared variables yet")
    for _ in range(MOST_UPDATES):
        before = window.state
        window = updated(window, change, layout, window.numbers)
        moved = sigma_distance(before, window.state, window.covariance, setting.columns)
        if moved < settled:
            break
        change = Change()
        if near:
            state = refreshed(state, window.state, setting)
            change = Change(summary=summary(state, window.state, setting))
    return state, window


def refreshed(state: State, at: SharedState, setting: Setting, *, rounds: int = 0) -> State:
    """The state with its epoch's chunks, and the aims, linearised anew (``rounds`` as of :func:`again`)."""
    shelf = state.now.shelf
    for i, chunk in enumerate(shelf.full):
        shelf = shelf.with_full(i, again(chunk, at, rounds), setting.columns)
    if shelf.open is not None:
        shelf = replace(shelf, open=again(shelf.open, at, rounds))
    aims = tuple(again(chunk, at, rounds) for chunk in state.aim_chunks)
    return replace(state.with_now(shelf=shelf), aim_chunks=aims)


def again(chunk: Chunk, at: SharedState, rounds: int = 0) -> Chunk:
    """A chunk linearised at another state near by; its private variables make one step more than ``rounds``."""
    return make_chunk(chunk.places, chunk.problem, chunk.kept, at, chunk.private, rounds=rounds)


def opened(
    state: State, groups: Sequence[Group], at: SharedState, numbers: int, setting: Setting
) -> tuple[State, Window]:
    """A window anew about a state, and the estimate at rest."""
    layout = state.layout
    if layout is None:
        raise ValueError("no shared variables yet")
    window = open_window(groups, summary(state, at, setting), layout, state.epoch, numbers)
    for _ in range(MOST_UPDATES):
        state = refreshed(state, window.state, setting, rounds=1)  # three pairs hardly hold a registration
        before = window.state
        change = Change(summary=summary(state, window.state, setting))
        window = updated(window, change, layout, numbers)
        if sigma_distance(before, window.state, window.covariance, setting.columns) < SETTLED_FEW:
            break
    return state, window
