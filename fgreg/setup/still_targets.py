"""Radius, range offset and signs from targets that stand still while the stage is turned (docs/setup.md, section 2).

With (x, y, z) of a target in TRUS, rho = hypot(y, z) and phi the device angle at which the plane points at it, its
range at device angle u is

    (1 + s) r = hypot(rho cos(phi - u) - R', rho sin(phi - u)) - o,        R' = R + x tilt

R the radius, o the range offset, s the error of the medium's sound speed. At phi it is loudest: the top of

    log a = log a0 - k (phi - u)^2,

which shares no other parameter and is fitted first. Measured besides, where that was done: the depth rho - R',
and the distance between two targets.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fgreg.errors import EstimationError
from fgreg.geometry.transforms import FloatArray
from fgreg.model.setup_recording import TargetLine
from fgreg.setup.constants import Declared, Found
from fgreg.setup.optimum import Optimum, optimum

LEAST_LOOKS = 3
BELL_LOOKS = 5
"""Looks with an amplitude from which the angle of a target is found by them."""
SURE_Z = 5.0
"""A sign is told by a displacement of at least this many of its sigmas, and ..."""
SURE_MM = 1.0
"""... of at least this."""
LEAST_AMPLITUDE_SIGMA = 0.01
OFFSET_SIGMA_MM = 5.0
"""Weak prior of the range offset where a depth was measured. Else it is zero within what is declared."""
LEAST_DOF = 8
"""Residuals from which their scatter is the noise, and not what is declared."""
MISFIT_Z = 5.0
"""Beyond this many of its sigmas a measured depth, distance or loudest angle is wrong."""
MISFIT = 3.0
"""Times the noise of ranges: beyond it the ranges contradict what was measured."""
SEEN = 0.5
"""Largest share of the declared radius that the sigma of a radius may be: its weak prior alone says 1."""
MOST_LOOKS, NORMAL = 0.8, 1.2816
"""Share of a target's looks that has to lie together (others may be stray), and within how many sigmas it then does."""
FAR = 3.0
"""A radius that many times the declared one, or that small, is none."""
_R, _O, _TILT = range(3)


@dataclass(frozen=True, slots=True, eq=False)
class TargetLooks:
    """Looks (n,) at one target: device angles (rad), x and range (mm, by the declared sound speed), amplitudes.

    ``amplitude`` is NaN where there is none. ``medium``: index of its recording.
    """

    number: int
    medium: int
    device_rad: FloatArray
    x_mm: FloatArray
    range_mm: FloatArray
    amplitude: FloatArray
    facts: tuple[TargetLine, ...] = ()


@dataclass(frozen=True, slots=True)
class Medium:
    """True over declared sound speed of a recording, and its relative standard deviation."""

    ratio: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class _Target:
    """A target's looks: true ranges, mean x, the device angle at which the plane points at it (mm, rad, 1 sigma)."""

    looks: TargetLooks
    range_mm: FloatArray
    x_mm: float
    angle_rad: float
    angle_sigma_rad: float
    first: int
    """Index of its first parameter: rho, then phi."""


def still_targets(targets: Sequence[TargetLooks], media: Sequence[Medium], declared: Declared) -> list[Found]:
    """Constants and signs that still targets show.

    Raises:
        EstimationError: they show nothing.
    """
    ready = _ready(targets, media, declared)
    sigma_range = _range_sigma(ready, declared)
    count = ready[-1].first + 2
    depths = any(fact.depth_mm is not None for one in ready for fact in one.looks.facts)
    offset_sigma = OFFSET_SIGMA_MM if depths else declared.range_offset_sigma_mm
    start, scale = np.zeros(count), np.ones(count)
    start[_R] = declared.radius_mm
    scale[[_O, _TILT]] = 0.1, declared.tilt_sigma_rad
    scale[3 : 3 + len(media)] = [medium.sigma for medium in media]
    for one in ready:
        start[one.first : one.first + 2] = declared.radius_mm + float(one.range_mm.min()), one.angle_rad
        scale[one.first + 1] = math.radians(0.1)
    by_number = {(one.looks.medium, one.looks.number): one for one in ready}

    def residuals(p: FloatArray) -> FloatArray:
        parts = [
            np.array(
                [
                    (p[_R] - declared.radius_mm)
                    / declared.radius_mm,  # weak: it keeps a radius that is not seen finite
                    p[_O] / offset_sigma,
                    p[_TILT] / declared.tilt_sigma_rad,
                ]
            ),
            p[3 : 3 + len(media)] / [medium.sigma for medium in media],
        ]
        for one in ready:
            parts.append(_ranges_off_mm(p, one) / sigma_range)
            parts.extend(_measured(p, one, by_number, declared))
        return np.concatenate(parts)

    found = optimum(residuals, start, scale).widened()
    _check(found, ready, by_number, declared, sigma_range)
    return [*_constants(found, ready, declared), *_signs(found, ready, by_number, declared)]


def _ready(targets: Sequence[TargetLooks], media: Sequence[Medium], declared: Declared) -> list[_Target]:
    bells: list[_Bell | None] = []
    for one in targets:
        _check_still(one, declared)
        angles = len(np.unique(np.round(one.device_rad, 5)))
        if angles < LEAST_LOOKS:
            raise EstimationError(
                f"target {one.number} was heard at {angles} stage angles: {LEAST_LOOKS} or more needed"
            )
        bells.append(_bell(one))
    fitted = [bell for bell in bells if bell is not None]
    dof = sum(bell.degrees_of_freedom for bell in fitted)
    noise = max(math.sqrt(sum(bell.squares for bell in fitted) / max(dof, 1)), LEAST_AMPLITUDE_SIGMA)
    ready = []
    for number, (one, bell) in enumerate(zip(targets, bells, strict=True)):
        # Without amplitudes: the middle of where it was heard. Each end is anywhere within a step.
        angle, sigma = 0.5 * float(one.device_rad.min() + one.device_rad.max()), _step_rad(one) / math.sqrt(6.0)
        if bell is not None:
            angle, sigma = bell.angle_rad, noise * bell.sigma_rad
        ranges = media[one.medium].ratio * one.range_mm
        ready.append(_Target(one, ranges, float(one.x_mm.mean()), angle, sigma, 3 + len(media) + 2 * number))
    return ready


def _check_still(one: TargetLooks, declared: Declared) -> None:
    """Raises EstimationError where x, or the range beside a parabola, scatters too much; a few stray looks may."""
    u = one.device_rad - one.device_rad.mean()
    ranges = one.range_mm - np.polyval(np.polyfit(u, one.range_mm, min(2, len(np.unique(u)) - 1)), u)
    for name, off, sigma in (
        ("x", one.x_mm, declared.noise.lateral_mm),
        ("range", ranges, declared.noise.range_mm),
    ):
        spread = float(np.quantile(np.abs(off - np.median(off)), MOST_LOOKS)) / NORMAL
        if spread > MISFIT * sigma:
            text = f"the {name} of target {one.number} scatters by {spread:.1f} mm, {sigma:g} by the declared noise"
            raise EstimationError(f"{text}: it moved, or other things were heard")


@dataclass(frozen=True, slots=True)
class _Bell:
    """Loudest angle (rad), its sigma at a noise of 1 of the log amplitudes, and the squares that the fit leaves."""

    angle_rad: float
    sigma_rad: float
    squares: float
    degrees_of_freedom: int


def _bell(one: TargetLooks) -> _Bell | None:
    """The parabola log a = a u^2 + b u + c, whose top is at -b / 2a; None with too few amplitudes."""
    louder = np.flatnonzero(np.nan_to_num(one.amplitude) > 0.0)
    if len(np.unique(np.round(one.device_rad[louder], 5))) < BELL_LOOKS:
        return None
    middle = float(one.device_rad[louder].mean())
    u, log = one.device_rad[louder] - middle, np.log(one.amplitude[louder])
    powers = np.vander(u, 3)
    fit = np.linalg.lstsq(powers, log, rcond=None)[0]
    a, b, _ = fit
    if a >= 0.0 or not (np.ptp(u) > abs(b / a)):
        raise EstimationError(
            f"target {one.number} has amplitudes that do not fall off to both sides: turn the stage past it"
        )
    g = np.linalg.pinv(powers).T @ [0.5 * b / a**2, -0.5 / a, 0.0]
    left = log - powers @ fit
    return _Bell(middle - 0.5 * b / a, float(np.linalg.norm(g)), float(left @ left), u.size - 3)


def _step_rad(one: TargetLooks) -> float:
    angles = np.unique(np.round(one.device_rad, 5))
    return max(float(np.median(np.diff(angles))), math.radians(0.05))


def _range_sigma(ready: Sequence[_Target], declared: Declared) -> float:
    """Standard deviation of ranges, mm, by their scatter about parabolas."""
    ranges, dof = 0.0, 0
    for one in ready:
        u = one.looks.device_rad - one.looks.device_rad.mean()
        if u.size > 3:
            ranges += float(np.sum((one.range_mm - np.polyval(np.polyfit(u, one.range_mm, 2), u)) ** 2))
            dof += u.size - 3
    return max(math.sqrt(ranges / dof) if dof >= LEAST_DOF else declared.noise.range_mm, 1e-3)


def _ranges_off_mm(p: FloatArray, one: _Target) -> FloatArray:
    rho, phi = p[one.first : one.first + 2]
    away = phi - one.looks.device_rad
    face = p[_R] + one.x_mm * p[_TILT]
    distance = np.hypot(rho * np.cos(away) - face, rho * np.sin(away))
    return np.asarray(distance - p[_O] - (1.0 + p[3 + one.looks.medium]) * one.range_mm)


def _measured(
    p: FloatArray, one: _Target, targets: Mapping[tuple[int, int], _Target], declared: Declared
) -> list[FloatArray]:
    """Residuals of a target's loudest angle, and of what was measured of it besides."""
    rho, phi = p[one.first : one.first + 2]
    parts = [np.array([(phi - one.angle_rad) / one.angle_sigma_rad])]
    for fact in one.looks.facts:
        if fact.depth_mm is not None:
            parts.append(np.array([(rho - p[_R] - one.x_mm * p[_TILT] - fact.depth_mm) / fact.depth_sigma_mm]))
        if fact.apart_mm is not None:
            other = _other(one, fact, targets)
            rho_2, phi_2 = p[other.first : other.first + 2]
            across = rho**2 + rho_2**2 - 2.0 * rho * rho_2 * math.cos(phi - phi_2)
            along = one.x_mm - other.x_mm
            sigma_x = math.hypot(*(declared.noise.lateral_mm / math.sqrt(len(t.looks.x_mm)) for t in (one, other)))
            sigma = math.hypot(fact.apart_sigma_mm, sigma_x * along / fact.apart_mm)
            parts.append(np.array([(math.sqrt(across + along**2) - fact.apart_mm) / sigma]))
    return parts


def _check(
    found: Optimum,
    ready: Sequence[_Target],
    targets: Mapping[tuple[int, int], _Target],
    declared: Declared,
    sigma_range: float,
) -> None:
    """Raises EstimationError where what was measured besides does not fit."""
    limit = MISFIT * max(sigma_range, declared.noise.range_mm)
    for one in ready:
        apart = [float(abs(part[0])) for part in _measured(found.value, one, targets, declared)]
        if max(apart, default=0.0) > MISFIT_Z:
            text = f"the depth or distance of target {one.looks.number} is {max(apart):.0f} sigmas off what is heard"
            raise EstimationError(f"{text}: measure it again, and look which target is which")
        off = float(np.sqrt(np.mean(_ranges_off_mm(found.value, one) ** 2)))
        if off > limit:
            text = f"depths and distances do not fit the ranges of target {one.looks.number}, by {off:.1f} mm RMS"
            raise EstimationError(f"{text}: measure again, and look which target is which")
    radius = float(found.value[_R])
    if not declared.radius_mm / FAR < radius < declared.radius_mm * FAR:
        raise EstimationError(f"these give a radius of {radius:.1f} mm: look at the depths and distances measured")


def _other(one: _Target, fact: TargetLine, targets: Mapping[tuple[int, int], _Target]) -> _Target:
    other = targets.get((one.looks.medium, -1 if fact.of is None else fact.of))
    if other is None:
        raise EstimationError(f"target {one.looks.number} is compared with target {fact.of}, which was never heard")
    return other


def _constants(found: Optimum, ready: Sequence[_Target], declared: Declared) -> list[Found]:
    sigma = np.sqrt(np.diag(found.covariance))
    facts = [fact for one in ready for fact in one.looks.facts]
    by = [f"the range of {len(ready)} still target{'s' * (len(ready) > 1)} against the stage angle"]
    if apart := sum(fact.apart_mm is not None for fact in facts):
        by.append(f"{apart} measured distance{'s' * (apart > 1)} between them")
    if depths := sum(fact.depth_mm is not None for fact in facts):
        by.append(f"{depths} measured depth{'s' * (depths > 1)}")
    how = ", ".join(by)
    needs = "" if depths else "; nothing shows it: measure the depth of a target (depth_mm)"
    radius_seen = float(sigma[_R]) < SEEN * declared.radius_mm
    between = "" if radius_seen else "; these hardly show it: measure the distance of two targets (apart_mm)"
    return [
        Found("probe.radius_mm", float(found.value[_R]), float(sigma[_R]), "mm", how + between, seen=radius_seen),
        Found("range_offset_mm", float(found.value[_O]), float(sigma[_O]), "mm", how + needs, seen=depths > 0),
    ]


def _signs(
    found: Optimum, ready: Sequence[_Target], targets: Mapping[tuple[int, int], _Target], declared: Declared
) -> list[Found]:
    """Direction and flip by the targets of which it is known to which side of another one they lie."""
    votes: dict[str, list[tuple[float, float, str]]] = {"x": [], "y": []}
    for one in ready:
        for fact in one.looks.facts:
            for towards in fact.towards:
                other, sign = _other(one, fact, targets), 1.0 if towards[0] == "+" else -1.0
                if towards[1] == "x":
                    sigma = math.hypot(
                        *(declared.noise.lateral_mm / math.sqrt(len(t.looks.x_mm)) for t in (one, other))
                    )
                    moved = one.x_mm - other.x_mm
                else:
                    moved, sigma = _sideways(found, one, other, declared)
                text = f"target {one.looks.number} lies towards {towards} of target {other.looks.number}"
                if abs(moved) < max(SURE_Z * sigma, SURE_MM):
                    near = f"{text}, but only by {abs(moved):.1f} +- {sigma:.1f} mm (1 sigma): move it farther"
                    raise EstimationError(near)
                votes[towards[1]].append((sign * moved, sigma, text))
    out = []
    for axis, name in (("y", "stage.direction"), ("x", "probe.flip")):
        if not votes[axis]:
            continue
        signs = {moved > 0.0 for moved, _, _ in votes[axis]}
        if len(signs) > 1:
            texts = " and ".join(next(t for m, _, t in votes[axis] if (m > 0.0) is sign) for sign in (True, False))
            raise EstimationError(f"{texts}: these contradict each other")
        moved, sigma, text = max(votes[axis], key=lambda vote: abs(vote[0] / vote[1]))
        as_declared = moved > 0.0
        value = (1 if as_declared else -1) if axis == "y" else as_declared is declared.flip
        how = f"{text}, by {abs(moved):.1f} mm"
        out.append(Found(name, value, None, "", how, z=abs(moved) / sigma))
    return out


def _sideways(found: Optimum, one: _Target, other: _Target, declared: Declared) -> tuple[float, float]:
    """How far a target lies towards +y of another one if the direction is +1, mm, and its standard deviation."""
    gradient, moved = np.zeros(found.value.size), 0.0
    for target, sign in ((one, 1.0), (other, -1.0)):
        rho, phi = found.value[target.first : target.first + 2]
        away = phi - declared.zero_device_rad
        moved += sign * rho * math.sin(away)
        gradient[target.first : target.first + 2] += sign * math.sin(away), sign * rho * math.cos(away)
    return float(moved), found.sigma(gradient)
