"""The residuals linearised in each PM's polar coordinates z, the turn theta and the shift s, and what that leaves.

Everything is in TRUS axes: theta turns about them, and s is the shift times the cell's centre rotation. What the
linearisation leaves moves a PM by a few mm at most. The lines see it there; but the linearised residuals may have a PM
of their own: its z gives way as far as the looks allow, along the beam almost for nothing. So a mm that is left counts
with the information that is left of lines and looks once z is eliminated, not with that of the lines alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.certificate.conditional import Conditional
from fgreg.certificate.looks import LookParts, dot, look_parts
from fgreg.certificate.quadratic import inverse
from fgreg.certificate.rotations import Reach
from fgreg.geometry.transforms import BoolArray, FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """The residuals at z.

    Attributes:
        line: (m, 10, J, B) derivatives by z, theta, s, and the residual, across the beams. rows: (m, 3, J, B) by a
            point.
        y: (3, J, B) the PM less the pivot. radial, tangent: directions. by_z: (3, 3, J, B) of y.
        hessian: (3, 3, J, B) of z, of lines and looks. spread: its inverse.
        left: (3, 3, J, B) information on a mm of x, radially, tangentially, where z gives way; absolute values.
        slide: (3, 3, J, B) by how much z does for each mm; absolute values.
    """

    line: FloatArray
    rows: FloatArray
    y: FloatArray
    radial: FloatArray
    tangent: FloatArray
    by_z: FloatArray
    hessian: FloatArray
    spread: FloatArray
    left: FloatArray
    slide: FloatArray
    looks: LookParts


def linearised(of: Conditional, rotation: FloatArray, z: FloatArray, half: FloatArray) -> Linearised:
    """At z (3, J, B), for cells with centres ``rotation`` (3, 3, B); ``half`` widths of intervals, for the looks."""
    sine, cosine = np.sin(z[2]), np.cos(z[2])
    x_axis, up, aside = (of.from_array[:, i, :, None] for i in (0, 2, 1))
    radial, tangent = aside * sine + up * cosine, aside * cosine - up * sine
    y = of.origin[..., None] + x_axis * z[0] + radial * z[1]
    by_z = np.stack([np.broadcast_to(x_axis, y.shape), radial, tangent * z[1]], axis=1)
    rows = np.einsum("min,kib->mknb", of.rows, rotation)
    line = np.empty((len(of.rows), 10, *z.shape[1:]))
    line[:, :3] = np.einsum("mknb,kjnb->mjnb", rows, by_z)
    for i in range(3):  # y x theta
        j, k = (i + 1) % 3, (i + 2) % 3
        line[:, 3 + i] = rows[:, j] * y[k] - rows[:, k] * y[j]
    line[:, 6:9] = -rows
    line[:, 9] = np.einsum("mknb,knb->mnb", rows, y) + of.offset[..., None]
    looks = look_parts(of, z, half)
    of_lines = np.einsum("minb,mjnb->ijnb", line[:, :3], line[:, :3])
    hessian = of_lines + looks.hessian
    spread = inverse(hessian)
    per_mm = np.stack([np.ones_like(z[1]), np.ones_like(z[1]), 1.0 / z[1]])
    slide = np.einsum("ijnb,jknb->iknb", spread, of_lines) * per_mm
    left = np.einsum("jinb,jknb->iknb", slide, looks.hessian) * per_mm
    return Linearised(line, rows, y, radial, tangent, by_z, hessian, spread, np.abs(left), np.abs(slide), looks)


@dataclass(frozen=True, slots=True, eq=False)
class Remainder:
    """What the linearisation leaves, at most, of registrations in cells and PMs within their intervals.

    Attributes:
        error: (B,) root of the sum of squares, in standard deviations. own: (J, B) of each PM.
        each: (3, B) part of it that grows with a cell's reach about each axis.
        offset: (3, J, B) by how much a PM's z and that of the linearised residuals differ.
        centred: (B,) whether the squares of the PMs' moves are about their middles, where these are in the residuals.
        longest: (J, B) largest range. moved: (J, B) by how much a PM moves within its interval, mm; all_moved: (B,)
            root of the sum of squares of that. bow, sideways: (J, B) second order of it, radially and tangentially.
    """

    error: FloatArray
    own: FloatArray
    each: FloatArray
    offset: FloatArray
    centred: BoolArray
    longest: FloatArray
    moved: FloatArray
    all_moved: FloatArray
    bow: FloatArray
    sideways: FloatArray


def remainder(
    of: Conditional, at: Linearised, z: FloatArray, half: FloatArray, reach: Reach, within: float, part: float
) -> Remainder:
    """Bounds of what is left; ``part``: of each square that is not in the residuals yet (1/2, or 1/4 about its middle).

    A turn about other axes moves a PM across them only, and a PM moves within its interval mostly tangentially: so the
    products of the two have their parts along x, radially and tangentially, each weighed by itself. All PMs together
    move less than each alone: the first looks' chi squares add up to at most ``within`` squared, and move them off
    where they are now, ``looks.off`` from what was measured.
    """
    x_off, range_off, w = half
    longest = z[1] + range_off
    bow, sideways = 0.5 * longest * w**2, range_off * w + longest * w**3 / 6.0
    apart = np.stack([x_off, range_off + bow, longest * w])
    moved = np.sqrt(x_off**2 + range_off**2 + (longest * w) ** 2)
    turn = of.scan_rad[:, None] + z[2]
    sine, cosine = np.abs(np.sin(turn)), np.abs(np.cos(turn))

    def along_pm(trus: FloatArray) -> FloatArray:
        """Components along TRUS axes, at most, as such along x, radially and tangentially."""
        x, y, z = trus
        return np.stack([np.broadcast_to(x, sine.shape), sine * y + cosine * z, cosine * y + sine * z])

    size, length = reach.angle, np.sqrt(dot(at.y, at.y))
    about = np.minimum(along_pm(reach.about[:, None]), size)
    in_ball = (_off_axis(reach) == size**2).all(axis=0)
    most = np.where(in_ball, part, 1.0 - part) * size**2 * length
    place = np.minimum(along_pm(_second_order(np.abs(at.y), reach, part)), most)
    place += length * size**3 / 6.0
    place += of.skew[:, None] * np.sqrt(dot(place, place))
    a, b, c = about  # about x, the radius, the tangent
    unit = of.skew[:, None] * size
    crossed = np.stack([b * apart[2] + c * apart[1], a * apart[2] + c * apart[0], a * apart[1] + b * apart[0]])
    crossed += unit * moved
    each_crossed = _weighed(at.left, crossed)
    alone = np.sqrt(each_crossed.sum(axis=0))
    # By a mm of x, range and tangentially; then by a standard deviation of the first look.
    zero, slant = np.zeros_like(b), unit * np.sqrt(np.sqrt(np.square(at.left).sum(axis=(0, 1))))
    by_x, by_range, by_arc = (
        np.sqrt(_weighed(at.left, np.stack(parts))) + slant for parts in ((zero, c, b), (c, zero, a), (b, a, zero))
    )
    look = of.first
    # The rotation changes least with delta where delta is 0.
    arc_sigma = longest * ((look.heard_mm + of.radius_mm) / (look.heard_mm * np.sqrt(look.weight[2, 2])))[:, None]
    plane_sigma = of.plane_sigma_mm[:, None]
    by_sigma = (by_x**2 + by_range**2) * plane_sigma**2 + ((by_arc + 0.5 * w * by_range) * arc_sigma) ** 2
    off = within + at.looks.off
    together = np.sqrt(by_sigma.max(axis=0)) * off
    stretch = of.stretch[:, None]
    all_moved = np.minimum(
        np.sqrt(np.square(stretch * moved).sum(axis=0)),
        (stretch * np.maximum(plane_sigma, arc_sigma)).max(axis=0) * off,
    )

    def own(mm: FloatArray) -> FloatArray:
        return np.asarray(np.sqrt(_weighed(at.left, mm)) + np.sqrt(at.looks.error2))

    def total(each: FloatArray) -> FloatArray:
        return np.asarray(np.sqrt(np.square(each).sum(axis=0)))

    # The bows: each PM's about its middle, or all of them in proportion to how far the PM is off, without a middle.
    bowed = place + np.stack([zero, 2.0 * part * bow, sideways])
    by_off = np.stack([zero, 0.5 * w * arc_sigma, w * plane_sigma + w**2 * arc_sigma / 6.0])
    each_bowed, all_bowed = total(own(bowed)), total(own(place)) + np.sqrt(_weighed(at.left, by_off).max(axis=0)) * off
    centred = each_bowed <= all_bowed
    place += np.stack([zero, np.where(centred, 2.0 * part, 1.0) * bow, sideways])
    share = np.minimum(1.0, together / np.maximum(alone, 1e-300))
    # For the choice of sides, so about: of tangential moves, and of others with a turn about the tangent.
    by_turn = np.stack([a * a * at.left[1, 1], b * b * at.left[0, 0]]) * apart[2] ** 2
    by_tangent = c * c * (at.left[0, 0] * apart[1] ** 2 + at.left[1, 1] * apart[0] ** 2)
    return Remainder(
        error=np.minimum(each_bowed, all_bowed) + np.minimum(alone, together),
        own=own(place) + np.sqrt(each_crossed),
        each=share * np.sqrt(np.stack([by_turn[0], by_tangent, by_turn[1]]).sum(axis=1)),
        offset=np.einsum("iknb,knb->inb", at.slide, place + crossed),
        centred=centred,
        longest=longest,
        moved=stretch * moved,
        all_moved=all_moved,
        bow=bow,
        sideways=sideways,
    )


def middle(at: Linearised, rest: Remainder, reach: Reach) -> FloatArray:
    """(3, J, B) mm, TRUS axes: the middle of the squares that the linearisation leaves."""
    bow = np.where(rest.centred, 0.5 * rest.bow, 0.0)
    return np.asarray(-0.25 * _off_axis(reach)[:, None] * at.y - at.radial * bow)


def _off_axis(reach: Reach) -> FloatArray:
    """(3, B) squared turn about the other two axes, at most."""
    squares = np.square(reach.about)
    return np.asarray(np.minimum(squares.sum(axis=0) - squares, reach.angle**2))


def _second_order(y: FloatArray, reach: Reach, part: float) -> FloatArray:
    """(3, J, B) largest components of (theta (theta'y) - |theta|^2 y) / 2, the squares with a ``part`` only."""
    h, off = reach.about[:, None], _off_axis(reach)[:, None]
    out = np.empty_like(y)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        out[k] = 0.5 * h[k] * (h[i] * y[i] + h[j] * y[j]) + part * off[k] * y[k]
    return out


def _weighed(left: FloatArray, mm: FloatArray) -> FloatArray:
    """(J, B) chi square of mm (3, J, B)."""
    x, r, t = mm
    return np.asarray(
        left[0, 0] * x * x
        + left[1, 1] * r * r
        + left[2, 2] * t * t
        + 2.0 * (left[0, 1] * x * r + left[0, 2] * x * t + left[1, 2] * r * t)
    )
