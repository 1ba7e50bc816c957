"""A lower bound of the cost over all registrations whose rotation lies in a cell, for many cells at once.

With F the residuals in standard deviations, as a function of the turn theta from the cell's centre, the shift s and
each PM's polar coordinates z, and L its linearisation,

    |F| >= |L| - |e|,     |L|^2 >= min over theta, s, z of |L|^2 + sum of m_k (theta_k^2 - about_k^2)   for any m >= 0,

so (sqrt of that minimum - |e|)^2 is a lower bound, with e a bound on what the linearisation leaves. The minimum is that
of a quadratic: z is eliminated PM by PM, then s, and good multipliers m are found for the 3 x 3 rest.

One PM of which much is left spoils this for all. So it is taken PM by PM as well: for any 0 <= t_j <= 1,

    |F_j|^2 >= (1 - t_j) |L_j|^2 - (1 / t_j - 1) e_j^2

which is (|L_j| - e_j)^2 at t_j = e_j / |L_j|; a PM that may have no residual at all is left out (t_j = 1). The sum is
a quadratic of the same kind, with weights.

e needs bounds on z. Registrations with a larger cost than the ``threshold`` T are of no interest, and each PM's own
terms say that its z lies in an interval. Given an e, |L| <= sqrt(T) + |e|, an ellipsoid that may narrow the intervals,
and so may |L_j| <= sqrt(T) + e_j, with theta and s in the ellipsoid; they are handed on to the parts of a cell. All of
it holds for every s, so no translation is left out.

What is left of a PM's place y, with sup over the intervals (half widths w, rho the largest range):

    y turned     each component of theta (theta' y) / 2 - |theta|^2 y / 2 by itself, squares about their middle, and a
                 term of third order, |theta|^3 |y| / 6;  with the change of y: theta x dy
    y along z    radial: within rho w^2 / 4 of -rho w^2 / 4;  tangential: w_rho w + rho w^3 / 6

and of the looks: of the first one only the rotation, rotation'' w^2 / 2; of others also the range, whose second
derivative by delta is small because the arcs' centres are near each other. A place that is left over costs little
(fgreg.certificate.linearised).

Rounding is not bounded: sums and inverses are of doubles, and a bound counts as one part in 1e11 of its largest term
less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.certificate.conditional import Conditional
from fgreg.certificate.linearised import linearised, middle, remainder
from fgreg.certificate.looks import dot
from fgreg.certificate.quadratic import Minimum, inverse, minimum
from fgreg.certificate.rotations import Reach
from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray
from fgreg.model.sensitivity import arc_of_rotation

_SAFE = 1e-11
SHARE = 0.15
"""Share of the quadratic's growth that pays for what the linearisation leaves, in the sharper bound."""
LEAST_SIZES = (2.0, 0.5)
"""Least |L_j| that the t_j are for, in shares of root of T / J, one after the other."""
LEAST_SHARE, LEAST_WEIGHT = 0.005, 1e-4
"""Of the t_j, and of the 1 - t_j: with no weight at all the sum would have no minimum that doubles can tell."""
_ANYWHERE_MM = 1e9
_LEAST_RANGE_MM = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Intervals:
    """Where the PMs' polar coordinates lie: centres and half widths (3, J, B)."""

    centre: FloatArray
    half: FloatArray

    @property
    def low(self) -> FloatArray:
        return np.asarray(self.centre - self.half)

    @property
    def high(self) -> FloatArray:
        return np.asarray(self.centre + self.half)

    def take(self, index: IntArray) -> Intervals:
        return Intervals(self.centre[..., index], self.half[..., index])

    def within(self, other: Intervals) -> Intervals:
        """The parts that are in the other ones."""
        low, high = np.maximum(self.low, other.low), np.minimum(self.high, other.high)
        return Intervals(0.5 * (low + high), np.maximum(0.5 * (high - low), 1e-12))


@dataclass(frozen=True, slots=True, eq=False)
class Bounds:
    """Of B cells.

    Attributes:
        cost: (B,) lower bounds. possible: (B,) whether a registration within the threshold is possible.
        centre, half: (3, J, B) intervals, narrowed.
        turn: (3, B), shift: (3, B) of the minimum: a registration to start from. In TRUS axes, as all of a cell: the
            turn from its centre R0, and R0 s.
        moved: (6, 6, B) such that theta and R0 s of all registrations within the threshold lie in the ellipsoid of this
            covariance about the minimum.
        centre_shift: (3, B), centre_fit: (3, J, B): R0 s and z of the best fit at the cells' centres, about.
        worth: (3, B) what the bound of |F| gains, about, by a rad that a cell is thinner about each axis.
    """

    cost: FloatArray
    possible: BoolArray
    centre: FloatArray
    half: FloatArray
    turn: FloatArray
    shift: FloatArray
    moved: FloatArray
    centre_shift: FloatArray
    centre_fit: FloatArray
    worth: FloatArray

    def take(self, index: IntArray) -> Bounds:
        """Those of some of the cells."""
        return Bounds(*(getattr(self, name)[..., index] for name in self.__slots__))

    def put(self, index: IntArray, other: Bounds) -> None:
        """Replace those of some of the cells."""
        for name in self.__slots__:
            getattr(self, name)[..., index] = getattr(other, name)

    @classmethod
    def joined(cls, parts: Sequence[Bounds]) -> Bounds:
        """Of all cells of several."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts], axis=-1) for name in cls.__slots__))

    @property
    def intervals(self) -> Intervals:
        return Intervals(self.centre, self.half)


def first_intervals(of: Conditional, threshold: float) -> Intervals | None:
    """(3, J, 1) intervals from each PM's first look alone; None where a PM is nearer to the array than the axis."""
    look = of.first
    if (look.heard_mm <= of.radius_mm).any():
        return None
    within = np.sqrt(threshold)
    xr = look.weight[0, 0] - look.weight[0, 1] ** 2 / look.weight[1, 1]
    rr = look.weight[1, 1] - look.weight[0, 1] ** 2 / look.weight[0, 0]
    turned = within / np.sqrt(look.weight[2, 2])
    low = arc_of_rotation(np.maximum(look.rotation_rad - turned, -np.pi), look.heard_mm, of.radius_mm)
    high = arc_of_rotation(np.minimum(look.rotation_rad + turned, np.pi), look.heard_mm, of.radius_mm)
    x_off, range_off = within / np.sqrt(xr), within / np.sqrt(rr)
    nearest, farthest = np.maximum(look.heard_mm - range_off, 0.0), look.heard_mm + range_off  # ranges are not negative
    centre = np.stack([look.x_mm, 0.5 * (nearest + farthest), 0.5 * (low + high)])
    half = np.stack([x_off, 0.5 * (farthest - nearest), 0.5 * (high - low)])
    return Intervals(centre[..., None], half[..., None])


def lower_bounds(
    of: Conditional,
    rotation: FloatArray,
    reach: Reach,
    known: Intervals,
    threshold: float,
    *,
    pm_by_pm: bool = False,
) -> Bounds:
    """Bounds of cells with centres ``rotation`` (3, 3, B), given ``known`` intervals.

    ``pm_by_pm``: with what is left of each PM weighed by itself as well; takes twice the time.
    """
    z, half = known.centre, known.half
    at = linearised(of, rotation, z, half)
    within = np.sqrt(max(threshold - of.constant, 0.0))
    rest = remainder(of, at, z, half, reach, within, 0.25)
    line, about = at.line, np.einsum("ijb,j->ib", rotation, of.shift)  # about the estimate's s: sums of it would round
    line[:, 9] += np.einsum("mknb,knb->mnb", at.rows, middle(at, rest, reach) - about[:, None])
    pull = np.einsum("minb,mjnb->ijnb", line[:, :3], line[:, 3:])
    pull[:, 6] += at.looks.gradient
    normal = np.einsum("minb,mjnb->ijb", line[:, 3:], line[:, 3:])
    normal[6, 6] += at.looks.chi2.sum(axis=0)
    found = minimum(at.hessian, at.spread, pull, normal, reach)
    least = found.least - _SAFE * normal[6, 6]
    cost = np.maximum(np.sqrt(np.maximum(least, 0.0)) - rest.error, 0.0) ** 2
    slack = (within + rest.error) ** 2 - least
    worth = np.sqrt(np.maximum(found.information, 0.0)) + rest.each / reach.about
    out = _narrowed(found, cost + of.constant, slack, known, rest.offset, worth, threshold)
    index = np.flatnonzero(out.possible)
    if pm_by_pm and len(index):
        parts = _Parts(
            line[:, 3:], pull, at.hessian, at.spread, at.looks.chi2, rest.own, rest.offset, z, half
        ).take(index)  # fmt: skip
        solution = found.solution[:, index]
        out.put(index, _pm_by_pm(parts, solution, reach.take(index), out.take(index), within, of.constant))
    return replace(out, shift=out.shift + about, centre_shift=out.centre_shift + about)


@dataclass(frozen=True, slots=True, eq=False)
class _Parts:
    """Of a linearisation: derivatives (m, 7, J, B) of the lines by theta, s, 1; ``pull`` (3, 7, J, B) of z with these;
    ``hessian`` (3, 3, J, B) of z, ``spread`` its inverse; the looks' ``chi2`` (J, B); what is left of each PM, ``own``
    (J, B), and ``offset`` (3, J, B) of its z; ``centre`` and ``half`` width of the intervals."""

    line: FloatArray
    pull: FloatArray
    hessian: FloatArray
    spread: FloatArray
    chi2: FloatArray
    own: FloatArray
    offset: FloatArray
    centre: FloatArray
    half: FloatArray

    def take(self, index: IntArray) -> _Parts:
        return _Parts(*(getattr(self, name)[..., index] for name in self.__slots__))


def _pm_by_pm(of: _Parts, solution: FloatArray, reach: Reach, out: Bounds, within: float, constant: float) -> Bounds:
    """Bounds with what is left of each PM weighed by itself, from those with all of it at once.

    Args:
        of: the linearisation.
        solution: (6, B) theta and s of its minimum.
        reach, out: of the cells.
        within: root of the threshold less the ``constant``.
    """
    about = Intervals(of.centre, of.half)
    for least_size in LEAST_SIZES:
        shared = np.concatenate([solution, np.ones((1, solution.shape[1]))])
        residual = np.einsum("minb,ib->mnb", of.line, shared)
        pull = np.einsum("kinb,ib->knb", of.pull, shared)
        square = np.einsum("mnb,mnb->nb", residual, residual) + of.chi2
        square -= np.einsum("knb,klnb,lnb->nb", pull, of.spread, pull)
        size = np.maximum(np.sqrt(np.maximum(square, 0.0)), least_size * within / np.sqrt(len(square)))
        share = np.clip(of.own / size, LEAST_SHARE, 1.0 - LEAST_WEIGHT)
        weight = 1.0 - share
        line = of.line * np.sqrt(weight)
        normal = np.einsum("minb,mjnb->ijb", line, line)
        normal[6, 6] += (weight * of.chi2).sum(axis=0)
        found = minimum(of.hessian, of.spread, of.pull, normal, reach, weight)
        loss = ((1.0 / share - 1.0) * of.own**2).sum(axis=0)
        least = found.least - _SAFE * normal[6, 6] - loss
        cost, slack, alone = np.fmax(out.cost, least + constant), within**2 - least, within + of.own
        threshold, before = within**2 + constant, out.intervals
        again = _narrowed(found, cost, slack, about, of.offset, out.worth, threshold, before, alone, weight)
        solution = found.solution
        smaller = np.einsum("iib->b", again.moved[:3, :3]) < np.einsum("iib->b", out.moved[:3, :3])
        for name in ("turn", "shift", "moved", "centre_shift", "centre_fit"):
            getattr(again, name)[..., ~smaller] = getattr(out, name)[..., ~smaller]
        out = replace(again, possible=out.possible & again.possible)
    return out


def sharper_bounds(of: Conditional, rotation: FloatArray, reach: Reach, known: Bounds, threshold: float) -> Bounds:
    """Bounds whose loss is of third order in the size of a cell, from those of :func:`lower_bounds` for the same cells.

    With l the residuals of the best fit at a cell's centre, L = l + J x and e2 the part of e that is of second order,

        |F|^2 >= (1 - SHARE) |J x|^2 + 2 l' J x + |l|^2 + 2 l' e2(x) - (1 / SHARE - 1) |e|^2 - 2 |l' (e - e2)|

    since 2 (J x)' e >= -SHARE |J x|^2 - |e|^2 / SHARE. The second-order terms in x are known, with their signs; they
    couple a PM's z with itself and with theta only, so that the same elimination minimises the right side. Where z
    gives way to e, l is that of the lines at the z to which it does, and x differs by what e moves it.
    """
    z, low, high = known.centre_fit, known.intervals.low, known.intervals.high
    z = np.clip(z, low, high)
    z[1] = np.maximum(z[1], _LEAST_RANGE_MM)
    half = np.maximum(high - z, z - low)
    at = linearised(of, rotation, z, half)
    within = np.sqrt(max(threshold - of.constant, 0.0))
    rest = remainder(of, at, z, half, reach, within, 0.5)
    line, looks = at.line, at.looks
    fit = line[:, 9] + np.einsum("mknb,kb->mnb", line[:, 6:9], known.centre_shift)
    line[:, 9] = fit
    gradient = np.einsum("minb,mnb->inb", line[:, :3], fit) + looks.gradient
    step = np.einsum("ijnb,jnb->inb", at.spread, gradient)
    a = np.einsum("mknb,mnb->knb", at.rows, fit - np.einsum("minb,inb->mnb", line[:, :3], step))
    w, bow, size = half[2], rest.bow, reach.angle
    along, across, pulls = np.abs(dot(a, at.radial)), np.abs(dot(a, at.tangent)), np.sqrt(dot(a, a))
    off, aside = np.maximum(rest.offset[0], rest.offset[1]), rest.offset[2]
    third = np.sqrt(dot(at.y, at.y)) * size**3 / 6.0 + of.stretch[:, None] * (
        size * (bow + rest.sideways)
        + off * (w + aside + 2.0 * size)
        + rest.longest * aside * (w + 0.5 * aside + size)
        + aside * half[1]
    )
    third = pulls * third + along * (0.5 * half[1] * w**2 + rest.longest * w**4 / 24.0)
    third += across * rest.longest * w**3 / 6.0 + looks.pulled
    loss = (1.0 / SHARE - 1.0) * rest.error**2 + 2.0 * third.sum(axis=0)
    loss += size**2 * np.minimum((pulls * rest.moved).sum(axis=0), np.sqrt(np.sum(pulls**2, axis=0)) * rest.all_moved)

    keep = 1.0 - SHARE
    hessian = keep * at.hessian
    hessian[2, 2] -= z[1] * dot(a, at.radial)
    hessian[1, 2] += dot(a, at.tangent)
    hessian[2, 1] = hessian[1, 2]
    pull = np.einsum("minb,mjnb->ijnb", line[:, :3], line[:, 3:])
    pull[:, :6] *= keep
    pull[:, 6] += looks.gradient
    for k in range(3):
        pull[k, :3] += _cross(a, at.by_z[:, k])
    normal = np.einsum("minb,mjnb->ijb", line[:, 3:], line[:, 3:])
    normal[:6, :6] *= keep
    turned = np.einsum("inb,jnb->ijb", a, at.y)
    normal[:3, :3] += 0.5 * (turned + turned.swapaxes(0, 1)) - np.eye(3)[..., None] * np.trace(turned)
    normal[6, 6] += looks.chi2.sum(axis=0)
    found = minimum(hessian, inverse(hessian), pull, normal, reach)
    least = found.least - loss - _SAFE * normal[6, 6]
    sharper = np.where(found.valid, least + of.constant, 0.0)
    slack = threshold - of.constant - least
    cost, about = np.maximum(known.cost, sharper), Intervals(z, half)
    out = _narrowed(found, cost, slack, about, rest.offset, known.worth, threshold, known.intervals)
    return replace(out, shift=out.shift + known.centre_shift, centre_shift=out.centre_shift + known.centre_shift)


def _narrowed(
    found: Minimum,
    cost: FloatArray,
    slack: FloatArray,
    about: Intervals,
    offset: FloatArray,
    worth: FloatArray,
    threshold: float,
    before: Intervals | None = None,
    alone: FloatArray | None = None,
    weight: FloatArray | float = 1.0,
) -> Bounds:
    """Bounds with the intervals of z narrowed to where the quadratic is at most ``slack`` above its minimum.

    ``alone`` (J, B): largest |L| of each PM, which bounds its z where theta and s are given. ``weight``: of the PMs.
    """
    before, slack = before or about, np.maximum(slack, 0.0)
    shared, own = np.where(found.variance >= 0.0, slack * found.variance, np.inf), np.maximum(found.own, 0.0)
    far = np.sqrt(shared + slack * own / np.maximum(weight, _SAFE))
    if alone is not None:
        far = np.minimum(far, np.sqrt(shared) + alone * np.sqrt(own))
    far = np.where(found.valid, far * (1.0 + _SAFE) + offset, np.inf)
    middle = about.centre + np.where(found.valid, found.step, 0.0)
    # What is not a number excludes nothing.
    low, high = np.fmax(before.low, middle - far), np.fmin(before.high, middle + far)
    cost = np.where(np.isnan(cost), 0.0, cost)
    possible = (cost <= threshold) & ~(found.valid & (slack <= 0.0)) & ~(low > high).any(axis=(0, 1))
    return Bounds(
        cost=cost,
        possible=possible,
        centre=0.5 * (low + high),
        half=np.maximum(0.5 * (high - low), 1e-12),
        turn=found.solution[:3],
        shift=found.solution[3:],
        moved=np.where(found.valid, found.covariance * np.maximum(slack, 0.0), _ANYWHERE_MM**2 * np.eye(6)[..., None]),
        centre_shift=found.fixed_shift,
        centre_fit=about.centre + found.fixed_step,
        worth=worth,
    )


def _cross(first: FloatArray, second: FloatArray) -> FloatArray:
    """(3, J, B) cross products, summed over nothing."""
    a, b = first, second
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
