"""Cases for the camera-move test from batch registrations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fgreg.camera_moves.detector import MoveCase
from fgreg.geometry.transforms import FloatArray, inverse
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.reduced_graph import evaluate
from fgreg.graph.reduced_system import refine
from fgreg.graph.shared_state import Quadratic, SharedState
from fgreg.model.measurements import Aim, EpochStart, Measurements
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.register import pack_session, register
from tests.forward import Truth, make_measurements, random_marker_T_laser, random_trus_T_camera

CONFIG = SolveConfig()


def aims_about(aims: Sequence[Aim], state: SharedState, model: SessionModel) -> Quadratic:
    """Information of calibration shots and priors on the shared variables of one epoch, about a state."""
    problem = pack_session(
        Measurements(tuple(aims), (), (EpochStart(0.0),)), model, replace(CONFIG, window_shape=False)
    )
    return everything_about(problem, state)


def everything_about(problem: PackedProblem, state: SharedState) -> Quadratic:
    """Information of all shots of a problem and its priors, about a state of one hypothesis."""
    private = initial_private(problem, state)
    for _ in range(4):
        private = refine(problem, state, private)
    there = evaluate(problem, state, private)
    return Quadratic(state, float(there.cost[0]), there.gradient[0], there.hessian[0])


def move_case(measurements: Measurements, model: SessionModel) -> MoveCase:
    """All pairs of a session of one epoch as a case; no estimate where their registration is ambiguous."""
    pms: dict[int, list[int]] = {}
    for place, pair in enumerate(measurements.pairs):
        pms.setdefault(pair.pm, []).append(place)
    found = register(measurements, model, CONFIG)
    inlier = dict(zip(found.shots.problem.pms, found.shots.pm_inlier, strict=True))
    state = None if found.ambiguous else found.optimum.state
    aims = [aim for aim, fits in zip(measurements.aims, found.shots.aim_inlier, strict=True) if fits]
    return MoveCase(
        epoch=0,
        pms=tuple(tuple(measurements.pairs[place] for place in places) for places in pms.values()),
        places=tuple(places[0] for places in pms.values()),
        inlier=np.array([inlier[pm] for pm in pms], dtype=bool),
        known=None if state is None else aims_about(aims, state, model),
    )


def moved_session(
    seed: int, motion: FloatArray, before: int, after: int, *, aims: int = 12, first_hit: bool = True
) -> tuple[SessionModel, Measurements, tuple[Truth, Truth]]:
    """Pairs before and after an unreported motion camera_new_T_camera_old: same beam, same window edge, one epoch."""
    rng = np.random.default_rng(seed)
    old, beam = random_trus_T_camera(rng), random_marker_T_laser(rng)
    again = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 1])  # so that both have one window edge
    model, first, truth = make_measurements(
        again[0], aims=aims, pairs=before, first_hit=first_hit, marker_T_laser=beam, trus_T_camera=old
    )
    _, second, moved = make_measurements(
        again[1], aims=0, pairs=after, first_hit=first_hit, marker_T_laser=beam, trus_T_camera=old @ inverse(motion)
    )
    later = tuple(
        replace(p, t=p.t + 1000.0, pm=p.pm + before, marker=replace(p.marker, id=p.marker.id + 1000))
        for p in second.pairs
    )
    return model, replace(first, pairs=first.pairs + later), (truth, moved)
