"""Solve a session's measurements as a whole: registration, beam, tracks, verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.errors import EstimationError
from fgreg.graph.gtsam_graph import GraphOptions, Rig, build_graph
from fgreg.graph.gtsam_values import PrivateValues, SharedValues, newton_step, values_at
from fgreg.graph.reduced_blocks import moved_markers
from fgreg.model.estimate import (
    AimEstimate,
    EpochEstimate,
    LaserEstimate,
    PairEstimate,
    PointEstimate,
    SessionEstimate,
    SystematicEstimate,
    TrackEstimate,
    Verdict,
)
from fgreg.model.measurements import Measurements, Track
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.tissue_surface import fit_surface
from fgreg.registration.camera_conditions import camera_conditions
from fgreg.registration.epoch_verdicts import EpochReport, epoch_verdicts, steadiness
from fgreg.registration.epochs import FinishedEpochs, last_epoch
from fgreg.registration.error_budget import (
    error_budget,
    random_errors_only,
)
from fgreg.registration.known_points import point_conditions, read_points
from fgreg.registration.multistart import EpochSearch
from fgreg.registration.outliers import free_variables, pm_degrees_of_freedom
from fgreg.registration.posterior import Posterior
from fgreg.registration.posterior_mean import (
    estimated_radius,
    estimated_sound_speed,
    posterior_mean,
)
from fgreg.registration.proof import Proof, prove
from fgreg.registration.readout import read_aims, read_laser, read_pairs
from fgreg.registration.register import Registration, labels_and_inliers, register
from fgreg.registration.verdict import (
    SURE_OF_AIMS,
    Condition,
    beam_sides,
    consistency,
    estimated,
    left_out,
    repeated_markers,
    sampling,
    too_few_to_tell,
    understated_noise,
    verdict_of,
    worst_first,
)
from fgreg.tracking.query import track
from fgreg.tracking.snapshot import Snapshot, make_snapshot

GRAPH_PAIRS = 200
"""Largest number of pairs for which the explicit graph is solved as well; its optimum has to agree."""
MIN_COMPARED = 6
"""Smallest number of PMs for which they are compared."""
AGREEMENT_SIGMA = 0.05
"""Largest distance between the two optima, in units of the estimate's own standard deviations."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The estimate for a session's measurements: everything but the session's name.

    ``pairs``, ``tracks``, ``aims`` and ``points`` are in the order of the measurements and queries. ``registration``,
    ``posterior`` and ``snapshot`` (which answers tracking queries) are None where nothing could be computed.
    ``reports``: of the epochs.
    """

    verdict: Verdict
    reasons: tuple[str, ...]
    laser: LaserEstimate | None
    epochs: tuple[EpochEstimate, ...]
    pairs: tuple[PairEstimate, ...]
    tracks: tuple[TrackEstimate, ...]
    aims: tuple[AimEstimate, ...]
    points: tuple[PointEstimate, ...] = ()
    systematic: tuple[SystematicEstimate, ...] = ()
    registration: Registration | None = None
    posterior: Posterior | None = None
    snapshot: Snapshot | None = None
    reports: tuple[EpochReport, ...] = ()

    def as_session(self, name: str) -> SessionEstimate:
        """The estimate as files and reports have it."""
        return SessionEstimate(
            name,
            self.verdict,
            self.reasons,
            self.laser,
            self.epochs,
            self.pairs,
            self.tracks,
            aims=self.aims,
            points=self.points,
            systematic=self.systematic,
        )


def solve(
    measurements: Measurements,
    tracks: Sequence[Track],
    model: SessionModel,
    config: SolveConfig,
    conditions: Sequence[Condition] = (),
    known: Mapping[int, EpochSearch] | None = None,
    finished: FinishedEpochs | None = None,
    before: Sequence[EpochReport] = (),
    registration: Registration | None = None,
) -> Solution:
    """Calibrate, register, decide on the verdict, and answer the tracking queries from the whole session.

    Args:
        measurements: aims, pairs, epochs.
        tracks: queries; they never enter the estimate.
        model: the session's set-up.
        config: limits of the verdict.
        conditions: of the detection, added to those found here.
        known: search results of epochs that are not searched again.
        finished: earlier epochs as a prior; only the last epoch is solved then, and only its pairs are in the solution.
        before: reports of the finished epochs.
        registration: of these measurements, where there is one already.
    """
    if finished is not None:
        measurements = last_epoch(measurements)
    try:
        registration = registration or register(measurements, model, config, known, finished)
    except EstimationError as error:
        seen = camera_conditions(measurements, model, config)
        return _no_solution(measurements, tracks, [Condition(Verdict.REFUSED, str(error)), *conditions, *seen])
    answered = posterior_mean(registration, config)
    posterior, centred = answered.posterior, answered.registration
    state = centred.optimum.state
    readout = read_laser(centred, model)
    pairs = read_pairs(measurements, centred, model, readout.origin_shift_mm)
    aims = read_aims(measurements, centred, readout.origin_shift_mm)
    registrations = [state.trus_T_camera(k)[0] for k in range(len(centred.epochs))]
    points = read_points(measurements, registration, registrations) if measurements.points else ()
    pictures = camera_conditions(measurements, model, config, registrations)
    budget = error_budget(registration, posterior, config)
    common = [
        *conditions,
        *pictures,
        *random_errors_only(model),
        *_common_conditions(registration, pairs, aims),
        *point_conditions(points, measurements),
        *sampling(posterior.effective),
        *_variable_conditions(centred, config),
        # A camera that is not as declared makes the shots contradict any other constant, too: it is to be mended first.
        *(() if pictures else budget.conditions),
    ]
    names = dict(
        zip(labels_and_inliers(registration, measurements)[0], (p.pm for p in measurements.pairs), strict=True)
    )
    steady = {k: steadiness(registration, place, config.limit_mm, names) for place, k in enumerate(registration.epochs)}
    to_prove = [k for k in registration.epochs if k not in (known or {})]
    proofs = {k: proof for k in to_prove if (proof := prove(registration, k, config)) is not None}
    for k, proof in proofs.items():
        steady[k].extend(proof.conditions)
    reports = epoch_verdicts(measurements, centred, posterior, budget, pairs, model, config, common, steady, before)
    reports = tuple(_with_proof(report, proofs.get(report.estimate.index)) for report in reports)
    epochs, several = tuple(report.estimate for report in reports), len(reports) > 1
    found = [(c, f"epoch {k}: {c.text}" if several else c.text) for k, of in enumerate(reports) for c in of.conditions]
    reports = (*reports[:-1], replace(reports[-1], common=tuple(common)))
    refused = {epoch.index: "" for epoch in epochs if epoch.verdict is Verdict.REFUSED}
    snapshot = track_snapshot(centred, model, config, readout.origin_shift_mm, refused)
    # The camera is in the last epoch; an earlier epoch that failed gives only a warning.
    verdict = max(epochs[-1].verdict, verdict_of(common), key=lambda v: v.severity)
    if verdict is Verdict.OK and any(epoch.verdict is not Verdict.OK for epoch in epochs):
        verdict = Verdict.WARNING
    return Solution(
        verdict=verdict,
        reasons=worst_first([*((condition, condition.text) for condition in common), *found]),
        laser=readout.laser,
        epochs=epochs,
        pairs=pairs,
        tracks=tuple(track(query, snapshot) for query in tracks),
        aims=aims,
        points=points,
        systematic=budget.constants,
        registration=registration,
        posterior=posterior,
        snapshot=snapshot,
        reports=reports,
    )


def _with_proof(report: EpochReport, proof: Proof | None) -> EpochReport:
    return report if proof is None else replace(report, estimate=replace(report.estimate, certificate=proof.estimate))


def _no_solution(measurements: Measurements, tracks: Sequence[Track], conditions: Sequence[Condition]) -> Solution:
    """A refused solution: nothing could be computed."""
    reasons = tuple(condition.text for condition in conditions)
    why = reasons[0]
    return Solution(
        verdict=Verdict.REFUSED,
        reasons=reasons,
        laser=None,
        epochs=tuple(
            EpochEstimate(k, epoch.t, None, None, sum(p.epoch == k for p in measurements.pairs), Verdict.REFUSED, None)
            for k, epoch in enumerate(measurements.epochs)
        ),
        pairs=tuple(PairEstimate(p.t, p.pm, p.epoch, used=False, reason=why) for p in measurements.pairs),
        tracks=tuple(TrackEstimate(q.t, None, None, None, False, f"no registration: {why}") for q in tracks),
        aims=tuple(AimEstimate(a.t, used=False, reason=why) for a in measurements.aims),
        points=tuple(PointEstimate(p.t, p.epoch, used=False, reason=why) for p in measurements.points),
    )


def _common_conditions(
    registration: Registration, pairs: Sequence[PairEstimate], aims: Sequence[AimEstimate]
) -> list[Condition]:
    """Conditions of the solve as a whole: residuals, beam, agreement of the two forms of the graph."""
    problem, cost = registration.problem, float(registration.optimum.evaluation.cost[0])
    shots, inlier_aims = registration.shots, len(registration.measurements.aims)
    equations = 2 * inlier_aims + int(pm_degrees_of_freedom(problem).sum()) + 3 * len(problem.points)
    unknowns = free_variables(problem)
    lambdas = [pair.lambda_mm for pair in pairs if pair.used and pair.lambda_mm is not None]
    lambdas += [aim.lambda_mm for aim in aims if aim.used and aim.lambda_mm is not None]
    found = [*consistency(cost, equations - unknowns), *beam_sides(np.array(lambdas))]
    if not registration.optimum.converged.all():
        text = f"the solve did not converge in {registration.optimum.iterations} steps: take more pairs in each epoch"
        found.append(Condition(Verdict.REFUSED, text))
    found.extend(repeated_markers(registration.measurements.pairs))
    nis = shots.innovations
    if aims:
        found.extend(left_out(shots.aim_inlier, nis.aim, "aims", SURE_OF_AIMS))
        found.extend(
            too_few_to_tell(
                shots.aim_beyond_limit, shots.aim_inlier, nis.aim, [f"the aim at {a.t:.1f} s" for a in aims]
            )
        )
    deviant = np.concatenate([shots.pm_beyond_limit, shots.aim_beyond_limit])
    found.extend(understated_noise(deviant, np.concatenate([nis.pm, nis.aim])))
    if found and verdict_of(found) is Verdict.REFUSED:
        return found  # inconsistent data cannot test whether the two forms of the graph agree
    # The explicit graph has no prior of finished epochs; few pairs are too flat an optimum to compare by one step.
    if len(pairs) <= GRAPH_PAIRS and problem.anchor is None and len(problem.pms) >= MIN_COMPARED:
        found.extend(_agreement(registration))
    return found


def _variable_conditions(centred: Registration, config: SolveConfig) -> list[Condition]:
    """Estimated sound speed and radius, where they are variables."""
    found = []
    if config.estimate_sound_speed and (speed := estimated_sound_speed(centred)) is not None:
        found.append(estimated("sound speed ratio", speed.value, speed.sigma, 1.0, config.sound_speed_sigma, ""))
    if config.estimate_radius and (radius := estimated_radius(centred)) is not None:
        given_mm = centred.model.probe.radius_mm
        found.append(estimated("radius", radius.value, radius.sigma, given_mm, config.radius_sigma_mm, " mm"))
    return found


def _agreement(registration: Registration) -> list[Condition]:
    """Explicit and reduced graph have to have the same optimum: both are forms of one model."""
    apart = distance_to_explicit(registration)
    if apart <= AGREEMENT_SIGMA:
        return []
    text = f"the two forms of the graph disagree by {apart:.2f} standard deviations: please report this session"
    return [Condition(Verdict.REFUSED, text)]


def distance_to_explicit(registration: Registration) -> float:
    """Mahalanobis distance between the optima of the explicit and the reduced graph, over the registrations.

    Both take one Gauss-Newton step from the reduced optimum (that of the reduced graph is almost zero). Infinite where
    the step of the explicit graph, the reference, is undetermined.
    """
    state, problem, at = registration.optimum.state, registration.problem, registration.optimum.evaluation
    epochs = problem.columns.epochs
    options = GraphOptions(
        marker_T_nominal=state.marker_T_nominal[0],
        unknown_motion_sigma=None,
        rig=Rig(problem.columns.constants, problem.prior),
    )
    explicit = build_graph(registration.measurements, registration.model, options)
    shared = SharedValues(
        trus_T_camera=tuple(state.trus_T_camera(k)[0] for k in range(epochs)),
        marker_laser=state.beam[0],
        constants=state.constants[0],
    )
    private = at.private
    there = PrivateValues(
        aim_camera_T_marker=moved_markers(problem.aims, private.aim_error[0], state.constants[0]),
        camera_p_spot_mm=problem.aim_spot_mm + private.aim_shift[0],
        camera_T_marker=moved_markers(problem.beams, private.beam_error[0], state.constants[0]),
        trus_p_pm_mm=private.trus_p_pm[0],
    )
    step = newton_step(explicit, values_at(explicit, shared, there))
    if step is None:
        return math.inf
    own = -(registration.covariance @ at.gradient[0])[: 6 * epochs]
    apart = np.concatenate([step.at(key) for key in explicit.keys.trus_T_camera]) - own
    poses = registration.covariance[: 6 * epochs, : 6 * epochs]
    return float(np.sqrt(apart @ np.linalg.solve(poses, apart)))


def track_snapshot(
    registration: Registration,
    model: SessionModel,
    config: SolveConfig,
    origin_shift_mm: float,
    refused: Mapping[int, str] | None = None,
) -> Snapshot:
    """The snapshot that answers tracking queries about a solved session.

    Args:
        registration: at the posterior mean, with the posterior's covariance.
        model, config: of the session.
        origin_shift_mm: lambda of the laser frame's origin in the beam chart.
        refused: the refused epochs, each with the reason (which may be empty).
    """
    problem, at = registration.problem, registration.optimum.evaluation
    gain = at.point_gain[0]
    covariance = at.point_covariance[0] + gain @ registration.covariance @ np.swapaxes(gain, -1, -2)
    state = registration.optimum.state
    camera_d = problem.beams.rotation @ state.beam_direction()[0]
    trus_d = np.einsum("bij,bj->bi", state.rotation[0, problem.beam_epoch], camera_d)
    return make_snapshot(
        model,
        config,
        state,
        registration.covariance,
        problem.columns,
        registration.epochs,
        origin_shift_mm=origin_shift_mm,
        surface=fit_surface(at.private.trus_p_pm[0], covariance, trus_d),
        causal=False,
        refused=refused,
    )
