"""Measurements as flat arrays, for the reduced problem.

A *beam* is one marker observation of one PM (looks of one PM that share an observation share the beam). A *look* is one
hearing of a PM. Marker covariances are rotated to the camera's axes about the marker's origin, where the reduced
problem perturbs the pose by a twist (w, n): the right tangent of GTSAM's Pose3, in other axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.transforms import FloatArray, IntArray, adjoint, inverse, parent_from_right_covariance
from fgreg.graph.columns import Columns, make_columns
from fgreg.graph.shared_state import Quadratic
from fgreg.model.measurements import (
    FLOOR_MM,
    POSE_FLOOR,
    EpochStart,
    MarkerObservation,
    Measurements,
    Pair,
    usable_covariance,
)
from fgreg.model.sensitivity import AMPLITUDE_SIGMA, WindowShapes, amplitude_table, sensitivity_priors, window_shapes
from fgreg.model.session_model import SensitivityModel, SessionModel

LINE_SIGMA_MM = 1e-3
"""Sigma of point on line, which is an equality: it keeps the covariance invertible (as in the factors)."""


@dataclass(frozen=True, slots=True, eq=False)
class BeamArrays:
    """Marker observations: rotation (n, 3, 3), translation (n, 3) mm, covariance (n, 6, 6) along the camera's axes."""

    rotation: FloatArray
    translation_mm: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LookArrays:
    """Looks: scan (L,) rad, x and range (L,) mm, weight (L, 3, 3) over (x, range, rotation), prior on the rotation.

    The rotation offset's prior: ``rotation - centre - edge_gain * window_edge`` with sigma (in ``weight``).
    """

    scan_rad: FloatArray
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
class PackedProblem:
    """All measurements of a session as arrays; indices say which PM and epoch each belongs to.

    ``anchor``: a Gaussian prior of all shared variables.

    ``log_outlier`` (J,): where each PM may be an inlier or an outlier, the log density of an outlier over that of an
    inlier at its best.
    """

    columns: Columns
    pms: tuple[int, ...]
    beam_pm: IntArray
    beam_epoch: IntArray
    beams: BeamArrays
    look_pm: IntArray
    look_beam: IntArray
    looks: LookArrays
    aims: BeamArrays
    aim_spot_mm: FloatArray
    aim_spot_covariance: FloatArray
    links: tuple[EpochLink, ...]
    radius_mm: float
    prior_information: FloatArray
    shapes: RotationShapes | None = None
    sound_speed_mean: float = 1.0
    anchor: Quadratic | None = None
    log_outlier: FloatArray | None = None


def _beam_arrays(markers: Sequence[MarkerObservation]) -> BeamArrays:
    if not markers:
        return BeamArrays(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 6, 6)))
    transforms = np.stack([marker.camera_T_marker for marker in markers])
    covariance = usable_covariance(np.stack([marker.covariance for marker in markers]), POSE_FLOOR)
    rotation = np.ascontiguousarray(transforms[:, :3, :3])
    return BeamArrays(rotation, transforms[:, :3, 3].copy(), parent_from_right_covariance(rotation, covariance))


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


def pack(
    measurements: Measurements,
    model: SessionModel,
    *,
    sound_speed_sigma: float | None = None,
    sound_speed_mean: float = 1.0,
    radius_sigma_mm: float | None = None,
    shapes: bool = False,
    amplitude_sigma: float = AMPLITUDE_SIGMA,
) -> PackedProblem:
    """Pack measurements as arrays.

    Args:
        measurements: aims, pairs and epochs.
        model: the session's set-up.
        sound_speed_sigma: prior sigma of the sound speed ratio; None: not estimated.
        sound_speed_mean: its prior mean.
        radius_sigma_mm: prior sigma of the probe's radius; None: not estimated.
        shapes: keep the windows' own shapes, and the amplitudes, for the posterior, in addition to the Gaussian priors.
        amplitude_sigma: relative noise of amplitudes.
    """
    probe = model.probe
    columns = make_columns(
        len(measurements.epochs),
        bias=model.noise.marker_bias_mm > 0,
        sound_speed=sound_speed_sigma is not None,
        radius=radius_sigma_mm is not None,
    )
    prior_information = np.zeros(columns.size)
    prior_information[columns.edge] = max(probe.sensitivity.edge_sigma_rad, 1e-9) ** -2
    if columns.bias is not None:
        prior_information[columns.bias : columns.bias + 3] = model.noise.marker_bias_mm**-2
    if columns.sound_speed is not None and sound_speed_sigma is not None:
        prior_information[columns.sound_speed] = sound_speed_sigma**-2
    if columns.radius is not None and radius_sigma_mm is not None:
        prior_information[columns.radius] = radius_sigma_mm**-2
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
    return replace(
        alone,
        aims=_beam_arrays([aim.marker for aim in aims]),
        aim_spot_mm=np.array([aim.camera_p_spot_mm for aim in aims], dtype=np.float64).reshape(-1, 3),
        aim_spot_covariance=usable_covariance(
            np.array([aim.covariance for aim in aims], dtype=np.float64).reshape(-1, 3, 3), (FLOOR_MM,) * 3
        ),
        links=_links(measurements.epochs),
        prior_information=prior_information,
        sound_speed_mean=sound_speed_mean,
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
        beams=_beam_arrays([pair.marker for pair in beam_pairs]),
        look_pm=np.array([pm_index[pair.pm] for pair in pairs], dtype=np.int64),
        look_beam=np.array([beam_index[pair.pm, pair.marker.id] for pair in pairs], dtype=np.int64),
        looks=LookArrays(
            scan_rad=np.array([look.scan_rad for look in looks], dtype=np.float64),
            x_mm=np.array([look.x_mm for look in looks], dtype=np.float64),
            range_mm=np.array([look.range_mm for look in looks], dtype=np.float64),
            weight=weight,
            centre_rad=priors.centre_rad,
            edge_gain=priors.edge_gain,
        ),
        aims=_beam_arrays([]),
        aim_spot_mm=np.zeros((0, 3)),
        aim_spot_covariance=np.zeros((0, 3, 3)),
        links=(),
        radius_mm=radius_mm,
        prior_information=np.zeros(columns.size),
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


def only_aims(problem: PackedProblem) -> PackedProblem:
    """The calibration shots alone: no pairs, no links, no priors."""
    none = np.zeros(0, dtype=np.int64)
    looks, beams = problem.looks, problem.beams
    return replace(
        problem,
        pms=(),
        beam_pm=none,
        beam_epoch=none,
        beams=BeamArrays(beams.rotation[:0], beams.translation_mm[:0], beams.covariance[:0]),
        look_pm=none,
        look_beam=none,
        looks=LookArrays(*(getattr(looks, name)[:0] for name in LookArrays.__slots__)),
        links=(),
        prior_information=np.zeros_like(problem.prior_information),
        shapes=None,
        anchor=None,
        log_outlier=None,
    )


def without_aims(problem: PackedProblem, anchor: Quadratic) -> PackedProblem:
    """The problem with a Gaussian prior of the shared variables in place of its calibration shots (and other prior)."""
    aims = problem.aims
    return replace(
        problem,
        aims=BeamArrays(aims.rotation[:0], aims.translation_mm[:0], aims.covariance[:0]),
        aim_spot_mm=problem.aim_spot_mm[:0],
        aim_spot_covariance=problem.aim_spot_covariance[:0],
        anchor=anchor,
    )
