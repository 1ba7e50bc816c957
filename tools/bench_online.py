"""Latency of the online registration on a long stream with several camera epochs.

    python tools/bench_online.py                      # 2,000 pairs, seven epochs
    python tools/bench_online.py --pairs 300 --epochs 1

Prints, each figure beside its limit: p50, p99, p99.9 and the largest of ``add`` without disk and without the full solve
(which runs in a worker process in the operating room); the first 10 pairs of an epoch with their full solve in process;
the last quarter of the pairs against the first; ``track``; memory growth; and the same graph of native GTSAM factors.
Wall time and processor time: on a machine that does other work as well the second is the engine's own.
"""

from __future__ import annotations

import argparse
import gc
import math
import resource
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import gtsam
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from fgreg.geometry.transforms import FloatArray, as_float_array, exp_so3, inverse, make_transform
from fgreg.model.measurements import Aim, Look, MarkerObservation, Pair, Track, default_marker_covariance
from fgreg.model.session_model import SessionModel
from fgreg.online import CameraMoved, OnlineRegistration
from fgreg.smoother.updates import MOST

FIRST = 10


def _place(rng: np.random.Generator, camera_p: FloatArray, marker_T_laser: FloatArray) -> FloatArray:
    """``camera_T_marker`` with its beam through a camera point."""
    sight = camera_p / np.linalg.norm(camera_p)
    across = np.linalg.svd(sight[None])[2][1:]
    rotation, lean = rng.uniform(-math.pi, math.pi), 0.35 * math.sqrt(rng.uniform())
    direction = sight + math.tan(lean) * (math.cos(rotation) * across[0] + math.sin(rotation) * across[1])
    direction /= np.linalg.norm(direction)
    basis = np.linalg.svd(direction[None])[2][1:]
    spin = rng.uniform(-math.pi, math.pi)
    x = math.cos(spin) * basis[0] + math.sin(spin) * basis[1]
    rotation_matrix = np.stack([x, np.cross(direction, x), direction], axis=1)
    camera_T_laser = make_transform(rotation_matrix, camera_p - rng.uniform(25.0, 60.0) * direction)
    return np.asarray(camera_T_laser @ inverse(marker_T_laser))


def _observed(
    rng: np.random.Generator, camera_T_marker: FloatArray, model: SessionModel, number: int
) -> MarkerObservation:
    noise = model.noise
    turn = exp_so3(rng.normal(size=3) * np.array(noise.marker_rotation_rad))
    shift = rng.normal(size=3) * np.array(noise.marker_translation_mm)
    pose = make_transform(turn @ camera_T_marker[:3, :3], camera_T_marker[:3, 3] + shift)
    covariance = default_marker_covariance(pose, noise)
    return MarkerObservation(as_float_array(pose, 4, 4), as_float_array(covariance, 6, 6), number)


class Stream:
    """Events made one by one, so that what grows is the engine."""

    def __init__(self, model: SessionModel, seed: int) -> None:
        self.model, self.rng = model, np.random.default_rng(seed)
        down = np.diag([1.0, -1.0, -1.0]) @ exp_so3(np.array([0.2, -0.15, 0.7]))
        self.trus_T_camera = make_transform(down, np.array([1.0, 2.0, 42.0]) - down @ np.array([0.0, 0.0, 105.0]))
        self.marker_T_laser = make_transform(exp_so3(np.array([0.2, -0.15, 0.3])), np.array([8.0, -5.0, 7.0]))
        self.edge = float(self.rng.normal() * model.probe.sensitivity.edge_sigma_rad)
        self.t, self.number = 0.0, 0

    def aims(self, count: int) -> Iterator[Aim]:
        """Calibration shots."""
        for _ in range(count):
            self.t += 1.0
            self.number += 1
            spot = np.array([*self.rng.uniform(-30.0, 30.0, 2), self.rng.uniform(90.0, 130.0)])
            marker = _observed(self.rng, _place(self.rng, spot, self.marker_T_laser), self.model, self.number)
            sigma = np.array(self.model.noise.aim_mm)
            yield Aim(self.t, marker, spot + sigma * self.rng.normal(size=3), np.diag(sigma**2))

    def pair(self, pm: int) -> Pair:
        """A first-hit pair, sweeps from both sides in turn."""
        rng, model = self.rng, self.model
        self.t += 1.0
        self.number += 1
        bearing, reach = rng.uniform(-0.5, 0.5), model.probe.radius_mm + rng.uniform(22.0, 42.0)
        trus_p = np.array([rng.uniform(-20.0, 20.0), reach * math.sin(bearing), reach * math.cos(bearing)])
        camera_p = (inverse(self.trus_T_camera) @ np.array([*trus_p, 1.0]))[:3]
        marker = _observed(rng, _place(rng, camera_p, self.marker_T_laser), model, self.number)
        sweep = 1 if pm % 2 else -1
        scan, radius = bearing, model.probe.radius_mm
        distance = 0.0
        share = rng.uniform()
        for _ in range(30):
            distance = math.hypot(trus_p[1] - radius * math.sin(scan), trus_p[2] - radius * math.cos(scan))
            width = float(model.probe.sensitivity.half_width_at(np.array(distance))) + self.edge
            scan = bearing - sweep * (width - share * model.stage.step_rad)
        noise = model.noise
        look = Look(
            scan + noise.scan_rad * float(rng.normal()),
            noise.scan_rad,
            float(trus_p[0]) + noise.lateral_mm * float(rng.normal()),
            distance + noise.range_mm * float(rng.normal()),
            np.diag([noise.lateral_mm**2, noise.range_mm**2]),
            sweep,
        )
        return Pair(self.t, pm, 0, marker, look)

    def moved(self) -> CameraMoved:
        """The camera moves, told without the motion."""
        self.t += 1.0
        motion = make_transform(exp_so3(self.rng.uniform(-0.1, 0.1, 3)), self.rng.uniform(-10.0, 10.0, 3))
        self.trus_T_camera = self.trus_T_camera @ inverse(motion)
        return CameraMoved(self.t)


def _memory_mb() -> float:
    """Resident memory now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def _linear(
    rng: np.random.Generator, values: gtsam.Values, parts: list[list[tuple[int, int]]]
) -> gtsam.NonlinearFactor:
    """A native factor on keys of these dimensions: a row a part, of at most three keys, as the wrapper has it."""
    rows = gtsam.GaussianFactorGraph()
    for part in parts:
        blocks = [x for key, size in part for x in (key, rng.normal(size=(1, size)))]
        rows.add(gtsam.JacobianFactor(*blocks, np.zeros(1), gtsam.noiseModel.Unit.Create(1)))  # type: ignore[call-overload]
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(rows), values)


def _native(pairs: int) -> FloatArray:
    """Milliseconds of the same updates with native factors, ``(n, 2)``: wall, processor.

    The same graph: each pair's factors are on the same keys, with the same dimensions, as in
    fgreg.smoother.isam_window: a prior of the marker pose (6), point on line (3) on registration, marker pose, beam,
    lambda and PM, point on arc (3) on PM and theta, sensitivity (1) on theta and the window's edge. The window is as
    long, and the oldest pair leaves it. Not matched: the two of 3 rows are linear (the wrapper has no native factor on
    those keys), there is no marginal prior to exchange, and no pair is prepared, tested or reported.
    """
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    parameters.relinearizeSkip = 1
    parameters.findUnusedFactorSlots = True
    isam = gtsam.ISAM2(parameters)
    theta = isam.getLinearizationPoint()
    rng = np.random.default_rng(0)
    pose, beam, edge = gtsam.symbol("T", 0), gtsam.symbol("B", 0), gtsam.symbol("W", 0)
    unit6, unit1 = (gtsam.noiseModel.Unit.Create(n) for n in (6, 1))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(pose, gtsam.Pose3(), unit6))
    graph.add(gtsam.PriorFactorVector(beam, np.zeros(4), gtsam.noiseModel.Unit.Create(4)))
    graph.add(gtsam.PriorFactorDouble(edge, 0.0, unit1))
    values.insert(pose, gtsam.Pose3())
    values.insert(beam, np.zeros(4))
    values.insert(edge, 0.0)
    shared = gtsam.Values(values)
    isam.update(graph, values)
    slots: list[list[int]] = []
    took = []
    for i in range(pairs):
        marker, point = gtsam.symbol("M", i), gtsam.symbol("P", i)
        lam, arc = gtsam.symbol("L", i), gtsam.symbol("H", i)
        values = gtsam.Values()
        values.insert(marker, gtsam.Pose3())
        values.insert(point, np.zeros(3))
        values.insert(lam, 0.0)
        values.insert(arc, 0.0)
        every = gtsam.Values(shared)
        every.insert(values)
        graph = gtsam.NonlinearFactorGraph()
        graph.add(gtsam.PriorFactorPose3(marker, gtsam.Pose3(), unit6))
        line = [
            [(pose, 6), (marker, 6), (point, 3)],
            [(beam, 4), (lam, 1), (point, 3)],
            [(pose, 6), (beam, 4), (lam, 1)],
        ]
        graph.add(_linear(rng, every, line))
        graph.add(_linear(rng, every, [[(point, 3), (arc, 1)]] * 3))
        graph.add(gtsam.BetweenFactorDouble(edge, arc, 0.0, unit1))
        start, used = time.perf_counter(), time.thread_time()
        isam = gtsam.ISAM2(isam)
        theta = isam.getLinearizationPoint()
        result = isam.update(graph, values, slots.pop(0) if len(slots) == MOST else [])
        slots.append(list(result.getNewFactorsIndices()))
        isam.calculateEstimatePose3(pose)
        isam.jointMarginalCovariance([pose, beam, edge])
        took.append((1e3 * (time.perf_counter() - start), 1e3 * (time.thread_time() - used)))
    assert theta is not None
    return np.array(took)


def _row(name: str, values: FloatArray, targets: str) -> None:
    wall, used = values[:, 0], values[:, 1]
    quantiles = (50.0, 99.0, 99.9)
    shown = [" ".join(f"{q:8.2f}" for q in (*np.percentile(v, quantiles), v.max())) for v in (wall, used)]
    print(f"{name:<38} wall {shown[0]}   processor {shown[1]}   limit {targets}")


class Timed(OnlineRegistration):
    """Tells the full solve's share of each event, in seconds of wall and processor time."""

    share = (0.0, 0.0)

    def _solve(self, t: float) -> None:
        start, used = time.perf_counter(), time.thread_time()
        super()._solve(t)
        self.share = (time.perf_counter() - start, time.thread_time() - used)


def bench(pairs: int, epochs: int, seed: int) -> None:
    """One stream."""
    from tests.forward import make_session

    model = make_session()
    stream = Stream(model, seed)
    engine = Timed(model, find_moves=True)
    for aim in stream.aims(12):
        engine.add(aim)
    times: list[tuple[float, float]] = []
    first: list[tuple[float, float]] = []
    tracks: list[tuple[float, float]] = []
    memory, epoch = 0.0, 0
    for i in range(pairs):
        if i and i * epochs // pairs > epoch:
            epoch += 1
            engine.add(stream.moved())
        pair = stream.pair(i)
        start, used = time.perf_counter(), time.thread_time()
        estimate = engine.add(pair)
        took = (time.perf_counter() - start, time.thread_time() - used)
        times.append((1e3 * (took[0] - engine.share[0]), 1e3 * (took[1] - engine.share[1])))
        if engine.state.epoch_pairs <= FIRST:
            first.append((1e3 * took[0], 1e3 * took[1]))
        if i == pairs // 10:
            gc.collect()
            memory = _memory_mb()
        if i in (pairs // 20, pairs // 2):
            query = Track(pair.t, engine.state.epoch, pair.marker, (pair.look,))
            for _ in range(20):
                start, used = time.perf_counter(), time.thread_time()
                engine.track(query)
                tracks.append((1e3 * (time.perf_counter() - start), 1e3 * (time.thread_time() - used)))
    gc.collect()
    growth = _memory_mb() - memory
    engine.close()
    every, start_up = np.array(times), np.array(first)
    print(f"{pairs} pairs, {epochs} epochs, {sum(engine.kept)} inliers; milliseconds: p50, p99, p99.9, largest")
    _row("add without its full solve", every, "p50 30, p99 60")
    _row(f"add, first {FIRST} pairs, with full solve", start_up, "largest 300 (first epochs of a session)")
    if tracks:
        _row("track", np.array(tracks), "p50 5")
    quarter = max(len(every) // 4, 1)
    for name, column in (("wall", 0), ("processor", 1)):
        ratio = np.median(every[-quarter:, column]) / np.median(every[:quarter, column])
        print(f"median of the last quarter over the first, {name}: {ratio:.2f}")
    print(f"memory growth {growth:.1f} MB")
    native = _native(300)[100:]
    _row("native factors, same graph", native, "no Python in it")
    ratio = np.median(every, axis=0) / np.median(native, axis=0)
    print(f"ratio of medians to native: wall {ratio[0]:.1f}, processor {ratio[1]:.1f}")
    error = np.linalg.inv(stream.trus_T_camera) @ np.asarray(estimate.optimum_trus_T_camera)
    print(f"at the end the registration is off by {np.abs(error[:3, 3]).max():.3f} mm at the camera")


def main() -> None:
    """Parse and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=2000)
    parser.add_argument("--epochs", type=int, default=7)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    bench(arguments.pairs, arguments.epochs, arguments.seed)


if __name__ == "__main__":
    main()
