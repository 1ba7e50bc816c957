"""Finding out that the camera moved: power and false alarms, beside the ideal detector.

Poses with the documented noise, 12 aims. What is measured:

  clean     streams of steady pairs: false alarms (target: at most 1 in 2,000 pairs)
  shifts    15 steady pairs, then a shift in a random direction about the camera: share found within so many pairs
            (targets: 5 mm or 3 deg, first-hit: 80 % within 2 and 93 % within 6; window only: 55 % and 85 %; 2 mm or
            1 deg, first-hit: 50 % within 6 and 80 % within 15)

The ideal detector is told the old registration, the beam, the window's edge and the very shift, and sums up
likelihood ratios (Shiryaev and Roberts); its threshold is set to the same rate of false alarms on clean pairs.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from fgreg.config import SolveConfig
from fgreg.errors import EstimationError
from fgreg.frames import FloatArray, exp_so3, inverse, make_transform
from fgreg.graph.reduced import log_posterior, refine
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.shared_state import make_state
from fgreg.measurements import EpochStart, Measurements
from fgreg.models import SessionModel
from fgreg.online.follow import EpochFollower, select_pms, summarise_aims
from fgreg.online.moves import MoveSettings, MoveTest, default_scales
from fgreg.registration import pack_session, register

sys.path.insert(0, os.fspath(Path(__file__).resolve().parent.parent))
from tests.forward import Truth, make_measurements, random_marker_T_laser, random_trus_T_camera

STEADY = 15
AFTER = 15
START = 8
RATE = 2000.0
CONFIG = SolveConfig()


def random_direction(rng: np.random.Generator) -> FloatArray:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def shift_of(rng: np.random.Generator, mm: float, degrees: float) -> FloatArray:
    """camera_new_T_camera_old: by so many mm or turned by so many degrees, each half the time."""
    if rng.uniform() < 0.5:
        return make_transform(np.eye(3), mm * random_direction(rng))
    return make_transform(exp_so3(math.radians(degrees) * random_direction(rng)), np.zeros(3))


def two_epochs(
    seed: int, motion: FloatArray, before: int, after: int, *, first_hit: bool
) -> tuple[SessionModel, Measurements, tuple[Truth, Truth]]:
    """Pairs before and after a motion, all told to be of epoch 0; same beam, same window edge."""
    rng = np.random.default_rng(seed)
    trus_T_camera, beam = random_trus_T_camera(rng), random_marker_T_laser(rng)
    model, first, truth = make_measurements(
        np.random.default_rng([seed, 1]), aims=12, pairs=before, first_hit=first_hit, marker_T_laser=beam,
        trus_T_camera=trus_T_camera,
    )  # fmt: skip
    # The same seed draws the same window edge; without aims all that follows is drawn anew.
    _, second, moved = make_measurements(
        np.random.default_rng([seed, 1]), aims=0, pairs=after, first_hit=first_hit, marker_T_laser=beam,
        trus_T_camera=trus_T_camera @ inverse(motion),
    )  # fmt: skip
    shift_t = first.pairs[-1].t if first.pairs else 0.0
    later = tuple(
        replace(pair, t=pair.t + shift_t, pm=pair.pm + before, marker=replace(pair.marker, id=pair.marker.id + 100000))
        for pair in second.pairs
    )
    return model, Measurements(first.aims, first.pairs + later, first.epochs), (truth, moved)


def ideal_ratios(
    model: SessionModel, measurements: Measurements, truth: Truth, old: FloatArray, new: FloatArray
) -> FloatArray:
    """(n,) log likelihood ratio of each pair, new against old registration, all else known."""
    problem = replace(pack_session(replace(measurements, aims=()), model, CONFIG), anchor=None)
    state = make_state(np.stack([old, new])[:, None], truth.marker_T_laser, model.probe.radius_mm)
    state = replace(state, edge_rad=np.full(2, truth.window_edge_rad))
    out = np.zeros(len(problem.pms))
    for j in range(len(out)):
        one = select_pms(problem, np.array([j]))
        private = initial_private(one, state)
        for _ in range(4):
            _, private = refine(one, state, private)
        log = log_posterior(one, state, private)
        out[j] = log[1] - log[0]
    return out


def shiryaev_roberts(ratios: FloatArray) -> FloatArray:
    """(n,) log of R_n = (1 + R_(n-1)) exp(ratio_n)."""
    out, log_r = np.empty(len(ratios)), -np.inf
    for n, ratio in enumerate(ratios):
        log_r = float(np.logaddexp(0.0, log_r) + ratio)
        out[n] = log_r
    return out


def follow(
    model: SessionModel, measurements: Measurements, settings: MoveSettings, from_pair: int = START
) -> list[MoveTest | None]:
    """Tests after each pair from number ``from_pair`` + 1 on."""
    registration = register(replace(measurements, pairs=measurements.pairs[:START]), model, CONFIG)
    problem = pack_session(measurements, model, CONFIG)
    problem = summarise_aims(problem, registration.optimum.state)
    follower = EpochFollower(problem, registration.optimum.state, START)
    tests = []
    for n in range(START + 1, len(problem.pms) + 1):
        follower.advance(n)
        tests.append(follower.test(settings) if n > from_pair else None)
    return tests[from_pair - START :]


def excursions(scores: FloatArray, threshold: float) -> int:
    """How often a score comes to pass the threshold."""
    above = np.concatenate([[False], scores > threshold])
    return int(np.sum(above[1:] & ~above[:-1]))


def run_clean(sessions: int, pairs: int, *, first_hit: bool, settings: MoveSettings, seed: int) -> dict[str, object]:
    scores, failed = [], 0
    for s in range(sessions):
        model, measurements, _ = make_measurements(
            np.random.default_rng([seed, s]), aims=12, pairs=pairs, first_hit=first_hit
        )
        try:
            found = follow(model, measurements, settings)
        except EstimationError:
            failed += 1
            continue
        scores.append([test.score if test is not None else -np.inf for test in found])
    return {"scores": scores, "failed": failed, "pairs": len(scores) * pairs}


def run_ideal_clean(
    sessions: int, pairs: int, mm: float, degrees: float, *, first_hit: bool, seed: int
) -> list[list[float]]:
    out = []
    for s in range(sessions):
        rng = np.random.default_rng([seed, s])
        motion = shift_of(rng, mm, degrees)
        model, measurements, truth = make_measurements(rng, aims=0, pairs=pairs, first_hit=first_hit)
        old = truth.trus_T_camera[0]
        ratios = ideal_ratios(model, measurements, truth, old, old @ inverse(motion))
        out.append(shiryaev_roberts(ratios).tolist())
    return out


def run_shifts(
    sessions: int, mm: float, degrees: float, *, first_hit: bool, settings: MoveSettings, seed: int
) -> dict[str, object]:
    scores, since, ideal = [], [], []
    for s in range(sessions):
        motion = shift_of(np.random.default_rng([seed, s, 7]), mm, degrees)
        model, measurements, (truth, moved) = two_epochs(
            seed * 100000 + s, motion, STEADY, AFTER, first_hit=first_hit
        )
        found = follow(model, measurements, settings, STEADY)
        scores.append([test.score if test is not None else -np.inf for test in found])
        since.append([-1 if t is None else len(found) and STEADY + k + 1 - (len(t.log_bayes) - t.since)
                      for k, t in enumerate(found)])  # fmt: skip
        ratios = ideal_ratios(model, measurements, truth, truth.trus_T_camera[0], moved.trus_T_camera[0])
        ideal.append(shiryaev_roberts(ratios)[STEADY:].tolist())
    return {"scores": scores, "since": since, "ideal": ideal}
