"""The looks' part of the linearised cost: quadratics in each PM's polar coordinates, and what they leave.

Of a PM's first look x and range are linear in these coordinates, and the stage rotation is nearly so. Another look of
the same PM is at another stage angle: its arc has another centre, some mm away, so that its range and its angle are
nearly those of the first one; their second derivatives are bounded by how far the centres are apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.certificate.conditional import Conditional, Looks
from fgreg.geometry.transforms import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LookParts:
    """Of the looks, by PM: Hessian (3, 3, J, B), gradient (3, J, B), chi square (J, B), and what the linearisation
    leaves: its square (J, B), and its product with the residuals (J, B), at most. ``off`` (B,): root of the first
    looks' chi squares."""

    hessian: FloatArray
    gradient: FloatArray
    chi2: FloatArray
    error2: FloatArray
    pulled: FloatArray
    off: FloatArray


def look_parts(of: Conditional, z: FloatArray, half: FloatArray) -> LookParts:
    """Terms of all looks, linearised at z."""
    look, radius = of.first, of.radius_mm
    value, slope, bend = _rotation(look, radius, z[2], half[2])
    w = look.weight[..., None]
    residual = np.stack([z[0] - look.x_mm[:, None], z[1] - look.heard_mm[:, None], value - look.rotation_rad[:, None]])
    hessian = np.zeros((3, 3, *z.shape[1:]))
    hessian[:2, :2] = w[:2, :2]
    hessian[2, 2] = w[2, 2] * slope**2
    weighted = np.einsum("ijn,jnb->inb", look.weight, residual)
    gradient = weighted.copy()
    gradient[2] *= slope
    left = 0.5 * bend * half[2] ** 2
    chi2 = dot(residual, weighted)
    off = np.sqrt(chi2.sum(axis=0))
    out = LookParts(hessian, gradient, chi2, w[2, 2] * left**2, np.abs(weighted[2]) * left, off)
    if len(of.others.pm):
        more = _other_looks(of, z, half)
        for name in ("hessian", "gradient", "chi2", "error2", "pulled"):
            total, part = getattr(out, name), getattr(more, name)
            for i, pm in enumerate(of.others.pm):
                total[..., pm, :] += part[..., i, :]
    return out


def _rotation(
    look: Looks, radius: float, delta: FloatArray, half: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Stage rotation at arc angles (J, B), its derivative there, and its largest second derivative within ``half``."""
    h = look.heard_mm[:, None]
    cosine = np.cos(delta)
    square = radius**2 + h * h + 2.0 * radius * h * cosine
    value = np.arctan2(h * np.sin(delta), radius + h * cosine)
    slope = h * (h + radius * cosine) / square
    widest = np.minimum(np.abs(delta) + half, np.pi)
    least = radius**2 + h * h + 2.0 * radius * h * np.cos(widest)
    bend = h * radius * np.abs(h * h - radius**2) * np.sin(np.minimum(widest, np.pi / 2)) / least**2
    return value, slope, bend


def _other_looks(of: Conditional, z: FloatArray, half: FloatArray) -> LookParts:
    """As :func:`look_parts` for the looks (n) that are not the first of their PM.

    In the plane of (tangential, radial), turned by the angle between the two stage readings, the frame of such a look
    is that of the first one but for a shift of the element and the array's tilts. So the point (u, rho) in the one is
    the point in the other moved by at most ``d``, and directions to it differ by at most ``lean``.
    """
    look, pm = of.others, of.others.pm
    z, half = z[:, pm], half[:, pm]
    sine, cosine = np.sin(z[2]), np.cos(z[2])
    q = np.stack([z[0], z[1] * sine, z[1] * cosine])
    by_z = np.zeros((3, 3, *z.shape[1:]))
    by_z[0, 0] = 1.0
    by_z[1, 1], by_z[2, 1], by_z[1, 2], by_z[2, 2] = sine, cosine, q[2], -q[1]
    there = np.einsum("ijn,jnb->inb", look.from_first, q) + look.origin[..., None]
    derivative = np.einsum("ijn,jknb->iknb", look.from_first, by_z)
    distance = np.hypot(there[1], there[2])
    u1, u2 = there[1] / distance, there[2] / distance
    by_rho = u1 * derivative[1] + u2 * derivative[2]
    by_delta = (u2 * derivative[1] - u1 * derivative[2]) / distance
    delta = np.arctan2(there[1], there[2])

    # The frames' turn about the axis, then what is left of the matrix (``tilt``) and of the point (``d``).
    m = look.from_first
    turn = np.arctan2(m[1, 2] - m[2, 1], m[1, 1] + m[2, 2])
    c, s = np.cos(turn), np.sin(turn)
    back = np.zeros_like(m)
    back[0, 0] = 1.0
    back[1, 1], back[1, 2], back[2, 1], back[2, 2] = c, -s, s, c
    rest = np.einsum("ijn,jkn->ikn", back, m) - np.eye(3)[..., None]
    tilt = np.sqrt(np.sum(rest**2, axis=(0, 1)))[:, None]
    size = np.sqrt(half[0] ** 2 + half[1] ** 2 + ((z[1] + half[1]) * half[2]) ** 2)
    shifted = np.einsum("ijn,jnb->inb", rest, q) + np.einsum("ijn,jn->in", back, look.origin)[..., None]
    d = np.hypot(shifted[1], shifted[2]) + tilt * size
    longest, nearest = z[1] + half[1], np.maximum(z[1] - half[1] - d, 1e-3)
    lean = np.minimum(d / nearest, 2.0)
    arc = longest * half[2]
    aside = lean + tilt
    onward = arc * (1.0 + tilt) + half[1] * aside + half[0] * tilt  # tangential part of a step, at most
    outward = half[1] * (1.0 + tilt) + arc * aside + half[0] * tilt
    curved = arc * half[2] * ((1.0 + tilt) ** 2 * d / nearest + lean**2 + 4.0 * tilt + tilt**2)
    mixed = 2.0 * half[1] * half[2] * aside
    small = half[1] * aside + half[0] * tilt
    bent = curved + mixed + (2.0 * arc * (1.0 + tilt) * small + small**2) / nearest
    angular = (
        2.0 * half[1] * half[2] * (1.0 + tilt) + arc * half[2] * aside + 2.0 * outward * onward / nearest
    ) / nearest
    turned = onward / nearest
    value, slope, bend = _rotation(look, of.radius_mm, delta, turned)
    h, radius = look.heard_mm[:, None], of.radius_mm
    widest = np.minimum(np.abs(delta) + turned, np.pi)
    steepest = h * (h + radius) / (radius**2 + h * h + 2.0 * radius * h * np.cos(widest))
    rest_x = np.hypot(rest[0, 1], rest[0, 2])[:, None]
    left = np.stack(
        [
            rest_x * (0.5 * arc * half[2] + half[1] * half[2]),
            0.5 * bent,
            0.5 * (steepest * angular + bend * turned**2),
        ]
    )

    residual = np.stack(
        [there[0] - look.x_mm[:, None], distance - look.heard_mm[:, None], value - look.rotation_rad[:, None]]
    )
    jacobian = np.stack([derivative[0], by_rho, slope * by_delta])
    by_weight = np.einsum("ijn,jknb->iknb", look.weight, jacobian)
    weighted = np.einsum("ijn,jnb->inb", look.weight, residual)
    return LookParts(
        np.einsum("iknb,ilnb->klnb", jacobian, by_weight),
        np.einsum("iknb,inb->knb", by_weight, residual),
        dot(residual, weighted),
        np.einsum("inb,ijn,jnb->nb", left, np.abs(look.weight), left),
        dot(np.abs(weighted), left),
        np.zeros(0),
    )


def dot(first: FloatArray, second: FloatArray) -> FloatArray:
    """(J, B) inner products of (3, J, B)."""
    return np.asarray(np.einsum("inb,inb->nb", first, second))
