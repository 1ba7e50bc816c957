"""Camera epochs and the measured motions between them: which can be solved, which are linked, and subsets of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgreg.graph.shared_state import Quadratic
from fgreg.model.measurements import EpochStart, Measurements
from fgreg.registration.multistart import EpochSearch


@dataclass(frozen=True, slots=True, eq=False)
class FinishedEpochs:
    """The epochs before the last one, where only the last one is solved.

    Attributes:
        prior: of the last epoch's shared variables, from the earlier epochs' pairs and a measured motion (without the
            aims, and the priors of the configuration).
        is_open: whether the epoch from which a measured motion leads to the last one is ambiguous.
    """

    prior: Quadratic
    is_open: bool


def has_registration(prior: Quadratic) -> bool:
    """Whether a prior of one epoch's shared variables has information on its registration, from a measured motion."""
    return bool((np.diag(prior.hessian)[:6] > 0.0).all())


def last_epoch(measurements: Measurements) -> Measurements:
    """The aims, and the pairs and points of the last epoch; the epochs keep their numbers, without the motions."""
    last = len(measurements.epochs) - 1
    pairs = tuple(pair for pair in measurements.pairs if pair.epoch == last)
    points = tuple(point for point in measurements.points if point.epoch == last)
    return Measurements(measurements.aims, pairs, tuple(EpochStart(start.t) for start in measurements.epochs), points)


def solvable_epochs(measurements: Measurements, searches: tuple[EpochSearch, ...]) -> list[int]:
    """Epochs with minima of their own, and those that measured camera motions link to one."""
    known = {k for k, search in enumerate(searches) if search.minima}
    linked = {k: epoch.old(k) for k, epoch in enumerate(measurements.epochs) if k and epoch.motion_known}
    for _ in range(len(searches)):
        known |= {k for k, old in linked.items() if old in known} | {old for k, old in linked.items() if k in known}
    return sorted(known)


def epoch_chains(measurements: Measurements, solvable: list[int]) -> list[list[int]]:
    """Solvable epochs, grouped by the measured motions between them."""
    out: list[list[int]] = []
    for k in solvable:
        start = measurements.epochs[k]
        chain = next((chain for chain in out if start.motion_known and start.old(k) in chain), None)
        if chain is not None:
            chain.append(k)
        else:
            out.append([k])
    return out


def restrict_epochs(measurements: Measurements, epochs: list[int]) -> Measurements:
    """The measurements of some epochs, renumbered in order; a motion stays where both of its epochs are among them."""
    place = {k: i for i, k in enumerate(epochs)}
    starts = tuple(
        replace(start, after=place[start.old(k)] if start.after is not None else None)
        if start.old(k) in place
        else EpochStart(start.t)
        for k, start in ((k, measurements.epochs[k]) for k in epochs)
    )
    pairs = tuple(replace(pair, epoch=place[pair.epoch]) for pair in measurements.pairs if pair.epoch in place)
    points = tuple(replace(point, epoch=place[point.epoch]) for point in measurements.points if point.epoch in place)
    return Measurements(measurements.aims, pairs, starts, points)
