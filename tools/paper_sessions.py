"""One simulated session of each table of the publication: run and combined by tools/reproduce_paper.py."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from baseline_alternating import LinesAndArcs, register_alternating
from baseline_point_based import register_points
from cramer_rao_bound import FullTruth, beam_covariance, truth_covariance
from fgreg.detection.events_to_measurements import extract_measurements
from fgreg.errors import EstimationError
from fgreg.evaluation.pair_residual import line_to_arc
from fgreg.evaluation.resolve import pair_residuals, predict
from fgreg.geometry.target_error import expected_tre_mm, tre_mm
from fgreg.geometry.transforms import FloatArray, as_float_array, exp_so3, inverse, make_transform, transform_points
from fgreg.graph.packing import PackedProblem, pack
from fgreg.graph.reduced_solver import optimize
from fgreg.graph.shared_state import Quadratic, SharedState, make_state, nominal_frame
from fgreg.model.measurements import Measurements, Track
from fgreg.model.sensitivity import rotation_of_arc
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.initialization import beam_starts
from fgreg.registration.multistart import calibrate_beam
from fgreg.registration.posterior_mean import posterior_mean
from fgreg.registration.readout import read_laser
from fgreg.registration.register import register
from fgreg.registration.solve import track_snapshot
from fgreg.session.session_reader import read_session
from fgreg.simulation import sweeps
from fgreg.simulation.config import SimulationConfig, Sweep
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session
from fgreg.tracking.query import track

HELD = 10
"""PMs of every session that no registration uses: pair residuals are computed on them."""
SETTINGS = SolveConfig()
GAUSSIAN = replace(SETTINGS, window_shape=False)
"""Windows as Gaussians of the same mean and variance, as the bound assumes."""


@dataclass(frozen=True, slots=True, eq=False)
class Sim:
    """A simulated session as fgreg reads it, and its truth."""

    model: SessionModel
    measurements: Measurements
    tracks: tuple[Track, ...]
    track_rad: tuple[float, ...]
    truth: FullTruth

    def first(self, pairs: int) -> Sim:
        """The session with its first ``pairs`` pairs only."""
        kept = replace(self.measurements, pairs=self.measurements.pairs[:pairs])
        truth = replace(self.truth, pair_camera_T_marker=self.truth.pair_camera_T_marker[:pairs])
        return replace(self, measurements=kept, truth=truth)

    def tre(self, trus_T_camera: FloatArray) -> FloatArray:
        return tre_mm(trus_T_camera, self.truth.trus_T_camera[0], self.model.targets_mm)


def simulated(config: SimulationConfig, seed: int) -> Sim:
    """One session, written and read back as a user's would be."""
    made = simulate(config, seed)
    with tempfile.TemporaryDirectory() as name:
        write_session(made, Path(name) / "s")
        session = read_session(Path(name) / "s")
        read = extract_measurements(session.events, session.model)
    truth = FullTruth(
        trus_T_camera=made.scene.trus_T_camera,
        marker_T_laser=made.scene.marker_T_laser,
        trus_p_pm_mm={int(pm): np.array(p) for pm, p in made.truth["pms"].items()},
        pair_camera_T_marker=[made.true_camera_T_marker[i] for i in read.pair_events],
        aim_camera_T_marker=[made.true_camera_T_marker[i] for i in read.aim_events],
        window_edge_rad=made.scene.window_edge_rad,
        marker_bias_mm=made.scene.marker_bias_mm,
    )
    answers = tuple(math.radians(item["stage_deg"]) for item in made.truth["tracks"])
    return Sim(session.model, read.measurements, read.tracks, answers, truth)


def deviating(degrees: float) -> SimulationConfig:
    """PMs off the image plane by arc angles up to ``degrees``, uniform; the window is the same."""
    table = PRESETS["paper"].probe.sensitivity
    # The window bounds stage rotation, which is less than the arc angle of a PM at range r.
    rotation = rotation_of_arc(math.radians(max(degrees, 0.05)), table.depth_mm, PRESETS["paper"].probe.radius_mm)
    window = replace(table, half_width_rad=as_float_array(rotation), edge_sigma_rad=1e-4)
    return replace(PRESETS["paper"], probe=replace(PRESETS["paper"].probe, sensitivity=window))


def first_guess(sim: Sim, rng: np.random.Generator, degrees: float, mm: float) -> FloatArray:
    """The true registration, rotated about the middle of the field and shifted, in random directions."""
    axis, shift = rng.standard_normal((2, 3))
    turn = exp_so3(axis / np.linalg.norm(axis) * math.radians(degrees))
    centre = np.array([0.0, 0.0, sim.model.probe.radius_mm + 32.0])
    off = make_transform(turn, centre - turn @ centre + shift / np.linalg.norm(shift) * mm)
    return np.asarray(off @ sim.truth.trus_T_camera[0])


def calibrated(measurements: Measurements) -> tuple[FloatArray, FloatArray]:
    """The fibre's line (origin, direction) in the marker frame of the baselines: an unweighted fit to the spots."""
    return beam_starts(measurements.aims)[0]


def lines_and_arcs(sim: Sim) -> LinesAndArcs:
    """Input of the published method."""
    origin, direction = calibrated(sim.measurements)
    pairs = sim.measurements.pairs
    marker = np.stack([pair.marker.camera_T_marker for pair in pairs])
    return LinesAndArcs(
        marker[:, :3, :3] @ origin + marker[:, :3, 3],
        marker[:, :3, :3] @ direction,
        np.array([pair.look.scan_rad for pair in pairs]),
        np.array([pair.look.x_mm for pair in pairs]),
        np.array([pair.look.range_mm for pair in pairs]),
        sim.model.probe.radius_mm,
    )


def baseline_residuals(sim: Sim, trus_T_camera: FloatArray) -> FloatArray:
    """Eq. 12 of a baseline's registration on a session's pairs."""
    data = lines_and_arcs(sim)
    trus_p = transform_points(trus_T_camera, data.camera_p)
    trus_d = data.camera_d @ trus_T_camera[:3, :3].T
    return line_to_arc(trus_p, trus_d, data.scan_rad, data.x_mm, data.range_mm, data.radius_mm).distance_mm


def by_points(sim: Sim, pms: Sequence[int], rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Baseline (b): registration from PMs seen in both frames; and its points (camera, TRUS)."""
    trus_p = np.stack([sim.truth.trus_p_pm_mm[pm] for pm in pms])
    camera_p = transform_points(inverse(np.asarray(sim.truth.trus_T_camera[0])), trus_p)
    camera_p = camera_p + rng.standard_normal(camera_p.shape) * [0.1, 0.1, 0.8]
    angle = np.arctan2(trus_p[:, 1], trus_p[:, 2]) + math.radians(0.5) * rng.standard_normal(len(pms))
    rho = np.hypot(trus_p[:, 1], trus_p[:, 2]) + 0.2 * rng.standard_normal(len(pms))
    x = trus_p[:, 0] + 0.3 * rng.standard_normal(len(pms))
    heard = np.stack([x, rho * np.sin(angle), rho * np.cos(angle)], axis=-1)
    return register_points(camera_p, heard), camera_p, heard


# ---- one session of each table; each returns plain numbers by row ----

Row = dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """One session of one table."""

    table: Callable[[Job], dict[Any, Row]]
    config: SimulationConfig
    seed: int
    sizes: tuple[int, ...] = ()
    slow: bool = False
    limit_rad: float = math.pi
    guess: tuple[float, float] = (5.0, 5.0)
    max_rounds: int = 4000
    key: Any = None
    gaussian: bool = False


def run_job(job: Job) -> dict[Any, Row]:
    return job.table(job)


def calibration(job: Job) -> dict[Any, Row]:
    """Error of the fibre's line against the number of aims."""
    sim = simulated(replace(job.config, aims=max(job.sizes) + HELD, pairs=0, tracks_heard=0, tracks_silent=0), job.seed)
    out: dict[Any, Row] = {}
    true = sim.truth.marker_T_laser
    held = sim.measurements.aims[-HELD:]
    along = np.linspace(20.0, 60.0, 9)
    for size in job.sizes:
        some = replace(sim.measurements, aims=sim.measurements.aims[:size])
        frame = calibrate_beam(some, sim.model).frames[0]
        lines = {"fgreg": (frame[:3, 3], frame[:3, 2]), "a": calibrated(some)}
        row: Row = {}
        for name, (origin, direction) in lines.items():
            gap = true[:3, 3] + along[:, None] * true[:3, 2] - origin
            row[f"{name}_beam"] = np.linalg.norm(np.cross(gap, direction), axis=1)
            spots = [transform_points(inverse(a.marker.camera_T_marker), a.camera_p_spot_mm) for a in held]
            row[f"{name}_spot"] = np.linalg.norm(np.cross(np.array(spots) - origin, direction), axis=1)
        part = replace(sim.truth, aim_camera_T_marker=sim.truth.aim_camera_T_marker[:size])
        covariance = beam_covariance(some, sim.model, part)
        jacobian = np.concatenate(
            [np.broadcast_to(np.eye(2), (len(along), 2, 2)), along[:, None, None] * np.eye(2)], axis=-1
        )
        row["bound2"] = float(np.mean(np.einsum("nij,jk,nik->n", jacobian, covariance, jacobian)))
        out[size] = row
    return out


def registration(job: Job) -> dict[Any, Row]:
    """Errors against the number of pairs; the last ``HELD`` are never used."""
    count = max(job.sizes) + HELD
    sim = simulated(replace(job.config, pairs=count, tracks_heard=0, tracks_silent=0), job.seed)
    rng = np.random.default_rng([job.seed, 7])
    held = replace(sim, measurements=replace(sim.measurements, pairs=sim.measurements.pairs[-HELD:]))
    out: dict[Any, Row] = {}
    for size in job.sizes:
        some = sim.first(size)
        covariance = truth_covariance(some.measurements, some.model, some.truth)
        bound = expected_tre_mm(covariance[:6, :6], np.asarray(some.truth.trus_T_camera[0]), some.model.targets_mm)
        row: Row = {"bound2": float(np.mean(bound**2))}
        try:
            found = register(some.measurements, some.model, SETTINGS)
            centred = posterior_mean(found, SETTINGS)
            row["tre"] = sim.tre(centred.posterior.mean.trus_T_camera()[0])
            states = [found.optimum.state, *(minimum.state for minimum in found.searches[0].minima)]
            best = min(states, key=lambda state: float(np.mean(sim.tre(state.trus_T_camera()[0]) ** 2)))
            row["best"] = sim.tre(best.trus_T_camera()[0])
            row["best_residual"] = pair_residuals(best, (0,), held.measurements.pairs, held.model.probe.radius_mm)
            row["ambiguous"] = bool(found.ambiguous)
            if job.gaussian:
                row["optimum_tre"] = sim.tre(found.optimum.state.trus_T_camera()[0])
                like = posterior_mean(register(some.measurements, some.model, GAUSSIAN), GAUSSIAN)
                row["gaussian_tre"] = sim.tre(like.posterior.mean.trus_T_camera()[0])
            held_out = predict(centred.registration, held.measurements.pairs)
            row["residual"] = np.array([pm.pair_residual_mm for pm in held_out])
        except EstimationError:
            row["failed"] = True
        row["b_tre"] = sim.tre(by_points(sim, range(size), rng)[0])
        if job.slow:
            guess = first_guess(sim, rng, *job.guess)
            start = time.process_time()
            a = register_alternating(
                lines_and_arcs(some), guess, limit_rad=job.limit_rad, tolerance=1e-7, max_rounds=job.max_rounds
            )
            row["a_s"] = time.process_time() - start
            row["a_tre"] = sim.tre(a.trus_T_camera)
            row["a_residual"] = baseline_residuals(held, a.trus_T_camera)
        out[job.key if job.key is not None else size] = row
    return out


def one_out(job: Job) -> dict[Any, Row]:
    """Leave-one-out with 15 pairs."""
    sim = simulated(replace(job.config, pairs=15, tracks_heard=0, tracks_silent=0), job.seed)
    rng = np.random.default_rng([job.seed, 8])
    _, camera_p, heard = by_points(sim, range(15), rng)
    residuals, points = [], []
    for left in range(15):
        pairs = sim.measurements.pairs
        kept = replace(sim.measurements, pairs=pairs[:left] + pairs[left + 1 :])
        centred = posterior_mean(register(kept, sim.model, SETTINGS), SETTINGS).registration
        residuals += [pm.pair_residual_mm for pm in predict(centred, pairs[left : left + 1])]
        rest = np.arange(15) != left
        points.append(
            float(
                np.linalg.norm(
                    transform_points(register_points(camera_p[rest], heard[rest]), camera_p[left]) - heard[left]
                )
            )
        )
    whole = posterior_mean(register(sim.measurements, sim.model, SETTINGS), SETTINGS)
    tre = sim.tre(whole.posterior.mean.trus_T_camera()[0])
    return {15: {"residual": np.array(residuals), "b_point": np.array(points), "tre": tre}}


def tracking(job: Job) -> dict[Any, Row]:
    """Results of queries whose PM is detected, with 10 pairs."""
    sim = simulated(replace(job.config, pairs=10, tracks_heard=6, tracks_silent=0), job.seed)
    found = register(sim.measurements, sim.model, SETTINGS)
    centred = posterior_mean(found, SETTINGS)
    shift = read_laser(centred.registration, sim.model).origin_shift_mm
    snapshot = track_snapshot(centred.registration, sim.model, SETTINGS, shift)
    answers = [track(query, snapshot) for query in sim.tracks]
    errors = [
        abs(math.degrees(found_track.stage_rad - right))
        for found_track, right in zip(answers, sim.track_rad, strict=True)
        if found_track.stage_rad is not None
    ]
    return {job.key: {"track": np.array(errors)}}


def held_prior(state: SharedState, information: FloatArray) -> Quadratic:
    """A prior that holds the shared variables with information (D,) at a state."""
    return Quadratic(state, 0.0, np.zeros(len(information)), np.diag(information))


def same_cost(sim: Sim, direction: FloatArray, origin: FloatArray) -> tuple[PackedProblem, FloatArray]:
    """The published cost as a reduced problem: beam fixed, equal weights, theta' free; and the beam's frame."""
    problem = pack(replace(sim.measurements, aims=()), sim.model)
    columns, looks = problem.columns, problem.looks
    covariance = np.zeros_like(problem.beams.covariance)
    covariance[:, 3:, 3:] = np.eye(3)
    weight = np.zeros_like(looks.weight)
    weight[:, 0, 0] = weight[:, 1, 1] = 1e6
    held = np.zeros(columns.size)
    held[columns.beam :] = 1e12
    problem = replace(
        problem,
        beams=replace(problem.beams, covariance=covariance),
        looks=replace(looks, weight=weight, centre_rad=np.zeros_like(looks.centre_rad)),
        anchor=held_prior(make_state(np.eye(4)[None, None], nominal_frame(origin, direction)), held),
    )
    return problem, nominal_frame(origin, direction)


def timing(job: Job) -> dict[Any, Row]:
    """Processor seconds of (a), theta' free, and of fgreg from the same guess, 10 pairs.

    fgreg twice: on its own cost (chi square with the priors), and on that of (a), with the beam fixed and theta' free,
    down to the cost that (a) reached.
    """
    sim = simulated(replace(job.config, pairs=10, tracks_heard=0, tracks_silent=0), job.seed)
    rng = np.random.default_rng([job.seed, 9])
    guess = first_guess(sim, rng, *job.guess)
    data = lines_and_arcs(sim)
    start = time.process_time()
    a = register_alternating(data, guess, max_rounds=job.max_rounds)
    row: Row = {"a_s": time.process_time() - start, "a_cost": a.cost_mm2, "converged": a.converged}
    origin, direction = calibrated(sim.measurements)
    problem, frame = same_cost(sim, direction, origin)
    for iterations in (4, 6, 8, 12, 16, 24, 32, 48, 64, 128, 256, 1000):
        start = time.process_time()
        found = optimize(problem, make_state(guess[None, None], frame), max_iterations=iterations)
        row["same_s"] = time.process_time() - start
        row["same_cost"] = float(found.evaluation.cost[0]) / len(data.x_mm)
        if row["same_cost"] <= a.cost_mm2 * (1.0 + 1e-9):
            break
    # fgreg's own cost, from the same guess; and that cost at (a)'s registration, all else at its conditional optimum.
    own = pack(sim.measurements, sim.model)
    start = time.process_time()
    found = optimize(own, make_state(guess[None, None], frame))
    row["own_s"], row["own_cost"] = time.process_time() - start, float(found.evaluation.cost[0])
    held = np.zeros(own.columns.size)
    held[:6] = 1e12
    at_a = make_state(a.trus_T_camera[None, None], frame)
    row["a_own_cost"] = float(optimize(replace(own, anchor=held_prior(at_a, held)), at_a).evaluation.cost[0])
    row["own_tre"], row["a_tre"] = sim.tre(found.state.trus_T_camera()[0]), sim.tre(a.trus_T_camera)
    start = time.process_time()
    register(sim.measurements, sim.model, SETTINGS)
    row["fgreg_s"] = time.process_time() - start
    return {job.key: row}


def positions(job: Job) -> dict[Any, Row]:
    """Stage positions visited until a PM is detected, stepping from a limit of the field, at one step width."""
    sim = simulated(replace(job.config, pairs=20, tracks_heard=0, tracks_silent=0), job.seed)
    config = replace(job.config, stage=replace(job.config.stage, step_rad=math.radians(job.key)))
    field = math.radians(42.0)  # the PMs' field and the window beyond it
    config = replace(config, stage=replace(config.stage, limits_device_rad=(-field, field)), sweep=Sweep.ALTERNATING)
    trus_p = np.stack([sim.truth.trus_p_pm_mm[pm] for pm in range(20)])
    rng = np.random.default_rng([job.seed, 10])
    heard = sweeps.look(config, trus_p, 1, 1, 0.0, rng)
    signs = 1.0 - 2.0 * (np.arange(20) % 2)
    visited = np.floor((signs * heard.device_rad[:, 0] + field) / config.stage.step_rad) + 1.0
    return {job.key: {"visited": visited}}
