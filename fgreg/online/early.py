"""Evidence of an untold move early in an epoch: the PMs before it are too few to know a registration by themselves.

The same hypotheses and Bayes factors as of moves among the last PMs (fgreg.camera_moves.bayes_filter), from the other
end of time: the last PMs are registered without the first ones, and those follow as a stream, newest first. A move
between two PMs is as likely either way round, and so is what it leads to: its prior has zero mean. So few PMs before a
move are judged by the many after it; and each PM is a place for a move in one of the two tests only, so that the sum of
all their Bayes factors still grows by one per pair on average while nothing happens, which is what the threshold goes
by.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.camera_moves.bayes_filter import MoveSettings, check_for_move, quick_score, relinearisation
from fgreg.camera_moves.whitened import Gaussian, linearise, pose_columns
from fgreg.config import SolveConfig
from fgreg.errors import EstimationError
from fgreg.measurements import Aim, EpochStart, Measurements, Pair
from fgreg.models import SessionModel
from fgreg.online.evidence import MIN_BEFORE, Tested, size_of
from fgreg.online.state import Setting, State, kept_by_place
from fgreg.online.store import MeasurementStore
from fgreg.registration import Registration, SoundSpeedPrior, pack_session, register
from fgreg.robust import plausible_cost
from fgreg.steadiness import DOUBT, logsumexp, odds_in_epoch
from fgreg.verdict import FEW_PMS, WARN_LEFT_OUT

EVERY = 2
"""Where some are left out, which the cheap look cannot judge, the test is made at every so many PMs."""
LEAST_AFTER = 7
"""PMs after a move that have to agree on a registration of their own: one more than it takes."""


@dataclass(frozen=True, slots=True, eq=False)
class EarlyCase:
    """What the test needs.

    Attributes:
        pms: looks at each PM of the epoch, oldest first, numbered so. places: of the first look at each.
        early: how many of the first PMs are judged by the others.
        aims: calibration shots.
    """

    pms: tuple[tuple[Pair, ...], ...]
    places: tuple[int, ...]
    early: int
    aims: tuple[Aim, ...]


def early_case(state: State, setting: Setting, store: MeasurementStore, settings: MoveSettings) -> EarlyCase | None:
    """The case for the test; None where it is not the time for one, or nothing to it by the cheap look."""
    window = None if state.is_open else state.window
    known = 0 if window is None else len(window.groups) + state.now.shelf.counts[1]
    if state.epoch_pairs <= LEAST_AFTER or known > FEW_PMS:
        return None
    looks: dict[int, list[int]] = {}
    for place in range(state.now.first, state.pairs):
        looks.setdefault(store.number(place), []).append(place)
    size = 0 if window is None else size_of(state, window)
    early = min(len(looks) - size - 1, len(looks) - LEAST_AFTER, MIN_BEFORE)
    if early < 1 or len(looks) > FEW_PMS:
        return None
    steady = window is not None and bool(kept_by_place(state)[state.now.first :].all())
    if not steady and len(looks) % EVERY:
        return None
    pms = tuple(tuple(store.pair(place, 0, n) for place in mine) for n, mine in enumerate(looks.values()))
    if window is not None and steady:
        problem = setting.pack((), [pair for pm in pms for pair in pm])
        posterior = Gaussian(np.zeros(setting.columns.size), window.covariance)
        terms = linearise(problem, window.state)
        if quick_score(posterior, terms, settings.scales, pose_columns(0)) < DOUBT:
            return None
    return EarlyCase(pms, tuple(mine[0] for mine in looks.values()), early, tuple(store.aims))


def early_test(
    case: EarlyCase, model: SessionModel, config: SolveConfig, prior: SoundSpeedPrior | None, settings: MoveSettings
) -> Tested | None:
    """Whether the camera moved among the first PMs; None where those after them have no sound registration."""
    last = Measurements(case.aims, tuple(pair for pm in case.pms[case.early :] for pair in pm), (EpochStart(0.0),))
    try:
        found = register(last, model, config, prior)
    except EstimationError:
        return None
    if not _is_sound(found):
        return None
    # Of the first ones the newest comes first.
    first = tuple(pair for pm in reversed(case.pms[: case.early]) for pair in pm)
    problem, state = (
        pack_session(Measurements((), first, (EpochStart(0.0),)), model, config, prior),
        found.optimum.state,
    )
    test = check_for_move(
        Gaussian(np.zeros(problem.columns.size), found.covariance),
        linearise(problem, state),
        settings.learned(found.shots.pm_kept),
        pose=pose_columns(0),
        relinearise=relinearisation(problem, state),
    )
    return Tested(test, case.places[case.early : 0 : -1])


def _is_sound(found: Registration) -> bool:
    """Whether the PMs of a registration agree, on one only, and the first of them with the last."""
    shots = found.shots
    few = shots.pm_kept.sum() < LEAST_AFTER or float(np.mean(~shots.pm_kept)) > WARN_LEFT_OUT
    deviates = bool((shots.pm_deviant & shots.pm_kept).any())
    plausible = float(found.optimum.evaluation.cost[0]) <= plausible_cost(found.problem)
    steady = logsumexp(odds_in_epoch(found.problem, found.optimum, found.covariance, 0)[1]) <= DOUBT
    return plausible and not few and not deviates and not found.ambiguous and bool(steady)
