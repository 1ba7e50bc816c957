"""Measurements as flat arrays, for the reduced problem.

A *beam* is one marker observation of one PM (looks of one PM that share an observation share the beam). A *look* is one
hearing of a PM. Marker covariances are rotated to the camera's axes about the marker's origin, where the reduced
problem perturbs the pose by a twist (w, n): the right tangent of GTSAM's Pose3, in other axes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.rig import CAMERA, COUNT, Constant
from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray, adjoint, inverse, parent_from_right_covariance
from fgreg.graph.columns import Columns, make_columns
from fgreg.graph.known_points import NO_POINTS, PointArrays, point_arrays
from fgreg.graph.shared_state import Quadratic
from fgreg.graph.visible_spots import SpotArrays, spot_arrays
from fgreg.model.corner_information import corner_information, observed_dependences
from fgreg.model.measurements import (
    FLOOR_MM,
    POSE_FLOOR,
    EpochStart,
    MarkerObservation,
    Measurements,
    Pair,
    usable_covariance,
    visible_spots,
)
from fgreg.model.probe_model import SensitivityModel
from fgreg.model.sensitivity import AMPLITUDE_SIGMA, WindowShapes, amplitude_table, sensitivity_priors, window_shapes
from fgreg.model.session_model import SessionModel
from fgreg.model.wavefront_evidence import wavefront_evidence

LEAST_EDGE_SIGMA_RAD = 1e-9
"""The window's edge is always a variable."""
LINE_SIGMA_MM = 1e-3
"""Sigma of point on line, which is an equality: it keeps the covariance invertible (as in the factors)."""


@dataclass(frozen=True, slots=True, eq=False)
class BeamArrays:
    """Marker observations.

    Attributes:
        rotation: (n, 3, 3). translation_mm: (n, 3).
        covariance: (n, 6, 6) along the camera's axes.
        by_constants: (n, 6, C) twist by which errors of the constants of ``CAMERA`` move the pose, camera axes.
        offset_mm: (n,) standard deviation of the spot beside the beam.
    """

    rotation: FloatArray
    translation_mm: FloatArray
    covariance: FloatArray
    by_constants: FloatArray
    offset_mm: FloatArray

    def none(self) -> BeamArrays:
        """The same without observations."""
        return BeamArrays(*(getattr(self, name)[:0] for name in self.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class LookArrays:
    """Looks: scan (L,) rad, x and range (L,) mm, weight (L, 3, 3) over (x, range, rotation), prior on the rotation.

    The rotation offset's prior: ``rotation - centre - edge_gain * window_edge - window_centre`` with sigma (in
    ``weight``). ``sweep`` (L,): +1, -1, or 0 where it is not known.
    """

    scan_rad: FloatArray
    sweep: FloatArray
    x_mm: FloatArray
    range_mm: FloatArray
    weight: FloatArray
    centre_rad: FloatArray
    edge_gain: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class RotationShapes:
    """Likelihoods of the looks' rotations in their own shape, not as Gaussians, for sampling the posterior.

    Attributes:
        windows: interval of each look.
        plane_rad: (J, G) plane angles at which each PM's amplitudes were compared with the sensitivity curve, or None.
        amplitude_log: (J, G) log likelihood of the amplitudes there, 0 at its best; zero for PMs without.
        amplitude_look: (J,) the look to which the amplitudes of its PM are assigned, -1 for PMs without.
    """

    windows: WindowShapes
    plane_rad: FloatArray
    amplitude_log: FloatArray
    amplitude_look: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class EpochLink:
    """Prior between epochs: ``trus_T_camera[new] = trus_T_camera[old] * old_T_new``, information over the tangent."""

    old: int
    new: int
    old_T_new: FloatArray
    information: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ConstantsPrior:
    """Gaussian prior of the rig's constants that are variables: mean (K,), information (K, K)."""

    mean: FloatArray
    information: FloatArray

    @classmethod
    def none(cls, columns: Columns) -> ConstantsPrior:
        """No prior."""
        count = len(columns.constants)
        return cls(np.zeros(count), np.zeros((count, count)))


@dataclass(frozen=True, slots=True, eq=False)
class PackedProblem:
    """All measurements of a session as arrays; indices say which PM and epoch each belongs to.

    ``anchor``: a Gaussian prior of all shared variables.

    ``aim_spot_by_constants`` (A, 3, C): as ``BeamArrays.by_constants``, of the spots. ``prior``: of the constants that
    are variables. ``log_outlier`` (J,): where each PM may be an inlier or an outlier, the log density of an outlier
    over that of an inlier at its best.
    """

    columns: Columns
    pms: tuple[int, ...]
    beam_pm: IntArray
    beam_epoch: IntArray
    beams: BeamArrays
    look_pm: IntArray
    look_beam: IntArray
    looks: LookArrays
    spots: SpotArrays
    aims: BeamArrays
    aim_spot_mm: FloatArray
    aim_spot_covariance: FloatArray
    aim_spot_by_constants: FloatArray
    points: PointArrays
    links: tuple[EpochLink, ...]
    radius_mm: float
    prior: ConstantsPrior
    shapes: RotationShapes | None = None
    anchor: Quadratic | None = None
    log_outlier: FloatArray | None = None


_CAMERA_COUNT = CAMERA.stop - CAMERA.start
BIAS = slice(Constant.MARKER_BIAS_X - CAMERA.start, Constant.MARKER_BIAS_Z + 1 - CAMERA.start)
"""The marker's bias among the camera's constants."""


def marker_gain(marker: MarkerObservation) -> FloatArray:
    """(6, COUNT) twist by which errors of the constants move a marker's observation, camera axes."""
    gain = np.zeros((6, COUNT))
    if marker.dependence is not None:
        gain[:, CAMERA] = marker.dependence.gain
    gain[3:, Constant.MARKER_BIAS_X : Constant.MARKER_BIAS_Z + 1] = -np.eye(3)  # the bias is measured less true
    return gain


def line_sigma_mm(beam_offset_mm: float) -> float:
    """Sigma of point on line, each axis, for a spot that lies beside the beam."""
    return math.hypot(LINE_SIGMA_MM, beam_offset_mm)


def least_sigmas(sigmas: FloatArray) -> FloatArray:
    """(COUNT,) standard deviations of the constants with that of the window's edge, which is always a variable."""
    sigmas = np.array(sigmas, dtype=np.float64)
    sigmas[Constant.WINDOW_EDGE] = max(sigmas[Constant.WINDOW_EDGE], LEAST_EDGE_SIGMA_RAD)
    return sigmas


def _beam_arrays(markers: Sequence[MarkerObservation], offset_mm: FloatArray) -> BeamArrays:
    n = len(markers)
    gain = np.zeros((n, 6, _CAMERA_COUNT))
    if not n:
        return BeamArrays(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 6, 6)), gain, offset_mm)
    transforms = np.stack([marker.camera_T_marker for marker in markers])
    covariance = usable_covariance(np.stack([marker.covariance for marker in markers]), POSE_FLOOR)
    rotation = np.ascontiguousarray(transforms[:, :3, :3])
    for i, marker in enumerate(markers):
        if marker.dependence is not None:
            gain[i] = marker.dependence.gain
    gain[:, 3:, BIAS] = -np.eye(3)  # as marker_gain, for all at once
    spread = parent_from_right_covariance(rotation, covariance)
    return BeamArrays(rotation, transforms[:, :3, 3].copy(), spread, gain, offset_mm)


def constants_prior(
    measurements: Measurements,
    columns: Columns,
    sigmas: FloatArray,
    mean: FloatArray,
    correlation: FloatArray | None = None,
) -> ConstantsPrior:
    """Prior of the constants that are variables, from what is known of them and what pictures and wavefronts say.

    Args:
        measurements: with the pictures' dependence and the wavefronts, where there are frames.
        columns: which constants are variables.
        sigmas, mean: (COUNT,) of all constants; an infinite sigma: nothing is known.
        correlation: (COUNT, COUNT); none where None.
    """
    chosen = np.array(columns.constants, dtype=np.int64)
    seen = evidence(measurements, columns)
    known = np.diag(sigmas[chosen] ** -2.0)
    if correlation is not None:
        known = np.linalg.inv(correlation[np.ix_(chosen, chosen)]) / np.outer(sigmas[chosen], sigmas[chosen])
    information = known + seen.information
    pull = known @ mean[chosen] + seen.information @ seen.mean
    return ConstantsPrior(_mean(information, pull), information)


def evidence(measurements: Measurements, columns: Columns) -> ConstantsPrior:
    """What pictures of tags and boards, and wavefronts, say about the constants by themselves.

    It is the same in every shot, so it enters here, not shot by shot; without what is known of the constants otherwise.
    """
    information, pull = wavefront_evidence(pair.look for pair in measurements.pairs)
    found = corner_information([*observed_dependences(measurements)])
    if found is not None:
        information[CAMERA, CAMERA] = found.information
        pull[CAMERA] = found.pull
    chosen = np.array(columns.constants, dtype=np.int64)
    information, pull = information[np.ix_(chosen, chosen)], pull[chosen]
    return ConstantsPrior(_mean(information, pull), information)


def tells_of_constants(pair: Pair) -> bool:
    """Whether a pair's frames say something about the constants by themselves (:func:`evidence`)."""
    seen = pair.marker.dependence
    return pair.look.wavefront is not None or (seen is not None and bool(seen.information.any()))


def _mean(information: FloatArray, pull: FloatArray) -> FloatArray:
    """Mean of a Gaussian from its information (K, K), which may be singular, and information times mean."""
    if not pull.any():
        return np.zeros(len(pull))
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-30))
    inverse = np.linalg.pinv(information * np.outer(scale, scale), rcond=1e-10, hermitian=True)
    return np.asarray(scale * (inverse @ (scale * pull)))


def _links(epochs: Sequence[EpochStart]) -> tuple[EpochLink, ...]:
    links = []
    for k, epoch in enumerate(epochs[1:], 1):
        motion, covariance = epoch.camera_new_T_camera_old, epoch.covariance
        if motion is not None and covariance is not None:
            # new_T_old Exp(xi) inverted is old_T_new Exp(-Ad xi): the covariance moves to the other frame.
            turn = adjoint(motion)
            spread = turn @ usable_covariance(covariance, POSE_FLOOR) @ turn.T
            information = np.asarray(np.linalg.inv(spread), dtype=np.float64)
            links.append(EpochLink(epoch.old(k), k, inverse(motion), information))
    return tuple(links)


SEARCHED = (Constant.WINDOW_EDGE, Constant.MARKER_BIAS_X, Constant.MARKER_BIAS_Y, Constant.MARKER_BIAS_Z)
"""The constants that are variables while minima are searched: those that move the optimum most."""


def search_sigmas(model: SessionModel) -> FloatArray:
    """(COUNT,) standard deviations of the constants in the search for minima: all others count as exact there."""
    sigmas = np.zeros(COUNT)
    sigmas[list(SEARCHED)] = model.constant_sigmas[list(SEARCHED)]
    return sigmas


def pack(
    measurements: Measurements,
    model: SessionModel,
    *,
    sigmas: FloatArray | None = None,
    mean: FloatArray | None = None,
    shapes: bool = False,
    amplitude_sigma: float = AMPLITUDE_SIGMA,
) -> PackedProblem:
    """Pack measurements as arrays.

    Args:
        measurements: aims, pairs and epochs.
        model: the session's set-up.
        sigmas: (COUNT,) prior standard deviations of the rig's constants; 0: no variable. None: the session's. Those
            that are not the session's are of constants that are independent of all others.
        mean: (COUNT,) prior means; None: the session's.
        shapes: keep the windows' own shapes, and the amplitudes, for the posterior, in addition to the Gaussian priors.
        amplitude_sigma: relative noise of amplitudes.
    """
    probe = model.probe
    correlation = model.constant_correlation
    if sigmas is not None and correlation is not None:
        correlation = _independent(correlation, sigmas != model.constant_sigmas)
    sigmas = least_sigmas(model.constant_sigmas if sigmas is None else sigmas)
    mean = model.constant_means if mean is None else mean
    columns = make_columns(len(measurements.epochs), sigmas)
    aims = measurements.aims
    alone = pack_pairs(
        measurements.pairs,
        columns,
        probe.sensitivity,
        radius_mm=probe.radius_mm,
        step_rad=model.stage.step_rad,
        shapes=shapes,
        amplitude_sigma=amplitude_sigma,
    )
    by_constants = np.zeros((len(aims), 3, _CAMERA_COUNT))
    for i, aim in enumerate(aims):
        if aim.dependence is not None:
            by_constants[i] = aim.dependence.gain
    return replace(
        alone,
        aims=_beam_arrays([aim.marker for aim in aims], np.zeros(len(aims))),
        aim_spot_mm=np.array([aim.camera_p_spot_mm for aim in aims], dtype=np.float64).reshape(-1, 3),
        aim_spot_covariance=usable_covariance(
            np.array([aim.covariance for aim in aims], dtype=np.float64).reshape(-1, 3, 3), (FLOOR_MM,) * 3
        ),
        aim_spot_by_constants=by_constants,
        points=point_arrays(measurements.points, model, [point.epoch for point in measurements.points]),
        links=_links(measurements.epochs),
        prior=constants_prior(measurements, columns, sigmas, mean, correlation),
    )


def _independent(correlation: FloatArray, alone: BoolArray) -> FloatArray:
    """The correlation (n, n) where some quantities (n,) depend on no other one."""
    joint = np.outer(~alone, ~alone) | np.eye(len(alone), dtype=bool)
    return np.where(joint, correlation, 0.0)


def pack_more(pairs: Sequence[Pair], model: SessionModel, columns: Columns) -> PackedProblem:
    """Pairs alone, with the columns of another problem of the session; windows as Gaussians."""
    return pack_pairs(
        pairs,
        columns,
        model.probe.sensitivity,
        radius_mm=model.probe.radius_mm,
        step_rad=model.stage.step_rad,
        shapes=False,
        amplitude_sigma=AMPLITUDE_SIGMA,
    )


def pack_pairs(
    pairs: Sequence[Pair],
    columns: Columns,
    sensitivity: SensitivityModel,
    *,
    radius_mm: float,
    step_rad: float,
    shapes: bool,
    amplitude_sigma: float,
) -> PackedProblem:
    """Pairs alone: no aims, no links, no priors (arguments as of :func:`pack`; ``step_rad``: the sweeps' increment)."""
    pms = tuple(dict.fromkeys(pair.pm for pair in pairs))
    pm_index = {pm: index for index, pm in enumerate(pms)}
    first_of_beam: dict[tuple[int, int], Pair] = {}
    for pair in pairs:
        first_of_beam.setdefault((pair.pm, pair.marker.id), pair)
    beam_pairs = tuple(first_of_beam.values())
    beam_index = {key: index for index, key in enumerate(first_of_beam)}
    looks = [pair.look for pair in pairs]
    priors = sensitivity_priors(looks, sensitivity, step_rad)
    weight = np.zeros((len(looks), 3, 3))
    if looks:
        weight[:, :2, :2] = np.linalg.inv(
            usable_covariance(np.stack([look.covariance for look in looks]), (FLOOR_MM,) * 2)
        )
        weight[:, 2, 2] = priors.sigma_rad**-2
    return PackedProblem(
        columns=columns,
        pms=pms,
        beam_pm=np.array([pm_index[pair.pm] for pair in beam_pairs], dtype=np.int64),
        beam_epoch=np.array([pair.epoch for pair in beam_pairs], dtype=np.int64),
        beams=_beam_arrays(
            [pair.marker for pair in beam_pairs],
            np.array([pair.beam_offset_mm for pair in beam_pairs], dtype=np.float64),
        ),
        look_pm=np.array([pm_index[pair.pm] for pair in pairs], dtype=np.int64),
        look_beam=np.array([beam_index[pair.pm, pair.marker.id] for pair in pairs], dtype=np.int64),
        looks=LookArrays(
            scan_rad=np.array([look.scan_rad for look in looks], dtype=np.float64),
            sweep=np.array([look.sweep for look in looks], dtype=np.float64),
            x_mm=np.array([look.x_mm for look in looks], dtype=np.float64),
            range_mm=np.array([look.range_mm for look in looks], dtype=np.float64),
            weight=weight,
            centre_rad=priors.centre_rad,
            edge_gain=priors.edge_gain,
        ),
        spots=spot_arrays({beam_index[key]: spot for key, spot in visible_spots(pairs).items()}),
        aims=_beam_arrays([], np.zeros(0)),
        aim_spot_mm=np.zeros((0, 3)),
        aim_spot_covariance=np.zeros((0, 3, 3)),
        aim_spot_by_constants=np.zeros((0, 3, _CAMERA_COUNT)),
        points=NO_POINTS,
        links=(),
        radius_mm=radius_mm,
        prior=ConstantsPrior.none(columns),
        shapes=_rotation_shapes(pairs, pm_index, sensitivity, step_rad, amplitude_sigma) if shapes else None,
    )


def _rotation_shapes(
    pairs: Sequence[Pair],
    pm_index: dict[int, int],
    sensitivity: SensitivityModel,
    step_rad: float,
    amplitude_sigma: float,
) -> RotationShapes:
    looks = [pair.look for pair in pairs]
    plane, log, look_of = [], [], []
    of_pm: dict[int, list[int]] = {}
    for i, pair in enumerate(pairs):
        of_pm.setdefault(pair.pm, []).append(i)
    for pm in pm_index:
        mine = of_pm[pm]
        table = amplitude_table([looks[i] for i in mine], sensitivity, amplitude_sigma)
        plane.append(table.plane_rad)
        log.append(table.log_likelihood)
        # A look that is no first hit is preferred: its interval does not depend on the window's edge.
        free = [i for i in mine if looks[i].sweep == 0] or mine
        look_of.append(free[0] if table.used else -1)
    return RotationShapes(
        window_shapes(looks, sensitivity, step_rad),
        np.array(plane).reshape(len(pm_index), -1),
        np.array(log).reshape(len(pm_index), -1),
        np.array(look_of, dtype=np.int64),
    )


def edge_sigma_rad(problem: PackedProblem) -> float:
    """Prior standard deviation of the window's edge, the other shared variables given."""
    at, place = problem.columns.at(Constant.WINDOW_EDGE), problem.columns.constants.index(Constant.WINDOW_EDGE)
    held = problem.prior.information[place, place]
    if problem.anchor is not None:
        held = held + problem.anchor.hessian[at, at]
    return float(held**-0.5)


def only_aims(problem: PackedProblem) -> PackedProblem:
    """The calibration shots alone: no pairs, no links, no priors."""
    none = np.zeros(0, dtype=np.int64)
    looks = problem.looks
    return replace(
        problem,
        pms=(),
        beam_pm=none,
        beam_epoch=none,
        beams=problem.beams.none(),
        look_pm=none,
        look_beam=none,
        looks=LookArrays(*(getattr(looks, name)[:0] for name in LookArrays.__slots__)),
        spots=problem.spots.take(none),
        points=NO_POINTS,
        links=(),
        prior=ConstantsPrior.none(problem.columns),
        shapes=None,
        anchor=None,
        log_outlier=None,
    )


def without_aims(problem: PackedProblem, anchor: Quadratic) -> PackedProblem:
    """The problem with a Gaussian prior of the shared variables in place of its calibration shots (and other prior)."""
    return replace(
        problem,
        aims=problem.aims.none(),
        aim_spot_mm=problem.aim_spot_mm[:0],
        aim_spot_covariance=problem.aim_spot_covariance[:0],
        aim_spot_by_constants=problem.aim_spot_by_constants[:0],
        anchor=anchor,
    )
