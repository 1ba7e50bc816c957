"""Summary statistics of evaluations, for tables, files and plots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import chdtri

from fgreg.evaluation.resolve import HeldOutPm, Resolved
from fgreg.evaluation.run import SessionEvaluation, SizedSolves

QUANTILE = 0.95


@dataclass(frozen=True, slots=True)
class Spread:
    """Mean, standard deviation, 95 % quantile and maximum of ``count`` values."""

    count: int
    mean: float
    std: float
    p95: float
    worst: float


def spread_of(values: Sequence[float] | np.ndarray[Any, Any]) -> Spread | None:
    """Statistics of absolute values; None where there are none."""
    array = np.abs(np.asarray(values, dtype=np.float64).ravel())
    if array.size == 0:
        return None
    return Spread(
        int(array.size),
        float(array.mean()),
        float(array.std()),
        float(np.quantile(array, QUANTILE)),
        float(array.max()),
    )


@dataclass(frozen=True, slots=True)
class Prediction:
    """Prediction errors of held-out PMs.

    Attributes:
        pair_residual_mm: Eq. 12 over the PMs (not a TRE).
        nis_per_degree: sum of NIS over sum of degrees of freedom; 1 where the stated noise is right.
        beyond_95: share of PMs whose NIS is beyond the 95 % quantile of its chi square.
        failed: solves without a registration.
    """

    pair_residual_mm: Spread
    nis_per_degree: float
    beyond_95: float
    failed: int


def prediction_of(solves: Sequence[Resolved]) -> Prediction | None:
    """Pooled prediction errors of solves; None where no PM was predicted."""
    held: list[HeldOutPm] = [pm for solve in solves for pm in solve.held_out]
    residual = spread_of([pm.pair_residual_mm for pm in held])
    if residual is None:
        return None
    freedom = sum(pm.degrees_of_freedom for pm in held)
    return Prediction(
        pair_residual_mm=residual,
        nis_per_degree=sum(pm.nis for pm in held) / freedom,
        beyond_95=float(np.mean([pm.nis > chdtri(pm.degrees_of_freedom, 1.0 - QUANTILE) for pm in held])),
        failed=sum(bool(solve.failure) for solve in solves),
    )


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """The curve at one number of pairs.

    Attributes:
        pairs: number used. subsets: number solved. failed: those without a registration.
        ambiguous: share of subsets with a second registration that explains the pairs about as well.
        tre_mm: over subsets and targets, where the truth is known. expected_mm: mean predicted TRE over subsets.
        pair_residual_mm: of the PMs not used (Eq. 12), where there are any.
        tre_rms_mm: root mean square over subsets and targets.
    """

    pairs: int
    subsets: int
    failed: int
    ambiguous: float
    tre_mm: Spread | None
    tre_rms_mm: float | None
    expected_mm: float | None
    pair_residual_mm: Spread | None


def curve_point(sized: SizedSolves, epoch: int) -> CurvePoint:
    """Statistics of one size."""
    answered = [solve for solve in sized.solves if not solve.failure]
    errors = [e for solve in answered if (e := solve.tre_mm[epoch]) is not None]
    expected = [mm for solve in answered if (mm := solve.expected_mm[epoch]) is not None]
    stacked = np.concatenate(errors) if errors else np.zeros(0)
    return CurvePoint(
        pairs=sized.pairs,
        subsets=len(sized.solves),
        failed=len(sized.solves) - len(answered),
        ambiguous=float(np.mean([solve.ambiguous for solve in answered])) if answered else math.nan,
        tre_mm=spread_of(stacked),
        tre_rms_mm=float(np.sqrt(np.mean(stacked**2))) if errors else None,
        expected_mm=float(np.mean(expected)) if expected else None,
        pair_residual_mm=spread_of([pm.pair_residual_mm for solve in answered for pm in solve.held_out]),
    )


def curve_of(evaluation: SessionEvaluation) -> tuple[CurvePoint, ...]:
    """The curve of one session."""
    return tuple(curve_point(sized, evaluation.curve_epoch) for sized in evaluation.curve)


def pooled_curve(evaluations: Sequence[SessionEvaluation]) -> tuple[CurvePoint, ...]:
    """The curve over all sessions' subsets of each size."""
    by_size: dict[int, list[Resolved]] = {}
    for evaluation in evaluations:
        for sized in evaluation.curve:
            # Only the curve's epoch is used: move it to index 0.
            k = evaluation.curve_epoch
            for solve in sized.solves:
                moved = (
                    solve
                    if solve.failure
                    else Resolved(
                        kept=solve.kept,
                        trus_T_camera=solve.trus_T_camera[k : k + 1],
                        ambiguous=solve.ambiguous,
                        expected_mm=solve.expected_mm[k : k + 1],
                        tre_mm=solve.tre_mm[k : k + 1],
                        held_out=solve.held_out,
                    )
                )
                by_size.setdefault(sized.pairs, []).append(moved)
    return tuple(curve_point(SizedSolves(size, tuple(by_size[size])), 0) for size in sorted(by_size))


def all_tre_mm(evaluations: Sequence[SessionEvaluation]) -> np.ndarray[Any, Any]:
    """Errors at all targets of all epochs of all sessions."""
    errors = [e for evaluation in evaluations for e in evaluation.whole.tre_mm if e is not None]
    return np.concatenate(errors) if errors else np.zeros(0)


def all_track_errors_deg(evaluations: Sequence[SessionEvaluation]) -> np.ndarray[Any, Any]:
    """Errors of all solved tracks with a known truth, degrees."""
    return np.degrees([e for item in evaluations for e in item.whole.track_error_rad if e is not None])
