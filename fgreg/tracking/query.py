"""Where to turn the stage for a beam: absolute angle with its sigma, from a snapshot of the estimate.

With a PM heard now (Eq. 11 of the publication): lambda and theta' given the registration. Here registration, beam,
marker and look enter with their covariances. The result is the posterior of the PM's angle given the session and the
query, from the reduced graph of this one PM with the estimate as its prior. The session's estimate does not change.
With no PM heard, lambda comes from the tissue surface that the PMs trace.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, exp_so3, parent_from_right_covariance
from fgreg.graph.expectation_propagation import settle
from fgreg.graph.packing import PackedProblem, pack_pairs
from fgreg.graph.reduced_blocks import initial_private, times
from fgreg.graph.reduced_graph import Evaluation, evaluate
from fgreg.graph.reduced_system import refine
from fgreg.graph.scaled_inverse import inverse_hessian
from fgreg.graph.shared_state import SharedState, gaussian_prior
from fgreg.model.estimate import TrackEstimate, Verdict
from fgreg.model.measurement_checks import problem_of
from fgreg.model.measurements import POSE_FLOOR, MarkerObservation, Pair, Track, usable_covariance
from fgreg.model.sensitivity import wrap_angle
from fgreg.model.tissue_surface import GRAZING
from fgreg.tracking.snapshot import SHARED, EpochSnapshot, Snapshot

SAMPLES = 1000
"""Draws of the shared variables, the marker's error and the surface's height, for the spread of the beam's end."""


def _standard(size: int) -> FloatArray:
    """(SAMPLES, size) standard normal draws whose own mean and covariance are exactly zero and the identity.

    So a linear function of them has its exact variance.
    """
    draws = np.random.default_rng(0).standard_normal((SAMPLES, size))
    draws = draws - draws.mean(axis=0)
    root = np.linalg.cholesky(draws.T @ draws / SAMPLES)
    return np.asarray(np.linalg.solve(root, draws.T).T)


STANDARD = _standard(SHARED + 6 + 1)
OUTLIER_P = 1e-3
"""Beam and looks do not agree where they would deviate as much with at most this probability."""
SETTLED = 0.005
"""The windows' sites have converged when the PM's rotation changes by at most this share of its standard deviation.
The sites of one PM's looks converge without damping."""


_Settled = tuple[PackedProblem, SharedState, Evaluation]


@dataclass(frozen=True, slots=True)
class _Placed:
    """The PM's plane angle and its sigma (rad), and its lambda in the beam chart (mm)."""

    scan_rad: float
    sigma_rad: float
    lambda_mm: float


def track(query: Track, snapshot: Snapshot) -> TrackEstimate:
    """Answer one query; ``stage_rad`` is None, with a reason, where there is no answer."""
    epoch = snapshot.epoch(query.epoch)
    if epoch is None:
        if query.epoch < snapshot.oldest:
            text = f"camera epoch {query.epoch} is over: queries are answered from epoch {snapshot.oldest} on"
            return _refused(query, snapshot, text)
        return _refused(query, snapshot, f"camera epoch {query.epoch} has no registration")
    if epoch.verdict is Verdict.REFUSED:
        why = f": {epoch.reason}" if epoch.reason else ""
        return _refused(query, snapshot, f"the registration of camera epoch {query.epoch} is refused{why}")
    if (problem := problem_of(query)) is not None:
        return _refused(query, snapshot, problem)
    placed = _from_looks(query, snapshot, epoch) if query.looks else _from_surface(query, snapshot, epoch)
    if isinstance(placed, str):
        return _refused(query, snapshot, placed)
    device_rad = snapshot.stage.device_from_scan(placed.scan_rad)
    low, high = snapshot.stage.limits_device_rad
    for turned in (device_rad, device_rad - 2.0 * math.pi, device_rad + 2.0 * math.pi):
        if low <= turned <= high:
            lambda_mm = placed.lambda_mm - snapshot.origin_shift_mm
            return TrackEstimate(query.t, turned, placed.sigma_rad, lambda_mm, snapshot.causal)
    reason = f"the stage would have to turn to {math.degrees(device_rad):.1f} deg, outside its limits"
    limits = f"{math.degrees(low):.0f} to {math.degrees(high):.0f} deg"
    return _refused(query, snapshot, f"{reason} {limits}")


def _refused(query: Track, snapshot: Snapshot, reason: str) -> TrackEstimate:
    return TrackEstimate(query.t, None, None, None, snapshot.causal, reason)


def _from_looks(query: Track, snapshot: Snapshot, epoch: EpochSnapshot) -> _Placed | str:
    """The PM that the query's looks detected, or why its place cannot be computed."""
    settled = _settled(query, snapshot, epoch)
    if any(look.others for look in query.looks) and not _fits(settled):
        others = [
            replace(query, looks=(*query.looks[:number], other, *query.looks[number + 1 :]))
            for number, look in enumerate(query.looks)
            for other in look.elsewhere()
        ]
        tried = (_settled(other, snapshot, epoch) for other in others)
        settled = next((found for found in tried if _fits(found)), settled)
    shared = None if settled is None else inverse_hessian(settled[2].hessian[0])
    if settled is None or shared is None:
        return "beam and looks do not converge to one place of the PM"
    at = settled[2]
    gain = at.point_gain[0, 0]
    covariance = at.point_covariance[0, 0] + gain @ shared @ gain.T
    _, y, z = at.private.trus_p_pm[0, 0].tolist()
    by_point = np.array([0.0, z, -y]) / (y * y + z * z)
    return _Placed(math.atan2(y, z), math.sqrt(float(by_point @ covariance @ by_point)), float(at.lambda_mm[0, 0]))


def _settled(query: Track, snapshot: Snapshot, epoch: EpochSnapshot) -> _Settled | None:
    """The posterior of the query's PM given its looks; None where it does not converge."""
    problem, state = _one_pm(query, snapshot, epoch)
    private = refine(problem, state, initial_private(problem, state))
    start = evaluate(problem, state, private)
    settled = settle(problem, state, start, settled=SETTLED, damping=1.0)
    if settled is None and problem.shapes is not None:  # the windows as Gaussians
        settled = settle(replace(problem, shapes=None), state, start, settled=SETTLED)
    return settled


def _fits(settled: _Settled | None) -> bool:
    """Whether beam and looks agree."""
    if settled is None:
        return False
    problem = settled[0]
    degrees_of_freedom = 2 * len(problem.beam_pm) + 3 * len(problem.look_pm) - 3
    return bool(settled[2].cost[0] <= chdtri(degrees_of_freedom, OUTLIER_P))


def _one_pm(query: Track, snapshot: Snapshot, epoch: EpochSnapshot) -> tuple[PackedProblem, SharedState]:
    """The query as a session of one PM whose prior is the estimate."""
    state, columns, covariance = snapshot.shared(epoch)
    markers = query.look_markers or (query.marker,) * len(query.looks)
    problem = pack_pairs(
        [Pair(query.t, 0, 0, marker, look) for marker, look in zip(markers, query.looks, strict=True)],
        columns,
        snapshot.sensitivity,
        radius_mm=snapshot.radius_mm,
        step_rad=snapshot.stage.step_rad,
        shapes=snapshot.window_shape,
        amplitude_sigma=snapshot.amplitude_sigma,
    )
    return replace(problem, anchor=gaussian_prior(state, covariance)), state


def _from_surface(query: Track, snapshot: Snapshot, epoch: EpochSnapshot) -> _Placed | str:
    """The beam's end on the tissue surface, or why not."""
    if snapshot.surface is None:
        return "no PM is heard and the session's PMs trace no surface yet (at least 5, not in a row)"
    state, columns, covariance = snapshot.shared(epoch)
    start, along = _beam(query.marker, state, np.zeros((1, 6)))
    met = snapshot.surface.meet(start[0], along[0])
    if met is None:
        return "no PM is heard and the beam misses the part of the surface that the session's PMs trace"
    rotation = query.marker.camera_T_marker[:3, :3]
    observed = parent_from_right_covariance(rotation, usable_covariance(query.marker.covariance, POSE_FLOOR))
    step = STANDARD[:, : columns.size] @ np.linalg.cholesky(covariance).T
    error = STANDARD[:, -7:-1] @ np.linalg.cholesky(observed).T
    start, along = _beam(query.marker, state.take(np.zeros(SAMPLES, dtype=np.int64)).retract(step, columns), error)
    height = met.normal @ met.trus_p + met.sigma_mm * STANDARD[:, -1]
    towards = np.maximum(along @ met.normal, 0.5 * GRAZING)
    point = start + ((height - start @ met.normal) / towards)[:, None] * along
    angle = math.atan2(met.trus_p[1], met.trus_p[2])
    spread = wrap_angle(np.arctan2(point[:, 1], point[:, 2]) - angle)
    return _Placed(angle, float(np.sqrt(np.mean(spread**2))), met.distance_mm)


def _beam(marker: MarkerObservation, state: SharedState, error: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points at lambda = 0 (S, 3) and directions (S, 3) in TRUS, for marker errors (S, 6) along the camera's axes."""
    rotation = exp_so3(error[:, :3]) @ marker.camera_T_marker[:3, :3]
    camera_p = times(rotation, state.beam_origin()) + marker.camera_T_marker[:3, 3] + error[:, 3:]
    camera_p = camera_p - state.constants[:, Constant.MARKER_BIAS_X : Constant.MARKER_BIAS_Z + 1]
    trus_R_camera = state.rotation[:, 0]
    start = times(trus_R_camera, camera_p) + state.translation_mm[:, 0]
    return start, times(trus_R_camera @ rotation, state.beam_direction())
