"""The posterior Cramer-Rao bound: the least covariance that any estimate can have on average, evaluated at the truth.

The information of the reduced problem (Gauss-Newton Hessian: marker noise, PMs, lambda and theta' eliminated, priors of
window and edge included) at noise-free measurements and the true state. Its inverse, propagated to the targets, is the
least mean squared error (van Trees, 1968, with the Gaussian window as the prior of theta').
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, as_float_array, inverse, transform_points
from fgreg.graph.packing import pack
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.reduced_graph import evaluate
from fgreg.graph.shared_state import make_state
from fgreg.model.measurements import Aim, KnownPoint, Look, MarkerObservation, Measurements, Pair, VisibleSpot
from fgreg.model.session_model import SessionModel


@dataclass(frozen=True, slots=True, eq=False)
class FullTruth:
    """The complete simulated truth.

    Attributes:
        trus_T_camera: (4, 4) of each epoch. marker_T_laser: (4, 4).
        trus_p_pm_mm: (3,) by PM.
        pair_camera_T_marker, aim_camera_T_marker: true (4, 4), in the order of the measurements.
        window_edge_rad: true half width less the stated one. marker_bias_mm: (3,) camera axes.
    """

    trus_T_camera: Sequence[FloatArray]
    marker_T_laser: FloatArray
    trus_p_pm_mm: Mapping[int, FloatArray]
    pair_camera_T_marker: Sequence[FloatArray]
    aim_camera_T_marker: Sequence[FloatArray]
    window_edge_rad: float = 0.0
    marker_bias_mm: FloatArray | None = None


def _exact_marker(observed: MarkerObservation, true_T: FloatArray, bias_mm: FloatArray) -> MarkerObservation:
    shifted = np.array(true_T, dtype=np.float64)
    shifted[:3, 3] += bias_mm
    return replace(observed, camera_T_marker=as_float_array(shifted, 4, 4))


def _exact_look(look: Look, trus_p: FloatArray, radius_mm: float) -> Look:
    """The look as it would read without noise, at the stage angle that was recorded."""
    dy = float(trus_p[1]) - radius_mm * np.sin(look.scan_rad)
    dz = float(trus_p[2]) - radius_mm * np.cos(look.scan_rad)
    return replace(look, x_mm=float(trus_p[0]), range_mm=float(np.hypot(dy, dz)))


def _exact_spot(pair: Pair, truth: FullTruth) -> VisibleSpot | None:
    """The pair's spot as it would be seen without noise."""
    if pair.spot is None:
        return None
    camera_p = transform_points(inverse(truth.trus_T_camera[pair.epoch]), truth.trus_p_pm_mm[pair.pm])
    return replace(pair.spot, camera_p_mm=as_float_array(camera_p, 3))


def _exact_point(point: KnownPoint, truth: FullTruth) -> KnownPoint:
    """The point as the camera would have it without noise, where the scanner has it."""
    camera_p = transform_points(inverse(truth.trus_T_camera[point.epoch]), point.trus_p_mm)
    return replace(point, camera_p_mm=as_float_array(camera_p, 3))


def _exact_aim(aim: Aim, true_T: FloatArray, truth: FullTruth, bias_mm: FloatArray) -> Aim:
    """The aim with its marker as it was and its spot on the true beam, as far along as the recorded one."""
    camera_T_laser = true_T @ truth.marker_T_laser
    along = float(transform_points(inverse(camera_T_laser), aim.camera_p_spot_mm)[2])
    spot = camera_T_laser[:3, 3] + along * camera_T_laser[:3, 2]
    return replace(aim, marker=_exact_marker(aim.marker, true_T, bias_mm), camera_p_spot_mm=as_float_array(spot, 3))


def truth_covariance(
    measurements: Measurements, model: SessionModel, truth: FullTruth, rotation_sigma_rad: float | None = None
) -> FloatArray:
    """(D, D) inverse information of the shared variables at the truth; epochs' right tangents come first.

    ``rotation_sigma_rad``: were each look's rotation measured besides, about the window's middle.
    """
    return _inverse(_truth_information(measurements, model, truth, rotation_sigma_rad)[0])


def beam_covariance(measurements: Measurements, model: SessionModel, truth: FullTruth) -> FloatArray:
    """(4, 4) bound of the beam chart (x, y, a, b) about the true beam, from the aims alone."""
    alone = replace(measurements, pairs=(), epochs=measurements.epochs[:1], points=())
    information, at = _truth_information(alone, model, replace(truth, pair_camera_T_marker=()))
    # Without pairs the registration is undetermined; only the aims and the prior of the bias determine the beam.
    return _inverse(information[at:, at:])[:4, :4]


def _inverse(information: FloatArray) -> FloatArray:
    scale = 1.0 / np.sqrt(np.diag(information))
    return np.asarray(np.linalg.inv(information * scale * scale[:, None]) * scale * scale[:, None])


def _truth_information(
    measurements: Measurements, model: SessionModel, truth: FullTruth, rotation_sigma_rad: float | None = None
) -> tuple[FloatArray, int]:
    """Information (D, D) of the shared variables at the truth, and where the beam chart's part begins."""
    bias = np.zeros(3) if truth.marker_bias_mm is None else np.asarray(truth.marker_bias_mm, dtype=np.float64)
    pairs = tuple(
        replace(
            pair,
            marker=_exact_marker(pair.marker, true_T, bias),
            look=_exact_look(pair.look, truth.trus_p_pm_mm[pair.pm], model.probe.radius_mm),
            spot=_exact_spot(pair, truth),
        )
        for pair, true_T in zip(measurements.pairs, truth.pair_camera_T_marker, strict=True)
    )
    aims = tuple(
        _exact_aim(aim, true_T, truth, bias)
        for aim, true_T in zip(measurements.aims, truth.aim_camera_T_marker, strict=True)
    )
    known = tuple(_exact_point(point, truth) for point in measurements.points)
    problem = pack(replace(measurements, aims=aims, pairs=pairs, points=known), model)
    if rotation_sigma_rad is not None:
        weight = problem.looks.weight.copy()
        weight[:, 2, 2] += rotation_sigma_rad**-2
        problem = replace(problem, looks=replace(problem.looks, weight=weight))
    epochs = len(measurements.epochs)
    state = make_state(np.stack(truth.trus_T_camera[:epochs])[None], truth.marker_T_laser)
    state.constants[:, Constant.WINDOW_EDGE] = truth.window_edge_rad
    state.constants[:, Constant.MARKER_BIAS_X : Constant.MARKER_BIAS_Z + 1] = bias
    points = np.array([truth.trus_p_pm_mm[pm] for pm in problem.pms], dtype=np.float64).reshape(1, -1, 3)
    private = replace(initial_private(problem, state), trus_p_pm=points)
    return evaluate(problem, state, private).hessian[0], problem.columns.beam
