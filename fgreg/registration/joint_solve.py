"""Inliers of all solved epochs together, and their joint optimum."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.transforms import BoolArray
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.reduced_graph import Evaluation, evaluate
from fgreg.graph.reduced_solver import Optimum, optimize
from fgreg.graph.reduced_system import refine
from fgreg.graph.shared_state import SharedState
from fgreg.model.measurements import Look, Measurements
from fgreg.registration.multistart import MIN_INLIER_AIMS, MIN_INLIER_PMS
from fgreg.registration.outliers import (
    FEW,
    InlierSelection,
    Innovations,
    beyond_limit,
    graduated_or_near,
    innovations_at,
    plausible_cost,
    predicted_pms,
    select_inliers,
)

Pack = Callable[[Measurements], PackedProblem]

READINGS = 3
"""Outlier PMs are read in another way at most this many times: with each PM that fits, the next are told better."""


@dataclass(frozen=True, slots=True, eq=False)
class Shots:
    """All shots of the solved epochs, evaluated at the optimum of the inliers.

    Attributes:
        problem: all shots, packed, with the inliers' prior; the registration's own problem where all are inliers.
        looks: of each of its pairs, in order; some in another of their positions than measured first.
        evaluation: at the registration's optimum (one hypothesis).
        pm_inlier (J,), aim_inlier (A,): which of ``problem``'s PMs and aims are inliers.
        innovations: of each PM and aim.
        pm_beyond_limit (J,), aim_beyond_limit (A,): shots beyond their limit, also where there are too few to leave one
            out.
    """

    problem: PackedProblem
    looks: tuple[Look, ...]
    evaluation: Evaluation
    pm_inlier: BoolArray
    aim_inlier: BoolArray
    innovations: Innovations
    pm_beyond_limit: BoolArray
    aim_beyond_limit: BoolArray


def only_inliers(
    measurements: Measurements, pms: tuple[int, ...], pm_inlier: BoolArray, aim_inlier: BoolArray
) -> Measurements:
    """The measurements whose PM and aim are inliers; ``pms`` are the PMs' numbers."""
    names = {pm for pm, keep in zip(pms, pm_inlier, strict=True) if keep}
    return replace(
        measurements,
        aims=tuple(aim for aim, keep in zip(measurements.aims, aim_inlier, strict=True) if keep),
        pairs=tuple(pair for pair in measurements.pairs if pair.pm in names),
    )


def _enough(problem: PackedProblem, pm_inlier: BoolArray, aim_inlier: BoolArray) -> tuple[BoolArray, BoolArray]:
    """The inliers, with outlier rejection undone for an epoch (or for the aims) that has too few inliers."""
    pm_inlier = pm_inlier.copy()
    epoch_of = np.zeros(len(problem.pms), dtype=np.int64)
    epoch_of[problem.beam_pm] = problem.beam_epoch
    for epoch in range(problem.columns.epochs):
        mine = epoch_of == epoch
        if (pm_inlier & mine).sum() < MIN_INLIER_PMS:
            pm_inlier |= mine
    if aim_inlier.sum() < MIN_INLIER_AIMS:
        aim_inlier = np.ones_like(aim_inlier)
    return pm_inlier, aim_inlier


def _other_readings(
    measurements: Measurements,
    whole: PackedProblem,
    kept: tuple[BoolArray, BoolArray],
    selection: InlierSelection,
    packed: Pack,
) -> tuple[Measurements, BoolArray] | None:
    """Read outlier PMs in another way that fits the inliers; None where there is none.

    A look is taken at another of its positions. Or, where no such fits and exactly one look can be left out so that
    the rest of its PM fits, that look is split off.

    Returns:
        the measurements with the changed looks, those split off under a PM number of their own; which of their PMs are
        inliers.
    """
    pm_inlier, _ = kept
    out = {pm for pm, keep in zip(whole.pms, pm_inlier, strict=True) if not keep}
    looks: dict[int, list[int]] = {}
    for index, pair in enumerate(measurements.pairs):
        if pair.pm in out:
            looks.setdefault(pair.pm, []).append(index)
    trials: list[tuple[int, Look | None]] = []  # a pair, and its look in another position, or None: left out
    for indices in looks.values():
        trials += [(index, look) for index in indices for look in measurements.pairs[index].look.elsewhere()]
        trials += [(index, None) for index in indices if len(indices) > 1]
    if not trials:
        return None
    # Each trial is packed as a PM of its own.
    variants = []
    for number, (changed, look) in enumerate(trials):
        for index in looks[measurements.pairs[changed].pm]:
            pair = replace(measurements.pairs[index], pm=number)
            if index != changed:
                variants.append(pair)
            elif look is not None:
                variants.append(replace(pair, look=look))
    fits = predicted_pms(packed(replace(measurements, pairs=tuple(variants))), whole, selection)
    good: dict[int, list[tuple[int, Look | None]]] = {}
    for trial, fit in zip(trials, fits, strict=True):
        if fit:
            good.setdefault(measurements.pairs[trial[0]].pm, []).append(trial)
    pairs, rescued, spare = list(measurements.pairs), set(), min(whole.pms) - 1
    for pm, fitting in good.items():
        index, look = fitting[0]
        if look is not None:
            pairs[index] = replace(pairs[index], look=look)
        elif len(fitting) == 1:
            pairs[index] = replace(pairs[index], pm=spare - index)
        else:
            continue
        rescued.add(pm)
    if not rescued:
        return None
    names = dict.fromkeys(pair.pm for pair in pairs)
    before = dict(zip(whole.pms, pm_inlier, strict=True))
    inlier = np.array([name in rescued or before.get(name, False) for name in names])
    return replace(measurements, pairs=tuple(pairs)), inlier


def solve_jointly(
    measurements: Measurements, packed: Pack, start: SharedState, aim_inlier: BoolArray, *, clean: bool
) -> tuple[Measurements, PackedProblem, Optimum, Shots]:
    """Select inliers and solve them.

    Args:
        measurements: of the epochs to be solved.
        packed: packs measurements as arrays.
        start: one hypothesis; several where not ``clean``.
        aim_inlier: (A,) aims that fit in the calibration without pairs.
        clean: whether every PM fitted in the searches of the epochs.

    Returns:
        the inliers, packed inliers, their optimum, and all shots evaluated there.
    """
    whole = packed(measurements)
    everyone = np.ones(len(whole.pms), dtype=bool), np.ones(len(measurements.aims), dtype=bool)
    if clean and aim_inlier.all():
        optimum = optimize(whole, start, tolerance=1e-8)
        found = innovations_at(whole, optimum.state, *everyone, optimum.evaluation.private)
        beyond = beyond_limit(whole, found, everyone[0])
        plausible = optimum.evaluation.cost[0] <= plausible_cost(whole)
        if plausible and not (beyond.pm.any() or beyond.aim.any()):
            looks = tuple(pair.look for pair in measurements.pairs)
            shots = Shots(whole, looks, optimum.evaluation, *everyone, found, beyond.pm, beyond.aim)
            return measurements, whole, optimum, shots
        start = optimum.state
        clean = bool(plausible and beyond.pm.mean() <= FEW and beyond.aim.sum() <= 1)
    if clean and aim_inlier.all():  # few of many are beyond their limit: this estimate is good enough to test them
        first = _enough(whole, ~beyond.pm, ~beyond.aim)
    else:
        robust = graduated_or_near(whole, start, robust_aims=True)
        start = robust.state.take([0])
        first = _enough(whole, robust.pm_inlier[0], robust.aim_inlier[0])
    selection = select_inliers(whole, start, *first)
    kept, given = _enough(whole, selection.pm_inlier, selection.aim_inlier), set(whole.pms)
    for _ in range(READINGS):
        other = _other_readings(measurements, whole, kept, selection, packed)
        if other is None:
            break
        measurements, pm_inlier = other
        whole = packed(measurements)
        selection = select_inliers(whole, selection.state, pm_inlier, kept[1])
        kept = _enough(whole, selection.pm_inlier, selection.aim_inlier)
        # Alone a look fits easily; what was split off shares its PM's marker observation, so it is no shot of its own.
        kept = kept[0] & np.isin(whole.pms, list(given)), kept[1]
    chosen = only_inliers(measurements, whole.pms, *kept)
    problem = packed(chosen)
    # Pictures and wavefronts of shots that are left out say nothing of the constants.
    whole = replace(whole, prior=problem.prior)
    optimum = optimize(problem, selection.state, tolerance=1e-8)
    found = innovations_at(whole, optimum.state, *kept)
    deviants = beyond_limit(whole, found, kept[0])
    private = initial_private(whole, optimum.state)
    for _ in range(4):
        private = refine(whole, optimum.state, private)
    at = evaluate(whole, optimum.state, private)
    looks = tuple(pair.look for pair in measurements.pairs)
    return chosen, problem, optimum, Shots(whole, looks, at, *kept, found, deviants.pm, deviants.aim)
