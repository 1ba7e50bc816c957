"""What the full solve and the test for camera moves get from the incremental state, and when it is due."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fgreg.camera_moves.detector import MIN_KNOWN, MoveCase
from fgreg.camera_moves.loop_closure import MIN_EARLIER, MOST_LOOKS
from fgreg.graph.columns import Columns
from fgreg.graph.shared_state import Quadratic, gaussian_prior
from fgreg.model.estimate import Verdict
from fgreg.model.measurements import Measurements
from fgreg.registration.epoch_verdicts import EpochReport
from fgreg.registration.epochs import FinishedEpochs, epoch_chains, has_registration
from fgreg.registration.multistart import EpochSearch, Minimum
from fgreg.smoother.state import State, looks_by_pm
from fgreg.smoother.updates import FIRST_PAIRS

LEAST_PMS = 3
"""Smallest number of PMs with which an epoch is registered."""
FIRST_PMS = 8
"""Up to this number of PMs of an epoch the full solve runs at each pair."""
LATER_PAIRS = (12, 15, 20, 25, 30, 40, 60, 80)
"""Numbers of pairs at which the full solve runs later; after the last one it runs whenever the pairs have doubled."""


def is_due(pairs: int) -> bool:
    """Whether the full solve runs because the epoch now has ``pairs`` pairs."""
    if pairs <= LATER_PAIRS[-1]:
        return pairs <= FIRST_PAIRS or pairs in LATER_PAIRS
    return bool(pairs % LATER_PAIRS[-1] == 0 and (pairs // LATER_PAIRS[-1]).bit_count() == 1)


def known_minima(state: State) -> dict[int, EpochSearch]:
    """Minima of earlier epochs that are not ambiguous, which are not searched again."""
    out = {}
    for k, epoch in enumerate(state.epochs[:-1]):
        mine = [shot for shot in state.shots if shot.pair.epoch == k]
        if epoch.state is not None and not epoch.is_open and len({shot.label for shot in mine}) >= LEAST_PMS:
            clean = all(shot.inlier for shot in mine)
            out[k] = EpochSearch((Minimum(0.0, epoch.state),), None, clean=clean)
    return out


def move_case(state: State, columns: Columns) -> MoveCase:
    """The test of the current epoch for an unreported camera move, or for a loop closure.

    ``columns``: of the shared variables.
    """
    active = state.active_window
    looks = looks_by_pm(state.current, state.now.first)
    # Among many PMs a camera move leaves two minima: the pairs of either side are outliers of the other.
    sound = state.carried is not None and (not state.is_open or state.epoch_pms >= 2 * MIN_KNOWN)
    return MoveCase(
        epoch=state.epoch,
        pms=tuple(tuple(state.shots[place].pair for place in places) for places in looks.values()),
        places=tuple(places[0] for places in looks.values()),
        inlier=np.array([state.shots[places[0]].inlier for places in looks.values()], dtype=bool),
        known=state.carried.at(active.state, columns) if active and state.carried and sound else None,
        earlier=_earlier(state, state.epoch) if state.epoch_pairs <= MOST_LOOKS else {},
    )


def finished_epochs(state: State, prior: Quadratic, reports: Sequence[EpochReport]) -> FinishedEpochs | None:
    """The earlier epochs as the prior of the current one; None where a tied one of them misses a condition.

    ``reports``: of the first epochs, as the full solve judged them.
    """
    if has_registration(prior) and not _tied_are_ok(state, reports):
        return None
    old = state.epochs[state.now.start.old(state.epoch)]
    return FinishedEpochs(prior, is_open=old.is_open and has_registration(prior))


def _tied_are_ok(state: State, reports: Sequence[EpochReport]) -> bool:
    """Whether no epoch that measured motions tie to the current one misses a condition that both have to meet."""
    starts = tuple(epoch.start for epoch in state.epochs)
    known = [k for k, epoch in enumerate(state.epochs) if epoch.state is not None or k == state.epoch]
    tied = next(chain for chain in epoch_chains(Measurements((), (), starts), known) if state.epoch in chain)
    return all(r.own_verdict is Verdict.OK for r in reports if r.estimate.index in tied[:-1])


def _earlier(state: State, to: int) -> dict[int, Quadratic]:
    """Registrations of the epochs before ``to`` that a loop may be closed to; none where the motion is known."""
    if state.epochs[to].start.motion_known:
        return {}
    out = {}
    for k, epoch in enumerate(state.epochs[:to]):
        pms = {shot.label for shot in state.shots if shot.pair.epoch == k}
        if epoch.state is not None and epoch.covariance is not None and len(pms) >= MIN_EARLIER:
            out[k] = gaussian_prior(epoch.state, epoch.covariance)
    return out
