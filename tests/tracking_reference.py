"""Answers to tracking queries, slow: what those of fgreg.tracking are held to.

A PM that is heard goes through the reduced problem with all epochs' variables, to the last digit; or, of a session
that is solved again with the PM in it, has the angle that it has there. The end on the tissue surface is spread by many
samples, on a fine grid of the Gaussian process itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, exp_so3
from fgreg.graph.expectation_propagation import propagate, settle
from fgreg.graph.packing import ConstantsPrior, PackedProblem
from fgreg.graph.reduced_solver import Optimum, optimize
from fgreg.graph.shared_state import SharedState, gaussian_prior, make_state
from fgreg.model.estimate import TrackEstimate
from fgreg.model.measurements import EpochStart, Measurements, Pair, Track
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.tissue_surface import GRAZING, LONGEST_MM, REACH_MM, TissueSurface
from fgreg.registration.register import pack_session
from tests.forward import Truth
from tests.track_cases import Solved

SAMPLES = 40_000
"""Of the Gaussian that a query takes the shared variables for."""


def track(query: Track, solved: Solved) -> TrackEstimate:
    """Answer one query; ``stage_rad`` None with a reason where it cannot be answered."""
    if query.epoch not in solved.epochs:
        return _refused(query, solved, f"camera epoch {query.epoch} has no registration")
    scan_rad: float
    if query.looks:
        scan_rad, sigma_rad, lambda_mm = _from_looks(query, solved)
    else:
        answer = _from_surface(query, solved)
        if isinstance(answer, str):
            return _refused(query, solved, answer)
        scan_rad, sigma_rad, lambda_mm = answer
    device_rad = solved.model.stage.device_from_scan(scan_rad)
    low, high = solved.model.stage.limits_device_rad
    turned = [a for a in (device_rad, device_rad - 2 * math.pi, device_rad + 2 * math.pi) if low <= a <= high]
    if turned:
        device_rad = turned[0]
    else:
        reason = f"the stage would have to turn to {math.degrees(device_rad):.1f} deg, outside its limits"
        return _refused(query, solved, f"{reason} {math.degrees(low):.0f} to {math.degrees(high):.0f} deg")
    return TrackEstimate(
        query.t, device_rad, sigma_rad, lambda_mm - solved.snapshot.origin_shift_mm, solved.snapshot.causal
    )


def _refused(query: Track, solved: Solved, reason: str) -> TrackEstimate:
    return TrackEstimate(query.t, None, None, None, solved.snapshot.causal, reason)


def _angle(trus_p: FloatArray) -> tuple[float, FloatArray]:
    """Plane angle of a TRUS point (rad) and its derivative (3,) by the point (rad / mm)."""
    y, z = float(trus_p[1]), float(trus_p[2])
    square = y * y + z * z
    return math.atan2(y, z), np.array([0.0, z, -y]) / square


def _from_looks(query: Track, solved: Solved) -> tuple[float, float, float]:
    """The one PM's angle with the session's estimate as prior: (scan angle, sigma, lambda in the chart)."""
    epoch = solved.epochs.index(query.epoch)
    count = solved.posterior.mean.rotation.shape[1]
    markers = query.look_markers or (query.marker,) * len(query.looks)
    pairs = tuple(Pair(query.t, 0, epoch, marker, look) for marker, look in zip(markers, query.looks, strict=True))
    once = Measurements((), pairs, tuple(EpochStart(0.0) for _ in range(count)))
    problem = pack_session(once, solved.model, solved.config)
    if problem.columns.size != len(solved.posterior.covariance):
        raise ValueError("the session's variables are not those of its configuration")
    # The priors on the shared variables are in the session's estimate already.
    anchor = gaussian_prior(solved.posterior.mean, solved.posterior.covariance)
    problem = replace(problem, anchor=anchor, prior=ConstantsPrior.none(problem.columns))
    optimum = optimize(problem, solved.posterior.mean)
    settled = settle(problem, optimum.state, optimum.evaluation, settled=1e-4)
    if settled is not None:
        problem, state, at = settled
        optimum = optimize(problem, state, at.private, tolerance=1e-9)
    at = optimum.evaluation
    shared = np.linalg.inv(at.hessian[0])
    gain = at.point_gain[0, 0]
    covariance = at.point_covariance[0, 0] + gain @ shared @ gain.T
    angle, by_point = _angle(at.private.trus_p_pm[0, 0])
    return angle, math.sqrt(float(by_point @ covariance @ by_point)), float(at.lambda_mm[0, 0])


@dataclass(frozen=True, slots=True, eq=False)
class SessionOptimum:
    """A session's optimum with its windows' sites, and the covariance (D, D) of the shared variables there."""

    problem: PackedProblem
    optimum: Optimum
    covariance: FloatArray

    @property
    def state(self) -> SharedState:
        return self.optimum.state

    def plane_angle(self, pm: int) -> tuple[float, float]:
        """A PM's plane angle and its sigma, rad."""
        k, at = self.problem.pms.index(pm), self.optimum.evaluation
        gain = at.point_gain[0, k]
        covariance = at.point_covariance[0, k] + gain @ self.covariance @ gain.T
        angle, by_point = _angle(at.private.trus_p_pm[0, k])
        return angle, math.sqrt(float(by_point @ covariance @ by_point))


def optimum_of(measurements: Measurements, model: SessionModel, truth: Truth) -> SessionOptimum:
    """The optimum that is found from the truth."""
    problem = pack_session(measurements, model, SolveConfig())
    start = make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser)
    found = propagate(problem, optimize(problem, start))
    assert found is not None
    problem, optimum = found
    return SessionOptimum(problem, optimum, np.asarray(np.linalg.inv(optimum.evaluation.hessian[0])))


def _from_surface(query: Track, solved: Solved) -> tuple[float, float, float] | str:
    """The beam's end on the tissue surface: (scan angle, sigma, lambda in the chart), or why not."""
    if solved.snapshot.surface is None:
        return "no PM is heard and the session's PMs trace no surface yet (at least 5, not in a row)"
    epoch = solved.epochs.index(query.epoch)
    origin, direction = _beam_in_trus(query, solved.posterior.mean, epoch, np.zeros((1, 6)))
    met = meet(solved.snapshot.surface, origin[0], direction[0])
    if met is None:
        return "no PM is heard and the beam misses the part of the surface that the session's PMs trace"
    angle, _ = _angle(met.trus_p)
    rng = np.random.default_rng(0)
    columns = solved.posterior.columns
    root = np.linalg.cholesky(solved.posterior.covariance)
    step = rng.standard_normal((SAMPLES, columns.size)) @ root.T
    state = solved.posterior.mean.take(np.zeros(SAMPLES, dtype=np.int64)).retract(step, columns)
    turn = np.kron(np.eye(2), query.marker.camera_T_marker[:3, :3])
    noise = rng.multivariate_normal(np.zeros(6), turn @ query.marker.covariance @ turn.T, SAMPLES)
    origin, direction = _beam_in_trus(query, state, epoch, noise)
    height = met.normal @ met.trus_p + met.sigma_mm * rng.standard_normal(SAMPLES)
    towards = np.maximum(direction @ met.normal, 0.5 * GRAZING)
    point = origin + ((height - origin @ met.normal) / towards)[:, None] * direction
    spread = np.mod(np.arctan2(point[:, 1], point[:, 2]) - angle + np.pi, 2 * np.pi) - np.pi
    return angle, float(np.sqrt(np.mean(spread**2))), met.distance_mm


def _beam_in_trus(query: Track, state: SharedState, epoch: int, error: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Origin (S, 3) and direction (S, 3) of the query's beam for marker errors (S, 6) along the camera's axes."""
    marker = query.marker.camera_T_marker
    rotation = exp_so3(error[:, :3]) @ marker[:3, :3]
    camera_p = np.einsum("sij,sj->si", rotation, state.beam_origin()) + marker[:3, 3] + error[:, 3:]
    camera_p = camera_p - state.constants[:, Constant.MARKER_BIAS_X : Constant.MARKER_BIAS_Z + 1]
    camera_d = np.einsum("sij,sj->si", rotation, state.beam_direction())
    trus_R_camera = state.rotation[:, epoch]
    origin = np.einsum("sij,sj->si", trus_R_camera, camera_p) + state.translation_mm[:, epoch]
    return origin, np.einsum("sij,sj->si", trus_R_camera, camera_d)


@dataclass(frozen=True, slots=True, eq=False)
class Met:
    """A ray's end: distance along it (mm), point (3,) in TRUS, unit normal (3,), sigma of ``normal @ point``."""

    distance_mm: float
    trus_p: FloatArray
    normal: FloatArray
    sigma_mm: float


def meet(surface: TissueSurface, trus_p: FloatArray, trus_d: FloatArray) -> Met | None:
    """Where a ray from (3,) along the unit vector (3,) first meets the surface; None where that is not known."""
    along = np.linspace(1.0, 200.0, 4001)
    points = (trus_p + along[:, None] * trus_d - surface.centre) @ surface.axes
    height, sigma = surface.height(points[:, :2])
    gap = points[:, 2] - height
    crossing = np.flatnonzero((gap[:-1] < 0) & (gap[1:] >= 0))
    begins, ends = np.flatnonzero(gap > -2.0 * sigma), np.flatnonzero(gap > 2.0 * sigma)
    if crossing.size == 0 or ends.size == 0:
        return None
    i = int(crossing[0])
    stretch = float(along[ends[0]] - along[begins[0]])
    if ends[0] < i or stretch > LONGEST_MM:
        return None
    distance = float(along[i] - gap[i] * (along[i + 1] - along[i]) / (gap[i + 1] - gap[i]))
    place = ((trus_p + distance * trus_d - surface.centre) @ surface.axes)[:2]
    if np.linalg.norm(surface.place - place, axis=1).min() > REACH_MM:
        return None
    around = place + np.array([[0.1, 0.0], [-0.1, 0.0], [0.0, 0.1], [0.0, -0.1]])
    near, _ = surface.height(around)
    slope = np.array([near[0] - near[1], near[2] - near[3]]) / 0.2
    normal = surface.axes @ np.array([-slope[0], -slope[1], 1.0])
    normal = normal / np.linalg.norm(normal)
    towards = float(normal @ trus_d)
    if towards < GRAZING:
        return None
    return Met(distance, trus_p + distance * trus_d, normal, stretch / 4.0 * towards)
