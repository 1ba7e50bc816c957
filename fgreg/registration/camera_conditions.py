"""What the corners of tags and board say about the cameras and the prints: conditions of the verdict.

Each detection tells about the constants by its misfit (fgreg.model.camera_dependence); here that is summed over the
session. What a constant *measures* as is its estimate with a flat prior on itself (or on its group) and the declared
priors on all others: how far it is off in standard deviations, the measurement's and its own, is its score test.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from fgreg.geometry.rig import CAMERA, Constant
from fgreg.geometry.transforms import FloatArray, IntArray, inverse, transform_points
from fgreg.model.camera_dependence import CONSTANTS, MODEL_PX, column
from fgreg.model.corner_information import (
    DEFAULT_SIGMAS,
    CornerInformation,
    corner_information,
    observed_dependences,
    posterior_of,
)
from fgreg.model.estimate import Verdict
from fgreg.model.measurements import Measurements
from fgreg.model.plausible import implausible_measurements, implausible_setup
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.systematic import TEXTS
from fgreg.registration.verdict import Condition

ALARM_P = 4.65e-4
"""A group is suspicious below this probability: 3.5 standard deviations of one constant."""
NAMED_Z = 2.0
"""Constants of a suspicious group that are named: those beyond this, and the farthest one."""
MISFIT_SHARE = 0.5
MISFIT_DETECTIONS = 4
"""Share of detections whose corners miss the body, and their number, from which the lens is suspicious."""
_FLAT = 1e3
"""Factor on a constant's default sigma that makes its prior flat."""
_GROUPS = (
    (Constant.FOCAL_LEFT, Constant.FOCAL_RIGHT),
    (Constant.CENTRE_LEFT_X, Constant.CENTRE_LEFT_Y, Constant.CENTRE_RIGHT_X, Constant.CENTRE_RIGHT_Y),
    (Constant.STEREO_ROTATION_X, Constant.STEREO_ROTATION_Y, Constant.STEREO_ROTATION_Z),
    (Constant.STEREO_TRANSLATION_X, Constant.STEREO_TRANSLATION_Y, Constant.STEREO_TRANSLATION_Z),
)
_PRINTS = ((Constant.TAG_SIZE, "tag", "size_mm"), (Constant.BOARD_SIZE, "board", "square_mm"))


@dataclass(frozen=True, slots=True)
class PrintSize:
    """The size of a print that the stereo views measure.

    Attributes:
        constant: TAG_SIZE or BOARD_SIZE.
        ratio: declared over measured size. sigma: of the measurement, the cameras' constants included.
        declared_sigma: of the declared size, relative.
    """

    constant: Constant
    ratio: float
    sigma: float
    declared_sigma: float


def print_sizes(corners: CornerInformation, sigmas: FloatArray) -> tuple[PrintSize, ...]:
    """The sizes of tag and board, as far as two views measured them.

    Args:
        sigmas: (19,) declared standard deviations of the constants.
    """
    columns = _columns([constant for constant, _, _ in _PRINTS])
    c, covariance = _measured(corners, columns, sigmas)
    out = []
    for place, (constant, _, _) in enumerate(_PRINTS):
        k = columns[place]
        sigma = math.sqrt(covariance[place, place])
        if corners.information[k, k] > 0.0 and sigma < 0.5:
            out.append(PrintSize(constant, 1.0 - float(c[place]), sigma, float(sigmas[k])))
    return tuple(out)


def camera_conditions(
    measurements: Measurements, model: SessionModel, config: SolveConfig, trus_T_camera: Sequence[FloatArray] = ()
) -> list[Condition]:
    """Conditions from the corners of tags and board, and from values beyond reason.

    Args:
        trus_T_camera: (4, 4) registrations, which tell what an error means at the targets.
    """
    found = [Condition(Verdict.WARNING, text) for text in implausible_setup(model)]
    found += [Condition(Verdict.WARNING, text) for text in implausible_measurements(measurements)]
    corners = corner_information([*observed_dependences(measurements)])
    if corners is None:
        return found
    # From here on the constants count from what a commissioned rig expects.
    corners = replace(corners, pull=corners.pull - corners.information @ model.constant_means[CAMERA])
    camera_p = [transform_points(inverse(transform), model.targets_mm) for transform in trus_T_camera]
    sigmas = model.constant_sigmas[CAMERA]
    prints = _print_condition(corners, sigmas, camera_p, config)
    # Prints that are off would else be laid at the stereo calibration's door, too.
    flat = _columns([constant for constant, _, _ in _PRINTS]) if prints else _columns([])
    # Where no constants make the corners fit, those that fit best mean nothing.
    other = _misfit_condition(corners) or _group_condition(corners, sigmas, flat, measurements, camera_p, config)
    return [*found, *prints, *other]


def _print_condition(
    corners: CornerInformation, sigmas: FloatArray, camera_p: Sequence[FloatArray], config: SolveConfig
) -> list[Condition]:
    """Whether the stereo views measure the prints as declared."""
    sizes = print_sizes(corners, sigmas)
    if not sizes:
        return []
    columns = _columns([size.constant for size in sizes])
    c, covariance = _measured(corners, columns, sigmas)
    if _p_value(c, covariance, sigmas[columns]) >= ALARM_P:
        return []
    z = np.abs(c) / np.sqrt(np.diag(covariance) + sigmas[columns] ** 2)
    named = [size for size, far in zip(sizes, z >= min(NAMED_Z, z.max()), strict=True) if far]
    words = {constant: (what, key) for constant, what, key in _PRINTS}
    said, which = [], []
    for size in named:
        what, key = words[size.constant]
        way = "smaller" if size.ratio > 1.0 else "larger"
        off = f"{100.0 * abs(size.ratio - 1.0):.1f} % {way} than {key} (1 sigma {100.0 * size.sigma:.1f} %)"
        said.append(f"the {what} {off}")
        which.append(what)
    farthest_mm = max((float(np.linalg.norm(p, axis=1).max()) for p in camera_p), default=0.0)
    error = max(abs(size.ratio - 1.0) for size in named) * farthest_mm
    # A wrong baseline makes all prints look wrong alike.
    other = ", or the stereo calibration's scale is wrong" if len(named) == len(sizes) else ""
    text = f"the stereo views measure {' and '.join(said)}{_meaning(error)}: measure the printed {' and '.join(which)}"
    return [Condition(_severity(error, config), text + other, error)]


def _group_condition(
    corners: CornerInformation,
    sigmas: FloatArray,
    flat: IntArray,
    measurements: Measurements,
    camera_p: Sequence[FloatArray],
    config: SolveConfig,
) -> list[Condition]:
    """The group of the cameras' constants that the corners contradict most, where they do."""
    tests = []
    for group in _GROUPS:
        columns = _columns(group)
        c, covariance = _measured(corners, np.concatenate([columns, flat]), sigmas)
        n = len(columns)
        tests.append((_p_value(c[:n], covariance[:n, :n], sigmas[columns]), columns, c[:n], covariance[:n, :n]))
    p, columns, c, covariance = min(tests, key=lambda test: test[0])
    if p >= ALARM_P:
        return []
    z = np.abs(c) / np.sqrt(np.diag(covariance) + sigmas[columns] ** 2)
    text = TEXTS[int(columns[0]) + CAMERA.start]
    scale, unit = (text.per_unit, f" {text.unit}") if text.unit else (100.0, " %")
    said = [
        f"the {TEXTS[int(k) + CAMERA.start].what} changed by {scale * value:.3g} +- {scale * sigma:.2g}{unit} (1 sigma)"
        for k, value, sigma, size in zip(columns, c, np.sqrt(np.diag(covariance)), z, strict=True)
        if size >= min(NAMED_Z, z.max())
    ]
    changed = np.zeros(CONSTANTS)
    changed[columns] = c
    error = _error_mm(changed, measurements, camera_p)
    sentence = (
        f"the corners of tags and board fit better with {', '.join(said)} (declared to 1 sigma of "
        f"{scale * sigmas[columns[0]]:.2g}{unit}){_meaning(error)}: the camera's calibration does not hold, "
        f"{text.remedy}"
    )
    return [Condition(_severity(error, config), sentence, error)]


def _misfit_condition(corners: CornerInformation) -> list[Condition]:
    """Corners that no constants make fit: a lens whose distortion is not as declared, or a print that is not flat."""
    poor = corners.weight < 1.0
    if poor.sum() < MISFIT_DETECTIONS or poor.mean() < MISFIT_SHARE:
        return []
    miss_px = MODEL_PX * math.sqrt(float(np.median(corners.misfit[poor])))
    text = (
        f"in {int(poor.sum())} of {len(poor)} detections the corners miss tag or board by {miss_px:.2f} px, whatever "
        "focal lengths, centres and stereo pose: the camera's calibration does not hold (lens distortion), or a print "
        "is not flat; calibrate the cameras again"
    )
    return [Condition(Verdict.WARNING, text)]


def _error_mm(c: FloatArray, measurements: Measurements, camera_p: Sequence[FloatArray]) -> float:
    """Shift at the worst target (n, 3) by which constants (19,) move the poses of the pairs' markers on average."""
    if not camera_p:
        return 0.0
    moves = []
    for pair in measurements.pairs:
        if pair.marker.dependence is not None:
            w, n = np.split(pair.marker.dependence.gain @ c, 2)
            moves.append([n + np.cross(w, p - pair.marker.camera_T_marker[:3, 3]) for p in camera_p])
    return float(np.linalg.norm(np.mean(moves, axis=0), axis=-1).max()) if moves else 0.0


def _meaning(error_mm: float) -> str:
    return f" ({error_mm:.1f} mm at the worst target)" if error_mm else ""


def _severity(error_mm: float, config: SolveConfig) -> Verdict:
    return Verdict.REFUSED if error_mm > 2.0 * config.limit_mm else Verdict.WARNING


def _columns(constants: Sequence[Constant]) -> IntArray:
    return np.array([column(constant) for constant in constants], dtype=np.int64)


def _measured(corners: CornerInformation, columns: IntArray, sigmas: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(estimate (m,), covariance (m, m)) of constants with a flat prior on them and the declared ones on the others."""
    prior = sigmas.copy()
    prior[columns] = _FLAT * DEFAULT_SIGMAS[columns]
    mean, covariance = posterior_of(corners.information, corners.pull, prior)
    return mean[columns], covariance[np.ix_(columns, columns)]


def _p_value(c: FloatArray, covariance: FloatArray, sigmas: FloatArray) -> float:
    """Of constants that measure as c with this covariance, declared with these standard deviations."""
    total = covariance + np.diag(sigmas**2)
    return float(chdtrc(len(c), max(float(c @ np.linalg.solve(total, c)), 0.0)))
