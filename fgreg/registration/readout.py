"""Per-shot results from the optimum: the laser line, each pair, each aim."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import exp_so3, inverse, make_transform, rotation_to_direction, transform_points
from fgreg.graph.reduced_blocks import expected_rotation
from fgreg.graph.shared_state import SharedState
from fgreg.model.estimate import AimEstimate, LaserEstimate, PairEstimate
from fgreg.model.measurements import Measurements, visible_spots
from fgreg.model.sensitivity import wrap_angle
from fgreg.model.session_model import SessionModel
from fgreg.registration.outliers import pm_degrees_of_freedom
from fgreg.registration.register import Registration


@dataclass(frozen=True, slots=True, eq=False)
class LaserReadout:
    """The laser line, and lambda of its origin in the beam chart (mm)."""

    laser: LaserEstimate
    origin_shift_mm: float


def beam_origin_shift(state: SharedState, model: SessionModel) -> float:
    """Lambda (mm) in the beam chart of the laser frame's origin.

    The origin is the point on the beam nearest to the nominal tip, else nearest to the marker's origin.
    """
    direction, start = state.beam_direction()[0], state.beam_origin()[0]
    initial = model.initial_marker_T_laser
    return float(-start @ direction) if initial is None else float((initial[:3, 3] - start) @ direction)


def read_laser(registration: Registration, model: SessionModel) -> LaserReadout:
    """``marker_T_laser`` with +z along the beam, its origin as of :func:`beam_origin_shift`.

    Roll about the beam and shift along it are gauge: their variances are zero.
    """
    state, columns = registration.optimum.state, registration.problem.columns
    direction, start = state.beam_direction()[0], state.beam_origin()[0]
    initial = model.initial_marker_T_laser
    if initial is None:
        rotation = rotation_to_direction(direction)
    else:
        # The smallest rotation that brings the nominal z onto the beam: the roll of the nominal frame stays.
        if initial[:3, 2] @ direction < 0:  # the given beam points backwards
            initial = initial @ np.diag([1.0, -1.0, -1.0, 1.0])
        axis = np.cross(initial[:3, 2], direction)
        sine, cosine = float(np.linalg.norm(axis)), float(initial[:3, 2] @ direction)
        turn = axis / max(sine, 1e-12) * np.arctan2(sine, cosine)
        rotation = exp_so3(turn) @ initial[:3, :3]
    shift = beam_origin_shift(state, model)
    r0 = state.marker_T_nominal[0, :3, :3]
    chart = np.array([*state.beam[0, 2:], 1.0])
    length = float(np.linalg.norm(chart))
    unit = chart / length
    by_direction = np.zeros((3, 4))
    by_direction[:, 2:] = r0 @ ((np.eye(3) - np.outer(unit, unit)) / length)[:, :2]
    by_origin = shift * by_direction
    by_origin[:, :2] += r0[:, :2]
    along = rotation.T @ by_direction
    jacobian = np.zeros((6, 4))
    jacobian[0], jacobian[1] = -along[1], along[0]  # omega x z = (omega_y, -omega_x, 0)
    jacobian[3:5] = (rotation.T @ by_origin)[:2]
    beam = slice(columns.beam, columns.beam + 4)
    covariance = jacobian @ registration.covariance[beam, beam] @ jacobian.T
    transform = make_transform(rotation, start + shift * direction)
    return LaserReadout(LaserEstimate(transform, covariance), shift)


def read_pairs(
    measurements: Measurements,
    registration: Registration,
    model: SessionModel,
    origin_shift_mm: float,
) -> tuple[PairEstimate, ...]:
    """One estimate per pair of ``measurements``, in order; outliers have the reason why they were left out."""
    shots = registration.shots
    problem, at = shots.problem, shots.evaluation
    state = registration.optimum.state
    gain, points = at.point_gain[0], at.private.trus_p_pm[0]
    covariance = at.point_covariance[0] + gain @ registration.covariance @ np.swapaxes(gain, -1, -2)
    nis, kept = shots.innovations.pm, shots.pm_inlier
    looks = problem.looks
    radius = problem.radius_mm + float(state.constant(Constant.RADIUS)[0])
    expected = expected_rotation(problem, state)[0]
    equations = pm_degrees_of_freedom(problem)
    spots = {shot: spot.camera_p_mm for shot, spot in visible_spots(measurements.pairs).items()}
    camera_T_trus = [inverse(state.trus_T_camera(place)[0]) for place in range(len(registration.epochs))]
    out: list[PairEstimate] = []
    look = 0
    for pair in measurements.pairs:
        if pair.epoch not in registration.epochs:
            reason = f"camera epoch {pair.epoch} has too few pairs for a registration"
            out.append(PairEstimate(pair.t, pair.pm, pair.epoch, used=False, reason=reason))
            continue
        pm, scan = int(problem.look_pm[look]), float(looks.scan_rad[look])
        place, spot = registration.epochs.index(pair.epoch), spots.get((pair.pm, pair.marker.id))
        dy = float(points[pm, 1]) - radius * np.sin(scan)
        dz = float(points[pm, 2]) - radius * np.cos(scan)
        delta = float(wrap_angle(np.arctan2(dy, dz) - scan))
        rotation = float(wrap_angle(at.look_residual[0, look, 2] + expected[look]))
        out.append(
            PairEstimate(
                t=pair.t,
                pm=pair.pm,
                epoch=pair.epoch,
                used=bool(kept[pm]),
                reason="" if kept[pm] else outlier_reason(float(nis[pm])),
                lambda_mm=float(at.lambda_mm[0, problem.look_beam[look]]) - origin_shift_mm,
                theta_rad=scan + delta,
                rotation_rad=model.stage.direction * rotation,
                trus_p_pm_mm=points[pm],
                covariance=covariance[pm],
                residual_mm=float(np.hypot(*at.look_residual[0, look, :2])),
                nis=float(nis[pm]),
                nis_dof=int(equations[pm]),
                spot_error_mm=None if spot is None else transform_points(camera_T_trus[place], points[pm]) - spot,
            )
        )
        look += 1
    return tuple(out)


def outlier_reason(nis: float) -> str:
    """Why a shot was left out, with its innovation."""
    return f"outlier: it does not fit the other shots (nis {nis:.1f})"


def read_aims(
    measurements: Measurements, registration: Registration, origin_shift_mm: float
) -> tuple[AimEstimate, ...]:
    """One estimate per aim of ``measurements``, in order."""
    shots = registration.shots
    at = shots.evaluation
    # The residuals lie in the plane across the chart's z axis; their parts across the beam are a little shorter.
    residual, slope = at.aim_residual[0], registration.optimum.state.beam[0, 2:]
    square = np.sum(residual**2, axis=1) - (residual @ slope) ** 2 / (1.0 + slope @ slope)
    out = []
    for index, aim in enumerate(measurements.aims):
        nis, kept = float(shots.innovations.aim[index]), bool(shots.aim_inlier[index])
        out.append(
            AimEstimate(
                t=aim.t,
                used=kept,
                reason="" if kept else outlier_reason(nis),
                lambda_mm=float(at.aim_lambda_mm[0, index]) - origin_shift_mm,
                residual_mm=float(np.sqrt(square[index])),
                nis=nis,
            )
        )
    return tuple(out)
