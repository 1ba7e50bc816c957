"""The certificate of one camera epoch's registration: what is proved about all others.

The statement. With the beam, the rig's constants, the inliers, and the beams' covariances as estimated, the windows as
the Gaussians that the optimum has, and all else free (the registration, and each PM in space):

- no registration, of any rotation and any translation, has a chi square of the pairs below ``least``;
- every one whose chi square is within ``within_chi2`` of the estimate's is turned by at most ``within_rad`` from it,
  and moves the middle of the PMs by at most ``within_mm``; and the rotations that were not excluded hang together.

What the pairs pull the beam to is part of the estimate, and a wrong registration pulls it to where it fits. So a second
proof, with the beam as it is without the pairs and covariances at the aims' distance, says where registrations are that
are no worse than the one nearest to the estimate.

The proof is a branch and bound over all rotations (fgreg.certificate.search); rounding is allowed for, not bounded.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fgreg.certificate.bound import Intervals, lower_bounds
from fgreg.certificate.conditional import Conditional, conditional
from fgreg.certificate.rotations import Cells, Reach
from fgreg.certificate.search import Found, angle_between, farthest, search
from fgreg.geometry.transforms import FloatArray, exp_so3, make_transform
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced_blocks import PrivateState
from fgreg.graph.shared_state import SharedState

RELATIVE_GAP, LEAST_GAP = 1e-3, 1e-3
"""Gap up to which the minimum counts as proved: relative to the chi square, and at least as much of it (few pairs fit
exactly, and differences as small are none)."""
FINE_RAD = tuple(np.radians([3.0, 1.5, 0.75]))
"""Cells that may hold another registration are halved to this; to the next one where they are not near enough else."""
APART_RAD = tuple(np.radians([3.2, 1.6, 0.8]))
"""The same with the beam as it is without the pairs."""
NEAR_RAD = np.radians(10.0)
"""Possible registrations farther than this from the estimate, and from each other, are worth a local search."""
ABOUT_RAD = np.radians(30.0)
"""Registrations that may be turned by more than this are no longer about the estimate."""
ABOUT_MM = 50.0
"""Nor those that may be moved by more than this."""
MOST_STARTS = 8
FEW_CELLS = 500
"""Up to as many cells left by the search for others, the search for a better one starts from these."""


@dataclass(frozen=True, slots=True, eq=False)
class WithoutPairs:
    """The optimum near the estimate with the beam held where it is without the pairs.

    ``distance_mm``: usual distance of a spot along the beam, for the beams' covariances. So the cost is nearly the same
    function of the registration whichever estimate is to be certified.
    """

    state: SharedState
    private: PrivateState
    distance_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class Certificate:
    """What was shown of one epoch's registration.

    Attributes:
        cost: chi square of its pairs at the estimate. least: no registration has less.
        within_chi2: of the estimate's chi square, for the rest. within_rad, within_mm: see the module.
        finished: whether the search for others came to its end. connected: whether the rotations that they may have
            then lie about the estimate's and hang together.
        holds_without_pairs: whether, with the beam as it is without the pairs, all registrations that are no worse than
            the one near the estimate are near it as well.
        starts: (n, 4, 4) registrations to start a local search from: far from the estimate, and not excluded.
        looked_at: cells times PMs that were bounded.
    """

    cost: float
    least: float
    within_chi2: float
    within_rad: float
    within_mm: float
    finished: bool
    connected: bool
    holds_without_pairs: bool
    starts: FloatArray
    looked_at: int

    @property
    def gap(self) -> float:
        """Relative gap between the chi square and its lower bound."""
        return max(self.cost - self.least, 0.0) / max(self.cost, LEAST_GAP)

    @property
    def is_least(self) -> bool:
        """Whether the estimate is proved to be the best registration."""
        return self.cost - self.least <= tolerance(self.cost)

    @property
    def is_alone(self) -> bool:
        """Whether all others within the threshold are proved to lie about it."""
        about = self.within_rad <= ABOUT_RAD and self.within_mm <= ABOUT_MM
        return self.connected and about


def tolerance(cost: float) -> float:
    """Chi square by which a lower bound may be below ``cost`` to prove it."""
    return max(RELATIVE_GAP * cost, LEAST_GAP) * (1.0 + 1e-9)


def certify(
    problem: PackedProblem,
    state: SharedState,
    private: PrivateState,
    epoch: int = 0,
    without_pairs: WithoutPairs | None = None,
    *,
    within_chi2: float,
    budget: int,
) -> Certificate | None:
    """The certificate of an epoch's registration.

    Args:
        problem: the inliers. state, private: their optimum (one hypothesis).
        epoch: place of the epoch.
        without_pairs: None where the beam is not known without the pairs.
        within_chi2: see :class:`Certificate`.
        budget: number of cells times PMs to bound at most, in all searches (3 to 8 us each).

    Returns:
        None where a PM is nearer to the array than the array to its axis, which the bounds do not cover.
    """
    of = conditional(problem, state, private, epoch)
    cost = cost_at(of)
    enough = cost - max(RELATIVE_GAP * cost, LEAST_GAP)
    others = _narrowed_to(of, cost + within_chi2, FINE_RAD, budget // 4, lambda found: _are_about(of, found))
    if others is None:
        return None
    few = others.finished and len(others.region.cells) <= FEW_CELLS
    start, spent = (others.region, others.looked_at) if few else (None, 0)
    best = search(of, cost, reach_rad=0.0, budget=budget // 2, enough=enough, start=start, spent=spent)
    assert best is not None
    starts, looked_at, holds = [_starts(of, others, _turned(others))], best.looked_at + others.looked_at, False
    if without_pairs is not None:
        near_by = without_pairs
        there = conditional(problem, near_by.state, near_by.private, epoch, near_by.distance_mm)
        near = _farthest(others) + 2.0 * APART_RAD[0]  # of the minimum there
        again = _narrowed_to(there, cost_at(there), APART_RAD, budget // 4, lambda found: _farthest(found) <= near)
        assert again is not None
        holds = again.finished and _farthest(again) <= near
        looked_at += again.looked_at
        starts.append(_starts(there, again, farthest(again.region.cells, of.rotation @ there.rotation.T)))
    return Certificate(
        cost=cost,
        least=max(best.least, 0.0),
        within_chi2=within_chi2,
        within_rad=_farthest(others),
        within_mm=_shifted(of, others),
        finished=others.finished,
        connected=others.finished and _are_about(of, others),
        holds_without_pairs=holds,
        starts=np.concatenate(starts),
        looked_at=looked_at,
    )


def _narrowed_to(
    of: Conditional, threshold: float, fine: tuple[float, ...], budget: int, are_near: Callable[[Found], bool]
) -> Found | None:
    """Search down to each of the sizes ``fine`` until what is left is near enough, or the budget is used up."""
    found: Found | None = None
    for reach_rad in fine:
        used, start = (0, None) if found is None else (found.looked_at, found.region)
        more = search(of, threshold, reach_rad=reach_rad, budget=budget - used, start=start, spent=used)
        if more is None:
            return None
        found = replace(more, looked_at=used + more.looked_at)
        if not found.finished or are_near(found):
            break
    return found


def cost_at(of: Conditional) -> float:
    """The chi square at the estimate's registration and PMs."""
    point = Intervals(of.polar[..., None], np.full((*of.polar.shape, 1), 1e-12))
    found = lower_bounds(of, of.rotation[..., None], Reach.ball(np.array([1e-12])), point, np.inf)
    return float(found.cost[0])


def _are_about(of: Conditional, others: Found) -> bool:
    """Whether all registrations that are left lie about the estimate, in one region."""
    near = _farthest(others) <= ABOUT_RAD and _shifted(of, others) <= ABOUT_MM
    return near and _hang_together(others.region.cells)


def _farthest(others: Found) -> float:
    return float(_turned(others).max(initial=0.0))


def _turned(others: Found) -> FloatArray:
    """(n,) rad: how far from the estimate rotations in each cell are, at most."""
    cells, bounds = others.region.cells, others.region.bounds
    spread = np.linalg.eigvalsh(bounds.moved[:3, :3].transpose(2, 0, 1))[:, -1]
    middle = angle_between(exp_so3(bounds.turn.T) @ cells.rotation, np.eye(3))
    return np.asarray(np.minimum(farthest(cells), middle + np.sqrt(np.maximum(spread, 0.0))))


def _shifted(of: Conditional, others: Found) -> float:
    """How far the middle of the PMs moves, at most: |s - s of the estimate|, mm."""
    bounds = others.region.bounds
    if not len(bounds.cost):
        return 0.0
    spread = np.linalg.eigvalsh(bounds.moved[3:, 3:].transpose(2, 0, 1))[:, -1]
    centres = others.region.cells.rotation @ of.rotation
    off = np.linalg.norm(bounds.shift.T - centres @ of.shift, axis=1)
    return float((off + np.sqrt(np.maximum(spread, 0.0))).max())


def _hang_together(cells: Cells) -> bool:
    """Whether all cells are connected, through each other, with the one nearest to the estimate."""
    apart = np.ones(len(cells), dtype=bool)
    front = np.argsort(farthest(cells) - cells.reach_rad)[:1]
    while len(front):
        apart[front] = False
        left = np.flatnonzero(apart)
        cosine = np.abs(cells.quaternion[left] @ cells.quaternion[front].T)
        angle = 2.0 * np.arccos(np.minimum(cosine, 1.0))
        front = left[(angle <= cells.reach_rad[left, None] + cells.reach_rad[front]).any(axis=1)]
    return not apart.any()


def _starts(of: Conditional, others: Found, away: FloatArray) -> FloatArray:
    """Registrations in cells far from the estimate and from each other, the farthest first."""
    cells, bounds = others.region.cells, others.region.bounds
    chosen: list[int] = []
    distance = away - cells.reach_rad
    while len(chosen) < MOST_STARTS and len(cells) and distance.max() > NEAR_RAD:
        index = int(np.argmax(distance))
        chosen.append(index)
        distance = np.minimum(distance, farthest(cells, cells.rotation[index]) - cells.reach_rad)
    out = np.zeros((len(chosen), 4, 4))
    for row, index in enumerate(chosen):
        turn, centre = exp_so3(bounds.turn[:, index]), cells.rotation[index] @ of.rotation
        out[row] = make_transform(turn @ centre, turn @ bounds.shift[:, index] + of.pivot)
    return out
