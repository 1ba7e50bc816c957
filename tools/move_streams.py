"""Simulated streams with a camera move, and the covariance of an ideal estimator.

For tools/study_moves.py, study_early_moves.py and study_returns.py. Poses with the documented noise (tests.forward).
"""

from __future__ import annotations

import math
import os
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from fgreg.geometry.rig import Constant
from fgreg.geometry.target_error import target_jacobians
from fgreg.geometry.transforms import FloatArray, exp_so3, inverse, make_transform
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.reduced_graph import evaluate
from fgreg.graph.reduced_system import refine
from fgreg.graph.shared_state import SharedState, make_state
from fgreg.model.measurements import Aim, EpochStart, Measurements
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.register import pack_session

sys.path.insert(0, os.fspath(Path(__file__).resolve().parent.parent))

from tests.forward import Truth, make_measurements, make_session, random_marker_T_laser, random_trus_T_camera

CONFIG = SolveConfig()
MANY_AIMS = 150
MIDDLE_MM = np.array([0.0, 0.0, 42.0])
"""Of the tissue, TRUS."""


def random_direction(rng: np.random.Generator) -> FloatArray:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def shift_of(rng: np.random.Generator, mm: float, degrees: float) -> FloatArray:
    """camera_new_T_camera_old: a shift by ``mm`` or a rotation by ``degrees``, each half the time."""
    if rng.uniform() < 0.5:
        return make_transform(np.eye(3), mm * random_direction(rng))
    return make_transform(exp_so3(math.radians(degrees) * random_direction(rng)), np.zeros(3))


def bump_of(seed: int, sigma_mm: float, sigma_rad: float) -> FloatArray:
    """camera_new_T_camera_old for :func:`two_epochs` of that seed: a turn about the tissue's middle and a shift.

    Sigmas per axis, as fgreg.simulation.room draws them.
    """
    trus_T_camera, rng = random_trus_T_camera(np.random.default_rng(seed)), np.random.default_rng([seed, 6])
    turn = exp_so3(rng.normal(0.0, sigma_rad, 3))
    move = make_transform(turn, MIDDLE_MM - turn @ MIDDLE_MM + rng.normal(0.0, sigma_mm, 3))
    return np.asarray(inverse(move @ trus_T_camera) @ trus_T_camera)


def two_epochs(
    seed: int, motion: FloatArray, before: int, after: int, *, first_hit: bool, reported: bool = False, looks: int = 1
) -> tuple[SessionModel, Measurements, tuple[Truth, Truth]]:
    """PMs before and after a motion; same beam and window edge. ``reported``: in epochs 0 and 1, else all in epoch 0.

    With several ``looks`` at each PM they are 2 deg apart, with amplitudes, and share a marker observation.
    """
    rng = np.random.default_rng(seed)
    trus_T_camera, beam = random_trus_T_camera(rng), random_marker_T_laser(rng)
    make = make_measurements if looks == 1 else partial(
        make_measurements, session=make_session(curve=True), looks_per_pm=looks, share_marker=True,
        look_spacing_deg=2.0, amplitude_noise=0.05,
    )  # fmt: skip
    model, first, truth = make(
        np.random.default_rng([seed, 1]), aims=12, pairs=before, first_hit=first_hit, marker_T_laser=beam,
        trus_T_camera=trus_T_camera,
    )  # fmt: skip
    # The same seed draws the same window edge; without aims everything after it differs.
    _, second, moved = make(
        np.random.default_rng([seed, 1]), aims=0, pairs=after, first_hit=first_hit, marker_T_laser=beam,
        trus_T_camera=trus_T_camera @ inverse(motion),
    )  # fmt: skip
    t = first.pairs[-1].t + 0.5 if first.pairs else 0.0
    later = tuple(
        replace(
            pair, t=pair.t + t, pm=pair.pm + before, epoch=int(reported),
            marker=replace(pair.marker, id=pair.marker.id + 100000),
        )
        for pair in second.pairs
    )  # fmt: skip
    epochs = (*first.epochs, EpochStart(t)) if reported else first.epochs
    return model, Measurements(first.aims, first.pairs + later, epochs), (truth, moved)


def many_aims(seed: int, truth: Truth) -> tuple[Aim, ...]:
    """Calibration shots in a number that makes the beam known."""
    rng = np.random.default_rng([seed, 9])
    return make_measurements(rng, aims=MANY_AIMS, pairs=0, marker_T_laser=truth.marker_T_laser)[1].aims


def ideal_covariance(
    model: SessionModel, measurements: Measurements, truths: tuple[Truth, ...]
) -> tuple[FloatArray, SharedState]:
    """Covariance of all shared variables by the information at the truth: the least of any estimator.

    Windows are taken as Gaussians and the geometry as linear. One truth per epoch of the measurements.
    """
    problem = pack_session(measurements, model, replace(CONFIG, window_shape=False))
    poses = np.stack([truth.trus_T_camera[0] for truth in truths])
    state = make_state(poses[None], truths[0].marker_T_laser)
    state.constants[:, Constant.WINDOW_EDGE] = truths[0].window_edge_rad
    private = initial_private(problem, state)
    for _ in range(4):
        private = refine(problem, state, private)
    hessian = evaluate(problem, state, private).hessian[0]
    scale = 1.0 / np.sqrt(np.diag(hessian))
    return np.asarray(np.linalg.inv(hessian * np.outer(scale, scale)) * np.outer(scale, scale)), state


def ideal_tre(covariance: FloatArray, state: SharedState, epoch: int, targets_mm: FloatArray) -> float:
    """Root mean square target error (mm) of one epoch's registration with that covariance."""
    pose = state.trus_T_camera(epoch)[0]
    block = slice(6 * epoch, 6 * epoch + 6)
    jacobian = target_jacobians(pose, targets_mm)
    spread = jacobian @ covariance[block, block] @ np.swapaxes(jacobian, 1, 2)
    return float(np.sqrt(np.einsum("nii->n", spread).mean()))
