"""The reduced problem as a sum: what each PM, each aim and the priors add to its cost, gradient and Hessian."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.geometry.transforms import FloatArray, IntArray
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced_blocks import Groups, PrivateState, look_columns, outer, times, transposed
from fgreg.graph.reduced_priors import prior_terms
from fgreg.graph.reduced_system import shared_derivatives, stacked, summed, system_at
from fgreg.graph.shared_state import SharedState


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Rows of m factors, k each: left, right (S, m, k, D), whose products ``left' right`` are parts of Hessians.

    ``part`` (m,): the part of the reduced problem to which each factor belongs.
    """

    part: IntArray
    left: FloatArray
    right: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Contributions:
    """Contributions of n parts to the reduced problem: cost (S, n), gradient (S, n, D) of half of it, and Hessians.

    The Hessians are made where they are wanted: those of all PMs of a long session, by all its variables, are too many
    numbers to keep.
    """

    cost: FloatArray
    gradient: FloatArray
    rows: tuple[_Rows, ...]

    def hessian(self, parts: IntArray | None = None, columns: IntArray | None = None) -> FloatArray:
        """(S, m, K, K) of half the cost of m parts (all where None), by K of the shared variables (all where None)."""
        count = self.cost.shape[1]
        place = np.arange(count)
        if parts is not None:
            place = np.full(count, -1)
            place[parts] = np.arange(len(parts))
            count = len(parts)
        size = self.gradient.shape[-1] if columns is None else len(columns)
        out = np.zeros((len(self.cost), count, size, size))
        for rows in self.rows:
            at, left, right = place[rows.part], rows.left, rows.right
            if parts is not None:
                left, right, at = left[:, at >= 0], right[:, at >= 0], at[at >= 0]
            if columns is not None:
                left, right = left[..., columns], right[..., columns]
            out += summed(Groups.of(at, count), transposed(left) @ right)
        return out

    def single(
        self, parts: IntArray | None = None, columns: IntArray | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cost (m,), gradient (m, K) and Hessian (m, K, K) of the first hypothesis; arguments as of :meth:`hessian`."""
        parts = np.arange(self.cost.shape[1]) if parts is None else parts
        columns = np.arange(self.gradient.shape[2]) if columns is None else columns
        return self.cost[0, parts], self.gradient[0][np.ix_(parts, columns)], self.hessian(parts, columns)[0]

    def total(self, weight: FloatArray | None = None) -> FloatArray:
        """(S, D, D) sum of all parts' Hessians, each times its weight (n,); 1 where None."""
        size = self.gradient.shape[-1]
        out = np.zeros((len(self.cost), size, size))
        for rows in self.rows:
            left = rows.left if weight is None else rows.left * weight[rows.part][:, None, None]
            out += stacked(left, rows.right)
        return out


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """The reduced problem at S hypotheses in parts: contributions of each PM and each aim, and of the priors.

    ``prior_cost`` (S,), ``prior_gradient`` (S, D), ``prior_hessian`` (S, D, D); ``private`` is as in
    :class:`fgreg.graph.reduced_graph.Evaluation`.
    """

    pm: Contributions
    aim: Contributions
    prior_cost: FloatArray
    prior_gradient: FloatArray
    prior_hessian: FloatArray
    private: PrivateState


def contributions(problem: PackedProblem, state: SharedState, private: PrivateState) -> Parts:
    """The terms whose sum is :func:`fgreg.graph.reduced_graph.evaluate`."""
    pms, rig = len(problem.beam_pm), look_columns(problem.columns)
    system = system_at(problem, state, private, derivatives=True)
    by = shared_derivatives(problem, state, system)
    line_gradient = times(transposed(by.line), outer(system.line[:, 0]))
    gradient = summed(system.beams, line_gradient[:, :pms]) + times(transposed(by.h_ps), outer(system.point_step))
    look = np.zeros((state.count, len(problem.look_pm), 3, problem.columns.size))
    look[..., rig] = outer(system.look[:, :, 4:])
    look_gradient = np.einsum("nkis,nks->nis", system.look[:, :, 4:], system.look[:, :, 0])
    gradient[..., rig] += outer(system.looks.sum(look_gradient))
    lines = by.line[:, :pms]
    rows = [
        _Rows(problem.beam_pm, lines, lines),
        _Rows(np.arange(len(problem.pms)), by.h_ps, by.point_gain),
        _Rows(problem.look_pm, look, look),
    ]
    if by.spot.shape[1]:
        gradient += summed(system.spots, times(transposed(by.spot), outer(system.spot)))
        rows.append(_Rows(problem.beam_pm[problem.spots.beam], by.spot, by.spot))
    aims, prior = by.line[:, pms:], prior_terms(problem, state)
    return Parts(
        pm=Contributions(outer(system.pm_cost), gradient, tuple(rows)),
        aim=Contributions(
            outer(system.aim_cost), line_gradient[:, pms:], (_Rows(np.arange(aims.shape[1]), aims, aims),)
        ),
        prior_cost=prior[0],
        prior_gradient=prior[1],
        prior_hessian=prior[2],
        private=system.private,
    )


def pm_columns(problem: PackedProblem, pms: IntArray, *also: int) -> IntArray:
    """(K,) columns of the shared variables on which PMs depend: of the epochs they are in, the beam's and the rig's.

    ``also``: epochs whose columns are wanted even where the PMs are none.
    """
    columns = problem.columns
    epochs = np.union1d(problem.beam_epoch[np.isin(problem.beam_pm, pms)], also).astype(np.int64)
    poses = (6 * epochs[:, None] + np.arange(6)).reshape(-1)
    return np.concatenate([poses, np.arange(columns.beam, columns.size)])


@dataclass(frozen=True, slots=True, eq=False)
class PmGroup:
    """PMs that are seen in the same camera epochs, and the columns of the shared variables on which they depend."""

    pms: IntArray
    columns: IntArray


def pms_by_epochs(problem: PackedProblem) -> tuple[PmGroup, ...]:
    """All PMs of a problem, in groups: one for each epoch, and one for those that are seen in several."""
    count = len(problem.pms)
    if problem.columns.epochs == 1:
        return (PmGroup(np.arange(count), np.arange(problem.columns.size)),)
    epoch = np.zeros(count, dtype=np.int64)
    epoch[problem.beam_pm] = problem.beam_epoch
    several = np.bincount(problem.beam_pm, problem.beam_epoch != epoch[problem.beam_pm], count) > 0
    group = np.where(several, -1, epoch)
    groups = (np.flatnonzero(group == place) for place in np.unique(group))
    return tuple(PmGroup(pms, pm_columns(problem, pms)) for pms in groups)
