"""A lower bound of the cost over all registrations whose rotation lies in a cell, for many cells at once.

With F the residuals in standard deviations, as a function of the turn omega from the cell's centre, the shift s and
each PM's polar coordinates z, and L its linearisation,

    |F| >= |L| - |e|,     |L|^2 >= min over omega, s, z of |L|^2 + mu (|omega|^2 - reach^2)   for any mu >= 0,

so (sqrt of that minimum - |e|)^2 is a lower bound, with e a bound on what the linearisation leaves. The minimum is that
of a quadratic: z is eliminated PM by PM, then s, and the best mu is found along the eigenvectors of the 3 x 3 rest.

e needs bounds on z. Registrations with a larger cost than the ``threshold`` T are of no interest, and each PM's own
terms say that its z lies in an interval. Given an e, |L| <= sqrt(T) + |e|, an ellipsoid that may narrow the intervals;
they are handed on to the parts of a cell. All of it holds for every s, so no translation is left out.

What is left, with sup over the intervals (half widths w, rho the largest range):

    R'p turned   (Exp(-omega) - 1 + hat(omega)) y: for |omega| <= reach within reach^2 |y| / 4 of -reach^2 y / 4, and a
                 term of third order, reach^3 |y| / 6;  with the change of p: reach |dp|
    p along z    radial: within rho w^2 / 4 of -rho w^2 / 4;  tangential: w_rho w + rho w^3 / 6
    looks        of the first look only the rotation, rotation'' w^2 / 2; of others also the range, whose second
                 derivative by delta is small because the arcs' centres are near each other

Rounding is not bounded: sums and inverses are of doubles, and a bound counts as one part in 1e11 of its largest term
less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.certificate.conditional import Conditional
from fgreg.certificate.looks import LookParts, dot, look_parts
from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray
from fgreg.model.sensitivity import arc_of_rotation

_SAFE = 1e-11
_NEWTON = 6
"""Steps for mu: any mu gives a bound."""
SHARE = 0.15
"""Share of the quadratic's growth that pays for what the linearisation leaves, in the sharper bound."""
_WEAKEST = 1e-6
"""Of the information on the shift, its least part: below (beams parallel to 0.05 deg) rounding would make a bound."""
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


@dataclass(frozen=True, slots=True, eq=False)
class Bounds:
    """Of B cells.

    Attributes:
        cost: (B,) lower bounds. possible: (B,) whether a registration within the threshold is possible.
        centre, half: (3, J, B) intervals, narrowed.
        turn: (3, B), shift: (3, B) of the minimum: a registration to start from.
        moved: (6, 6, B) such that omega and s of every registration within the threshold lie in the ellipsoid of this
            covariance about the minimum.
        centre_shift: (3, B), centre_fit: (3, J, B): s and z of the best fit at the cells' centres, about.
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
    of: Conditional, rotation: FloatArray, reach: FloatArray, known: Intervals, threshold: float
) -> Bounds:
    """Bounds of cells with centres ``rotation`` (3, 3, B) and ``reach`` (B,) rad, given ``known`` intervals."""
    z, half = known.centre, known.half
    at = _linearised(of, rotation, z, half)
    longest = z[1] + half[1]
    sagitta = 0.25 * longest * half[2] ** 2
    expected = -0.25 * reach**2 * at.y - at.radial * sagitta
    line = at.line
    line[:, 9] += np.einsum("min,inb->mnb", of.rows, expected)
    left = at.strength * (0.25 * reach**2 * at.length + at.cubic * reach**3)
    left += at.along * sagitta + at.across * at.sideways
    error = np.sqrt((left**2 + at.looks.error2).sum(axis=0))
    error += reach * _together(at, at.strength, within := np.sqrt(max(threshold - of.constant, 0.0)))

    hessian = np.einsum("minb,mjnb->ijnb", line[:, :3], line[:, :3]) + at.looks.hessian
    pull = np.einsum("minb,mjnb->ijnb", line[:, :3], line[:, 3:])
    pull[:, 6] += at.looks.gradient
    normal = np.einsum("minb,mjnb->ijb", line[:, 3:], line[:, 3:])
    normal[6, 6] += at.looks.chi2.sum(axis=0)
    found = _minimum(hessian, pull, normal, reach)
    cost = np.maximum(np.sqrt(np.maximum(found.least - _SAFE * normal[6, 6], 0.0)) - error, 0.0) ** 2 + of.constant
    slack = (within + error) ** 2 - found.least
    return _narrowed(found, cost, slack, known, threshold)


def sharper_bounds(of: Conditional, rotation: FloatArray, reach: FloatArray, known: Bounds, threshold: float) -> Bounds:
    """Bounds whose loss is of third order in the size of a cell, from those of :func:`lower_bounds` for the same cells.

    With l the residuals of the best fit at a cell's centre, L = l + J x and e2 the part of e that is of second order,

        |F|^2 >= (1 - SHARE) |J x|^2 + 2 l' J x + |l|^2 + 2 l' e2(x) - (1 / SHARE - 1) |e|^2 - 2 |l' (e - e2)|

    since 2 (J x)' e >= -SHARE |J x|^2 - |e|^2 / SHARE. The second-order terms in x are known, with their signs; they
    couple a PM's z with itself and with omega only, so that the same elimination minimises the right side.
    """
    z, low, high = known.centre_fit, known.intervals.low, known.intervals.high
    z = np.clip(z, low, high)
    z[1] = np.maximum(z[1], _LEAST_RANGE_MM)
    half = np.maximum(high - z, z - low)
    at = _linearised(of, rotation, z, half)
    line, looks = at.line, at.looks
    fit = line[:, 9] + np.einsum("mknb,kb->mnb", line[:, 6:9], known.centre_shift)
    line[:, 9] = fit
    a = np.einsum("min,mnb->inb", of.rows, fit)
    longest, w = z[1] + half[1], half[2]
    along, across, size = np.abs(dot(a, at.radial)), np.abs(dot(a, at.tangent)), np.sqrt(dot(a, a))
    bow = 0.5 * longest * w**2
    second = of.stretch[:, None] * (bow + at.sideways)
    third = size * (at.cubic * reach**3 + reach * second)
    third += along * (0.5 * half[1] * w**2 + longest * w**4 / 24.0) + across * longest * w**3 / 6.0
    third += looks.pulled
    left = at.strength * (0.5 * reach**2 * at.length + at.cubic * reach**3)
    left += at.along * bow + at.across * at.sideways
    within = np.sqrt(max(threshold - of.constant, 0.0))
    error = np.sqrt((left**2 + looks.error2).sum(axis=0)) + reach * _together(at, at.strength, within)
    loss = (1.0 / SHARE - 1.0) * error**2 + 2.0 * third.sum(axis=0)
    loss += reach**2 * np.minimum(
        (size * at.moved).sum(axis=0), np.sqrt(np.sum(size**2, axis=0)) * _together(at, 1.0, within)
    )

    keep = 1.0 - SHARE
    hessian = keep * (np.einsum("minb,mjnb->ijnb", line[:, :3], line[:, :3]) + looks.hessian)
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
    found = _minimum(hessian, pull, normal, reach)
    sharper = np.where(found.valid, found.least - loss - _SAFE * normal[6, 6] + of.constant, 0.0)
    slack = threshold - of.constant - found.least + loss
    cost, about = np.maximum(known.cost, sharper), Intervals(z, half)
    out = _narrowed(found, cost, slack, about, threshold, known.intervals)
    return replace(out, shift=out.shift + known.centre_shift, centre_shift=out.centre_shift + known.centre_shift)


def _together(at: _Linearised, factor: FloatArray | float, within: float) -> FloatArray:
    """(B,) root of the sum of squares of how far the PMs move, times a factor, at most.

    Each moves within its intervals. All together they move less: the first looks' chi squares add up to at most
    ``within`` squared, and move them off where they are now, ``at.looks.off`` from what was measured.
    """
    alone = np.sqrt(np.sum((factor * at.moved) ** 2, axis=0))
    return np.asarray(np.minimum(alone, (factor * at.per_sigma).max(axis=0) * (within + at.looks.off)))


@dataclass(frozen=True, slots=True, eq=False)
class _Linearised:
    """The residuals at z, with half widths of the intervals about it.

    Attributes:
        line: (m, 10, J, B) derivatives by z, omega, s, and the residual, across the beams.
        y, radial, tangent: (3, J, B) the PM less the pivot and directions, camera axes. by_z: (3, 3, J, B) of y.
        length: of y. moved: how far the PM moves within its interval, at most. per_sigma: how far, at most, while its
            first look's residuals change by one standard deviation. sideways: second order of its tangential
            part. cubic: |y| / 6.
        strength, along, across: by how much a mm in any direction, radially, tangentially changes the residual.
    """

    line: FloatArray
    y: FloatArray
    radial: FloatArray
    tangent: FloatArray
    by_z: FloatArray
    length: FloatArray
    moved: FloatArray
    per_sigma: FloatArray
    sideways: FloatArray
    cubic: FloatArray
    strength: FloatArray
    along: FloatArray
    across: FloatArray
    looks: LookParts


def _linearised(of: Conditional, rotation: FloatArray, z: FloatArray, half: FloatArray) -> _Linearised:
    sine, cosine = np.sin(z[2]), np.cos(z[2])
    longest = z[1] + half[1]
    in_camera = np.einsum("kib,kjn->ijnb", rotation, of.from_array)
    x_axis = in_camera[:, 0]
    radial = in_camera[:, 1] * sine + in_camera[:, 2] * cosine
    tangent = in_camera[:, 1] * cosine - in_camera[:, 2] * sine
    y = np.einsum("kib,kn->inb", rotation, of.origin) + x_axis * z[0] + radial * z[1]
    by_z = np.stack([x_axis, radial, tangent * z[1]], axis=1)
    length = np.sqrt(dot(y, y))
    rows, stretch = of.rows[..., None], of.stretch[:, None]
    look = of.first
    # The rotation changes least with delta where delta is 0.
    turns = np.sqrt(look.weight[2, 2]) * look.heard_mm / (look.heard_mm + of.radius_mm)
    line = np.empty((len(of.rows), 10, *length.shape))
    line[:, :3] = np.einsum("min,ijnb->mjnb", of.rows, by_z)
    for i in range(3):  # y x omega
        j, k = (i + 1) % 3, (i + 2) % 3
        line[:, 3 + i] = rows[:, j] * y[k] - rows[:, k] * y[j]
    line[:, 6:9] = -rows
    line[:, 9] = np.einsum("min,inb->mnb", of.rows, y) + of.offset[..., None]
    return _Linearised(
        line=line,
        y=y,
        radial=radial,
        tangent=tangent,
        by_z=by_z,
        length=length,
        moved=np.sqrt(half[0] ** 2 + half[1] ** 2 + (longest * half[2]) ** 2) * stretch,
        per_sigma=np.maximum(of.plane_sigma_mm[:, None], longest / turns[:, None]) * stretch,
        sideways=half[1] * half[2] + longest * half[2] ** 3 / 6.0,
        cubic=length / 6.0,
        strength=of.strength[:, None],
        along=np.sqrt(np.square(line[:, 1]).sum(axis=0)),
        across=np.sqrt(np.square(line[:, 2]).sum(axis=0)) / z[1],
        looks=look_parts(of, z, half),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Minimum:
    """The least value (B,) of a quadratic in (z, omega, s) with |omega| <= reach, from below, and what led to it.

    ``solution`` (6, B) and ``covariance`` (6, 6, B) of (omega, s); ``step`` (3, J, B) and ``variance`` of z; of the
    minimum with omega = 0: ``fixed_shift`` (3, B), ``fixed_step`` (3, J, B). ``valid`` (B,): whether it has a minimum.
    """

    least: FloatArray
    valid: BoolArray
    solution: FloatArray
    covariance: FloatArray
    step: FloatArray
    variance: FloatArray
    fixed_shift: FloatArray
    fixed_step: FloatArray


def _minimum(hessian: FloatArray, pull: FloatArray, normal: FloatArray, reach: FloatArray) -> _Minimum:
    """Minimise the quadratic of ``hessian`` (3, 3, J, B) of z, ``pull`` (3, 7, J, B) of z with (omega, s, 1), and
    ``normal`` (7, 7, B) of (omega, s, 1)."""
    spread = _inverse(hessian)
    gain = np.einsum("ijnb,jknb->iknb", spread, pull)
    n = normal - np.einsum("kinb,kjnb->ijb", pull, gain)
    weak = _WEAKEST * np.trace(n[3:6, 3:6]) * np.eye(3)[..., None]
    valid = _is_positive(hessian).all(axis=0) & _is_positive(n[3:6, 3:6] - weak)
    n = np.where(valid, n, np.eye(7)[..., None])  # of those without a minimum nothing is used
    n = np.ascontiguousarray(n.transpose(2, 0, 1))
    inner, across = n[:, 3:6, 3:6], n[:, :, 3:6]
    inverse = np.linalg.inv(inner)
    schur = n - across @ inverse @ np.swapaxes(across, 1, 2)
    values, vectors = np.linalg.eigh(schur[:, :3, :3])
    g2 = np.square(np.einsum("bij,bi->bj", vectors, schur[:, :3, 6]))
    least_mu = np.maximum(1e-9 * (1.0 + np.abs(values).max(axis=1)) - values[:, 0], 0.0)
    mu, square = least_mu.copy(), reach**2
    for _ in range(_NEWTON):  # |omega(mu)| = reach; 1 / |omega| is nearly linear in mu
        size = np.sum(g2 / (values + mu[:, None]) ** 2, axis=1) + 1e-300
        slope = np.sum(g2 / (values + mu[:, None]) ** 3, axis=1) + 1e-300
        mu = np.maximum(mu + size / slope * (np.sqrt(size / square) - 1.0), least_mu)
    least = schur[:, 6, 6] - np.sum(g2 / (values + mu[:, None]), axis=1) - mu * square
    held = n[:, :6, :6].copy()
    held[:, np.arange(3), np.arange(3)] += mu[:, None]
    covariance = np.linalg.inv(held)
    solution = -(covariance @ n[:, :6, 6:])[..., 0].T
    covariance = covariance.transpose(1, 2, 0)
    shift = -(inverse @ n[:, 3:6, 6:])[..., 0].T
    variance = np.einsum("iinb->inb", spread) + np.einsum("iknb,klb,ilnb->inb", gain[:, :6], covariance, gain[:, :6])
    return _Minimum(
        least=np.where(valid, least, 0.0),
        valid=valid,
        solution=solution,
        covariance=covariance,
        step=-(gain[:, 6] + np.einsum("iknb,kb->inb", gain[:, :6], solution)),
        variance=variance,
        fixed_shift=shift,
        fixed_step=-(gain[:, 6] + np.einsum("iknb,kb->inb", gain[:, 3:6], shift)),
    )


def _narrowed(
    found: _Minimum,
    cost: FloatArray,
    slack: FloatArray,
    about: Intervals,
    threshold: float,
    before: Intervals | None = None,
) -> Bounds:
    """Bounds with the intervals of z narrowed to where the quadratic is at most ``slack`` above its minimum."""
    before = before or about
    far = np.sqrt(np.maximum(slack, 0.0) * np.maximum(found.variance, 0.0)) * (1.0 + _SAFE)
    far = np.where(found.valid, far, np.inf)
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
    )


def _cross(first: FloatArray, second: FloatArray) -> FloatArray:
    """(3, J, B) cross products, summed over nothing."""
    a, b = first, second
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _is_positive(matrix: FloatArray) -> BoolArray:
    """Whether symmetric (3, 3, ...) matrices are positive definite, by their leading minors."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    second = a * d - b * b
    return np.asarray((a > 0.0) & (second > 0.0) & (f * second + 2.0 * b * c * e - a * e * e - d * c * c > 0.0))


def _inverse(matrix: FloatArray) -> FloatArray:
    """Inverses of symmetric (3, 3, ...) matrices by cofactors."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    out = np.empty_like(matrix)
    first, second, third = d * f - e * e, c * e - b * f, b * e - c * d
    out[0, 0] = first
    out[0, 1] = out[1, 0] = second
    out[0, 2] = out[2, 0] = third
    out[1, 1] = a * f - c * c
    out[1, 2] = out[2, 1] = b * c - a * e
    out[2, 2] = a * d - b * b
    out /= a * first + b * second + c * third
    return out
