"""Input of an evaluation: a session's measurements, the ground truth where it is known, and the settings."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.model.measurements import Measurements, Track
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The known part of the ground truth.

    Attributes:
        trus_T_camera: (4, 4) of each epoch.
        marker_T_laser: (4, 4), or None.
        track_stage_rad: true absolute device angle of each of the case's tracks, None where not known.
    """

    trus_T_camera: tuple[FloatArray, ...]
    marker_T_laser: FloatArray | None = None
    track_stage_rad: tuple[float | None, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One session: measurements, tracking queries, and the ground truth where it is known."""

    name: str
    model: SessionModel
    measurements: Measurements
    tracks: tuple[Track, ...] = ()
    truth: Truth | None = None

    @property
    def pms(self) -> tuple[int, ...]:
        """The PMs in the order of their first look."""
        return tuple(dict.fromkeys(pair.pm for pair in self.measurements.pairs))

    def pms_of_epoch(self, epoch: int) -> tuple[int, ...]:
        """The PMs of one camera epoch, in the order of their first look."""
        return tuple(dict.fromkeys(pair.pm for pair in self.measurements.pairs if pair.epoch == epoch))

    @property
    def largest_epoch(self) -> int:
        """The camera epoch with the most PMs; the latest one if several have as many."""
        count = len(self.measurements.epochs)
        return max(range(count), key=lambda k: (len(self.pms_of_epoch(k)), k))


@dataclass(frozen=True, slots=True)
class EvaluationConfig:
    """What to compute.

    Attributes:
        folds: number of folds of the cross-validation; 0: none.
        leave_one_out: also leave out each PM alone.
        most_left_out: largest number of these PMs; where there are more, evenly spread ones are used.
        curve: compute the error against the number of pairs.
        sizes: numbers of pairs of the curve; None: from 4, at most ``most_sizes`` of them.
        most_sizes: largest number of sizes where ``sizes`` is None.
        subsets: largest number of subsets of each size.
        seed: of folds and subsets.
        solve: settings of the estimate.
    """

    folds: int = 5
    leave_one_out: bool = True
    most_left_out: int = 60
    curve: bool = True
    sizes: tuple[int, ...] | None = None
    most_sizes: int = 8
    subsets: int = 20
    seed: int = 1
    solve: SolveConfig = field(default_factory=SolveConfig)

    def __post_init__(self) -> None:
        if self.folds == 1 or self.folds < 0:
            raise ValueError(f"folds is {self.folds}, expected 0 or at least 2")
        if self.subsets < 1:
            raise ValueError(f"subsets is {self.subsets}, expected at least 1")
        if self.sizes is not None and any(size < 3 for size in self.sizes):
            raise ValueError("a registration takes at least 3 pairs")


def folds_of(case: Case, count: int, seed: int) -> tuple[tuple[int, ...], ...]:
    """Random folds of the PMs, stratified by camera epoch; empty folds are left out."""
    rng = np.random.default_rng([seed, 1])
    folds: list[list[int]] = [[] for _ in range(count)]
    place, dealt = 0, set()
    for epoch in range(len(case.measurements.epochs)):
        pms = [pm for pm in case.pms_of_epoch(epoch) if pm not in dealt]
        for index in rng.permutation(len(pms)):
            folds[place % count].append(pms[index])
            place += 1
        dealt.update(pms)
    return tuple(tuple(sorted(fold)) for fold in folds if fold)


def left_out_one_by_one(case: Case, most: int) -> tuple[tuple[int, ...], ...]:
    """Each PM alone; evenly spread ones where there are more than ``most``."""
    pms = case.pms
    if len(pms) > most:
        pms = tuple(pms[i] for i in np.linspace(0, len(pms) - 1, most).round().astype(int))
    return tuple((pm,) for pm in pms)


def curve_sizes(count: int, config: EvaluationConfig) -> tuple[int, ...]:
    """Numbers of pairs of the curve for an epoch of ``count`` PMs."""
    if config.sizes is not None:
        return tuple(size for size in sorted(set(config.sizes)) if size <= count)
    if count < 4:
        return ()
    sizes = np.arange(4, count + 1)
    if len(sizes) > config.most_sizes:
        sizes = np.unique(np.geomspace(4, count, config.most_sizes).round().astype(int))
    return tuple(int(size) for size in sizes)


def subsets_of(pms: tuple[int, ...], size: int, most: int, seed: int) -> tuple[tuple[int, ...], ...]:
    """Distinct subsets of ``size`` PMs: all where there are at most ``most``, else as many at random."""
    total = math.comb(len(pms), size)
    rng = np.random.default_rng([seed, 2, size])
    if total <= most:
        from itertools import combinations

        return tuple(combinations(pms, size))
    found: dict[tuple[int, ...], None] = {}
    while len(found) < most:
        picked = np.sort(rng.choice(len(pms), size, replace=False))
        found[tuple(pms[i] for i in picked)] = None
    return tuple(found)
