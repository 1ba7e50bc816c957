"""The estimate of one camera epoch, pair by pair, warm started: a reference for tests on moves, apart from the engine.

Reduced Gauss-Newton on the kept PMs of the epoch so far; who is kept follows from the innovations, by the limits of
fgreg.robust. Calibration shots (and what earlier epochs said of beam and window edge) enter as one Gaussian.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.camera_moves.bayes_filter import MoveSettings, MoveTest, check_for_move, relinearisation
from fgreg.camera_moves.whitened import (
    Gaussian,
    WhiteTerms,
    gaussian_of,
    pivot_scale,
    pose_columns,
    white_terms,
    whiten,
)
from fgreg.errors import EstimationError
from fgreg.frames import BoolArray, FloatArray
from fgreg.graph.packing import Anchor, PackedProblem, only_aims, without_aims
from fgreg.graph.pm_selection import private_of, select_pms
from fgreg.graph.reduced import contributions, evaluate, refine
from fgreg.graph.reduced_blocks import PrivateState, initial_private
from fgreg.graph.shared_state import SharedState
from fgreg.online.evidence import LAST, MIN_BEFORE
from fgreg.robust import junk_p, pm_degrees_of_freedom, pm_limits

MAX_STEPS = 8
TOLERANCE = 3e-3
"""Newton decrement (chi square) at which an estimate has settled: what is left is in the gradients that tests get."""


def summarise_aims(problem: PackedProblem, state: SharedState) -> PackedProblem:
    """The problem with its calibration shots summed up as a Gaussian about ``state`` (at their optimum of the beam)."""
    if not len(problem.aims.rotation):
        return problem
    aims = only_aims(problem)
    private = initial_private(aims, state)
    for _ in range(3):
        _, private = refine(aims, state, private)
    there = evaluate(aims, state, private)
    centre = -np.linalg.pinv(there.hessian[0], rcond=1e-12, hermitian=True) @ there.gradient[0]
    return without_aims(problem, Anchor(state.retract(centre[None], problem.columns), there.hessian[0]))


@dataclass(frozen=True, slots=True, eq=False)
class _Here:
    """The reduced problem at the present state: PMs whitened, and what is known beside them."""

    terms: WhiteTerms
    prior_hessian: FloatArray
    prior_gradient: FloatArray


class EpochFollower:
    """Follows one epoch (number 0 of its problem).

    Args:
        problem: all PMs of the epoch in time order; one epoch, aims summed up (:func:`summarise_aims`).
        state: where to start (one hypothesis), good for the first PMs.
        count: how many PMs to take in at first.

    Raises:
        EstimationError: these PMs leave the registration open.
    """

    def __init__(self, problem: PackedProblem, state: SharedState, count: int = MIN_BEFORE) -> None:
        self.problem, self.state = problem, state
        self.count = 0
        self.kept: BoolArray = np.zeros(0, dtype=bool)
        self._scale = pivot_scale(problem.columns)
        self.advance(count)

    def advance(self, count: int) -> None:
        """Take in PMs up to ``count`` in all and settle.

        Raises:
            EstimationError: they leave the registration open.
        """
        self.kept = np.concatenate([self.kept, np.ones(count - self.count, dtype=bool)])
        fresh = np.arange(len(self.kept)) >= self.count if self.count else np.zeros(count, dtype=bool)
        known, self.count = self.count, count
        self.seen = select_pms(self.problem, np.arange(count))
        self.private = self._warm_private(known)
        for _ in range(3 if known == 0 else 1):
            _, self.private = refine(self.seen, self.state, self.private)
        self.here = self._linearise()
        if fresh.any() and self.posterior(~fresh) is not None:
            self._judge(self.kept & ~fresh)
        for _ in range(3):
            self._settle()
            before = self.kept
            self._judge(self.kept)
            if (before == self.kept).all():
                break

    def _warm_private(self, known: int) -> PrivateState:
        """Private variables of all seen: as they were of the first ``known`` PMs, on the arcs of the others."""
        fresh = initial_private(self.seen, self.state)
        if known == 0:
            return fresh
        fresh.trus_p_pm[:, :known] = self.private.trus_p_pm
        fresh.beam_error[:, self.seen.beam_pm < known] = self.private.beam_error
        return fresh

    def _linearise(self) -> _Here:
        parts = contributions(self.seen, self.state, self.private)
        self.private = parts.private
        terms = whiten(parts.pm, pm_degrees_of_freedom(self.seen), self._scale)
        hessian = parts.prior.hessian[0, 0] + parts.aim.hessian[0].sum(axis=0)
        gradient = parts.prior.gradient[0, 0] + parts.aim.gradient[0].sum(axis=0)
        return _Here(terms, hessian, gradient)

    def _settle(self) -> None:
        for _ in range(MAX_STEPS):
            posterior = self.posterior(np.ones(self.count, dtype=bool))
            if posterior is None:
                raise EstimationError("these shots leave the registration undetermined; take more pairs")
            step = posterior.mean
            self.state = self.state.retract(step[None], self.problem.columns)
            if not np.isfinite(self.state.translation_mm).all():
                raise EstimationError("the registration runs away from these shots")
            for _ in range(2):
                _, self.private = refine(self.seen, self.state, self.private)
            self.here = self._linearise()
            if step @ np.linalg.solve(posterior.covariance, step) < TOLERANCE:
                return

    def posterior(self, among: BoolArray) -> Gaussian | None:
        """The step given the kept PMs among those (n,), and aims and priors; None where that is open."""
        use = self.kept & among
        jacobian = self.here.terms.jacobian[0, use].reshape(-1, self.problem.columns.size)
        residual = self.here.terms.residual[0, use].reshape(-1)
        hessian = self.here.prior_hessian + jacobian.T @ jacobian
        return gaussian_of(hessian, self.here.prior_gradient + jacobian.T @ residual, self._scale)

    def _judge(self, kept: BoolArray) -> None:
        """Who is kept, by innovations given those kept (which are at their optimum or nearly)."""
        before, self.kept = self.kept, kept
        posterior = self.posterior(np.ones(self.count, dtype=bool))
        if posterior is None:
            self.kept = before
            return
        terms = self.here.terms
        residual = terms.residual[0] + terms.jacobian[0] @ posterior.mean
        spread = terms.jacobian[0] @ posterior.covariance @ np.swapaxes(terms.jacobian[0], -1, -2)
        spread = np.eye(spread.shape[-1]) + np.where(kept, -1.0, 1.0)[:, None, None] * spread
        nis = np.einsum("na,nab,nb->n", residual, np.linalg.pinv(spread, hermitian=True), residual) + terms.rest[0]
        good = nis < pm_limits(self.seen, junk_p(kept))
        self.kept = good if good.sum() >= MIN_BEFORE else before

    def test(self, settings: MoveSettings) -> MoveTest | None:
        """Whether the camera moved among the last PMs; None where too few came before them."""
        size = min(LAST, self.count - MIN_BEFORE)
        if size < 1:
            return None
        last, old = np.arange(self.count - size, self.count), np.arange(self.count) < self.count - size
        before = self.posterior(old)
        if before is None:
            return None
        tail = select_pms(self.seen, last)
        return check_for_move(
            before,
            white_terms(tail, self.state, private_of(self.seen, self.private, last)),
            settings.learned(self.kept[old]),
            pose=pose_columns(0),
            relinearise=relinearisation(tail, self.state),
        )

    def everything(self) -> Gaussian:
        """The step given all kept PMs."""
        posterior = self.posterior(np.ones(self.count, dtype=bool))
        assert posterior is not None  # _settle raised otherwise
        return posterior
