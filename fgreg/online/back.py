"""The scope put back: an earlier epoch's registration against the pairs of the one that lasts.

What is known of an earlier epoch's registration is what its own pairs, those before, and the aims say; the pairs of the
epoch that lasts are judged by that (fgreg.camera_moves.loop_closure), as they come.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgreg.camera_moves.bayes_filter import relinearisation
from fgreg.camera_moves.loop_closure import ReturnSettings, ReturnTest, default_return_settings, fits_again, which_epoch
from fgreg.camera_moves.whitened import gaussian_of, linearise, pivot_scale, pose_columns
from fgreg.config import SolveConfig
from fgreg.graph.shared_state import SharedState
from fgreg.measurements import EpochStart, Measurements, Pair
from fgreg.models import SessionModel
from fgreg.online.shared import Quadratic
from fgreg.online.state import Setting, State, passed_from, summary
from fgreg.online.store import MeasurementStore
from fgreg.registration import SoundSpeedPrior, pack_session

MOST_PAIRS = 30
"""Pairs of an epoch up to which it is asked whether it is an earlier one: by then it knows itself as well."""
MIN_EARLIER = 8
"""PMs that an earlier epoch has to have."""
CANDIDATES = 4
"""Only so many of the last epochs are asked about."""


@dataclass(frozen=True, slots=True, eq=False)
class ReturnCase:
    """What the test needs.

    Attributes:
        epoch: that lasts. pairs: its pairs so far.
        earlier: by epoch: its registration (with the common variables), and what is known about that.
    """

    epoch: int
    pairs: tuple[Pair, ...]
    earlier: dict[int, tuple[SharedState, Quadratic]]


@dataclass(frozen=True, slots=True)
class ReturnFound:
    """The camera is back: in ``epoch`` it is where ``to`` had it. log_bayes: of that against elsewhere."""

    epoch: int
    to: int
    log_bayes: float


def known_of(state: State, epoch: int, setting: Setting) -> tuple[SharedState, Quadratic] | None:
    """An earlier epoch's shared variables, and what was known of them when it ended; None without a registration."""
    data = state.epochs[epoch]
    if data.state is None or sum(len(chunk.kept) for chunk in data.shelf.chunks) < MIN_EARLIER:
        return None
    until = state.epochs[: epoch + 1]
    passed, _ = passed_from(until, data.state, setting.columns)
    return data.state, summary(replace(state, epochs=until, passed=passed), data.state, setting)


def return_case(state: State, setting: Setting, store: MeasurementStore, settings: ReturnSettings) -> ReturnCase | None:
    """The case for the test; None where it is not the time for one, or no epoch to go back to."""
    now = state.now
    if not state.epoch or now.start.motion_known or not settings.least_pairs <= state.epoch_pairs <= MOST_PAIRS:
        return None
    earlier = {}
    for epoch in range(max(0, state.epoch - CANDIDATES), state.epoch):
        known = known_of(state, epoch, setting)
        if known is not None:
            earlier[epoch] = known
    if not earlier:
        return None
    pairs = tuple(store.pair(place, 0) for place in range(now.first, state.pairs))
    return ReturnCase(state.epoch, pairs, earlier)


def return_tests(
    case: ReturnCase, model: SessionModel, config: SolveConfig, prior: SoundSpeedPrior | None, settings: ReturnSettings
) -> dict[int, ReturnTest]:
    """The tests of all earlier epochs of a case."""
    problem = pack_session(Measurements((), case.pairs, (EpochStart(0.0),)), model, config, prior)
    scale, pose = pivot_scale(problem.columns), pose_columns(0)
    tests = {}
    for epoch, (state, known) in case.earlier.items():
        earlier = gaussian_of(known.hessian, known.gradient, scale)
        if earlier is None:
            continue
        wide = earlier.covariance.copy()
        wide[pose, pose] += np.diag(np.repeat(settings.tolerance, 3) ** 2)
        tests[epoch] = fits_again(
            replace(earlier, covariance=wide),
            linearise(problem, state),
            settings,
            pose=pose,
            relinearise=relinearisation(problem, state),
        )
    return tests


def back_to(start: EpochStart, epoch: int, settings: ReturnSettings | None = None) -> EpochStart:
    """The start of an epoch in which the camera is where an earlier one had it, within the tolerance."""
    tolerance = (settings or default_return_settings()).tolerance
    return EpochStart(start.t, np.eye(4), np.diag(np.repeat(tolerance, 3) ** 2), epoch)


def returned_by(case: ReturnCase, tests: dict[int, ReturnTest]) -> ReturnFound | None:
    """Where the camera is back, if it is."""
    to = which_epoch(tests)
    return None if to is None else ReturnFound(case.epoch, to, tests[to].log_bayes)
