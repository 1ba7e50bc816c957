"""The checks of numbers before they enter an estimate, whoever made them: file, detector, driver or program.

Finite, of the right shape, rigid or positive semidefinite, and within the bounds that the files have. A variance of
zero is allowed: the floor of the noise is added to it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.model.events import LATERAL_MM, RANGE_MM
from fgreg.model.measurements import (
    Aim,
    Check,
    LocatedPoint,
    Look,
    MarkerObservation,
    Measurements,
    Pair,
    Track,
    observation,
)
from fgreg.schema.kinds import COORDINATE_MM, MAX_TRANSLATION_MM, NOT_NEGATIVE, Number
from fgreg.schema.matrices import covariance_problem, transform_problem

INT64 = 2**63
TURN_RAD = Number(-2.0 * math.pi, 2.0 * math.pi)
"""Stage angles: zero and direction of the stage may bring those of the files to any angle of a turn."""
MAX_SIGMA = 1e6
"""Largest standard deviation of an entry, in mm or rad, as in files."""
Measured = Aim | Pair | Track | LocatedPoint


def problem_of(measured: Measured) -> str | None:
    """The first fault of a measurement, in one line; None where it may enter an estimate (or be answered, compared)."""
    return next(_problems(measured), None)


def problems_of_all(measurements: Measurements, checks: Sequence[Check]) -> Iterator[tuple[str, str]]:
    """Faults of a program's measurements, each with its place (``pairs[3]``)."""
    listed: dict[str, Sequence[Measured]] = {
        "aims": measurements.aims,
        "pairs": measurements.pairs,
        "points": measurements.points,
        "checks": checks,
    }
    for name, all_measured in listed.items():
        for index, measured in enumerate(all_measured):
            if (problem := problem_of(measured)) is not None:
                yield f"{name}[{index}]", problem
    epochs = {"pairs": [pair.epoch for pair in measurements.pairs]}
    epochs["points"] = [point.epoch for point in measurements.points]
    for name, each in epochs.items():
        for index, epoch in enumerate(each):
            if not 0 <= epoch < len(measurements.epochs):
                yield f"{name}[{index}]", f"its epoch is {epoch}, of {len(measurements.epochs)}"
    seen: dict[tuple[int, int], int] = {}
    for index, pair in enumerate(measurements.pairs):
        if seen.setdefault(observation(pair), pair.epoch) != pair.epoch:
            yield f"pairs[{index}]", of_earlier_epoch(pair.pm)
    for index, start in enumerate(measurements.epochs):
        if (problem := motion_problem(start.camera_new_T_camera_old, start.covariance)) is not None:
            yield f"epochs[{index}]", problem


def of_earlier_epoch(pm: int) -> str:
    """Why a look is left out whose marker observation is known from another camera epoch."""
    return f"the marker of PM {pm} was seen in another camera epoch, and this look has no observation of its own"


def marker_problem(marker: MarkerObservation) -> str | None:
    """The first fault of a marker's pose, its covariance, or what it says of the camera's constants."""
    return next(_marker(marker), None)


def spot_problem(camera_p_spot_mm: FloatArray, covariance: FloatArray) -> str | None:
    """The first fault of a spot (3,) and its covariance (3, 3)."""
    return next(_point("camera_p_spot_mm", camera_p_spot_mm, "covariance of the spot", covariance), None)


def look_problem(look: Look) -> str | None:
    """The first fault of a look."""
    return next(_look(look), None)


def motion_problem(camera_new_T_camera_old: FloatArray | None, covariance: FloatArray | None) -> str | None:
    """The first fault of a camera's motion (4, 4) and its covariance (6, 6), where there are any."""
    return next(_motion(camera_new_T_camera_old, covariance), None)


def pose_problem(name: str, pose: FloatArray, covariance: FloatArray) -> str | None:
    """The first fault of a pose (4, 4) and its covariance (6, 6)."""
    return next(_pose(name, pose, f"covariance of {name}", covariance), None)


def _problems(measured: Measured) -> Iterator[str]:
    if not math.isfinite(measured.t):
        yield f"its time is {measured.t}, expected a number"
    if isinstance(measured, LocatedPoint):
        yield from _point("camera_p_mm", measured.camera_p_mm, "covariance of the point", measured.covariance)
        yield from _point("trus_p_mm", measured.trus_p_mm, "trus_covariance of the point", measured.trus_covariance)
        return
    yield from _marker(measured.marker)
    if isinstance(measured, Aim):
        yield from _point("camera_p_spot_mm", measured.camera_p_spot_mm, "covariance of the spot", measured.covariance)
    elif isinstance(measured, Pair):
        yield from _look(measured.look)
        yield from _number("beam_offset_mm", measured.beam_offset_mm, NOT_NEGATIVE)
        if (spot := measured.spot) is not None:
            yield from _point("camera_p_mm of the spot", spot.camera_p_mm, "covariance of the spot", spot.covariance)
            if spot.dependence is not None and not np.isfinite(spot.dependence.gain).all():
                yield "the spot's dependence on the camera's constants has an entry that is not finite"
        if not -INT64 <= measured.pm < INT64:
            yield f"pm is {measured.pm}, expected a number of 64 bits"
    else:
        for marker in measured.look_markers:
            yield from _marker(marker)
        for look in measured.looks:
            yield from _look(look)
        if measured.scan_rad is not None:
            yield from _number("scan_rad", measured.scan_rad, TURN_RAD)


def _marker(marker: MarkerObservation) -> Iterator[str]:
    yield from _pose("camera_T_marker", marker.camera_T_marker, "covariance of the marker", marker.covariance)
    if not -INT64 <= marker.id < INT64:
        yield f"marker id is {marker.id}, expected a number of 64 bits"
    if (dependence := marker.dependence) is not None:
        for name in ("gain", "information", "pull"):
            if not np.isfinite(getattr(dependence, name)).all():
                yield f"the dependence on the camera's constants has an entry of its {name} that is not finite"
        information = dependence.information
        if np.isfinite(information).all() and (problem := covariance_problem(information, semidefinite=True)):
            yield f"what the corners tell of the camera's constants is {problem}"


def _look(look: Look) -> Iterator[str]:
    yield from _number("scan_rad", look.scan_rad, TURN_RAD)
    yield from _number("scan_sigma_rad", look.scan_sigma_rad, NOT_NEGATIVE)
    yield from _number("window_sigma_rad", look.window_sigma_rad, NOT_NEGATIVE)
    yield from _number("x_mm", look.x_mm, LATERAL_MM)
    yield from _number("range_mm", look.range_mm, RANGE_MM)
    yield from _covariance("covariance of the look", look.covariance, 2)
    if look.amplitude is not None and not math.isfinite(look.amplitude):
        yield f"amplitude is {look.amplitude}, expected a number"
    if look.sweep not in (-1, 0, 1):
        yield f"sweep is {look.sweep}, expected -1, 0 or 1"
    if (wave := look.wavefront) is not None and not (
        math.isfinite(wave.ratio) and math.isfinite(wave.sigma) and wave.sigma > 0.0
    ):
        yield f"its wavefront shows a sound speed of {wave.ratio} +- {wave.sigma}, expected numbers, the second > 0"
    for other in look.others:
        yield from _number("x_mm of another position", other.x_mm, LATERAL_MM)
        yield from _number("range_mm of another position", other.range_mm, RANGE_MM)
        yield from _covariance("covariance of another position", other.covariance, 2)


def _motion(camera_new_T_camera_old: FloatArray | None, covariance: FloatArray | None) -> Iterator[str]:
    if camera_new_T_camera_old is not None:
        yield from _transform("camera_new_T_camera_old", camera_new_T_camera_old)
    if covariance is not None:
        yield from _covariance("covariance of the motion", covariance, 6)


def _pose(name: str, pose: FloatArray, of_covariance: str, covariance: FloatArray) -> Iterator[str]:
    yield from _transform(name, pose)
    yield from _covariance(of_covariance, covariance, 6)


def _point(name: str, point_mm: FloatArray, of_covariance: str, covariance: FloatArray) -> Iterator[str]:
    for problem in _array(name, point_mm, (3,)):
        yield problem
        return
    for value in point_mm.tolist():
        yield from _number(name, value, COORDINATE_MM)
    yield from _covariance(of_covariance, covariance, 3)


def _number(name: str, value: float, allowed: Number) -> Iterator[str]:
    if not allowed.has(float(value)):
        yield f"{name} is {value:.6g}, expected {allowed.expected}"


def _array(name: str, value: FloatArray, shape: tuple[int, ...]) -> Iterator[str]:
    if np.shape(value) != shape:
        yield f"{name} has shape {np.shape(value)}, expected {shape}"
    elif not np.isfinite(value).all():
        yield f"{name} has an entry that is not finite"


def _transform(name: str, value: FloatArray) -> Iterator[str]:
    for problem in _array(name, value, (4, 4)):
        yield problem
        return
    if (problems := transform_problem(value, MAX_TRANSLATION_MM)) is not None:
        yield f"{name} is {problems[0]}, expected {problems[1]}"


def _covariance(name: str, value: FloatArray, size: int) -> Iterator[str]:
    for problem in _array(name, value, (size, size)):
        yield problem
        return
    found = covariance_problem(value, semidefinite=True)
    if found is None and float(np.diag(value).max()) > MAX_SIGMA**2:
        found = f"one with a standard deviation of {math.sqrt(float(np.diag(value).max())):.2g}"
    if found is not None:
        yield f"{name} is {found}, expected a symmetric, positive semidefinite one"
