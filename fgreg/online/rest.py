"""Rests: from time to time the window is opened anew from plain numbers, and a session can be taken up from there.

ISAM2 cannot be written to disk. So every so many events the engine itself goes on from what *can* be written: the
window's variables as numbers, from which GTSAM's objects are made anew. Since it does so at the same events whether or
not anything is written, and goes on from the same numbers, a session that is opened again at a rest goes on exactly as
one that was never closed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import gtsam
import numpy as np

from fgreg.frames import FloatArray
from fgreg.measurements import Pair
from fgreg.online.events import DetectedMove, DetectedReturn
from fgreg.online.judge import Judgement
from fgreg.online.restart import AIMS_IN_CHUNK
from fgreg.online.shared import Layout, number_at
from fgreg.online.state import RECENT, SETTLED_MANY, STEP, WINDOW, Setting, State, sigma_distance, summary
from fgreg.online.summary import CHUNK
from fgreg.online.window import (
    Group,
    GroupSeed,
    Prepared,
    Window,
    WindowSeed,
    factors_of,
    open_window,
    private_keys,
    windows_of,
)
from fgreg.surface import TissueSurface

LEAST_EFFORT: Final = 100
"""Effort, in events of the usual kind, after which there is a rest, or an eighth of the session's pairs where that is
more: so much at most is to be taken in again when a session is opened, and what is written grows with the session."""
SHARE: Final = 8
EFFORTS: Final = ((8, 40), (40, 8), (160, 2))
"""Up to so many pairs of an epoch an event takes so many times as long as later ones."""

CONSTANTS: Final = (CHUNK, WINDOW, STEP, RECENT, AIMS_IN_CHUNK, LEAST_EFFORT, SHARE, EFFORTS)
"""What a rest that is taken up by another program has to have in common with it."""


@dataclass(frozen=True, slots=True)
class Noticed:
    """What was found out about the camera by itself.

    Attributes:
        moves, returns: in the order of time. suspicion: why the epoch that lasts is not to be trusted; empty: it is.
    """

    moves: tuple[DetectedMove, ...] = ()
    returns: tuple[DetectedReturn, ...] = ()
    suspicion: str = ""

    def texts(self) -> dict[int, str]:
        """What to tell of the epochs that began with such a move; their numbers count those before."""
        return {move.epoch + before + 1: move.text for before, move in enumerate(self.moves)}


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """The engine at a rest.

    Attributes:
        state: with a window that was just opened from its seed.
        t: of the last event. serial: number of events.
        estimate_t: time of the estimate.
        judgement, surface: what the judge said last.
        noticed: what was found out about the camera.
    """

    state: State
    t: float
    serial: int
    estimate_t: float
    judgement: Judgement | None
    surface: TissueSurface | None
    noticed: Noticed = Noticed()


def with_effort(state: State) -> State:
    """The state with the effort of one event more."""
    pairs = state.epoch_pairs
    return replace(state, effort=state.effort + next((times for most, times in EFFORTS if pairs <= most), 1))


def rested(state: State, setting: Setting) -> State:
    """The state after a rest, where one is due and leaves the estimate where it is; else the state as it is."""
    window = state.window
    if window is None or state.layout is None or state.effort < max(LEAST_EFFORT, state.pairs // SHARE):
        return state
    try:
        fresh = window_of(seed_of(window), state, setting)
        moved = sigma_distance(window.state, fresh.state, fresh.covariance, setting.columns)
    except (ArithmeticError, RuntimeError):  # among pairs that contradict each other: the next event may do better
        return state
    if not moved < SETTLED_MANY:
        return state
    return replace(state.with_now(state=fresh.state), window=fresh, effort=0)


def seed_of(window: Window) -> WindowSeed:
    """A window as numbers."""
    values = window.isam.calculateEstimate()
    groups = []
    for group in window.groups:
        prepared = group.prepared
        own = _private_numbers(group.bundle.pairs, prepared.first, values) if group.kept else None
        groups.append(GroupSeed(group.bundle, prepared.rows, prepared.residual, prepared.state, prepared.far, own))
    return WindowSeed(window.state, tuple(groups))


def window_of(seed: WindowSeed, state: State, setting: Setting) -> Window:
    """The window that a seed grows to beside what else is in a state.

    Raises:
        RuntimeError: an indeterminate system, or another failure of GTSAM.
        ArithmeticError: a result that is not finite.
        ValueError: numbers of private variables that are not those of the groups' pairs.
    """
    layout = state.layout
    if layout is None:
        raise ValueError("no shared variables yet")
    groups, numbers = [], 0
    for one in seed.groups:
        groups.append(_group(one, layout, state.epoch, setting, numbers))
        numbers += len(one.bundle.pairs)
    window = open_window(groups, summary(state, seed.at, setting), layout, state.epoch, numbers)
    return replace(window, seed=seed)


def _group(seed: GroupSeed, layout: Layout, epoch: int, setting: Setting, first: int) -> Group:
    pairs = seed.bundle.pairs
    graph = factors_of(pairs, windows_of(pairs, setting.model), layout, epoch, setting.model, first)
    values = gtsam.Values() if seed.values is None else _private_values(pairs, first, seed.values)
    return Group(seed.bundle, Prepared(graph, values, seed.rows, seed.residual, seed.state, seed.far, first))


def private_count(pairs: tuple[Pair, ...]) -> int:
    """How many numbers the private variables of the looks at one PM are."""
    return 13 * len({pair.marker.id for pair in pairs}) + 3 + len(pairs)


def _private_numbers(pairs: tuple[Pair, ...], first: int, values: gtsam.Values) -> FloatArray:
    markers, lambdas, point, thetas = private_keys(pairs, first)
    parts: list[FloatArray] = []
    for marker, lam in zip(markers, lambdas, strict=True):
        parts += [values.atPose3(marker).matrix()[:3].ravel(), np.array([values.atDouble(lam)])]
    parts += [values.atPoint3(point), np.array([values.atDouble(theta) for theta in thetas])]
    return np.concatenate(parts)


def _private_values(pairs: tuple[Pair, ...], first: int, numbers: FloatArray) -> gtsam.Values:
    if numbers.shape != (private_count(pairs),):
        raise ValueError(f"{numbers.shape} private variables, expected {private_count(pairs)}")
    markers, lambdas, point, thetas = private_keys(pairs, first)
    values, at = gtsam.Values(), 0
    for marker, lam in zip(markers, lambdas, strict=True):
        pose = np.eye(4)
        pose[:3] = numbers[at : at + 12].reshape(3, 4)
        values.insert(marker, gtsam.Pose3(pose))
        values.insert(number_at(lam, float(numbers[at + 12])))
        at += 13
    values.insert(point, numbers[at : at + 3])
    for theta, value in zip(thetas, numbers[at + 3 :].tolist(), strict=True):
        values.insert(number_at(theta, value))
    return values
