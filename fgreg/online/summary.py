"""Older shots, summed up: chunks of packed measurements, each with its quadratic on the shared variables.

A chunk is linearised at a state of its own, with everything private at its optimum there, and can be linearised again
where the estimate has gone. An epoch that is over is its chunks; its registration is eliminated, so that what is left
of it is a quadratic on what the epochs share, and on the next registration where a measured motion ties the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from fgreg.factors.epoch_change import epoch_change_factor
from fgreg.frames import BoolArray, FloatArray, IntArray, inverse
from fgreg.graph.columns import Columns
from fgreg.graph.explicit import Variable
from fgreg.graph.packing import BeamArrays, LookArrays, PackedProblem
from fgreg.graph.reduced import Contributions, Parts, contributions, refine
from fgreg.graph.reduced_blocks import PrivateState, initial_private
from fgreg.graph.shared_state import SharedState, step_between
from fgreg.measurements import POSE_FLOOR, EpochStart, usable_covariance
from fgreg.online.shared import Quadratic

CHUNK = 64
"""PMs in a chunk that is full."""
FAR_RAD = 5e-3
"""Turn beyond which a sum of quadratics is formed anew about a state near by, rather than carried on."""
WANDERS_MM, WANDERING_CHI2 = 1.0, 1e4
"""As in fgreg.robust: a PM that moves by more in one step, after several, has no place that fits."""
UNSEEN = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """Shots of one epoch (or aims), linearised together.

    Attributes:
        places: of the pairs, (L,), in the session's order of pairs; of the aims, (A,), in theirs.
        problem: them packed, in one epoch, without priors.
        kept: (J,) PMs that count, or (A,) aims.
        private: at their optimum for the quadratic's state.
        quadratic: of those kept.
        count: how many are kept.
    """

    places: IntArray
    problem: PackedProblem
    kept: BoolArray
    private: PrivateState
    quadratic: Quadratic
    count: int


def without_priors(problem: PackedProblem) -> PackedProblem:
    """The problem's shots alone."""
    return replace(problem, links=(), prior_information=np.zeros_like(problem.prior_information), shapes=None)


def joined(first: PackedProblem, second: PackedProblem) -> PackedProblem:
    """The pairs of two problems of the same epoch and no PM in common."""
    shift, beams = len(first.pms), len(first.beam_pm)
    return replace(
        first,
        pms=first.pms + second.pms,
        beam_pm=np.concatenate([first.beam_pm, second.beam_pm + shift]),
        beam_epoch=np.concatenate([first.beam_epoch, second.beam_epoch]),
        beams=BeamArrays(*(_both(first.beams, second.beams, name) for name in BeamArrays.__slots__)),
        look_pm=np.concatenate([first.look_pm, second.look_pm + shift]),
        look_beam=np.concatenate([first.look_beam, second.look_beam + beams]),
        looks=LookArrays(*(_both(first.looks, second.looks, name) for name in LookArrays.__slots__)),
    )


def without_pms(problem: PackedProblem, leave: IntArray) -> tuple[PackedProblem, IntArray, IntArray]:
    """The problem without some PMs (places); and which of its looks and beams are left."""
    stay = np.ones(len(problem.pms), dtype=bool)
    stay[leave] = False
    number = np.cumsum(stay) - 1
    looks, beams = np.flatnonzero(stay[problem.look_pm]), np.flatnonzero(stay[problem.beam_pm])
    beam_number = np.zeros(len(problem.beam_pm), dtype=np.int64)
    beam_number[beams] = np.arange(len(beams))
    return (
        replace(
            problem,
            pms=tuple(pm for pm, here in zip(problem.pms, stay, strict=True) if here),
            beam_pm=number[problem.beam_pm[beams]],
            beam_epoch=problem.beam_epoch[beams],
            beams=BeamArrays(*(getattr(problem.beams, name)[beams] for name in BeamArrays.__slots__)),
            look_pm=number[problem.look_pm[looks]],
            look_beam=beam_number[problem.look_beam[looks]],
            looks=LookArrays(*(getattr(problem.looks, name)[looks] for name in LookArrays.__slots__)),
        ),
        looks,
        beams,
    )


def _both(first: object, second: object, name: str) -> FloatArray:
    return np.concatenate([getattr(first, name), getattr(second, name)])


def joined_private(first: PrivateState, second: PrivateState) -> PrivateState:
    """Private variables of :func:`joined` problems."""
    return PrivateState(
        *(np.concatenate([getattr(first, n), getattr(second, n)], axis=1) for n in PrivateState.__slots__)
    )


def settled(
    problem: PackedProblem, state: SharedState, private: PrivateState | None = None, *, rounds: int = 3
) -> Parts:
    """The problem's parts at a state, private variables at their optimum (from the arcs where None are given).

    A PM that still wanders counts as far off, whatever it passes on its way.
    """
    private = initial_private(problem, state) if private is None else private
    with np.errstate(all="ignore"):  # far from everything numbers may overflow: who sums them up looks at them
        for _ in range(rounds):
            _, private = refine(problem, state, private)
        return _honest(contributions(problem, state, private), private)


def _honest(parts: Parts, before: PrivateState) -> Parts:
    wanders = np.linalg.norm(parts.private.trus_p_pm - before.trus_p_pm, axis=-1) > WANDERS_MM
    if not wanders.any():
        return parts
    cost = np.where(wanders, np.maximum(parts.pm.cost, WANDERING_CHI2), parts.pm.cost)
    return replace(parts, pm=replace(parts.pm, cost=cost))


def with_more(chunk: Chunk, more: Chunk, columns: Columns) -> Chunk:
    """A chunk with more PMs of its epoch that are linearised already; its own stay linearised where they are."""
    state = more.quadratic.state
    return Chunk(
        np.concatenate([chunk.places, more.places]),
        joined(chunk.problem, more.problem),
        np.concatenate([chunk.kept, more.kept]),
        joined_private(chunk.private, more.private),
        chunk.quadratic.at(state, columns).plus(more.quadratic),
        chunk.count + more.count,
    )


def shots_of(chunk_problem: PackedProblem, parts: Parts) -> Contributions:
    """What the chunk's shots add, PMs or aims."""
    return parts.pm if len(chunk_problem.pms) else parts.aim


def make_chunk(
    places: IntArray,
    problem: PackedProblem,
    kept: BoolArray,
    state: SharedState,
    private: PrivateState | None = None,
    *,
    rounds: int = 3,
) -> Chunk:
    """Linearise shots at a state.

    Raises:
        ArithmeticError: a number is not finite.
    """
    return chunk_of(places, problem, kept, state, settled(problem, state, private, rounds=rounds))


def chunk_of(places: IntArray, problem: PackedProblem, kept: BoolArray, state: SharedState, parts: Parts) -> Chunk:
    """The chunk of shots whose parts at a state are known."""
    part, weight = shots_of(problem, parts), kept.astype(np.float64)
    cost = float(np.where(kept, part.cost[0], 0.0).sum())
    gradient = np.where(kept[:, None], part.gradient[0], 0.0).sum(axis=0)
    hessian = np.einsum("n,nab->ab", weight, np.where(kept[:, None, None], part.hessian[0], 0.0))
    if not (np.isfinite(cost) and np.isfinite(gradient).all() and np.isfinite(hessian).all()):
        raise ArithmeticError("the summary of older shots is not finite")
    return Chunk(places, problem, kept, parts.private, Quadratic(state, cost, gradient, hessian), int(kept.sum()))


Tally = tuple[int, int, int]
"""PMs that count, PMs, looks that count."""


def tally_of(chunk: Chunk) -> Tally:
    """Of one chunk of pairs."""
    # One look a PM is the rule, and then no array needs to be looked at.
    single = len(chunk.problem.look_pm) == len(chunk.kept)
    return chunk.count, len(chunk.kept), chunk.count if single else int(chunk.kept[chunk.problem.look_pm].sum())


def plus_tally(one: Tally, other: Tally, times: int = 1) -> Tally:
    """Sum, or difference."""
    return one[0] + times * other[0], one[1] + times * other[1], one[2] + times * other[2]


@dataclass(frozen=True, slots=True, eq=False)
class Shelf:
    """The chunks of one epoch: those that are full, with the sum of their quadratics, and the open one.

    ``total`` is about a state of its own; replacing a chunk replaces its share of it. ``tally``: of the full ones.
    """

    full: tuple[Chunk, ...] = ()
    total: Quadratic | None = None
    open: Chunk | None = None
    tally: Tally = (0, 0, 0)

    @property
    def counts(self) -> Tally:
        """Of all of them; takes no longer the more there are."""
        return self.tally if self.open is None else plus_tally(self.tally, tally_of(self.open))

    @property
    def chunks(self) -> tuple[Chunk, ...]:
        """All of them."""
        return self.full if self.open is None else (*self.full, self.open)

    def with_open(self, chunk: Chunk | None, columns: Columns) -> Shelf:
        """With another open chunk, shelved at once where it is full."""
        if chunk is None or len(chunk.problem.pms) < CHUNK:
            return replace(self, open=chunk)
        own = chunk.quadratic
        added = own if self.total is None else self.total.plus(own.at(self.total.state, columns))
        return Shelf((*self.full, chunk), added, None, plus_tally(self.tally, tally_of(chunk)))

    def with_full(self, place: int, chunk: Chunk, columns: Columns) -> Shelf:
        """With another chunk in place of a full one."""
        if self.total is None:
            raise ValueError("no chunk is full")
        full = (*self.full[:place], chunk, *self.full[place + 1 :])
        tally = plus_tally(plus_tally(self.tally, tally_of(chunk)), tally_of(self.full[place]), -1)
        at = chunk.quadratic.state
        if np.abs(step_between(self.total.state, at, columns)[0, :3]).max() > FAR_RAD:
            return Shelf(full, summed([c.quadratic for c in full], at, columns), self.open, tally)
        here = self.total.state
        old, new = self.full[place].quadratic.at(here, columns), chunk.quadratic.at(here, columns)
        total = Quadratic(
            here,
            self.total.cost - old.cost + new.cost,
            self.total.gradient - old.gradient + new.gradient,
            self.total.hessian - old.hessian + new.hessian,
        )
        return Shelf(full, total, self.open, tally)

    def about(self, state: SharedState, columns: Columns) -> Quadratic:
        """Sum of all about a state."""
        parts = [self.total] if self.total is not None else []
        if self.open is not None:
            parts.append(self.open.quadratic)
        return summed(parts, state, columns)


def summed(quadratics: Sequence[Quadratic], state: SharedState, columns: Columns) -> Quadratic:
    """Sum of quadratics about a state."""
    out = Quadratic(state, 0.0, np.zeros(columns.size), np.zeros((columns.size, columns.size)))
    for quadratic in quadratics:
        out = out.plus(quadratic.at(state, columns))
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Elimination:
    """A finished epoch's registration given what comes after: ``step = offset + gain * later`` from ``state``.

    ``later``: the step of the next registration (6, zero columns where not tied) and of the common variables.
    """

    state: SharedState
    next_state: SharedState
    offset: FloatArray
    gain: FloatArray


def passed_on(
    quadratic: Quadratic, start_of_next: EpochStart, next_state: SharedState, columns: Columns
) -> tuple[Quadratic, Elimination]:
    """What a finished epoch says about the next one's shared variables, its own registration eliminated.

    Args:
        quadratic: all that is known of the epoch's shared variables, earlier epochs included.
        start_of_next: with the measured motion that ties the two, or none.
        next_state: shared variables of the next epoch; the common ones are the quadratic's.
        columns: of one epoch.
    """
    size = columns.size
    # Variables: the old registration (6), the next one (6), the common ones.
    hessian, gradient = np.zeros((size + 6, size + 6)), np.zeros(size + 6)
    mine = np.r_[0:6, 12 : size + 6]
    hessian[np.ix_(mine, mine)], gradient[mine] = quadratic.hessian, quadratic.gradient
    cost = quadratic.cost
    motion, covariance = start_of_next.camera_new_T_camera_old, start_of_next.covariance
    if motion is not None and covariance is not None:
        old, new = Variable.trus_T_camera.key(0), Variable.trus_T_camera.key(1)
        values = gtsam.Values()
        values.insert(old, gtsam.Pose3(quadratic.state.trus_T_camera()[0]))
        values.insert(new, gtsam.Pose3(next_state.trus_T_camera()[0]))
        linear = epoch_change_factor(old, new, motion, usable_covariance(covariance, POSE_FLOOR)).linearize(values)
        jacobian, right = linear.jacobian()
        order = np.r_[0:6, 6:12] if linear.keys()[0] == old else np.r_[6:12, 0:6]
        jacobian = jacobian[:, order]
        hessian[:12, :12] += jacobian.T @ jacobian
        gradient[:12] -= jacobian.T @ right
        cost += float(right @ right)
    own, cross = hessian[:6, :6], hessian[:6, 6:]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(own), 1e-30))
    # Pseudo-inverse: an epoch of one or two pairs leaves directions of its registration open.
    back = np.linalg.pinv(own * np.outer(scale, scale), rcond=UNSEEN, hermitian=True) * np.outer(scale, scale)
    gain, offset = -back @ cross, -back @ gradient[:6]
    left = hessian[6:, 6:] + cross.T @ gain
    passed = Quadratic(
        next_state, cost + float(gradient[:6] @ offset), gradient[6:] + cross.T @ offset, 0.5 * (left + left.T)
    )
    return passed, Elimination(quadratic.state, next_state, offset, gain)


def carried_over(state: SharedState, start: EpochStart) -> SharedState:
    """The shared variables of a new epoch: its registration by the measured motion, else as it was."""
    motion = start.camera_new_T_camera_old
    if motion is None:
        return state
    moved_pose = state.trus_T_camera()[0] @ inverse(motion)
    rotation, translation_mm = moved_pose[None, None, :3, :3].copy(), moved_pose[None, None, :3, 3].copy()
    return replace(state, rotation=rotation, translation_mm=translation_mm)
