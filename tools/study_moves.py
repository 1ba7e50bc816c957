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
from fgreg.frames import FloatArray, exp_so3, inverse, make_transform, right_from_parent_covariance
from fgreg.graph.reduced import log_posterior, refine
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.shared_state import make_state
from fgreg.measurements import EpochStart, Measurements
from fgreg.models import SessionModel
from fgreg.online.follow import EpochFollower, select_pms, summarise_aims
from fgreg.online.moves import MoveSettings, MoveTest, default_scales
from fgreg.online.static_tags import StaticTagsWatch
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


# --- static tags ----------------------------------------------------------------------------------------------------

FRAMES_PER_PAIR = 10


class TagNoise:
    """Detection noise of tags in a row of frames: the session's defaults; a share of the variance drifts slowly.

    The drift is a Gauss-Markov process of its own in each tag and axis; errors that never change are added as well
    (they cancel as long as the camera stands still, and are drawn anew when it moves).
    """

    def __init__(self, rng: np.random.Generator, tags: int, drift_share: float, drift_frames: float) -> None:
        self.rng = rng
        self.sigma = np.array([0.01, 0.01, 0.01, 0.1, 0.1, 0.8])
        self.share, self.keep = drift_share, math.exp(-1.0 / drift_frames)
        self.drift = rng.normal(size=(tags, 6))

    def draw(self) -> FloatArray:
        """(tags, 6) errors of one frame: rotation about the camera's axes, translation along them."""
        fresh = self.rng.normal(size=self.drift.shape)
        self.drift = self.keep * self.drift + math.sqrt(1.0 - self.keep**2) * self.rng.normal(size=self.drift.shape)
        mixed = math.sqrt(self.share) * self.drift + math.sqrt(1.0 - self.share) * fresh
        return np.asarray(mixed * self.sigma)


def place_tags(rng: np.random.Generator, tags: int) -> list[FloatArray]:
    """camera_T_tag of tags in view at 90 to 140 mm, within 45 mm of the optical axis, tilted up to some 35 deg."""
    out = []
    for _ in range(tags):
        place = np.array([*rng.uniform(-45.0, 45.0, 2), rng.uniform(90.0, 140.0)])
        turn = exp_so3(np.array([*rng.uniform(-0.6, 0.6, 2), rng.uniform(-math.pi, math.pi)]))
        out.append(make_transform(np.diag([1.0, -1.0, -1.0]) @ turn, place))
    return out


def see_tags(poses: list[FloatArray], noise: TagNoise) -> tuple[dict[int, FloatArray], dict[int, FloatArray]]:
    """One frame: camera_T_tag and right-tangent covariances as the session's defaults have them."""
    seen, covariance = {}, {}
    for i, (pose, error) in enumerate(zip(poses, noise.draw(), strict=True)):
        seen[i] = make_transform(exp_so3(error[:3]) @ pose[:3, :3], pose[:3, 3] + error[3:])
        covariance[i] = right_from_parent_covariance(seen[i][:3, :3], np.diag(noise.sigma**2))
    return seen, covariance


def run_tags_clean(frames: int, seed: int, tags: int, drift_share: float, drift_frames: float) -> int:
    """False alarms (each resets the watch) in so many frames, in epochs of 500."""
    alarms = 0
    for s in range(frames // 500):
        rng = np.random.default_rng([seed, s])
        poses, noise = place_tags(rng, tags), TagNoise(rng, tags, drift_share, drift_frames)
        watch = StaticTagsWatch()
        for _ in range(500):
            test = watch.add(*see_tags(poses, noise))
            if test is not None and test.alarm:
                alarms += 1
                watch.reset()
    return alarms


def run_tags_shifts(
    sessions: int, mm: float, degrees: float, seed: int, tags: int, drift_share: float, drift_frames: float
) -> list[int]:
    """Frames from each shift to its alarm (99 where none within the frames before the next pair)."""
    out = []
    for s in range(sessions):
        rng = np.random.default_rng([seed, s])
        poses, noise = place_tags(rng, tags), TagNoise(rng, tags, drift_share, drift_frames)
        motion = shift_of(rng, mm, degrees)
        watch = StaticTagsWatch()
        for _ in range(STEADY * FRAMES_PER_PAIR):
            watch.add(*see_tags(poses, noise))
        moved = [motion @ pose for pose in poses]
        found = 99
        for k in range(FRAMES_PER_PAIR):
            test = watch.add(*see_tags(moved, noise))
            if test is not None and test.alarm:
                found = k + 1
                break
        out.append(found)
    return out
