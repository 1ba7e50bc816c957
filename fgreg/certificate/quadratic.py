"""The least value of a quadratic in the PMs' polar coordinates, a turn within a cell and a free shift, from below."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.certificate.rotations import Reach
from fgreg.geometry.transforms import BoolArray, FloatArray

_NEWTON = 3
_BOX_STEPS = 2
"""Steps for the multipliers: any give a bound."""
_EYE = np.eye(3)[..., None]
_WEAKEST = 1e-6
"""Of the information on the shift, its least part: below (beams parallel to 0.05 deg) rounding would make a bound."""


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """The least value (B,) of a quadratic in (z, theta, s) with theta in a cell, from below, and what led to it.

    ``solution`` (6, B) and ``covariance`` (6, 6, B) of (theta, s); ``step`` (3, J, B) of z, its ``variance`` that is
    due to (theta, s), and its ``own`` with these given; of the minimum with theta = 0: ``fixed_shift`` (3, B),
    ``fixed_step`` (3, J, B). ``valid`` (B,): whether it has a minimum.
    ``information`` (3, B): on theta about each axis.
    """

    least: FloatArray
    valid: BoolArray
    solution: FloatArray
    covariance: FloatArray
    step: FloatArray
    variance: FloatArray
    own: FloatArray
    fixed_shift: FloatArray
    fixed_step: FloatArray
    information: FloatArray


def minimum(
    hessian: FloatArray,
    spread: FloatArray,
    pull: FloatArray,
    normal: FloatArray,
    reach: Reach,
    weight: FloatArray | None = None,
) -> Minimum:
    """Minimise a quadratic over theta within ``reach``, all z and s.

    Args:
        hessian: (3, 3, J, B) of z. spread: its inverse.
        pull: (3, 7, J, B) of z with (theta, s, 1). normal: (7, 7, B) of (theta, s, 1).
        weight: (J, B) of the PMs' terms; it is in ``normal`` already.
    """
    gain = np.einsum("ijnb,jknb->iknb", spread, pull)
    n = normal - np.einsum("kinb,kjnb->ijb", pull if weight is None else pull * weight, gain)
    weak = _WEAKEST * np.trace(n[3:6, 3:6]) * _EYE
    valid = is_positive(hessian).all(axis=0) & is_positive(n[3:6, 3:6] - weak)
    n = np.where(valid, n, np.eye(7)[..., None])  # of those without a minimum nothing is used
    inner = inverse(n[3:6, 3:6])
    across = np.einsum("ijb,jkb->ikb", n[:, 3:6], inner)
    schur = n - np.einsum("ijb,kjb->ikb", across, n[:, 3:6])
    least, multiplier = _least(schur, reach)
    turn = inverse(schur[:3, :3] + _EYE * multiplier)
    lever = np.einsum("kib,klb->ilb", across[:3], turn)  # of (s, theta)
    covariance = np.empty((6, 6, turn.shape[2]))
    covariance[:3, :3], covariance[3:, :3], covariance[:3, 3:] = turn, -lever, -lever.swapaxes(0, 1)
    covariance[3:, 3:] = inner + np.einsum("ilb,lkb->ikb", lever, across[:3])
    solution = -np.einsum("ijb,jb->ib", covariance, n[:6, 6])
    shift = -across[6]
    return Minimum(
        least=np.where(valid, least, 0.0),
        valid=valid,
        solution=solution,
        covariance=covariance,
        step=-(gain[:, 6] + np.einsum("iknb,kb->inb", gain[:, :6], solution)),
        variance=np.einsum("iknb,klb,ilnb->inb", gain[:, :6], covariance, gain[:, :6]),
        own=np.einsum("iinb->inb", spread),
        fixed_shift=shift,
        fixed_step=-(gain[:, 6] + np.einsum("iknb,kb->inb", gain[:, 3:6], shift)),
        information=np.where(valid, schur[[0, 1, 2], [0, 1, 2]], 0.0),
    )


def _least(schur: FloatArray, reach: Reach) -> tuple[FloatArray, FloatArray]:
    """Least value (B,) of the quadratic ``schur`` (7, 7, B) in (theta, ., 1), from below, and multipliers (3, B).

    For any multipliers m >= 0, the least of q(theta) + sum of m (theta^2 - about^2) is a bound. First one m for the
    ball, or the ellipsoid about the box where that is smaller; then for each axis what raises it.
    """
    ball = reach.angle / np.sqrt(3.0)
    unit = np.where(np.prod(reach.about, axis=0) < ball**3, reach.about, ball)
    square = (reach.about / unit) ** 2
    inside = schur[:3, :3] * unit[:, None] * unit
    pull, constant = schur[:3, 6] * unit, schur[6, 6]
    size = np.abs(inside)
    lowest = np.einsum("iib->ib", inside) - size.sum(axis=1) + np.einsum("iib->ib", size)  # of the eigenvalues, by rows
    tiny = 1e-9 * np.einsum("iib->b", size)
    least_m = np.where(is_positive(inside - tiny * _EYE), 0.0, tiny + np.maximum(-lowest.min(axis=0), 0.0))
    m, best, chosen = least_m, np.full(len(constant), -np.inf), np.zeros_like(pull)
    for _ in range(_NEWTON):  # |t(m)|^2 = 3; 1 / |t| is nearly linear in m
        spread = inverse(inside + _EYE * m)
        t = np.einsum("ijb,jb->ib", spread, pull)
        square_t = np.einsum("ib,ib->b", t, t) + 1e-300
        value = constant - np.einsum("ib,ib->b", pull, t) - 3.0 * m
        best, chosen = np.maximum(value, best), np.where(value > best, m, chosen)
        slope = np.einsum("ib,ijb,jb->b", t, spread, t) + 1e-300
        m = np.maximum(m + square_t / slope * (np.sqrt(square_t / 3.0) - 1.0), least_m)
    each = chosen
    for _ in range(_BOX_STEPS):
        t = np.einsum("ijb,jb->ib", inverse(inside + _EYE * each), pull)
        each = each * np.minimum(t**2 / square, 4.0)
        held = inside + _EYE * each
        value = constant - np.einsum("ib,ijb,jb->b", pull, inverse(held), pull) - (each * square).sum(axis=0)
        better = is_positive(held - 1e-9 * _EYE * np.trace(held)) & (value > best)
        best, chosen = np.where(better, value, best), np.where(better, each, chosen)
    return best, chosen / unit**2


def is_positive(matrix: FloatArray) -> BoolArray:
    """Whether symmetric (3, 3, ...) matrices are positive definite, by their leading minors."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    second = a * d - b * b
    return np.asarray((a > 0.0) & (second > 0.0) & (f * second + 2.0 * b * c * e - a * e * e - d * c * c > 0.0))


def inverse(matrix: FloatArray) -> FloatArray:
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
